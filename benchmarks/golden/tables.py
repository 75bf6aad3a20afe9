"""Tables of answers: all verdicts of a file, and what differs between two files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.golden.facts import NOTHING, Answer, score

Answers = Mapping[str, Answer]
PROBABILITY, SHARE, RELATIVE, ONSET_S = 0.1, 0.05, 0.1, 2.0
"""Differences of probabilities, of shares, of sizes relative to each other, and of onsets [s] that are shown."""
_TIMES = ("experiment's seconds",)


def verdict(answer: Answer) -> str:
    if "verdict" not in answer:
        return "refused" if "refused" in answer else "failed"
    return " + ".join(answer["verdict"]) + (" (partial)" if answer.get("partial") else "")


def true_names(answer: Answer) -> str:
    truth = answer.get("truth")
    if truth is None:
        return ""
    outside = f" ({', '.join(truth['outside'])} outside)" if truth.get("outside") else ""
    return " + ".join(truth["names"]) + outside


def all_verdicts(answers: Answers) -> str:
    """Counts, and a row a case."""
    lines = [*counts([answers], ["all"]), "", "| case | truth | verdict | right | P(verdict), P(truth) | CPU s |"]
    lines.append("|---|---|---|---|---|---|")
    for name, answer in answers.items():
        scored = score(answer)
        right = "" if scored is None else "yes" if scored[0] else "no"
        chances = [p for p in (_of_verdict(answer), answer.get("p_truth")) if p is not None]
        told = ", ".join(f"{p:.2f}" for p in chances)
        lines.append(f"| {name} | {true_names(answer)} | {verdict(answer)} | {right} | {told} | {_cpu(answer)} |")
    return "\n".join(lines)


def counts(files: Sequence[Answers], names: Sequence[str]) -> list[str]:
    """A row a group of cases and file: how many are right, what is named in vain, and how long it takes."""
    lines = [
        "| cases | engine | right | names found | names too many | AUROC of unknown | no answer | median s | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[str, Callable[[str, Answer], bool]] = {
        "callers": lambda name, _: name.startswith("callers/"),
        "simulated, ideal": lambda name, _: name.startswith("simulated/ideal/"),
        "simulated, ordinary": lambda name, _: name.startswith("simulated/ordinary/"),
    }
    for kind in ("none", "single", "pair", "several", "outside"):
        groups[f"simulated, {kind}"] = lambda _, answer, kind=kind: answer.get("truth", {}).get("kind") == kind
    groups["recordings"] = lambda name, _: name.startswith("recordings/")
    for group, holds in groups.items():
        for file, engine in zip(files, names, strict=True):
            some = [answer for name, answer in file.items() if holds(name, answer)]
            if not some:
                continue
            scored = [x for x in map(score, some) if x is not None]
            silent = sum("verdict" not in answer for answer in some)
            cells = (group, engine, _counted(some, scored), _auroc(some), str(silent), _spent(some))
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def _counted(some: Sequence[Answer], scored: Sequence[tuple[bool, int, int]]) -> str:
    if not scored:
        return " | | "
    true = sum(len(set(a["truth"]["names"]) - {"none"}) for a in some if a.get("truth"))
    right, hits, extra = (sum(x[i] for x in scored) for i in range(3))
    return f"{right} of {len(scored)} | {hits} of {true} | {extra}"


def _auroc(some: Sequence[Answer]) -> str:
    kinds = [(a["truth"].get("kind"), a["p_unknown"]) for a in some if a.get("truth") and "p_unknown" in a]
    outs = np.array([p for kind, p in kinds if kind == "outside"])
    # several causes may hold one outside the table
    ins = np.array([p for kind, p in kinds if kind in ("none", "single", "pair")])
    if not len(outs) or not len(ins):
        return ""
    over = outs[:, None] - ins[None]
    return f"{np.mean((over > 0) + 0.5 * (over == 0)):.2f}"


def _spent(some: Sequence[Answer]) -> str:
    wall, cpu = ([a[key] for a in some if key in a] for key in ("seconds", "cpu"))
    return f"{np.median(wall):.1f} | {np.median(cpu):.1f}" if wall else " | "


def _cpu(answer: Answer) -> str:
    return f"{answer['cpu']:.1f}" if "cpu" in answer else ""


def _of_verdict(answer: Answer) -> float | None:
    name = "+".join(sorted(answer.get("verdict", [])))
    return next((p for top, p in answer.get("top", []) if top == name), None)


def differences(old: Answers, new: Answers) -> str:
    """Counts of both, then a row a case in which more than rounding differs, the worse ones first."""
    both = [name for name in old if name in new]
    pair = [{name: file[name] for name in both} for file in (old, new)]
    lines = [*counts(pair, ["old", "new"]), ""]
    rows: list[tuple[int, str]] = []
    tally = {"worse": 0, "better": 0, "other": 0, "same": 0}
    for name in both:
        a, b = old[name], new[name]
        what, how = list(_differing(a, b)), _how(a, b)
        tally[how if what else "same"] += 1
        if what:
            order = ("worse", "better", "other").index(how)
            cells = (name, true_names(a), verdict(a), verdict(b), how, "; ".join(what), f"{_cpu(a)} → {_cpu(b)}")
            rows.append((order, f"| {' | '.join(cells)} |"))
    lines.append(", ".join(f"{count} {how}" for how, count in tally.items()) + f" of {len(both)} cases in both files.")
    for missing, where in ((old.keys() - new.keys(), "old"), (new.keys() - old.keys(), "new")):
        if missing:
            lines.append(f"In the {where} file only: {', '.join(sorted(missing))}.")
    lines += ["", "| case | truth | old | new | | what differs, old → new | CPU s |", "|---|---|---|---|---|---|---|"]
    return "\n".join([*lines, *(row for _, row in sorted(rows, key=lambda row: row[0]))])


def _how(a: Answer, b: Answer) -> str:
    """By the verdict, an answer being better than none; `other`: neither better nor worse, or of unknown truth."""
    if ("verdict" in a) != ("verdict" in b):
        return "better" if "verdict" in b else "worse"
    one, two = score(a), score(b)
    if one is None or two is None:
        return "other"
    before, after = ((right, hits - extra) for right, hits, extra in (one, two))
    return "better" if after > before else "worse" if after < before else "other"


def _differing(a: Answer, b: Answer) -> Iterable[str]:
    if a.get("log") != b.get("log"):
        yield "**another log**"
    if verdict(a) != verdict(b):
        yield "verdict"
    for key in ("refused", "failed"):
        if a.get(key) != b.get(key):
            yield f"{key}: {a.get(key, 'not')} → {b.get(key, 'not')}"
    yield from _numbers("P", _top(a), _top(b), PROBABILITY)
    true = _true_sizes(a)
    for text in _numbers("", _sizes(a), _sizes(b), RELATIVE, relative=True):
        known = true.get(text.split(" ")[0])
        yield text if known is None else f"{text} (true {known:.3g})"
    yield from _numbers("share", _shares(a), _shares(b), SHARE)
    yield from _numbers("onset [s]", _onsets(a), _onsets(b), ONSET_S)
    yield from _other(a.get("more") or {}, b.get("more") or {})


def _top(a: Answer) -> Answer:
    kept = {name: p for name, p in a.get("top", []) if p >= PROBABILITY}
    return kept | {key.removeprefix("p_"): a[key] for key in ("p_unknown", "p_none") if key in a}


def _sizes(a: Answer) -> Answer:
    """Of what the verdict names, and of the bare baseline."""
    named = set(a.get("verdict", [])) - set(NOTHING)
    sizes = {key: x for key, x in (a.get("parameters") or {}).items() if key.rpartition(".")[0] in named}
    return sizes | {key: x for key, x in (a.get("baseline") or {}).items() if key in ("T_L", "K_L")}


def _true_sizes(a: Answer) -> Answer:
    truth = a.get("truth") or {}
    sizes = {f"{name}.{key}": x for name, values in truth.get("parameters", {}).items() for key, x in values.items()}
    return sizes | (truth.get("baseline") or {})


def _shares(a: Answer) -> Answer:
    budget = a.get("budget") or {}
    shares = {part["name"]: part["share"] for part in budget.get("parts", []) if "share" in part}
    return shares | ({"unexplained": budget["unexplained"]["mean"]} if budget else {})


def _onsets(a: Answer) -> Answer:
    own = {p["name"]: p["onset_s"] for p in (a.get("budget") or {}).get("parts", []) if "onset_s" in p}
    return own | ({} if a.get("onset_s") is None else {"verdict": a["onset_s"]})


def _numbers(what: str, a: Answer, b: Answer, least: float, *, relative: bool = False) -> Iterable[str]:
    for key in dict.fromkeys([*a, *b]):
        x, y = a.get(key), b.get(key)
        if x is None or y is None:
            # a probability or share that is absent is one of nothing; a size belongs to a name, which the verdict has
            if x is not y and not relative and (what.startswith("onset") or abs(x or y or 0.0) >= least):
                yield f"{what} {key} {_number(x)} → {_number(y)}".strip()
        elif abs(x - y) > least * (max(abs(x), abs(y)) if relative else 1.0):
            yield f"{what} {key} {_number(x)} → {_number(y)}".strip()


def _number(x: Any) -> str:
    return "none" if x is None else f"{x:.3g}" if isinstance(x, float) else str(x)


def _other(a: Answer, b: Answer) -> Iterable[str]:
    for key in dict.fromkeys([*a, *b]):
        x, y = a.get(key), b.get(key)
        if key in _TIMES or x == y:
            continue
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in (x, y)):
            yield from _numbers("", {key: x}, {key: y}, RELATIVE, relative=True)
        elif all(isinstance(v, Mapping) for v in (x, y)):
            yield from (f"{key}: {text}" for text in _other(x, y))
        else:
            yield f"{key}: {_words(x)} → {_words(y)}"


def _words(x: Any) -> str:
    if isinstance(x, list):
        return ", ".join(map(_number, x)) or "nothing"
    return _number(x)
