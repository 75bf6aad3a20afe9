"""Posteriors as ArviZ data, for its plots and diagnostics. Needs the extra ``arviz``, so import it by its path."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from avtorch.errors import InputError
from avtorch.inference.posterior import Posterior

if TYPE_CHECKING:
    from arviz import InferenceData

#: Units of the parameters of either form; names not listed carry none.
UNITS = {
    "T_L": "s",
    "K_L": "1",
    "sigma": "m/s^3",
    "process_noise": "m/s^2/sqrt(s)",
    "road_noise": "m/s/sqrt(s)",
    "speed_noise": "m/s",
    "accel_noise": "m/s^2",
    "coloured_sd": "m/s^2",
    "coloured_time": "s",
}


def to_arviz(posterior: Posterior, *, window: int | None = None) -> InferenceData:
    """The draws as ``arviz.InferenceData``: one variable a parameter, with its unit in ``attrs["units"]``.

    Dimensions are ``(chain, draw, window)``, or ``(chain, draw)`` if one ``window`` is asked for. Which windows
    converged is in the group's ``attrs["converged"]``, as 0 or 1, beside the ``pareto_k`` of each. ArviZ 1.x has
    ``xarray.DataTree`` in place of ``InferenceData``: ``DataTree.from_dict({"posterior": to_arviz(p).posterior})``
    carries over.

    Raises:
        InputError: for a window that the posterior does not have.
    """
    import xarray

    with warnings.catch_warnings():
        # ArviZ 0.23 announces its successor on import
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        import arviz

    chains, draws, windows, _ = posterior.draws.shape
    if window is not None and not 0 <= window < windows:
        raise InputError(f"window: {window} is not in 0 to {windows - 1}")
    kept = slice(None) if window is None else window
    dims = ("chain", "draw", "window") if window is None else ("chain", "draw")
    sizes = dict(zip(dims, (chains, draws, windows), strict=False))
    variables = {
        name: (dims, posterior[name][..., kept].numpy(), {"units": UNITS[name]} if name in UNITS else {})
        for name in posterior.names
    }
    flags = posterior.converged[kept].int().reshape(-1).tolist()
    k = posterior.pareto_k[kept].reshape(-1).tolist()
    attributes = {"converged": flags, "pareto_k": k, "inference_library": "avtorch"}
    data = xarray.Dataset(variables, coords={dim: range(size) for dim, size in sizes.items()}, attrs=attributes)
    return arviz.InferenceData(posterior=data)
