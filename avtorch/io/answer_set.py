"""Files of one answer that appear together: a reader gets the whole earlier answer or the whole new one.

A rename is atomic for one file, not for six. So the names in a folder are links, and one rename moves them all, as
Kubernetes' atomic writer does for mounted configuration:

    OUT/diagnosis.json   ->  .avtorch/answer/diagnosis.json
    OUT/report.html      ->  .avtorch/answer/report.html
    OUT/.avtorch/answer  ->  set-k3v9      replaced by one rename
    OUT/.avtorch/set-k3v9/                 the files

However the process ends, SIGKILL included, the link points to one whole set. Half-written files stay in `.avtorch`
until the next answer removes them. The link of a file that the set lacks dangles for a moment: to a reader there is no
such file.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from avtorch.errors import InputError
from avtorch.io.set_lock import lock_if_free, locked

HIDDEN, CURRENT, SET = ".avtorch", "answer", "set-"

_staged: set[Path] = set()
"""Folders that `answer_set` has yielded: an answer written into one of them is added to its set."""

published: list[Path] = []
"""Folders in which this process has published answers, in order, for the message of a later interruption."""

_NO_LINKS = {errno.EPERM, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP}
_NO_LINKS_WINDOWS = {1, 50, 1314}  # invalid function, not supported, a privilege is not held


@contextmanager
def answer_set(folder: str | os.PathLike[str], names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder for the files of an answer; they replace the earlier ones in `folder` all at once.

    `names`: every file that this answer may consist of, the identifying one first. Earlier files of these names that
    are not written again are removed at the same moment; all others stay. If the block or the publication fails, the
    earlier answer stays whole. Regular files of these names, such as an earlier version wrote, are taken over: their
    content does not change before the new answer is complete.

    A writer that is called within the block with the yielded folder adds to the same set.

    Where the file system has no symbolic links the files are moved one by one, the first of `names` last, and its
    earlier version is removed before: while it is missing, the answer in `folder` is incomplete.

    Raises InputError where `folder` cannot be written, ValueError for a file that `names` does not have.

    Example:
        >>> from avtorch.io import answer_set, write_json
        >>> with answer_set("out", ["estimates.json", "estimates.png"]) as folder:
        ...     write_json(folder / "estimates.json", {"T_L": 0.3})
        >>> from pathlib import Path
        >>> sorted(path.name for path in Path("out").glob("*.json"))
        ['estimates.json']
    """
    place = Path(folder)
    if place in _staged:
        yield place
        return
    staged: Path | None = None
    try:
        staged = _stage(place)
        _staged.add(staged)
        with lock_if_free(staged):  # so that no other process removes it as a leftover
            yield staged
            _publish(place, staged, names)
            published.append(place)
    except BaseException as fault:
        there = _discard(place, staged)
        if isinstance(fault, OSError):
            raise InputError(_failed(place, fault, there=there)) from None
        if isinstance(fault, InputError):
            # name the user's folder in the message, not the temporary one
            raise InputError(str(fault).replace(str(staged), str(place))) from None
        if isinstance(fault, KeyboardInterrupt) and there:
            raise KeyboardInterrupt(f"the new answer is in {place}") from None
        raise
    finally:
        _staged.discard(staged or place)


def _failed(place: Path, fault: OSError, *, there: bool) -> str:
    why = fault.strerror or str(fault)
    if there:
        return f"{place}: the new answer is there, but the disk did not confirm that it keeps it ({why})"
    return f"{place}: the answer cannot be written ({why}); what was there has not changed"


def _stage(place: Path) -> Path:
    staged = place / HIDDEN / f"{SET}{secrets.token_hex(4)}"
    staged.parent.mkdir(parents=True, exist_ok=True)
    staged.mkdir()
    return staged


def _publish(place: Path, staged: Path, names: Sequence[str]) -> None:
    files = sorted(os.listdir(staged))
    if foreign := set(files) - set(names):
        raise ValueError(f"{place}: {', '.join(sorted(foreign))} written, needs names out of {', '.join(names)}")
    for name in names:
        if stat.S_ISDIR(_mode(place / name)):
            raise InputError(f"{place / name}: is a directory; the name of a file is needed")
    for name in files:
        _sync(staged / name)
    hidden = place / HIDDEN
    with locked(hidden):
        try:  # the link that will be renamed; made first, to find out whether the file system has links
            ahead = _link(hidden, staged.name, staged.name)
        except (NotImplementedError, OSError) as fault:
            if not _means_no_links(fault):
                raise
            _move(place, staged, files, names)
            return
        if stat.S_ISDIR(_mode(hidden / CURRENT)):  # a copy that followed the links: its names are files as well
            os.rename(hidden / CURRENT, _stage(place))
        _take_over(place, names)
        _carry(place, staged, names)
        _sync(staged)
        for name in files:
            if not _is_ours(place, name):
                _reveal(place, name)
        _sync(place)
        os.replace(ahead, hidden / CURRENT)
        try:
            _sync(hidden)
        except OSError as fault:
            raise InputError(_failed(place, fault, there=True)) from None
        with suppress(OSError):
            _clear(place, own=staged)


