"""Where answers go: lines of JSON to standard output or a file."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import IO, Any, Protocol

from avtorch.errors import InputError
from avtorch.io.answers import json_text
from avtorch.live.live_watch import Answer


class Sink(Protocol):
    """Takes answers; `flush` is called behind every batch. It may wait, and the source then waits too.

    Example:
        >>> class Printed:
        ...     def write(self, answer):
        ...         print(answer.entry)
        ...     def flush(self): ...
        ...     def close(self): ...
        >>> from avtorch.live import Answer
        >>> Printed().write(Answer({"car": "red"}, "red", 1, None))
        {'car': 'red'}
    """

    def write(self, answer: Answer) -> bool:
        """Take an answer; false where an earlier run had written it."""
        ...

    def flush(self) -> None:
        """Send what was taken."""
        ...

    def close(self) -> None:
        """Send what was taken, and end."""
        ...


def line_of(answer: Answer) -> str:
    """The answer as one line of JSON, with its line end."""
    return json_text(answer.entry, indent=None, ascii_only=True).strip() + "\n"


def _answered(entry: Any) -> tuple[str, int]:
    """The car and the number of the window of an answer; 0 for one that has none, as the refusal of a car.

    Raises `ValueError` or another error of bad lines for what is no answer, such as the rows of a source.
    """
    car, window = entry["car"], entry.get("window", 0)
    if type(car) is not str or type(window) is not int or "accel_cmd" in entry:
        raise ValueError("no answer")
    return car, window


class LineSink:
    """Lines to an open text stream, standard output by default.

    Example:
        >>> from avtorch.live import Answer, LineSink
        >>> LineSink().write(Answer({"car": "red", "alerts": []}, "red", 1, None))
        {"car": "red", "alerts": []}
        True
    """

    def __init__(self, stream: IO[str] | None = None) -> None:
        self._stream = sys.stdout if stream is None else stream

    def write(self, answer: Answer) -> bool:
        self._stream.write(line_of(answer))
        return True

    def flush(self) -> None:
        self._stream.flush()

    def close(self) -> None:
        self._stream.flush()


class FileSink(LineSink):
    """Lines appended to a file. With `resume` a line that was cut short is removed, and windows that the file holds are
    not written again: a run that was killed and started again leaves the file of one that was not.

    Raises `InputError` where it cannot be written, or holds other lines.

    Example:
        >>> from avtorch.live import Answer, FileSink
        >>> for number in (1, 2):  # the first run is killed behind window 1, the second begins again
        ...     sink = FileSink("answers.jsonl", resume=True)
        ...     print([sink.write(Answer({"car": "red", "window": n}, "red", n, None)) for n in range(1, number + 1)])
        ...     sink.close()
        [True]
        [False, True]
    """

    def __init__(self, path: str | os.PathLike[str], *, resume: bool = False) -> None:
        self.path = Path(path)
        self._written: dict[str, int] = {}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                self._look(resume)
            stream = open(self.path, "a", encoding="utf-8", newline="")  # noqa: SIM115 (closed by close)
        except OSError as fault:
            raise InputError(f"{self.path}: cannot be written ({fault.strerror or fault})") from None
        super().__init__(stream)

    def write(self, answer: Answer) -> bool:
        if answer.number <= self._written.get(answer.car, 0):
            return False
        return super().write(answer)

    def close(self) -> None:
        self._stream.close()

    def _look(self, resume: bool) -> None:
        """The last window of each car in the file, and its last line made whole."""
        if not self.path.is_file():
            raise InputError(f"{self.path}: is no regular file; a file for lines of JSON is needed")
        whole = 0
        with open(self.path, "rb+") as stream:
            for number, line in enumerate(stream, 1):
                if not line.endswith(b"\n"):
                    break
                whole += len(line)
                try:
                    car, window = _answered(json.loads(line))
                except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
                    raise InputError(
                        f"{self.path}, line {number}: is no answer of avtorch watch; needs another name for --out"
                    ) from None
                if resume:
                    self._written[car] = max(window, self._written.get(car, 0))
            # what a killed run left of its last line
            stream.truncate(whole)
