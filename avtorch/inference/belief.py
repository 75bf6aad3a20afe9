"""The belief about every vehicle after a window, for any estimator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int
from avtorch.display import Card, Displayed, Frame
from avtorch.inference.arviz_export import UNITS, draws_frame, inference_data, parameter_table
from avtorch.inference.chains import quantiles_of
from avtorch.inference.device import Device
from avtorch.inference.priors import Prior

if TYPE_CHECKING:
    import pandas
    from arviz import InferenceData

Z90 = 1.6448536269514722
"""The standard normal's 95 % quantile: 90 % lie within this many SDs."""

_FIGURES = ("mean", "sd", "q05", "q95")
_TENSORS = (*_FIGURES, "draws", "excited", "converged")


class Summary(NamedTuple):
    """Summary of some vehicles: ``draws`` ``(draw, vehicle, parameter)``, the rest ``(vehicle, parameter)``."""

    mean: Float[Tensor, "vehicle parameter"]
    sd: Float[Tensor, "vehicle parameter"]
    q05: Float[Tensor, "vehicle parameter"]
    q95: Float[Tensor, "vehicle parameter"]
    draws: Float[Tensor, "draw vehicle parameter"]

    @classmethod
    def log_normal(
        cls,
        mean_z: Float[Tensor, "vehicle parameter"],
        cov_z: Float[Tensor, "vehicle parameter parameter"],
        kept: int,
        generator: torch.Generator,
    ) -> Summary:
        """Summary of parameters with normal logarithms: moments and quantiles in closed form, and ``kept`` draws.

        `mean_z`: ``(vehicle, parameter)``. cov_z: ``(vehicle, parameter, parameter)``, positive semidefinite.
        """
        sd_z = cov_z.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
        mean = (mean_z + 0.5 * sd_z.square()).exp()
        values, basis = torch.linalg.eigh(cov_z)  # a known parameter has no spread, and no Cholesky factor
        noise = torch.randn(kept, *mean_z.shape, generator=generator, dtype=mean_z.dtype, device=mean_z.device)
        draws = mean_z + torch.einsum("vij,kvj->kvi", basis * values.clamp_min(0.0).sqrt().unsqueeze(-2), noise)
        low, high = (mean_z - Z90 * sd_z).exp(), (mean_z + Z90 * sd_z).exp()
        return cls(mean, mean * sd_z.square().expm1().sqrt(), low, high, draws.exp())

    def put(self, index: Int[Tensor, " some"], other: Summary) -> Summary:
        """The vehicles ``index`` taken from ``other``."""
        figures = (mine.index_copy(0, index, theirs) for mine, theirs in zip(self[:4], other[:4], strict=True))
        return Summary(*figures, draws=self.draws.index_copy(1, index, other.draws))

    def select(self, where: Bool[Tensor, " vehicle"]) -> Summary:
        """The vehicles ``where`` it is true."""
        return Summary(*(x[where] for x in self[:4]), draws=self.draws[:, where])


