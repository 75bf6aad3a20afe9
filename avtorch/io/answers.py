"""Answers for machines: strict JSON with finite numbers only, and files that appear whole or not at all.

The files of one answer are plain files, written aside and then put in place one by one, the JSON last. A rename
replaces one file whole, not six at once. So the JSON holds the SHA-256 of every other file of its answer under `files`:
whatever fails, and whenever the process ends, each file is whole, the old one or the new one, and `read_answer`
recognises a folder that holds files of two answers. What the JSON does not list is no part of its answer.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from avtorch.errors import InputError, printable
from avtorch.io.folder_lock import sole_use
from avtorch.io.opening import place as shown
from avtorch.io.opening import read_regular


@contextmanager
def atomic(path: str | os.PathLike[str], *, binary: bool = False) -> Iterator[IO]:
    """Open ``path`` for writing so that a reader gets the old file or the new one, never a part of it.

    Missing folders are made. If the block raises, the temporary file is removed and ``path`` is unchanged.
    Raises InputError where the place cannot be written.
    """
    target = Path(path)
    try:
        if target.is_dir():
            raise InputError(f"{target}: is a directory; the name of a file is needed")
        target.parent.mkdir(parents=True, exist_ok=True)
        # same folder, hence same file system: only there is the rename atomic
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
    except OSError as fault:
        raise InputError(f"{target}: cannot be written ({fault.strerror or fault})") from None
    try:
        # newline="" keeps line ends as given, so that a log has the same bytes on every system
        with os.fdopen(handle, "wb") if binary else os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(name, 0o666 & ~mask)  # mkstemp makes it private; an answer gets the permissions of any other file
        os.replace(name, target)
    except BaseException as fault:
        with suppress(OSError):  # report the first failure
            os.unlink(name)
        if isinstance(fault, OSError):
            raise InputError(f"{target}: cannot be written ({fault.strerror or fault})") from None
        raise


_NOT_PLAIN = re.compile(r"[^ -~\n]")


def write_json(path: str | os.PathLike[str], obj: Any) -> None:
    """Write ``obj`` as indented UTF-8 JSON, atomically.

    Accepts dicts with string keys, lists, tuples, strings, numbers, booleans and None, and objects with ``tolist``
    (NumPy arrays and scalars, tensors). Control characters and other invisible ones are escaped. Raises
    InputError, naming the key, for NaN, infinity or a foreign type; nothing is written then, and an earlier file stays.
    """
    text = json_text(obj)
    with atomic(path) as stream:
        stream.write(text + "\n")


def json_text(obj: Any, *, indent: int | None = 1, ascii_only: bool = False) -> str:
    """``obj`` as strict JSON; accepts and refuses the same objects as :func:`write_json`."""
    text = json.dumps(_plain(obj, "$"), indent=indent, ensure_ascii=ascii_only, allow_nan=False)
    # invisible characters occur only in strings, where JSON can escape them
    return _NOT_PLAIN.sub(lambda found: _seen(found[0]), text)


def _seen(c: str) -> str:
    if printable(c) == c:
        return c
    return f"\\u{ord(c):04x}" if ord(c) < 0x10000 else json.dumps(c)[1:-1]


def _plain(x: Any, where: str) -> Any:
    """``x`` as strict JSON can hold it; ``where`` is its place in the answer, for the message."""
    if x is None or isinstance(x, (bool, str)):
        return x
    if isinstance(x, int):
        return int(x)
    if isinstance(x, float):
        if not math.isfinite(x):
            raise InputError(f"{where}: is {x}; an answer holds finite numbers, or null where there is none")
        return float(x)
    if isinstance(x, Mapping):
        for key in x:
            if not isinstance(key, str):
                raise InputError(f"{where}: has the key {key!r}; the keys of an answer are strings")
        return {str(key): _plain(value, f"{where}.{key}") for key, value in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(value, f"{where}[{i}]") for i, value in enumerate(x)]
    if hasattr(x, "tolist"):
        return _plain(x.tolist(), where)
    raise InputError(f"{where}: is a {type(x).__name__}; an answer holds objects, lists, strings, numbers and null")


FILES = "files"
"""The key of an answer's JSON under which the SHA-256 of each of its other files stands, by name."""

_STAGE = ".avtorch-"
_MOST = 2**30  # bytes of an answer's JSON

_staged: set[Path] = set()
"""Folders that `answer_set` has yielded: an answer written into one of them is added to its set."""


