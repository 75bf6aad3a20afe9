"""The mode of a hypothesis's parameters: Gauss-Newton on whitened errors, from many starts at once.

Derivatives are forward differences: all columns of all starts are one batch of rollouts. They are taken only where a
step follows; the place where a fit ends needs its value alone. The slope of a road is linear in its coefficients, which
are integrated out exactly.

The likelihood in a dead time has a crease, where its slope jumps, at every whole number of rows, because a command is
held until the next. Where the last step has crossed one, the crease itself is tried, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from avtorch.arrays import Float, FloatArray
from avtorch.gap.likelihood.grade_marginal import GradeMarginal
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter, acting, sensed

_STEP = 1e-4
_LONGEST = 1.0


@dataclass(frozen=True, eq=False)
class GaussNewtonFit:
    """`z` (coordinate,) at the mode, its posterior covariance, and the residuals (channel, counted, group).

    `log_joint`: log likelihood plus log prior at the mode; `log_evidence`: by Laplace's approximation, with the noise
    held. `grade_rms`, `profile`: of the road grade.
    """

    z: Float[FloatArray, " coordinate"]
    covariance: Float[FloatArray, "coordinate coordinate"] = field(repr=False)
    errors: Float[FloatArray, "channel counted group"] = field(repr=False)
    log_joint: float
    log_evidence: float
    grade_rms: float | None = None
    profile: Float[FloatArray, " knot"] | None = None


def modes(
    hypothesis: Hypothesis,
    white: WhiteningFilter,
    starts: Float[FloatArray, "start coordinate"],
    *,
    onset: int | None = None,
    iterations: int = 8,
    coarse: bool = False,
    enough: float = 0.01,
) -> tuple[Float[FloatArray, "start coordinate"], Float[FloatArray, " start"]]:
    """Modes (start, coordinate) and their log joint densities (start,), from `starts` (start, coordinate).

    `coarse`: rollouts of averaged commands, several times as fast and accurate enough for screening. A start has
    converged once a step gains less than `enough` nats.
    """
    z = np.array(starts)
    count, size = z.shape
    damping = np.full(count, 1e-3)
    best = z.copy()
    value = np.full(count, np.inf)
    gradient, square = np.zeros((count, size)), np.tile(np.eye(size), (count, 1, 1))
    trial = z
    live = np.ones(count, bool)
    delayed = any(effect.shift is not None for effect in hypothesis.effects)
    on_crease, promised = z.copy(), np.full(count, np.nan)
    at = _Place(hypothesis, white, onset, coarse)
    for turn in range(iterations):
        where = np.flatnonzero(live)
        v, base = at.value(trial[where])
        good = v < value[where]
        gain = value[where] - v
        damping[where] = np.where(good, damping[where] * 0.2, np.maximum(damping[where] * 8, 1e-2))
        live[where] = ~(good & (gain < enough)) & (damping[where] < 1e4)
        # a crease shows in the slopes at both ends of a step
        ends = np.ones(len(where), bool) if delayed else good & live[where] & (turn < iterations - 1)
        g, h = np.empty((len(where), size)), np.empty((len(where), size, size))
        if ends.any():
            g[ends], h[ends] = at.curvature(trial[where[ends]], base[ends])
        if delayed:
            step = trial[where] - best[where]
            crease = _crease(step, value[where], gradient[where], square[where], v, g)
            on_crease[where] = best[where] + crease.share[:, None] * step
            promised[where] = np.minimum(value[where], v) - crease.value
        up = where[good]
        best[up], value[up] = trial[up], v[good]
        gradient[where[good & ends]], square[where[good & ends]] = g[good & ends], h[good & ends]
        if not live.any():
            break
        diagonal = np.einsum("cii->ci", square)
        step = np.linalg.solve(square + (damping[:, None] * diagonal)[:, :, None] * np.eye(size), -gradient[:, :, None])
        step = step[:, :, 0]
        step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(1, keepdims=True), 1e-12))
        trial = np.clip(best + step, -5.0, 5.0)
    last = np.flatnonzero(promised > enough)
    if last.size:
        v, _ = at.value(on_crease[last])
        up = last[v < value[last]]
        best[up], value[up] = on_crease[up], v[v < value[last]]
    return best, white.constant_of(coarse=coarse) - value


def log_joint(
    hypothesis: Hypothesis,
    white: WhiteningFilter,
    z: Float[FloatArray, "start coordinate"],
    onset: int | None = None,
    *,
    coarse: bool = False,
) -> Float[FloatArray, " start"]:
    """Log joint densities (start,) at `z` (start, coordinate), as `modes` has them."""
    return white.constant_of(coarse=coarse) - _Place(hypothesis, white, onset, coarse).value(z)[0]


class _Crease(NamedTuple):
    """Where the parabolas of a step's two ends meet: `share` of the step (start,), `value` there (start,)."""

    share: Float[FloatArray, " start"]
    value: Float[FloatArray, " start"]


