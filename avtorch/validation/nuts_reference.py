"""NUTS over selected windows, by Pyro: an independent reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.posterior import Posterior
from avtorch.validation.windows import Windows


@dataclass(frozen=True)
class NutsSettings:
    """Chains, draws a chain and steps of adaptation of the NUTS reference.

    Raises:
        InputError: for fewer than 1 chain, 16 draws or 1 step of adaptation.

    Example:
        >>> from avtorch.validation import NutsSettings
        >>> quick = NutsSettings(chains=1, draws=200, warmup=100)  # for `validate`
        >>> quick.chains * quick.draws
        200
    """

    chains: int = 2
    draws: int = 1000
    warmup: int = 500

    def __post_init__(self) -> None:
        for name, least in (("chains", 1), ("draws", 16), ("warmup", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: found {getattr(self, name)}, needs {least} or more")


#: NUTS where a step costs milliseconds, and where it runs a filter over the rows (minutes per window even with fewer
#: draws).
NUTS_WINDOWS, LATENT_NUTS_WINDOWS = 3, 1
LATENT_NUTS = NutsSettings(chains=1, draws=300, warmup=200)


def walk_nuts(
    windows: Windows, index: Tensor, settings: NutsSettings, *, seed: int, done: Callable[[], None]
) -> Posterior:
    """NUTS on the windows named by ``index``, one after another; ``done`` is called after each."""
    from avtorch.inference.nuts import nuts

    found = []
    for i in index:
        one = windows.select(i[None])
        found.append(
            nuts(
                one.density,  # pyright: ignore[reportArgumentType]
                window=0,
                chains=settings.chains,
                draws=settings.draws,
                warmup=settings.warmup,
                seed=(seed + int(i)) % 2**63,
            )
        )
        done()
    return join_draws(found)


def join_draws(parts: list[Posterior]) -> Posterior:
    """Posteriors of different windows as one."""
    draws, converged = torch.cat([p.draws for p in parts], 2), torch.cat([p.converged for p in parts])
    why = [reason for p in parts for reason in (p.why or ("",) * len(p.converged))]
    return Posterior(parts[0].names, draws, converged, tuple(why))
