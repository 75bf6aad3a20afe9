"""Units of the parameters, and draws as ArviZ data, which needs the extra ``arviz``, imported when it is used."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from avtorch.arrays import Float
from avtorch.display import Frame
from avtorch.errors import InputError

if TYPE_CHECKING:
    from arviz import InferenceData

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
"""By parameter, as ArviZ and xarray write units."""


def shown_unit(name: str) -> str:
    """A parameter's unit as tables show it: ``m/s²``, ``-`` for none; empty for a parameter that is not known."""
    unit = UNITS.get(name, "")
    return "-" if unit == "1" else unit.replace("^2", "²").replace("^3", "³").replace("sqrt(s)", "√s")


def parameter_table(
    place: str, names: Sequence[str], stats: Mapping[str, Tensor], flags: Mapping[str, Tensor] | None = None
) -> Frame:
    """A row a place (window, vehicle) and parameter: ``stats`` ``(place, parameter)``, then ``flags`` ``(place,)``."""
    count = len(next(iter(stats.values())))
    return Frame(
        {
            place: [i for i in range(count) for _ in names],
            "parameter": list(names) * count,
            "unit": [shown_unit(name) for name in names] * count,
            **{key: values.flatten().tolist() for key, values in stats.items()},
            **{key: values.repeat_interleave(len(names)).tolist() for key, values in (flags or {}).items()},
        }
    )


def draws_frame(names: Sequence[str], draws: Float[Tensor, "*place parameter"], dims: Sequence[str]) -> Frame:
    """A row a draw, its place by ``dims``, and a column a parameter."""
    place = torch.meshgrid(*(torch.arange(n) for n in draws.shape[:-1]), indexing="ij")
    index = {dim: at.flatten().numpy() for dim, at in zip(dims, place, strict=True)}
    return Frame(index | {name: draws[..., i].flatten().cpu().numpy() for i, name in enumerate(names)})


def arviz() -> ModuleType:
    """ArviZ, or an `InputError` with the command that installs it."""
    with warnings.catch_warnings():
        # ArviZ 0.23 announces its successor on import
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        try:
            import arviz
        except ImportError:
            raise InputError(
                "arviz: not installed; needs pip install 'avtorch[arviz]' or 'avtorch[validate]'"
            ) from None
    return arviz


def inference_data(
    draws: Mapping[str, NDArray],
    dims: Sequence[str],
    *,
    units: Mapping[str, str],
    attributes: Mapping[str, Any],
) -> InferenceData:
    """Draws by parameter, each of the shape that ``dims`` names, as ``arviz.InferenceData``.

    A unit goes to the variable's ``attrs["units"]``. ArviZ 1.x has ``xarray.DataTree`` in place of ``InferenceData``:
    ``DataTree.from_dict({"posterior": data.posterior})`` carries over.

    Raises `InputError` where ArviZ is not installed, or there are no draws.
    """
    if not all(x.size for x in draws.values()) or not draws:
        raise InputError("draws: found none; to_arviz needs posterior draws")
    az = arviz()
    import xarray

    variables = {name: (dims, x, {"units": units[name]} if name in units else {}) for name, x in draws.items()}
    sizes = zip(dims, next(iter(draws.values())).shape, strict=True)
    coords = {dim: range(size) for dim, size in sizes}
    attrs = {"inference_library": "avtorch", **attributes}
    return az.InferenceData(posterior=xarray.Dataset(variables, coords=coords, attrs=attrs))
