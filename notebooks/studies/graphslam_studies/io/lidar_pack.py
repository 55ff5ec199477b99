"""Recorded 3-D lidar scans, packed: integer coordinates in one compressed array, scan offsets, and poses if any.

A folder holds

* ``xyz_i16_planar.npy`` ``(3, q)`` int16, plain or ``.xz``: coordinates in units of a *step* that the files do not say
  (the data-set cards do). A point with -32768 in it is a missing return.
* ``scan_offsets.npy`` ``(n + 1,)``: points of scan k are columns ``offsets[k]:offsets[k + 1]``.
* stamps: ``times.txt``, one line a scan; or in the rows of the poses; or none, and a period must be given.
* poses, none or one of ``odom_poses.txt`` (a row of ``[R | t]`` a scan, scan frame → world) and ``alidarPose.csv``
  (BALM: four rows a scan, ``[R | t]`` and ``0, 0, 0, stamp``), and ``optimized_poses.txt`` with the results of a
  pose graph.

The log has the streams ``clouds`` (:class:`~graphslam.core.point_clouds.PointClouds`), ``odometry`` (motion from scan
to scan) and ``reference`` (:class:`~graphslam.core.trajectory.Trajectory`). The last two are results of other programs,
so none of them is called truth. The base is the frame of the points.

Points are decoded when the first of them is asked for, all at once (the packs are one compressed stream), and are then
held as integers: 6 bytes a point.
"""

from __future__ import annotations

import io
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.npz import MOST_HEADER, npy_begin, npy_header, read_npy
from graphslam.core.point_clouds import PointClouds, check_offsets
from graphslam.core.reading import read_bytes
from graphslam.core.records import Odometry, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import usable_records
from graphslam.io.text_records import find_text_file, read_table

POINTS, OFFSETS = "xyz_i16_planar.npy", "scan_offsets.npy"
MISSING = -32768
ODOMETRY_SIGMAS = (0.03, 0.005)
"""Stated σ of one motion between scans, per axis: metres, radians. The recordings state none."""
_NOT_A_ROTATION = 1e-2  # largest |R Rᵀ - I| of a rotation printed with three digits or more


