"""Draws as ArviZ data, for its plots and diagnostics. Needs the extra ``arviz``, which is imported when it is used."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from avtorch.errors import InputError
from avtorch.inference.units import UNITS as UNITS

if TYPE_CHECKING:
    from arviz import InferenceData


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
    with warnings.catch_warnings():
        # ArviZ 0.23 announces its successor on import
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        try:
            import arviz
            import xarray
        except ImportError:
            raise InputError("arviz: not installed; to_arviz needs pip install 'avtorch[arviz]'") from None
    variables = {name: (dims, x, {"units": units[name]} if name in units else {}) for name, x in draws.items()}
    sizes = zip(dims, next(iter(draws.values())).shape, strict=True)
    coords = {dim: range(size) for dim, size in sizes}
    attrs = {"inference_library": "avtorch", **attributes}
    return arviz.InferenceData(posterior=xarray.Dataset(variables, coords=coords, attrs=attrs))
