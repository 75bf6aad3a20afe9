"""Numbers that pin the likelihood: log evidences of short fixed drives by the search itself, and residual statistics.

Names and formatting may change without a new fit, numbers may not. So the fingerprint consists of numbers. Each drive
exercises another part: noise and onset, pairs and the sensor, outliers and lost messages, the road, groups of rows;
`effects` evaluates every effect of the table at one fixed point, from the start and from an onset on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from avtorch.gap import EFFECTS, plant
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.gauss_newton import finish
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.noise_segments import whitening_filter
from avtorch.gap.search.search import Search
from avtorch.gap.selection.adequacy import adequacy
from avtorch.io import Log
from benchmarks.fit_calibration.drives import drive

Numbers = dict[str, float]

FIXED_PLACE = "effects"
RELATIVE, NATS = 1e-6, 0.05
"""Tolerances. At a fixed point there are no decisions, and round-off moves the numbers by 1e-11 (inputs moved by
1e-12): there the tolerance is relative. A search stops where a round gains less than 0.01 to 0.05 nats, which round-off
can cause a round earlier (7e-3 nats for the gust): elsewhere the tolerance is in nats, far below any effect on a
probability."""


def late() -> Numbers:
    """Noise, onset and a delay."""
    return searched(drive(1, seconds=24.0, rate_hz=20, delay_s=0.3, since_s=11.0), ["dead_time"], left="dead_time")


def two() -> Numbers:
    """A pair."""
    log = drive(2, seconds=24.0, rate_hz=20, delay_s=0.25, scale=1.3)
    return searched(log, ["dead_time", "sensor_scale"], left="dead_time+sensor_scale")


def chance() -> Numbers:
    """Outliers and lost messages."""
    log = drive(
        3, seconds=24.0, rate_hz=20, held=[slice(i, i + 12) for i in range(60, 460, 60)], glitches=[37, 134, 231, 328]
    )
    return searched(log, ["outliers", "command_hold"], left="none")


def road() -> Numbers:
    """A road's slope together with a gust."""
    return searched(drive(4, seconds=24.0, rate_hz=20, slope=0.03), ["road_grade", "gust"], left="road_grade")


def grouped() -> Numbers:
    """A log of 100 Hz, with rows in groups of five."""
    return searched(drive(5, seconds=14.0, rate_hz=100, delay_s=0.2), ["dead_time"], left="none", pairs=False)


def effects() -> Numbers:
    """All deterministic effects, and a gust's noise, at one point: from the start and from an onset on."""
    record = Record.of(drive(6, seconds=14.0, rate_hz=20))
    noise = NoiseModel(force_sd=0.02, accel_sd=0.06)
    bare = Hypothesis.named(record, "none", plant())
    place = np.full(bare.size, 0.4)
    found = {
        "none": finish(bare, whitening_filter(record, noise), place).log_evidence,
        "gust": finish(bare, whitening_filter(record, noise.replaced(force_sd=0.3)), place).log_evidence,
    }
    for name, effect in EFFECTS.items():
        if effect.random:
            continue
        hypothesis = Hypothesis.named(record, name, plant())
        for onset in (None, record.rows // 2):
            fit = finish(hypothesis, whitening_filter(record, noise, onset=onset), np.full(hypothesis.size, 0.4), onset)
            found[name if onset is None else f"{name} from an onset"] = fit.log_evidence
    return found


PARTS: Mapping[str, Callable[[], Numbers]] = {
    part.__name__: part for part in (late, two, chance, road, grouped, effects)
}


def fingerprint() -> dict[str, Numbers]:
    """All numbers [nats] by part; some ten seconds of processor time."""
    return {name: part() for name, part in PARTS.items()}


def searched(log: Log, names: Sequence[str], *, left: str, pairs: bool = True) -> Numbers:
    """Log evidence of every hypothesis among effects of these names, and the residual statistic of the one named
    `left`."""
    race = Search([log], plant(), effects=[EFFECTS[name] for name in names], pairs=pairs).run()
    found = {f.name: f for f in race.found}
    of = found[left]
    over = adequacy(of.white, of.errors, race.record.measured - of.errors)
    numbers = {name: float(f.log_evidence) for name, f in sorted(found.items())}
    return numbers | {f"left: {name}": float(getattr(over, name)) for name in sorted(vars(over))}


def differences(part: str, stored: Mapping[str, float], now: Mapping[str, float]) -> list[str]:
    """Each number of a part that differs, in words."""
    lines = [
        f"{part}: {name}: only {'stored' if name in stored else 'computed'}" for name in stored.keys() ^ now.keys()
    ]
    for name in stored.keys() & now.keys():
        allowed = RELATIVE * abs(stored[name]) if part == FIXED_PLACE else NATS
        if abs(stored[name] - now[name]) > allowed:
            lines.append(f"{part}: {name}: stored {stored[name]:.9g}, computed {now[name]:.9g}")
    return sorted(lines)
