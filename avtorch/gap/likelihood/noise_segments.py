"""The noise before an onset: a sensor that still reads plainly, a force that is still calm."""

from __future__ import annotations

from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitening_filter import Until, WhiteningFilter

CALM = 0.005
"""Size of the nuisance force before a gust's onset [m/s²]."""


def before_onset(noise: NoiseModel, *, onset: int | None = None, gust_onset: int | None = None) -> Until:
    """What `noise` was up to a row, in order: `onset` is that of a sensor's lag and scale, `gust_onset` a gust's."""
    plain = noise.seen_through((), {})
    shaped = onset if plain != noise else None
    out = []
    for row in sorted({row for row in (shaped, gust_onset) if row}):
        before = plain if shaped is not None and row <= shaped else noise
        if gust_onset is not None and row <= gust_onset:
            before = before.replaced(force_sd=min(CALM, noise.force_sd))
        out.append((row, before))
    return tuple(out)


def whitening_filter(
    record: Record, noise: NoiseModel, *, onset: int | None = None, gust_onset: int | None = None
) -> WhiteningFilter:
    """Of errors under `noise` as it was before and after the onsets."""
    return WhiteningFilter(record, noise, before_onset(noise, onset=onset, gust_onset=gust_onset))
