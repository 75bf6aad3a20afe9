"""MDF 3 and 4 by asammdf: names from the blocks, samples of those channels that are asked for."""

from __future__ import annotations

import io
import os
from collections import Counter
from typing import Any, BinaryIO

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, quoted
from avtorch.io.formats.kinds import Kind, guarded, library
from avtorch.io.formats.listed import Channel, Recording, refuse_cells
from avtorch.io.opening import MOST_BYTES, beginning, opened, place, read_regular

_NEED = "an undamaged MDF 3 or 4 file"
_NUMBERS_4 = frozenset(range(6))  # unsigned, signed and real, little and big end first; then texts, bytes, media
_NUMBERS_3 = frozenset((0, 1, 2, 3, 9, 10, 11, 12, 13, 14, 15, 16))
_TIME, _NO_SYNC = 1, 0  # what a master counts in MDF 4; the others are an angle, a distance, an index
_MASTERS_4 = (2, 3)
_VARIABLE_LENGTH = 1
_DATES_3 = (132, 133)


def open_file(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open an MDF file and list its numeric channels that have a time.

    Samples are physical values; a channel whose values are named by texts is read as its raw numbers, and where texts
    name a few values of a numeric channel only, those are NaN. Invalidation bits make NaN, too. A name that several
    groups have becomes ``GROUP.NAME``, with the group's own name where that tells them apart, else its number as in
    ``2.NAME``. Raises InputError.
    """
    source = place(path)
    asammdf = library("asammdf", source, kind)
    remarks = []
    unfinished = beginning(path, 8, need=_NEED).startswith(b"UnFin")
    with guarded(source, _NEED):
        stream = opened(path, need=_NEED)
        if unfinished:  # asammdf completes it in place, so it gets a copy in memory
            stream = io.BytesIO(read_regular(path, most=MOST_BYTES, need=_NEED))
        try:
            mdf = _loaded(asammdf, stream, whole=True)
        except asammdf.blocks.utils.MdfException as fault:
            if "Incomplete block" not in str(fault):
                raise
            mdf = _loaded(asammdf, stream, whole=False)
            remarks.append("the file is cut off; blocks that its end cuts are left out")
        if unfinished:
            remarks.append("the recorder did not finish the file; it was completed as far as it goes")
        places, units, left = _listing(mdf)

    def load(names: tuple[str, ...]) -> dict[str, Channel]:
        refuse_cells(source, sum(mdf.groups[places[name][0]].channel_group.cycles_nr for name in names))
        times: dict[int, FloatArray] = {}
        channels = {}
        for name in names:
            group, index = places[name]
            with guarded(f"{source}: channel {quoted(name, 80)}", _NEED):
                signal = mdf.get(group=group, index=index, raw=True, ignore_invalidation_bits=True)
                values = _physical(signal)
                time = np.array(signal.timestamps, dtype=np.float64)
                known = times.get(group)
                if known is not None and np.array_equal(known, time, equal_nan=True):
                    time = known
                times[group] = time
                if time.shape != values.shape:
                    raise InputError(
                        f"{source}: channel {quoted(name, 80)}: has {len(time)} time stamps for "
                        f"{len(values)} values; {_NEED} is needed"
                    )
                channels[name] = Channel(name, time, values)
        return channels

    return Recording(source, f"MDF {mdf.version}", places, units, remarks + left, load)


def _loaded(asammdf: Any, stream: BinaryIO, *, whole: bool) -> Any:
    """The file; `whole`: blocks that its end cuts are an error, and left out else."""
    asammdf.set_global_option("raise_on_incomplete_blocks", whole)
    stream.seek(0)
    return asammdf.MDF(stream, process_bus_logging=False)


def _listing(mdf: Any) -> tuple[dict[str, tuple[int, int]], dict[str, str], list[str]]:
    """The numeric channels of a file: places and units by name; and remarks."""
    four = mdf.version >= "4"
    found: list[tuple[str, str, int, int, str]] = []  # name, group's name, group, index, unit
    untimed = 0
    for g, group in enumerate(mdf.groups):
        numbers = [i for i in range(len(group.channels)) if _is_number(group, i, four)]
        if not _has_time(mdf, g, group, four):
            untimed += bool(numbers)
            continue
        for i in numbers:
            found.append((group.channels[i].name, _group_name(group), g, i, _unit(group.channels[i])))
    names = _told_apart([x[:3] for x in found])
    places = {name: x[2:4] for name, x in zip(names, found, strict=True)}
    units = {name: x[4] for name, x in zip(names, found, strict=True) if x[4]}
    return places, units, [f"{untimed} groups without a time are left out"] if untimed else []


def _has_time(mdf: Any, g: int, group: Any, four: bool) -> bool:
    master = mdf.masters_db.get(g)
    if master is None:
        # a group that shares the master of another one, as MDF 4.2 allows
        return getattr(group.channel_group, "cg_master_index", None) is not None
    return not four or group.channels[master].sync_type in (_TIME, _NO_SYNC)


def _is_number(group: Any, i: int, four: bool) -> bool:
    channel = group.channels[i]
    kind = channel.channel_type
    if four:
        plain = kind not in (*_MASTERS_4, _VARIABLE_LENGTH) and group.channel_dependencies[i] is None
        return channel.data_type in _NUMBERS_4 and plain
    conversion = channel.conversion
    dated = conversion is not None and conversion.conversion_type in _DATES_3
    return channel.data_type in _NUMBERS_3 and kind == 0 and not dated


def _group_name(group: Any) -> str:
    head = group.channel_group
    source = getattr(head, "acq_source", None)
    return str(getattr(head, "acq_name", "") or getattr(source, "name", "") or "").strip()


def _unit(channel: Any) -> str:
    conversion = channel.conversion
    unit = getattr(channel, "unit", "") or (getattr(conversion, "unit", "") if conversion is not None else "")
    return str(unit or "").strip()


def _told_apart(found: list[tuple[str, str, int]]) -> list[str]:
    """A name for each channel: its own; ``GROUP.NAME`` where several have it; ``NUMBER.NAME`` where groups do, too."""
    names, pairs = Counter(name for name, _, _ in found), Counter((group, name) for name, group, _ in found)
    told = []
    taken: set[str] = set()
    for name, group, number in found:
        new = name
        if names[name] > 1:
            new = f"{group}.{name}" if group and pairs[group, name] == 1 else f"{number}.{name}"
        base, count = new, 1
        while new in taken:
            count += 1
            new = f"{base} ({count})"
        taken.add(new)
        told.append(new)
    return told


def _physical(signal: Any) -> FloatArray:
    samples, conversion = signal.samples, signal.conversion
    if conversion is not None:
        converted = conversion.convert(samples)
        if getattr(converted, "dtype", None) is not None and converted.dtype.kind in "fiub":
            values = np.array(converted, dtype=np.float64)
        else:
            values = _beside_texts(samples, conversion)
    else:
        values = np.array(samples, dtype=np.float64)
    invalid = signal.invalidation_bits
    if invalid is not None:
        values[np.asarray(invalid, dtype=bool)] = np.nan
    return values


def _beside_texts(samples: Any, conversion: Any) -> FloatArray:
    """Values of a channel of which texts name some: by the conversion of the others; raw where texts name all."""
    default = conversion.referenced_blocks.get("default_addr")
    raw = np.array(samples, dtype=np.float64)
    if default is None or isinstance(default, (bytes, str)):
        return raw
    values = np.array(default.convert(samples), dtype=np.float64)
    for i in range(getattr(conversion, "ref_param_nr", 1) - 1):
        one = getattr(conversion, f"val_{i}", np.nan)
        low, high = getattr(conversion, f"lower_{i}", one), getattr(conversion, f"upper_{i}", one)
        values[(raw >= low) & (raw <= high)] = np.nan
    return values
