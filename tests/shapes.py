"""Shapes checked under test: calls of annotated functions are held to `Float[Tensor, "window time"]` and its like.

`install` puts a finder before Python's own. What it loads from `PACKAGES` is the module as it stands, with every
function that names a shape wrapped: jaxtyping compares the dimensions of one call with each other, beartype resolves
unions and tuples. Other annotations are not checked, because the tests of refusals pass wrong values on purpose; and
the function runs first, so that its own error messages take precedence. A combination of shapes that has passed once is
not compared again: a loop of ten thousand equal steps costs ten thousand look-ups in a set.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import FunctionType, ModuleType
from typing import Any, ForwardRef, get_args

import jaxtyping
import numpy as np
from beartype import BeartypeConf
from beartype.door import is_bearable
from torch import Tensor

import avtorch.arrays

PACKAGES = ("avtorch.vehicle", "avtorch.inference")
SHAPES = ("Bool", "Complex", "Float", "Inexact", "Int", "Real")

_NUMBERS = BeartypeConf(is_pep484_tower=True)  # an int is a float, as type checkers have it


class ShapeError(TypeError):
    """A tensor whose shape, or kind of number, is not the annotated one."""


def install() -> None:
    """To be called before anything of `PACKAGES` is imported."""
    loaded = [name for name in sys.modules if name.startswith(PACKAGES)]
    if loaded:
        raise RuntimeError(f"imported too early for their shapes to be checked: {', '.join(loaded)}")
    for name in SHAPES:
        setattr(avtorch.arrays, name, getattr(jaxtyping, name))
    sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if not any(fullname == package or fullname.startswith(f"{package}.") for package in PACKAGES):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        for name, value in list(vars(module).items()):
            if getattr(value, "__module__", None) != module.__name__:
                continue
            if isinstance(value, FunctionType):
                setattr(module, name, checked(value))
            elif isinstance(value, type) and not getattr(value, "_is_protocol", False):
                _check_methods(value)


def _check_methods(cls: type) -> None:
    if issubclass(cls, tuple) and "_fields" in vars(cls):
        # typing builds the constructor of a NamedTuple elsewhere: its annotations refer to the class's own module
        made = vars(cls)["__new__"].__func__
        cls.__new__ = checked(made, vars(sys.modules[cls.__module__]))
    for name, member in list(vars(cls).items()):
        if name == "__new__":
            continue
        if isinstance(member, FunctionType):
            setattr(cls, name, checked(member))
        elif isinstance(member, (classmethod, staticmethod)):
            setattr(cls, name, type(member)(checked(member.__func__)))
        elif isinstance(member, property) and member.fget is not None:
            setattr(cls, name, property(checked(member.fget), member.fset, member.fdel, member.__doc__))


def checked(function: Callable[..., Any], names: dict[str, Any] | None = None) -> Callable[..., Any]:
    """`function`, held to the shapes it names; itself where it names none. `names`: of its annotations, if not its own
    module's."""
    hints = _shapes_named(function, names)
    if not hints:
        return function
    answer = hints.pop("return", None)
    signature = inspect.signature(function)
    named = [(i, name) for i, name in enumerate(signature.parameters) if name in hints]
    passed: set[object] = set()

    @functools.wraps(function)
    def held(*args: Any, **kwargs: Any) -> Any:
        # of the arguments that name a shape alone: this is done ten thousand times in a loop
        kinds = tuple([_kind(args[i]) if i < len(args) else _kind(kwargs.get(name)) for i, name in named])
        if kinds in passed:
            return function(*args, **kwargs)
        out = function(*args, **kwargs)
        given = signature.bind(*args, **kwargs).arguments
        with jaxtyping.jaxtyped("context"):
            for name, hint in hints.items():
                if name in given:
                    _hold(function, name, given[name], hint)
            if answer is not None:
                _hold(function, "return", out, answer)
        passed.add(kinds)
        return out

    return held


def _shapes_named(function: Callable[..., Any], names: dict[str, Any] | None) -> dict[str, Any]:
    """The annotations of `function` that name a shape, evaluated."""
    origin = inspect.unwrap(function)
    names = getattr(origin, "__globals__", {}) if names is None else names
    hints = {}
    for name, text in getattr(origin, "__annotations__", {}).items():
        text = text.__forward_arg__ if isinstance(text, ForwardRef) else text
        try:
            hint = eval(text, names) if isinstance(text, str) else text
        except NameError:  # imported for type checkers alone, as no shape is
            continue
        if _is_shape(hint):
            hints[name] = hint
    return hints


def _is_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(_is_shape(part) for part in get_args(hint))


def _kind(x: Any) -> object:
    if isinstance(x, (Tensor, np.ndarray)):
        return x.shape, x.dtype
    return tuple(map(_kind, x)) if isinstance(x, tuple) else type(x)


def _hold(function: Callable[..., Any], name: str, value: Any, hint: Any) -> None:
    if not is_bearable(value, hint, conf=_NUMBERS):
        raise ShapeError(f"{function.__module__}.{function.__qualname__}, {name}: found {_kind(value)}, needs {hint}")
