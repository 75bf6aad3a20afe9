"""The interface of a method of the comparison: a cheap description, and a runner that its own process builds."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from avtorch.arrays import FloatArray
from benchmarks.peers.problem import Windows

Settings = dict[str, Any]


@dataclass(frozen=True)
class Answer:
    """A method's result for some windows.

    Attributes:
        draws: ``(chain, draw, window, parameter)`` in the parameters' own units, or ``None`` without draws.
        mean, sd: ``(window, parameter)``; NaN where the method does not estimate a parameter. Taken from the draws
            where there are some.
        ess: a ceiling on the effective draws of every window, ``(window,)``, for weighted draws.
    """

    draws: FloatArray | None = None
    mean: FloatArray | None = None
    sd: FloatArray | None = None
    ess: FloatArray | None = None


class Runner(Protocol):
    """A method with its settings, built in its own process. It keeps compiled code between calls."""

    def log_density(self, windows: Windows, z: FloatArray) -> FloatArray | None:
        """Its log density of the first window at ``z = log(parameter)``, ``(point, 3)`` to ``(point,)``.

        ``None`` if the method does not work on that density.
        """
        ...

    def run(self, windows: Windows, seed: int) -> Answer:
        """From the rows of the windows to the answer: one window, or all of them at once."""
        ...


@dataclass(frozen=True)
class Method:
    """One row of the table.

    Attributes:
        name: how ``--only`` names it.
        title: how the table names it.
        runner: module and class of its :class:`Runner` under ``benchmarks.peers``.
        needs: modules that must be installed, and ``pip``: what installs them.
        candidates: settings for one window; of several the run keeps the fastest that is accurate, on windows of its
            own. ``draws`` (a chain), or what else ``scales`` names, is then scaled so that the worst parameter gets the
            effective draws wanted, unless ``fixed``.
        batch: settings for many windows at once, or ``None``; ``batch_windows``: at most so many. Where ``scales`` is
            not ``draws`` the settings found for one window are taken.
        exact: the truth itself.
        slow: the number of windows is cut, and no trial is made.
    """

    name: str
    title: str
    runner: str
    needs: tuple[str, ...] = ()
    pip: str = ""
    candidates: tuple[Settings, ...] = ({},)
    fixed: bool = False
    scales: str = "draws"
    batch: Settings | None = None
    batch_windows: int = 1000
    exact: bool = False
    slow: bool = False

    def missing(self) -> tuple[str, ...]:
        """Modules it needs that are not installed."""
        return tuple(name for name in self.needs if find_spec(name) is None)

    def build(self, settings: Settings) -> Runner:
        module, _, runner = self.runner.partition(".")
        return getattr(import_module(f"benchmarks.peers.{module}"), runner)(settings)


def moments(answer: Answer) -> tuple[FloatArray, FloatArray]:
    """Means and SDs, ``(window, parameter)``."""
    if answer.draws is None:
        assert answer.mean is not None
        assert answer.sd is not None
        return answer.mean, answer.sd
    flat = answer.draws.reshape(-1, *answer.draws.shape[2:])
    return flat.mean(0), flat.std(0, ddof=1)


def as_log(windows: Windows) -> FloatArray:
    """Random points around the truth in ``z``, ``(point, 3)``, for comparing densities."""
    g = np.random.default_rng(len(windows))
    return np.log(windows.truth[0]) + 0.5 * g.standard_normal((20, 3))
