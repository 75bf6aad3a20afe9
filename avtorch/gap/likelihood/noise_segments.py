"""The noise before an onset: no sensor lag or scale error yet, and a force of nuisance size."""

from __future__ import annotations

from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.whitening_filter import Until, WhiteningFilter

CALM = 0.005
"""Size of the nuisance force before a gust's onset [m/s²]."""


def before_onset(noise: NoiseModel, *, onset: int | None = None, gust_onset: int | None = None) -> Until:
    """`noise` as it was up to each onset, in order: `onset` of a sensor's lag and scale, `gust_onset` of a gust."""
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
    """The whitening filter for errors under `noise`, with its changes at the onsets."""
    return WhiteningFilter(record, noise, before_onset(noise, onset=onset, gust_onset=gust_onset))
