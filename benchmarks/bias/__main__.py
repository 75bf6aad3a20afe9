"""Distance of SGLD's law from the posterior: step, batch, preconditioner, control variates, noise, schedule.

    python -m benchmarks.bias [--quick] [--markdown] [--only WORD]

Twelve windows of 200 points and twelve of 2000 (four vehicles, weak to strong excitation), truth by quadrature. Every
arm samples at the window's automatic pace. One row per arm has, for either length: largest difference of means in
posterior SDs over the three parameters, the SD ratio of the worst of them, what the closed form predicts for it (for
schedules: the SD ratio within a single chain instead), effective draws per step of one chain, and the share of windows
whose chains diverged or never approached the mode. Where there are two numbers the first is the median over windows and
the second the worst. The last section compares NUTS and SGLD at the same number of gradients over all points.
"""

from __future__ import annotations

import argparse
import time
from itertools import groupby

import torch
from torch import Tensor

from benchmarks.bias.arms import LONG, Arm, every_arm, length, predict, run
from benchmarks.bias.equal_compute import Printer, equal_compute
from benchmarks.bias.law import point_covariance
from benchmarks.bias.measure import Measured, furthest, measure
from benchmarks.bias.windows import Problem, problem

ARM_HEADS, ARM_WIDTHS = ("step", "batch", "precond.", "CV", "noise"), (4, 5, 8, 3, 25)
HEADS, WIDTHS = ("mean diff. [SD]", "SD ratio", "predicted", "ESS/step", "lost"), (15, 13, 13, 8, 4)


def both(value: Tensor, worst: Tensor | None = None) -> str:
    """Median over windows, and the worst of them."""
    kept = value[~value.isnan()]
    if not len(kept):
        return "-"
    last = kept.amax() if worst is None else worst
    return f"{number(kept.median())} ({number(last)})"


def number(value: Tensor | float) -> str:
    x = float(value)
    if x < 0.0005:
        return "<0.001"
    return "inf" if x == float("inf") else f"{x:.3f}" if x < 10 else f"{x:.1f}"


def worst_ratio(ratio: Tensor) -> Tensor:
    """The ratio of the window that is furthest from one."""
    kept = ratio[~ratio.isnan()]
    return kept[furthest(kept).squeeze(-1)] if len(kept) else torch.tensor(torch.nan)


def arm_cells(arm: Arm) -> tuple[str, ...]:
    """The arm's settings."""
    batch = "full" if arm.batch is None else str(arm.batch)
    return (f"{arm.step:g}", batch, arm.whitening, "yes" if arm.cv else "", arm.label)


def cells(arm: Arm, found: Measured, predicted: Tensor | None) -> tuple[str, ...]:
    """Its results on the windows of one length."""
    if bool(found.lost.all()):
        return ("-", "-", "-", "-", "100%")
    third = number(found.one_chain.nanmedian()) if arm.section == LONG else "-"
    if predicted is not None:
        each = predicted.gather(-1, furthest(predicted)).squeeze(-1)
        third = both(each, worst_ratio(each))
    return (
        both(found.mean_difference),
        both(found.sd_ratio, worst_ratio(found.sd_ratio)),
        third,
        number(found.ess_per_step.nanmedian()),
        f"{found.lost.double().mean():.0%}",
    )


def check(problem: Problem, found: Measured, predicted: Tensor) -> Tensor:
    """Relative difference of the SD ratio from the closed form, and its Monte Carlo error: ``(2, strong window)``."""
    strong = (problem.strength == 2) & ~found.lost
    expected = predicted.gather(-1, found.parameter[:, None]).squeeze(-1)
    return torch.stack([(found.sd_ratio / expected - 1).abs(), found.sd_error / found.sd_ratio])[:, strong]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter chains, 200 points only, three windows")
    parser.add_argument("--markdown", action="store_true", help="print Markdown tables")
    parser.add_argument("--only", default="", help="only sections whose title contains this word")
    options = parser.parse_args()
    torch.set_num_threads(1)
    begun = time.perf_counter()
    problems: list[Problem] = [problem(200, vehicles=1)] if options.quick else [problem(200), problem(2000)]
    covariances = [{cv: point_covariance(p, control_variates=cv) for cv in (False, True)} for p in problems]
    printer = Printer(markdown=options.markdown)
    checks: list[Tensor] = []
    for section, arms in groupby(every_arm(), key=lambda arm: arm.section):
        if options.only not in section:
            continue
        own = tuple("one chain" if section == LONG and head == "predicted" else head for head in HEADS)
        heads = tuple(head if len(problems) == 1 else f"{head} {p.points}" for p in problems for head in own)
        printer.section(section, ARM_HEADS + heads, ARM_WIDTHS + tuple(w + 5 for w in WIDTHS) * len(problems))
        errors: list[Tensor] = []
        for arm in arms:
            found = [measure(p, run(arm, p, length(arm, quick=options.quick))) for p in problems]
            predictions = [predict(arm, p, c) for p, c in zip(problems, covariances, strict=True)]
            each = (cells(arm, f, t) for f, t in zip(found, predictions, strict=True))
            printer.row(sum(each, arm_cells(arm)))
            errors += [f.sd_error for f in found]
            if arm.whitening == "full":
                checks += [
                    check(p, f, t) for p, f, t in zip(problems, found, predictions, strict=True) if t is not None
                ]
        error = torch.cat(errors)
        summary = f"median {number(error.nanmedian())}, largest {number(error.nan_to_num(0.0).amax())}"
        print(f"\nMonte Carlo error of an SD ratio here: {summary}")
    if checks:
        gap, error = torch.cat(checks, -1)
        print(f"\nClosed form against measurement, whitened, strong excitation, {len(gap)} windows and arms:")
        print(f"difference of the SD ratio: median {gap.median():.1%}, 95 % {gap.quantile(0.95):.1%}, ", end="")
        print(f"largest {gap.amax():.1%}; in Monte Carlo errors: median {(gap / error).median():.1f}")
    if options.only in "equal compute":
        equal_compute(problems[0], printer, quick=options.quick)
    print(f"\n{time.perf_counter() - begun:.0f} s, one thread, torch {torch.__version__}")


if __name__ == "__main__":
    main()
