"""The folder of a fleet: rows of Parquet, one file a log and step, each with the key of what it was computed from."""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from avtorch.errors import InputError, quoted
from avtorch.fleet.log_list import KEY, LABEL, STATUS, FleetLog, marks_of
from avtorch.fleet.settings import STEPS, FleetSettings, Step
from avtorch.io import atomic, fingerprint
from avtorch.version import __version__

if TYPE_CHECKING:
    import os

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


REPORTS = "reports"
"""Below it, the reports of diagnosed logs."""


def task_key(step: Step, sha256: str | None, settings: FleetSettings) -> str:
    """What rows were computed from: the log's content, the settings of the step, and avtorch's version."""
    return fingerprint("avtorch.fleet/1", step, sha256, settings.of(step), __version__)


def label_of(log: FleetLog) -> dict[str, Any]:
    """What is known of a log beside its content."""
    return {"car": log.car, "log": log.shown, "date": log.date, "tags": dict(log.tags)}


@dataclass(frozen=True)
class FleetFolder:
    """Files below `root`: `checks`, `windows`, `diagnoses`, each appears whole or not at all."""

    root: Path

    def path(self, step: Step, log: FleetLog) -> Path:
        """Where the rows of a log are."""
        return self.root / DATASETS[step] / log.file_name

    def report(self, log: FleetLog) -> Path:
        """Where the report of a log is, if one was written: `reports/CAR/LOG/report.html`."""
        return self._report(log.car, log)

    def _report(self, car: str, log: FleetLog) -> Path:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", car)[:60].strip(".") or "car"
        return self.root / REPORTS / name / log.file_name.removesuffix(".parquet") / "report.html"

    def kept(self, step: Step, log: FleetLog, key: str) -> Status | None:
        """The status of rows that an earlier call computed from the same, None where there are none.

        Where the manifest names another car, date or tag since, they are written anew with these.
        """
        written = marks_of(self.path(step, log))
        if written.get(KEY) != key.encode() or STATUS not in written:
            return None
        status: Any = written[STATUS].decode()
        if written.get(LABEL) != _text(label_of(log)):
            rows = self.rows(step, log)
            if not rows:
                return None
            before, now = self._report(rows[0]["car"], log), self.report(log)
            if step == "diagnose" and before != now and before.is_file():
                now.parent.mkdir(parents=True, exist_ok=True)
                before.replace(now)
            self._write(step, log, key, [row | label_of(log) for row in rows], status)
        return status

    def has_answer(self, step: Step, log: FleetLog) -> bool:
        """Whether there are rows of an answer, from whatever content and settings."""
        return marks_of(self.path(step, log)).get(STATUS) == b"done"

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

        Raises `InputError` where that cannot be done.
        """
        known = label_of(log) | {"sha256": sha256, "version": __version__, "seconds": seconds}
        full = labelled(rows, known)
        status: Status = full[0]["status"]
        if step == "diagnose":
            self._write_report(log, report)
        self._write(step, log, key, full, status)
        return status

    def _write_report(self, log: FleetLog, report: str | None) -> None:
        """In place of an earlier one, which was of another answer."""
        if report is None:
            self.report(log).unlink(missing_ok=True)
            return
        self.report(log).parent.mkdir(parents=True, exist_ok=True)
        with atomic(self.report(log)) as stream:
            stream.write(report)

    def _write(self, step: Step, log: FleetLog, key: str, rows: list[Row], status: Status) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        for row in rows:
            row["tags"] = list(dict(row["tags"] or {}).items())
        about = {KEY: key.encode(), LABEL: _text(label_of(log)), STATUS: status.encode()}
        table = pa.Table.from_pylist(rows, schema=schema(step)).replace_schema_metadata(about)
        buffer = io.BytesIO()
        pq.write_table(table, buffer)
        with atomic(self.path(step, log), binary=True) as stream:
            stream.write(buffer.getvalue())

    def rows(self, step: Step, log: FleetLog, columns: list[str] | None = None) -> list[Row]:
        """The rows of a log; none where there are none."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            return pq.ParquetFile(self.path(step, log)).read(columns=columns).to_pylist()
        except (OSError, pa.ArrowException):
            return []

    def others(self, logs: list[FleetLog]) -> int:
        """Number of logs with rows here that are not among `logs`."""
        names = {log.file_name for log in logs}
        there = {p.name for step in STEPS for p in (self.root / DATASETS[step]).glob("*.parquet")}
        return len(there - names)


def _text(label: Mapping[str, Any]) -> bytes:
    return json.dumps(label, sort_keys=True).encode()


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

    step = next((step for step, name in DATASETS.items() if name == dataset), None)
    if step is None:
        raise InputError(f"dataset: found {quoted(dataset)}, needs {', '.join(DATASETS.values())}")
    # a folder that another process writes to holds files of passing names, which begin with a dot
    files = sorted(p for p in (Path(out) / dataset).glob("*.parquet") if not p.name.startswith("."))
    if not files:
        raise InputError(f"{Path(out) / dataset}: has no rows; needs the --out of avtorch fleet")
    try:
        return pa.concat_tables(pq.ParquetFile(file).read().replace_schema_metadata() for file in files)
    except (OSError, pa.ArrowException) as fault:
        raise InputError(f"{Path(out) / dataset}: is damaged ({fault}); run avtorch fleet again") from None
