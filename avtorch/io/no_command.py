"""What is said of a log without a commanded acceleration, where one is needed."""

from __future__ import annotations

from avtorch.errors import InputError
from avtorch.io.log import Log


def no_command(log: Log, need: str) -> InputError:
    """The error; `need`: what needs the command, such as ``which the diagnosis needs``."""
    words = f"{log.name}: has no accel_cmd{need}"
    others = log.pedals or (("speed_cmd",) if log.speed_cmd is not None else ())
    if others:
        words += f"; avtorch.pedals.fit_pedals makes one of its {' and '.join(others)}"
    return InputError(words)
