"""What glitches and lost messages add to the density of rows that had no say in how many of them there are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitener import Whitener
from avtorch.gap.search import command_errors
from avtorch.gap.search.chance import tails
from avtorch.gap.search.found import Found
from avtorch.gap.search.losses import rows_gained
from avtorch.gap.search.random_effects import variance_of
from avtorch.gap.search.raw_rows import raw_errors, raw_white

Float = NDArray[np.float64]


def chance_gains(found: Found, raw: Record, fits: Record) -> Float:
    """Log density (counted,) [nats] that the find's glitches or losses gain in each row of its record.

    Fractions and sizes are those of the rows that count in `fits`, but for a user's errors of the command, which are
    those of all rows. `raw`: the same drives in rows of their own.
    """
    record, own = found.candidate.record, found.by_chance
    if found.tails is None and found.losses is None and (own is None or own.process_sd is None):
        return np.zeros(record.rows)
    row = raw.source // record.group
    seen = np.isin(row, fits.source)
    errors = raw_errors(raw, found)
    gained = np.zeros(raw.rows)
    began = None
    if found.tails is not None:
        law = {} if own is None else {"law": own.law.tails, "size": own.law.size}
        gained += tails(errors[0, :, 0], raw.dt, fits=seen, **law).ratios
        began = found.tails.onset
    if found.losses is not None:
        values, command = found.values, raw.command[raw.source]
        gained += rows_gained(raw_white(raw, found), errors, command, values["T_L"], values["K_L"], seen)
        began = found.losses.onset
    if own is not None and own.process_sd is not None:
        plain = raw_white(raw, found)
        white = Whitener(raw, plain.noise.replaced(process_sd=own.process_sd))
        variance = variance_of(own.law, own.z, found, raw)
        gained += command_errors.rows_gained(white, errors, variance, found.values["T_L"], found.values["K_L"])
        gained += white.row_likelihoods(errors) - plain.row_likelihoods(errors)
    if began is not None:
        gained[:began] = 0.0
    by_row = np.bincount(row, weights=gained, minlength=int(record.source[-1]) + 1)
    return np.asarray(by_row[record.source], np.float64)
