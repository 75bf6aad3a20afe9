"""Check a log before estimation: what it contains, which rows are masked, what is doubtful. It never corrects a log."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError, listed
from avtorch.io.clock import clock_words, median_step, stretches
from avtorch.io.engagement import SETTLE_S
from avtorch.io.log import Log
from avtorch.io.mapping import PEDALS
from avtorch.io.validity import DELAYS_S, Scale, command_scale, integral, scale_between

LEAST_S = 2.0
"""The shortest stretch [s] of which anything is estimated: the lag and dead time of a car, and as long again."""
_CONSTANT_MPS2 = 1.0  # an accelerometer tilted by 6 degrees, or a road of 10 %: no larger constant has these causes
_CALIBRATED = 0.05  # share by which a wheel's wear, a tyre's pressure and a sensor's calibration change a scale

SIGNALS = ("accel_cmd", "accel", "speed", "jerk", "spacing", "lead_speed", "lead_accel", "grade", *PEDALS, "speed_cmd")


@dataclass(frozen=True)
class Gap:
    """A gap begins after ``row`` (of the log, from 1) at ``start_s`` on the log's time and lasts ``seconds``."""

    row: int
    start_s: float
    seconds: float


@dataclass(frozen=True)
class Quality:
    """The quality of a log.

    ``epoch_s``: time of the first row [s], from which ``notes`` count; ``jitter``: 95 % point of the deviation of a
    step from the median one, as its share [-]; ``late_rows``: steps over 1.5 median ones that are no gap;
    ``masked_rows``: rows not usable, of which ``driver_rows`` not engaged, ``settling_rows`` within 2 s of one of
    ``returns`` to engaged and ``standstill_rows`` below 0.3 m/s, or a
    tenth of the top speed where that is less, or, without speed, classified as standing; ``notes``:
    all of it in sentences.
    """

    rows: int
    seconds: float
    segments: int
    rate_hz: float
    jitter: float
    late_rows: int
    gaps: tuple[Gap, ...]
    masked_rows: int
    driver_rows: int
    standstill_rows: int
    returns: int
    settling_rows: int
    constant: tuple[str, ...]
    missing: tuple[str, ...]
    doubtful_units: tuple[str, ...]
    notes: tuple[str, ...]
    epoch_s: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """For a JSON answer."""
        return asdict(self)


