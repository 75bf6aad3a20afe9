"""How much of the noise a random effect makes that the likelihood names."""

from __future__ import annotations

from avtorch.gap.budget.flexible_regression import left_over
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.simulator.effect import Effect


def share_of_noise(kind: type[Effect], winner: FittedModel, selection: Selection) -> float | None:
    """Share of the variance that is left with all parts; None where the fit does not tell.

    A force: of the mean over channels of what the `selection` leaves, as for a force that its residuals show; only
    where its parts are the effects of `winner`, as others would leave another force. Outliers: of the errors of the
    accelerometer's readings, row by row. What lost messages do passes through the actuator and depends on the commands
    lost, which nobody knows.
    """
    form = kind.own_search()
    if form == "force" and {e.name for e in winner.hypothesis.effects} == set(selection.last.fit.model.names):
        record = selection.fitting.whitening.record
        left = float(left_over(selection.fitting, selection.last.fit).mean(0)[record.counts].var())
        acting = 1 - (winner.gust_onset or 0) / winner.hypothesis.record.rows
        return min(acting * winner.noise.noise.force_sd**2 / left, 1.0)
    if form == "tails" and winner.tails is not None:
        noise, tails = winner.noise.noise, winner.tails
        moved = noise.sensor_scale**2 * sum(sd**2 for sd, _ in noise.forces)
        far = tails.fraction * (tails.scale * noise.accel_sd) ** 2
        return far / (far + moved + noise.accel_sd**2)
    return None
