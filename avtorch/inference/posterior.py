"""Draws of a posterior and their summaries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.inference.arviz_export import UNITS, draws_frame, inference_data, parameter_table
from avtorch.inference.chains import effective_sample_size, nested_rhat, normal_scores, quantiles_of
from avtorch.inference.exactness import Exactness

if TYPE_CHECKING:
    import pandas
    from arviz import InferenceData

SHOWN = 2
"""Windows whose parameters a posterior shows of itself."""


@dataclass(frozen=True, repr=False)
class Posterior(Displayed):
    """Draws of positive parameters for every window.

    Attributes:
        names: parameter names, in the order of the last dimension.
        draws: shape ``(chain, draw, window, parameter)``, in the parameters' own units.
        converged: ``(window,)`` bool; false where the draws were not found to follow the density: do not use them.
            Without a comparison (``exactness`` is None, as in the latent form) true means only that the chains agree.
        why: a reason for every window that did not converge, ``""`` for the others; empty where none was recorded.
        exactness: moments of the draws against those of the exact density, or None where they were not compared.
    """

    names: tuple[str, ...]
    draws: Float[Tensor, "chain draw window parameter"]
    converged: Bool[Tensor, " window"]
    why: tuple[str, ...] = ()
    exactness: Exactness | None = None

    def overview(self) -> Card:
        """Its size, whether it converged, and the parameters of the first windows."""
        chains, draws, windows, _ = self.draws.shape
        some = "window" if windows == 1 else "windows"
        title = f"Posterior of {', '.join(self.names)}: {chains} chains of {draws} draws, {windows} {some}"
        good = int(self.converged.sum())
        reason = next((f" {reason}" for reason in self.why if reason), "")
        lines = [f"{good} of {windows} windows converged.{reason}"]
        if windows > SHOWN:
            lines.append(f"The first {SHOWN} windows; summary() has all:")
        first = slice(0, SHOWN)
        part = Posterior(self.names, self.draws[:, :, first], self.converged[first])
        table = {name: values for name, values in part.summary().columns.items() if name != "converged"}
        return Card(title, tuple(lines), Frame(table), most=SHOWN * len(self.names))

    def summary(self) -> Frame:
        """A row a window and parameter: mean, sd, the 5 and 95 % quantiles, nested R-hat, effective draws."""
        stats = {"mean": self.mean, "sd": self.sd, "q05": self.quantile(0.05), "q95": self.quantile(0.95)}
        stats |= {"rhat": self.rhat, "ess_bulk": self.ess_bulk, "ess_tail": self.ess_tail}
        return parameter_table("window", self.names, stats, {"converged": self.converged})

    def to_dataframe(self) -> pandas.DataFrame:
        """The draws, a row a chain, draw and window, a column a parameter. Needs ``pip install 'avtorch[pandas]'``."""
        return draws_frame(self.names, self.draws, ("chain", "draw", "window")).to_dataframe()

    def to_arviz(self, *, window: int | None = None) -> InferenceData:
        """The draws as ``arviz.InferenceData``: one variable a parameter, with its unit in ``attrs["units"]``.

        Dimensions are ``(chain, draw, window)``, or ``(chain, draw)`` if one ``window`` is asked for. Which windows
        converged is in the group's ``attrs["converged"]``, as 0 or 1, beside the ``pareto_k`` of each. Needs ``pip
        install 'avtorch[arviz]'``.

        Raises `InputError` for a window that the posterior does not have, and where ArviZ is not installed.
        """
        windows = self.draws.shape[2]
        if window is not None and not 0 <= window < windows:
            raise InputError(f"window: {window} is not in 0 to {windows - 1}")
        kept = slice(None) if window is None else window
        dims = ("chain", "draw", "window") if window is None else ("chain", "draw")
        flags = self.converged[kept].int().reshape(-1).tolist()
        attributes = {"converged": flags, "pareto_k": self.pareto_k[kept].reshape(-1).tolist()}
        draws = {name: self[name][..., kept].cpu().numpy() for name in self.names}
        return inference_data(draws, dims, units=UNITS, attributes=attributes)

    def __getitem__(self, name: str) -> Float[Tensor, "chain draw window"]:
        """Draws of one parameter, shape ``(chain, draw, window)``."""
        return self.draws[..., self.names.index(name)]

    @property
    def flat(self) -> Float[Tensor, "all_draws window parameter"]:
        """All draws, chains behind one another: ``(chain * draw, window, parameter)``."""
        return self.draws.flatten(0, 1)

    @property
    def mean(self) -> Float[Tensor, "window parameter"]:
        """Posterior means, ``(window, parameter)``."""
        return self.flat.mean(0)

    @property
    def sd(self) -> Float[Tensor, "window parameter"]:
        """Posterior standard deviations, ``(window, parameter)``."""
        return self.flat.std(0)

    @property
    def rhat(self) -> Float[Tensor, "window parameter"]:
        """Nested R-hat (:func:`nested_rhat`), ``(window, parameter)``."""
        return nested_rhat(self.draws)

    @property
    def ess_bulk(self) -> Float[Tensor, "window parameter"]:
        """Effective draws behind the bulk, from their ranks, ``(window, parameter)``."""
        return effective_sample_size(normal_scores(self.draws))

    @property
    def ess_tail(self) -> Float[Tensor, "window parameter"]:
        """Effective draws behind the 5 % or the 95 % quantile, whichever are fewer, ``(window, parameter)``."""
        below = (effective_sample_size((self.draws <= self.quantile(q)).to(self.draws)) for q in (0.05, 0.95))
        return torch.minimum(*below)

    @property
    def pareto_k(self) -> Float[Tensor, " window"]:
        """Shape of the tail of ``density / normal fit`` over the fit, ``(window,)``; NaN where it was not computed."""
        if self.exactness is None:
            return self.draws.new_full((self.draws.shape[2],), torch.nan)
        return self.exactness.pareto_k

    def quantile(self, q: float) -> Float[Tensor, "window parameter"]:
        """Posterior quantiles, ``(window, parameter)``."""
        return quantiles_of(self.flat, q)[0]

    def log_moments(self) -> tuple[Float[Tensor, "window parameter"], Float[Tensor, "window parameter parameter"]]:
        """Mean ``(window, parameter)`` and covariance ``(window, parameter, parameter)`` of the log parameters."""
        z = self.flat.log()
        centred = z - z.mean(0)
        return z.mean(0), torch.einsum("nwi,nwj->wij", centred, centred) / (len(z) - 1)
