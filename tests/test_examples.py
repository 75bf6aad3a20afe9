"""What a page names has an example in its docstring, and all examples run and print the output shown."""

from __future__ import annotations

import ast
import doctest
import re
from pathlib import Path

import pytest

from tests.public_names import ROOT, Public, every, offered, path_of

PUBLIC = every()
PLACES = ("README.md", "docs/*.md", "docs/effects/*.md", "notebooks/*.py")  # without what `make docs` copies
PAGES = [p for place in PLACES for p in sorted(ROOT.glob(place))]
# What needs recordings or a display, and so cannot run everywhere, with the reason.
SKIPPED: dict[str, str] = {}
# Whole experiments and diagnoses, though small ones: seconds each.
SLOW = frozenset(
    {
        "avtorch.experiment.next_experiment.next_experiment",
        "avtorch.external.compare_simulators.compare_simulators",
        "avtorch.external.external_simulator.ExternalSimulator",
        "avtorch.external.external_simulator.wrap",
        "avtorch.external.fmu.FmuSimulator",
        "avtorch.external.surrogate.SimulatorCheck",
        "avtorch.external.compare_simulators.SimulatorComparison",
        "avtorch.fleet.folder.read_rows",
        "avtorch.fleet.run.run_fleet",
        "avtorch.follower.diagnose_follower.FollowerDiagnosis",
        "avtorch.follower.diagnose_follower.diagnose_follower",
        "avtorch.gap",
        "avtorch.gap.compare.compare",
        "avtorch.gap.diagnose.diagnose",
        "avtorch.gap.result.diagnosis.Diagnosis",
        "avtorch.paper.estimation.Estimation",
        "avtorch.paper.estimation.estimation",
        "avtorch.paper.gains.Gains",
        "avtorch.paper.gains.gains",
        "avtorch.paper.monitoring.Monitoring",
        "avtorch.paper.monitoring.monitoring",
        "avtorch.paper.platoon.Platoon",
        "avtorch.paper.platoon.platoon",
        "avtorch.paper.regions.Regions",
        "avtorch.paper.regions.regions",
        "avtorch.paper.reproduce.Reproduction",
        "avtorch.paper.reproduce.reproduce",
        "avtorch.paper.strategies.Strategies",
        "avtorch.paper.strategies.strategies",
        "avtorch.plots.paper.paper_pictures",
        "avtorch.plots.posteriors.validation_figures",
        "avtorch.plots.signatures.signature_figure",
        "avtorch.plots.drive.diagnosis_figure",
        "avtorch.remedy.what_to_set.setting_for",
        "avtorch.report.fleet.write_fleet_page",
        "avtorch.report.diagnosis.write_report",
        "avtorch.validation.validate.Validation",
        "avtorch.validation.validate.validate",
    }
)


def examples(public: Public) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(public.doc, str(public))


RUN = [pytest.param(p, marks=pytest.mark.slow if str(p) in SLOW else []) for p in PUBLIC if examples(p)]


@pytest.mark.parametrize("public", RUN, ids=str)
def test_example_runs(public: Public, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As pasted into a fresh interpreter in an empty folder: whatever it needs it imports itself."""
    monkeypatch.chdir(tmp_path)
    test = doctest.DocTestParser().get_doctest(
        public.doc, {"__name__": "__main__"}, str(public), str(path_of(public.module)), 0
    )
    report: list[str] = []
    assert any(example.want for example in test.examples), "no example, or one that shows nothing"
    assert doctest.DocTestRunner(verbose=False).run(test, out=report.append).failed == 0, "".join(report)


def test_what_a_page_names_has_an_example() -> None:
    """A name of the first level has one, too; what a function returns is explained by the function's own."""
    shown = {word for page in PAGES for code in _code(page) for word in re.findall(r"\w+", code)}
    assert len(shown) > 500
    assert not [str(p) for p in PUBLIC if p.name in shown | set(offered("avtorch")) and not examples(p)]


def test_slow_ones_are_public_names() -> None:
    assert {str(p) for p in PUBLIC} >= SLOW


def test_only_what_cannot_run_is_skipped() -> None:
    skips = {str(p) for p in PUBLIC for e in examples(p) if doctest.SKIP in e.options}
    assert skips == SKIPPED.keys()


def test_summary_is_a_sentence_on_the_first_line() -> None:
    assert not [str(p) for p in PUBLIC if not re.search(r"[.:](\s|$)", p.doc.strip().split("\n")[0])]


def test_errors_are_documented() -> None:
    """Where a public function, or a constructor, refuses its input by itself, its docstring names `InputError`."""
    refusing = [p for p in PUBLIC if any(_refuses(f) for f in _entrances(p.node))]
    assert len(refusing) > 50
    assert not [str(p) for p in refusing if "InputError" not in p.doc]


def test_arrays_have_a_shape_or_a_unit() -> None:
    """Of a function that takes or returns arrays: `(window, time)`, `[m/s²]`, or that it is another's arguments."""
    said = re.compile(r"\[[^\]]+\]|\((\.\.\.|\w+( \+ 1)?)(, [\w.]+)*,?\)|\b(as|in|see|of|per) `")
    taking = [p for p in PUBLIC if _takes_arrays(p.node)]
    assert len(taking) > 30
    assert not [str(p) for p in taking if not said.search(p.doc.split("Example:")[0])]


def _code(page: Path) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return [text] if page.suffix == ".py" else re.findall(r"```.*?```|`[^`]+`", text, re.S)


def _takes_arrays(node: ast.stmt | ast.Module) -> bool:
    if not isinstance(node, ast.FunctionDef):
        return False
    kinds = [a.annotation for a in (*node.args.args, *node.args.kwonlyargs)] + [node.returns]
    arrays = re.compile(r"\b(Tensor|NDArray|Float|ndarray|ArrayLike|Number|Value|PointOrBox)\b")
    return any(kind is not None and arrays.search(ast.unparse(kind)) for kind in kinds)


def _entrances(node: ast.stmt | ast.Module) -> list[ast.FunctionDef]:
    if isinstance(node, ast.FunctionDef):
        return [node]
    body = node.body if isinstance(node, ast.ClassDef) else []
    return [f for f in body if isinstance(f, ast.FunctionDef) and f.name in ("__init__", "__post_init__")]


def _refuses(function: ast.FunctionDef) -> bool:
    raised = [n.exc for n in ast.walk(function) if isinstance(n, ast.Raise)]
    return any(isinstance(e, ast.Call) and ast.unparse(e.func) == "InputError" for e in raised)
