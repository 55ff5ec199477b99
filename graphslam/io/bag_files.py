"""Files of bags: ROS 1, ROS 2 and MCAP, opened by the package ``rosbags`` and read message by message, without ROS."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from graphslam.core.errors import FormatError, GraphSlamError, MissingDataError
from graphslam.core.extras import import_extra
from graphslam.core.log import DropCounter
from graphslam.core.reading import most_bytes
from graphslam.io.recognise import bag_kind
from graphslam.io.source_probe import SourceProbe


@dataclass
class BagTopic:
    """A topic: its type, and how many messages were seen."""

    name: str
    type: str
    count: int = 0


@dataclass(frozen=True, slots=True)
class McapChannel:
    """A topic of an MCAP file."""

    topic: str
    msgtype: str
    msgcount: int
    encoding: str


class McapFile:
    """A single MCAP file, whatever else is in it; with the methods of the readers of rosbags that are used here."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.connections: list[McapChannel] = []

    def open(self) -> None:
        """Find the topics: in the summary at the end, or else by all records."""
        from mcap.reader import make_reader

        try:
            with open(self._path, "rb") as stream:
                summary = make_reader(stream).get_summary()
        except Exception:  # cut off: its records may be there all the same
            summary = None
        if summary is not None and summary.statistics is not None and summary.channels:
            counts = summary.statistics.channel_message_counts
            schemas = summary.schemas
            self.connections = [self._channel(c, schemas, counts.get(k, 0)) for k, c in summary.channels.items()]
            return
        seen: Counter[str] = Counter()
        known: dict[str, McapChannel] = {}
        try:
            for channel, _, _ in self._records():
                known.setdefault(channel.topic, channel)
                seen[channel.topic] += 1
        except Exception:
            if not known:
                raise
        self.connections = [replace(c, msgcount=seen[t]) for t, c in known.items()]

    @staticmethod
    def _channel(channel: Any, schemas: Any, count: int) -> McapChannel:
        schema = schemas.get(channel.schema_id)
        name = str(schema.name) if schema is not None else "no schema"
        if channel.message_encoding not in ("cdr", "ros1"):
            name += f", {channel.message_encoding}"
        elif name.count("/") == 1:  # as ROS 1 says it
            name = name.replace("/", "/msg/")
        return McapChannel(str(channel.topic), name, int(count), str(channel.message_encoding))

    def _records(self) -> Iterator[tuple[McapChannel, int, bytes]]:
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader

        schemas: dict[int, Any] = {}
        channels: dict[int, McapChannel] = {}
        with open(self._path, "rb") as stream:
            for record in StreamReader(stream, record_size_limit=most_bytes()).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = self._channel(record, schemas, 0)
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield channels[record.channel_id], record.log_time, record.data

    def messages(self, chosen: list[McapChannel]) -> Iterator[tuple[McapChannel, int, bytes]]:
        """Messages of topics."""
        topics = {c.topic for c in chosen}
        return (r for r in self._records() if r[0].topic in topics)

    def close(self) -> None:
        """Nothing is open between two calls."""


class BagFiles:
    """The files of a bag, opened: topics, and messages as ``(topic, bytes, bag's stamp, decode)``."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        for package in ("mcap", "rosbags"):
            import_extra(package, "a bag", where=str(path))
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        files = _files(path)
        kinds = {f: "" if f.is_dir() else bag_kind(SourceProbe(f), f) for f in files}
        self.ros2 = "ROS 1 bag" not in kinds.values()
        self.readers: list[Any] = []
        for f in files:
            try:
                reader = McapFile(f) if kinds[f] == "MCAP" else Reader2(f) if self.ros2 else Reader1(f)
                reader.open()
            except Exception as error:  # MemoryError, too: a damaged length asks for more than any file holds
                raise FormatError(
                    f"bag cannot be opened: {error_text(error)}",
                    where=str(f),
                    got=f"{_size(f):,} bytes" if f.is_file() else None,
                    wanted="a bag that is whole: `rosbag reindex`, `ros2 bag reindex` or `mcap recover` may repair it",
                ) from None
            stack.callback(_quietly, reader.close)
            self.readers.append(reader)
        if kinds[files[0]] == "MCAP" and {c.encoding for r in self.readers for c in r.connections} == {"ros1"}:
            self.ros2 = False
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.ros2 else Stores.ROS1_NOETIC)
        if not self.ros2:
            types = {"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"}
            own = get_typestore(Stores.ROS2_HUMBLE).fielddefs["tf2_msgs/msg/TFMessage"]
            self.store.register({t: own for t in types if t not in self.store.fielddefs})
        self.topics: dict[str, BagTopic] = {}
        for r in self.readers:
            for c in r.connections:
                topic = self.topics.setdefault(c.topic, BagTopic(c.topic, c.msgtype))
                topic.count += int(c.msgcount)

    def messages(self, names: set[str], drops: DropCounter) -> Iterator[tuple[str, bytes, float]]:
        """Messages of topics, in the order of the bag; a bag that ends too early ends there, which is counted."""
        for r in self.readers:
            chosen = [c for c in r.connections if c.topic in names and c.msgtype == self.topics[c.topic].type]
            if not chosen:
                continue
            try:
                for c, t, raw in r.messages(chosen):
                    yield c.topic, bytes(raw), 1e-9 * t
            except GraphSlamError:
                raise
            except Exception as error:
                drops.drop("bag", f"is damaged or truncated; read up to there ({error_text(error)})")

    def decode(self, raw: bytes, kind: str) -> Any:
        """A message; :class:`ValueError` where it cannot be decoded."""
        try:
            if self.ros2:
                return self.store.deserialize_cdr(raw, kind)
            return self.store.deserialize_ros1(raw, kind)
        except Exception as error:
            raise ValueError(error_text(error)) from None


def error_text(error: Exception) -> str:
    text = " ".join(str(error).split())[:200]
    return text or f"damaged or cut off ({type(error).__name__})"


def _size(path: Path) -> int:
    return path.stat().st_size


def _quietly(close: Callable[[], None]) -> None:
    try:
        close()
    except Exception:  # a reader that failed may be closed already
        return


def _files(path: Path) -> list[Path]:
    """What rosbags opens: a folder with metadata.yaml, or files that are parts of one recording."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise MissingDataError("no such file or folder", where=str(path), wanted="a bag")
    look = SourceProbe(path)
    metadata = [
        p for p in look.files if p.name == "metadata.yaml" and look.lines(p, 1)[:1] == ["rosbag2_bagfile_information:"]
    ]
    if len(metadata) == 1:
        return [metadata[0].parent]
    found = [p for p in look.files if bag_kind(look, p)]
    if len(metadata) > 1 or not found:
        raise MissingDataError(
            f"{len(metadata) or 'no'} bags here",
            where=str(path),
            got=", ".join(look.relative(p.parent) for p in metadata[:4]) or str(look),
            wanted="one bag",
        )
    parts = {re.sub(r"_\d+$", "", p.stem) for p in found}
    if len(parts) > 1 or len({p.suffix for p in found}) > 1:
        raise MissingDataError(
            f"{len(found)} bags here", where=str(path), got=", ".join(look.relative(p) for p in found[:6]), wanted="one"
        )
    return sorted(found, key=lambda p: [int(w) if w.isdigit() else 0 for w in re.split(r"(\d+)", p.stem)])
