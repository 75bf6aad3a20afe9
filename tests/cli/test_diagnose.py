"""`avtorch diagnose`: what it passes on, prints and writes, and one line for input it cannot use.

The search has its own tests; here a stub replaces it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from avtorch.cli import main
from avtorch.cli.diagnose import print_diagnosis
from avtorch.cli.talk import Talk, drawn
from avtorch.errors import InputError
from avtorch.gap import EFFECTS, DeadTime, GapPlant, plant
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.gap_size import GapSize
from avtorch.gap.result.hypotheses import Candidate
from avtorch.gap.result.log_facts import LogFacts
from avtorch.io import Log, read_answer
from avtorch.report.diagnosis_tables import candidate_table
from tests.gap.verdicts import near, verdict_of

ROWS = 600


def around(mean: float, sd: float) -> Quantity:
    return Quantity(mean, sd, mean - 1.645 * sd, mean + 1.645 * sd)


BASELINE = {"T_L": around(0.52, 0.01), "K_L": around(1.02, 0.01)}
MOVED = {"T_L": around(0.31, 0.01), "K_L": around(0.99, 0.01)}
CANDIDATES = (
    Candidate("dead_time", 0.93, 1234.2, {"delay_s": around(0.182, 0.004)}, MOVED),
    Candidate("second_order_actuator", 0.04, 1230.1, {"natural_frequency_radps": around(6.1, 0.3)}, MOVED),
    Candidate(
        "backlash+dead_band",
        0.02,
        1200.0,
        {"backlash.half_width_mps2": around(0.1, 0.01), "dead_band.half_width_mps2": around(-0.2, 0.02)},
        MOVED,
    ),
    Candidate("none", 1e-5, 0.0),
    Candidate("unknown", 0.01),
)


def answer(logs: Sequence[Log], candidates: tuple[Candidate, ...] = CANDIDATES, **more: Any) -> Diagnosis:
    gap = GapSize(True, 1e-9, 0.08, 0.05, 0.21, 0.05, 0.9, 5.0)
    given = {"verdict": verdict_of(candidates), "plant": plant([DeadTime(0.182)]), **more}
    return Diagnosis(LogFacts.of(logs), BASELINE, gap, candidates, **given)


class Search:
    """A stub of `avtorch.gap.diagnose`: records its arguments, tells its steps, and answers."""

    def __init__(self) -> None:
        self.calls: list[dict[str, Any]] = []
        self.more: dict[str, Any] = {}

    def diagnose(self, logs: list[Log], *, progress: Callable, **given: Any) -> Diagnosis:
        self.calls.append({"logs": logs, **given})
        for k in range(4):
            progress("effects", k, 4)
        return answer(logs, **self.more)


@pytest.fixture
def search(monkeypatch: pytest.MonkeyPatch) -> Search:
    stand_in = Search()
    module = ModuleType("avtorch.gap.diagnose")
    module.diagnose = stand_in.diagnose  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "avtorch.gap.diagnose", module)
    return stand_in


def columns(phase: float = 0.0) -> dict[str, np.ndarray]:
    time = np.arange(ROWS) * 0.02
    return {
        "time": time,
        "accel_cmd": np.sin(time + phase),
        "accel": np.sin(time + phase - 0.3),
        "speed": 15 - np.cos(time + phase - 0.3),
    }


def write(path: Path, **signals: np.ndarray | None) -> str:
    given = {name: values for name, values in signals.items() if values is not None}
    lines = [
        ",".join(given),
        *(",".join(map(repr, row)) for row in zip(*(x.tolist() for x in given.values()), strict=True)),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


@pytest.fixture
def drive(tmp_path: Path) -> str:
    return write(tmp_path / "drive.csv", **columns())


@pytest.fixture
def other(tmp_path: Path) -> str:
    return write(tmp_path / "other.csv", **columns(phase=1.0))


# --- what it hands on and writes


def test_files_and_words(
    search: Search, drive: str, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "er"
    assert main(["diagnose", drive, other, "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    sentence, table = told.out.split("\n\n")[:2]
    assert "The simulator lacks this (probability 0.93): commands act" in " ".join(sentence.split())
    assert table.split()[0] == "hypothesis"
    assert f"Written to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}\n" in told.out
    assert "T_L 0.52" not in told.out
    assert main(["diagnose", drive, other, "--out", str(out), "--verbose"]) == 0
    told = capsys.readouterr()
    assert "drive.csv" in told.out
    assert "other.csv" in told.out
    assert "T_L 0.52 → 0.31 s, K_L 1.02 → 0.99" in told.out
    written = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert written["schema"] == "avtorch.diagnosis/1"  # as its stand-in for the search has no budget
    assert written["log"]["rows"] == 2 * ROWS
    repaired = GapPlant.from_toml((out / "plant.toml").read_text(encoding="utf-8"))
    assert float(repaired.values()["dead_time.delay_s"]) == 0.182
    call, again = search.calls
    assert again.keys() == call.keys()
    assert [log.name for log in call.pop("logs")] == [drive, other]
    assert call == {
        "material": 0.03,
        "named_only": False,
        "baseline": None,
        "prior": None,
        "accel_kind": "kinematic",
        "effects": None,
        "pairs": True,
        "posterior": "sgld",
        "budget_s": None,
        "seed": 0,
    }


def test_every_option_is_handed_on(search: Search, drive: str, tmp_path: Path) -> None:
    options = ["--effects", "dead_time, gust", "--no-pairs", "--posterior", "laplace", "--budget", "20", "--seed", "7"]
    priors = ["--prior", "none=3", "--prior", "dead_time=0.5", "--prior", "pair=0"]
    more = ["--baseline", "dead_time=0.1,T_L=0.4", "--accel-kind", "specific-force"]
    assert main(["diagnose", drive, *options, *priors, *more, "--out", str(tmp_path / "o")]) == 0
    (call,) = search.calls
    simulator = call["baseline"]
    assert isinstance(simulator, GapPlant)
    assert {name: float(x) for name, x in simulator.values().items()} == {
        "T_L": 0.4,
        "K_L": 1.0,
        "dead_time.delay_s": 0.1,
    }
    assert call["effects"] == ["dead_time", "gust"]
    assert call["prior"] == {"none": 3.0, "dead_time": 0.5, "pair": 0.0}
    assert (call["pairs"], call["posterior"], call["budget_s"], call["seed"]) == (False, "laplace", 20.0, 7)
    assert call["accel_kind"] == "specific-force"


def test_the_repaired_simulator_is_the_next_baseline(search: Search, drive: str, tmp_path: Path) -> None:
    assert main(["diagnose", drive, "--quiet", "--out", str(tmp_path / "a")]) == 0
    repaired = str(tmp_path / "a" / "plant.toml")
    assert main(["diagnose", drive, "--quiet", "--baseline", repaired, "--out", str(tmp_path / "b")]) == 0
    assert [e.name for e in search.calls[1]["baseline"].effects] == ["dead_time"]


def test_names_and_units_of_columns(search: Search, tmp_path: Path) -> None:
    given = columns()
    signals = {"time": given["time"], "CMD": given["accel_cmd"], "V": 3.6 * given["speed"]}
    log = write(tmp_path / "raw.csv", **signals)
    options = ["--map", "accel_cmd=CMD", "--map", "speed=V", "--unit", "speed=km/h"]
    assert main(["diagnose", log, *options, "--quiet", "--out", str(tmp_path / "o")]) == 0
    (read,) = search.calls[0]["logs"]
    assert read.accel is None
    assert np.allclose(read.speed, given["speed"])


def test_json_and_quiet(search: Search, drive: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diagnose", drive, "--json", "--out", str(tmp_path / "o")]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    written = read_answer(tmp_path / "o" / "diagnosis.json")
    assert json.loads(said.out) == {key: written[key] for key in written if key != "files"}
    assert main(["diagnose", drive, "--quiet", "--out", str(tmp_path / "o")]) == 0
    assert capsys.readouterr() == ("", "")


# --- bad input


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--effects", "dead_tim"], "--effects: found 'dead_tim', needs an effect's name; perhaps dead_time"),
        (["--effects", "gust,gust"], "--effects: found gust twice"),
        (["--effects", ""], "--effects: found ''"),
        (["--effects", "none"], "--effects: found 'none'"),
        (["--prior", "deadtime=1"], "--prior: found 'deadtime', needs an effect's name; perhaps dead_time"),
        (["--prior", "none"], "--prior: found 'none', needs NAME=WEIGHT"),
        (["--prior", "none=-1"], "--prior: found 'none=-1', needs NAME=WEIGHT"),
        (["--prior", "none=nan"], "--prior: found 'none=nan', needs NAME=WEIGHT"),
        (["--prior", "none=1", "--prior", "none=2"], "--prior: found none twice"),
        (["--baseline", "nonsense"], "--baseline 'nonsense': effect: found 'nonsense'"),
        (["--baseline", "dead_tim=0.2"], "found 'dead_tim', needs an effect's name; perhaps dead_time"),
        (["--baseline", "dead_time=x"], "needs effects, each once, with numbers"),
        (["--baseline", "dead_time=-0.1"], "dead_time.delay_s is -0.1, needs a number"),
        (["--baseline", "T_L=0"], "--baseline 'T_L=0': T_L"),
        (["--baseline", "missing.toml"], "--baseline 'missing.toml': no such file"),
        (["--budget", "0"], "--budget: found 0, needs a finite number above 0 s"),
        (["--budget", "nan"], "--budget: found nan"),
        (["--seed", "1.5"], "needs a whole number"),
        (["--accel-kind", "gravity"], "--accel-kind"),
        (["--posterior", "nuts"], "--posterior"),
        (["--unit", "speed=furlong"], "furlong"),
        (["--map", "speed=NOPE"], "NOPE"),
        (["--speed-min", "20", "--speed-max", "30", "--road", "150"], "--road, --seconds: found limits that no man"),
        (["--speed-min", "90"], "m/s (from the log, where not given), needs 0 or more, and 1.5 m/s between them"),
    ],
)
def test_bad_arguments(
    search: Search, drive: str, tmp_path: Path, refused: Callable[[list[str]], str], options: list[str], fault: str
) -> None:
    assert fault in refused(["diagnose", drive, *options, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
    assert not search.calls


def test_a_manoeuvre_that_cannot_be_had_costs_no_answer(
    search: Search, drive: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(*_: object, **__: object) -> None:
        raise InputError("limits: no manoeuvre of the library keeps to them")

    monkeypatch.setattr("avtorch.experiment.next_experiment", refuses)
    assert main(["diagnose", drive, "--out", str(tmp_path / "out"), "--verbose"]) == 0
    answer = json.loads((tmp_path / "out" / "diagnosis.json").read_text(encoding="utf-8"))
    assert answer["next_experiment"] is None
    told = "No next experiment: limits: no manoeuvre of the library keeps to them."
    assert told in answer["notes"]
    assert told in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("missing", "fault"),
    [
        (("accel_cmd",), "accel_cmd"),
        (("accel", "speed"), "columns 'accel' and 'speed' are both missing"),
        (("time",), "time"),
    ],
)
def test_logs_that_lack_a_signal(
    search: Search, tmp_path: Path, refused: Callable[[list[str]], str], missing: tuple[str, ...], fault: str
) -> None:
    log = write(tmp_path / "poor.csv", **(columns() | dict.fromkeys(missing)))
    assert fault in refused(["diagnose", log, "--out", str(tmp_path / "out")])
    assert not search.calls


def test_logs_that_cannot_be_used(search: Search, tmp_path: Path, refused: Callable[[list[str]], str]) -> None:
    by_hand = write(tmp_path / "by_hand.csv", **columns(), engaged=np.zeros(ROWS, int))
    speed_only = write(tmp_path / "speed.csv", **(columns() | {"accel": None}))
    for arguments, fault in (
        ([by_hand], "by_hand.csv: has no row to use"),
        ([speed_only, "--accel-kind", "specific-force"], "speed.csv has no accel"),
        ([speed_only, "--effects", "gust,sensor_lag"], "found sensor_lag, which no log without accel can show"),
        ([str(tmp_path / "missing.csv")], "missing.csv"),
        ([], "LOGS: missing; see avtorch diagnose --help"),
    ):
        assert fault in refused(["diagnose", *arguments, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
    assert "speed.csv: cannot be made (File exists)" in refused(["diagnose", speed_only, "--out", speed_only])


# --- what a person reads


@pytest.fixture
def logs() -> list[Log]:
    return [Log.from_arrays(**columns())]


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[Diagnosis], list[str]]:
    """What a terminal of 200 columns shows of a diagnosis."""
    monkeypatch.setenv("COLUMNS", "200")

    def lines(found: Diagnosis) -> list[str]:
        print_diagnosis(Talk(json=False, quiet=False), found, verbose=True)
        return [line.rstrip() for line in capsys.readouterr().out.splitlines()]

    return lines


def test_table(logs: list[Log]) -> None:
    table = candidate_table(answer(logs))
    assert table.rows[0] == ("dead_time", "0.930", "+1234", "delay 0.182 (0.175 to 0.189) s")
    # both of the pair have a half width: there the effect is named
    assert "backlash: half width 0.1 (" in table.rows[2][3]
    assert "dead_band: half width -0.2 (" in table.rows[2][3]
    assert [row[:2] for row in table.rows[-2:]] == [("unknown", "0.010"), ("none", "<.001")]


@pytest.mark.parametrize("width", [80, 120])
def test_table_fits_the_terminal(logs: list[Log], width: int) -> None:
    console = Console(width=width, highlight=False, no_color=True)
    with console.capture() as seen:
        console.print(drawn(candidate_table(answer(logs))))
    assert max(len(line.rstrip()) for line in seen.get().splitlines()) <= width
    assert all(name in seen.get().split() for name in ("dead_time", "unknown"))  # whole, to be copied


def test_table_of_many_candidates_stays_short(logs: list[Log]) -> None:
    names = [name for name in EFFECTS if name != "dead_time"]
    each = 0.42 / len(names)
    weak = tuple(Candidate(name, each, 1.0) for name in names)
    found = answer(
        logs, (Candidate("dead_time", 0.5, 9.0), *weak, Candidate("none", 0.04, 0.0), Candidate("unknown", 0.04))
    )
    rows = candidate_table(found, most=8).rows
    assert len(rows) == 8 + 1
    assert rows[-1][:2] == (f"{len(names) - 5} others", f"{each * (len(names) - 5):.3f}")
    assert {"none", "unknown"} <= {row[0] for row in rows}


def test_headline_for_each_kind_of_verdict(logs: list[Log], printed: Callable[[Diagnosis], list[str]]) -> None:
    def said(name: str, p: float = 0.9) -> str:
        others = tuple(Candidate(n, 0.0) for n in ("none", "unknown") if n != name)
        return printed(answer(logs, (Candidate(name, p), *others)))[0]

    assert said("none") == "The simulator lacks nothing that this log shows (probability over 0.99)."
    late = "the command acts after a delay (dead_time)"
    assert said("dead_time", 0.9) == f"The simulator lacks this (probability over 0.99): {late}."
    unsure = (Candidate("dead_time", 0.6), Candidate("gust", 0.4), Candidate("none", 0.0), Candidate("unknown", 0.0))
    assert printed(answer(logs, unsure))[0].startswith("Probably the simulator lacks this")
    assert said("unknown").startswith("The cause is not among the effects known here")
    weak = (Candidate("unknown", 0.38), Candidate("gust", 0.31), Candidate("dead_time", 0.31), Candidate("none", 0.0))
    assert printed(answer(logs, weak))[0] == (
        "No cause can be named: perhaps it is not among the effects known here (probability 0.38), perhaps too weak to "
        "tell."
    )
    assert said("dead_time+gust") == (
        f"The simulator lacks this (probability over 0.99): {late}, "
        "and wind and road push the car at random, for seconds (gust)."
    )


def test_notes(logs: list[Log], printed: Callable[[Diagnosis], list[str]]) -> None:
    def noted(found: Diagnosis) -> list[str]:
        """What stands below the table."""
        lines = printed(found)[:-1]
        return lines[len(lines) - lines[::-1].index("") :]

    remaining = (Candidate("none", 0.1, 0.0), Candidate("aerodynamic_drag", 0.897, 40.0), Candidate("gust", 0.003))
    both = verdict_of(CANDIDATES, aliases=near(0.04))
    more = {"onset_s": 132.42, "remaining": remaining, "complete": False, "notes": ("speed [only]",)}
    told = noted(answer(logs, verdict=both, **more))
    assert told[0] == "This log cannot distinguish dead_time from second_order_actuator."
    assert told[1] == "The gap begins at 132.4 s of the log's time."
    assert told[2] == "Baseline fitted without and with the effect: T_L 0.52 → 0.31 s, K_L 1.02 → 0.99."
    assert told[3] == (
        "Gap of the baseline simulator, in rollouts of 5 s: acceleration error 0.21 m/s² (0.05 with the best "
        "hypothesis), speed error 0.9 m/s."
    )
    assert told[4] == "Hypotheses once the simulator has dead_time: aerodynamic_drag 0.897, none 0.100."
    assert told[5] == "speed [only]"
    assert printed(answer(logs, verdict=both, **more))[1].startswith("The budget ended the search")

    sure = verdict_of(CANDIDATES, aliases=lambda ranked: ())
    told = noted(answer(logs, verdict=sure))
    assert told[:2] == [
        "No other known cause explains this log as well.",
        "The gap is there from the start.",
    ]
    wide = verdict_of(CANDIDATES, aliases=lambda ranked: ["none", "unknown", "backlash+dead_band"])
    told = noted(answer(logs, verdict=wide))
    assert told[0] == (
        "This log cannot distinguish dead_time from no effect at all, a cause outside the table or "
        "backlash with dead_band."
    )
    many = Candidate("dead_time", 0.3, 9.0), *(Candidate(n, 0.05, 1.0) for n in sorted(EFFECTS) if n != "dead_time")
    told = noted(answer(logs, (*many, *CANDIDATES[-2:])))
    assert told[0].endswith("command_hold or any of 20 less probable hypotheses.")
