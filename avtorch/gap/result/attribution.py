"""What a hypothesis changes, row by row, in nats, and where that lies.

In units of the noise, half the square of the change that a hypothesis makes to the prediction is what it is expected to
gain; the difference of the squared residuals is what it did gain. Both are spread over rows by the transform's adjoint,
which is orthonormal: nats of coefficients are nats of rows.

On each axis the part named is the shortest stretch that holds nearly all of what is expected, if clearly fewer rows lie
there. Each part is tested by the gain of its rows less the whole cost of the model. This is an e-value, for which the
procedure of Wang and Ramdas (2022) controls the false-discovery rate under any dependence between parts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.signal import lfilter
from scipy.stats import false_discovery_control

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import base_name
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.simulator.effect import EFFECTS as TABLE

_MOST = 0.95  # share of the cause's effect that a part holds
_BAND = 0.9  # share of the power

PLAINLY = 0.6
"""Largest share of the rows since the onset that a part may cover."""
RATE = 0.05
"""False-discovery rate."""


Axis = Literal["time", "speed", "command", "frequency", "signal"]
UNITS: dict[Axis, str] = {"time": "s", "speed": "m/s", "command": "m/s²", "frequency": "Hz", "signal": ""}


@dataclass(frozen=True)
class Location:
    """A part of the gap: `begin` to `end` on an `axis`, with its `share` of the cause's contribution.

    Times are on the log's own clock [s], the others [m/s, m/s², Hz]; on the axis `signal` both are `"actuation"` (the
    car's motion differs) or `"sensing"` (the accelerometer's reading differs). `q_value`: the false-discovery rate at
    which all parts with a q-value as small are named.
    """

    axis: Axis
    begin: float | str
    end: float | str
    share: float
    q_value: float

    def words(self, epoch_s: float = 0.0) -> str:
        """The part as a phrase; times count from `epoch_s`, the log's start on its own clock."""
        if isinstance(self.begin, str) or isinstance(self.end, str):
            return "in the car's motion" if self.begin == "actuation" else "in the accelerometer's reading"
        if self.axis == "time":
            return f"from {self.begin - epoch_s:.1f} to {self.end - epoch_s:.1f} s after the log's start"
        at, unit = "frequencies" if self.axis == "frequency" else f"{self.axis}s", UNITS[self.axis]
        ends = f"from {self.begin:.2g} to {self.end:.2g}" if self.begin else f"below {self.end:.2g}"
        return f"at {at} {ends} {unit}"

    def to_dict(self) -> dict[str, Any]:
        """An entry of `where` in `diagnosis.json`."""
        part = {"axis": self.axis, "from": self.begin, "to": self.end}
        return part | {"share": self.share, "q_value": self.q_value}


@dataclass(frozen=True, eq=False)
class RowAttribution:
    """Gain and effect of a model fitted to all drives, for every counted row (counted,).

    `gained` [nats]: gain in log density over the bare baseline. `paid` [nats], for all rows together: the cost of the
    fitted parameters and of the selection. `does` [nats]: expected gain, half the square of the whitened change in the
    rollout; `felt` [nats]: the same for the accelerometer's faults alone. `moved` (channel, counted): the change
    itself.
    """

    record: CountedRows
    gained: FloatArray = field(repr=False)
    paid: float
    does: FloatArray = field(repr=False)
    felt: FloatArray = field(repr=False)
    moved: FloatArray = field(repr=False)

    @property
    def p_value(self) -> float:
        """Upper bound on the p-value of the bare baseline against the model: the inverse of the e-value."""
        return float(np.exp(-np.clip(self.gained.sum() - self.paid, 0.0, 700.0)))


def row_attribution(rows: CountedRows, h: Hypothesis, base: Hypothesis, moved: FloatArray) -> RowAttribution:
    """The attribution of an evaluated hypothesis over the base; both about the same data as `rows`.

    `moved` (channel, counted): the change of the rollout.
    """
    before, after = _squares(h, base.residual), _squares(h, h.residual)
    gained = rows.of_rows(before - after).sum(1)
    total = float(h.log_likelihood - base.log_likelihood)
    if gained.sum() > 0:  # with the noise that each has, not with one noise for both
        gained = gained * total / gained.sum()
    cost = total - (h.evidence - base.evidence) + EFFECT_NATS * len(h.effects)
    does = rows.of_rows(_squares(h, h.predicted - base.predicted)).sum(1)
    sensed = _without_sensor(h)
    felt = np.zeros_like(does) if sensed is None else rows.of_rows(_squares(h, h.predicted - sensed)).sum(1)
    return RowAttribution(record=rows, gained=gained, paid=float(cost), does=does, felt=felt, moved=moved)


def change_attribution(rows: CountedRows, h: Hypothesis, change: FloatArray, paid: float) -> RowAttribution:
    """The attribution of a change of coefficients (channel, frame, bin) that takes so much of the residual of `h`, for
    `paid` nats."""
    before, after = _squares(h, h.residual), _squares(h, h.residual - change)
    does = rows.of_rows(_squares(h, change)).sum(1)
    moved = np.stack([rows.of_rows(h.data.adjoint(x)).mean(-1) for x in change])
    return RowAttribution(rows, rows.of_rows(before - after).sum(1), paid, does, np.zeros_like(does), moved)


def _squares(h: Hypothesis, x: FloatArray) -> FloatArray:
    """Half the squares (row,) of coefficients (channel, frame, bin) in units of the noise."""
    data = h.data
    white = whiten(data, h.covariance, x).reshape(x.shape)
    return np.sum([0.5 * data.adjoint(c) ** 2 for c in white], axis=0)


