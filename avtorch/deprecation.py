"""Old names that still work for one version, and say what to write instead."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from avtorch.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")


def deprecated(old: str, new: str, *, until: str) -> None:
    """Warn the caller's caller that `old` is `new` now; version `until` no longer has it.

    Example:
        >>> import warnings
        >>> from avtorch.deprecation import deprecated
        >>> with warnings.catch_warnings(record=True) as seen:
        ...     warnings.simplefilter("always")
        ...     deprecated("speed_up()", "accelerate()", until="0.3")
        >>> print(seen[0].message)
        speed_up() is deprecated, write accelerate(); avtorch 0.3 no longer has it
    """
    message = f"{old} is deprecated, write {new}; avtorch {until} no longer has it"
    warnings.warn(message, DeprecationWarning, stacklevel=3)


def renamed(*, until: str, **names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A function whose keywords `names` (old = new) have new names: an old one works, with a `DeprecationWarning`.

    Raises `InputError` where both are given.

    Example:
        >>> from avtorch.deprecation import renamed
        >>> @renamed(until="0.3", log="logs")
        ... def rows(logs: list[int]) -> int:
        ...     return len(logs)
        >>> rows([1, 2])
        2
    """

    def with_old_names(function: Callable[P, R]) -> Callable[P, R]:
        name = function.__qualname__
        # a constructor is called by its class
        called_as = name.removesuffix(".__init__") if name.endswith(".__init__") else function.__name__

        @wraps(function)
        def called(*args: P.args, **kwargs: P.kwargs) -> R:
            for old, new in names.items():
                if old in kwargs:
                    if new in kwargs:
                        raise InputError(f"{old}: given beside {new}, its new name; needs {new} alone")
                    deprecated(f"{called_as}({old}=...)", f"{new}=...", until=until)
                    kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return called

    return with_old_names
