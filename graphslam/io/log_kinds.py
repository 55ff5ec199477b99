"""Kinds of streams that can be stored on disk, and their conversion to arrays and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphslam.core.errors import FormatError
from graphslam.core.gnss import Pseudoranges
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.npz import Field, check_arrays, floats, ints, texts
from graphslam.core.point_clouds import ArrayClouds, PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import (
    PLAIN,
    AckermannGeometry,
    Gps,
    LandmarkObservations,
    LaserScans,
    Odometry,
    SteeringControls,
)
from graphslam.core.trajectory import Trajectory

Arrays = Mapping[str, Any]


def _nothing(_: Any) -> dict[str, Any]:
    return {}


@dataclass(frozen=True, slots=True)
class StreamKind:
    """Conversion of streams of one class to arrays and back.

    Parameters
    ----------
    fields : mapping of str to Field
        Arrays that are fields of the class.
    pack : callable
        Stream → additional arrays.
    unpack : callable
        Arrays → additional arguments of the class.
    more : mapping of str to Field
        The additional arrays.
    """

    cls: type
    fields: Mapping[str, Field]
    pack: Callable[[Any], dict[str, Any]] = _nothing
    unpack: Callable[[Arrays], dict[str, Any]] = _nothing
    more: Mapping[str, Field] = field(default_factory=dict)

    def arrays(self, stream: Any) -> dict[str, Any]:
        """The stream as arrays by name."""
        return {**{f: getattr(stream, f) for f in self.fields}, **self.pack(stream)}

    def stream(self, arrays: Arrays, where: str) -> Any:
        """Inverse of :meth:`arrays`; errors of the class are not converted."""
        arrays = check_arrays(arrays, {**self.fields, **self.more}, where)
        return self.cls(**{f: arrays[f] for f in self.fields}, **self.unpack(arrays))


def _pack_steering(s: SteeringControls) -> dict[str, Any]:
    g = s.geometry
    return {
        "wheelbase": np.float64(g.wheelbase),
        "encoder_offset": np.float64(g.encoder_offset),
        "model": np.str_(g.model),
    }


def _unpack_steering(a: Arrays) -> dict[str, Any]:
    return {
        "geometry": AckermannGeometry(
            wheelbase=float(a["wheelbase"]), encoder_offset=float(a["encoder_offset"]), model=str(a["model"])
        )
    }


def _pack_landmarks(s: LandmarkObservations) -> dict[str, Any]:
    extra = {"max_range": np.float64(s.max_range), "field_of_view": np.array(s.field_of_view)}
    return extra if s.ids is None else {**extra, "ids": s.ids}


def _unpack_landmarks(a: Arrays) -> dict[str, Any]:
    low, high = (float(v) for v in a["field_of_view"])
    return {"max_range": float(a["max_range"]), "field_of_view": (low, high), "ids": a.get("ids")}


def _pack_imu(s: Imu) -> dict[str, Any]:
    noise = {f"noise_{f.name}": np.float64(getattr(s.noise, f.name)) for f in dataclasses.fields(ImuNoise)}
    return noise if s.attitude is None else {**noise, "attitude": s.attitude}


def _unpack_imu(a: Arrays) -> dict[str, Any]:
    noise = ImuNoise(**{f.name: float(a[f"noise_{f.name}"]) for f in dataclasses.fields(ImuNoise)})
    return {"noise": noise, "attitude": a.get("attitude")}


def _pack_clouds(s: PointClouds) -> dict[str, Any]:
    """Decode all scans of the stream, but not other scans of its source."""
    clouds = [np.asarray(c, dtype=np.float64).reshape(-1, 3) for c in s]
    offsets = np.concatenate([[0], np.cumsum([len(c) for c in clouds])]).astype(np.int64)
    ages = [s.ages(k) for k in range(len(s))]
    packed = {"points": np.concatenate(clouds) if clouds else np.zeros((0, 3)), "offsets": offsets}
    if clouds and all(a is not None for a in ages):
        packed["before"] = np.concatenate([a for a in ages if a is not None])
    return packed


def _unpack_clouds(a: Arrays) -> dict[str, Any]:
    return {"source": ArrayClouds(a["points"], a["offsets"], a.get("before"))}


def _floats(*names: str) -> dict[str, Any]:
    """``pack``, ``unpack`` and ``more`` for fields that are single numbers."""
    return {
        "pack": lambda s: {n: np.float64(getattr(s, n)) for n in names},
        "unpack": lambda a: {n: float(a[n]) for n in names},
        "more": {n: floats(finite=n != "max_range") for n in names},
    }


_TIMES = {"times": floats("n")}
KINDS: dict[str, StreamKind] = {
    "laser-scans": StreamKind(
        LaserScans,
        {**_TIMES, "ranges": floats("n", "m", finite=False), "bearings": floats("m"), "T_base_sensor": floats(3)},
        **_floats("max_range"),
    ),
    "range-scans": StreamKind(
        RangeScans,
        {
            **_TIMES,
            "ranges": floats("n", "m", finite=False),
            "directions": floats("m", 3),
            "beam_times": floats("m"),
            "T_base_mount": floats(7),
            "spin": floats("n"),
            "spin_rate": floats("n"),
        },
        **_floats("max_range", "sigma"),
    ),
    "point-clouds": StreamKind(
        PointClouds,
        {**_TIMES, "origin": floats(3), "T_base_sensor": floats(7)},
        _pack_clouds,
        _unpack_clouds,
        {"points": floats("q", 3), "offsets": ints("n+1"), "before": floats("q", optional=True)},
    ),
    "imu": StreamKind(
        Imu,
        {
            **_TIMES,
            "angular_rate": floats("n", 3),
            "specific_force": floats("n", 3),
            "T_base_imu": floats(7),
        },
        _pack_imu,
        _unpack_imu,
        {
            "attitude": floats("n", 2, optional=True),
            **{f"noise_{f.name}": floats() for f in dataclasses.fields(ImuNoise)},
        },
    ),
    "steering-controls": StreamKind(
        SteeringControls,
        {**_TIMES, "speed": floats("n"), "steering": floats("n")},
        _pack_steering,
        _unpack_steering,
        {"wheelbase": floats(), "encoder_offset": floats(), "model": texts()},
    ),
    "odometry": StreamKind(Odometry, {**_TIMES, "increments": floats("n", "p"), "covariances": floats("n", "d", "d")}),
    "gps": StreamKind(
        Gps,
        {**_TIMES, "positions": floats("n", "c"), "sigma": floats("n"), "lever": floats("c")},
        lambda s: {} if s.covariances is None else {"covariances": s.covariances},
        lambda a: {"covariances": a.get("covariances")},
        {"covariances": floats("n", "c", "c", optional=True)},
    ),
    "pseudoranges": StreamKind(
        Pseudoranges,
        {
            **_TIMES,
            "offsets": ints("n+1"),
            "ranges": floats("q"),
            "sigmas": floats("q"),
            "satellites": floats("q", 3),
            "ids": ints("q"),
            "systems": ints("q"),
            "elevation": floats("q"),
            "density": floats("q"),
            "lever": floats(3),
        },
    ),
    "landmark-observations": StreamKind(
        LandmarkObservations,
        {
            **_TIMES,
            "offsets": ints("n+1"),
            "ranges": floats("q"),
            "bearings": floats("q"),
            "sigmas": floats("q", 2, finite=False),
            "T_base_sensor": floats(3),
        },
        _pack_landmarks,
        _unpack_landmarks,
        {"max_range": floats(finite=False), "field_of_view": floats(2), "ids": ints("q", optional=True)},
    ),
    "trajectory": StreamKind(
        Trajectory,
        {**_TIMES, "poses": floats("n", "p")},
        lambda s: {} if s.covariances is None else {"covariances": s.covariances},
        lambda a: {"covariances": a.get("covariances")},
        {"covariances": floats("n", "d", "d", optional=True)},
    ),
}
"""By the name in ``log.json``; :func:`stream_kinds` adds those of :data:`~graphslam.core.records.PLAIN`."""


def stream_kinds() -> dict[str, StreamKind]:
    """All kinds of streams that can be stored, also those of plug-ins."""
    return KINDS | {
        kind: StreamKind(cls, {f.name: floats("n") for f in dataclasses.fields(cls)}) for kind, cls in PLAIN.items()
    }


def kind_name(stream: Any, where: str | None = None) -> str:
    """Name of the kind of a stream."""
    for name, kind in stream_kinds().items():
        if type(stream) is kind.cls:
            return name
    raise FormatError(
        "stream of a kind that cannot be stored",
        where=where,
        got=type(stream).__name__,
        wanted=", ".join(stream_kinds()),
    )
