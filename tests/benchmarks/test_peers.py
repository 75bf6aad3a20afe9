"""The comparison with peers: its command runs without them, all densities agree, and missing peers are reported."""

from __future__ import annotations

import json
import warnings
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from benchmarks.peers import __main__ as command
from benchmarks.peers.aims import aims
from benchmarks.peers.contract import Method, as_log
from benchmarks.peers.own import own_log_density
from benchmarks.peers.problem import Windows, make_windows
from benchmarks.peers.registry import METHODS
from benchmarks.peers.score import WANTED, effective, seconds_to
from benchmarks.peers.single import Row
from benchmarks.peers.tables import markdown, one_window, text
from tests.bars import BAR

#: Methods that need nothing beyond avtorch itself.
ALONE = ("avtorch", "conjugate", "laplace", "rls", "scalar", "quadrature")
#: Those of the others that can be imported side by side with torch in one process.
PEERS = ("blackjax-nuts", "numpyro-nuts", "nutpie", "pyro-nuts", "posteriors", "blackjax-sgld", "ukf")


@pytest.fixture(scope="module")
def windows() -> Windows:
    return make_windows(3, seed=8)


def test_windows_keep_their_ranges(windows: Windows) -> None:
    many = make_windows(200, points=50, seed=1)
    low, high = many.truth.min(0), many.truth.max(0)
    assert (low >= [0.1, 0.4, 0.05]).all()
    assert (high <= [2.0, 1.1, 0.3]).all()
    residual = many.jerk - (many.truth[:, 1:2] * many.u - many.a) / many.truth[:, :1]
    assert np.allclose(residual.std(1), many.truth[:, 2], rtol=0.6)
    assert windows.sums().shape == (3, 7)


@pytest.mark.parametrize("name", [*ALONE, *PEERS])
def test_every_method_works_on_the_same_density(name: str, windows: Windows) -> None:
    method = METHODS[name]
    if method.missing():
        pytest.skip(f"{', '.join(method.missing())} not installed")
    if "jax" in method.needs:
        import_module("jax").config.update("jax_enable_x64", True)
    z, ours = as_log(windows), own_log_density(windows, as_log(windows))
    with warnings.catch_warnings():
        if name in PEERS:
            warnings.simplefilter("ignore")  # a peer's warnings on import are not our fault
        theirs = method.build(method.candidates[0]).log_density(windows, z)
    assert (theirs is None) == (name in ("rls", "ukf"))
    if theirs is not None:
        assert (np.abs(theirs - ours) <= 1e-8 * (1 + np.abs(ours))).all()


@pytest.mark.slow
def test_quick_run_of_what_needs_no_peer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = tmp_path / "peers.json"
    given = ["--quick", "--windows", "1", "--only", ",".join(ALONE), "--parts", "one", "--core", "-1"]
    assert command.main([*given, "--json", str(told)]) == 0
    figures = json.loads(told.read_text(encoding="utf-8"))
    rows = {row["method"]: row for row in figures["one"]}
    assert set(rows) == set(ALONE)
    assert not [row["why"] for row in rows.values() if row["why"]]
    assert all(row["seconds"] > 0 and row["peak_mb"] >= 0 for row in rows.values())
    assert rows["quadrature"]["shift"] < 1e-6
    assert abs(rows["laplace"]["shift"]) < 1.0
    printed = capsys.readouterr().out
    assert "against avtorch" in printed
    assert "recursive least squares" in printed


