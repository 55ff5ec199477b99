"""Digests of the content of a log, by stream: they distinguish logs with the same name."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from graphslam.core.digest import Digest
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.io.log_kinds import stream_kinds

META = ("T_world_frame",)
"""Entries of ``meta`` that affect metrics."""


def log_digest(log: SensorLog) -> dict[str, str]:
    """For each stream and for ground truth: number of records and digest of all arrays, with mounting and noise.

    Clouds are not decoded: the digest is from their packed bytes, so the same scans in memory have another one.
    ``log.read``, ``log.dropped`` and the rest of ``meta`` do not affect digests.

    Returns
    -------
    dict of str to str
        ``{"controls": "7249 records, blake2b 0123…", …}``; ``(truth)`` and ``(meta)`` if there are any.
    """
    out, held = {}, {name: _arrays(stream) for name, stream in log.streams.items()}
    for name, stream in log.streams.items():
        d = Digest()
        d.add("kind", type(stream).__name__)
        d.add_all(held[name])
        out[name] = f"{len(stream.times)} records, blake2b {d.text()}"
    if log.truth is not None:
        d, t = Digest(), log.truth
        path = {f.name: getattr(t.trajectory, f.name) for f in dataclasses.fields(t.trajectory)}
        moving = {f"moving {k}": v.labels for k, v in t.moving.items()}
        d.add_all({**path, "landmark_ids": t.landmark_ids, "landmarks": t.landmarks, **moving})
        out["(truth)"] = f"{len(t.trajectory.times)} records, blake2b {d.text()}"
    known = {k: np.asarray(log.meta[k], dtype=np.float64) for k in META if k in log.meta}
    if known:
        d = Digest()
        d.add_all(known)
        out["(meta)"] = f"blake2b {d.text()}"
    return out


def _arrays(stream: Any) -> dict[str, Any]:
    if isinstance(stream, PointClouds):
        own = {"times": stream.times, "index": stream.index, "origin": stream.origin, "mount": stream.T_base_sensor}
        return {**own, "counts": stream.source.counts, "packed": stream.source.packed()}
    kind = next((k for k in stream_kinds().values() if type(stream) is k.cls), None)
    if kind is not None:
        return kind.arrays(stream)
    return _fields("", stream)  # a stream class of a plug-in


def _fields(where: str, value: Any) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for f in dataclasses.fields(value):
        name, v = f"{where}{f.name}", getattr(value, f.name)
        if dataclasses.is_dataclass(v):
            out |= _fields(f"{name}.", v)
        elif v is None or np.asarray(v).dtype.kind in "biufcSU":
            out[name] = v
    return out
