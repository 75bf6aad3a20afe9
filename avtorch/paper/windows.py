"""The paper's protocol of estimation: windows of 5 s at 100 Hz, three to form a prior, seven more (Section 3.3)."""

from __future__ import annotations

from torch import Tensor

from avtorch.inference import BeliefStream
from avtorch.inference.stream import Window
from avtorch.io.log import STANDSTILL_MPS
from avtorch.paper.drive import NOISE, Progress, noise_seeds
from avtorch.paper.leaders import SWEEP_S
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader

WINDOW_S = 5.0
FOR_PRIOR, MORE = 3, 7


def ten_windows(
    leader: Leader, T_L: Tensor, K_L: Tensor, *, seed: int, progress: Progress
) -> tuple[list[Window], list[Tensor]]:
    """Vehicles T_L [s], K_L [-] (run,) behind `leader`, each with its own noise and its own belief.

    The nominal controller drives, its demand passed through. Returns the ten windows and, of each, the RMS of the
    command (run,) [m/s²].
    """
    runs = len(T_L)
    loop = ClosedLoop(leader, plant=GLVDPlant(T_L, K_L, sigma=NOISE), scenarios=runs, seeds=noise_seeds(seed, runs))
    stream = BeliefStream(window=WINDOW_S, vehicles=runs, seed=seed, check_units=False)
    windows: list[Window] = []
    asked: list[Tensor] = []
    while loop.time < SWEEP_S - 1e-9:
        block = loop.advance(round(WINDOW_S / loop.dt))
        columns = {name: getattr(block, name) for name in stream.form.columns}
        moving = block.speed >= STANDSTILL_MPS
        windows += stream.feed(block.time, columns, usable=moving, until=loop.time)
        asked.append(block.accel_cmd.square().mean(-1).sqrt())
        progress(loop.time / SWEEP_S)
    return windows, asked
