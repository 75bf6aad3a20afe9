"""Gain in held-out log density from random effects, whose parameters are fitted to other rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search import command_errors
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.full_rate import full_rate_errors, full_rate_filter
from avtorch.gap.search.lost_messages import LossRatios
from avtorch.gap.search.outliers import heavy_tails
from avtorch.gap.search.random_effects import variance_of


@dataclass(frozen=True, eq=False)
class RandomEffectDensity:
    """What a model's outliers, lost messages or command errors gain in log density, for any choice of rows to fit.

    `raw`: the same drives without averaging of rows. What does not depend on that choice is computed once.
    """

    found: FittedModel = field(repr=False)
    raw: Record = field(repr=False)

    def __call__(self, fits: Record) -> FloatArray:
        """Gain (counted,) [nats] in each row.

        Fractions and sizes are fitted to the rows that count in `fits`; only a user-defined command error uses all.
        """
        found, raw = self.found, self.raw
        record, own = found.hypothesis.record, found.by_chance
        if found.tails is None and found.losses is None and (own is None or own.process_sd is None):
            return np.zeros(record.rows)
        row = raw.source // record.group
        fitted = np.isin(row, fits.source)
        gained = np.zeros(raw.rows)
        began = None
        if found.tails is not None:
            gained += self._tails(fitted)
            began = found.tails.onset
        if found.losses is not None:
            gained += self._losses.fitted_to(fitted)
            began = found.losses.onset
        if own is not None and own.process_sd is not None:
            gained += self._command_errors
        if began is not None:
            gained[:began] = 0.0
        by_row = np.bincount(row, weights=gained, minlength=int(record.source[-1]) + 1)
        return np.asarray(by_row[record.source], np.float64)

    @cached_property
    def _errors(self) -> FloatArray:
        return full_rate_errors(self.raw, self.found)

    def _tails(self, fitted: BoolArray) -> FloatArray:
        own = self.found.by_chance
        law = {} if own is None or own.law.form != "tails" else {"law": own.law.tails, "size": own.law.size}
        return heavy_tails(self._errors[0, :, 0], self.raw.dt, fits=fitted, **law).ratios

    @cached_property
    def _losses(self) -> LossRatios:
        raw, values = self.raw, self.found.values
        white, command = full_rate_filter(raw, self.found), raw.command[raw.source]
        return LossRatios.of(white, self._errors, command, values["T_L"], values["K_L"])

    @cached_property
    def _command_errors(self) -> FloatArray:
        found, raw, own = self.found, self.raw, self.found.by_chance
        assert own is not None
        assert own.process_sd is not None
        plain = full_rate_filter(raw, found)
        white = WhiteningFilter(raw, plain.noise.replaced(process_sd=own.process_sd))
        variance, (T_L, K_L) = variance_of(own.law, own.z, found, raw), (found.values["T_L"], found.values["K_L"])
        gained = command_errors.command_error_gains(white, self._errors, variance, T_L, K_L)
        gained += white.row_likelihoods(self._errors) - plain.row_likelihoods(self._errors)
        return gained
