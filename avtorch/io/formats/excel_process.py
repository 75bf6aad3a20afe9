"""Reads a workbook in a process of its own: python-calamine ends the process that asks it for a sheet too large.

A sheet of two cells, the first and the last, claims 400 GB. The bytes of the file come from the standard input; the
answer is one line of JSON and the numbers behind it.
"""

from __future__ import annotations

import io
import json
import sys

from avtorch.errors import InputError
from avtorch.io.formats.excel_table import table_of
from avtorch.io.formats.library import guarded

MOST_MEMORY = 6 * 2**30
"""Bytes of address space, where the system can limit it: 20 million cells with their texts take about half."""


def main() -> None:
    """Answer with the first sheet that holds a table, or with what is wrong."""
    _limit_memory()
    source = sys.argv[1]
    out = sys.stdout.buffer
    try:
        answer, numbers = _read(sys.stdin.buffer.read(), source)
    except InputError as fault:
        answer, numbers = {"error": str(fault)}, b""
    out.write(json.dumps(answer).encode() + b"\n" + numbers)


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _read(raw: bytes, source: str) -> tuple[dict, bytes]:
    import python_calamine

    sheets = []
    with guarded(source, "an undamaged workbook"):
        book = python_calamine.load_workbook(io.BytesIO(raw))
        for name in book.sheet_names:
            sheets.append(name)
            table = table_of(book.get_sheet_by_name(name).iter_rows(), source)
            if table is not None and len(table.names) > 0:
                shape = list(table.numbers.shape)
                answer = {"sheet": name, "names": table.names, "units": table.units, "texts": table.texts}
                return answer | {"shape": shape, "others": len(book.sheet_names) - 1}, table.numbers.T.tobytes()
    return {"error": "", "sheets": sheets}, b""


if __name__ == "__main__":
    main()
