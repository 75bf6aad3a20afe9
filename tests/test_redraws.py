"""How tests that draw are run (`tests.redraws`), on small suites of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.failed_seeds import NAME

ROOT = Path(__file__).resolve().parents[1]
PASSES_WHEN_LARGER = """
    import pytest
    @pytest.mark.statistical
    @pytest.mark.parametrize("case", range({cases}))
    def test_bar(case, rotating_seed, draws_factor):
        with open({log!r}, "a") as log:
            log.write(f"{{rotating_seed}} {{draws_factor}}\\n")
        assert draws_factor == 4
"""


class Suite:
    """One file of tests, run by this house's rules."""

    def __init__(self, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("AVTORCH_SEED", "AVTORCH_DRAWS", "AVTORCH_FAILED_SEEDS", "PYTEST_ADDOPTS"):
            monkeypatch.delenv(name, raising=False)
        # other plugins are imported anew in each of these runs, which takes seconds
        monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
        monkeypatch.setenv("PYTHONPATH", str(ROOT))
        self.pytester = pytester
        self.log = str(pytester.path / "drawn.txt")
        pytester.makeini(
            "[pytest]\naddopts = --strict-markers\npythonpath = .\nmarkers = statistical: may fail by chance"
        )

    def run(self, source: str, *options: str, apart: bool = False) -> pytest.RunResult:
        self.pytester.makepyfile(test_it=source)
        run = self.pytester.runpytest_subprocess if apart else self.pytester.runpytest_inprocess
        return run("-p", "tests.redraws", "-p", "no:cacheprovider", *options)

    @property
    def drawn(self) -> list[tuple[int, int]]:
        """Seed and factor of each draw, in turn."""
        rows = [line.split() for line in Path(self.log).read_text(encoding="utf-8").splitlines()]
        return [(int(seed), int(factor)) for seed, factor in rows]

    def seeds(self, name: str = NAME) -> dict[str, list[int]]:
        return json.loads((self.pytester.path / name).read_text(encoding="utf-8"))

    def keep(self, seeds: object) -> None:
        path = self.pytester.path / NAME
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(seeds), encoding="utf-8")


