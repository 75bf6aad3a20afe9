"""What is shown of objects, and threads of long calls."""

from __future__ import annotations

import html.parser
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (its own OpenBLAS)
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from avtorch import (
    BeliefStream,
    ClosedLoop,
    Estimates,
    GLVDPlant,
    Leader,
    Log,
    Supervisor,
    check,
    compare,
    diagnose,
    estimate,
)
from avtorch import simulate as drive
from avtorch.display import Card, Displayed, Frame
from avtorch.display.progress import shows_progress
from avtorch.errors import InputError
from avtorch.gap import DeadTime, plant
from avtorch.inference import Posterior


class Balanced(html.parser.HTMLParser):
    """Tags that are opened and closed in order, and the text between them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: set[str] = set()
        self.text = ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        self.seen.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def log() -> Log:
    late = plant([DeadTime(0.4)], sigma=0.0)
    return drive(Leader.default(start=50.0, duration=54.0, dt=0.1), plant=late).log()


def posterior(windows: int = 3) -> Posterior:
    generator = torch.Generator().manual_seed(0)
    log_draws = 0.1 * torch.randn(4, 50, windows, 2, dtype=torch.float64, generator=generator)
    why = ("", *["The chains did not settle."] * (windows - 1))
    converged = torch.arange(windows) < 1
    return Posterior(("T_L", "K_L"), log_draws.exp(), converged, why)


@cache
def estimated(log: Log) -> Estimates:
    return estimate(log, estimator="map")


MADE: dict[str, Callable[[Log], Displayed]] = {
    "posterior": lambda log: posterior(),
    "log": lambda log: log,
    "check": lambda log: check(log),
    "estimates": lambda log: estimated(log),
    "window": lambda log: estimated(log).windows[0],
    "belief": lambda log: estimated(log).windows[0].window.belief,
    "diagnosis": lambda log: diagnose(log, effects=["dead_time"], pairs=False),
    "comparison": lambda log: compare(log, log, effects=[]),
    "trajectory": lambda log: drive(Leader.constant(speed=20.0, duration=3.0), vehicles=2),
    "run": lambda log: Supervisor(
        ClosedLoop(Leader.default(start=50.0, duration=4.0, dt=0.05)), stream=BeliefStream(estimator="map")
    ).run(4.0),
}


def quadrature() -> Displayed:
    from avtorch.inference import integrate
    from avtorch.validation import synthetic_windows

    return integrate(synthetic_windows(2, seed=1).density, nodes=25)


def what_to_set() -> Displayed:
    from avtorch.remedy import what_to_set

    return what_to_set(plant(T_L=1.5, K_L=0.5), {"T_L": np.full(20, 1.5), "K_L": np.full(20, 0.5)})


def experiment() -> Displayed:
    from avtorch.experiment import Experiment, Information, library

    return Experiment(library()[0], ("one", "other"), Information(0.6, 0.95, 4.0), entropy=0.69, every={})


class Mine:
    """A simulator of a lag alone."""

    def reset(self, *, speed: float, accel: float) -> None:
        self.speed, self.accel = speed, accel

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        before = self.accel
        self.accel = accel_cmd + float(np.exp(-dt / 0.4)) * (before - accel_cmd)
        self.speed += dt * (before + self.accel) / 2
        return self.accel, self.speed


def simulator_check() -> Displayed:
    from avtorch.external import check_simulator

    return check_simulator(Mine())


def simulator_comparison() -> Displayed:
    from avtorch import compare_simulators

    log = drive(Leader.default(start=30.0, duration=60.0, dt=0.1), plant=plant(T_L=0.5)).log()
    return compare_simulators(log, "T_L=0.5", "T_L=0.2, K_L=0.9")


def follower() -> Displayed:
    from avtorch import LinearController
    from avtorch.follower import diagnose_follower

    car = LinearController(gains=(0.2, 0.6, 0.0), time_gap=1.5)
    log = drive(Leader.default(start=50.0, duration=45.0, dt=0.1), car).log()
    return diagnose_follower(log.to_dataframe(), law="constant_time_gap", cause=False)


def validation() -> Displayed:
    pytest.importorskip("pyro")
    from avtorch.inference import SamplerSettings
    from avtorch.validation import NutsSettings, synthetic_windows, validate

    quick = {"settings": SamplerSettings(chains=64), "nuts": NutsSettings(1, 20, 10), "nuts_windows": 1}
    return validate(synthetic_windows(1, seed=1), **quick)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (quadrature, "Quadrature of T_L, K_L, sigma: 2 windows"),
        (what_to_set, "What to set"),
        (experiment, "It separates one, other: 0.6 of 0.69 nats expected."),
        (simulator_check, "Simulator"),
        pytest.param(simulator_comparison, "The first simulator is nearer to the car", marks=pytest.mark.slow),
        pytest.param(follower, "under the law constant_time_gap", marks=pytest.mark.slow),
        pytest.param(validation, "Validation of SGLD on 1 window of", marks=pytest.mark.slow),
    ],
)
def test_rarer_answers_do_so_too(make: Callable[[], Displayed], says: str) -> None:
    found = make()
    assert says in " ".join(repr(found).split())
    assert len(repr(found).splitlines()) <= 17
    assert "tensor(" not in repr(found)
    assert "array(" not in repr(found)
    assert says in Balanced(found._repr_html_()).text


@pytest.mark.parametrize("kind", MADE)
def test_every_answer_is_a_few_lines_without_a_tensor(kind: str, log: Log) -> None:
    found = MADE[kind](log)
    lines = repr(found).splitlines()
    assert 2 <= len(lines) <= 17
    assert max(map(len, lines)) <= 100
    assert "tensor(" not in repr(found)
    assert "array(" not in repr(found)
    page = Balanced(found._repr_html_())
    assert found.overview().title in page.text
    assert len(found._repr_html_()) < 6000


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["belief", "diagnosis", "estimates", "log", "posterior", "run", "trajectory"])
def test_every_answer_of_numbers_is_a_data_frame(kind: str, log: Log) -> None:
    pandas = pytest.importorskip("pandas")
    found = MADE[kind](log)
    assert isinstance(found.to_dataframe(), pandas.DataFrame)  # type: ignore[attr-defined]


def test_a_logs_data_frame_is_the_log(log: Log) -> None:
    pytest.importorskip("pandas")
    frame = log.to_dataframe()
    assert frame["speed"].tolist() == log.speed.tolist()
    again = Log.from_dataframe(frame)
    assert np.array_equal(again.accel_cmd, log.accel_cmd)
    assert np.array_equal(again.time, log.time)


def test_a_runs_data_frame_has_every_car_at_every_time() -> None:
    pytest.importorskip("pandas")
    run = drive(Leader.default(start=50.0, duration=3.0, dt=0.1), vehicles=2, scenarios=3)
    frame = run.to_dataframe()
    assert len(frame) == run.speed.numel()
    one = frame[(frame["scenario"] == 2) & (frame["vehicle"] == 1)]
    assert one["speed"].tolist() == run.speed[2, 1].tolist()
    assert one["time"].tolist() == run.time.tolist()


def test_summary_of_a_posterior_is_its_own_figures() -> None:
    found = posterior()
    rows = list(found.summary().rows())
    assert [(row["window"], row["parameter"], row["unit"]) for row in rows[:3]] == [
        (0, "T_L", "s"),
        (0, "K_L", "-"),
        (1, "T_L", "s"),
    ]
    for row in rows:
        i = found.names.index(row["parameter"])
        for key in ("mean", "sd", "rhat", "ess_bulk", "ess_tail"):
            assert row[key] == float(getattr(found, key)[row["window"], i])
        assert row["q95"] == float(found.quantile(0.95)[row["window"], i])
        assert row["converged"] == (row["window"] == 0)


def test_a_posterior_says_why_it_did_not_converge() -> None:
    assert "1 of 3 windows converged. The chains did not settle." in repr(posterior())
    assert "The first 2 windows" in repr(posterior())
    assert "The first" not in repr(posterior(1))


@pytest.mark.slow
def test_the_summary_of_a_diagnosis_has_the_effects_parameters_and_their_chains(log: Log) -> None:
    found = diagnose(log, effects=["dead_time"], pairs=False, posterior="sgld")
    rows = {row["parameter"]: row for row in found.summary().rows()}
    assert list(rows) == ["T_L", "K_L", "dead_time.delay_s"]
    delay = rows["dead_time.delay_s"]
    assert delay["unit"] == "s"
    # without noise a recorder's delay, 10 ms with a standard deviation of 10, is all that is open
    assert delay["mean"] == pytest.approx(0.4, abs=0.02)
    assert delay["rhat"] < 1.1
    assert delay["ess_bulk"] > 50
    laplace = diagnose(log, effects=["dead_time"], pairs=False)
    assert "rhat" not in laplace.summary().columns


@pytest.mark.slow
def test_draws_go_to_arviz(log: Log) -> None:
    pytest.importorskip("arviz")
    found = estimate(log, estimator="importance")
    group = found.to_arviz().posterior
    belief = found.windows[-1].window.belief
    assert group["T_L"].dims == ("chain", "draw", "vehicle")
    assert group["T_L"].values[0, :, 0].tolist() == belief.draws[:, 0, 0].tolist()
    assert group["T_L"].attrs["units"] == "s"
    with pytest.raises(InputError, match="window: found 99, needs a number below"):
        found.to_arviz(window=99)
    without = replace(belief, draws=belief.draws[:0])
    with pytest.raises(InputError, match="draws: found none"):
        without.to_arviz()


def test_text_from_a_file_cannot_write_into_the_page() -> None:
    card = Card("<script>alert(1)</script>", ("a & b\x1b[2J",), Frame({"<b>": ("<i>",)}))
    page = Balanced(card.html())
    assert page.seen == {"div", "strong", "table", "thead", "tbody", "tr", "th", "td"}
    assert "\x1b" not in card.html()
    assert "\x1b" not in str(card)


def test_a_long_table_is_cut_and_counted() -> None:
    frame = Frame({"n": range(20)})
    assert len(frame.lines()) == 14
    assert frame.lines()[-1] == "... and 8 more rows"
    assert Balanced(frame.html()).text.endswith("... and 8 more rows")


def test_columns_of_different_length_are_refused() -> None:
    with pytest.raises(InputError, match="columns: differ in length: a 1, b 2"):
        Frame({"a": (1,), "b": (1, 2)})


def test_a_missing_number_stays_missing_everywhere() -> None:
    frame = Frame({"x": (1.5, None)})
    assert frame.to_arrow().column("x").to_pylist()[0] == 1.5
    pytest.importorskip("pandas")
    assert frame.to_dataframe()["x"].isna().tolist() == [False, True]
    assert frame.lines()[2].strip() == ""


def test_polars_takes_a_table_without_pandas() -> None:
    polars = pytest.importorskip("polars")
    assert polars.DataFrame(posterior().summary())["parameter"].to_list()[:2] == ["T_L", "K_L"]


def test_without_pandas_the_command_that_brings_it_is_named(monkeypatch: pytest.MonkeyPatch, log: Log) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match=r"pip install 'avtorch\[pandas\]'"):
        log.to_dataframe()


def test_a_car_that_collides_says_so() -> None:
    run = drive(Leader.constant(speed=20.0, duration=3.0), plant=GLVDPlant(0.3, 1.0))
    assert "No collision." in repr(run)
    crashed = replace(run, spacing=run.spacing - 100.0)
    assert "1 of 1 drives end in a collision." in repr(crashed)


# A long call from Python uses one thread, as a command does, and leaves the user's number as it was.
@shows_progress
def work(fails: bool = False, *, progress: object = None) -> list[int]:
    """Threads of all pools while it runs."""
    if fails:
        raise ValueError("no")
    return counts()


def counts() -> list[int]:
    """Of torch, and of each pool of linear algebra."""
    return [torch.get_num_threads(), *(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")]


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A user with two threads in each pool."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(2, user_api="blas"):
        yield monkeypatch
    torch.set_num_threads(before)


def test_one_thread_within_and_as_before_behind(two: pytest.MonkeyPatch) -> None:
    two.delenv("OMP_NUM_THREADS", raising=False)
    assert len(counts()) > 1
    assert set(work()) == {1}
    with pytest.raises(ValueError, match="no"):
        work(fails=True)
    assert set(counts()) == {2}


def test_what_the_user_set_stays(two: pytest.MonkeyPatch) -> None:
    two.setenv("OMP_NUM_THREADS", "2")
    assert set(work()) == {2}
