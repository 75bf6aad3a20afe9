"""The table of a blind test: the method with its 90 % intervals, the aims, and the rivals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from rich.table import Table

# label, path in the answer, number format, and the aim
_MEASURES = (
    ("top-1, easy", "top1.easy", "%", "≥ 97 %"),
    ("top-1, medium", "top1.medium", "%", "≥ 95 %"),
    ("top-1, hard", "top1.hard", "%", "≥ 95 %"),
    ("top-1, faint", "top1.faint", "%", "≥ 60 %"),
    ("alias set holds the truth", "alias_set.accuracy", "%", "≥ 99 %"),
    ("alias set's size", "alias_set.mean_size", "", "≤ 1.5"),
    ("false alarms on none", "false_alarm", "%", "≤ 3 %"),
    ("above 0.9 and wrong", "confident_errors", "%", "≤ 2 %"),
    ("unknown, AUROC", "unknown_auroc", "", "≥ 0.95"),
    ("unknown, FPR at 95 %", "unknown_fpr95", "%", ""),
    ("unknown named as an effect", "unknown_confidently_blamed", "%", "≤ 10 %"),
    ("calibration error", "ece", "", "≤ 0.05"),
    ("Brier score", "brier", "", ""),
    ("macro F1", "macro_f1", "", ""),
    ("pairs exact", "pairs_exact", "%", "≥ 80 %"),
    ("pairs, Jaccard", "pairs_jaccard", "", "≥ 0.9"),
    ("onset error, median [s]", "onset_error_s", "", "≤ 5"),
    ("seconds per case", "seconds_per_case", "", ""),
)


def blindtest_table(answer: Mapping[str, Any]) -> Table:
    """One row per measure; `answer` as of `avtorch.trial.run_trial`. Measures without a case are left out."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("")
    for name in (answer["answerer"], "90 %", "aim", *answer["baselines"]):
        table.add_column(escape(name), justify="right", no_wrap=True)
    for words, path, kind, asked in _MEASURES:
        if _at(answer, path) is None:
            continue
        interval = _at(answer["intervals"], path)
        spread = (
            "" if interval is None else f"{_formatted(interval[0], kind, False)}-{_formatted(interval[1], kind, False)}"
        )
        others = [_formatted(_at(one, path), kind) for one in answer["baselines"].values()]
        table.add_row(escape(words), _formatted(_at(answer, path), kind), spread, asked, *others)
    return table


def blindtest_notes(answer: Mapping[str, Any]) -> list[str]:
    """The number of cases, which methods gave no answer, and which answers were damaged."""
    counts = answer["counts"]
    singles = sum(counts["top1"].values())
    notes = [
        f"{answer['cases']} cases: {singles} of one effect, {counts['pairs_exact']} of two, {counts['false_alarm']} of "
        f"none, {counts['unknown_confidently_blamed']} of causes outside the table."
    ]
    for name, one in {answer["answerer"]: answer, **answer["baselines"]}.items():
        if one["failed"]:
            notes.append(f"{name} gave no answer to {one['failed']}: {one['failures'][0]}")
    return [*notes, *answer.get("notes", ())]


def _at(answer: Mapping[str, Any], path: str) -> Any:
    for key in path.split("."):
        answer = answer[key]
    return answer


def _formatted(value: float | None, kind: str, unit: bool = True) -> str:
    if value is None:
        return "-"
    if kind == "%":
        return f"{100 * value:.1f}{' %' if unit else ''}"
    return f"{value:.2f}"
