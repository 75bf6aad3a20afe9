"""The leaders: recordings where available, otherwise the embedded US06."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from avtorch.errors import InputError
from avtorch.io import read_leader
from avtorch.vehicle import Leader

SWEEP_S, DRIVE_S, PLATOON_S = 50.0, 80.0, 160.0
"""Lengths [s]: of the estimation sweep (ten windows of 5 s), of a drive with a change, of the platoon's drive."""

_NGSIM = "ngsim/events_000_249.csv"
_LIVELY = ("openacc_zalazone/handling_part40.csv", None, 4.0)
_STEADY = ("openacc_astazero/ASta_040719_platoon7.csv", 5, 300.0)


@dataclass(frozen=True)
class Ahead:
    """A leader, its `name` in rows, `which` it is in full, and `note`: why it is used in place of a recording (or
    "")."""

    leader: Leader
    name: str
    which: str
    note: str = ""

    def with_note(self, why: str) -> str:
        """A sentence with the note appended."""
        return f"{why[:-1]}; {self.note}." if self.note else why


@dataclass(frozen=True)
class Leaders:
    """`sweep`: behind which the parameters are estimated (NGSIM, OpenACC). `drives`: behind which a vehicle changes
    and is watched (OpenACC; a lively section and a steadier one). The first of `drives` leads the other experiments.

    Example:
        >>> from avtorch.paper import Leaders
        >>> leaders = Leaders.read()  # without a folder of recordings: the embedded US06
        >>> len(leaders.sweep), len(leaders.drives)
        (1, 1)
    """

    sweep: tuple[Ahead, ...]
    drives: tuple[Ahead, ...]

    @classmethod
    def read(cls, data: str | os.PathLike[str] | None = None) -> Leaders:
        """Out of a folder of recordings, in the sub-folders `ngsim`, `openacc_zalazone` and `openacc_astazero`.

        NGSIM: the longest event. OpenACC: car 2 of ZalaZONE `handling_part40` from 4 s on, and car 5 of AstaZero
        platoon 7 from 300 s on. Every acceleration is Gaussian-smoothed (`Leader.from_speed`). None: US06 for all.

        Raises `InputError` where the folder or one of the files is missing or cannot be read.
        """
        if data is None:
            note = "no recordings were given, so the embedded US06 drives ahead"
            us06 = Ahead(Leader.default(), "US06", "US06, the embedded drive cycle, from its start", note)
            return cls((us06,), (us06,))
        folder = Path(data)
        if not folder.is_dir():
            raise InputError(f"data: {folder} is not a folder; needs the recordings' own, or leave it out for US06")
        raw = read_leader(_file(folder, _NGSIM))
        leader = Leader.from_speed(raw.time, raw.speed, name=raw.name)
        ngsim = Ahead(leader, raw.name, f"{raw.note}, {leader.duration:.1f} s")
        lively = _openacc(folder, "OpenACC ZalaZONE", *_LIVELY)
        steady = _openacc(folder, "OpenACC AstaZero", *_STEADY)
        return cls((ngsim, lively), (lively, steady))

    @property
    def descriptions(self) -> dict[str, str]:
        """By name in rows, which each is."""
        return {ahead.name: ahead.which for ahead in (*self.sweep, *self.drives)}

    @property
    def main(self) -> Ahead:
        """The leader of the strategies, the gains and the platoon."""
        return self.drives[0]


def _openacc(folder: Path, name: str, file: str, vehicle: int | None, start: float) -> Ahead:
    leader = Leader.read(_file(folder, file), vehicle=vehicle, start=start)
    return Ahead(leader, name, f"{leader.name}, from {start:g} s")


def _file(folder: Path, name: str) -> Path:
    path = folder / name
    if not path.is_file():
        raise InputError(f"data: {folder} has no {name}; needs it, or leave the folder out for US06")
    return path