def check(log: Log) -> Quality:
    """Check the quality of a log. Accepts any valid `Log` and raises nothing.

    Example:
        >>> import numpy as np
        >>> from avtorch.io import Log, check
        >>> time = np.arange(0.0, 20.0, 0.05)
        >>> quality = check(Log.from_arrays(time=time, accel_cmd=np.sin(time), speed=20 - np.cos(time)))
        >>> round(quality.seconds, 2), quality.missing
        (19.95, ('accel',))
    """
    same = np.diff(log.segment) == 0
    step = median_step(log.elapsed, same)
    steps = np.diff(log.elapsed)[same]
    jitter = float(np.quantile(np.abs(steps - step), 0.95) / step) if len(steps) else 0.0
    late = int((steps > 1.5 * step).sum())
    apart = np.round(np.diff(log.time), 6)  # one label where the clock was reset
    gaps = tuple(
        Gap(int(row) + 1, float(log.time[row]), float(apart[row]))
        for row in np.flatnonzero(~same)
        if apart[row] > 1.5 * step
    )
    present = {name: getattr(log, name) for name in SIGNALS if getattr(log, name) is not None}
    constant = tuple(name for name, values in present.items() if np.ptp(values) == 0)
    missing = tuple(name for name in ("accel_cmd", "accel", "speed") if name not in present)
    parts, motion = stretches(log.usable, log.segment), None
    if log.speed is not None and log.accel is not None:
        motion = scale_between(log.elapsed, parts, log.speed, log.accel)
    doubtful = tuple(_doubtful_units(log, parts, motion))
    driver, still = int((~log.engaged).sum()), int((~log.moving).sum())
    returns = int((np.diff(log.engaged.astype(int)) == 1).sum())
    settling = int((log.engaged & ~log.settled).sum())
    masked = int((~log.usable).sum())
    segments = len(log.segments())

    notes = [f"{log.rows} rows, {log.seconds:.1f} s in {segments} segment{'s' * (segments != 1)}, {log.rate_hz:.4g} Hz"]
    if log.epoch_s != 0:
        notes.append(f"times are shown from the log's start, at {clock_words(log.epoch_s)}")
    if jitter > 0.1:
        notes.append(
            f"time jitters: steps differ from {step:.4g} s by up to {100 * jitter:.0f} % (95 % of them by less)"
        )
    if late:
        notes.append(f"{late} step{'s' * (late != 1)} longer than 1.5 median ones: rows were lost, too few for a gap")
    for gap in gaps[:5]:
        at = f"row {gap.row} ({log.elapsed[gap.row - 1]:.6g} s from the start)"
        notes.append(f"gap of {gap.seconds:.3g} s after {at}: a new segment starts")
    if len(gaps) > 5:
        notes.append(f"{len(gaps) - 5} more gaps, each the start of a new segment")
    if segments - 1 > len(gaps):
        notes.append(f"{segments - 1 - len(gaps)} new segments by the log's own segment column")
    if driver:
        notes.append(f"{driver} rows masked: not engaged")
    if returns:
        notes.append(
            f"{returns} return{'s' * (returns != 1)} to engaged: the simulation restarts at each; "
            f"{settling * step:.1f} s of settling masked ({SETTLE_S:g} s after each)"
        )
    if still:
        how = f"below {log.standstill_mps:.2g} m/s" if log.speed is not None else "braked, yet not slowing"
        notes.append(f"{still} rows masked: standstill ({how})")
    if masked == log.rows:
        notes.append("no row is left to estimate from")
    notes.extend(f"{name} is constant ({present[name][0]:.6g}): it excites nothing" for name in constant)
    notes.extend(_on_missing(missing, log))
    notes.extend(_repeats(present, log))
    notes.extend(doubtful)
    notes.extend(_disagreements(log, motion))
    if log.ignored:
        notes.append(f"columns ignored: {listed(log.ignored)}")
    notes.extend(log.remarks)
    return Quality(
        rows=log.rows, seconds=log.seconds, segments=segments, rate_hz=log.rate_hz, jitter=jitter, late_rows=late,
        gaps=gaps, masked_rows=masked, driver_rows=driver, standstill_rows=still, returns=returns,
        settling_rows=settling, constant=constant, missing=missing,
        doubtful_units=doubtful, notes=tuple(notes), epoch_s=log.epoch_s,
    )  # fmt: skip


def _on_missing(missing: tuple[str, ...], log: Log) -> list[str]:
    mapped = log.pedals or (("speed_cmd",) if log.speed_cmd is not None else ())
    assumed = f"a map of {' and '.join(mapped)}" if mapped else "an assumed controller"
    sentences = {
        "accel_cmd": f"no accel_cmd: every result on the actuator is conditional on {assumed}",
        "accel": "no accel: speed is the only channel, so the log cannot distinguish sensor faults from real forces",
        "speed": "no speed: accel is the only channel, short stops go unnoticed, and sensor faults resemble forces",
    }
    return [sentences[name] for name in missing]


def _repeats(present: dict[str, NDArray], log: Log) -> list[str]:
    """Signals sampled more slowly than the rows and held in between."""
    notes = []
    for name in ("accel_cmd", "accel", "speed"):
        if name not in present:
            continue
        changes = np.flatnonzero(np.diff(present[name]) != 0)
        # a constant signal repeats too; a slowly sampled one repeats equally often each time
        if len(changes) >= 20:
            runs = np.diff(changes)
            usual = int(np.median(runs))
            if usual >= 2 and np.mean(runs == usual) > 0.7:
                notes.append(
                    f"{name} changes every {usual} rows only: it comes at {log.rate_hz / usual:.3g} Hz and is held"
                )
    return notes


