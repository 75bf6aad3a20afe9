"""Sealed cases, drawn so that nothing but the log identifies the cause.

Kinds come in fixed shares in shuffled order, every effect in every tier equally often; half of the causes have an onset
within the drive. A case depends only on `(seed, index)` and the settings, so a set of cases can be drawn in parts and
in any order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from avtorch.errors import InputError
from benchmarks.blindtest.car import draw_car
from benchmarks.blindtest.case import Case
from benchmarks.blindtest.catalogue import CALIBRATION, EFFECTS, SEALED, Family
from benchmarks.blindtest.command import Parameters
from benchmarks.blindtest.deck import MIX, card, kind_of
from benchmarks.blindtest.drives import draw_drive, with_stops
from benchmarks.blindtest.oracle_budget import gap_over_floor
from benchmarks.blindtest.recorder import draw_recorder
from benchmarks.blindtest.replay import Replay
from benchmarks.blindtest.several import LEAST_GAP, draw_several, excess_range, ordinary, solve_strength
from benchmarks.blindtest.vehicle import Pilot, Run, simulate
from benchmarks.blindtest.visibility import TIERS, Sight, oracles, sight, tier_of

Recording = Literal["ideal", "ordinary"]
Trial = tuple[Parameters, Run, Sight]
"""A cause alone on a drive: its parameters, the drive, how visible it is there."""
_ATTEMPTS = 10
SIGNALS = ("accel", "speed")
_PAIR_EXCESS = (1.25, 8.0)
"""Visibility range of each effect of a pair, alone on the drive: visible enough that both can be identified."""
_TOP_SPEED_MPS = 44.0


def draw_cases(n: int, seed: int, **settings: Any) -> Iterator[Case]:
    """The first `n` cases of the set `seed`, one after another.

    `settings`: those of `draw_case`. `mix`: shares of the kinds (default 25 % none, 40 % single, 20 % pair, 15 %
    outside), kept in every 20 cases;
    `several`: three to five causes of ordinary size (`several.py`), with the oracle's budget of the gap.
    `tiers`, `effects`: single cases cover all their combinations in random order; causes outside the table are drawn
    from all `tiers`. `outside`: which of the two groups of families outside the table. `seconds`, `manoeuvre`: fixed
    instead of drawn. `signals`: the channels of the logs, in which a cause must be visible. Where a cause cannot reach
    the visibility asked for on a drive, another drive is drawn; after ten drives another cause takes its place, or else
    the case keeps the drive where it is most visible, in the tier that it has there. `recorder`: `ordinary` passes each
    log, whatever its kind, through a recorder drawn for it (`draw_recorder`), and lets every other drive of cruise and
    steps come to a standstill; the other drives are those of `ideal`.

    Raises `InputError` for unknown kinds, tiers, effects, signals or recorders.

    Example:
        >>> from benchmarks.blindtest import draw_cases
        >>> [case.truth_name for case in draw_cases(2, seed=1, mix={"none": 1.0}, seconds=10.0)]
        ['none', 'none']
    """
    for i in range(n):
        yield draw_case(i, seed, **settings)


def draw_case(
    index: int,
    seed: int,
    *,
    mix: Mapping[str, float] | None = None,
    tiers: Sequence[str] = tuple(TIERS),
    effects: Sequence[str] = tuple(EFFECTS),
    outside: Literal["sealed", "calibration"] = "sealed",
    seconds: float | None = None,
    manoeuvre: str | None = None,
    signals: Sequence[str] = SIGNALS,
    recorder: Recording = "ideal",
) -> Case:
    """Draw case `index` of the set `seed`; other arguments are those of `draw_cases`.

    Raises `InputError` as that does.

    Example:
        >>> from benchmarks.blindtest import draw_case
        >>> case = draw_case(0, seed=1, mix={"single": 1.0}, effects=["dead_time"], tiers=["easy"], seconds=20.0)
        >>> case.truth_name, case.tier
        ('dead_time', 'easy')
    """
    if set(tiers) - TIERS.keys() or not tiers:
        raise InputError(f"tiers: found {tuple(tiers)}, needs some of {', '.join(TIERS)}")
    if set(effects) - EFFECTS.keys() or not effects:
        raise InputError(f"effects: found {tuple(effects)}, needs some of {', '.join(EFFECTS)}")
    if set(signals) - set(SIGNALS) or not signals:
        raise InputError(f"signals: found {tuple(signals)}, needs accel, speed or both")
    if recorder not in get_args(Recording):
        raise InputError(f"recorder: found {recorder!r}, needs ideal or ordinary")
    mix, stops = MIX if mix is None else mix, recorder == "ordinary"
    case = _drawn(index, seed, mix, tiers, effects, outside, seconds, manoeuvre, signals, stops)
    if recorder == "ideal":
        return case
    # draws of its own: the drive is the same behind either recorder
    rng = np.random.default_rng([seed, index, 4])
    return replace(case, recorder=draw_recorder(rng, case.drive.rate_hz))


def _drawn(
    index: int,
    seed: int,
    mix: Mapping[str, float],
    tiers: Sequence[str],
    effects: Sequence[str],
    outside: Literal["sealed", "calibration"],
    seconds: float | None,
    manoeuvre: str | None,
    signals: Sequence[str],
    stops: bool,
) -> Case:
    """A case before its recorder is drawn."""
    kind, count = kind_of(index, seed, mix)
    rng = np.random.default_rng([seed, index, 3])
    group = SEALED if outside == "sealed" else CALIBRATION
    best: Case | None = None
    for attempt in range(5 * _ATTEMPTS):
        if attempt % _ATTEMPTS == 0:
            if best is not None and best.tier is not None:
                return best
            # first the cause that is due; after ten drives in which it is not visible, any other
            due = count if attempt == 0 else int(rng.integers(2**31))
            families, tier, count_of = _causes(kind, due, seed, rng, effects, tiers, group)
        case = _attempt(index, seed, kind, families, count_of, tier, rng, seconds, manoeuvre, signals, stops)
        if case is None:
            continue
        if kind in ("none", "pair", "several") or case.tier == tier:
            return case
        if best is None or case.visibility > best.visibility:
            best = case
    if best is None:
        raise InputError(f"effects: {', '.join(effects)} cannot be drawn in the drives asked for")
    return best


def _causes(
    kind: str,
    count: int,
    seed: int,
    rng: np.random.Generator,
    effects: Sequence[str],
    tiers: Sequence[str],
    group: Mapping[str, Family],
) -> tuple[list[Family], str, int]:
    """The causes of the `count`-th case of its kind, the tier of their visibility, and how many there will be."""
    if kind == "single":
        tier, effect = divmod(card(count, seed, len(effects) * len(tiers)), len(effects))
        return [EFFECTS[effects[effect]]], tiers[tier], 1
    if kind == "outside":
        tier, which = divmod(card(count, seed, len(group) * len(tiers)), len(group))
        return [list(group.values())[which]], tiers[tier], 1
    if kind == "pair":
        # lost messages are too faint for one half of a pair
        able = sorted(set(effects) - {"command_hold"})
        if len(able) < 2:
            raise InputError(f"effects: found {tuple(effects)}, pairs need two that are not command_hold")
        return [EFFECTS[str(name)] for name in sorted(rng.choice(able, 2, replace=False))], "pair", 2
    if kind == "several":
        families, wanted = draw_several(rng, effects, group)
        return families, "several", wanted
    return [], "none", 0


def _attempt(
    index: int,
    seed: int,
    kind: str,
    families: Sequence[Family],
    count: int,
    tier: str,
    rng: np.random.Generator,
    seconds: float | None,
    manoeuvre: str | None,
    signals: Sequence[str],
    stops: bool,
) -> Case | None:
    """A case of `count` causes on a newly drawn drive; None where the drive is unusable, or where one of a pair or too
    many of several cannot be visible on it."""
    car, drive = draw_car(rng), draw_drive(rng, seconds=seconds, manoeuvre=manoeuvre)
    if stops:
        drive = with_stops(drive)
    noise, late, when = int(rng.integers(2**31)), rng.random() < 0.5, float(rng.uniform(0.2, 0.7))
    if kind == "several" and late:
        # its moment may be before that of the others
        families = [f for f in families if f.name != "gain_change"]
    draws = {f.name: f.draw(rng, car, drive) for f in families}
    aims = {f.name: float(rng.random()) for f in families}
    # a random first strength: otherwise the first trial to fit would be the same in many cases
    begins = {f.name: float(np.exp(rng.uniform(-1, 1))) for f in families}
    if kind != "several" and any(f.suits and drive.manoeuvre not in f.suits for f in families):
        return None
    changes = "gain_change" in draws
    onset = round(when * drive.seconds * drive.rate_hz) / drive.rate_hz if late and families and not changes else 0.0

    pilots: list[Pilot] = []

    def made(effects: Parameters) -> tuple[Run, Sight]:
        pilots.append(drive.pilot())
        run = simulate(
            car, pilots[-1], seconds=drive.seconds, rate_hz=drive.rate_hz, effects=effects, onset=onset, seed=noise
        )
        return run, sight(run, signals)

    def at_strength(f: Family, strength: float) -> Trial:
        parameters = {f.name: draws[f.name](strength)}
        return parameters, *made(parameters)

    def alone(f: Family) -> Trial | None:
        """The effect by itself, at the strength that the tier requires."""
        low, high = excess_range(tier) if kind != "pair" else _PAIR_EXCESS
        aim = low * (high / low) ** (0.1 + 0.8 * aims[f.name])

        def trial(strength: float) -> tuple[float, Trial]:
            made_so = at_strength(f, strength)
            return made_so[2].excess, made_so

        # where it cannot reach the tier, keep its strongest form
        found = solve_strength(trial, aim, low, high, begin=begins[f.name], strongest=f.strongest)
        return found or (trial(f.strongest)[1] if kind != "pair" else None)

    if kind == "several":
        found = ordinary(rng, families, count, drive, at_strength, lambda trial: trial[2].excess)
    else:
        found = _all_of(families, alone)
    if found is None:
        return None
    parameters = {name: values for trial in found for name, values in trial[0].items()}
    # a case of one cause is the drive on which its strength was found
    run, fitted = found[0][1:] if len(found) == 1 else made(parameters)
    if not _sound(run, pilots[-1]):
        return None
    moment = parameters["gain_change"]["change_s"] if "gain_change" in parameters else (onset or None)
    case = Case(
        index=index,
        seed=seed,
        kind=kind,  # type: ignore[arg-type]
        names=tuple(sorted(parameters)),
        parameters=parameters,
        onset_s=moment,
        onset_scored=not ("gain_change" in parameters and len(parameters) > 1),
        visibility=fitted.most,
        visibility_each={name: trial[2].most for trial in found for name in trial[0]},
        tier=tier_of(fitted.most) if parameters else None,
        car=car,
        drive=drive,
        run=run,
        refit=fitted,
        oracles=oracles(run, fitted, predictable="command_hold" not in parameters),
        replay=Replay(run, car, parameters, onset, noise) if kind == "several" else None,
        signals=tuple(name for name in SIGNALS if name in signals),
    )
    return None if case.replay is not None and not _divisible(case, case.replay) else case


def _divisible(case: Case, replay: Replay) -> bool:
    """Whether several causes leave a gap to divide; gusts and glitches may drown the others."""
    gap = gap_over_floor(replay, case.log(signals=case.signals), case.refit.T_L, case.refit.K_L)
    return gap >= LEAST_GAP


def _all_of(families: Sequence[Family], alone: Callable[[Family], Trial | None]) -> list[Trial] | None:
    """The trial of each cause alone; None where one cannot be visible."""
    found: list[Trial] = []
    for f in families:
        trial = alone(f)
        if trial is None:
            return None
        found.append(trial)
    return found


def _sound(run: Run, pilot: Pilot) -> bool:
    """Whether a drive is usable: moves half of the time, stays below 44 m/s, no collision, no oscillation."""
    moving = np.mean(run.true_speed > 0.3) > 0.5
    hit = getattr(pilot, "nearest", 1.0) <= 0
    return bool(moving and not hit and run.true_speed.max() < _TOP_SPEED_MPS and np.abs(run.true_accel).max() < 9.0)
