"""The facts of an answer that are kept: small plain dicts, read from what the public objects state of themselves."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

T = TypeVar("T")
Answer = dict[str, Any]
NOTHING = ("none", "unknown")


def timed(work: Callable[[], T]) -> tuple[T, Answer]:
    """What `work` returns, with its `seconds` and processor seconds `cpu`, those of processes it started among them."""
    begun, before = time.perf_counter(), os.times()
    found = work()
    after = os.times()
    return found, {"seconds": time.perf_counter() - begun, "cpu": sum(after[:4]) - sum(before[:4])}


def diagnosis_facts(answer: Mapping[str, Any]) -> Answer:
    """Of the object of `diagnosis.json`."""
    verdict, effects = answer["verdict"], sorted(answer["effects"], key=lambda e: -e["probability"])
    by_name = {e["name"]: e for e in effects}
    name = "+".join(sorted(verdict["names"]))
    shrinkage = answer.get("shrinkage") or {}
    facts: Answer = {
        "verdict": list(verdict["names"]),
        "partial": bool(verdict.get("partial")),
        "aliases": [x for x in verdict["alias_set"] if x != name],
        "top": [[e["name"], e["probability"]] for e in effects[:5]],
        "p_unknown": by_name.get("unknown", {}).get("probability", 0.0),
        "p_none": by_name.get("none", {}).get("probability", 0.0),
        "baseline": _means(answer["baseline"]),
        "onset_s": answer.get("onset_s"),
        "closed": (shrinkage.get("closed") or {}).get("mean"),
    }
    parameters = _means(by_name.get(name, {}).get("parameters") or {})
    if len(verdict["names"]) == 1:
        parameters = {f"{name}.{key}": value for key, value in parameters.items()}
    return facts | _budget(answer.get("budget"), parameters)


def _budget(budget: Mapping[str, Any] | None, parameters: Answer) -> Answer:
    if budget is None:
        return {"parameters": parameters, "budget": None}
    parts = [*budget["parts"], *budget["chance"]]
    for part in parts:
        own = {f"{part['names'][0]}.{key}": value for key, value in _means(part.get("parameters") or {}).items()}
        parameters = own | parameters
    rest = budget["unexplained"]
    kept = {
        "before": budget["before"],
        "left": budget["left"],
        "parts": [
            {
                "name": "+".join(part["names"]),
                "p": part["probability"],
                "share": part["share"]["mean"] if part.get("share") else None,
                "share_of_noise": part.get("share_of_noise"),
                "onset_s": part.get("onset_s"),
            }
            for part in parts
        ],
        "unexplained": {**rest["share"], "material": rest["material"], "resembles": rest.get("resembles")},
    }
    for part in kept["parts"]:
        for key in [key for key, value in part.items() if value is None]:
            del part[key]
    return {"parameters": parameters, "budget": kept}


def tested_facts(answer: Mapping[str, Any]) -> Answer:
    """What a diagnosis says of the user's own simulator."""
    tested = answer["simulator"]
    return {
        "missing": list(tested["missing"]),
        "wrong": {p["name"]: [p["simulator"], p["car"]["mean"]] for p in tested["parameters"] if p["differs"]},
        "surrogate": sorted(tested["surrogate"]["effects"]),
        "rollout": dict(tested["rollout_10s"]),
        "rollouts": tested["rollouts"],
    }


def comparison_facts(answer: Mapping[str, Any]) -> Answer:
    """Of the object of `comparison.json`, of two sets of drives."""
    cause = answer["cause"] or {"answer": "too short", "names": [], "parts": [], "alias_set": []}
    return {
        "verdict": list(cause["names"]) or ["unknown" if cause["answer"] == "unknown" else "none"],
        "aliases": [x for x in cause["alias_set"] if x not in cause["names"]],
        "top": [["+".join(p["names"]), p["probability"]] for p in cause["parts"][:5]],
        "parameters": {f"{p['names'][0]}.{k}": q["mean"] for p in cause["parts"] for k, q in p["parameters"].items()},
        "more": {
            "answer": cause["answer"],
            "changed": answer["changed"],
            "p_value": answer["p_value"],
            "simulator": answer["simulator"],
            **{f"{key} after/before": moved["ratio"]["mean"] for key, moved in answer["car"].items()},
            **{f"{key} after/before": moved["ratio"]["mean"] for key, moved in answer["gap"].items()},
            **{f"least {key} that would show": value for key, value in (cause.get("detectable") or {}).items()},
        },
    }


def _means(quantities: Mapping[str, Any]) -> Answer:
    return {key: value["mean"] if isinstance(value, Mapping) else value for key, value in quantities.items()}


def rounded(x: Any) -> Any:
    """The same with four digits; no number that JSON does not have."""
    if isinstance(x, Mapping):
        return {key: rounded(value) for key, value in x.items()}
    if isinstance(x, list | tuple):
        return [rounded(value) for value in x]
    if isinstance(x, float):
        return float(f"{x:.4g}") if abs(x) < float("inf") else None
    return x


def score(answer: Mapping[str, Any]) -> tuple[bool, int, int] | None:
    """Whether a verdict is the truth, how many true names it has, and how many too many; None where no truth is known.

    Where a cause outside the table is among several, `unknown` beside the names is none too many.
    """
    truth = answer.get("truth")
    if truth is None:
        return None
    if "verdict" not in answer:
        return False, 0, 0
    named, true = set(answer["verdict"]), set(truth["names"])
    if truth.get("outside"):
        named = named - {"unknown"} if named - {"unknown"} and true != {"unknown"} else named
    return named == true, len((named & true) - {"none"}), len(named - true - set(NOTHING))
