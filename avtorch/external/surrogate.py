"""A chain of effects that answers as a simulator does: its surrogate.

A simulator whose inside is unknown is identified by its own output, as a car is; but it has no noise, so what decides
is least squares, and how much of the response is left to explain:

    log L = -1/2 sum_c |R_c|² / s_c²

with coefficients R (channel, frame, bin) below 10 Hz and the size s (channel,) [m/s²] of what is left. Frames held out
say whether an effect is there. The surrogate stands in for the simulator wherever one has to ask what it would have
done with another parameter or with an effect more; what it leaves over is known, and stays the simulator's own
(`discrepancy`).

What a parameter is called in a simulator's settings and what it does in the drive are two things: a lag of 0.4 s may
become 0.8 s by a filter before it. The manoeuvres are steps of every size, either way, and a sweep, at several speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self, cast

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.external.driving import driven_along
from avtorch.external.simulator import Simulator, check_methods
from avtorch.gap.engine.coordinates import EFFECTS as ATOMS
from avtorch.gap.engine.coordinates import EngineEffect, adopt
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit, jacobian, objective, prior_terms, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis, plant_of
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import CLAIM_HZ
from avtorch.gap.engine.promises import promises
from avtorch.gap.engine.search import other_limit
from avtorch.gap.quantity import unit_of, words_of
from avtorch.gap.simulator.effect import EFFECTS
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log

_LATE_S = 0.1  # either way, of the speed against the acceleration: a step of the slowest simulators
_FOLDS = 6


@dataclass(eq=False)
class NoiseFree(Hypothesis):
    """A hypothesis about a simulator's output, whose errors have the size `sd` (channel,) [m/s²] and no colour."""

    sd: FloatArray = field(default_factory=lambda: np.ones(1))

    @property
    def free(self) -> list[str]:
        """Names of the coordinates that a fit moves: lag and gain, the speed's lateness, those of the effects."""
        late = ["speed_delay"] if self.data.channel_count == 2 else []
        return ["T_L", "K_L", *late, *(c.name for e in self.effects for c in ATOMS[e].coordinates)]

    def limits(self, name: str) -> tuple[float, float]:
        return (-_LATE_S, _LATE_S) if name == "speed_delay" else super().limits(name)

    def copy(self) -> Self:
        other = super().copy()
        other.sd = self.sd
        return other

    def with_sd(self, sd: FloatArray) -> Self:
        """The same hypothesis with errors of another size."""
        other = self.copy()
        other.sd = sd
        return other.evaluate()

    def fitted(self, iterations: int = 8) -> Self:
        """The hypothesis at its best, changed in place."""
        fit(self, iterations)
        return self

    def evaluate(self) -> Self:
        self.predicted = self.response()
        self.residual = self.data.measured - self.predicted
        self.covariance = np.broadcast_to(np.diag(self.sd**2), (self.data.band_count, len(self.sd), len(self.sd)))
        self.log_likelihood = -0.5 * float((whiten(self.data, self.covariance, self.residual) ** 2).sum())
        return self

    @property
    def errors(self) -> FloatArray:
        """Root mean square (channel,) [m/s²] of what is left."""
        return np.sqrt((self.residual**2).sum((1, 2)) / (self.data.frame_count * self.data.frame_rows))

    @property
    def held_out(self) -> float:
        """Root mean square of what is left of frames that the fit did not see, over `sd`, to first order."""
        names, data = self.free, self.data
        by_frame = (data.channel_count, data.frame_count, data.bin_count)
        W = whitened_jacobian(self, jacobian(self, names)).reshape(len(names), *by_frame)
        r = whiten(data, self.covariance, self.residual).reshape(by_frame)
        precision, pull = prior_terms(self, names)
        each = np.einsum("icfk,jcfk->fij", W, W, optimize=True)
        scores = np.einsum("icfk,cfk->fi", W, r, optimize=True)
        fold = np.arange(data.frame_count) % min(_FOLDS, data.frame_count)
        total = 0.0
        for k in range(int(fold.max()) + 1):
            own = fold == k
            A = each[~own].sum(0) + np.diag(precision)
            step = np.linalg.lstsq(A, scores[~own].sum(0) + pull, rcond=None)[0]
            total += float(((r[:, own] - np.tensordot(step, W[:, :, own], 1)) ** 2).sum())
        return float(np.sqrt(total / r.size))


MOST_EFFECTS = 8
ENOUGH = 0.002
"""Share of the response (root mean square) that may be left over."""
_WORTH = 0.95  # of the errors on frames held out, that an effect must leave at most
_PER_PARAMETER = 1.5  # times smaller errors, that a parameter more has to be worth when two effects compete
_FITTED, _HELD_OUT = 16, 4  # effects fitted, those that promise most, and held out of these
_LAGS_S = (0.07, 0.15, 0.3, 0.6)  # from which the first fits begin
_SHORTER = 0.5  # of a lag that gives its time to a delay or a second pole
_FIRST_ERROR = 0.1  # of the response
_LEAST_ERROR = 1e-5  # of the response, so that a perfect fit has a scale


