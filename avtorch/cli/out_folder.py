"""One process at a time in `--out`: every command that writes there holds the folder while it runs."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

from avtorch.cli.arguments import free_folder


def alone_in_out(command: Callable[..., None]) -> Callable[..., None]:
    """`command`, holding its `out` folder; it stays free where `out` is None.

    A second process in the same folder gets one line (`InputError`) that names the first.
    """
    arguments = inspect.signature(command)

    @wraps(command)
    def held(*args: Any, **kwargs: Any) -> None:
        given = arguments.bind(*args, **kwargs)
        given.apply_defaults()
        out = given.arguments["out"]
        if out is None:
            return command(*args, **kwargs)
        from avtorch.io import sole_use
        from avtorch.io.answer_set import published

        free_folder(out)
        before = len(published)
        try:
            with sole_use(out, work=f"avtorch {command.__name__}") as locked:
                if not locked:
                    warning = "the file system has no locks; keep other runs out of this folder"
                    print(f"avtorch: {out}: {warning}", file=sys.stderr)
                return command(*args, **kwargs)
        except KeyboardInterrupt as stop:
            if len(published) > before and not str(stop):
                raise KeyboardInterrupt(f"the new answer is in {out}") from None
            raise

    return held
