"""A budget's selection of effects that are known by other means, such as the likelihood of a hypothesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Selection, Step, one_by_one
from avtorch.gap.simulator.effect import Effect


def given_effects(
    fitting: RobustFit,
    bare: Fit,
    kinds: Sequence[type[Effect]],
    *,
    values: Mapping[str, float],
    onsets: Mapping[str, float],
) -> Selection:
    """The effects `kinds` fitted to the budget's record, one step each.

    `values` by `effect.parameter`: where the fit begins. `onsets` [s] from the log's start, by effect.
    """
    first = Step(bare, fitting.hold_out(bare))
    if not kinds:
        return Selection(fitting, (first,))
    model = EffectModel(bare.model.record, bare.model.base, tuple(kinds), dict(onsets))
    parameters = model.plant.parameters()
    known = dict(bare.known)
    for key, value in values.items():
        if key in model.index and parameters[key].size == 1:
            z = float(parameters[key].unconstrain(torch.tensor(value, dtype=torch.float64)))
            known[key] = np.array([z])
    # the lag that goes with these values, and the one of the bare baseline
    with_lag = {key: z for key, z in known.items() if key not in ("T_L", "K_L") or key in values}
    starts = np.stack([model.coordinates(with_lag), model.coordinates({**with_lag, **bare.known})])
    fit = fitting.fit(model, np.clip(starts, model.low, model.high), iterations=12)
    last = Step(fit, fitting.hold_out(fit), fit.model.names[-1])
    return Selection(fitting, (first, *one_by_one(fitting, last, {}, {})))
