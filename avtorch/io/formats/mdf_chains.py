"""The chains of blocks of an MDF file, walked before a library follows them: each must end, and within the file.

A block names the next one by its address. In a damaged file that may be itself, or one before it, and a reader that
follows it never ends. The layout is that of the standard: in MDF 4 every block begins with its name, its length and
its links; in MDF 3 with a name of two letters, and links at fixed places.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from avtorch.errors import InputError
from avtorch.io.size import MOST_CELLS, MOST_COLUMNS

MOST_BLOCKS = 50 * MOST_COLUMNS
"""Maximum of blocks in the chains: a recording of ten thousand channels in pieces has fewer."""
_MOST_LINKS = 2**16  # of one block
_MOST_INFLATED = 2**28  # bytes of one compressed piece; the standard recommends 4 MiB
_MOST_CYCLES = 100 * MOST_CELLS  # samples that one group may declare
_DEFLATE = 1032  # bytes that deflate makes of one, at most


@dataclass
class Chains:
    """What the walk found."""

    beyond: int = 0
    """Links that point beyond the end of the file, as those of a truncated one do."""
    blocks: int = 0
    cut: dict[int, int] = field(default_factory=dict)
    """Where a block of samples begins that the end of the file cuts, and the bytes it has left."""
    seen: set[int] = field(default_factory=set)


def walk(stream: BinaryIO, source: str) -> Chains:
    """Follow the chains of data groups, channel groups, channels, data, events, attachments and history.

    Raises InputError for a chain that returns to itself, a block that is not of its kind, and beyond 500,000 blocks.
    """
    head = _at(stream, 0, 64)
    if len(head) < 64:
        raise InputError(f"{source}: has {len(head)} bytes; an MDF file begins with 64 bytes of identification")
    version = struct.unpack_from("<H", head, 28)[0]
    walker = _Walk4(stream, source) if version >= 400 else _Walk3(stream, source, big=head[24:26] != b"\0\0")
    walker.run()
    return walker.found


class _Walk:
    def __init__(self, stream: BinaryIO, source: str) -> None:
        self.stream, self.source, self.found = stream, source, Chains()
        self.end = stream.seek(0, 2)

    def new(self, at: int, what: str) -> bool:
        """Whether to go on to the block at `at`: not at an end, whether the chain's own or the file's."""
        if at == 0:
            return False
        if at >= self.end:
            self.found.beyond += 1
            return False
        if at in self.found.seen:
            raise self.fault(at, f"a chain of {what} returns to itself")
        self.found.seen.add(at)
        self.found.blocks += 1
        if self.found.blocks > MOST_BLOCKS:
            raise InputError(f"{self.source}: has more than {MOST_BLOCKS:,} blocks; split it, or name fewer channels")
        return True

    def fault(self, at: int, what: str) -> InputError:
        return InputError(f"{self.source}: byte {at:,}: {what}; an undamaged MDF file is needed")

    def run(self) -> None:
        raise NotImplementedError


class _Walk4(_Walk):
    """MDF 4: links are addresses of 8 bytes behind the block's head."""

    def run(self) -> None:
        hd = self.links(64, b"HD")
        for dg in self.chain(hd[0] if hd else 0, b"DG", "data groups"):
            for cg in self.chain(dg[1], b"CG", "channel groups"):
                self.channels(cg[1], 0)
            self.data(dg[2])
        for link, name in zip(hd[1:5], (b"FH", b"CH", b"AT", b"EV"), strict=False):
            for _ in self.chain(link, name, name.decode()):
                pass

    def links(self, at: int, *names: bytes) -> tuple[int, ...]:
        """The links of the block at `at`, which is one of `names`; none where the file ends within it."""
        head = _at(self.stream, at, 24)
        if len(head) < 24:
            self.found.beyond += 1
            return ()
        name, length, count = head[2:4], *struct.unpack_from("<QQ", head, 8)
        if head[:2] != b"##" or (names and name not in names):
            raise self.fault(at, f"{head[:4]!r} where {' or '.join(n.decode() for n in names)} should be")
        if count > min(_MOST_LINKS, max(0, length - 24) // 8):
            raise self.fault(at, f"a block of {length:,} bytes claims {count:,} links")
        raw = _at(self.stream, at + 24, 8 * count)
        if name == b"CG":
            self.cycles(at, count)
        return struct.unpack(f"<{len(raw) // 8}Q", raw[: len(raw) // 8 * 8])

    def cycles(self, at: int, links: int) -> None:
        fixed = _at(self.stream, at + 24 + 8 * links, 16)
        if len(fixed) == 16 and (count := struct.unpack("<QQ", fixed)[1]) > _MOST_CYCLES:
            raise self.fault(at, f"a group claims {count:,} samples")

    def chain(self, at: int, name: bytes, what: str) -> Iterator[tuple[int, ...]]:
        while self.new(at, what):
            links = self.links(at, name)
            if len(links) < 3 and name in (b"DG", b"CG", b"CN"):
                return
            yield links
            at = links[0] if links else 0

    def channels(self, at: int, depth: int) -> None:
        """Channels of a group, and those they are made of: structures, and arrays of them."""
        if depth > 20:
            raise self.fault(at, "channels are nested more than 20 deep")
        for links in self.chain(at, b"CN", "channels"):
            part = links[1]
            if 0 < part < self.end - 4 and _at(self.stream, part, 4) == b"##CA":
                part = next(iter(self.links(part, b"CA")), 0)
            if 0 < part < self.end - 4 and _at(self.stream, part, 4) == b"##CN" and part not in self.found.seen:
                self.channels(part, depth + 1)
            if len(links) > 5:
                self.data(links[5])

    def data(self, at: int) -> None:
        """Pieces of data: one block, or a chain of lists. Several channels may share one."""
        listed: set[int] = set()
        while 0 < at < self.end - 24:
            name = _at(self.stream, at, 4)[2:4]
            if name == b"DZ":
                self.inflated(at)
            if name == b"DT":
                self.whole(at)
            if name not in (b"HL", b"DL", b"LD"):
                return
            if at in listed:
                raise self.fault(at, "a chain of data returns to itself")
            listed.add(at)
            fresh = at not in self.found.seen
            self.found.seen.add(at)
            if len(listed) > MOST_BLOCKS:
                raise InputError(f"{self.source}: has more than {MOST_BLOCKS:,} lists of data; split it")
            links = self.links(at, name)
            if fresh and name != b"HL":
                for piece in links[1:]:
                    if piece >= self.end:
                        self.found.beyond += 1
                    elif piece and (kind := _at(self.stream, piece, 4)) == b"##DZ":
                        self.inflated(piece)
                    elif piece and kind == b"##DT":
                        self.whole(piece)
            at = links[0] if links else 0
        if at >= self.end - 24:
            self.found.beyond += 1

    def whole(self, at: int) -> None:
        """A block of samples, which the end of the file may cut."""
        head = _at(self.stream, at, 24)
        if len(head) == 24 and at + struct.unpack_from("<Q", head, 8)[0] > self.end:
            self.found.beyond += 1
            self.found.cut[at] = self.end - at

    def inflated(self, at: int) -> None:
        """A compressed piece: its own head says how large it becomes."""
        head = _at(self.stream, at, 48)
        if len(head) == 48:
            claimed, packed = struct.unpack_from("<QQ", head, 32)
            if claimed > min(_MOST_INFLATED, _DEFLATE * packed + 64):
                raise self.fault(at, f"{packed:,} compressed bytes claim to hold {claimed:,}")
            if at + 48 + packed > self.end:
                self.found.beyond += 1


class _Walk3(_Walk):
    """MDF 3: links are addresses of 4 bytes, the first of a block that to the next of its kind."""

    def __init__(self, stream: BinaryIO, source: str, big: bool) -> None:
        super().__init__(stream, source)
        self.order = ">" if big else "<"

    def run(self) -> None:
        hd = self.links(64, b"HD", 1)
        for dg in self.chain(hd[0], b"DG", "data groups", 4):
            for cg in self.chain(dg[1], b"CG", "channel groups", 2):
                for _ in self.chain(cg[1], b"CN", "channels", 1):
                    pass
            if dg[3] > self.end:
                self.found.beyond += 1

    def links(self, at: int, name: bytes, count: int) -> tuple[int, ...]:
        raw = _at(self.stream, at, 4 + 4 * count)
        if raw[:2] != name[: len(raw)]:
            raise self.fault(at, f"{raw[:2]!r} where {name.decode()} should be")
        raw = raw[4:].ljust(4 * count, b"\0")
        return struct.unpack(f"{self.order}{count}I", raw)

    def chain(self, at: int, name: bytes, what: str, count: int) -> Iterator[tuple[int, ...]]:
        while self.new(at, what):
            links = self.links(at, name, count)
            yield links
            at = links[0]


def _at(stream: BinaryIO, at: int, count: int) -> bytes:
    stream.seek(at)
    return stream.read(count)
