"""The constants behind probabilities and alias sets, read from `calibration.json` beside this module.

``python -m benchmarks.fit_calibration`` writes that file. It gives each constant a unit, a meaning, and `by`: "fitted"
to simulated cases, or "chosen" beforehand. Its `provenance` names the cases and the results on them. Its `fingerprint`
holds log evidences that a test recomputes, so constants fitted to another likelihood are rejected.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from avtorch.errors import InputError

SCHEMA = "avtorch.calibration/1"
PATH = Path(__file__).with_name("calibration.json")

_PARTS = {"schema", "constants", "provenance", "fingerprint"}
_ENTRY = {"value", "unit", "by", "meaning"}
_BY = ("fitted", "chosen")
_NEEDS = {"float": "a finite number", "int": "a whole number above 0", "Scales": "a list of finite numbers"}

Scales = tuple[float, ...]


@dataclass(frozen=True)
class Odds:
    """Constants that turn log evidence into odds; `calibration.json` has meanings and units of all these fields."""

    effect: float
    second: float
    second_share: float
    second_by_chance: float
    second_by_chance_share: float
    unit: float
    unit_share: float
    power: float


@dataclass(frozen=True)
class UnknownWeights:
    """Weights of the logistic regression for `unknown`, in the order of `model_probabilities.signs`."""

    constant: float
    most: float
    against_gain: float
    gain: float
    none: float


@dataclass(frozen=True)
class AliasLimits:
    """Thresholds from which on two hypotheses count as the same answer."""

    ratio: float
    unknown_ratio: float


@dataclass(frozen=True)
class RemainderScales:
    """Sizes, times and numbers of basis functions used by `adequacy` to test residuals for structure."""

    sizes: Scales
    response_delays: int
    response_spacing: float
    response_decays: Scales
    speed_lag: float
    accel_knots: int
    speed_knots: int
    time_knots: int
    command_knots: int
    push_lags: Scales
    jerk_turns: Scales
    accel_turns: Scales
    drift_blocks: Scales
    drift_sizes: Scales
    line_from: float
    line_to: float
    line_sizes: Scales
    memory_order: int
    burst_lag: float
    burst_blocks: Scales
    burst_sizes: Scales


@dataclass(frozen=True)
class Calibration:
    """All constants, by purpose."""

    odds: Odds
    unknown: UnknownWeights
    alias_sets: AliasLimits
    remainder: RemainderScales

    @classmethod
    def read(cls, path: Path = PATH) -> Calibration:
        """Raises `InputError` for a file that is missing, has another schema, or lacks or adds a constant."""
        return cls.of(document(path)["constants"], str(path))

    @classmethod
    def of(cls, constants: Mapping[str, Any], where: str = "calibration") -> Calibration:
        """The constants from the file's `constants`: groups of entries with `value`, `unit`, `by` and `meaning`."""
        _same_keys(constants, {f.name for f in fields(cls)}, f"{where}: constants")
        return cls(
            odds=_group(Odds, constants["odds"], f"{where}: odds"),
            unknown=_group(UnknownWeights, constants["unknown"], f"{where}: unknown"),
            alias_sets=_group(AliasLimits, constants["alias_sets"], f"{where}: alias_sets"),
            remainder=_group(RemainderScales, constants["remainder"], f"{where}: remainder"),
        )


def document(path: Path = PATH) -> dict[str, Any]:
    """The whole file, with its sections checked. Raises `InputError` where it cannot be read or is not such a file."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as fault:
        raise InputError(f"{path}: cannot be read ({fault}); needs the file that avtorch ships") from None
    _same_keys(found, _PARTS, str(path))
    if found["schema"] != SCHEMA:
        raise InputError(f"{path}: found schema {found['schema']!r}, needs {SCHEMA!r}")
    return found


_Group = TypeVar("_Group", Odds, UnknownWeights, AliasLimits, RemainderScales)


def _group(kind: type[_Group], entries: Any, where: str) -> _Group:
    types = {f.name: str(f.type) for f in fields(kind)}
    _same_keys(entries, set(types), where)
    return kind(**{name: _value(entries[name], of, f"{where}.{name}") for name, of in types.items()})


def _value(entry: Any, of: str, where: str) -> Any:
    _same_keys(entry, _ENTRY, where)
    if entry["by"] not in _BY or not (isinstance(entry["unit"], str) and isinstance(entry["meaning"], str)):
        raise InputError(f"{where}: found by={entry['by']!r}, needs {' or '.join(_BY)}, and unit and meaning as text")
    value: Any = entry["value"]
    if of == "Scales":
        if isinstance(value, list) and value and all(map(_finite, value)):
            return tuple(map(float, value))
    elif of == "int" and _finite(value) and int(value) == value and value > 0:
        return int(value)
    elif of == "float" and _finite(value):
        return float(value)
    raise InputError(f"{where}: found {value!r}, needs {_NEEDS[of]}")


def _finite(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x)


def _same_keys(found: Any, needed: set[str], where: str) -> None:
    if not isinstance(found, dict):
        raise InputError(f"{where}: found {type(found).__name__}, needs an object with {', '.join(sorted(needed))}")
    missing, foreign = sorted(needed - found.keys()), sorted(found.keys() - needed)
    if missing or foreign:
        faults = [f"misses {', '.join(missing)}"] if missing else []
        faults += [f"has the unknown {', '.join(foreign)}"] if foreign else []
        raise InputError(f"{where}: {' and '.join(faults)}; needs {', '.join(sorted(needed))}")


CALIBRATION = Calibration.read()
"""The constants shipped with avtorch."""
