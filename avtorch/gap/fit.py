"""The mode of a candidate's parameters: Gauss-Newton from many starts at once, errors made white.

Derivatives are forward differences: all columns of all starts are one batch of rollouts, which costs hardly more than
one. The slope of a road is linear in its coefficients, which are integrated out exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.candidate import Candidate
from avtorch.gap.innovations import Whitener

Float = NDArray[np.float64]

_STEP = 1e-4
_LONGEST = 1.0


@dataclass(frozen=True, eq=False)
class Fit:
    """`z` (coordinate,) at the mode, its posterior covariance, errors (witness, counted, group) left over.

    `log_joint`: log likelihood plus log prior at the mode; `log_evidence`: by Laplace, the noise as given.
    `grade_rms`, `profile`: of a road's slope.
    """

    z: Float
    covariance: Float = field(repr=False)
    errors: Float = field(repr=False)
    log_joint: float
    log_evidence: float
    grade_rms: float | None = None
    profile: Float | None = None


def modes(
    candidate: Candidate,
    white: Whitener,
    starts: Float,
    *,
    onset: int | None = None,
    iterations: int = 8,
    coarse: bool = False,
) -> tuple[Float, Float]:
    """Modes (start, coordinate) and their log joint densities (start,), from `starts` (start, coordinate).

    `coarse`: on rollouts of averaged commands, several times as fast, good for a first look.
    """
    z = np.array(starts)
    count, size = z.shape
    damping = np.full(count, 1e-3)
    best = z.copy()
    value = np.full(count, np.inf)
    gradient, square = np.zeros((count, size)), np.tile(np.eye(size), (count, 1, 1))
    trial = z
    live = np.ones(count, bool)
    for _ in range(iterations):
        g, h, v = _quadratic(candidate, white, trial[live], onset, coarse)
        where = np.flatnonzero(live)
        good = v < value[where]
        gain = value[where] - v
        up = where[good]
        best[up], value[up], gradient[up], square[up] = trial[up], v[good], g[good], h[good]
        damping[where] = np.where(good, damping[where] * 0.2, np.maximum(damping[where] * 8, 1e-2))
        live[where] = ~(good & (gain < 0.01)) & (damping[where] < 1e4)
        if not live.any():
            break
        diagonal = np.einsum("cii->ci", square)
        step = np.linalg.solve(square + (damping[:, None] * diagonal)[:, :, None] * np.eye(size), -gradient[:, :, None])
        step = step[:, :, 0]
        step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(1, keepdims=True), 1e-12))
        trial = np.clip(best + step, -5.0, 5.0)
    return best, white.constant - value


def _quadratic(
    candidate: Candidate, white: Whitener, z: Float, onset: int | None, coarse: bool = False
) -> tuple[Float, Float, Float]:
    """Gradient, Gauss-Newton matrix and value of the negative log joint density (less its constant) at `z`."""
    count, size = z.shape
    moved = np.repeat(z[:, None], size + 1, 1)
    moved[:, 1:] += _STEP * np.eye(size)
    errors = candidate.errors(moved.reshape(-1, size), onset, coarse=coarse)
    e = white(errors).reshape(count, size + 1, -1)
    columns = (e[:, 1:] - e[:, :1]) / _STEP
    base = e[:, 0]
    square = columns @ columns.transpose(0, 2, 1)
    cross = np.einsum("cpr,cr->cp", columns, base)
    value = 0.5 * np.einsum("cr,cr->c", base, base)
    grade = candidate.grade_columns
    if grade is not None:
        grade = grade.mean(-1, keepdims=True) if coarse else grade
        square, cross, value, _ = _integrated(white, grade, onset, columns, base, square, cross, value)
    return cross + z, square + np.eye(size), value + 0.5 * (z**2).sum(1)


_RMS = np.exp(np.linspace(np.log(2e-4), np.log(0.1), 25))


def _integrated(
    white: Whitener,
    grade: Float,
    onset: int | None,
    columns: Float,
    base: Float,
    square: Float,
    cross: Float,
    value: Float,
) -> tuple[Float, Float, Float, tuple[Float, Float]]:
    """The quadratic with the slope's coefficients integrated out, each start at its best `grade_rms`."""
    vectors, sizes, image = _spectrum(white, grade, onset)
    b = -base @ image.T @ vectors  # (start, knot): slope explains -e
    a = columns @ image.T @ vectors
    # log N of the coefficients' data, by eigenvalue, for every rms
    r2 = _RMS[:, None] ** 2
    shrink = r2 / (1 + r2 * sizes)
    gains = 0.5 * (b**2) @ shrink.T - 0.5 * np.log1p(r2 * sizes).sum(1)
    # the prior of the rms: log-normal about 1.2 %, wide towards faint
    gains = gains - 0.5 * ((np.log(_RMS) - np.log(0.012)) / 1.2) ** 2
    at = gains.argmax(1)
    w = shrink[at]
    square = square - np.einsum("cpk,ck,cqk->cpq", a, w, a)
    cross = cross + np.einsum("cpk,ck->cp", a, w * b)
    # Laplace over the rms: what the grid's curvature says
    peak = gains[np.arange(len(at)), at]
    spacing = np.log(_RMS[1] / _RMS[0])
    spread = np.log(np.exp(gains - peak[:, None]).sum(1) * spacing / (1.2 * np.sqrt(2 * np.pi)))
    return square, cross, value - peak - spread, (_RMS[at], (w * b) @ vectors.T)


