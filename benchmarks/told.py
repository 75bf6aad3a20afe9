"""What the logs of a trial tell of the causes that were missed, behind an ideal recorder.

``python -m benchmarks.told --cell NAME --outside sealed --cases 20 --tiers easy medium hard --out DIR``

The options are those of `engine_trial`, whose stored answers are read. Of each case the drive is known without its
noise. Half the squared distance between it and what the answer's best set predicts, in units of that set's noise
[nats], is what any method could gain over the answer (Kay 1998, section 13.7). The errors of the set's own parameters
leave half a nat each. Prints a row a miss, and how many logs tell less than a name costs. Of what chance decides
(gusts, roads, outliers, lost messages) a drive without noise knows nothing, and where a car has stopped, noise has
moved it on or not: such causes and drives are left out.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.inference import infer
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.gap.simulator.plant import plant
from benchmarks.blindtest.case import Case
from benchmarks.blindtest.cases import draw_case
from benchmarks.blindtest.catalogue import EFFECTS
from benchmarks.engine_trial import Cell, Method, Place, Scored, options, stored


def told(case: Case) -> tuple[float, int]:
    """What the log of a case tells beyond the best set of its answer [nats], and the parameters of that set."""
    data = DriveData.of([with_sensor_noise(case.log())[0]])
    average = infer(data, baseline=plant([])).average
    h = average.best[next(iter(average.probabilities))].examined.hypothesis
    run, rows = case.run, np.round(h.data.time * case.drive.rate_hz).astype(int)
    accel = run.accel - run.noise_accel - run.chance_accel - run.felt_accel
    speed = run.speed - run.noise_speed - run.drift_speed - run.chance_speed
    silent = h.data.transform(h.data.channel_rows(accel[rows], speed[rows]))
    far = whiten(h.data, h.covariance, silent - h.predicted)
    return 0.5 * float(far @ far), len(h.free)


def main(arguments: Sequence[str] | None = None) -> int:
    given = options(arguments)
    cell = Cell(given.out, given.cell, given.outside, tuple(given.signals))
    places = [Place(cell, "ideal", tier, index) for tier in given.tiers for index in range(given.cases)]
    name = Method(given.function, given.name or "avtorch.diagnose").name
    missed = [one for one in stored(places, name) if not one.row.right and not _by_chance(one)]
    print("| case | cause | answer | beyond it [nats] | half its parameters |\n|---|---|---|---|---|")
    beyond = []
    for one in missed:
        drawn = {"tiers": (one.place.tier,), "outside": cell.outside, "signals": cell.signals}
        case = draw_case(one.place.index, cell.seed(one.place.tier), **drawn)
        if (case.run.true_speed <= 0).any():
            continue
        nats, parameters = told(case)
        beyond.append(nats - 0.5 * parameters)
        cells = (one.place.label, one.cause, one.row.verdict, f"{nats:.0f}", f"{0.5 * parameters:.1f}")
        print(f"| {' | '.join(cells)} |", flush=True)
    few = sum(nats < EFFECT_NATS for nats in beyond)
    print(f"\n{few} of {len(beyond)} logs tell less than the {EFFECT_NATS:g} nats that a name costs")
    return 0


def _by_chance(one: Scored) -> bool:
    return any(name in EFFECTS and EFFECTS[name].by_chance for name in one.truth["names"])


if __name__ == "__main__":
    sys.exit(main())
