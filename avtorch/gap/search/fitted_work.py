"""Identity of a set of fits, for the file that stores them: the logs and every setting that changes a fit.

A fit does not depend on the prior over causes, on the method and seed of the winner's posterior, or on a budget, so a
search with other values of these continues from the same file.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import fields
from types import CodeType
from typing import Any

from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log, fingerprint
from avtorch.version import __version__

_SIGNALS = ("time", "accel_cmd", "accel", "speed", "engaged", "grade", "segment")


def fitted_work(
    logs: Sequence[Log], baseline: GapPlant, effects: Sequence[type[Effect]], *, pairs: bool
) -> dict[str, Any]:
    """The identity, from the content of the logs whatever their columns or files are called; as JSON."""
    return {
        "avtorch": __version__,
        "logs": [
            {"name": log.name, "rows": log.rows, "sha256": fingerprint([getattr(log, name) for name in _SIGNALS])}
            for log in logs
        ],
        "accel_kind": sorted({log.accel_kind for log in logs}),
        "baseline": _in_words(baseline),
        "baseline_sha256": fingerprint(
            baseline.T_L, baseline.K_L, baseline.sigma, [(_effect(type(e)), e) for e in baseline.effects]
        ),
        "effects": [effect.name for effect in effects],
        "effects_sha256": fingerprint([_effect(effect) for effect in effects]),
        "pairs": pairs,
    }


def difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """The differences in words; None if there are none."""
    if set(before) != set(now):
        return "other kinds of settings"
    if before["avtorch"] != now["avtorch"]:
        return f"avtorch {_short(before['avtorch'])}, not {now['avtorch']}"
    if _contents(before["logs"]) != _contents(now["logs"]):
        return f"other logs ({_logs(before['logs'])})"
    for name in ("accel_kind", "baseline", "effects", "pairs"):
        if before[name] != now[name]:
            return f"{name} {_short(before[name])}"
    if before["baseline_sha256"] != now["baseline_sha256"]:
        return f"another baseline of the same description ({_short(before['baseline'])})"
    if before["effects_sha256"] != now["effects_sha256"]:
        return "an effect of the same name and other code"
    return None


def _effect(effect: type[Effect]) -> list[Any]:
    """A class by name; one from outside avtorch also by its source, which its author may have changed."""
    if effect.__module__.split(".")[0] == "avtorch":
        return [effect]
    own = [cls for cls in effect.__mro__ if cls.__module__.split(".")[0] not in ("avtorch", "builtins")]
    return [effect.name, [_source(cls) for cls in own]]


def _source(cls: type) -> str:
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):  # defined in an interpreter
        own = {name: x for name, x in vars(cls).items() if not name.startswith("__")}
        return fingerprint({name: _code(x.__code__) if inspect.isfunction(x) else repr(x) for name, x in own.items()})


def _code(code: CodeType) -> list[Any]:
    inner = [_code(x) if isinstance(x, CodeType) else repr(x) for x in code.co_consts]
    return [code.co_code, list(code.co_names), inner]


def _in_words(baseline: GapPlant) -> str:
    """The baseline in one line."""
    values = [f"{name}={x:g}" for name in ("T_L", "K_L") if isinstance(x := getattr(baseline, name), (int, float))]
    for effect in baseline.effects:
        given = [(f.name, getattr(effect, f.name)) for f in fields(effect)]
        arguments = [f"{name}={x:g}" for name, x in given if isinstance(x, (int, float)) and not isinstance(x, bool)]
        values.append(f"{effect.name}({', '.join(arguments)})")
    return ", ".join(values)


def _contents(logs: Any) -> Any:
    return [log.get("sha256") if isinstance(log, dict) else None for log in logs] if isinstance(logs, list) else logs


def _logs(logs: Any) -> str:
    if not isinstance(logs, list):
        return "none"
    return _short(", ".join(f"{x.get('name')}, {x.get('rows')} rows" for x in logs if isinstance(x, dict)))


def _short(x: Any) -> str:
    """The value in one line, shortened."""
    text = ", ".join(map(str, x)) if isinstance(x, list) else str(x)
    text = "".join(c for c in text if c.isprintable())
    return text if len(text) <= 200 else text[:197] + "..."
