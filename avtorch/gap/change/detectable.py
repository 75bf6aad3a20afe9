"""How small a change two sets of drives would show, and whether the drives are alike enough to be compared."""

from __future__ import annotations

import numpy as np
import torch

from avtorch.gap.change.change_model import ChangeModel
from avtorch.gap.change.change_selection import ChangeSelection
from avtorch.gap.change.two_sides import TwoSides
from avtorch.gap.simulator.effect import delay_effect, delay_key

_ERRORS = 4.0  # 2.5 standard errors are needed, and 1.5 more to have them in nine of ten drives
_RATIO = 0.1  # of T_L and K_L, for the differences
_SECONDS = 0.05  # of dead time
_WITHIN = 0.7  # share of the drives after that those before must have covered


def detectable_changes(selection: ChangeSelection) -> dict[str, float]:
    """The least change of T_L and K_L (share) and of dead time [s] that would show in nine of ten such drives.

    It is the change of one, nothing else changing: 4 standard errors over blocks.
    """
    model, p = selection.steps[0].fit.model, selection.steps[0].fit.p
    out = {}
    for key, name in (("T_L", "T_L"), ("K_L", "K_L"), (delay_key(), delay_effect().name)):
        moved = _moved(model, p, key)
        rise = (model.simulate(moved) - model.simulate(p)) * selection.sides.is_after
        unit = _SECONDS if key == delay_key() else _RATIO
        _, error = selection.fitting.sizes(selection.steps[0].fit, rise[None])
        out[name] = float(_ERRORS * unit * error[0])
    return out


def _moved(model: ChangeModel, p: np.ndarray, key: str) -> np.ndarray:
    parameter = model.before.plant.parameters()[key]
    at = model.index[key]
    value = parameter.constrain(torch.as_tensor(p[at]))
    value = value + _SECONDS if key == delay_key() else value * (1 + _RATIO)
    out = p.copy()
    out[at] = parameter.unconstrain(value).numpy()
    return out


def unlike_drives(sides: TwoSides) -> list[str]:
    """What the drives after do that those before did not: a clause for each of command and speed."""
    out = []
    for name, x in (("commands", sides.whole.command), ("speeds", sides.whole.speed)):
        if name == "speeds" and not sides.whole.has_speed:
            continue
        before, after = (x[sides.whole.counts & (sides.is_after == side)] for side in (False, True))
        low, high = np.quantile(before, (0.01, 0.99))
        share = float(((after >= low) & (after <= high)).mean())
        if share < _WITHIN:
            out.append(
                f"only {share:.0%} of the drives after are at {name} that those before cover, so what the car does "
                "there may be no change"
            )
    return out
