"""A sensor log on disk: a folder with ``log.json`` and one npz per stream (format ``graphslam.log/1``).

``log.json`` contains name, meta, counts and the list of streams (name, kind, file, records); ``truth.npz`` contains
ground truth, if known. All numbers are restored bit for bit. Pickle is not used; ``log.json`` is written last, so a
folder without it is an unfinished log. The kinds of streams are in :mod:`graphslam.io.log_kinds`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graphslam.core.atomic import read_json, read_npz, write_json, write_npz
from graphslam.core.errors import DataError, FormatError
from graphslam.core.log import BeamLabels, SensorLog, Truth
from graphslam.core.npz import check_arrays, floats, ints
from graphslam.core.reading import resolve_inside
from graphslam.core.records import Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.log_kinds import Arrays, kind_name, stream_kinds

LOG_FORMAT = "graphslam.log/1"
STREAM_FORMAT = "graphslam.stream/1"
TRUTH_FORMAT = "graphslam.truth/1"
INDEX_NAME = "log.json"
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def save_log(log: SensorLog, folder: str | os.PathLike[str]) -> Path:
    """Write ``log`` into ``folder`` (created if missing; an older log there is replaced)."""
    root = Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    (root / INDEX_NAME).unlink(missing_ok=True)  # an interrupted call leaves no valid log
    entries = []
    for name, stream in log.streams.items():
        where = f"{root}, stream {name!r}"
        if not _SAFE_NAME.fullmatch(name) or name.lower() == "truth":
            raise FormatError("stream name is no file name", where=where, wanted="letters, digits, _ . - (not truth)")
        kind = kind_name(stream, where)
        header = {"format": STREAM_FORMAT, "kind": kind}
        write_npz(root / f"{name}.npz", {**header, **stream_kinds()[kind].arrays(stream)})
        entries.append({"name": name, "kind": kind, "file": f"{name}.npz", "records": len(stream.times)})
    if log.truth is not None:
        write_npz(root / "truth.npz", _truth_arrays(log.truth))
    index = {
        "format": LOG_FORMAT,
        "name": log.name,
        "streams": entries,
        "truth": "truth.npz" if log.truth is not None else None,
        "read": {k: int(v) for k, v in log.read.items()},
        "dropped": {k: int(v) for k, v in log.dropped.items()},
        "meta": dict(log.meta),
    }
    write_json(root / INDEX_NAME, index)
    return root


def load_log(folder: str | os.PathLike[str]) -> SensorLog:
    """Read a log written by :func:`save_log`."""
    root = Path(folder)
    index_path = resolve_inside(root, INDEX_NAME, str(root))
    where = str(index_path)
    index = read_json(index_path, fmt=LOG_FORMAT, shape=_INDEX)
    streams: dict[str, Stream] = {}
    for entry in index["streams"]:
        name, kind = entry["name"], entry["kind"]
        path = resolve_inside(root, entry["file"], where)
        if name in streams:
            raise FormatError("stream listed twice", where=where, got=repr(name[:80]))
        arrays = read_npz(path, fmt=STREAM_FORMAT)
        if kind not in stream_kinds() or str(arrays.get("kind")) != kind:
            raise FormatError(
                "unknown stream kind", where=str(path), got=f"{arrays.get('kind')} listed as {kind!r}", wanted=kind
            )
        made = stream_kinds()[kind]
        streams[name] = _build(str(path), lambda a=arrays, k=made, p=path: k.stream(a, str(p)))  # type: ignore[misc]
        if len(streams[name].times) != entry["records"]:
            raise FormatError(
                "wrong number of records", where=str(path), got=len(streams[name].times), wanted=entry["records"]
            )
    truth = None
    if index.get("truth") is not None:
        path = resolve_inside(root, index["truth"], where)
        truth = _build(str(path), lambda: _truth(read_npz(path, fmt=TRUTH_FORMAT), str(path)))
    return SensorLog(
        name=index["name"],
        streams=streams,
        truth=truth,
        read=index["read"],
        dropped=index["dropped"],
        meta=index["meta"],
    )


_INDEX = {
    "name": str,
    "streams": [{"name": str, "file": str, "kind": str, "records": int}],
    "truth?": str,
    "read": {str: int},
    "dropped": {str: int},
    "meta": {},
}
_TRUTH = {
    "times": floats("n"),
    "poses": floats("n", "p"),
    "covariances": floats("n", "d", "d", optional=True),
    "landmark_ids": ints("l"),
    "landmarks": floats("l", "c"),
}


def _truth_arrays(truth: Truth) -> dict[str, Any]:
    t = truth.trajectory
    arrays = {
        "format": TRUTH_FORMAT,
        "times": t.times,
        "poses": t.poses,
        "landmark_ids": truth.landmark_ids,
        "landmarks": truth.landmarks,
    }
    for name, moving in truth.moving.items():
        arrays |= {f"moving.{name}": moving.labels, f"moving-times.{name}": moving.times}
    return arrays if t.covariances is None else {**arrays, "covariances": t.covariances}


def _truth(arrays: Arrays, where: str) -> Truth:
    names = [k.removeprefix("moving.") for k in arrays if k.startswith("moving.")]
    moving = {f"moving.{k}": ints("n" + k, "m" + k) for k in names}
    moving |= {f"moving-times.{k}": floats("n" + k) for k in names}
    a = check_arrays(arrays, {**_TRUTH, **moving}, where)
    return Truth(
        moving={k: BeamLabels(a[f"moving-times.{k}"], a[f"moving.{k}"]) for k in names},
        trajectory=Trajectory(a["times"], a["poses"], a.get("covariances")),
        landmark_ids=a["landmark_ids"],
        landmarks=a["landmarks"],
    )


def _build(where: str, make: Callable[[], Any]) -> Any:
    """Call a constructor with data of a file; its :class:`DataError` becomes a :class:`FormatError` of the file."""
    try:
        return make()
    except DataError as error:
        if error.where is not None and error.where.startswith(where):
            raise
        raise FormatError(f"holds an impossible record ({error})", where=where) from error