def _crease(
    step: Float[FloatArray, "start coordinate"],
    value: Float[FloatArray, " start"],
    gradient: Float[FloatArray, "start coordinate"],
    square: Float[FloatArray, "start coordinate coordinate"],
    end_value: Float[FloatArray, " start"],
    end_gradient: Float[FloatArray, "start coordinate"],
) -> _Crease:
    """Of steps from `value` and `gradient` to `end_value` and `end_gradient`; nan where one crosses no crease.

    A Gauss-Newton step on a smooth function ends where it is flat; one that ends on a rise half as steep as the descent
    at its start has crossed a crease. Both parabolas have the curvature of `square`.
    """
    slope, end_slope = (gradient * step).sum(1), (end_gradient * step).sum(1)
    curvature = np.einsum("cp,cpq,cq->c", step, square, step)
    jump = end_slope - slope - curvature
    crossed = np.isfinite(value) & (slope < 0) & (end_slope > -0.5 * slope) & (jump > 0)
    fall = np.where(crossed, value - end_value, np.nan)
    share = np.clip((fall + end_slope - 0.5 * curvature) / np.where(crossed, jump, 1.0), 0.0, 1.0)
    return _Crease(share, value + slope * share + 0.5 * curvature * share**2)


@dataclass(frozen=True, eq=False)
class _Place:
    """The negative log joint density (up to a constant) of a hypothesis under a noise, and its derivatives."""

    hypothesis: Hypothesis
    white: WhiteningFilter
    onset: int | None
    coarse: bool

    def value(
        self, z: Float[FloatArray, "start coordinate"]
    ) -> tuple[Float[FloatArray, " start"], Float[FloatArray, "start row"]]:
        """At `z`, with the whitened errors there, of which `curvature` makes use."""
        base = self._whitened(z)
        value = 0.5 * (np.einsum("cr,cr->c", base, base) + (z**2).sum(1))
        if self.hypothesis.grade_means is not None:
            value -= self._slope.weighed(base @ self._slope.image.T)[0]
        return value, base

    def curvature(
        self, z: Float[FloatArray, "start coordinate"], base: Float[FloatArray, "start row"]
    ) -> tuple[Float[FloatArray, "start coordinate"], Float[FloatArray, "start coordinate coordinate"]]:
        """Gradient and Gauss-Newton matrix at `z`, with the road grade's coefficients and size integrated out."""
        count, size = z.shape
        columns = self._whitened((z[:, None] + _STEP * np.eye(size)).reshape(-1, size)).reshape(count, size, -1)
        columns -= base[:, None]
        columns /= _STEP
        square, cross = columns @ columns.transpose(0, 2, 1), np.einsum("cpr,cr->cp", columns, base)
        if self.hypothesis.grade_means is not None:
            match, towards = base @ self._slope.image.T, columns @ self._slope.image.T
            _, taken = self._slope.weighed(match)
            square -= np.einsum("cpk,ck,cqk->cpq", towards, taken, towards)
            cross -= np.einsum("cpk,ck->cp", towards, taken * match)
        return cross + z, square + np.eye(size)

    def _whitened(self, z: Float[FloatArray, "column coordinate"]) -> Float[FloatArray, "column row"]:
        return self.white(self.hypothesis.errors(z, self.onset, coarse=self.coarse)).reshape(len(z), -1)

    @property
    def _slope(self) -> GradeMarginal:
        return grade_marginal(self.white, self.hypothesis, self.onset, coarse=self.coarse)


