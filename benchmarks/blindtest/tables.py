"""The table that a blind test prints, with aims and rivals."""

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
    ("outside, blamed on effects alone", "blamed_alone", "%", "≤ 10 %"),
    ("outside, an effect at 0.5 or more", "unknown_confidently_blamed", "%", ""),
    ("partial without reason", "partial_wrong", "%", ""),
    ("calibration error", "ece", "", "≤ 0.05"),
    ("the same, were it calibrated", "ece_by_chance", "", ""),
    ("Brier score", "brier", "", ""),
    ("macro F1", "macro_f1", "", ""),
    ("pairs exact", "pairs_exact", "%", "≥ 80 %"),
    ("pairs, Jaccard", "pairs_jaccard", "", "≥ 0.9"),
    ("several, recall by share", "several.recall", "", "≥ 0.85"),
    ("several, precision by share", "several.precision", "", "≥ 0.90"),
    ("several, sum of shares off", "several.sum_error", "", "≤ 0.05"),
    ("several, unexplained share off", "several.unexplained_error", "", "≤ 0.10"),
    ("several, each share off", "several.share_error", "", ""),
    ("several, leading cause", "several.leading", "%", ""),
    ("several, a name too many", "several.extra", "%", ""),
    ("parts, calibration error", "part_ece", "", "≤ 0.05"),
    ("the same, were they calibrated", "part_ece_by_chance", "", ""),
    ("sizes, 90 % intervals that hold", "parameters_covered", "%", "85 to 95 %"),
    ("sizes within 25 %", "parameters_right", "%", ""),
    ("utility of the alias set", "utility.group", "", ""),
    ("onset error, median [s]", "onset_error_s", "", "≤ 5"),
    ("seconds per case", "seconds_per_case", "", ""),
)


def blindtest_table(answer: Mapping[str, Any]) -> Table:
    """One row per measure; `answer` as of `run_trial`. Measures without a case are left out."""
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
    """The number of cases, and which methods gave no answer."""
    counts = answer["counts"]
    singles = sum(counts["top1"].values())
    notes = [
        f"{answer['cases']} cases: {singles} of one effect, {counts['pairs_exact']} of two, {counts['false_alarm']} of "
        f"none, {counts['unknown_confidently_blamed']} of causes outside the table, {counts['several']['exact']} of "
        "several at once."
    ]
    notes += _too_few(answer)
    for name, one in {answer["answerer"]: answer, **answer["baselines"]}.items():
        if one["failed"]:
            notes.append(f"{name} gave no answer to {one['failed']}: {one['failures'][0]}")
    return notes


# the measures that have an aim, and the cases that they are of
_OF = {
    "top1.easy": "easy singles",
    "top1.medium": "medium singles",
    "top1.hard": "hard singles",
    "top1.faint": "faint singles",
    "false_alarm": "none",
    "pairs_exact": "pairs",
    "blamed_alone": "outside",
    "several.recall": "several",
    "several.precision": "several",
}


def _too_few(answer: Mapping[str, Any]) -> list[str]:
    """One line on the kinds that have too few cases for intervals of 5 points on either side; none if all have enough.

    How many are enough depends on the measure; of a kind the largest number counts.
    """
    wanted: dict[str, tuple[int, int]] = {}
    for path, kind in _OF.items():
        needed, has = _at(answer["needed"], path), _at(answer["counts"], path)
        if needed is not None and needed > has:
            wanted[kind] = max(wanted.get(kind, (0, 0)), (needed, has))
    if not wanted:
        return []
    short = ", ".join(f"{needed} {kind} (of {has})" for kind, (needed, has) in wanted.items())
    whole = max(needed / has for needed, has in wanted.values()) * answer["cases"]
    return [
        f"Too few cases for intervals of ± 5 points, which take {short}: some {_two_digits(whole)} cases of this mix."
    ]


def _two_digits(number: float) -> int:
    """Rounded up to two digits."""
    unit = 10 ** max(len(str(int(number))) - 2, 0)
    return -(-int(number + 0.999999) // unit) * unit


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