@dataclass(frozen=True)
class Surrogate:
    """`plant`: the chain that answers as the simulator does; `left`: share of the response that it does not, by channel
    (root mean squares, of acceleration and of the derivative of speed, below 10 Hz)."""

    plant: GapPlant
    left: Mapping[str, float]

    def sizes(self) -> dict[str, dict[str, float]]:
        """The numbers of each of its effects, by name."""
        return {
            name: {key: float(x) for key, x in values.items() if x.dim() == 0}
            for name, values in self.plant.report().items()
        }

    @property
    def lag_and_gain(self) -> dict[str, float]:
        """`T_L` [s] and `K_L`."""
        return {"T_L": float(self.plant.T_L), "K_L": float(self.plant.K_L)}

    def to_dict(self) -> dict[str, Any]:
        """As in `comparison.json`."""
        return {"effects": self.sizes(), **self.lag_and_gain, "left": dict(self.left)}


def surrogate_of(
    simulated: Sequence[Log],
    *,
    enough: float = ENOUGH,
    progress: Callable[[str, int, int], None] | None = None,
) -> Surrogate:
    """The surrogate of the simulator whose output these logs are.

    `enough`: share of the response that may be left over.
    `progress(what, done, of)` is called at each effect.

    Raises `InputError` where the drives are too short, see `DriveData.of`.
    """
    data = DriveData.of(simulated)
    size = np.std(data.channel_rows(data.accel, data.speed), axis=1) + 1e-9
    data = data.below(CLAIM_HZ)
    bare = [NoiseFree(data, sd=_FIRST_ERROR * size) for _ in _LAGS_S]
    for h, lag in zip(bare, _LAGS_S, strict=True):
        h["T_L"] = lag
    now = max((h.fitted(15) for h in bare), key=objective)
    kinds = _kinds(data)
    for number in range(MOST_EFFECTS):
        if progress is not None:
            progress("simulator", number, MOST_EFFECTS)
        if (now.errors < enough * size).all():
            break
        now = now.with_sd(np.maximum(now.errors, _LEAST_ERROR * size)).fitted()
        entered = _entered(now, [e for e in kinds if e.base not in now.names])
        if entered is None:
            break
        now = entered
    now = _without_the_idle(now, size, enough)
    now = now.with_sd(np.maximum(now.errors, _LEAST_ERROR * size)).fitted()
    left = dict(zip(data.channels, (now.errors / size).tolist(), strict=True))
    return Surrogate(plant_of(now, plant([], sigma=0.0)), left)


def _kinds(data: DriveData) -> list[EngineEffect]:
    """Effects that a simulator can have: the same on every drive, by no chance, and seen in these channels."""
    kinds = [k for k in EFFECTS.values() if not (k.random or k.of_the_drive or k.own_onset)]
    for kind in kinds:
        adopt(kind)
    names = {kind.name for kind in kinds}
    return [
        replace(e, onset="never")
        for e in ATOMS.values()
        if e.base in names and e.onset != "must" and e.coordinates and e.needs <= set(data.channels)
    ]


def _entered(now: NoiseFree, kinds: Sequence[EngineEffect]) -> NoiseFree | None:
    """The model with the effect that leaves least on frames held out; an effect with more parameters has to leave
    less for each. None where no effect is worth it."""
    before, starts = now.held_out, dict[str, list[tuple[float, ...]]]()
    for promise in promises(now, kinds):
        if promise.effect in starts or len(starts) < _FITTED:
            starts.setdefault(promise.effect, []).append(promise.start)
    rough = [max((h.fitted(4) for h in _begun(now, e, starts[e])), key=objective) for e in starts]
    best = sorted(rough, key=lambda h: -objective(h))[:_HELD_OUT]
    # with limits of the command that a fit put out of reach brought back, where that explains more
    fits = [cast("NoiseFree", other_limit(h.fitted(12))) for h in best]
    left = [h.held_out / before for h in fits]
    worth = [(share * _PER_PARAMETER ** len(h.free), n) for n, (share, h) in enumerate(zip(left, fits, strict=True))]
    worth = [(value, n) for value, n in worth if left[n] < _WORTH]
    return fits[min(worth)[1]] if worth else None


def _begun(now: NoiseFree, effect: str, starts: Sequence[tuple[float, ...]]) -> list[NoiseFree]:
    """The model with one more effect at each of `starts`; a lag and a delay trade places, so from a shorter lag too."""
    out = [now.with_effect(effect, start) for start in starts]
    for h in list(out):
        if EFFECTS[ATOMS[effect].base].memory or effect in ("second_order_actuator", "rate_limit"):
            shorter = h.copy()
            shorter["T_L"] *= _SHORTER
            out.append(shorter)
    return out


def _without_the_idle(now: NoiseFree, size: FloatArray, enough: float) -> NoiseFree:
    """The model without effects that the others make superfluous, the most superfluous first."""
    while now.effects:
        errors = np.maximum(now.errors, _LEAST_ERROR * size)
        without = [now.without(e).with_sd(errors).fitted() for e in now.effects]
        cost = [float((h.errors / np.maximum(errors, enough * size)).max()) for h in without]
        if min(cost) > 1 / _WORTH:
            break
        now = without[int(np.argmin(cost))]
    return now


