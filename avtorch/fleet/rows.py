"""The rows of a fleet's answer: their columns, and how an answer of one log becomes rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from avtorch.fleet.settings import Step

if TYPE_CHECKING:
    import pyarrow as pa

    from avtorch.decision.estimation import Estimates
    from avtorch.gap.result.diagnosis import Diagnosis
    from avtorch.logcheck.check import LogCheck

Status = Literal["done", "failed", "crashed"]
"""`failed`: the log cannot be used, and the row says why. `crashed`: the work ended without an answer, perhaps for want
of memory; the next call tries it again."""

DATASETS: dict[Step, str] = {"check": "checks", "estimate": "windows", "diagnose": "diagnoses"}
"""The folder of each step's rows."""

Row = dict[str, Any]


def schema(step: Step) -> pa.Schema:
    """The columns of a dataset; those of all datasets come first."""
    import pyarrow as pa

    text, number, whole, flag = pa.string(), pa.float64(), pa.int64(), pa.bool_()
    texts = pa.list_(text)

    def interval(name: str) -> list[tuple[str, pa.DataType]]:
        return [(f"{name}_{part}", number) for part in ("mean", "q05", "q95")]

    def quantity(name: str) -> list[tuple[str, pa.DataType]]:
        return [(f"{name}_{part}", number) for part in ("mean", "sd", "q05", "q95")]

    named = pa.list_(pa.struct([("name", text), *quantity("value")]))
    cause = [("name", text), ("probability", number), *interval("share"), ("alias_set", texts)]
    cause += [("onset_s", number), ("plausible", flag), ("parameters", named)]
    chance = [("name", text), ("probability", number), ("share_of_noise", number)]
    own: dict[Step, list[tuple[str, pa.DataType]]] = {
        "check": [
            *(("form", text), ("rows", whole), ("duration_s", number), ("rate_hz", number), ("segments", whole)),
            *(("masked_rows", whole), ("missing", texts), ("follows", flag), ("mapping_needed", flag)),
            ("notes", texts),
        ],
        "estimate": [
            *(("window", whole), ("begin_s", number), ("end_s", number), ("rows", whole)),
            *(("excited", flag), ("used", flag), *quantity("T_L"), *quantity("K_L"), ("noise", named)),
            *(("p_string_stable", number), ("alerts", texts)),
            *(("form", text), ("estimator", text), ("dead_time_s", number), ("note", text)),
        ],
        "diagnose": [
            *(("verdict", texts), ("probability", number), ("alias_set", texts), ("abstained", flag)),
            *(("causes", pa.list_(pa.struct(cause))), ("chance", pa.list_(pa.struct(chance)))),
            *(*interval("unexplained"), ("unexplained_material", flag), ("gap_detected", flag)),
            *(("gap_before", number), ("gap_left", number), ("rmse_accel_mps2", number), ("rmse_speed_mps", number)),
            *(*quantity("T_L"), *quantity("K_L"), ("complete", flag), ("summary", text), ("notes", texts)),
            ("answer", text),
        ],
    }
    common = [("car", text), ("log", text), ("date", text), ("tags", pa.map_(text, text)), ("sha256", text)]
    common += [("version", text), ("status", text), ("error", text), ("seconds", number)]
    return pa.schema([*common, *own[step]])


def check_rows(found: LogCheck) -> list[Row]:
    """One row; `failed` where the log cannot be read."""
    row: Row = {"form": found.form, "follows": found.follows, "notes": list(found.notes)}
    row["mapping_needed"] = found.proposal is not None and found.proposal.needed
    if found.quality is not None:
        seen = found.quality
        row |= {"rows": seen.rows, "duration_s": seen.seconds, "rate_hz": seen.rate_hz, "segments": seen.segments}
        row |= {"masked_rows": seen.masked_rows, "missing": list(seen.missing)}
    if found.fault is not None:
        row |= {"status": "failed", "error": found.fault}
    return [row]


