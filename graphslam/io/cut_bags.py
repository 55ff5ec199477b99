"""Bag files read record by record: without an index, truncated, compressed, or with a leftover SQLite journal.

ROS 1: records are sequential, and a truncated chunk is decompressed up to its end. ROS 2 (sqlite3): SQLite finds rows
by a tree whose pages may be missing, so all pages are scanned (https://sqlite.org/fileformat2.html).
"""

from __future__ import annotations

import bz2
import io
import mmap
import shutil
import sqlite3
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO
from urllib.parse import quote

from graphslam.core.reading import check_size, most_bytes
from graphslam.io.recognise import SQLITE, ZSTD

_MOST_MESSAGE = 1 << 28  # maximal declared size of a compressed message [bytes]
_LEAF, _INTEGERS = 13, {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}  # SQLite: page type; bytes per serial type


@dataclass(frozen=True, slots=True)
class BagChannel:
    """A topic of one file."""

    topic: str
    msgtype: str
    msgcount: int
    encoding: str


Record = tuple[BagChannel, int, bytes]
"""Topic, stamp in the bag [ns], message."""


class RecordFile(ABC):
    """A file that is read sequentially; with those methods of the rosbags readers that are used here."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.connections: list[BagChannel] = []

    @abstractmethod
    def records(self) -> Iterator[Record]:
        """All messages; an exception at the end of a truncated file."""

    def open(self) -> None:
        """Find the topics by reading all records."""
        seen: Counter[str] = Counter()
        known: dict[str, BagChannel] = {}
        try:
            for channel, _, _ in self.records():
                known.setdefault(channel.topic, channel)
                seen[channel.topic] += 1
        except Exception:
            if not known:
                raise
        self.connections = [replace(c, msgcount=seen[t]) for t, c in known.items()]

    def messages(self, chosen: list[BagChannel]) -> Iterator[Record]:
        """Messages of topics."""
        topics = {c.topic for c in chosen}
        return (r for r in self.records() if r[0].topic in topics)

    def close(self) -> None:  # noqa: B027
        """Does nothing: no file stays open between calls."""


class CutBag1(RecordFile):
    """A ROS 1 bag with a missing or wrong index."""

    def records(self) -> Iterator[Record]:
        """See :class:`RecordFile`."""
        with open(self._path, "rb") as stream:
            stream.readline()
            yield from self._walk(stream, self._path.stat().st_size, {})

    def _walk(self, stream: BinaryIO, size: int, known: dict[int, BagChannel]) -> Iterator[Record]:
        from rosbags.rosbag1.reader import Header, Reader, RecordType, read_bytes, read_uint32

        while (at := stream.tell()) < size:
            header = Header.read(stream)
            op, length = header.get_uint8("op"), read_uint32(stream)
            if op == RecordType.CONNECTION:
                reader = Reader(self._path)
                reader.bio = stream
                stream.seek(at)
                c = reader.read_connection()
                known[c.id] = BagChannel(c.topic, c.msgtype, 0, "ros1")
            elif op == RecordType.MSGDATA:
                yield known[header.get_uint32("conn")], header.get_time("time"), read_bytes(stream, length)
            elif op == RecordType.CHUNK:
                raw = _unchunked(stream.read(min(length, size - stream.tell())), header.get_string("compression"))
                yield from self._walk(io.BytesIO(raw), len(raw), known)
            else:
                stream.seek(length, io.SEEK_CUR)


def _unchunked(raw: bytes, compression: str) -> bytes:
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(raw, most_bytes())
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return bytes(LZ4FrameDecompressor().decompress(raw, most_bytes()))
    return raw


class CutDatabase(RecordFile):
    """A ROS 2 bag (sqlite3) with missing pages."""

    def records(self) -> Iterator[Record]:
        """See :class:`RecordFile`."""
        with closing(sqlite3.connect(f"file:{quote(str(self._path))}?immutable=1", uri=True)) as db:
            db.execute("PRAGMA writable_schema = ON")  # otherwise SQLite rejects a truncated file
            rows = db.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        known = {int(k): BagChannel(str(name), str(kind), 0, str(form)) for k, name, kind, form in rows}
        lost = 0
        with open(self._path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            size = page_size(data[:100])
            for start in range(0, len(data) - 8, size):
                head = start or 100
                count = int.from_bytes(data[head + 3 : head + 5]) if data[head] == _LEAF else 0
                for at in range(head + 8, head + 8 + 2 * count, 2):
                    try:
                        row = _row(data, start + int.from_bytes(data[at : at + 2]), size)
                    except IndexError:
                        lost += 1
                        continue
                    if row is not None and row[0] in known:
                        yield known[row[0]], row[1], row[2]
        if lost:
            raise ValueError(f"{lost} rows are incomplete")


def page_size(head: bytes) -> int:
    """Page size of a database [bytes]."""
    return {0: 512, 1: 1 << 16}.get(size := int.from_bytes(head[16:18]), size)


def _row(data: mmap.mmap, at: int, page: int) -> tuple[int, int, bytes] | None:
    """Topic, stamp and message; None for a row of another table, IndexError if one of its pages is missing."""
    length, at = _varint(data, at)
    _, at = _varint(data, at)
    usable, local = page - data[20], length
    if length > usable - 35:  # the rest is on a chain of overflow pages
        least = (usable - 12) * 32 // 255 - 23
        local = least + (length - least) % (usable - 4)
        local = local if local <= usable - 35 else least
    raw, follows = data[at : at + local], data[at + local : at + local + 4]
    parts, left = [raw], length - local
    while left > 0 and (first := (int.from_bytes(follows) - 1) * page) >= 0 and first < len(data):
        parts.append(data[first + 4 : first + 4 + min(left, usable - 4)])
        follows, left = data[first : first + 4], left - (usable - 4)
    raw = b"".join(parts)
    if len(raw) != length:
        raise IndexError(length)
    at, k = _varint(raw, 0)
    end, kinds = at, list[int]()
    while k < end:
        kind, k = _varint(raw, k)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] or not {*kinds[1:3]} <= _INTEGERS.keys() or kinds[3] < 12 or kinds[3] % 2:
        return None
    values = []
    for kind in kinds[1:3]:
        values.append(kind - 8 if kind > 7 else int.from_bytes(raw[at : at + _INTEGERS[kind]], signed=True))
        at += _INTEGERS[kind]
    return values[0], values[1], raw[at : at + (kinds[3] - 12) // 2]


def _varint(data: mmap.mmap | bytes, at: int) -> tuple[int, int]:
    value = 0
    for k in range(at, at + 8):
        value = value << 7 | data[k] & 127
        if data[k] < 128:
            return value, k + 1
    return value << 8 | data[at + 8], at + 9


def missing_pages(path: Path) -> str:
    """Present and expected size of a truncated database as text; empty if it is complete."""
    with open(path, "rb") as stream:
        head = stream.read(100)
    known = head.startswith(SQLITE) and head[24:28] == head[92:96]
    size, wanted = path.stat().st_size, int.from_bytes(head[28:32]) * page_size(head) if known else 0
    return f"{size:,} bytes of {wanted:,}" if size < wanted else ""


def local_copy(path: Path, stack: ExitStack) -> Path:
    """The file itself, or a temporary copy: decompressed (zstd), or with the SQLite journal next to it applied."""
    with open(path, "rb") as stream:
        head = stream.read(16)
    beside = [path.with_name(path.name + e) for e in ("-wal", "-journal")] if head == SQLITE else []
    beside = [p for p in beside if p.is_file() and p.stat().st_size]
    if not head.startswith(ZSTD) and not beside:
        return path
    folder = Path(stack.enter_context(TemporaryDirectory()))
    copy = folder / path.name.removesuffix(".zstd")
    if beside:
        for p in (path, *beside):
            shutil.copyfile(p, folder / p.name)
        with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as db:
            db.execute("PRAGMA journal_mode = DELETE")
        return copy
    import zstandard

    size = 0
    with open(path, "rb") as stream, open(copy, "wb") as out, suppress(zstandard.ZstdError):
        for part in zstandard.ZstdDecompressor().read_to_iter(stream):
            check_size(size := size + len(part), str(path))
            out.write(part)
    return copy


def unpack_message(raw: bytes) -> bytes:
    """Decompress a message that the recorder compressed (zstd)."""
    if raw.startswith(ZSTD):
        import zstandard

        with suppress(zstandard.ZstdError):
            if 0 <= zstandard.frame_content_size(raw) <= _MOST_MESSAGE:
                return zstandard.ZstdDecompressor().decompress(raw)
    return raw