_CACHE: dict[tuple[int, int], tuple[object, int | None, tuple[Float, Float, Float]]] = {}


def _spectrum(white: Whitener, grade: Float, onset: int | None) -> tuple[Float, Float, Float]:
    """Eigenvectors and eigenvalues of the slope's Gram matrix, and the white image of its columns (knot, row)."""
    key = (id(white), grade.shape[-1])
    kept = _CACHE.get(key)
    if kept is not None and kept[0] is white and kept[1] == onset:
        return kept[2]
    columns = grade
    if onset is not None:
        columns = grade.copy()
        if white.record.speed is not None:
            columns[:, -1] -= columns[:, -1, onset, :1][:, :, None]
        columns[:, :, :onset] = 0.0
    image = white(columns).reshape(len(grade), -1)
    sizes, vectors = np.linalg.eigh(image @ image.T)
    made = (vectors, np.maximum(sizes, 0.0), image)
    _CACHE.clear()
    _CACHE[key] = (white, onset, made)
    return made


def finish(candidate: Candidate, white: Whitener, z: Float, onset: int | None = None) -> Fit:
    """Covariance, errors and Laplace evidence at a mode `z` (coordinate,)."""
    size = len(z)
    gradient, square, value = (x[0] for x in _quadratic(candidate, white, z[None], onset))
    del gradient
    errors = candidate.errors(z[None], onset)[0]
    rms, profile = None, None
    grade = candidate.grade_columns
    if grade is not None:
        base = white(errors).reshape(1, -1)
        empty = np.zeros((1, 0, base.shape[1]))
        _, _, _, (found, coefficients) = _integrated(
            white, grade, onset, empty, base, np.zeros((1, 0, 0)), np.zeros((1, 0)), np.zeros(1)
        )
        rms, profile = float(found[0]), coefficients[0]
        part = np.tensordot(profile, grade, 1)
        if onset is not None:
            if candidate.record.speed is not None:
                part[-1] -= part[-1, onset, 0]
            part[:, :onset] = 0.0
        errors = errors - part
    log_joint = white.constant - float(value)
    return (
        Fit(
            z=z,
            covariance=np.linalg.inv(square),
            errors=errors,
            log_joint=log_joint,
            log_evidence=log_joint - 0.5 * float(np.linalg.slogdet(square)[1]),
            grade_rms=rms,
            profile=profile,
        )
        if size
        else Fit(z, np.zeros((0, 0)), errors, log_joint, log_joint)
    )
