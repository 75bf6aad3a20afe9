"""The latent form for a stream: only acceleration and/or speed are measured, and neither is differenced.

Which of its windows are excited is a fixed rule, independent of the posterior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.inference.form import Rows, WindowLikelihood
from avtorch.inference.latent import (
    NOISE_PRIOR,
    LatentDensity,
    default_noise_prior,
    even_steps,
    latent_names,
    run_log_likelihood,
)
from avtorch.inference.latent_window import LatentWindow
from avtorch.inference.priors import Prior
from avtorch.inference.sampler_settings import SamplerSettings

#: Each step runs a filter over the rows for every chain, so there are fewer and longer chains. Some parameters are
#: determined by little more than their prior, and their posteriors are so far from normal that importance sampling
#: around the draws does not determine their moments; convergence is tested on the chains alone.
SAMPLER = SamplerSettings(chains=64, draws=20, burn_in=12, thinning=1, step=1.5, longest=3.0, compare=False)
#: Reference vehicle at which the information is predicted: lag [s], gain [-].
REFERENCE = (0.3, 1.0)
#: Noise level at which it is predicted: the medians of the noise priors.
REFERENCE_NOISE = {name: median for name, (median, _) in NOISE_PRIOR.items()}
#: SDs of log T_L and log K_L under the first prior.
KNOWN = (0.7, 0.3)
#: A window is excited from one bit on: where it is expected to halve the area of the belief about (T_L, K_L).
LEAST_BITS = 1.0


class LatentForm:
    """Windows of ``accel_cmd`` with measured ``accel`` and/or ``speed``, for :class:`LatentDensity`.

    `accel`, `speed`: which of the two is measured. `noise`: noise level at which excitation is predicted, by name (see
    :func:`latent_excitation`). `share`: the least share of a window's rows that must be usable; the state at the start
    of a run is unknown, so that a short end of a drive is less informative than its rows suggest.
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


def latent_excitation(
    data: LatentWindow,
    *,
    noise: Mapping[str, float] | None = None,
    reference: tuple[float, float] = REFERENCE,
    least_bits: float = LEAST_BITS,
) -> tuple[Bool[Tensor, " window"], Float[Tensor, " window"]]:
    """Which windows are excited, ``(window,)`` bool, and their expected information, ``(window,)`` [bit].

    The figure is the expected information about ``(log T_L, log K_L)`` that the *command* brings, at a fixed reference
    vehicle and noise level: with ``F`` the Fisher information of the predicted signal and ``C = diag(KNOWN²)``,
    ``log2 det(I + C F) / 2``. It depends on times, commands and mask, on which signals are measured and on ``noise``
    (names and units of ``NOISE_PRIOR``; the default is ``REFERENCE_NOISE``), not on measured values or a posterior.
    Each run's start and a constant force on it are taken as unknown, so a constant command carries no information.
    """
    place, data = data.time.device, data.to("cpu")  # some short recursions, row by row
    runs, owner = data.runs()
    names = latent_names(accel=data.accel is not None, speed=data.speed is not None)
    values = dict(zip(names[:2], reference, strict=True)) | REFERENCE_NOISE | dict(noise or {})
    p = {name: torch.full_like(owner, values[name], dtype=torch.float64) for name in names}

    by_lag, by_gain = _sensitivities(runs, *reference)

    def energies_of(signals: list[tuple[Tensor, Tensor]]) -> list[Tensor]:
        """``sᵀ Σ⁻¹ s`` of signals (acceleration, speed): twice the loss of log likelihood that each causes alone."""
        count = len(signals)
        accel, speed = (torch.cat(parts) for parts in zip(*signals, strict=True))
        time, mask = (x.repeat(count, 1) for x in (runs.time, runs.mask))
        data = LatentWindow(
            time,
            torch.zeros_like(time),
            None if runs.accel is None else accel,
            None if runs.speed is None else speed,
            mask,
        )
        repeated = {name: x.repeat(count) for name, x in p.items()}
        return list((-2.0 * run_log_likelihood(repeated, data, even_steps(data))).chunk(count))

    # A force of unknown constant size, such as a slope: only changes of the command then determine the gain.
    since = runs.time - runs.time[:, :1]
    signals = (by_lag, by_gain, (torch.ones_like(since), since))
    zero = torch.zeros_like(since)
    pairs = ((0, 1), (0, 2), (1, 2))
    sums = [(signals[i][0] + signals[j][0], signals[i][1] + signals[j][1]) for i, j in pairs]
    floor, *found = energies_of([(zero, zero), *signals, *sums])
    energies = [x - floor for x in found[:3]]
    tk, tc, kc = (
        0.5 * (both - energies[i] - energies[j] - floor) for both, (i, j) in zip(found[3:], pairs, strict=True)
    )
    tt, kk, cc = energies
    cc = cc.clamp(min=1e-12)
    fisher = (tt - tc**2 / cc, kk - kc**2 / cc, tk - tc * kc / cc)
    tt, kk, tk = (torch.zeros(data.windows, dtype=torch.float64).index_add(0, owner, f) for f in fisher)
    known_T, known_K = KNOWN
    determinant = (1.0 + known_T**2 * tt) * (1.0 + known_K**2 * kk) - (known_T * known_K * tk) ** 2
    bits = 0.5 * determinant.clamp(min=1.0).log() / math.log(2.0)
    bits = bits.to(place)
    return bits >= least_bits, bits


def _sensitivities(runs: LatentWindow, T: float, K: float) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Derivatives of (acceleration, speed) by log T_L and by log K_L, each ``(run, time)``, with the command held."""
    h = 1e-4
    shape = runs.time.shape
    lags = (T * (1.0 + h), T * (1.0 - h))
    found = np.zeros((2, 2, *shape))  # lag, (acceleration, speed), run, row
    steps, targets = runs.time.diff().clamp(min=0.0).numpy(), K * runs.u.numpy()
    for i, lag in enumerate(lags):
        for run in range(shape[0]):
            # plain numbers: one short recursion after another, in which a call of an array library costs most
            kept = np.exp(-steps[run] / lag).tolist()
            a, v = float(targets[run, 0]), 0.0
            accel, speed = [a], [v]
            for u, dt, decay in zip(targets[run].tolist(), steps[run].tolist(), kept, strict=False):
                fading = (a - u) * (1.0 - decay)
                v += u * dt + lag * fading
                a -= fading
                accel.append(a)
                speed.append(v)
            found[i, :, run] = accel, speed
    accel, speed = torch.from_numpy(found).unbind(1)
    by_lag = ((accel[0] - accel[1]) / (2.0 * h), (speed[0] - speed[1]) / (2.0 * h))
    # The response is proportional to K_L.
    return by_lag, (accel.mean(0), speed.mean(0))
