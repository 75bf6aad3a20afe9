"""The folder of a fleet: rows of Parquet, one file a log and step, each with the key of what it was computed from."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, variance
from typing import TYPE_CHECKING, Any, Literal

from avtorch.errors import InputError, quoted
from avtorch.fleet.log_list import KEY, FleetLog, key_of
from avtorch.fleet.settings import STEPS, FleetSettings, Step
from avtorch.io import atomic, fingerprint
from avtorch.version import __version__

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

INTERVAL, STATS = ("mean", "q05", "q95"), ("mean", "sd", "q05", "q95")


def schema(step: Step) -> pa.Schema:
    """The columns of a dataset; those of all datasets come first."""
    import pyarrow as pa

    text, number, whole, flag = pa.string(), pa.float64(), pa.int64(), pa.bool_()
    texts = pa.list_(text)

    def numbers(name: str, parts: Sequence[str] = STATS) -> list[tuple[str, pa.DataType]]:
        return [(f"{name}_{part}", number) for part in parts]

    named = pa.list_(pa.struct([("name", text), *numbers("value")]))
    cause = [("name", text), ("probability", number), *numbers("share", INTERVAL), ("alias_set", texts)]
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
            *(("excited", flag), ("used", flag), *numbers("T_L"), *numbers("K_L"), ("noise", named)),
            *(("p_string_stable", number), ("alerts", texts)),
            *(("form", text), ("estimator", text), ("dead_time_s", number), ("note", text)),
        ],
        "diagnose": [
            *(("verdict", texts), ("probability", number), ("alias_set", texts), ("abstained", flag)),
            *(("causes", pa.list_(pa.struct(cause))), ("chance", pa.list_(pa.struct(chance)))),
            *(*numbers("unexplained", INTERVAL), ("unexplained_material", flag), ("gap_detected", flag)),
            *(("gap_before", number), ("gap_left", number), ("rmse_accel_mps2", number), ("rmse_speed_mps", number)),
            *(*numbers("T_L"), *numbers("K_L"), ("complete", flag), ("summary", text), ("notes", texts)),
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
        row |= _numbers("T_L", entry["T_L"]) | _numbers("K_L", entry["K_L"])
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
            row |= _numbers(name, repaired[name].to_dict())
    if budget is None:
        named = [name for name in verdict["names"] if name not in ("none", "unknown")]
        row["causes"] = [_cause(effect) for effect in answer["effects"] if named == [effect["name"]]]
        return [row]
    unexplained = budget["unexplained"]
    row |= {"gap_before": budget["before"], "gap_left": budget["left"]}
    row |= {"unexplained_material": unexplained["material"], **_numbers("unexplained", unexplained["share"], INTERVAL)}
    row["causes"] = [_cause({"name": part["names"][0], **part}) for part in budget["parts"]]
    kept = ("probability", "share_of_noise")
    row["chance"] = [{"name": part["names"][0], **{key: part[key] for key in kept}} for part in budget["chance"]]
    return [row]


def _cause(part: Mapping[str, Any]) -> Row:
    row = {key: part.get(key) for key in ("name", "probability", "onset_s", "plausible")}
    row |= {"alias_set": list(part.get("alias_set") or ()), "parameters": _named(part["parameters"])}
    return row | _numbers("share", part.get("share") or {}, INTERVAL)


def _numbers(name: str, stats: Mapping[str, float], parts: Sequence[str] = STATS) -> Row:
    return {f"{name}_{part}": stats.get(part) for part in parts}


def _named(stats: Mapping[str, Mapping[str, float]]) -> list[Row]:
    return [{"name": name, **_numbers("value", values)} for name, values in stats.items()]


QUANTITIES = ("T_L", "K_L")

Drive = Mapping[str, tuple[float, float]]
"""What a drive says: mean and standard deviation of the coordinate of each quantity."""

LEAST_SD = 1e-3
"""Of a coordinate: no drive tells a lag or the size of an effect better than to a thousandth."""


def drive_belief(used: Sequence[Row]) -> Drive | None:
    """What the used windows of a drive say of log T_L and log K_L; None where an estimator gives no SD.

    The standard deviation of their mean is by what the windows differ by, or by what their posteriors say, whichever is
    more. What windows of a drive have in common is the spread from drive to drive.
    """
    if not used:
        return None
    found = {}
    for name in QUANTITIES:
        stats = [(row[f"{name}_mean"], row[f"{name}_sd"]) for row in used]
        if any(x is None or not math.isfinite(x) for both in stats for x in both) or min(stats)[0] <= 0:
            return None
        variances = [math.log1p((sd / mean) ** 2) for mean, sd in stats]
        means = [math.log(mean) - v / 2 for (mean, _), v in zip(stats, variances, strict=True)]
        spread = variance(means) if len(means) > 1 else 0.0
        found[name] = (fmean(means), max(math.sqrt(max(spread, fmean(variances)) / len(means)), LEAST_SD))
    return found


def failure_rows(status: Status, why: str) -> list[Row]:
    """The one row of a log without an answer."""
    return [{"status": status, "error": why}]


def task_key(step: Step, sha256: str | None, settings: FleetSettings) -> str:
    """What rows were computed from: the log's content, the settings of the step, and avtorch's version."""
    return fingerprint("avtorch.fleet/1", step, sha256, settings.of(step), __version__)


def _label(log: FleetLog) -> Row:
    """What is known of a log beside its content."""
    return {"car": log.car, "log": log.shown, "date": log.date, "tags": dict(log.tags)}


@dataclass(frozen=True)
class FleetFolder:
    """Files below `root`: `checks`, `windows`, `diagnoses`, `reports`, each appears whole or not at all."""

    root: Path

    def path(self, step: Step, log: FleetLog) -> Path:
        """Where the rows of a log are."""
        return self.root / DATASETS[step] / f"{log.name}.parquet"

    def report(self, log: FleetLog) -> Path:
        """Where the report of a log is, if one was written: `reports/LOG.html`."""
        return self.root / "reports" / f"{log.name}.html"

    def kept(self, step: Step, log: FleetLog, key: str) -> Status | None:
        """The status of rows that an earlier call computed from the same, None where there are none.

        Where the manifest names another car, date or tag since, they are written anew with these.
        """
        label = _label(log)
        if key_of(self.path(step, log)) != key.encode() or not (rows := self.rows(step, log, ["status", *label])):
            return None
        if {name: rows[0][name] for name in label} != label:
            self._write(step, log, key, [row | label for row in self.rows(step, log)])
        return rows[0]["status"]

    def has_answer(self, step: Step, log: FleetLog) -> bool:
        """Whether there are rows of an answer, from whatever content and settings."""
        return {"status": "done"} in self.rows(step, log, ["status"])

    def write(
        self,
        step: Step,
        log: FleetLog,
        key: str,
        rows: list[Row],
        *,
        sha256: str | None,
        seconds: float,
        report: str | None = None,
    ) -> Status:
        """Write the rows of a log in place of earlier ones, with the `report` of a diagnosis; returns their status.

        Rows without a status are done. Raises `InputError` where that cannot be done.
        """
        known = _label(log) | {"sha256": sha256, "version": __version__, "seconds": seconds}
        full = [{"status": "done", **row, **known} for row in rows]
        if report is not None:
            with atomic(self.report(log)) as stream:
                stream.write(report)
        elif step == "diagnose":  # an earlier one is of another answer
            self.report(log).unlink(missing_ok=True)
        self._write(step, log, key, full)
        return full[0]["status"]

    def _write(self, step: Step, log: FleetLog, key: str, rows: list[Row]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        for row in rows:
            row["tags"] = list(row["tags"].items())
        buffer = io.BytesIO()
        table = pa.Table.from_pylist(rows, schema=schema(step))
        pq.write_table(table.replace_schema_metadata({KEY: key.encode()}), buffer)
        with atomic(self.path(step, log), binary=True) as stream:
            stream.write(buffer.getvalue())

    def rows(self, step: Step, log: FleetLog, columns: list[str] | None = None) -> list[Row]:
        """The rows of a log; none where there are none."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            table = pq.ParquetFile(self.path(step, log)).read(columns=columns)
        except (OSError, pa.ArrowException):
            return []
        return table.to_pylist(maps_as_pydicts="strict")

    def others(self, logs: list[FleetLog]) -> int:
        """Number of logs with rows here that are not among `logs`."""
        there = {p.stem for step in STEPS for p in (self.root / DATASETS[step]).glob("*.parquet")}
        return len(there - {log.name for log in logs})


