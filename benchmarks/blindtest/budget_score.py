"""Scores of a divided gap: an answer's names and shares against the oracle's budget of a case with several causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benchmarks.blindtest.answers import Answered


def true_shares(row: Answered) -> Mapping[str, float]:
    """The oracle's shares of the causes in the table, by name."""
    parts = (row.true_budget or {}).get("parts", ())
    return {part["names"][0]: float(part["share"]) for part in parts}


def true_unexplained(row: Answered) -> float:
    return float((row.true_budget or {})["unexplained"]["share"])


def recall(rows: Sequence[Answered]) -> float | None:
    """Of all that the table's causes take off the gaps of these cases, the part that is due to named ones.

    Where a cause outside the table takes nearly all of a gap, the rest weighs little. None where they take nothing.
    """
    found = [(share, name in row.named) for row in rows for name, share in true_shares(row).items()]
    whole = sum(share for share, _ in found)
    return sum(share for share, named in found if named) / whole if whole > 0 else None


def precision(rows: Sequence[Answered]) -> float | None:
    """Of the shares that answers give to what they name, the part given to true causes; None where nothing is named.

    Names without a share count alike, 1 for each answer, where no name of it has one: causes of chance, or an answer
    without a budget.
    """
    right = whole = 0.0
    for row in rows:
        given = {name: max(row.budget.shares.get(name, 0.0), 0.0) for name in row.named} if row.budget else {}
        if sum(given.values()) <= 0:
            given = dict.fromkeys(row.named, 1 / max(len(row.named), 1))
        right += sum(share for name, share in given.items() if name in row.truth.split("+"))
        whole += sum(given.values())
    return right / whole if whole > 0 else None


def extra_names(row: Answered) -> bool:
    """Whether a name is no cause of the case."""
    return bool(set(row.named) - set(row.truth.split("+")))


def leading_right(row: Answered) -> bool:
    """Whether the named part with the largest share is the cause with the largest share."""
    true, given = true_shares(row), {} if row.budget is None else row.budget.shares
    return bool(true and given) and max(given, key=lambda n: given[n]) == max(true, key=lambda n: true[n])


def sum_error(row: Answered) -> float | None:
    """Distance between the sums of the named parts' shares and of the oracle's; None without a budget."""
    if row.budget is None:
        return None
    return abs(sum(row.budget.shares.values()) - sum(true_shares(row).values()))


def share_error(row: Answered) -> float | None:
    """Mean distance of a true cause's share from the one named, 0 where it is not; None without a budget."""
    true = true_shares(row)
    if row.budget is None or not true:
        return None
    return sum(abs(row.budget.shares.get(name, 0.0) - share) for name, share in true.items()) / len(true)


def unexplained_error(row: Answered) -> float | None:
    """Distance between the unexplained share and the oracle's; None without a budget."""
    return None if row.budget is None else abs(row.budget.unexplained - true_unexplained(row))


def part_probabilities(row: Answered) -> list[tuple[float, bool]]:
    """Each listed part or cause of chance, named or not: its probability, and whether it is a cause of the case."""
    if row.budget is None:
        return []
    true = row.truth.split("+")
    return [(part.probability, part.name in true) for part in (*row.budget.parts, *row.budget.chance)]