@pytest.fixture
def suite(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> Suite:
    return Suite(pytester, monkeypatch)


def test_a_failed_bar_is_drawn_once_more_with_more_samples(suite: Suite) -> None:
    result = suite.run(PASSES_WHEN_LARGER.format(cases=2, log=suite.log))
    assert result.ret == 0
    assert result.parseoutcomes() == {"passed": 2, "redrawn": 2}
    assert [factor for _, factor in suite.drawn] == [1, 4, 1, 4]
    assert len({seed for seed, _ in suite.drawn}) == 4
    assert suite.seeds() == {f"test_it.py::test_bar[{k}]": [suite.drawn[2 * k][0]] for k in range(2)}
    # with its seed and what it compared
    result.stdout.fnmatch_lines(
        ["*drawn again after a failure*", "*assert 1 == 4*", f"AVTORCH_SEED={suite.drawn[0][0]} for *"]
    )


@pytest.mark.parametrize("workers", [[], ["-p", "xdist", "-n", "2"]], ids=["alone", "two workers"])
def test_a_third_redraw_fails_the_run(suite: Suite, workers: list[str]) -> None:
    result = suite.run(PASSES_WHEN_LARGER.format(cases=3, log=suite.log), *workers, apart=bool(workers))
    assert result.ret == 1
    assert result.parseoutcomes() == {"passed": 3, "redrawn": 3}
    assert set(suite.seeds()) == {f"test_it.py::test_bar[{k}]" for k in range(3)}
    result.stdout.fnmatch_lines(["FAILED: 3 tests were drawn again, at most 2 may be:"])
    for test, (seed,) in suite.seeds().items():
        assert f"  AVTORCH_SEED={seed} for {test}" in result.outlines


def test_what_fails_twice_fails(suite: Suite) -> None:
    result = suite.run(PASSES_WHEN_LARGER.format(cases=1, log=suite.log).replace("== 4", "== 9"))
    assert result.ret == 1
    assert result.parseoutcomes() == {"failed": 1, "redrawn": 1}
    assert suite.seeds() == {"test_it.py::test_bar[0]": sorted(seed for seed, _ in suite.drawn)}
    result.stdout.fnmatch_lines([f"AVTORCH_SEED={suite.drawn[1][0]} AVTORCH_DRAWS=4 for test_it.py::test_bar*"])


OF_EVERY_KIND = """
    import warnings
    import numpy as np, pytest
    import package

    statistical = pytest.mark.statistical

    @statistical
    @pytest.mark.parametrize("crash", [
        lambda: int("another exception"),
        lambda: pytest.raises(ValueError, int, 1),  # a refusal that does not come
        package.broken,
        lambda: sorted([1, 2], key=lambda _: package.broken()),
        lambda: warnings.warn("strange", stacklevel=1),
    ])
    @pytest.mark.filterwarnings("error")
    def test_crash(crash, rotating_seed):
        crash()

    @statistical
    def test_crash_while_a_bar_failed(rotating_seed):
        try:
            assert False
        except AssertionError:
            raise KeyError(0)

    @pytest.fixture
    def log(rotating_seed):
        assert False

    @statistical
    def test_fixture(log):
        pass

    def test_exact(fresh_seed):
        assert False

    def test_without_a_seed():
        assert False

    def near(x):
        np.testing.assert_allclose(x, 4)

    @statistical
    def test_array(rotating_seed, draws_factor):
        near(draws_factor)
"""


def test_only_a_failed_bar_is_drawn_again(suite: Suite) -> None:
    """Not a crash of whatever kind, a fixture or an exact property; a comparison of arrays is the test's own bar."""
    suite.pytester.makepyfile(package="def broken():\n    assert False")
    result = suite.run(OF_EVERY_KIND)
    assert result.parseoutcomes() == {"failed": 8, "errors": 1, "passed": 1, "redrawn": 1}
    # every seed that failed is kept, and each failed once
    assert [len(seeds) for seeds in suite.seeds().values()] == [1] * 9
    assert {test.split("::")[1].split("[")[0] for test in suite.seeds()} == {
        "test_crash",
        "test_crash_while_a_bar_failed",
        "test_fixture",
        "test_exact",
        "test_array",
    }


def test_recorded_seeds_are_drawn_first(suite: Suite) -> None:
    suite.keep({"test_it.py::test_bar[0]": [3, 5]})
    result = suite.run(PASSES_WHEN_LARGER.format(cases=1, log=suite.log).replace("== 4", "> 0"))
    assert result.parseoutcomes() == {"passed": 1}
    assert suite.drawn[:2] == [(3, 4), (5, 4)]
    assert [factor for _, factor in suite.drawn[2:]] == [1]
    assert suite.seeds() == {"test_it.py::test_bar[0]": [3, 5]}


def test_a_recorded_seed_that_fails_again_fails_the_test(suite: Suite) -> None:
    suite.keep({"test_it.py::test_bar[0]": [3, 5]})
    result = suite.run(PASSES_WHEN_LARGER.format(cases=1, log=suite.log).replace("== 4", "== 1"))
    assert result.parseoutcomes() == {"failed": 1}
    assert suite.drawn == [(3, 4)]
    result.stdout.fnmatch_lines([f"AVTORCH_SEED=3 AVTORCH_DRAWS=4 for *, recorded in {NAME}"])


def test_a_named_seed_is_drawn_alone_and_not_recorded(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVTORCH_SEED", "11")
    suite.keep({"test_it.py::test_bar[0]": [3]})
    assert suite.run(PASSES_WHEN_LARGER.format(cases=1, log=suite.log)).parseoutcomes() == {"failed": 1}
    monkeypatch.setenv("AVTORCH_DRAWS", "4")
    assert suite.run(PASSES_WHEN_LARGER.format(cases=1, log=suite.log)).ret == 0
    assert suite.drawn == [(11, 1), (11, 4)]
    assert suite.seeds() == {"test_it.py::test_bar[0]": [3]}


def test_ci_writes_elsewhere_and_reads_both(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVTORCH_FAILED_SEEDS", "out/seeds.json")
    suite.keep({})
    source = PASSES_WHEN_LARGER.format(cases=1, log=suite.log)
    assert suite.run(source).ret == suite.run(source).ret == 0
    assert suite.seeds() == {}
    # drawn, drawn again; then the recorded one with more samples, a new one, and that one again
    assert [factor for _, factor in suite.drawn] == [1, 4, 4, 1, 4]
    assert suite.drawn[2][0] == suite.drawn[0][0]
    assert len(suite.seeds("out/seeds.json")["test_it.py::test_bar[0]"]) == 2


@pytest.mark.parametrize("held", ["[]", '{"test": 3}', '{"test": [-1]}', "{"])
def test_a_file_that_is_none_ends_the_run(suite: Suite, held: str) -> None:
    suite.keep({})
    (suite.pytester.path / NAME).write_text(held, encoding="utf-8")
    result = suite.run("def test_it(): pass")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*failed_seeds.json*"])
