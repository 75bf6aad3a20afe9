"""The search for pairs: a second effect on top of the best single ones, as long as the two gain more than either."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from avtorch.gap.likelihood.gauss_newton import modes
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import CALM
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.search.checkpoint import StoredFit
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.own_noise_fit import OwnNoiseFits
from avtorch.gap.search.pairs import PairBase, exchanged, joint_fit
from avtorch.gap.search.random_effects import RandomEffects
from avtorch.gap.search.screening import Screened, refine, screen
from avtorch.gap.search.time_budget import TimeBudget
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated

LEAST = 3.0
"""Nats at first sight, for less of which no noise of its own would help."""
_BASES = 3  # joined with a second effect
_SECONDS = 4  # tried on each
_PAIRS = 4  # fitted with noise of their own
_SWAPS = 2  # times that either half of the best pair is exchanged for another effect
_SECOND = 8.0  # nats a pair must be ahead of the best single effect for that
_CLOSE = 12.0  # nats by which a pair may be behind at first sight


@dataclass(frozen=True, eq=False)
class PairSearch:
    """Over one record: deterministic `kinds` and `random` effects; no fit begins once the `budget` is spent."""

    kinds: Sequence[type[Effect]]
    random: RandomEffects
    fits: OwnNoiseFits
    budget: TimeBudget
    progress: Callable[[str, int, int], None]

    def fitted(self, singles: Sequence[FittedModel], none: FittedModel) -> list[FittedModel]:
        """Pairs with noise of their own, built on the best of `singles`; empty where none of those gains on `none`."""
        single = sorted((f for f in singles if f.name != "none"), key=lambda f: -f.log_evidence)
        if not single or single[0].log_evidence < none.log_evidence + LEAST:
            return []
        top = single[0].log_evidence - none.log_evidence
        bases = [f for f in single if not f.blown and f.log_evidence - none.log_evidence > 0.2 * top][:_BASES]
        steps = len(bases) + _PAIRS + _SWAPS
        self.progress("pairs", 0, steps)
        made = {f.name: f for base in bases[:2] for f in self.random.forced(base)}
        for base in bases[:2]:
            # what drifts slowly is a gust or a road, and the noise that was fitted without either hides the road
            gusty = made.get(base.name_with(self.random.own["force"].name)) if "force" in self.random.own else None
            if gusty is None or gusty.log_evidence <= base.log_evidence + _SECOND or base.hypothesis.integrated:
                continue
            for road in (kind for kind in self.kinds if issubclass(kind, Integrated)):
                hypothesis = Hypothesis(base.hypothesis.record, (*base.hypothesis.effects, road), self.fits.baseline)
                look = Screened(hypothesis, hypothesis.z_of(base.values), 0.0, base.onset)
                self._settle_pairs([look], 1, gusty.noise.noise.replaced(force_sd=CALM), made)
        # a gust's noise is too quiet for causes that explain less
        noise = (bases[0] if bases else none).noise.noise
        if single[0].blown:
            self._under(single[0], none, made)
        white = WhiteningFilter(none.hypothesis.record, noise)
        alone = {f.name: f.values for f in single if not f.blown}
        screened: dict[str, Screened] = {}
        for i, base in enumerate(bases):
            self.progress("pairs", i, steps)
            if self.budget.spent():
                break
            for look in self._joined(base, white, alone, _SECONDS if i == 0 else _SECONDS // 2):
                known = screened.get(look.hypothesis.name)
                if known is None or look.value > known.value:
                    screened[look.hypothesis.name] = look
        self.progress("pairs", len(bases), steps)
        done = self._settle_pairs(list(screened.values()), _PAIRS, noise, made)
        for swap in range(_SWAPS):
            self.progress("pairs", len(bases) + _PAIRS + swap, steps)
            if done is None or done.log_evidence < single[0].log_evidence + _SECOND or self.budget.spent():
                break
            # a better partner for either half, now that the noise is what the best pair leaves over
            white = done.white
            _, value = modes(done.hypothesis, white, done.z[None], onset=done.onset, iterations=1)
            here = Screened(done.hypothesis, done.z, float(value[0]), done.onset)
            near = here.value - _CLOSE
            others = exchanged(here, self.kinds, white, alone, tries=_SECONDS)
            others = [k for k in others if k.hypothesis.name not in made and k.value > near]
            better = self._settle_pairs(others, 2, done.noise.noise, made)
            if better is None or better.log_evidence < done.log_evidence + 1:
                break
            done = better
        return list(made.values())

    def _under(self, blown: FittedModel, none: FittedModel, made: dict[str, FittedModel]) -> None:
        """Causes that show only once a random force's noise is in, each with that force, added to `made`."""
        on = PairBase(none.hypothesis, none.z, none.values, none.onset, blown.white)
        for hypothesis, z in on.partners(self.kinds, {}, most=_BASES, least=LEAST):
            if self.budget.spent():
                break
            forms = screen(hypothesis, blown.white, z[None], onsets=hypothesis.effects[-1].own_onset is None)
            look = max((refine(form, blown.white) for form in forms), key=lambda form: form.value)
            under = StoredFit(look.z, blown.noise.noise, 0.0).fitted_model(look.hypothesis, look.onset)
            both = self.random.forced_as(blown, under)
            if both.name not in made or made[both.name].log_evidence < both.log_evidence:
                made[both.name] = both

    def _joined(
        self, base: FittedModel, white: WhiteningFilter, alone: Mapping[str, Mapping[str, float]], most: int
    ) -> list[Screened]:
        """The `most` effects that promise most on top of `base`, each fitted with it."""
        on = PairBase(base.hypothesis, base.z, base.values, base.onset, white)
        found = [
            joint_fit(hypothesis, base.hypothesis.effects[0], z, base.onset, white, onsets=True)
            for hypothesis, z in on.partners(self.kinds, alone, most=most, least=4.0)
            if not self.budget.spent()
        ]
        # on averaged commands a controller's noise passes for a partner
        return [near for near in (refine(look, white) for look in found) if near.value > on.flat + LEAST]

    def _settle_pairs(
        self, pairs: list[Screened], most: int, noise: NoiseModel, made: dict[str, FittedModel]
    ) -> FittedModel | None:
        """The best `most` of them with noise of their own, added to `made`; the best of these."""
        best: FittedModel | None = None
        for look in sorted(pairs, key=lambda k: -k.value)[:most]:
            if self.budget.spent():
                break
            pair = self.fits.best_form([look], noise)
            if pair.name not in made or made[pair.name].log_evidence < pair.log_evidence:
                made[pair.name] = pair
            if best is None or pair.log_evidence > best.log_evidence:
                best = pair
                noise = pair.noise.noise
        return best