def read_rows(out: str | os.PathLike[str], dataset: str) -> pa.Table:
    """The rows of a fleet: `checks`, `windows` (one a window) or `diagnoses` (one a log), as an Arrow table.

    A log that failed has one row, whose `status` is not "done" and whose `error` says why; its other columns are null.
    The folders are Parquet datasets, which pandas, Polars, DuckDB and Spark read as well. Raises `InputError` for
    another name, and where the folder has no such rows.

    Example:
        >>> from avtorch import GLVDPlant, Leader, simulate
        >>> from avtorch.fleet import FleetSettings, read_rows, run_fleet
        >>> simulate(Leader.default(start=30.0, duration=20.0, dt=0.05), plant=GLVDPlant(0.4, 0.9)).log().write("a.csv")
        >>> _ = run_fleet("a.csv", "out", settings=FleetSettings(steps=("check",)), workers=1)
        >>> read_rows("out", "checks").select(["car", "status", "rows"]).to_pylist()
        [{'car': 'a', 'status': 'done', 'rows': 400}]
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if dataset not in DATASETS.values():
        raise InputError(f"dataset: found {quoted(dataset)}, needs {', '.join(DATASETS.values())}")
    folder = Path(out) / dataset
    # a folder that another process writes to holds files of passing names, which begin with a dot
    files = sorted(folder.glob("[!.]*.parquet"))
    if not files:
        raise InputError(f"{folder}: has no rows; needs the --out of avtorch fleet")
    try:
        return pa.concat_tables(pq.ParquetFile(file).read().replace_schema_metadata() for file in files)
    except (OSError, pa.ArrowException) as fault:
        raise InputError(f"{folder}: is damaged ({fault}); run avtorch fleet again") from None
