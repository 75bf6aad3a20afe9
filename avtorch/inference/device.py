"""The device that a computation runs on: the one that its tensors are on, or one that the user names.

Densities follow the tensors that they are made of, and samplers and integrals the density. Loops over windows take a
`device`. What is short, or the same for everybody, is on the processor: clocks, states on disk, summaries.
"""

from __future__ import annotations

import torch

from avtorch.errors import InputError, quoted

Device = str | torch.device
"""A device by name, such as `"cuda"` or `"cuda:1"`, or as torch's own object."""


def checked_device(device: Device) -> torch.device:
    """The device, once a double was written there and read back.

    Raises `InputError` for a name that is none, a device that this machine lacks, and one without double precision.
    """
    try:
        tried = torch.ones(1, dtype=torch.float64, device=device)
        tried.item()
    except (RuntimeError, AssertionError, TypeError, NotImplementedError, ImportError):
        here = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
        raise InputError(f"device: found {quoted(str(device), 40)}, needs one of {', '.join(here)}") from None
    return tried.device  # with its number


def check_generator(generator: torch.Generator | None, device: torch.device) -> None:
    """Raises `InputError` for a generator of another device."""
    if generator is not None and generator.device.type != device.type:
        raise InputError(f"generator: found one on {generator.device}, needs one on {device}, where the density is")