@dataclass(frozen=True, repr=False)
class Belief(Displayed):
    """The belief about every vehicle after a window.

    Attributes:
        names: parameter names, ``T_L`` [s] and ``K_L`` [-] first, then the noise parameters.
        mean, sd, q05, q95: shape ``(vehicle, parameter)``.
        draws: ``(draw, vehicle, parameter)``.
        excited: ``(vehicle,)`` bool; where false the window was not used and the rest is carried over unchanged.
        converged: ``(vehicle,)`` bool; false where the window was excited but its chains did not settle: carried over,
            too. In the latent form true means only that the chains agree (see `Posterior`).
    """

    names: tuple[str, ...]
    mean: Float[Tensor, "vehicle parameter"]
    sd: Float[Tensor, "vehicle parameter"]
    q05: Float[Tensor, "vehicle parameter"]
    q95: Float[Tensor, "vehicle parameter"]
    draws: Float[Tensor, "draw vehicle parameter"]
    excited: Bool[Tensor, " vehicle"]
    converged: Bool[Tensor, " vehicle"]

    def overview(self) -> Card:
        """How many vehicles, how many of them the window updated, and the parameters of the first."""
        vehicles = len(self.excited)
        used = int((self.excited & self.converged).sum())
        if vehicles == 1:
            line = "The last window updated it." if used else "The last window was not used; it is the belief before."
        else:
            line = f"The last window updated {used} of {vehicles}; the others keep the belief before it."
        title = f"Belief about {vehicles} vehicle{'' if vehicles == 1 else 's'}: {', '.join(self.names)}"
        left_out = ("used",) if vehicles > 1 else ("used", "vehicle")
        table = {key: values for key, values in self.summary().columns.items() if key not in left_out}
        return Card(title, (line,), Frame(table), most=2 * len(self.names))

    def summary(self) -> Frame:
        """A row a vehicle and parameter: mean, sd, the 5 and 95 % quantiles; `used`: the window updated it."""
        stats = {key: getattr(self, key) for key in _FIGURES}
        return parameter_table("vehicle", self.names, stats, {"used": self.excited & self.converged})

    def to_dataframe(self) -> pandas.DataFrame:
        """The draws, a row a draw and vehicle, a column a parameter. Needs ``pip install 'avtorch[pandas]'``."""
        return draws_frame(self.names, self.draws, ("draw", "vehicle")).to_dataframe()

    def to_arviz(self) -> InferenceData:
        """The draws as one chain, variables ``(chain, draw, vehicle)``. Needs ``pip install 'avtorch[arviz]'``.

        The draws of a belief are independent or thinned: R-hat of one chain says nothing, see :meth:`Posterior.rhat`.
        """
        draws = {name: self.draws[..., i].unsqueeze(0).cpu().numpy() for i, name in enumerate(self.names)}
        attributes = {"used": (self.excited & self.converged).int().tolist()}
        return inference_data(draws, ("chain", "draw", "vehicle"), units=UNITS, attributes=attributes)

    def stat(self, name: str, vehicle: int = 0) -> dict[str, float]:
        """``{"mean", "sd", "q05", "q95"}`` of one parameter of one vehicle."""
        i = self.names.index(name)
        return {key: float(getattr(self, key)[vehicle, i]) for key in _FIGURES}

    def updated(
        self,
        excited: Bool[Tensor, " vehicle"],
        index: Int[Tensor, " used"],
        found: Summary,
        converged: Bool[Tensor, " used"],
    ) -> Belief:
        """After a window: ``found`` of the vehicles ``index`` where it ``converged``, all others carried over."""
        before = Summary(self.mean, self.sd, self.q05, self.q95, self.draws)
        after = before.put(index[converged], found.select(converged))
        return Belief(self.names, *after, excited, torch.ones_like(excited).index_put((index,), converged))

    def unused(self, excited: Bool[Tensor, " vehicle"]) -> Belief:
        """After a window that no vehicle used: all carried over."""
        return replace(self, excited=excited, converged=torch.ones_like(excited))

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors, on the processor, and names."""
        return {"names": list(self.names), **{key: getattr(self, key).cpu() for key in _TENSORS}}

    def to(self, device: Device) -> Belief:
        """The same on another device."""
        return Belief(self.names, *(getattr(self, key).to(device) for key in _TENSORS))

    @classmethod
    def of_state(cls, state: Mapping[str, Any], device: Device) -> Belief:
        """The inverse of :meth:`state_dict`; other entries are ignored."""
        return cls(tuple(state["names"]), *(state[key].clone().to(device) for key in _TENSORS))

    @classmethod
    def of_prior(cls, names: tuple[str, ...], prior: Prior, kept: int, vehicles: int, g: torch.Generator) -> Belief:
        """The belief before any window: ``kept`` draws of the prior, from the generator ``g``."""
        draws = prior.sample(kept, vehicles, generator=g).exp()
        q05, q95 = quantiles_of(draws, 0.05, 0.95)
        never = torch.zeros(vehicles, dtype=torch.bool, device=draws.device)
        return cls(names, draws.mean(0), draws.std(0), q05, q95, draws, excited=never, converged=~never)
