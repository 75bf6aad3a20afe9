"""Damage to a kept file: bits, numbers, ends, pieces."""

from __future__ import annotations

import random

KINDS = 5


def damaged(whole: bytes, kind: int, rng: random.Random) -> bytes:
    """`whole` after damage of one of the `KINDS`, somewhere."""
    content = bytearray(whole)
    at, more = sorted(rng.sample(range(len(whole)), 2))
    match kind:
        case 0:
            content[at] ^= 1 << rng.randrange(8)
        case 1:  # another number
            i = rng.choice([i for i, byte in enumerate(whole) if chr(byte) in "0123456789"])
            content[i] = rng.choice([d for d in b"0123456789" if d != content[i]])
        case 2:
            del content[at:]
        case 3:
            content[at:more] = b""
        case 4:
            content[at:at] = rng.choice([b" ", b"\n", b"\0", b"-", b"1", b'"', b"[[", rng.randbytes(9)])
        case _:
            raise ValueError(f"kind: found {kind}, needs 0 to {KINDS - 1}")
    return bytes(content)
