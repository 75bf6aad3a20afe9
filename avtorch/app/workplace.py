"""The folder that the workbench was started in: what may be read there, where uploads and answers go, examples."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import threading
from dataclasses import dataclass, field
from functools import partial
from itertools import count, islice
from pathlib import Path

from avtorch.errors import InputError, quoted

MOST_MB = 512
"""Of an upload."""
_SUFFIXES = re.compile(r"\.([ct]sv|txt|gz|parquet|m[fd][4f]|bag|mcap|db3|record|blf|asc|mat|xlsx?|ods)$", re.I)
_MOST_LISTED, _MOST_LOOKED_AT = 200, 20_000  # files: a home folder may have millions
_LAP = Path("genesis") / "lap1.csv"


@dataclass(frozen=True)
class Workplace:
    """What the tabs of a server share: the folder `root`, absolute and without symbolic links; the `token` of its
    address; `slots`, of which each command that runs takes one."""

    root: Path
    token: str = field(default_factory=partial(secrets.token_urlsafe, 32))
    slots: threading.Semaphore = field(default_factory=partial(threading.Semaphore, max(1, (os.cpu_count() or 2) // 2)))

    @classmethod
    def of(cls, folder: Path) -> Workplace:
        """Raises `InputError` where there is no such folder."""
        if not folder.is_dir():
            raise InputError(f"{folder}: is no folder; needs the folder that holds the logs")
        return cls(folder.resolve())

    def inside(self, name: str) -> Path:
        """The file or folder of that name. Raises `InputError` for what is not there, and for what leads out of the
        folder by `..`, as an absolute path or by a symbolic link."""
        try:
            path = (self.root / name).resolve(strict=True)
        except (OSError, ValueError, RuntimeError):
            raise InputError(f"{quoted(name, 120)}: no such file in {self.root}") from None
        if path == self.root or not path.is_relative_to(self.root):
            raise InputError(f"{quoted(name, 120)}: is outside {self.root}, the folder of this workbench")
        return path

    def name_of(self, path: Path) -> str:
        """The name of a path inside, with `/` between folders."""
        return path.relative_to(self.root).as_posix()

    def logs(self) -> list[str]:
        """Names of files that may be logs, at most 200; answers and hidden files are left out."""
        there = (p for p in islice(self.root.rglob("*"), _MOST_LOOKED_AT) if _SUFFIXES.search(p.name))
        names = (self.name_of(p) for p in there if p.is_file())
        own = (x for x in names if not re.search(r"(^|/)\.", x) and (x[:4] != "out/" or x[:9] == "out/logs/"))
        return sorted(islice(own, _MOST_LISTED), key=lambda x: (x.startswith("out/"), x.lower()))

    def upload(self, name: str) -> Path:
        """A free place for an upload, `out/logs/NAME`, of which only the last part counts."""
        bare = re.sub(r"[^\w.+ -]", "_", name.replace("\\", "/").rpartition("/")[2]).lstrip(". -")[-100:] or "log.csv"
        folder = self.root / "out" / "logs"
        folder.mkdir(parents=True, exist_ok=True)
        stem, dot, suffix = bare.partition(".")
        tried = (folder / f"{stem}{'' if n == 1 else f'-{n}'}{dot}{suffix}" for n in count(1))
        return next(path for path in tried if not path.exists())

    def answer(self, log: str) -> Path:
        """A new folder for an answer: `out/NAME`, or `out/NAME-2` where that is taken. Raises `InputError` where it
        cannot be made."""
        stem = re.sub(r"[^\w+-]", "_", Path(log).name.partition(".")[0]) or "log"
        names = (stem if n == 1 else f"{stem}-{n}" for n in count(1))
        path = next(path for name in names if not (path := self.root / "out" / name).exists())
        try:
            path.mkdir(parents=True)  # another tab's at this very moment is an error, too
        except OSError as fault:
            raise InputError(f"{path}: cannot be made ({fault.strerror}); start the workbench elsewhere") from None
        return path

    def give_up(self, folder: Path) -> None:
        """Remove the folder of an answer that did not come."""
        if not any(folder.glob("*.html")):
            shutil.rmtree(folder, ignore_errors=True)

    def example(self, name: str) -> str:
        """The name of an example's log, written into `out/logs`. Raises `InputError` for an unknown one."""
        if name not in examples():
            raise InputError(f"example: found {quoted(name)}, needs one of {', '.join(examples())}")
        path = self.root / "out" / "logs" / f"example-{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        if name == "recorded":
            shutil.copyfile(Path(os.environ["AVTORCH_DATA"]) / _LAP, path)
        else:
            from avtorch import Leader, simulate
            from avtorch.gap import DeadTime, SensorBias, plant

            car = plant([DeadTime(0.3), SensorBias(0.15)], T_L=0.4, sigma=0.05)
            simulate(Leader.default(start=40.0, duration=90.0, dt=0.05), plant=car).log().write(path)
        return self.name_of(path)


def examples() -> dict[str, str]:
    """Examples by name, with what they are; the recorded one, which does not come with avtorch, from `AVTORCH_DATA`."""
    told = {"simulated": "commands act 0.3 s late and the accelerometer reads 0.15 m/s² too much; are both found?"}
    folder = os.environ.get("AVTORCH_DATA")
    if folder and (Path(folder) / _LAP).is_file():
        told["recorded"] = "a lap of a Hyundai Genesis (MPC-Berkeley/genesis_path_follower, MIT licence)"
    return told