def _without_sensor(h: Hypothesis) -> FloatArray | None:
    """The prediction without the sensor's effects; None where there are none."""
    rest = h
    for e in h.effects:
        if base_name(e) in TABLE and TABLE[base_name(e)].place == "sensor":
            rest = rest.without(e)
    return None if rest is h else rest.response()


def localise(
    attribution: RowAttribution, *, onset_s: float | None, lag: float, epoch_s: float = 0.0
) -> tuple[Location, ...]:
    """The significant parts, most significant first. `onset_s`: from the log's start; `lag` [s] of the actuator;
    `epoch_s`: the start of the log on its own clock, on which times are stated."""
    parts: list[Part] = [*_stretches(attribution, onset_s, lag), *_signals(attribution), *_band(attribution)]
    q_values = _q_values([gain - attribution.paid for *_, gain in parts])
    named = []
    for (axis, begin, end, share, _), q in zip(parts, q_values, strict=True):
        if axis == "time" and not isinstance(begin, str) and not isinstance(end, str):
            begin, end = begin + epoch_s, end + epoch_s
        named.append(Location(axis, begin, end, share, q))
    return tuple(sorted((w for w in named if w.q_value <= RATE), key=lambda w: w.q_value))


Part = tuple[Axis, float | str, float | str, float, float]
"""Axis, ends, share of the cause's contribution, and gain within the part [nats]."""


def _stretches(attribution: RowAttribution, onset_s: float | None, lag: float) -> Iterator[Part]:
    record, does = attribution.record, attribution.does
    time = record.time
    one_clock = bool((np.diff(time) > 0).all()) and len(np.unique(record.log)) == 1
    if onset_s is not None and one_clock:
        # random effects (glitches, lost messages) have an onset but no predictable contribution
        since_then = does if does.any() else np.ones(len(time))
        yield _part(attribution, "time", time, onset_s, float(time[-1]), since_then)
    if not does.any():
        return
    axes: list[tuple[Axis, FloatArray]] = [("time", time)] if onset_s is None and one_clock else []
    if "speed" in record.channels:
        axes.append(("speed", record.measured[-1].mean(-1)))
    # the command filtered by the lag: an effect of the command is visible once the actuator has followed
    follows = -np.expm1(-record.dt / lag)
    command = np.asarray(lfilter([follows], [1, follows - 1], record.command))
    axes.append(("command", command))
    since = time >= onset_s if onset_s is not None and one_clock else np.ones(len(time), bool)
    for axis, x in axes:
        # weighted by size, not by square, or the edges of the active region would be lost
        low, high = shortest(x, np.sqrt(does), _MOST)
        if ((x >= low) & (x <= high))[since].mean() <= PLAINLY:
            _, _, _, share, gain = _part(attribution, axis, x, low, high, does)
            if axis == "command":  # an end at the limit of the filtered command is at that of the command itself
                low = float(record.command.min()) if low <= x.min() + 1e-9 else low
                high = float(record.command.max()) if high >= x.max() - 1e-9 else high
            yield axis, low, high, share, gain


def _part(attribution: RowAttribution, axis: Axis, x: FloatArray, low: float, high: float, does: FloatArray) -> Part:
    inside = (x >= low) & (x <= high)
    return axis, low, high, float(does[inside].sum() / does.sum()), float(attribution.gained[inside].sum())


def shortest(x: FloatArray, weight: FloatArray, share: float) -> tuple[float, float]:
    """Ends of the shortest interval of `x` (row,) that holds `share` of the `weight` (row,)."""
    order = np.argsort(x)
    x, total = x[order], np.concatenate([[0.0], np.cumsum(weight[order])])
    ends = np.searchsorted(total, total[:-1] + share * total[-1] * (1 - 1e-12))
    fits = np.flatnonzero(ends <= len(x))
    lengths = x[ends[fits] - 1] - x[fits]
    best = fits[int(lengths.argmin())]
    return float(x[best]), float(x[ends[best] - 1])


def _signals(attribution: RowAttribution) -> Iterator[Part]:
    does, felt = float(attribution.does.sum()), float(attribution.felt.sum())
    if does <= 0:
        return
    gained = float(attribution.gained.sum())
    sensing = min(felt / does, 1.0)
    for name, share in (("actuation", 1 - sensing), ("sensing", sensing)):
        if share > 0:
            yield "signal", name, name, share, share * gained


def _band(attribution: RowAttribution) -> Iterator[Part]:
    """The frequency band of the cause's change of acceleration."""
    record = attribution.record
    accel = attribution.moved[0] if "accel" in record.channels else np.gradient(attribution.moved[-1]) / record.dt
    power, f = np.zeros(0), np.zeros(0)
    for part in record.stretches:
        x = accel[part]
        power = np.concatenate([power, np.abs(np.fft.rfft(x * np.hanning(len(x))))[1:] ** 2])
        f = np.concatenate([f, np.fft.rfftfreq(len(x), record.dt)[1:]])
    if not power.sum() > 0:
        return
    low, high = shortest(np.log(f), power, _BAND)
    if high - low <= 0.75 * np.ptp(np.log(f)):
        share = float(power[(np.log(f) >= low) & (np.log(f) <= high)].sum() / power.sum())
        # the lowest frequency that a drive resolves includes the steady part
        slowest = low <= np.log(f.min()) + 1e-9
        begin, end = 0.0 if slowest else float(np.exp(low)), float(np.exp(high))
        yield "frequency", begin, end, share, share * float(attribution.gained.sum())


def _q_values(gains: Sequence[float]) -> list[float]:
    """q-values from e-values, given by their logarithms: Benjamini and Hochberg's of their inverses."""
    return false_discovery_control(np.exp(-np.clip(gains, 0.0, 700.0))).tolist() if gains else []
