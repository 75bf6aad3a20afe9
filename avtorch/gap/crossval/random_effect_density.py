"""Gain in held-out log density from random effects, whose parameters are fitted to other rows."""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search import command_errors
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.full_rate import full_rate_errors, full_rate_filter
from avtorch.gap.search.lost_messages import lost_message_gains
from avtorch.gap.search.outliers import heavy_tails
from avtorch.gap.search.random_effects import variance_of


def random_effect_density(found: FittedModel, raw: Record, fits: Record) -> FloatArray:
    """Log density (counted,) [nats] that a model's outliers, lost messages or command errors gain in each row.

    Fractions and sizes are fitted to the rows that count in `fits`; only a user-defined command error uses all rows.
    `raw`: the same drives without averaging of rows.
    """
    record, own = found.hypothesis.record, found.by_chance
    if found.tails is None and found.losses is None and (own is None or own.process_sd is None):
        return np.zeros(record.rows)
    row = raw.source // record.group
    fitted = np.isin(row, fits.source)
    errors = full_rate_errors(raw, found)
    gained = np.zeros(raw.rows)
    began = None
    if found.tails is not None:
        law = {} if own is None or own.law.form != "tails" else {"law": own.law.tails, "size": own.law.size}
        gained += heavy_tails(errors[0, :, 0], raw.dt, fits=fitted, **law).ratios
        began = found.tails.onset
    if found.losses is not None:
        values, command = found.values, raw.command[raw.source]
        gained += lost_message_gains(
            full_rate_filter(raw, found), errors, command, values["T_L"], values["K_L"], fitted
        )
        began = found.losses.onset
    if own is not None and own.process_sd is not None:
        plain = full_rate_filter(raw, found)
        white = WhiteningFilter(raw, plain.noise.replaced(process_sd=own.process_sd))
        variance = variance_of(own.law, own.z, found, raw)
        gained += command_errors.command_error_gains(white, errors, variance, found.values["T_L"], found.values["K_L"])
        gained += white.row_likelihoods(errors) - plain.row_likelihoods(errors)
    if began is not None:
        gained[:began] = 0.0
    by_row = np.bincount(row, weights=gained, minlength=int(record.source[-1]) + 1)
    return np.asarray(by_row[record.source], np.float64)