@pytest.mark.slow
def test_quick_run_of_many_windows(tmp_path: Path) -> None:
    told = tmp_path / "peers.json"
    given = ["--quick", "--batch", "3", "--only", "avtorch,rls,scalar", "--parts", "many", "--json", str(told)]
    assert command.main(given) == 0
    rows = {row["method"]: row for row in json.loads(told.read_text(encoding="utf-8"))["many"]}
    assert set(rows) == {"avtorch", "rls"}
    assert all(row["windows"] == 3 and row["seconds"] > 0 for row in rows.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "told"),
    [
        (
            Method("absent", "", "absent", needs=("no_such_module",), pip="pip install absent", batch={}),
            "not installed: pip install absent",
        ),
        # its process does not find this name in the registry
        (Method("broken", "", "own.Laplace", fixed=True, batch={}), "its process ended"),
    ],
)
def test_a_missing_or_failing_peer_is_a_line_not_the_end(
    method: Method, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(METHODS, method.name, method)
    assert (
        command.main(["--quick", "--windows", "1", "--only", method.name, "--parts", "one,many", "--batch", "1"]) == 0
    )
    assert capsys.readouterr().out.count(told) == 2


def test_unknown_method_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(["--only", "nuts2"])
    assert "'nuts2' is none of" in capsys.readouterr().err


@pytest.mark.statistical
def test_effective_draws_of_many_short_chains(rotating_seed: int, draws_factor: int) -> None:
    g = np.random.default_rng(rotating_seed)
    chains, length = 512 * draws_factor, 8
    independent = np.exp(g.standard_normal((chains, length, 1, 2)))
    bulk, _ = effective(independent)
    # the least of two, each with a relative error of sqrt(2/512), is low by a little
    assert abs(bulk[0] / (chains * length) - 1) < BAR * np.sqrt(2 / chains) + 0.05
    rho = 0.9
    walk = np.empty((chains, length, 1, 1))
    walk[:, 0] = g.standard_normal((chains, 1, 1))
    for k in range(1, length):
        walk[:, k] = rho * walk[:, k - 1] + np.sqrt(1 - rho**2) * g.standard_normal((chains, 1, 1))
    lags = np.arange(1, length)
    expected = chains * length / (1 + 2 * ((1 - lags / length) * rho**lags).sum())
    assert abs(effective(walk)[0][0] / expected - 1) < BAR * np.sqrt(2 / chains)


def test_effective_draws_never_exceed_the_draws() -> None:
    g = np.random.default_rng(0)
    x = g.standard_normal((4, 400, 1, 1))
    x[:, 1::2] = -x[:, ::2]  # antithetic pairs: their mean is exact, their spread is not
    assert effective(x)[0][0] <= 1600


def test_seconds_are_scaled_up_only() -> None:
    assert seconds_to(WANTED, 1.0, WANTED / 2) == pytest.approx(2.0)
    assert seconds_to(WANTED, 1.0, 2 * WANTED) == pytest.approx(1.0)


def test_tables_from_rows() -> None:
    own = Row("avtorch", "avtorch SGLD", seconds=0.01, seconds_wanted=0.01, bulk=3000.0, first_s=0.1, windows=5)
    peer = Row("blackjax-nuts", "BlackJAX NUTS", seconds=0.05, seconds_wanted=0.05, bulk=2100.0, windows=5)
    gone = Row("nutpie", "nutpie", why="not installed: pip install nutpie")
    shown = text(one_window([own, peer, gone]))
    assert "5 x" in shown
    assert "not installed: pip install nutpie" in shown
    assert markdown(one_window([own, peer, gone])).count("\n") == 4


def test_aims_are_those_of_the_page_in_their_order() -> None:
    def row(method: str, milliseconds: float, windows: int) -> Row:
        seconds = milliseconds / 1000
        return Row(method, method, seconds=seconds, seconds_wanted=seconds, first_s=0.57, windows=windows)

    # milliseconds of the page's two tables
    one = {"avtorch": 4.98, "avtorch-matched": 4.83, "blackjax-nuts": 25.2, "blackjax-nuts-stan": 70.1}
    one["conjugate"] = 3.19
    many = {"avtorch": 1.26, "avtorch-matched": 0.963, "blackjax-nuts": 26.4, "blackjax-nuts-stan": 23.8}
    many["blackjax-nuts-whitened"] = 4.87
    found = aims([row(*of, 5) for of in one.items()], [row(*of, 300) for of in many.items()], None)
    page = Path(command.__file__).with_name("README.md").read_text(encoding="utf-8")
    section = page.partition("## Today's releases, one run")[2].partition("\n## ")[0].partition("| aim |")[2]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
    assert [(aim, verdict) for aim, _, verdict in found] == [(aim, verdict) for aim, _, verdict in rows]
    for (_, figure, _), (_, shown, _) in zip(found, rows, strict=True):
        assert float(figure.split()[0]) == pytest.approx(float(shown.split()[0]), rel=0.05)
    # a peer that is not there has no aim
    gone = Row("blackjax-nuts", "BlackJAX NUTS", why="not installed: pip install blackjax")
    assert [aim for aim, _, _ in aims([row("avtorch", 1, 5), gone], [], None) if "BlackJAX" in aim] == []
