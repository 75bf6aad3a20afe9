"""NUTS and SGLD at the same number of gradients over all points, warm-up and burn-in included."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from avtorch.inference import JerkDensity, find_mode
from benchmarks.bias.arms import Arm, Length, run
from benchmarks.bias.control_variates import gradients_by_point
from benchmarks.bias.measure import autocorrelation_time, effective, furthest
from benchmarks.bias.windows import AMPLITUDES, Problem

HEADS = ("excitation", "method", "gradients", "mean diff. [SD]", "SD ratio", "ESS", "gradients/ESS", "seconds")
WIDTHS = (12, 44, 10, 16, 9, 8, 14, 8)
CHAINS = 64
BATCH = 20


class Printer:
    """Lines of a table in plain text or Markdown."""

    def __init__(self, *, markdown: bool) -> None:
        self.markdown = markdown

    def section(self, title: str, heads: tuple[str, ...], widths: tuple[int, ...]) -> None:
        self.widths = widths
        print(f"\n### {title}\n" if self.markdown else f"\n{title}")
        self.row(heads)
        if self.markdown:
            print("|" + "---|" * len(heads))

    def row(self, cells: tuple[str, ...]) -> None:
        if self.markdown:
            print("| " + " | ".join(cells) + " |", flush=True)
        else:
            print(" ".join(f"{cell:>{width}}" for cell, width in zip(cells, self.widths, strict=True)), flush=True)


@contextmanager
def counted() -> Iterator[mock.Mock]:
    """Counts the log densities of measured jerk that are evaluated inside."""
    original = JerkDensity.log_prob
    counter = mock.Mock()

    def log_prob(self: JerkDensity, z: Tensor) -> Tensor:
        counter()
        return original(self, z)

    with mock.patch.object(JerkDensity, "log_prob", log_prob):
        yield counter


@dataclass(frozen=True)
class Result:
    """Draws of ``z`` ``(chain, step, parameter)`` and their cost; ``shared``: all chains had the same minibatches."""

    method: str
    z: Tensor
    gradients: int
    seconds: float
    shared: bool = False


def one_window(problem: Problem, window: int) -> Problem:
    """The problem with a single window."""
    index = torch.tensor([window])
    truth = problem.truth
    fields = ("mean", "sd", "log_evidence", "error", "edge", "converged", "nodes", "mass")
    chosen: dict[str, Any] = {name: getattr(truth, name)[index] for name in fields}
    return Problem(
        problem.points,
        problem.density.select(index),
        problem.mode.select(index),
        replace(truth, **chosen),
        problem.strength[index],
    )


def by_nuts(problem: Problem, *, warmup: int, draws: int) -> Result:
    """Pyro's NUTS, one chain; its gradients are counted without those of the mode search."""
    from avtorch.inference.nuts import nuts

    density = JerkDensity(problem.density.statistics, problem.density.prior)
    with counted() as counter:
        find_mode(density)
        before = counter.call_count
        begun = time.perf_counter()
        found = nuts(density, draws=draws, warmup=warmup, seed=1)
        seconds = time.perf_counter() - begun
        gradients = counter.call_count - 2 * before
    return Result(f"NUTS (Pyro), {warmup} warm-up, {draws} draws", found.draws[:, :, 0].log(), gradients, seconds)


def by_langevin(problem: Problem, arm: Arm, gradients: int, method: str) -> Result:
    """An arm of the table with as many gradients, counted in points for minibatches."""
    share = 1.0 if arm.batch is None else arm.batch / problem.points
    chains = CHAINS if arm.batch is None else 8
    # control variates spend one pass on the gradients at the mode
    steps = int((gradients - arm.cv) / share / chains)
    burn_in = min(steps // 5, 15 if arm.batch is None else 200)
    if arm.cv:  # torch's first transform of a function costs a second, once
        gradients_by_point(problem.density, problem.mode.z)
    begun = time.perf_counter()
    z = run(arm, problem, Length(chains, burn_in, steps - burn_in))
    seconds = time.perf_counter() - begun
    return Result(method, z[:, :, 0], round(steps * chains * share), seconds, shared=arm.batch is not None)


def equal_compute(problem: Problem, printer: Printer, *, quick: bool) -> None:
    """Print the section: the vehicle (0.3 s, 1.0), or else the first one, at each strength."""
    printer.section("equal compute: NUTS and Langevin, 200 points", HEADS, WIDTHS)
    warmup, draws = (100, 100) if quick else (200, 800)
    per_strength = len(problem.strength) // len(AMPLITUDES)
    arms = {
        "SGLD averaged, h 2": Arm("", 2.0),
        "SGLD independent, h 0.3": Arm("", 0.3, noise="independent"),
        f"SGLD averaged, h 0.3, batch {BATCH}": Arm("", 0.3, BATCH),
        f"SGLD averaged, h 0.3, batch {BATCH}, CV": Arm("", 0.3, BATCH, cv=True),
    }
    for strength, name in enumerate(("weak",) if quick else ("weak", "medium", "strong")):
        window = one_window(problem, strength * per_strength + min(1, per_strength - 1))
        reference = by_nuts(window, warmup=warmup, draws=draws)
        results = [reference]
        results += [by_langevin(window, arm, reference.gradients, method) for method, arm in arms.items()]
        for result in results:
            printer.row((name, *_cells(window, result)))


def effective_of_average(centred: Tensor) -> Tensor:
    """Effective draws from the variation of the average over chains: chains that share noise count only by their own
    part."""
    squares = centred.square()
    both = torch.stack([centred, squares - squares.mean((0, 1))])
    average = both.mean(1)
    error = average.square().mean(1) * autocorrelation_time(average.movedim(0, -1)[None]).movedim(-1, 0)
    return (both.square().mean((1, 2)) * centred.shape[1] / error).amin(0)


def _cells(problem: Problem, result: Result) -> tuple[str, ...]:
    score = (result.z.exp() - problem.truth.mean[0]) / problem.truth.sd[0]
    shift = score.mean((0, 1))
    centred = score - shift
    ratio = centred.square().mean((0, 1)).sqrt()
    ess = float((effective_of_average(centred) if result.shared else effective(centred)).amin())
    worst = float(ratio.gather(-1, furthest(ratio)))
    figures = (
        f"{shift.abs().amax():.3f}",
        f"{worst:.3f}",
        f"{ess:.0f}",
        f"{result.gradients / ess:.1f}",
        f"{result.seconds:.2f}",
    )
    return (result.method, str(result.gradients), *figures)
