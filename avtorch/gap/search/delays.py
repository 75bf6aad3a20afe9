"""All delays that fit equally well under a periodic command.

A periodic command identifies a delay only up to its period: the likelihood has a mode at every multiple of the period,
and under a pure sine a delay and a longer lag are equivalent. All delays within the prior's range are therefore tried,
with lag and gain fitted to each; evidence and posterior are those of all modes together. A mode within one row of zero
delay counts as no delay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish, modes
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.fitted_model import ALIKE, Delays, FittedModel
from avtorch.gap.simulator.simulator_input import SimulatorInput

_LONGEST_S = 1.0  # twice the longest typical delay
_TRIED = 40
_FOLLOWED = 16  # number of these refined to their modes

_REPEATS = 0.95  # least correlation of a command with itself one period later
_BEGUN_S = 2.0  # start of a stretch, in which commands from before the log may still act
_DIPS = 0.2  # least drop of the correlation between the peaks


def repeats_after(drives: Sequence[SimulatorInput]) -> float | None:
    """The period [s] of a periodic command, from the rows of all drives; None where it is not periodic."""
    longest = max(len(d.time) for d in drives) // 2
    total, norm = np.zeros(longest), np.zeros(longest)
    for drive in drives:
        u = drive.command.numpy() - float(drive.command.mean())
        count = min(longest, len(u) // 2)
        spectrum = np.fft.rfft(u, 2 * len(u))
        total[:count] += np.fft.irfft(np.abs(spectrum) ** 2)[:count]
        square = np.cumsum(u**2)
        # energies of the two overlapping stretches
        early, late = square[len(u) - 1 - np.arange(count)], square[-1] - np.concatenate([[0.0], square[: count - 1]])
        norm[:count] += np.sqrt(early * late)
    if not norm[0] > 0:
        return None
    r = total / np.maximum(norm, 1e-12 * norm[0])
    dips = np.minimum.accumulate(r)
    later = np.append(r[1:], -1.0)
    peaks = np.flatnonzero((r > _REPEATS) & (r >= later) & (r > dips + _DIPS))
    # the first peak may be a shoulder of the true one, one row earlier
    return None if not len(peaks) else float(peaks[0] * drives[0].dt.median())


def all_delays(record: Record, best: Mapping[str, FittedModel]) -> dict[str, FittedModel]:
    """Fitted models by name, most evidence first, each with all delays that a periodic command leaves possible."""
    period = repeats_after(record.drives)
    if period is None:
        return dict(best)
    out, top = [], next(iter(best.values()))
    for f in best.values():
        shifts = {e.name for e in f.hypothesis.effects if e.shift is not None}
        without = best.get("+".join(sorted(set(f.name.split("+")) - shifts)) or "none")
        able = shifts and without is not None and ("+" not in f.name or f is top)
        out.append(with_delays(f, without, period) if able and without is not None else f)
    return {f.name: f for f in sorted(out, key=lambda f: -f.log_evidence)}


def with_delays(found: FittedModel, without: FittedModel, period: float) -> FittedModel:
    """`found` with all its delays that fit equally well under a command of this `period` [s]; unchanged without a
    delay.

    `without`: the fitted model with the same effects except the delay.
    """
    candidate, onset = found.hypothesis, found.onset
    keys = [f"{e.name}.{e.shift}" for e in candidate.effects if e.shift is not None]
    at = [i for i, c in enumerate(candidate.coordinates) if c.key in keys]
    if len(at) != 1:
        return found
    (i,) = at
    coordinate, row = candidate.coordinates[i], candidate.record.dt / candidate.record.group
    own = float(found.values[coordinate.key])
    step = max(period, _LONGEST_S / _TRIED)
    shifted = own + step * np.arange(-np.floor(own / step), np.floor((_LONGEST_S - own) / step) + 1)
    tries = np.unique(np.round([*shifted, 0.3 * row, 0.05, 0.15, 0.35, 0.7], 6))
    starts = np.repeat(found.z[None], len(tries), 0)
    starts[:, i] = [coordinate.z_of(max(float(d), 1e-4)) for d in tries]
    white = found.white
    looked, value = modes(candidate, white, np.concatenate([found.z[None], starts]), onset=onset, iterations=3)
    z, _ = modes(candidate, white, looked[np.argsort(-value)[:_FOLLOWED]], onset=onset, iterations=6)
    lengths = coordinate.value(z[:, i]).numpy()
    fits = np.array([_settled(white, candidate.errors(x[None], onset)[0]) for x in z])
    kept: list[int] = []
    for k in np.argsort(-fits):
        near = [j for j in kept if abs(lengths[j] - lengths[k]) < min(0.3 * period, max(row, 0.05 * lengths[j]))]
        if fits[k] > fits.max() - ALIKE and not near:
            kept.append(int(k))
    laplace = [finish(candidate, white, z[k], onset) for k in kept]
    first = finish(candidate, white, found.z, onset)
    # the first rows of a stretch respond to commands from before the log, so they do not discriminate between delays
    begun = [float(white.row_likelihoods(f.errors).sum()) - _settled(white, f.errors) for f in laplace]
    evidence = np.array([f.log_evidence for f in laplace]) - np.array(begun) + max(begun)
    total = float(np.logaddexp.reduce(evidence))
    order = np.argsort(lengths[kept])
    plain = without.white
    gain = max(_settled(plain, e) for e in candidate.errors(z, onset)) - _settled(plain, without.errors)
    best = int(evidence.argmax())
    return replace(
        found,
        z=laplace[best].z,
        covariance=laplace[best].covariance,
        errors=laplace[best].errors,
        values={k: float(v) for k, v in candidate.values(laplace[best].z[None]).items()},
        log_evidence=found.log_evidence + total - first.log_evidence,
        delays=Delays(
            period=period,
            row=row,
            lengths=lengths[kept][order],
            shares=np.exp(evidence - total)[order],
            z=z[kept][order],
            covariances=np.stack([laplace[k].covariance for k in order]),
            gain=gain,
            without=without.name,
        ),
    )


def _settled(white: WhiteningFilter, errors: FloatArray) -> float:
    """Log likelihood of errors (channel, counted, group), without the rows at the start of each stretch."""
    record = white.record
    since = np.arange(record.rows) - record.starts[record.stretch]
    return float(white.row_likelihoods(errors)[since * record.dt >= _BEGUN_S].sum())
