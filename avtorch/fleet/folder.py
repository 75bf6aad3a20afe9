"""The folder of a fleet: one Parquet file a log and step, each with the key of what it was computed from."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avtorch.errors import InputError, quoted
from avtorch.fleet.log_list import FleetLog
from avtorch.fleet.marks import KEY, LABEL, STATUS, marks_of
from avtorch.fleet.rows import DATASETS, Row, Status, labelled, schema
from avtorch.fleet.settings import STEPS, FleetSettings, Step
from avtorch.io import atomic, fingerprint
from avtorch.version import __version__

if TYPE_CHECKING:
    import os

    import pyarrow as pa

REPORTS = "reports"
"""Below it, the reports of diagnosed logs."""

UNFINISHED = "unfinished"
"""Below it, what killed or interrupted tasks had finished; removed once all is done."""


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

    def checkpoints(self) -> Path:
        """The folder of checkpoints, made if it is missing."""
        place = self.root / UNFINISHED
        place.mkdir(parents=True, exist_ok=True)
        return place

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

    def clear(self) -> None:
        """Remove the checkpoints: everything is done."""
        shutil.rmtree(self.root / UNFINISHED, ignore_errors=True)


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
