"""Bytes to text: gzip, UTF-8, UTF-16, and the one code page that is left to guess.

A statistical guess at the code page does worse than a fixed one: a header holds a dozen characters that are not ASCII
(m/s², °, an umlaut), and charset-normalizer 3.5 named seven of ten such headers wrongly, `m/s²` as Chinese among them.
So text that is not Unicode is read as Windows-1252, which includes Latin-1, and that is told.
"""

from __future__ import annotations

import re
import zlib

from avtorch.errors import InputError
from avtorch.io.opening import MOST_BYTES

_BINARY = re.compile(rb"[\x00-\x08\x0b\x0e-\x1a\x1c-\x1f]")
_PIECE = 2**20


def unzipped(source: str, raw: bytes) -> bytes:
    """`raw`, or what it holds if it is gzip. Raises InputError for a damaged one, and beyond `MOST_BYTES`."""
    if not raw.startswith(b"\x1f\x8b"):
        return raw
    pieces, size, rest = [], 0, raw
    try:
        while rest.startswith(b"\x1f\x8b"):  # several may follow each other
            part = zlib.decompressobj(wbits=31)
            while not part.eof:
                piece = part.decompress(rest, _PIECE)
                rest = part.unconsumed_tail
                pieces.append(piece)
                size += len(piece)
                if size > MOST_BYTES:
                    raise InputError(f"{source}: holds over {MOST_BYTES:,} bytes; {MOST_BYTES:,} at most are needed")
                if not piece and not rest and not part.eof:
                    raise InputError(f"{source}: ends inside its gzip data; the whole file is needed")
            rest = part.unused_data
    except zlib.error:
        raise InputError(f"{source}: damaged gzip data; write the file anew") from None
    return b"".join(pieces)


def decoded(source: str, raw: bytes) -> tuple[str, tuple[str, ...]]:
    """Text, and a remark on its encoding where that had to be guessed. Raises InputError for what is no text."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return _utf16(source, raw, "utf-16"), ()
    silent = _silent_utf16(raw)
    if silent is not None:
        return _utf16(source, raw, silent), ()
    if b"\0" in raw:
        line = _line(raw[: raw.index(b"\0")])
        raise InputError(f"{source}: line {line}: holds a zero byte, so it is binary; {_NEEDED}")
    try:
        return raw.decode("utf-8-sig"), ()
    except UnicodeDecodeError as fault:
        # after a byte order mark the codec counts from behind it
        start = fault.start + (3 if raw.startswith(b"\xef\xbb\xbf") and len(fault.object) < len(raw) else 0)
    odd = _BINARY.search(raw)
    try:
        if odd is None:
            text = raw.decode("cp1252")
            remark = f"line {_line(raw[:start])} is not UTF-8: the text is read as Windows-1252 (Latin-1)"
            return text, (remark,)
    except UnicodeDecodeError:
        pass
    raise InputError(f"{source}: line {_line(raw[:start])}, byte {start + 1}: is not UTF-8 text; {_NEEDED}")


_NEEDED = "a CSV or Parquet file is needed"


def _silent_utf16(raw: bytes) -> str | None:
    """The byte order of UTF-16 without a mark: ASCII in it has a zero in every other byte, and nowhere else."""
    head = raw[:1000]
    for codec, zero, other in (("utf-16-le", head[1::2], head[::2]), ("utf-16-be", head[::2], head[1::2])):
        if len(zero) >= 4 and zero.count(0) > 0.7 * len(zero) and 0 not in other:
            return codec
    return None


def _utf16(source: str, raw: bytes, codec: str) -> str:
    try:
        text = raw.decode(codec)
    except UnicodeDecodeError as fault:
        raise InputError(f"{source}: byte {fault.start + 1}: is not UTF-16 text; {_NEEDED}") from None
    if "\0" in text:
        raise InputError(f"{source}: holds a zero character, so it is binary; {_NEEDED}")
    return text


def _line(before: bytes) -> int:
    return len(re.findall(rb"\r\n|\r|\n", before)) + 1
