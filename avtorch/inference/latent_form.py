"""The latent form for a stream: only acceleration and/or speed are measured, and neither is differenced."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.latent import LatentDensity, default_noise_prior, latent_names
from avtorch.inference.latent_excitation import latent_excitation
from avtorch.inference.latent_window import LatentWindow
from avtorch.inference.priors import Prior
from avtorch.inference.sampler_settings import SamplerSettings

#: Each step runs a filter over the rows for every chain, so there are fewer and longer chains. Some parameters are
#: determined by little more than their prior, and their posteriors are so far from normal that importance sampling
#: around the draws does not determine their moments; convergence is tested on the chains alone.
SAMPLER = SamplerSettings(chains=64, draws=20, burn_in=12, thinning=1, step=1.5, longest=3.0, compare=False)


class LatentForm:
    """Windows of ``accel_cmd`` with measured ``accel`` and/or ``speed``, for :class:`LatentDensity`.

    Args:
        accel, speed: which of the two is measured.
        noise: noise level at which excitation is predicted, by name (see :func:`latent_excitation`).
        share: the least share of a window's rows that must be usable; the state at the start of a run is unknown, so
            that a short end of a drive is less informative than its rows suggest.
    """

    sampler = SAMPLER

    def __init__(
        self,
        *,
        accel: bool,
        speed: bool,
        noise: Mapping[str, float] | None = None,
        noise_prior: Prior | None = None,
        share: float = 0.75,
    ) -> None:
        self.names = latent_names(accel=accel, speed=speed)
        self.measured = (*(("accel",) if accel else ()), *(("speed",) if speed else ()))
        self.columns = ("accel_cmd", *self.measured)
        self.noise_prior: Prior = default_noise_prior(self.names[2:]) if noise_prior is None else noise_prior
        self.noise, self.share = noise, share

    def likelihood(self, rows: Rows, full: float) -> WindowLikelihood:
        usable = rows["usable"]
        count = usable.sum(-1)
        enough = count >= max(4.0, self.share * full)
        time = rows["time"].expand(usable.shape)
        signals = {name: rows[name] if name in self.measured else None for name in ("accel", "speed")}
        data = LatentWindow(time, rows["accel_cmd"], signals["accel"], signals["speed"], usable)
        excited = torch.zeros_like(enough)
        if bool(enough.any()):
            excited[enough] = latent_excitation(data.select(enough), noise=self.noise)[0]
        return WindowLikelihood(count, excited, lambda index, prior: LatentDensity(data.select(index), prior))
