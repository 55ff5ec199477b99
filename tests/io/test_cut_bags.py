"""Bags that are cut off, packed, or left by a recorder that was stopped: what is in them is read, and is right."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.reading import size_limit
from graphslam.io.catalog import load_recording
from tests.io.bag_worlds import Message, Messages, write_mcap, write_ros1, write_ros2

N, T0 = 100, 1.7e9


def clouds() -> np.ndarray:
    return np.random.default_rng(3).uniform(-9, 9, (N, 2000, 3)).round(3)


def recording(*, ros1: bool = False) -> list[Message]:
    """Clouds of 36 kB, each on many pages of a database, and an IMU between them."""
    m, out = Messages(ros1), list[Message]()
    for k, xyz in enumerate(clouds()):
        t = T0 + 0.1 * k
        out.append(("/imu", "sensor_msgs/msg/Imu", t, m.imu(t, [0, 0, 0.2], [0, 0, 9.8], frame="lidar")))
        out.append(("/points", "sensor_msgs/msg/PointCloud2", t + 0.02, m.cloud(t, xyz)))
    return out


def write(folder: Path, form: str) -> Path:
    """A recording; the file that a cut is to hit."""
    if form.startswith("ros1"):
        return write_ros1(folder / "a.bag", recording(ros1=True), compress=form[5:])
    if form == "mcap":
        return write_mcap(folder / "a.mcap", recording())
    return next(write_ros2(folder / "a", recording()).glob("*.db3"))


def bag_fault(log: SensorLog) -> str:
    return next((k for k in log.dropped if k.startswith("bag: is damaged")), "")


def holds_the_first(log: SensorLog, least: int, most: int) -> int:
    """Number of clouds, each of which is the one that was recorded."""
    c = log["clouds"]
    n = len(c.times)
    assert least <= n <= most
    np.testing.assert_allclose(c.times, T0 + 0.1 * np.arange(n), atol=1e-6)
    for k in range(n):
        np.testing.assert_allclose(c.cloud(k), clouds()[k], atol=1e-6)
    return n


@pytest.mark.parametrize("form", ["ros1", "ros1:BZ2", "ros1:LZ4", "db3", "folder", "mcap"])
@pytest.mark.parametrize("part", [0.5, 0.9])
def test_a_bag_is_read_up_to_the_cut(tmp_path: Path, form: str, part: float) -> None:
    path = write(tmp_path, form)
    raw = path.read_bytes()
    path.write_bytes(raw[: int(part * len(raw))])
    log = load_recording(path.parent if form == "folder" else path)
    # a block of bzip2 holds 900 kB, of LZ4 64 kB, a chunk of MCAP here one cloud
    n = holds_the_first(log, int(part * N) - (30 if form == "ros1:BZ2" else 3), int(part * N) + 1)
    fault = bag_fault(log)
    count, last = int(fault.split("read up to there: ")[1].split()[0]), float(fault.split("the last at ")[1])
    assert count == len(log["imu"].times) + n
    assert last == pytest.approx(max(log["imu"].times[-1], T0 + 0.1 * (n - 1) + 0.02), abs=1e-3)


def test_a_ros1_bag_without_an_index(tmp_path: Path) -> None:
    """As ``rosbag record`` leaves it when it is killed."""
    path = write(tmp_path, "ros1")
    raw = path.read_bytes()
    index = struct.unpack("<Q", raw[raw.index(b"index_pos=") + 10 :][:8])[0]
    head = raw[:index].replace(b"index_pos=" + struct.pack("<Q", index), b"index_pos=" + bytes(8))
    active = tmp_path / "a.bag.active"
    active.write_bytes(head)
    path.unlink()
    for source in (active, tmp_path):
        log = load_recording(source)
        holds_the_first(log, N, N)
        assert "not indexed" in bag_fault(log)
        assert "200 messages in 9.9 s" in bag_fault(log)


def test_a_cut_before_the_first_message_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = write(tmp_path, "ros1")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(
        FormatError, match=r"a\.bag: no message is found .* cut off .*got 5,000 bytes; wanted .*copy it"
    ):
        load_recording(path)


def test_a_database_is_read_up_to_a_stamp_that_is_no_number(tmp_path: Path) -> None:
    path = write(tmp_path, "db3")
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET timestamp = x'00' WHERE id = 199")  # sorted behind all numbers
    log = load_recording(path)
    holds_the_first(log, N, N)
    assert "199 messages" in bag_fault(log)


@pytest.mark.parametrize("mode", ["wal", "delete"])
def test_a_journal_beside_a_database_is_applied(tmp_path: Path, mode: str) -> None:
    """What a recorder wrote last is in the WAL; a rollback journal undoes a transaction that was not finished."""
    whole = write(tmp_path, "db3")
    path = tmp_path / "b.db3"
    live = sqlite3.connect(whole)
    live.execute(f"PRAGMA journal_mode = {mode}")
    live.execute("PRAGMA wal_autocheckpoint = 0")
    live.execute("PRAGMA cache_size = 1")  # so that pages reach the file before the end of a transaction
    live.execute("DELETE FROM messages WHERE id > 60")
    if mode == "wal":
        live.commit()
    else:
        live.execute("SELECT count(*) FROM messages").fetchone()
    for p in (whole, *whole.parent.glob("*.db3-*")):
        shutil.copy(p, path.with_name(p.name.replace(whole.name, path.name)))
    live.close()
    before = path.read_bytes()
    assert list(tmp_path.glob("b.db3-*"))
    holds_the_first(load_recording(path), *(30, 30) if mode == "wal" else (N, N))
    assert path.read_bytes() == before


@pytest.mark.parametrize("form", ["db3", "mcap"])
def test_a_packed_file_alone(tmp_path: Path, form: str) -> None:
    path = write(tmp_path, form)
    packed = tmp_path / f"b.{form}.zstd"
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    holds_the_first(load_recording(packed), N, N)
    packed.write_bytes(packed.read_bytes()[: packed.stat().st_size // 2])
    cut = load_recording(packed)
    holds_the_first(cut, 5, N - 10)
    assert bag_fault(cut)
    with size_limit(100_000), pytest.raises(FormatError, match="max-size"):
        load_recording(packed)


def test_packed_parts_of_one_recording(tmp_path: Path) -> None:
    for k, half in enumerate((recording()[:N], recording()[N:])):
        raw = next(write_ros2(tmp_path / f"w{k}", half).glob("*.db3")).read_bytes()
        (tmp_path / "parts").mkdir(exist_ok=True)
        (tmp_path / "parts" / f"a_{k}.db3.zstd").write_bytes(zstandard.compress(raw))
    holds_the_first(load_recording(tmp_path / "parts"), N, N)


def test_a_part_that_metadata_names_and_that_is_not_there(tmp_path: Path) -> None:
    path = write(tmp_path, "db3")
    path.rename(path.with_name("other.db3"))
    with pytest.raises(MissingDataError, match=r"part of the bag is not there; .* wanted a\.db3"):
        load_recording(path.parent)


def test_packed_messages_without_metadata(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "a", recording(), compress="MESSAGE")
    (folder / "metadata.yaml").unlink()
    holds_the_first(load_recording(folder), N, N)


def test_rows_on_several_pages_are_read_as_sqlite_reads_them(tmp_path: Path) -> None:
    """Every length of a row around the limits at which SQLite moves its end to other pages, and stamps of all sizes."""
    from graphslam.io.cut_bags import CutDatabase

    path = tmp_path / "a.db3"
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
    db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    db.execute("INSERT INTO topics VALUES (1, '/a', 'x/msg/A', 'cdr'), (300, '/b', 'x/msg/B', 'cdr')")
    lengths = [*range(0, 130), *range(440, 530), *range(4020, 4100), *range(8100, 8190), 70_000]
    stamps = [0, 1, 127, -128, 2**15, 2**23, 2**31, 2**47, 1_700_000_000_000_000_000]
    rows = [((1, 300)[k % 2], stamps[k % 9], bytes([k % 251]) * n) for k, n in enumerate(lengths)]
    db.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    db.commit()
    read = [({"/a": 1, "/b": 300}[c.topic], t, raw) for c, t, raw in CutDatabase(path).records()]
    assert read == rows
