"""A command uses one thread, unless the user has set another number or the libraries are loaded already."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from avtorch.cli.app import use_one_thread

NAMES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


@pytest.mark.slow  # a process that loads torch
def test_torch_has_one_thread_after_a_command_begins() -> None:
    own = {name: value for name, value in os.environ.items() if name not in NAMES}
    code = "from avtorch.cli import main; main(['--version']); import torch; print(torch.get_num_threads())"
    done = subprocess.run([sys.executable, "-c", code], env=own, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "1"


def begun(only: pytest.MonkeyPatch, given: dict[str, str], *, loaded: bool = False) -> dict[str, str]:
    """The variables after a command has begun where they were `given`."""
    for name in NAMES:
        only.setenv(name, "")  # so that what is there now is restored, or removed again
        only.delenv(name)
    for name, value in given.items():
        only.setenv(name, value)
    with pytest.MonkeyPatch.context() as modules:
        for name in () if loaded else ("numpy", "torch"):
            modules.delitem(sys.modules, name, raising=False)
        use_one_thread()
    out = {name: os.environ[name] for name in NAMES if name in os.environ}
    for name in out:
        del os.environ[name]
    return out


def test_what_the_user_set_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    assert begun(monkeypatch, {}) == dict.fromkeys(NAMES, "1")
    assert begun(monkeypatch, {"OMP_NUM_THREADS": "3"}) == {"OMP_NUM_THREADS": "3"}
    assert begun(monkeypatch, {"MKL_NUM_THREADS": "4"}) == dict.fromkeys(NAMES, "1") | {"MKL_NUM_THREADS": "4"}
    assert begun(monkeypatch, {}, loaded=True) == {}  # too late to change anything