def whitened_jacobian(
    hypothesis: Hypothesis,
    white: WhiteningFilter,
    z: Float[FloatArray, " coordinate"],
    onset: int | None = None,
    *,
    coarse: bool = False,
) -> Float[FloatArray, "direction row"]:
    """Whitened derivatives (direction, row) of the rollout at `z` by the parameters and the road grade."""
    moved = np.repeat(z[None], len(z) + 1, 0)
    moved[1:] += _STEP * np.eye(len(z))
    e = white(hypothesis.rollouts(moved, onset, coarse=coarse)).reshape(len(z) + 1, -1)
    columns = (e[1:] - e[:1]) / _STEP
    if hypothesis.grade_means is None:
        return columns
    return np.concatenate([columns, grade_marginal(white, hypothesis, onset, coarse=coarse).image])


def grade_marginal(white: WhiteningFilter, hypothesis: Hypothesis, onset: int | None, *, coarse: bool) -> GradeMarginal:
    """Of the hypothesis's slope under this noise."""
    grade = hypothesis.grade_means if coarse else hypothesis.grade_columns
    assert grade is not None
    return white.grade_marginal(grade, onset)


def residuals(
    hypothesis: Hypothesis,
    white: WhiteningFilter,
    z: Float[FloatArray, " coordinate"],
    onset: int | None = None,
    *,
    coarse: bool,
) -> Float[FloatArray, "channel counted group"]:
    """Residuals (channel, counted, group) at `z` (coordinate,), with the fitted road grade subtracted."""
    errors = hypothesis.errors(z[None], onset, coarse=coarse)[0]
    return errors if hypothesis.grade_means is None else errors - _sloped(hypothesis, white, errors, onset)[2]


def _sloped(
    hypothesis: Hypothesis,
    white: WhiteningFilter,
    errors: Float[FloatArray, "channel counted group"],
    onset: int | None,
) -> tuple[float, Float[FloatArray, " knot"], Float[FloatArray, "channel counted group"]]:
    """`grade_rms`, the road grade's coefficients (knot,), and its contribution to the errors."""
    rms, profile = grade_marginal(white, hypothesis, onset, coarse=errors.shape[-1] == 1).estimate(
        white(errors).ravel()
    )
    part = hypothesis.grade_response(profile)
    part = part.mean(-1, keepdims=True) if errors.shape[-1] == 1 else part
    return rms, profile, sensed(white.record, white.noise, acting(white.record, part, onset))


def finish(
    hypothesis: Hypothesis, white: WhiteningFilter, z: Float[FloatArray, " coordinate"], onset: int | None = None
) -> GaussNewtonFit:
    """Covariance, residuals and Laplace evidence at a mode `z` (coordinate,)."""
    size = len(z)
    at = _Place(hypothesis, white, onset, coarse=False)
    value, base = at.value(z[None])
    square = at.curvature(z[None], base)[1][0]
    errors = hypothesis.errors(z[None], onset)[0]
    rms, profile = None, None
    if hypothesis.grade_means is not None:
        rms, profile, part = _sloped(hypothesis, white, errors, onset)
        errors = errors - part
    log_joint = white.constant_of(coarse=False) - float(value[0])
    return (
        GaussNewtonFit(
            z=z,
            covariance=np.linalg.inv(square),
            errors=errors,
            log_joint=log_joint,
            log_evidence=log_joint - 0.5 * float(np.linalg.slogdet(square)[1]),
            grade_rms=rms,
            profile=profile,
        )
        if size
        else GaussNewtonFit(z, np.zeros((0, 0)), errors, log_joint, log_joint)
    )