def _take_over(place: Path, names: Sequence[str]) -> None:
    """Move regular files of these names into the current set and put links in their places; readers notice no
    change."""
    loose = [name for name in names if _mode(place / name) and not _is_ours(place, name)]
    if not loose:
        return
    hidden = place / HIDDEN
    if _current(place) is None:
        present = _stage(place)
        os.replace(_link(hidden, present.name, present.name), hidden / CURRENT)
    for name in loose:
        kept = hidden / CURRENT / name
        kept.unlink(missing_ok=True)  # the file hides it, so no reader notices the removal
        _copy(place / name, kept)
        os.replace(_link(hidden, _target(name), f"{SET}{name}"), place / name)


def _carry(place: Path, staged: Path, names: Sequence[str]) -> None:
    """Carry over the files of other answers in the current set."""
    present = _current(place)
    if present is None:
        return
    for name in sorted(os.listdir(place / HIDDEN / present)):
        if name not in names and _is_ours(place, name):
            _copy(place / HIDDEN / present / name, staged / name)


def _reveal(place: Path, name: str) -> None:
    """Make the link; it dangles until the set that has the file becomes the current one."""
    # someone removed the link: an earlier file must not come back for a moment
    (place / HIDDEN / CURRENT / name).unlink(missing_ok=True)
    os.symlink(_target(name), place / name)


def _move(place: Path, staged: Path, files: Sequence[str], names: Sequence[str]) -> None:
    """Without links, move the files one by one: the first of `names` is removed before all others and written after
    them."""
    first, *rest = names
    try:
        if rest:
            (place / first).unlink(missing_ok=True)
        for name in (*rest, first):
            if name in files:
                os.replace(staged / name, place / name)
            else:
                (place / name).unlink(missing_ok=True)
    except OSError as fault:
        why = fault.strerror or fault
        raise InputError(f"{place}: the answer cannot be written ({why}); it is whole only with {first}") from None
    with suppress(OSError):
        _clear(place, own=staged)


def _discard(place: Path, staged: Path | None) -> bool:
    """Remove a set that was not published; True if it was published. The next answer removes what cannot be removed
    now."""
    with suppress(OSError):
        if staged is not None and _current(place) == staged.name:
            return True
        if staged is not None:
            shutil.rmtree(staged, ignore_errors=True)
        with lock_if_free(place / HIDDEN) as free:
            if free:
                _clear(place)
    return False


def _clear(place: Path, *, own: Path | None = None) -> None:
    """Remove dangling links, unused sets, and the temporary files of processes that have ended.

    `own`: the caller's, which holds its lock.
    """
    hidden, present = place / HIDDEN, _current(place)
    for name in os.listdir(place):
        if _is_ours(place, name) and not (place / name).exists():
            os.unlink(place / name)
    if present is not None and not os.listdir(hidden / present):
        os.unlink(hidden / CURRENT)
        present = None
    for name in os.listdir(hidden):
        left = hidden / name
        if not name.startswith(SET) or name == present:
            continue
        if not stat.S_ISDIR(_mode(left)):
            os.unlink(left)
            continue
        with lock_if_free(left) as free:
            if free or left == own:
                shutil.rmtree(left, ignore_errors=True)
    if present is None and not os.listdir(hidden):
        hidden.rmdir()


def _target(name: str) -> str:
    return f"{HIDDEN}/{CURRENT}/{name}"


def _is_ours(place: Path, name: str) -> bool:
    path = place / name
    return stat.S_ISLNK(_mode(path)) and Path(os.readlink(path)).as_posix() == _target(name)


def _current(place: Path) -> str | None:
    """Name of the folder's current set; None where there is none."""
    path = place / HIDDEN / CURRENT
    name = os.readlink(path) if stat.S_ISLNK(_mode(path)) else ""
    return name if re.fullmatch(rf"{SET}\w+", name) and (place / HIDDEN / name).is_dir() else None


def _mode(path: Path) -> int:
    """Kind of a file, of a link itself; 0 where there is none."""
    try:
        return os.lstat(path).st_mode
    except FileNotFoundError:
        return 0


def _link(hidden: Path, target: str, name: str) -> Path:
    """A link under a passing name, to be renamed."""
    path = hidden / f"{name}.link"
    with suppress(FileNotFoundError):
        os.unlink(path)
    os.symlink(target, path)
    return path


def _means_no_links(fault: NotImplementedError | OSError) -> bool:
    """Whether a system that refuses a symbolic link so has none, or none for this user."""
    if isinstance(fault, NotImplementedError):
        return True
    return fault.errno in _NO_LINKS or getattr(fault, "winerror", None) in _NO_LINKS_WINDOWS


def _copy(source: Path, target: Path) -> None:
    """The same content at `target`, which does not exist; a dangling link has none."""
    if not source.exists():
        return
    if not source.is_file():
        raise InputError(f"{source}: is no regular file; the name of a file is needed")
    if not source.is_symlink():
        with suppress(OSError):  # some file systems have no hard links
            os.link(source, target)
            return
    shutil.copyfile(source, target)
    _sync(target)


def _sync(path: Path) -> None:
    """Flush a file or a folder to disk, as far as the file system can."""
    folder = path.is_dir()
    if folder and os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY if folder or os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(handle)
    except OSError as fault:
        if fault.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)