def window_rows(found: Estimates, note: str | None) -> list[Row]:
    """One row a window, in order. `note`: on the map that made the command, where one did."""
    from avtorch.results import window_entry

    of_log = {"form": found.form, "estimator": found.estimator, "dead_time_s": found.dead_time, "note": note}
    rows = []
    for number, watched in enumerate(found.windows):
        entry = window_entry(watched)
        noise = entry.get("noise") or {"sigma": entry["sigma"]}
        row = {"window": number, "begin_s": entry["start_s"], "end_s": entry["end_s"], "rows": entry["n"]}
        row |= {key: entry[key] for key in ("excited", "used", "alerts", "p_string_stable")}
        row |= _quantity("T_L", entry["T_L"]) | _quantity("K_L", entry["K_L"])
        rows.append(row | {"noise": _named(noise)} | of_log)
    return rows


def diagnosis_rows(found: Diagnosis, note: str | None) -> list[Row]:
    """One row. Without a budget (drives too short to hold out blocks) shares and what is unexplained are null."""
    from avtorch.io.answers import json_text

    answer = found.to_dict()
    verdict, budget, gap = answer["verdict"], answer["budget"], answer["gap"]["rollout"]
    row: Row = {key: verdict[key] for key in ("alias_set", "abstained")}
    row |= {"verdict": verdict["names"], "probability": found.winner.probability, "complete": found.complete}
    row |= {"gap_detected": found.gap.detected, "summary": str(found).splitlines()[0]}
    row |= {"rmse_accel_mps2": gap["rmse_accel"], "rmse_speed_mps": gap["rmse_speed"]}
    row |= {"notes": [*found.notes, *([] if note is None else [note])], "answer": json_text(answer, indent=None)}
    repaired = found.baseline if found.budget is None else found.budget.repaired
    for name in ("T_L", "K_L"):
        if name in repaired:
            row |= _quantity(name, repaired[name].to_dict())
    if budget is None:
        single = [
            e for e in answer["effects"] if verdict["names"] == [e["name"]] and e["name"] not in ("none", "unknown")
        ]
        row["causes"] = [_cause(part) for part in single]
        return [row]
    unexplained = budget["unexplained"]
    row |= {"gap_before": budget["before"], "gap_left": budget["left"]}
    row |= {"unexplained_material": unexplained["material"], **_interval("unexplained", unexplained["share"])}
    row["causes"] = [_cause({"name": part["names"][0], **part}) for part in budget["parts"]]
    kept = ("probability", "share_of_noise")
    row["chance"] = [{"name": part["names"][0], **{key: part[key] for key in kept}} for part in budget["chance"]]
    return [row]


def _cause(part: Mapping[str, Any]) -> Row:
    share = part.get("share") or {}
    row = {key: part.get(key) for key in ("name", "probability", "onset_s", "plausible")}
    row |= {"alias_set": list(part.get("alias_set") or ()), "parameters": _named(part["parameters"])}
    return row | _interval("share", share)


def _interval(name: str, share: Mapping[str, float]) -> Row:
    return {f"{name}_{part}": share.get(part) for part in ("mean", "q05", "q95")}


def _quantity(name: str, stats: Mapping[str, float]) -> Row:
    return {f"{name}_{part}": stats.get(part) for part in ("mean", "sd", "q05", "q95")}


def _named(stats: Mapping[str, Mapping[str, float]]) -> list[Row]:
    return [{"name": name, **_quantity("value", values)} for name, values in stats.items()]


def failure_rows(status: Status, why: str) -> list[Row]:
    """The one row of a log without an answer."""
    return [{"status": status, "error": why}]


def labelled(rows: Sequence[Row], label: Mapping[str, Any]) -> list[Row]:
    """Rows with what is known of their log; those without a status are done."""
    return [{"status": "done", **row, **label} for row in rows]