# is a simulator what its user set? ----------------------------------------------------------------------------------
_SPEEDS_MPS = (10.0, 18.0, 26.0)
STEP_S = 0.02
_SIZES = (0.05, -0.05, 0.15, -0.15, 0.4, -0.4, 1.0, -1.0, 2.5, -2.5, 0.8, -2.0, 1.2)
_HOLD_S, _REST_S = 1.6, 1.0
_NEARLY_ENOUGH = 0.005  # of the response: an integrator of the simulator's own leaves some thousandths
_SWEEP_S, _SWEEP_HZ = 20.0, (0.05, 1.5)


@dataclass(frozen=True, repr=False)
class SimulatorCheck(Displayed):
    """What a simulator called `name` does, as a chain of effects (`surrogate`), and the `output` it was found from."""

    name: str
    surrogate: Surrogate
    output: Log

    def overview(self) -> Card:
        """The chain of effects that answers as it does."""
        rows = [{"parameter": name, "unit": unit_of(name), "value": value} for name, value in self.values.items()]
        line = f"That is all but {100 * self.left:.1f} % of its response."
        return Card(f"Simulator {self.name}, as a chain of effects", (line,), Frame.of_rows(rows))

    @property
    def values(self) -> dict[str, float]:
        """`T_L` [s], `K_L`, and `effect.parameter` of the effects it has."""
        effects = self.surrogate.sizes()
        return self.surrogate.lag_and_gain | {f"{e}.{k}": x for e, values in effects.items() for k, x in values.items()}

    @property
    def left(self) -> float:
        """Share of its response that no chain of known effects gives, of the channel where it is largest."""
        return max(self.surrogate.left.values())

    def __str__(self) -> str:
        lines = [f"{self.name} answers as"]
        for name, value in self.values.items():
            effect, _, key = name.rpartition(".")
            unit = unit_of(key)
            words = f"{effect}: {words_of(key)}" if effect else {"T_L": "lag T_L", "K_L": "gain K_L"}[key]
            lines.append(f"  {words} {value:.3g}{'' if unit == '-' else f' {unit}'}")
        return "\n".join([*lines, f"and that is all but {100 * self.left:.1f} % of its response."])

    def to_dict(self) -> dict[str, Any]:
        """As `simulator.json`."""
        return {
            "schema": "avtorch.simulator/1",
            "name": self.name,
            "values": self.values,
            "left": dict(self.surrogate.left),
        }


def check_simulator(
    simulator: Simulator,
    *,
    name: str = "",
    step_s: float = STEP_S,
) -> SimulatorCheck:
    """What `simulator` does, from drives that begin at 10, 18 and 26 m/s, with steps of `step_s` [s].

    Raises `InputError` for an object that is no simulator, one that fails (see `driven_along`), a step out of range,
    and one that does not respond.

    Example:
        >>> from avtorch import InputError
        >>> from avtorch.external import check_simulator
        >>> class Parked:
        ...     def reset(self, *, speed, accel): pass
        ...     def step(self, accel_cmd, dt): return 0.0, 0.0
        >>> try:
        ...     check_simulator(Parked())
        ... except InputError as error:
        ...     print(error)
        Parked: does not respond to commands between -2.5 and 2.5 m/s²
    """
    check_methods(simulator, type(simulator).__name__)
    if not 0.001 <= step_s <= 0.1:
        raise InputError(f"step_s: found {step_s}, needs 0.001 to 0.1 s")
    name = name or type(simulator).__name__
    command = _manoeuvre(step_s)
    rows = len(command)
    time = np.concatenate([k * (rows * step_s + 60.0) + step_s * np.arange(rows) for k in range(len(_SPEEDS_MPS))])
    drive = Log.from_arrays(
        name=name,
        time=time,
        accel_cmd=np.tile(command, len(_SPEEDS_MPS)),
        accel=np.zeros(len(time)),
        speed=np.repeat(_SPEEDS_MPS, rows),
    )
    output = driven_along(simulator, drive, name=name)
    if output.accel is None or output.accel.std() < 1e-6:
        raise InputError(
            f"{name}: does not respond to commands between {command.min():.2g} and {command.max():.2g} m/s²"
        )
    return SimulatorCheck(name, surrogate_of([output], enough=_NEARLY_ENOUGH), output)


def _manoeuvre(dt: float) -> FloatArray:
    """Commands (row,) [m/s²]: a sweep, and steps of every size; what is gained in speed is lost again."""
    time = dt * np.arange(round(_SWEEP_S / dt))
    low, high = _SWEEP_HZ
    phase = 2 * np.pi * low * _SWEEP_S / np.log(high / low) * ((high / low) ** (time / _SWEEP_S) - 1)
    pieces = [np.zeros(round(_REST_S / dt)), np.sin(phase)]
    for size in _SIZES:
        pieces += [np.zeros(round(_REST_S / dt)), np.full(round(_HOLD_S / dt), size)]
    return np.concatenate([*pieces, np.zeros(round(_REST_S / dt))])
