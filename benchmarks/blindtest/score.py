"""Scores of a set of answers to sealed cases: every measure of `blindtest.json`, with its 90 % interval."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from benchmarks.blindtest import budget_score as of_budget
from benchmarks.blindtest.answers import Answered, read_answer
from benchmarks.blindtest.deck import KINDS
from benchmarks.blindtest.intervals import (
    Interval,
    bootstrap,
    calibration_by_chance,
    calibration_error,
    cases_for,
    cases_for_mean,
    wilson,
)
from benchmarks.blindtest.parameter_score import found_sizes
from benchmarks.blindtest.visibility import TIERS

Rows = Sequence[Answered]


def score(
    truths: Sequence[Mapping[str, Any]],
    answers: Sequence[Mapping[str, Any] | None],
    *,
    seconds: Sequence[float] | None = None,
    resamples: int = 1000,
    seed: int = 0,
) -> dict[str, Any]:
    """Measures of the answers (`avtorch.diagnosis/1` or `/2`, None where there is none) to the cases of `truths`.

    The keys are those of `blindtest.json`, and also `confident_errors`, `alias_set.by_tier`, `counts` (the number of
    cases behind each measure), `intervals` (the same keys, `[low, high]` of 90 %) and `needed` (how many cases make an
    interval of ± 5 points, of shares and of measures of several causes). A measure to which no case applies is None.

    - `top1` by tier, `alias_set`: single effects only. `false_alarm`: share of the cases without a cause for which the
      verdict is not `none`. `pairs_exact`, `pairs_jaccard`: pairs.
    - `unknown_auroc`, `unknown_fpr95`: the probability of `unknown`, causes outside the table against all other cases.
      `unknown_confidently_blamed`: share of the former in which a named effect or pair has probability 0.5 or more;
      `blamed_alone`: in which the verdict names effects, and does not say that something material is left.
    - `partial_wrong`: share of the cases without a cause outside the table that are answered with `partial`.
    - `several.recall`, `.precision` (weighted by shares), `.sum_error`, `.share_error`, `.unexplained_error`,
      `.leading`, `.exact`, `.extra`: cases of several causes against the oracle's budget
      (`budget_score.py`). `part_ece`: calibration error of the budgets' parts, all cases.
    - `parameters_covered`, `parameters_right`: of the sizes of parts that are named and true, the share whose 90 %
      interval holds the true one, and the share within a quarter of it (`parameter_score.py`).
    - `utility.group`, `.weighted`, `.by_kind`: of the alias set as an ambiguity group (`ambiguity.py`).
    - `confident_errors`, `ece` (ten bins of the highest probability), `brier`: all cases. `ece_by_chance`,
      `part_ece_by_chance`: what `ece` and `part_ece` would be were these probabilities exactly right.
    - `macro_f1`: over the labels that occur; an effect found within a pair counts for that effect.
    - `closed_error`, `closed_covered` (by the 90 % interval), `onset_error_s` (median): where the verdict is right.
      `placebo_closed`: mean over the answers that report one; `placebo_nothing`: how often its interval reaches 0.
    - `where_overlap`: median intersection over union of true and named parts, where the cause acts in a known part;
      `where_nowhere`: share of the cases without a cause in which no part is named.

    Args: `seconds` that each answer took. `resamples`, `seed` of the bootstrap. Raises `InputError` for lengths that
    differ and for answers that break the schema.

    Example:
        >>> from benchmarks.blindtest import draw_cases, score
        >>> from benchmarks.blindtest.reply import reply
        >>> cases = list(draw_cases(2, seed=1, mix={"none": 1.0}, seconds=10.0))
        >>> answers = [reply(case.log(), {"none": 0.9, "dead_time": 0.1}, why="nothing to see") for case in cases]
        >>> score([case.truth() for case in cases], answers, resamples=10)["false_alarm"]
        0.0
    """
    if len(truths) != len(answers) or (seconds is not None and len(seconds) != len(truths)):
        raise InputError(f"answers: found {len(answers)} for {len(truths)} cases, needs one each")
    rows = [read_answer(truth, answer) for truth, answer in zip(truths, answers, strict=True)]
    sheet = _Sheet(resamples, seed)
    by_kind = {kind: [r for r in rows if r.kind == kind] for kind in KINDS}
    # with a cause outside the table beside others, either answer to "unknown?" is right
    clear = [r for r in rows if r.kind == "outside" or not r.outside]
    for tier in TIERS:
        of_tier = [r for r in by_kind["single"] if r.tier == tier]
        sheet.share(f"top1.{tier}", [r.right for r in of_tier])
        sheet.share(f"alias_set.by_tier.{tier}", [r.truth in r.alias_set for r in of_tier])
    sheet.share("alias_set.accuracy", [r.truth in r.alias_set for r in by_kind["single"]])
    sheet.mean("alias_set.mean_size", [len(r.alias_set) for r in by_kind["single"]])
    sheet.share("false_alarm", [not r.right for r in by_kind["none"]])
    sheet.measure("unknown_auroc", clear, auroc)
    sheet.measure("unknown_fpr95", clear, fpr95)
    sheet.share("unknown_confidently_blamed", [r.blamed >= 0.5 for r in by_kind["outside"]])
    sheet.share("blamed_alone", [r.blamed_alone for r in by_kind["outside"]])
    sheet.share("partial_wrong", [r.partial for r in rows if not r.outside])
    sheet.share("confident_errors", [r.confidence > 0.9 and r.favourite != r.truth for r in rows])
    sheet.measure("ece", rows, ece)
    sheet.by_chance("ece", [r.confidence for r in rows], seed)
    sheet.mean("brier", [r.brier for r in rows])
    sheet.measure("macro_f1", rows, macro_f1)
    sheet.share("pairs_exact", [r.right for r in by_kind["pair"]])
    sheet.mean("pairs_jaccard", [_jaccard(r) for r in by_kind["pair"]])
    _several(sheet, by_kind["several"])
    sheet.measure("part_ece", [r for r in rows if of_budget.part_probabilities(r)], part_ece)
    sheet.by_chance("part_ece", [p for r in rows for p, _ in of_budget.part_probabilities(r)], seed)
    sizes = [size for r in rows for size in found_sizes(r)]
    sheet.share("parameters_covered", [size.covered for size in sizes if size.covered is not None])
    sheet.share("parameters_right", [size.right for size in sizes if size.right is not None])
    for kind, some in {"group": rows, "weighted": rows, **{f"by_kind.{k}": by_kind[k] for k in KINDS}}.items():
        sheet.mean(f"utility.{kind}", [r.utility(weighted=kind == "weighted") for r in some])
    sheet.mean("closed_error", [r.closed_error for r in rows if r.closed_error is not None])
    sheet.share("closed_covered", [r.closed_covered for r in rows if r.closed_covered is not None])
    placebos = [r.placebo for r in rows if r.placebo is not None]
    sheet.mean("placebo_closed", [float(p["mean"]) for p in placebos])
    sheet.share("placebo_nothing", [p["q05"] <= 0 for p in placebos])
    overlaps = [r for r in rows if r.overlaps]
    sheet.measure("where_overlap", overlaps, lambda some: float(np.median([x for r in some for x in r.overlaps])))
    sheet.share("where_nowhere", [r.parts_named == 0 for r in by_kind["none"]])
    late = [r for r in rows if r.onset_error is not None]
    sheet.measure("onset_error_s", late, lambda some: float(np.median([r.onset_error or 0.0 for r in some])))
    sheet.mean("seconds_per_case", list(seconds or ()))
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    for r in rows:
        confusion[r.truth][r.verdict] += 1
    return {
        "cases": len(rows),
        **sheet.values,
        "confusion": {truth: dict(sorted(c.items())) for truth, c in sorted(confusion.items())},
        "counts": sheet.counts,
        "intervals": sheet.intervals,
        "needed": sheet.needed,
    }


def _several(sheet: _Sheet, rows: Rows) -> None:
    """Cases of several causes: which are named, and how the gap is divided among them."""

    def known(of: Callable[[Answered], float | None]) -> list[float]:
        return [value for value in map(of, rows) if value is not None]

    sheet.measure("several.recall", rows, of_budget.recall, planned=True)
    sheet.measure("several.precision", [r for r in rows if r.named], of_budget.precision, planned=True)
    sheet.mean("several.sum_error", known(of_budget.sum_error), planned=True)
    sheet.mean("several.share_error", known(of_budget.share_error), planned=True)
    sheet.mean("several.unexplained_error", known(of_budget.unexplained_error), planned=True)
    sheet.share("several.leading", [of_budget.leading_right(r) for r in rows if r.budget is not None])
    sheet.share("several.exact", [r.right for r in rows])
    sheet.share("several.extra", [of_budget.extra_names(r) for r in rows])


def auroc(rows: Rows) -> float | None:
    """Probability that a cause outside the table gets more `unknown` than another case does; None without both."""
    outside = np.array([r.kind == "outside" for r in rows])
    ins, outs = int((~outside).sum()), int(outside.sum())
    if not ins or not outs:
        return None
    ranks = rankdata(_unknown(rows))
    return float((ranks[outside].sum() - outs * (outs + 1) / 2) / (ins * outs))


def fpr95(rows: Rows) -> float | None:
    """False-positive rate of the threshold on `unknown` that detects 95 % of the causes outside the table."""
    outside = np.array([r.kind == "outside" for r in rows])
    if outside.all() or not outside.any():
        return None
    unknown = _unknown(rows)
    found = np.sort(unknown[outside])[::-1]
    threshold = found[int(np.ceil(0.95 * len(found))) - 1]
    return float(np.mean(unknown[~outside] >= threshold))


def _unknown(rows: Rows) -> FloatArray:
    return np.array([r.probabilities.get("unknown", 0.0) for r in rows])


def ece(rows: Rows, bins: int = 10) -> float | None:
    """Expected calibration error: mean difference between confidence and the share of right answers, in equal bins."""
    if not rows:
        return None
    return calibration_error([r.confidence for r in rows], [r.favourite == r.truth for r in rows], bins)


def part_ece(rows: Rows, bins: int = 10) -> float | None:
    """Expected calibration error of the probabilities that budgets give to their parts, each part for itself."""
    parts = [part for r in rows for part in of_budget.part_probabilities(r)]
    return calibration_error([p for p, _ in parts], [true for _, true in parts], bins) if parts else None


def macro_f1(rows: Rows) -> float | None:
    """Mean over labels (effects, `none`, `unknown`) of the harmonic mean of precision and recall."""
    pairs = [(set(r.truth.split("+")), set(r.verdict.split("+"))) for r in rows]
    labels = sorted(set().union(*(truth for truth, _ in pairs))) if pairs else []
    scores = []
    for label in labels:
        hit = sum(label in truth and label in named for truth, named in pairs)
        wrong = sum((label in truth) != (label in named) for truth, named in pairs)
        scores.append(2 * hit / (2 * hit + wrong))
    return float(np.mean(scores)) if scores else None


def _jaccard(r: Answered) -> float:
    truth, named = set(r.truth.split("+")), set(r.verdict.split("+"))
    return len(truth & named) / len(truth | named)


class _Sheet:
    """Collects measures, each with its number of cases and its interval; dots in a key make nested dicts."""

    def __init__(self, resamples: int, seed: int) -> None:
        self.values: dict[str, Any] = {}
        self.counts: dict[str, Any] = {}
        self.intervals: dict[str, Any] = {}
        self.needed: dict[str, Any] = {}
        self._resamples, self._seed = resamples, seed

    def _put(self, key: str, value: float | None, count: int, interval: Interval | None) -> None:
        for sheet, entry in (
            (self.values, value),
            (self.counts, count),
            (self.intervals, None if interval is None else list(interval)),
        ):
            _set(sheet, key, entry)

    def share(self, key: str, hits: Sequence[bool]) -> None:
        """A share, with Wilson's interval."""
        self._put(key, float(np.mean(hits)) if hits else None, len(hits), wilson(sum(hits), len(hits)))
        _set(self.needed, key, cases_for(sum(hits), len(hits)) if hits else None)

    def mean(self, key: str, values: Sequence[float], *, planned: bool = False) -> None:
        """A mean, bootstrapped; `planned`: also how many cases it needs."""
        known = np.asarray(values, float)
        interval = bootstrap(
            lambda index: float(known[index].mean()), len(known), resamples=self._resamples, seed=self._seed
        )
        self._put(key, float(known.mean()) if len(known) else None, len(known), interval)
        if planned:
            _set(self.needed, key, cases_for_mean(interval, len(known)))

    def measure(self, key: str, rows: Rows, of: Callable[[Rows], float | None], *, planned: bool = False) -> None:
        """Any measure of rows, with a bootstrap interval; `planned` as of a mean."""
        interval = bootstrap(
            lambda index: of([rows[i] for i in index.tolist()]), len(rows), resamples=self._resamples, seed=self._seed
        )
        self._put(key, of(rows) if rows else None, len(rows), interval)
        if planned:
            _set(self.needed, key, cases_for_mean(interval, len(rows)))

    def by_chance(self, key: str, probabilities: Sequence[float], seed: int) -> None:
        """What the calibration error `key` would be were these probabilities right."""
        value = calibration_by_chance(probabilities, seed=seed) if probabilities else None
        self._put(f"{key}_by_chance", value, len(probabilities), None)


def _set(sheet: dict[str, Any], key: str, entry: Any) -> None:
    """Put an entry in a sheet; dots in its key make nested dicts."""
    *path, last = key.split(".")
    for part in path:
        sheet = sheet.setdefault(part, {})
    sheet[last] = entry
