"""Dead band: small commands have no effect."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class DeadBand(Effect):
    """Soft threshold of `|u|` at `half_width_mps2`; neutral at 0.

    Possible up to 1 m/s², an eighth of full braking.

    Example:
        >>> import torch
        >>> from avtorch.gap import DeadBand, SimulatorInput, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> command = torch.tensor([[0.05], [0.5]], dtype=torch.float64).expand(2, 200)  # a faint and a firm command
        >>> accel = plant([DeadBand(0.08)]).response(SimulatorInput(time, command)).accel
        >>> accel[:, -1].round(decimals=2).tolist()
        [0.0, 0.42]
    """

    half_width_mps2: Number = 0.08

    name = "dead_band"
    place = "command"
    order = 2
    meaning = "commands within a band do nothing, larger ones are reduced by its half width"
    words = "commands of less than {half_width_mps2:.2g} m/s² do nothing"
    equation = "sign(u) max(|u| - delta, 0)"
    parameters = (Parameter("half_width_mps2", "m/s²", 0.0, 0.02, 0.3, possible=(0.0, 1.0)),)

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        width = tensor(self.half_width_mps2)
        return (x - width).clamp_min(0.0) + (x + width).clamp_max(0.0)
