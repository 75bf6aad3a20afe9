"""The search for the cause: all single effects, then pairs where a second effect still gains.

Every hypothesis is first fitted under the noise of the bare baseline, over the whole drive and from an onset on. The
best are refitted, each with its own noise, and combined with further effects. Random effects (gusts, outliers, lost
messages) are fitted to the residuals of these models.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.gauss_newton import finish, modes, residuals
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_fit import fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import CALM, whitening_filter
from avtorch.gap.likelihood.observability import is_observable
from avtorch.gap.likelihood.random_law import Form, RandomLaw
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.checkpoint import Checkpoint, StoredFit
from avtorch.gap.search.delays import all_delays
from avtorch.gap.search.fitted_model import (
    FittedModel,
    Scope,
    SearchResult,
    first_noise,
    with_or_without_onset,
    without_outliers,
)
from avtorch.gap.search.fitted_work import fitted_work
from avtorch.gap.search.full_rate import full_rate_errors, full_rate_filter
from avtorch.gap.search.gusts import gust
from avtorch.gap.search.initial_values import lag_delay_starts, start_points
from avtorch.gap.search.lost_messages import lost_messages
from avtorch.gap.search.onset import onset_evidence, refined_onset
from avtorch.gap.search.outliers import HeavyTails, heavy_tails
from avtorch.gap.search.pairs import PairBase, exchanged, joint_fit
from avtorch.gap.search.random_effects import commanded, forced, glitched, own_searches, users_own
from avtorch.gap.search.screening import ENOUGH, Screened, refine, screen
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log

Progress = Callable[[str, int, int], None]

Kinds = Sequence[type[Effect]]

_TURNS = 10  # alternations of parameters and noise, at most
_SINGLES = 6  # single effects fitted with noise of their own
_LEAST = 3.0  # least gain in screening [nats] for a fit with noise of its own
_BASES = 3  # models combined with a second effect
_SECONDS = 4  # second effects tried on each
_PAIRS = 4  # pairs fitted with noise of their own
_SWAPS = 2  # rounds in which either half of the best pair is replaced by another effect
_SECOND = 8.0  # nats by which a pair must exceed the best single effect for that
_CLOSE = 12.0  # nats by which a pair may be behind in screening


class Search:
    """One search over one or several logs of a car."""

    def __init__(
        self,
        logs: Sequence[Log],
        baseline: GapPlant,
        *,
        effects: Kinds | None = None,
        pairs: bool = True,
        budget_s: float | None = None,
        progress: Progress | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> None:
        self.logs, self.baseline, self.pairs = tuple(logs), baseline, pairs
        self.effects = list(EFFECTS.values() if effects is None else effects)
        self.until = None if budget_s is None else time.monotonic() + budget_s
        self.progress = progress or (lambda what, done, of: None)
        self.complete = True
        self._seen: set[str] = set()  # effects rolled out, including those whose evidence is not kept
        self._paired = False
        self._own = own_searches(self.effects)
        self._laws: dict[Form, list[RandomLaw]] = {"force": [], "tails": [], "command": []}
        self._glitches: list[tuple[RandomLaw | type[Effect], HeavyTails]] = []
        work = None if checkpoint is None else fitted_work(self.logs, baseline, self.effects, pairs=pairs)
        self.checkpoint = Checkpoint(checkpoint, work)

    # the whole search ----------------------------------------------------------------------------------------------
    def run(self) -> SearchResult:
        glitches, logs = None, self.logs
        record = Record.of(logs)
        raw = Record.of(logs, rate_hz=1e9, multiple=record.group)
        none = self._none(record)
        self._laws = users_own(self.effects, raw, self.baseline)
        with_tails = record.accel is not None and ("tails" in self._own or bool(self._laws["tails"]))
        if with_tails:
            glitches = self._tails(raw, none)
            if glitches.plain:
                logs = without_outliers(logs, raw, glitches)
                none = self._none(record := Record.of(logs))
        found = self._deterministic(record, none)
        if with_tails:
            again = self._tails(raw, max(found, key=lambda f: f.log_evidence))
            before = 0 if glitches is None else int(glitches.hit.sum())
            changed = (glitches is not None and glitches.plain) != again.plain
            changed |= again.plain and abs(before - int(again.hit.sum())) > 0.3 * before + 3
            if changed and not self._late():
                logs = without_outliers(self.logs, raw, again) if again.plain else self.logs
                none = self._none(record := Record.of(logs))
                found = self._deterministic(record, none)
            glitches = again
        if "losses" in self._own and not self._late():
            found += self._held(Record.of(logs, rate_hz=1e9, multiple=record.group), found, none)
        for law in self._laws["command"]:
            if not self._late():
                rows = Record.of(logs, rate_hz=1e9, multiple=record.group)
                found += [commanded(f, law, rows) for f in self._alone_and_best(found, none)]
        found += [] if glitches is None else glitched(found, self._glitches, pairs=self._paired)
        best: dict[str, FittedModel] = {}
        for f in sorted(found, key=lambda f: -f.log_evidence):
            best.setdefault(f.name, f)
        best = all_delays(record, best)
        pairs = "none" if not self._paired else "all" if self.complete else "some"
        scope = Scope.of(self.effects, {*best, *self._seen}, record.channels, pairs)
        return SearchResult(record, raw, tuple(logs), tuple(best.values()), self.complete, scope)

    def _blowing(self, on: FittedModel) -> list[FittedModel]:
        """A fitted model with every random force added in turn."""
        own = [gust(on, self._own["force"])] if "force" in self._own else []
        return [*own, *(forced(on, law) for law in self._laws["force"])]

    def _late(self) -> bool:
        self.complete &= not (late := self.until is not None and time.monotonic() > self.until)
        return late

    # deterministic causes and gusts --------------------------------------------------------------------------------
    def _none(self, record: Record) -> FittedModel:
        """The bare baseline, with its noise."""
        hypothesis = Hypothesis(record, (), self.baseline)
        noise = first_noise(record)
        white = WhiteningFilter(record, noise)
        z = np.stack([hypothesis.z_of({"T_L": t, "K_L": 1.0}) for t in (0.12, 0.3, 0.8)])
        found, values = modes(hypothesis, white, z, iterations=6)
        return self._converged_fit(hypothesis, found[values.argmax()], noise, rounds=6)

    def with_effects(self, none: FittedModel, kinds: Kinds) -> FittedModel:
        """`none` with effects of these kinds, acting from the drives' start, with noise of its own."""
        hypothesis = Hypothesis(none.hypothesis.record, tuple(kinds), self.baseline)
        white = WhiteningFilter(hypothesis.record, none.noise.noise)
        places, values = modes(hypothesis, white, start_points(hypothesis, none.values), iterations=6, coarse=True)
        return self._converged_fit(hypothesis, places[values.argmax()], none.noise.noise)

    def _converged_fit(
        self, hypothesis: Hypothesis, z: FloatArray, noise: NoiseModel, *, onset: int | None = None, rounds: int = 2
    ) -> FittedModel:
        """Fit parameters and noise alternately until both converge."""
        record = hypothesis.record
        start = self.checkpoint.start(hypothesis, z, noise, onset, rounds)
        known = self.checkpoint.next(start)
        if known is not None:
            return known.found(hypothesis, onset)
        # first on averaged commands, which is several times as fast and ends nearby
        for coarse in (True, False) if record.group > 1 else (False,):
            value, best = -np.inf, (z, noise)
            usual = 2 if record.group > 1 and not coarse else rounds + 1
            for turn in range(_TURNS):
                noise = noise.seen_through(hypothesis.effects, self._values(hypothesis, z))
                white = whitening_filter(record, noise, onset=onset)
                enough = ENOUGH if coarse else 0.05
                if turn < 2:  # once under the initial noise, and once under the fitted one
                    z = self._traded(hypothesis, z, white, onset, coarse)
                z = modes(hypothesis, white, z[None], onset=onset, iterations=4, coarse=coarse, enough=enough)[0][0]
                errors = residuals(hypothesis, white, z, onset, coarse=coarse)
                lag = self._values(hypothesis, z)["T_L"]
                fitted = fit_noise(record, errors, noise, T_L=lag, onset=onset, iterations=3)
                noise = fitted.noise
                new = float(fitted.rows.sum()) + fitted.log_prior - 0.5 * float(z @ z)
                if new > value:
                    best, log_prior = (z, noise), fitted.log_prior
                if new < value + (0.3 if turn < usual - 1 else 3.0):
                    break
                value = new
            z, noise = best
        self.checkpoint.keep(start, StoredFit(z, noise, log_prior))
        return StoredFit(z, noise, log_prior).found(hypothesis, onset)

    @staticmethod
    def _traded(
        hypothesis: Hypothesis, z: FloatArray, white: WhiteningFilter, onset: int | None, coarse: bool
    ) -> FloatArray:
        """`z`, or the best mode reached by trading dead time for lag."""
        places = np.concatenate([z[None], lag_delay_starts(hypothesis, z)])
        if len(places) == 1:
            return z
        moved, values = modes(hypothesis, white, places, onset=onset, iterations=3, coarse=coarse, enough=ENOUGH)
        return moved[values.argmax()]

    @staticmethod
    def _values(hypothesis: Hypothesis, z: FloatArray) -> dict[str, float]:
        return {key: float(x[0]) for key, x in hypothesis.values(z[None]).items()}

    def _deterministic(self, record: Record, none: FittedModel) -> list[FittedModel]:
        kinds = [e for e in self.effects if not e.random and is_observable(e, record.channels)]
        white = WhiteningFilter(record, none.noise.noise)
        seen: list[Screened] = []
        floor, coarse_floor = (
            float(white.log_likelihood(e[None])[0]) for e in (none.errors, none.errors.mean(-1, keepdims=True))
        )
        for i, kind in enumerate(kinds):
            self.progress("single effects", i, len(kinds))
            if self._late():
                break
            hypothesis = Hypothesis(record, (kind,), self.baseline)
            begin = start_points(hypothesis, none.values)
            found = screen(hypothesis, white, begin, onsets=kind.own_onset is None, floor=coarse_floor)
            seen += [refine(look, white) for look in found]
        best: dict[str, float] = {}
        self._seen |= {look.hypothesis.name for look in seen}
        for look in seen:
            best[look.hypothesis.name] = max(best.get(look.hypothesis.name, -np.inf), look.value)
        order = sorted(best, key=lambda n: -best[n])
        top = best[order[0]] - floor if order else 0.0
        lead = [n for n in order[:_SINGLES] if best[n] - floor > max(min(0.25 * top, top - 30), _LEAST)]
        found = [none]
        if ("force" in self._own or self._laws["force"]) and not self._late():
            found += self._blowing(none)
        fitted = set()
        for i, name in enumerate(lead):
            self.progress("best effects", i, len(lead))
            if self._late():
                break
            fitted.add(name)
            # a gust's model leaves too little noise for models that explain less
            noise = max((f for f in found if not f.blown), key=lambda f: f.log_evidence).noise.noise
            found.append(self._refined([look for look in seen if look.hypothesis.name == name], noise))
        found += self._left_behind([look for look in seen if look.hypothesis.name not in fitted], white, none)
        if self.pairs and not self._late():
            self._paired = True
            found += self._pairs(record, kinds, found, none)
        return found

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

    def _refined(self, forms: Sequence[Screened], noise: NoiseModel) -> FittedModel:
        """One cause over the whole drive and from an onset on, equally likely a priori."""
        return with_or_without_onset([self._from_onset(f.hypothesis, f.z, noise, f.onset) for f in forms])

    def _from_onset(self, hypothesis: Hypothesis, z: FloatArray, noise: NoiseModel, onset: int | None) -> FittedModel:
        if onset is None:
            return self._converged_fit(hypothesis, z, noise)
        record = hypothesis.record
        white = whitening_filter(record, noise, onset=onset)
        for _ in range(2):
            z = modes(hypothesis, white, z[None], onset=onset, iterations=4)[0][0]
            moved, _ = refined_onset(white, hypothesis, z, onset)
            if moved == onset:
                break
            onset = moved
        refitted = self._converged_fit(hypothesis, z, noise, onset=onset)
        moved, tried = refined_onset(refitted.white, hypothesis, refitted.z, onset)
        if abs(moved - onset) * record.dt > 0.5:
            refitted = self._converged_fit(hypothesis, refitted.z, refitted.noise.noise, onset=moved)
            _, tried = refined_onset(refitted.white, hypothesis, refitted.z, moved)
        return replace(refitted, log_evidence=refitted.log_evidence + onset_evidence(tried, record.dt))

    # pairs ---------------------------------------------------------------------------------------------------------
    def _pairs(self, record: Record, kinds: Kinds, found: list[FittedModel], none: FittedModel) -> list[FittedModel]:
        single = sorted((f for f in found if f.name != "none"), key=lambda f: -f.log_evidence)
        if not single or single[0].log_evidence < none.log_evidence + _LEAST:
            return []
        top = single[0].log_evidence - none.log_evidence
        bases = [f for f in single if not f.blown and f.log_evidence - none.log_evidence > 0.2 * top][:_BASES]
        made = {f.name: f for base in bases[:2] for f in self._blowing(base)}
        for base in bases[:2]:
            # slow drift may be a gust or a road grade; noise fitted without either of them hides the grade
            gusty = made.get(base.name_with(self._own["force"].name)) if "force" in self._own else None
            if gusty is None or gusty.log_evidence <= base.log_evidence + _SECOND or base.hypothesis.integrated:
                continue
            for road in (kind for kind in kinds if issubclass(kind, Integrated)):
                hypothesis = Hypothesis(record, (*base.hypothesis.effects, road), self.baseline)
                look = Screened(hypothesis, hypothesis.z_of(base.values), 0.0, base.onset)
                self._settle_pairs([look], 1, gusty.noise.noise.replaced(force_sd=CALM), made)
        # a gust's model leaves too little noise for models that explain less
        noise = (bases[0] if bases else none).noise.noise
        if single[0].blown:
            self._under(single[0], kinds, none, made)
        white = WhiteningFilter(record, noise)
        alone = {f.name: f.values for f in single if not f.blown}
        seen: dict[str, Screened] = {}
        for i, base in enumerate(bases):
            self.progress("pairs", i, len(bases))
            if self._late():
                break
            for look in self._joined(base, kinds, white, alone, _SECONDS if i == 0 else _SECONDS // 2):
                known = seen.get(look.hypothesis.name)
                if known is None or look.value > known.value:
                    seen[look.hypothesis.name] = look
        done = self._settle_pairs(list(seen.values()), _PAIRS, noise, made)
        for _ in range(_SWAPS):
            if done is None or done.log_evidence < single[0].log_evidence + _SECOND or self._late():
                break
            # try to replace either half, now under the noise fitted with the best pair
            white = done.white
            _, value = modes(done.hypothesis, white, done.z[None], onset=done.onset, iterations=1)
            here = Screened(done.hypothesis, done.z, float(value[0]), done.onset)
            near = here.value - _CLOSE
            others = [k for k in exchanged(here, kinds, white, alone, tries=_SECONDS) if k.hypothesis.name not in made]
            better = self._settle_pairs([k for k in others if k.value > near], 2, done.noise.noise, made)
            if better is None or better.log_evidence < done.log_evidence + 1:
                break
            done = better
        return list(made.values())

    def _under(self, blown: FittedModel, kinds: Kinds, none: FittedModel, made: dict[str, FittedModel]) -> None:
        """Add to `made` effects that are visible only under a random force's noise, each combined with that force."""
        on = PairBase(none.hypothesis, none.z, none.values, none.onset, blown.white)
        for hypothesis, z in on.partners(kinds, {}, most=_BASES, least=_LEAST):
            if self._late():
                break
            forms = screen(hypothesis, blown.white, z[None], onsets=hypothesis.effects[-1].own_onset is None)
            look = max((refine(form, blown.white) for form in forms), key=lambda form: form.value)
            under = StoredFit(look.z, blown.noise.noise, 0.0).found(look.hypothesis, look.onset)
            both = gust(under, self._own["force"]) if blown.by_chance is None else forced(under, blown.by_chance.law)
            if both.name not in made or made[both.name].log_evidence < both.log_evidence:
                made[both.name] = both

    def _joined(
        self,
        base: FittedModel,
        kinds: Kinds,
        white: WhiteningFilter,
        alone: Mapping[str, Mapping[str, float]],
        most: int,
    ) -> list[Screened]:
        """The `most` second effects with the largest gains on top of `base`, each fitted with it."""
        on = PairBase(base.hypothesis, base.z, base.values, base.onset, white)
        found = [
            joint_fit(hypothesis, base.hypothesis.effects[0], z, base.onset, white, onsets=True)
            for hypothesis, z in on.partners(kinds, alone, most=most, least=4.0)
            if not self._late()
        ]
        # on averaged commands the noise that a controller feeds back resembles a second effect
        return [near for near in (refine(look, white) for look in found) if near.value > on.flat + _LEAST]

    def _settle_pairs(
        self, pairs: list[Screened], most: int, noise: NoiseModel, made: dict[str, FittedModel]
    ) -> FittedModel | None:
        """The best `most` pairs with noise of their own, added to `made`; returns the best of these."""
        best: FittedModel | None = None
        for look in sorted(pairs, key=lambda k: -k.value)[:most]:
            if self._late():
                break
            pair = self._refined([look], noise)
            if pair.name not in made or made[pair.name].log_evidence < pair.log_evidence:
                made[pair.name] = pair
            if best is None or pair.log_evidence > best.log_evidence:
                best = pair
                noise = pair.noise.noise
        return best

    # random effects ------------------------------------------------------------------------------------------------
    def _tails(self, raw: Record, of: FittedModel) -> HeavyTails:
        """The best of all tails; `_glitches` holds those of each effect."""
        errors = full_rate_errors(raw, of)[0, :, 0]
        self._glitches = [(self._own["tails"], heavy_tails(errors, raw.dt))] if "tails" in self._own else []
        for law in self._laws["tails"]:
            self._glitches.append((law, heavy_tails(errors, raw.dt, law=law.tails, size=law.size)))
        return max((found for _, found in self._glitches), key=lambda found: found.evidence)

    def _alone_and_best(self, found: list[FittedModel], none: FittedModel) -> list[FittedModel]:
        """Models to which errors of the command are added: as these resemble a delay, always the bare baseline, too."""
        alone = [f for f in found if f.name != "none" and "+" not in f.name and f.hypothesis.effects]
        best = max(alone, key=lambda f: f.log_evidence, default=none)
        return [none, best] if self._paired and best.log_evidence >= none.log_evidence + _LEAST else [none]

    def _held(self, raw: Record, found: list[FittedModel], none: FittedModel) -> list[FittedModel]:
        """Lost messages alone and, where pairs are tried, added to the best single effect."""
        out, kind = [], self._own["losses"]
        for f in self._alone_and_best(found, none):
            errors = full_rate_errors(raw, f)
            white = full_rate_filter(raw, f)
            lost = lost_messages(white, errors, raw.command[raw.source], f.values["T_L"], f.values["K_L"])
            own = {"name": f.name_with(kind.name), "searched": (*f.searched, kind), "losses": lost}
            out.append(replace(f, log_evidence=f.log_evidence + lost.evidence, **own))
        return out