class PackedClouds:
    """Points of a pack; see :class:`~graphslam.core.point_clouds.CloudSource`.

    Parameters
    ----------
    path : path
        ``.npy`` or ``.npy.xz``. Its header is read at once, its points on first use.
    offsets : (n + 1,) int64
    step : float
        Metres of one unit.
    """

    def __init__(self, path: Path, offsets: npt.NDArray[np.int64], step: float) -> None:
        self._path, self._step, self._offsets = path, step, offsets
        self._points: npt.NDArray[np.int16] | None = None
        self._lock = threading.Lock()
        shape, _, dtype, _ = self._header(read_bytes(path, first=npy_begin(read_bytes(path, first=12))))
        if len(shape) != 2 or shape[0] != 3 or dtype != np.int16:
            raise FormatError(
                "points are no planar int16", where=str(path), got=f"{dtype} {shape}", wanted="int16 (3, q)"
            )
        check_offsets(offsets, shape[1], where=str(path.with_name(OFFSETS)))

    @property
    def counts(self) -> npt.NDArray[np.int64]:
        """Columns of every scan ``(n,)``."""
        return np.diff(self._offsets)

    @property
    def decoded(self) -> bool:
        """Are the points in memory?"""
        return self._points is not None

    def cloud(self, k: int) -> Array:
        """Points ``(m, 3)`` of scan k [m], missing returns left out."""
        with self._lock:
            if self._points is None:
                self._points = self._read()
        units = self._points[self._offsets[k] : self._offsets[k + 1]]
        return np.multiply(units[np.all(units != MISSING, axis=1)], self._step, dtype=np.float64)

    def ages(self, k: int) -> Array | None:
        """See :class:`~graphslam.core.point_clouds.CloudSource`: packs have none."""
        return None

    def packed(self) -> bytes:
        """See :class:`~graphslam.core.point_clouds.CloudSource`: the file as it is, and the metres of one unit."""
        return np.float64(self._step).tobytes() + self._path.read_bytes()

    def _read(self) -> npt.NDArray[Any]:
        """Points ``(q, 3)`` of the array."""
        data = read_bytes(self._path)
        shape, fortran, dtype, begin = self._header(data[:MOST_HEADER])
        if len(data) - begin != dtype.itemsize * shape[0] * shape[1]:
            raise FormatError(
                "points are truncated or corrupt", where=str(self._path), got=f"{len(data) - begin} bytes", wanted=shape
            )
        array = np.frombuffer(data, dtype, offset=begin).reshape(shape, order="F" if fortran else "C")
        return np.ascontiguousarray(array.T)

    def _header(self, data: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
        try:
            return npy_header(io.BytesIO(data), self._path.name)
        except ValueError as error:
            raise FormatError(f"points are truncated or corrupt ({error})", where=str(self._path)) from None


def read_lidar_pack(
    folder: str | os.PathLike[str],
    *,
    step: float | None = None,
    period: float | None = None,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    odometry_sigmas: tuple[float, float] = ODOMETRY_SIGMAS,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read a pack.

    Parameters
    ----------
    step : float
        Metres of one unit of the coordinates. The files do not say it; the card of a data set does.
    period : float, optional
        Seconds from scan to scan, where the pack has no stamps.
    origin : (3,)
        Where the beams begin, in the frame of the points [m]: the lever arm of a lidar whose points were recorded in
        the frame of another sensor.
    odometry_sigmas : (float, float)
        σ of one motion from scan to scan, per axis: metres, radians.
    name : str, optional
        Of the log; the folder's by default.
    drops : DropCounter, optional
        Counts into this one, besides ``SensorLog.dropped``.

    Returns
    -------
    SensorLog
        A scan whose stamp or pose is unusable is dropped and counted. Points that are missing returns are left out
        when a cloud is decoded; ``PointClouds.counts`` has them.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="the folder of a lidar pack")
    for what, values in (("step", [step]), ("period", [period]), ("odometry_sigmas", odometry_sigmas)):
        if any(v is not None and not (np.isfinite(v) and v > 0) for v in values):
            raise ConfigError(f"lidar pack: {what} is {values}; wanted positive numbers")
    if step is None:
        raise ConfigError(f"lidar pack {root}: its files do not say the step of their coordinates; give step=… metres")
    offsets = _read_offsets(root / OFFSETS)
    source = PackedClouds(_points_file(root), offsets, step)
    n = len(offsets) - 1
    matrices, stamps, pose_file = _read_poses(root, n)
    optimized = _optional(root, "optimized_poses.txt")
    reference = None if optimized is None else _rows(optimized, n)
    times, stamped_by = _stamps(root, stamps, n, period)

    counter = DropCounter()
    bad = {}
    for what, m in (("pose", matrices), ("reference pose", reference)):
        if m is not None:
            bad[f"{what} is not finite"] = np.asarray(~np.isfinite(m).all(axis=(1, 2)))
            bad[f"{what} is no rotation"] = _no_rotation(m)
    keep = np.flatnonzero(usable_records(times, bad, stream="clouds", where=str(root), drops=counter))
    if drops is not None:
        drops.counts.update(counter.counts)

    streams: dict[str, Stream] = {
        "clouds": PointClouds(times=times[keep], source=source, index=keep, origin=np.array(origin, dtype=np.float64))
    }
    origin_of = "none"
    if matrices is not None:
        poses = _poses(matrices[keep])
        streams["odometry"] = _odometry(times[keep], poses, odometry_sigmas)
        origin_of = f"{pose_file}: the poses the odometry was made of; not independent"
        if reference is not None:
            poses, origin_of = (
                _poses(reference[keep]),
                "optimized_poses.txt: a pose graph over the odometry; not independent",
            )
        streams["reference"] = Trajectory(times[keep], poses)
    elif reference is not None:
        streams["reference"] = Trajectory(times[keep], _poses(reference[keep]))
        origin_of = "optimized_poses.txt"
    return SensorLog(
        name=name or root.name,
        streams=streams,
        read=dict.fromkeys(streams, n),
        dropped=dict(counter.counts),
        meta={
            "source": root.name,
            "step": step,
            "stamps": stamped_by,
            "reference": origin_of,
            **({"odometry_sigmas": list(odometry_sigmas)} if matrices is not None else {}),
        },
    )


def _points_file(root: Path) -> Path:
    path = next((p for p in (root / POINTS, root / f"{POINTS}.xz") if p.is_file()), None)
    if path is None:
        raise MissingDataError("no such file", where=str(root / POINTS), wanted=f"{POINTS}, plain or with .xz")
    return path


def _read_offsets(path: Path) -> npt.NDArray[np.int64]:
    data = read_bytes(path)
    try:
        raw = read_npy(io.BytesIO(data), len(data), path.name)
    except (ValueError, EOFError) as error:
        raise FormatError(f"offsets are truncated or corrupt ({error})", where=str(path)) from None
    last = int(raw[-1]) if raw.ndim == 1 and len(raw) and raw.dtype.kind in "iu" else 0
    offsets = check_offsets(raw, last, where=str(path))
    if len(offsets) < 2:
        raise DataError("holds no scan", where=str(path), wanted="at least one")
    return offsets


def _optional(root: Path, name: str) -> Path | None:
    try:
        return find_text_file(root, name)
    except MissingDataError:
        return None


def _read_poses(root: Path, n: int) -> tuple[Array | None, Array | None, str]:
    """Matrices ``(n, 3, 4)`` and stamps ``(n,)``, whichever there are, and the name of their file."""
    rows = _optional(root, "odom_poses.txt")
    if rows is not None:
        return _rows(rows, n), None, "odom_poses.txt"
    blocks = _optional(root, "alidarPose.csv")
    if blocks is None:
        return None, None, "none"
    table, lines = read_table(blocks, 4, separator=",")
    if len(table) != 4 * n:
        raise DataError("poses and scans differ in number", where=str(blocks), got=len(table), wanted=f"{4 * n} rows")
    table = table.reshape(n, 4, 4)
    odd = np.flatnonzero(np.any(table[:, 3, :3] != 0.0, axis=1))
    if len(odd):
        where = f"{blocks}, line {lines[4 * odd[0] + 3]}"
        raise FormatError(
            "fourth row of a pose is no stamp", where=where, got=table[odd[0], 3], wanted="0, 0, 0, stamp"
        )
    return table[:, :3], table[:, 3, 3], "alidarPose.csv"


def _rows(path: Path, n: int) -> Array:
    table, _ = read_table(path, 12)
    if len(table) != n:
        raise DataError("poses and scans differ in number", where=str(path), got=len(table), wanted=f"{n} rows")
    return table.reshape(n, 3, 4)


def _stamps(root: Path, given: Array | None, n: int, period: float | None) -> tuple[Array, str]:
    path = _optional(root, "times.txt")
    if path is not None:
        times = read_table(path, 1)[0][:, 0]
        if len(times) != n:
            raise DataError("stamps and scans differ in number", where=str(path), got=len(times), wanted=n)
        return times, "times.txt"
    if given is not None:
        return given, "with the poses"
    if period is None:
        raise ConfigError(f"lidar pack {root}: it has no stamps; give period=… seconds from scan to scan")
    return period * np.arange(n, dtype=np.float64), f"nominal, {period:g} s from scan to scan"


def _no_rotation(matrices: Array) -> npt.NDArray[np.bool_]:
    """Which of ``(n, 3, 4)`` are finite but not ``[R | t]``."""
    R = np.nan_to_num(matrices[:, :, :3], posinf=0.0, neginf=0.0)
    error = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    wrong = (error > _NOT_A_ROTATION) | (np.linalg.det(R) < 0)
    return np.asarray(wrong & np.isfinite(matrices).all(axis=(1, 2)))


def _poses(matrices: Array) -> Array:
    """``(n, 3, 4)`` to ``(n, 7)``."""
    return np.column_stack([matrices[:, :, 3], se3.matrix_to_quat(matrices[:, :, :3])])


def _odometry(times: Array, poses: Array, sigmas: tuple[float, float]) -> Odometry:
    steps = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(poses), 1))
    steps[1:] = se3.se3_between(poses[:-1], poses[1:])
    metres, radians = sigmas
    variance = np.diag(np.repeat([radians**2, metres**2], 3))  # rotation first
    return Odometry(times=times, increments=steps, covariances=np.tile(variance, (len(poses), 1, 1)))