def _doubtful_units(log: Log, parts: list[slice], motion: Scale | None) -> list[str]:
    """`motion`: how speed changes by what accel says over `parts`."""
    notes = []
    if log.speed is not None and log.moving.any():
        top, middle = float(log.speed.max()), float(np.median(log.speed[log.moving]))
        if top > 60 or middle > 45:
            notes.append(f"speed reaches {top:.3g} m/s (median {middle:.3g}): could it be km/h? `--unit speed=km/h`")
    times = None if motion is None or motion.correlation <= 0.9 else motion.factor
    if times is not None and abs(math.log(times)) > _CALIBRATED:
        notes.append(
            f"speed changes {times:.3g} times as much as accel implies: a unit, the accelerometer's scale or the "
            "speed's, such as a wheel's radius, is wrong. A known distance tells which; until then the car's gain "
            "is open by as much"
        )
    if log.accel_cmd is not None:
        found = command_scale(log.elapsed, parts, log.speed, log.accel, log.accel_cmd)
        if found is not None and found.correlation > 0.9 and not 0.2 <= found.slope <= 1.5:
            channel = "speed" if log.speed is not None else "accel"
            notes.append(
                f"{channel} responds with {found.slope:.3g} times the command: units of {channel} or accel_cmd?"
            )
        notes += _constant(log, parts)
    if log.speed is None and log.accel is not None and log.accel_cmd is not None:
        top = max(float(np.abs(log.accel).max()), float(np.abs(log.accel_cmd).max()))
        if 0 < top < 0.6:
            notes.append(f"accel and accel_cmd stay below {top:.2g}: calm, or in g? Only speed could show which")
    if log.jerk is not None and log.accel is not None:
        found = scale_between(log.elapsed, parts, log.accel, log.jerk)
        if found is not None and found.correlation > 0.9 and not 0.5 <= found.slope <= 2:
            notes.append(f"accel changes {found.slope:.3g} times as much as jerk implies: a unit is wrong")
    if log.lead_speed is not None and log.speed is not None:
        ratio = float(np.abs(log.lead_speed).sum() / max(np.abs(log.speed).sum(), 1e-9))
        if not 0.5 < ratio < 2:
            notes.append(f"the leader is {ratio:.3g} times as fast all along: units of lead_speed or speed?")
    return notes


def _constant(log: Log, parts: list[slice]) -> list[str]:
    """A constant between command and motion that is neither a sensor's offset nor a road."""
    level = log.speed if log.accel is None else integral(log.elapsed, log.accel)
    if level is None or log.accel_cmd is None:
        return []
    line = scale_between(log.elapsed, parts, level, log.accel_cmd, delays=DELAYS_S)
    if line is None or line.correlation < 0.8 or abs(line.constant) - 3 * line.sd < _CONSTANT_MPS2:
        return []
    channel = "accel" if log.accel is not None else "speed's derivative"
    return [
        f"{channel} is {line.slope:.3g} times the command {'plus' if line.constant > 0 else 'minus'} "
        f"{abs(line.constant):.3g} m/s² (SE {line.sd:.1g}): is gravity or a feed-forward left in one of them? "
        "Take it off first: lag and gain that are estimated with it are wrong"
    ]


def require_usable(log: Log) -> None:
    """Raises `InputError` for a log of which too little is left (`LEAST_S`)."""
    if not log.usable.any():
        raise InputError(
            f"{log.name}: has no row to use; all are driven by hand (engaged 0), within 2 s after, or at standstill"
        )
    spans = [log.elapsed[p.stop - 1] - log.elapsed[p.start] for p in stretches(log.usable, log.segment)]
    longest = max(spans) + 1 / log.rate_hz  # a row lasts until the next one
    if longest < LEAST_S - 1e-6:
        still = f"; {float((~log.moving).mean()):.0%} of the rows are below {log.standstill_mps:.2g} m/s"
        raise InputError(
            f"{log.name}: too little is left to use: the longest stretch lasts {longest:.2g} s, needs {LEAST_S:g} s or "
            f"more{still if not log.moving.all() else ''}"
        )


def _disagreements(log: Log, motion: Scale | None) -> list[str]:
    if motion is None or log.speed is None:
        return []
    # 0.5 m/s in a second, or a twentieth of the top speed of what is slower, is well above noise and grade
    plain = min(0.5, 0.05 * float(np.abs(log.speed).max()))
    if motion.change < plain or motion.correlation >= 0.5:
        return []
    r = f"{motion.correlation:.2f}"
    return [f"speed's derivative and accel disagree (correlation {r}): one of them is not this car's motion"]
