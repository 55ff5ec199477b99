"""Files of ROS 1, ROS 2 and MCAP bags, read message by message without ROS (packages ``rosbags`` and ``mcap``)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from graphslam.core.errors import FormatError, GraphSlamError, MissingDataError
from graphslam.core.extras import import_extra
from graphslam.core.log import DropCounter
from graphslam.core.reading import most_bytes
from graphslam.io import cut_bags as cut
from graphslam.io.recognise import bag_kind
from graphslam.io.source_probe import SourceProbe, plain_name


@dataclass
class BagTopic:
    """A topic with its message type and number of messages."""

    name: str
    type: str
    count: int = 0


class McapFile(cut.RecordFile):
    """A single MCAP file."""

    def open(self) -> None:
        """Find the topics: from the summary at the end of the file, or else by reading all records."""
        from mcap.reader import make_reader

        try:
            with open(self._path, "rb") as stream:
                summary = make_reader(stream).get_summary()
        except Exception:  # a truncated file has no summary, but may have records
            summary = None
        if summary is not None and summary.statistics is not None and summary.channels:
            counts = summary.statistics.channel_message_counts
            schemas = summary.schemas
            self.connections = [self._channel(c, schemas, counts.get(k, 0)) for k, c in summary.channels.items()]
            return
        super().open()

    @staticmethod
    def _channel(channel: Any, schemas: Any, count: int) -> cut.BagChannel:
        schema = schemas.get(channel.schema_id)
        name = str(schema.name) if schema is not None else "no schema"
        if channel.message_encoding not in ("cdr", "ros1"):
            name += f", {channel.message_encoding}"
        elif name.count("/") == 1:  # type names of ROS 1
            name = name.replace("/", "/msg/")
        return cut.BagChannel(str(channel.topic), name, int(count), str(channel.message_encoding))

    def records(self) -> Iterator[cut.Record]:
        """See :class:`~graphslam.io.cut_bags.RecordFile`."""
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader

        schemas: dict[int, Any] = {}
        channels: dict[int, cut.BagChannel] = {}
        with open(self._path, "rb") as stream:
            for record in StreamReader(stream, record_size_limit=most_bytes()).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = self._channel(record, schemas, 0)
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield channels[record.channel_id], record.log_time, record.data


class BagFiles:
    """The open files of a bag: topics, and messages as ``(topic, bytes, receive time [s])``."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        for package in ("mcap", "rosbags"):
            import_extra(package, "a bag", where=str(path))
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self._stack, self.faults = stack, dict[int, str]()
        self.readers: list[Any] = []
        self.ros2 = True
        for f in _files(path):
            self._open(f)
        if {getattr(c, "encoding", "") for r in self.readers for c in r.connections} == {"ros1"}:
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

    def _open(self, path: Path) -> None:
        """Open a file with the reader of rosbags or, if that fails, record by record."""
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        kind, file = bag_kind(SourceProbe(path), path), cut.local_copy(path, self._stack)
        self.ros2 = kind != "ROS 1 bag"
        try:
            if kind == "MCAP":
                return self._add(McapFile(file))
            if self.ros2 and (missing := cut.missing_pages(file)):
                raise FormatError(missing)
            return self._add(Reader2(file) if self.ros2 else Reader1(file))
        except Exception as error:  # includes MemoryError, from a damaged length field
            why = error_text(error)
        try:
            if kind == "MCAP":
                raise FormatError(why)
            return self._add(cut.CutDatabase(file) if self.ros2 else cut.CutBag1(file), why)
        except Exception:
            raise FormatError(
                f"no message is found in this bag, which is damaged or cut off ({why})",
                where=str(path),
                got=f"{path.stat().st_size:,} bytes",
                wanted="a bag with messages: copy it once more from where it was recorded, or try"
                " `rosbag reindex`, `ros2 bag reindex` or `mcap recover`",
            ) from None

    def _add(self, reader: Any, fault: str = "") -> None:
        self._stack.callback(_quietly, reader.close)
        reader.open()
        if fault and not reader.connections:
            raise FormatError(fault)
        self.readers.append(reader)
        self.faults[id(reader)] = fault

    def messages(self, names: set[str], drops: DropCounter) -> Iterator[tuple[str, bytes, float]]:
        """Messages of topics, in the order of the bag, up to the end of a truncated bag, which is counted."""
        for r in self.readers:
            chosen = [c for c in r.connections if c.topic in names and c.msgtype == self.topics[c.topic].type]
            why, count, first, last = self.faults[id(r)], 0, 0.0, 0.0
            try:
                for c, t, raw in r.messages(chosen) if chosen else ():
                    first, last, count = first if count else 1e-9 * t, 1e-9 * t, count + 1  # an error if t is no number
                    yield c.topic, cut.unpack_message(bytes(raw)), last
            except GraphSlamError:
                raise
            except Exception as error:
                why = error_text(error)
            if why:
                drops.drop(
                    "bag",
                    f"is damaged or cut off ({why}); read up to there: {count} messages in"
                    f" {last - first:.1f} s, the last at {last:.3f}",
                )

    def decode(self, raw: bytes, kind: str) -> Any:
        """Decode a message; :class:`ValueError` if that fails."""
        try:
            if self.ros2:
                return self.store.deserialize_cdr(raw, kind)
            return self.store.deserialize_ros1(raw, kind)
        except Exception as error:
            raise ValueError(error_text(error)) from None


def error_text(error: Exception) -> str:
    text = re.sub(re.escape(gettempdir()) + r"/\w+/", "", " ".join(str(error).split())[:200])
    return text or type(error).__name__


def _quietly(close: Callable[[], None]) -> None:
    try:
        close()
    except Exception:  # a reader that failed may already be closed
        return


def _files(path: Path) -> list[Path]:
    """Files of one bag: a single file, the files of a folder with metadata.yaml, or the parts of one recording."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise MissingDataError("no such file or folder", where=str(path), wanted="a bag")
    look = SourceProbe(path)
    metadata = [
        p for p in look.files if p.name == "metadata.yaml" and look.lines(p, 1)[:1] == ["rosbag2_bagfile_information:"]
    ]
    if len(metadata) == 1:
        look = SourceProbe(metadata[0].parent)
        names = re.findall(r"^ +- (?:.*/)?([^/:]+\.(?:db3|mcap)(?:\.zstd)?)$", "\n".join(look.lines(metadata[0])), re.M)
        if lost := [n for n in names if not (look.path / n).is_file()]:
            raise MissingDataError("a part of the bag is not there", where=str(path), got=str(look), wanted=lost[0])
    found = [p for p in look.files if bag_kind(look, p)]
    if len(metadata) > 1 or not found:
        raise MissingDataError(
            f"{len(metadata) or 'no'} bags here",
            where=str(path),
            got=", ".join(look.relative(p.parent) for p in metadata[:4]) or str(look),
            wanted="one bag: a .bag, .db3 or .mcap file, or a folder with metadata.yaml",
        )
    parts = {re.sub(r"_\d+$", "", Path(plain_name(p)).stem) for p in found}
    if len(parts) > 1 or len({p.suffix for p in found}) > 1:
        raise MissingDataError(
            f"{len(found)} bags here", where=str(path), got=", ".join(look.relative(p) for p in found[:6]), wanted="one"
        )
    return sorted(found, key=lambda p: [int(w) if w.isdigit() else 0 for w in re.split(r"(\d+)", p.stem)])
