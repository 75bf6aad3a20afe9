"""Budgets in the cells of a table."""

from __future__ import annotations

from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import Budget


def interval(q: Quantity) -> str:
    """A quantity with its 90 % interval."""
    return f"{q.mean:.3g} ({q.q05:.3g} to {q.q95:.3g})"


def causes(budget: Budget) -> str:
    """Causes with shares and parameters, in one cell of a table."""
    if not budget.names:
        return budget.verdict[0]
    cells: list[str] = []
    for part in budget.parts:
        if part.name in budget.names:
            values = [interval(q) for q in part.parameters.values()]
            cells.append(f"{part.name} {part.share.mean:.0%}: {', '.join(values)}")
    cells += [f"{part.name}, by chance" for part in budget.chance if part.name in budget.names]
    return "; ".join(cells)
