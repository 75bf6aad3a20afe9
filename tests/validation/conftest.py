"""NUTS in a moment: exact draws where a test is not about NUTS itself."""

from __future__ import annotations

import pytest
import torch

from avtorch.inference import Posterior, SamplerSettings, sample


@pytest.fixture
def quick_nuts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands in for NUTS: draws of a sampler that is right on these windows."""
    pytest.importorskip("pyro")
    import avtorch.inference.nuts as module

    def stand_in(density, *, window: int, chains: int, draws: int, warmup: int, seed: int) -> Posterior:
        settings = SamplerSettings(chains=64, draws=16, burn_in=10, step=1.5)
        return sample(density, settings, generator=torch.Generator().manual_seed(seed + 1))

    monkeypatch.setattr(module, "nuts", stand_in)
