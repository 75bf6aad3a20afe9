"""A device that every machine has: its numbers lie on the processor, and it is as strict as a real one, or stricter.

Within `OtherDevice` a tensor made with `device=ELSEWHERE` says that it is there. As on a graphics card, it cannot meet
a tensor of the processor in one operation (but for a single number), NumPy does not see it, and random numbers need a
generator that is there, too. So a `torch.zeros(...)` that was given no device ends the test. Indices, which CUDA would
take from the processor and copy, have to be there as well. As the numbers are the processor's, a computation has to
give there what it gives here.

How often a number is fetched from there, for which a real device has to wait, is counted in `fetched`.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

ELSEWHERE = torch.device("meta")
"""Its name: that of the only device without numbers of its own that torch has everywhere."""

_aten = torch.ops.aten
_FETCHES = (_aten._local_scalar_dense.default, _aten.nonzero.default, _aten.equal.default, _aten.masked_select.default)
_MAKES_A_COPY = (_aten._to_copy.default, _aten.copy_.default)

HereGenerator = torch.Generator


class GeneratorElsewhere(HereGenerator):
    """Its random numbers are those of the processor's generator of this seed."""

    def __new__(cls, device: Any = "cpu") -> HereGenerator:  # type: ignore[misc]
        if torch.device(device) != ELSEWHERE:
            return HereGenerator(device)
        return super().__new__(cls)

    def __init__(self, device: Any = "cpu") -> None: ...

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return ELSEWHERE


class Elsewhere(Tensor):
    """A tensor on the other device, around one on the processor."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> Elsewhere:
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype,
            device=ELSEWHERE,
        )  # fmt: skip
        made.here = here
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func}: a tensor of the other device outside `OtherDevice`")

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("numpy: the tensor is not on the processor")

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("numpy: the tensor is not on the processor")

    def __repr__(self, **kwargs: Any) -> str:  # type: ignore[override]
        return f"Elsewhere({self.here!r})"


class Strayed(AssertionError):
    """Tensors of both devices met in an operation."""


class OtherDevice(TorchDispatchMode):
    """Within it the other device exists."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: Counter[str] = Counter()
        self.calls = 0
        self._values = _Values()
        self._patch = pytest.MonkeyPatch()

    def __enter__(self) -> OtherDevice:
        self._patch.setattr(torch, "Generator", GeneratorElsewhere)
        self._values.__enter__()
        return super().__enter__()

    def __exit__(self, *fault: Any) -> None:
        super().__exit__(*fault)
        self._values.__exit__(*fault)
        self._patch.undo()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        there = [x for x in given if isinstance(x, Elsewhere)]
        named = kwargs.get("device")
        copies = func in _MAKES_A_COPY
        if there and not copies:
            strays = [x for x in given if not isinstance(x, Elsewhere) and (x.dim() or "index" in str(func))]
            if strays:
                raise Strayed(f"{func}: a tensor {tuple(strays[0].shape)} of the processor among those elsewhere")
        if func is _aten.copy_.default:
            on = isinstance(args[0], Elsewhere)
        else:
            on = torch.device(named) == ELSEWHERE if named is not None else bool(there)
        self.calls += bool(there)
        if there and (func in _FETCHES or (copies and not on)):
            self.fetched[str(func)] += 1
        here = {**kwargs, "device": torch.device("cpu")} if named is not None else kwargs
        out = func(*tree_map(_here, args), **tree_map(_here, here))
        if not on or func in _FETCHES[:1]:
            return out
        out = tree_map(lambda x: Elsewhere(x) if isinstance(x, Tensor) else x, out)
        return return_and_correct_aliasing(func, args, kwargs, out)


def _here(x: Any) -> Any:
    return x.here if isinstance(x, Elsewhere) else x


class _Values(TorchFunctionMode):
    """Plain numbers are written to the device, where torch would make a tensor of meta without any; a generator has to
    be of the device that it draws for."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        generator = kwargs.get("generator")
        if generator is not None:
            named = kwargs.get("device")
            on = any(isinstance(x, Elsewhere) for x in args) if named is None else torch.device(named) == ELSEWHERE
            if isinstance(generator, GeneratorElsewhere) != on:
                own, other = ("there", "here") if on else ("here", "there")
                raise Strayed(f"{func}: draws {own} by a generator that is {other}")
        if func in (torch.tensor, torch.as_tensor) and not isinstance(args[0], Tensor):
            device = kwargs.pop("device", None)
            made = func(*args, **kwargs)
            return made if device is None else made.to(device)
        if func is Tensor.new_tensor:
            like, values = args
            return torch.tensor(values, dtype=kwargs.get("dtype", like.dtype)).to(kwargs.get("device", like.device))
        return func(*args, **kwargs)
