"""The search for the cause: all single effects, then pairs where a second effect still gains.

Every hypothesis is first fitted under the noise of the bare baseline, over the whole drive and from an onset on. The
best are refitted, each with its own noise, and combined with further effects. Random effects (gusts, outliers, lost
messages) are fitted to the residuals of these models.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from avtorch.gap.answer.scope import Scope
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.random_law import RandomLaw
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.checkpoint import Checkpoint
from avtorch.gap.search.delays import all_delays
from avtorch.gap.search.fitted_model import FittedModel, SearchResult, without_outliers
from avtorch.gap.search.fitted_work import fitted_work
from avtorch.gap.search.full_rate import full_rate_errors, full_rate_filter
from avtorch.gap.search.initial_values import start_points
from avtorch.gap.search.lost_messages import lost_messages
from avtorch.gap.search.outliers import HeavyTails, heavy_tails
from avtorch.gap.search.own_noise_fit import OwnNoiseFits
from avtorch.gap.search.pair_search import LEAST, PairSearch
from avtorch.gap.search.random_effects import RandomEffects, commanded, glitched
from avtorch.gap.search.screening import Screened, refine, screen
from avtorch.gap.search.time_budget import TimeBudget
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.observability import is_observable
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log

Progress = Callable[[str, int, int], None]

Kinds = Sequence[type[Effect]]

_SINGLES = 6  # effects that are fitted with noise of their own
_RANDOM = 3  # kinds of random effects that are added in the end


class Search:
    """One search over one or several logs of a car."""

    def __init__(
        self,
        logs: Sequence[Log],
        baseline: GapPlant,
        *,
        effects: Kinds | None = None,
        pairs: bool = True,
        lost: Callable[[Sequence[FittedModel], Record], bool] | None = None,
        budget_s: float | None = None,
        progress: Progress | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> None:
        """`lost`: whether these models show that the likelihood cannot give the answer; no pair is then tried."""
        self.lost = lost
        self.logs, self.baseline, self.pairs = tuple(logs), baseline, pairs
        self.effects = list(EFFECTS.values() if effects is None else effects)
        self.budget = TimeBudget(budget_s)
        self.progress = progress or (lambda what, done, of: None)
        self._rolled_out: set[str] = set()  # effects rolled out, also those whose evidence is not kept
        self._paired = self._lost = False
        self._asked: FittedModel | None = None  # the best model when that was last asked for
        self._random = RandomEffects({}, {})  # until their laws are drawn up for the drives
        self._glitches: list[tuple[RandomLaw | type[Effect], HeavyTails]] = []
        work = None if checkpoint is None else fitted_work(self.logs, baseline, self.effects, pairs=pairs)
        self.fits = OwnNoiseFits(baseline, Checkpoint(checkpoint, work))

    # the whole search ----------------------------------------------------------------------------------------------
    def run(self) -> SearchResult:
        glitches, logs = None, self.logs
        record = Record.of(logs)
        raw = Record.of(logs, rate_hz=1e9, multiple=record.group)
        none = self.fits.bare(record)
        self._random = RandomEffects.of(self.effects, raw, self.baseline)
        with_tails = record.accel is not None and self._random.has("tails")
        if with_tails:
            glitches = self._tails(raw, none)
            if glitches.plain:
                logs = without_outliers(logs, raw, glitches)
                record = Record.of(logs)
                none = self.fits.bare(record)
        found = self._singles(record, none)
        # before the pairs, which take most of the time, so that these are searched once
        again = self._other_tails(raw, found, glitches) if with_tails else None
        if again is not None:
            logs, record, none = self._cleaned(raw, again)
            found = self._singles(record, none)
        found += self._pairs(record, found, none)
        self.progress("random effects", 0, _RANDOM)
        if with_tails:
            last = self._other_tails(raw, found, glitches)
            if again is None and last is not None:
                logs, record, none = self._cleaned(raw, last)
                found = self._singles(record, none)
                found += self._pairs(record, found, none)
        self.progress("random effects", 1, _RANDOM)
        if "losses" in self._random.own and not self.budget.spent():
            found += self._held(Record.of(logs, rate_hz=1e9, multiple=record.group), found, none)
        self.progress("random effects", 2, _RANDOM)
        for law in self._random.laws["command"]:
            if not self.budget.spent():
                rows = Record.of(logs, rate_hz=1e9, multiple=record.group)
                found += [commanded(f, law, rows) for f in self._alone_and_best(found, none)]
        found += [] if glitches is None else glitched(found, self._glitches, pairs=self._paired)
        best: dict[str, FittedModel] = {}
        for f in sorted(found, key=lambda f: -f.log_evidence):
            best.setdefault(f.name, f)
        best = all_delays(record, best)
        pairs = "all" if self.budget.complete else "some"
        pairs = pairs if self._paired else "lost" if self._lost else "none"
        scope = Scope.of(self.effects, {*best, *self._rolled_out}, record.channels, pairs)
        return SearchResult(record, raw, tuple(logs), tuple(best.values()), self.budget.complete, scope)

    # deterministic causes and gusts --------------------------------------------------------------------------------
    def _kinds(self, record: Record) -> list[type[Effect]]:
        return [e for e in self.effects if not e.random and is_observable(e, record.channels)]

    def _singles(self, record: Record, none: FittedModel) -> list[FittedModel]:
        """The bare baseline first, then single effects and forces."""
        kinds = self._kinds(record)
        white = WhiteningFilter(record, none.noise.noise)
        screened: list[Screened] = []
        floor, coarse_floor = (
            float(white.log_likelihood(e[None])[0]) for e in (none.errors, none.errors.mean(-1, keepdims=True))
        )
        for i, kind in enumerate(kinds):
            self.progress("single effects", i, len(kinds))
            if self.budget.spent():
                break
            hypothesis = Hypothesis(record, (kind,), self.baseline)
            begin = start_points(hypothesis, none.values)
            found = screen(hypothesis, white, begin, onsets=kind.own_onset is None, floor=coarse_floor)
            screened += [refine(look, white) for look in found]
        best: dict[str, float] = {}
        self._rolled_out |= {look.hypothesis.name for look in screened}
        for look in screened:
            best[look.hypothesis.name] = max(best.get(look.hypothesis.name, -np.inf), look.value)
        order = sorted(best, key=lambda n: -best[n])
        top = best[order[0]] - floor if order else 0.0
        lead = [n for n in order[:_SINGLES] if best[n] - floor > max(min(0.25 * top, top - 30), LEAST)]
        found = [none]
        if self._random.has("force") and not self.budget.spent():
            found += self._random.forced(none)
        fitted = set()
        for i, name in enumerate(lead):
            self.progress("best effects", i, len(lead))
            if self.budget.spent():
                break
            fitted.add(name)
            # a gust's model leaves too little noise for models that explain less
            noise = max((f for f in found if not f.blown), key=lambda f: f.log_evidence).noise.noise
            found.append(self.fits.best_form([look for look in screened if look.hypothesis.name == name], noise))
            if self._is_lost(found, record):
                break
        found += self._left_behind([look for look in screened if look.hypothesis.name not in fitted], white, none)
        return found

    def _pairs(self, record: Record, singles: Sequence[FittedModel], none: FittedModel) -> list[FittedModel]:
        if not self.pairs or self.budget.spent():
            return []
        if self._is_lost(singles, record):
            return []
        self._paired = True
        return PairSearch(self._kinds(record), self._random, self.fits, self.budget, self.progress).fitted(
            singles, none
        )

    def _is_lost(self, found: Sequence[FittedModel], record: Record) -> bool:
        """Whether the likelihood can no longer give the answer; nothing more is then fitted with noise of its own."""
        best = max(found, key=lambda f: f.log_evidence)
        if best is not self._asked and self.lost is not None:
            self._asked, self._lost = best, self.lost(found, record)
        return self._lost

    def _left_behind(self, rest: Sequence[Screened], white: WhiteningFilter, none: FittedModel) -> list[FittedModel]:
        """The other hypotheses, with the evidence of their screening fits."""
        flat = finish(none.hypothesis, white, none.z).log_evidence
        found = []
        for look in rest:
            if look.onset is None:
                fit = finish(look.hypothesis, white, look.z)
                evidence = none.log_evidence + fit.log_evidence - flat
                found.append(FittedModel.of(look.hypothesis, fit, none.noise, evidence, fit.log_joint))
        return found

    # chance --------------------------------------------------------------------------------------------------------
    def _tails(self, raw: Record, of: FittedModel) -> HeavyTails:
        """The best of all tails; `_glitches` holds those of each effect."""
        errors = full_rate_errors(raw, of)[0, :, 0]
        self._glitches = []
        if "tails" in self._random.own:
            self._glitches.append((self._random.own["tails"], heavy_tails(errors, raw.dt)))
        for law in self._random.laws["tails"]:
            self._glitches.append((law, heavy_tails(errors, raw.dt, law=law.tails, size=law.size)))
        return max((found for _, found in self._glitches), key=lambda found: found.evidence)

    def _other_tails(self, raw: Record, found: Sequence[FittedModel], before: HeavyTails | None) -> HeavyTails | None:
        """Outliers under the best model so far, where these are other rows than `before` and there is time left."""
        again = self._tails(raw, max(found, key=lambda f: f.log_evidence))
        count = 0 if before is None else int(before.hit.sum())
        differ = abs(count - int(again.hit.sum())) > 0.3 * count + 3
        changed = (before is not None and before.plain) != again.plain or (again.plain and differ)
        return again if changed and not self.budget.spent() else None

    def _cleaned(self, raw: Record, tails: HeavyTails) -> tuple[Sequence[Log], Record, FittedModel]:
        """The logs without these outliers where they are plain, their record, and the bare baseline on it."""
        logs = without_outliers(self.logs, raw, tails) if tails.plain else self.logs
        record = Record.of(logs)
        return logs, record, self.fits.bare(record)

    def _alone_and_best(self, found: list[FittedModel], none: FittedModel) -> list[FittedModel]:
        """Models to which errors of the command are added: as these resemble a delay, always the bare baseline, too."""
        alone = [f for f in found if f.name != "none" and "+" not in f.name and f.hypothesis.effects]
        best = max(alone, key=lambda f: f.log_evidence, default=none)
        return [none, best] if self._paired and best.log_evidence >= none.log_evidence + LEAST else [none]

    def _held(self, raw: Record, found: list[FittedModel], none: FittedModel) -> list[FittedModel]:
        """Lost messages alone and, where pairs are tried, on top of the best single effect."""
        out, kind = [], self._random.own["losses"]
        for f in self._alone_and_best(found, none):
            errors = full_rate_errors(raw, f)
            white = full_rate_filter(raw, f)
            lost = lost_messages(white, errors, raw.command[raw.source], f.values["T_L"], f.values["K_L"])
            own = {"name": f.name_with(kind.name), "searched": (*f.searched, kind), "losses": lost}
            out.append(replace(f, log_evidence=f.log_evidence + lost.evidence, **own))
        return out
