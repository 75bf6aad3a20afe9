r"""Second-order lags, in speed and in location, one derivative below Eq. 1, which the paper leaves to further work.

The GLVD's lag lies in the acceleration, which makes a car a third-order system. For cars driven by a speed or a
position command the lag is in a lower derivative, and the system is of second order:

.. math::
    \text{speed:}\quad & \dot v = -v/T_V + (K_V/T_V)\, v_{cmd} + \epsilon \\
    \text{location:}\quad & T_P^2\, \dot v + 2 \zeta T_P\, v + x = x_{cmd} + T_P^2\, \epsilon

with :math:`\dot x = v` in both. ``T_V``, ``T_P`` [s] are lags, ``K_V`` [-] the realised share of the demanded speed,
``zeta`` [-] the damping; ``epsilon`` [m/s²] is noise on the acceleration. A location has no gain: it would depend on
where the road is measured from. Behind a target that moves at a steady ``v`` the car stays ``2 zeta T_P v`` back.

Everything broadcasts over leading dimensions and is differentiable in parameters, states and commands.
"""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.arrays import Float, Real
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Batch, Number, Signal, broadcast, checked
from avtorch.vehicle.glvd import glvd_rollout


class SpeedLag(torch.nn.Module):
    """A first-order lag between commanded and realised speed, with parameters ``T_V`` [s] > 0, ``K_V`` [-] >= 0.

    Raises:
        InputError: for values out of range.

    Example:
        >>> import torch
        >>> from avtorch.vehicle import SpeedLag
        >>> car = SpeedLag(T_V=0.8, K_V=0.95)
        >>> v = car.rollout(20.0, torch.full((400,), 22.0, dtype=torch.float64), dt=0.01)
        >>> tuple(v.shape), round(float(v[-1].detach()), 2)  # near 0.95 times 22 m/s
        ((400,), 20.89)
    """

    def __init__(self, T_V: Number, K_V: Number) -> None:
        super().__init__()
        self.T_V = torch.nn.Parameter(checked("T_V", T_V, unit="s", above=0.0).detach().clone())
        self.K_V = torch.nn.Parameter(checked("K_V", K_V, least=0.0).detach().clone())

    def rollout(self, v0: Number, v_cmd: Real[Tensor, "*#batch time"], dt: float) -> Float[Tensor, "*all time"]:
        """Speeds at steps 1…N under commands ``(..., time)``, each held for ``dt`` [s]; exact, ``(..., time)``.

        The recursion is Eq. 1's with speed in place of acceleration.
        """
        return glvd_rollout(v0, v_cmd, self.T_V, self.K_V, dt)

    forward = rollout


class PositionLag(torch.nn.Module):
    """A second-order lag between commanded and realised position, with ``T_P`` [s] > 0 and ``zeta`` [-] >= 0.

    Raises:
        InputError: for values out of range.

    Example:
        >>> import torch
        >>> from avtorch.vehicle import PositionLag
        >>> car, zero = PositionLag(T_P=0.5, zeta=1.0), torch.zeros((), dtype=torch.float64)
        >>> x, v = car.rollout(zero, zero, torch.ones(300, dtype=torch.float64), dt=0.01)
        >>> round(float(x[-1].detach()), 3)  # of the 1 m asked for, after 3 s
        0.983
    """

    def __init__(self, T_P: Number, zeta: Number) -> None:
        super().__init__()
        self.T_P = torch.nn.Parameter(checked("T_P", T_P, unit="s", above=0.0).detach().clone())
        self.zeta = torch.nn.Parameter(checked("zeta", zeta, least=0.0).detach().clone())

    def rollout(
        self, x0: Batch, v0: Batch, x_cmd: Signal, dt: float
    ) -> tuple[Float[Tensor, "*all time"], Float[Tensor, "*all time"]]:
        """Positions [m] and speeds [m/s] at steps 1…N, each ``(..., time)``, under held commands ``(..., time)``.

        Exact: the step is the exponential of the 2 by 2 system, which is differentiable through critical damping too.

        Raises:
            InputError: for a ``dt`` that is no positive number.
        """
        if not 0 < dt < float("inf"):
            raise InputError(f"dt: found {dt!r}, needs a finite time step > 0 s")
        T, zeta = broadcast(self.T_P, self.zeta)
        zero = torch.zeros_like(T)
        rates = torch.stack([torch.stack([zero, zero + 1], -1), torch.stack([-(T**-2), -2 * zeta / T], -1)], -2)
        step = torch.matrix_exp(dt * rates)
        state = torch.stack(broadcast(x0, v0), -1)
        rest = torch.stack([x_cmd, torch.zeros_like(x_cmd)], -1)  # where each command would come to rest
        out: list[Tensor] = []
        for target in rest.unbind(-2):
            state = target + (step @ (state - target).unsqueeze(-1)).squeeze(-1)
            out.append(state)
        x, v = torch.stack(out, -2).unbind(-1)
        return x, v

    forward = rollout