@contextmanager
def answer_set(folder: str | os.PathLike[str], names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder for the files of an answer; they replace the earlier ones in `folder` when the block ends.

    `names`: the answer's JSON, and other files that belong to it. What the earlier JSON lists and what has one of
    these names is removed where it is not written again; all other files stay. If the block fails, nothing has
    changed. If it fails while the files are put in place, each is whole, and `read_answer` refuses the JSON, which
    comes last.

    A writer that is called within the block with the yielded folder adds to the same set. No other process can write an
    answer into `folder` meanwhile.

    Raises InputError where `folder` cannot be written or is in use.
    """
    place = Path(folder)
    if place in _staged:
        yield place
        return
    with sole_use(place, work="an answer") as alone:
        staged, begun = place, False
        try:
            if alone:
                _remove_leftovers(place)
            staged = Path(tempfile.mkdtemp(prefix=_STAGE, dir=place))
            _staged.add(staged)
            yield staged
            files = _prepared(place, staged, names[0])
            begun = True
            _put_in_place(place, staged, files, names)
        except BaseException as fault:
            left = f"files of two answers lie in {place} until it is written again"
            if isinstance(fault, OSError):
                what = left if begun else "what was there has not changed"
                raise InputError(f"{place}: the answer cannot be written ({fault.strerror or fault}); {what}") from None
            if isinstance(fault, InputError):
                # name the user's folder in the message, not the temporary one
                raise InputError(str(fault).replace(str(staged), str(place))) from None
            if isinstance(fault, KeyboardInterrupt) and begun:
                raise KeyboardInterrupt(left) from None
            raise
        finally:
            _staged.discard(staged)
            if staged != place:
                shutil.rmtree(staged, ignore_errors=True)


def read_answer(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON of an answer, if the files that it lists are those that were written with it.

    Raises InputError, in one line, where `path` is no JSON object, and where a file of the answer is missing, edited or
    of another answer.

    Example:
        >>> from avtorch.io import read_answer, write_json
        >>> write_json("estimates.json", {"T_L": 0.3})
        >>> read_answer("estimates.json")
        {'T_L': 0.3}
    """
    path = Path(path)
    try:
        answer = json.loads(read_regular(path, most=_MOST, need="the JSON of an answer"))
    except (ValueError, RecursionError) as fault:
        if isinstance(fault, InputError):
            raise
        answer = None
    files = answer.get(FILES, {}) if isinstance(answer, dict) else None
    if not isinstance(files, dict):
        raise InputError(f"{shown(path)}: is no JSON of an answer")
    odd = [name for name, digest in files.items() if Path(name).name != name or _digest(path.parent / name) != digest]
    if odd:
        are = "is" if len(odd) == 1 else "are"
        raise InputError(
            f"{shown(path)}: {', '.join(map(shown, odd))} {are} missing, edited or of another answer; "
            "needs the answer to be written again"
        )
    assert isinstance(answer, dict)
    return answer


def is_of_answer(path: Path, answer: str) -> bool:
    """Whether the JSON `answer` beside the file `path` lists that file."""
    return path.name in _listed(path.parent / answer)


def _listed(answer: Path) -> list[str]:
    """The files that an answer's JSON lists; none where there is no such JSON."""
    try:
        listed = list(json.loads(answer.read_text(encoding="utf-8"))[FILES])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return []
    own = [name for name in listed if isinstance(name, str) and Path(name).name == name]
    return [name for name in own if not (answer.parent / name).is_dir()]


def _digest(path: Path) -> str | None:
    try:
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return None


def _prepared(place: Path, staged: Path, main: str) -> list[str]:
    """The names of the files that were written, on the disk and with their hashes in the JSON; nothing is in place."""
    files = sorted(os.listdir(staged))
    for name in (main, *files):
        if (place / name).is_dir() and not (place / name).is_symlink():
            raise InputError(f"{place / name}: is a directory; the name of a file is needed")
    others = [name for name in files if name != main]
    if main in files and main.endswith(".json") and others:
        answer = json.loads((staged / main).read_text(encoding="utf-8"))
        write_json(staged / main, answer | {FILES: {name: _digest(staged / name) for name in others}})
    for name in files:
        with open(staged / name, "rb+") as stream:
            os.fsync(stream.fileno())
    return files


def _put_in_place(place: Path, staged: Path, files: Sequence[str], names: Sequence[str]) -> None:
    main, *others = dict.fromkeys((*names, *_listed(place / names[0]), *files))
    for name in (*others, main):
        if name in files:
            os.replace(staged / name, place / name)
        else:
            (place / name).unlink(missing_ok=True)


def _remove_leftovers(place: Path) -> None:
    """Remove what processes that were killed while they wrote have left."""
    for left in place.glob(f"{_STAGE}*"):
        if not any(one.name == left.name for one in _staged):
            shutil.rmtree(left, ignore_errors=True)
