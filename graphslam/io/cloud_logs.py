"""Reader of folders of 3-D lidar scans, one file per scan, with or without poses.

The log has the stream ``clouds`` and, if there are poses, ``odometry`` and ``reference``. Without stamps, scans are
``period`` apart. Clouds are decoded on access.

The unit of point times (fields ``t``, ``time``, ``timestamp``, ``offset_time``, ``gps_time``) is chosen such that the
duration of a scan fits the time between scans (:mod:`graphslam.io.point_times`).
"""

from __future__ import annotations

import hashlib
import os
import re
import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, FormatError, GraphSlamError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.imu import ImuNoise
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import usable_records
from graphslam.io.cloud_files import BIN_COLUMNS, bin_columns, count_points, read_cloud
from graphslam.io.odometry_noise import constant_noise
from graphslam.io.point_times import PointClock, PointTimes, choose_point_times
from graphslam.io.recognise import (
    CLOUD_ENDINGS,
    cloud_folder,
    first_rows,
    is_kitti_poses,
    is_stamped_matrices,
    parse_numbers,
    pose_file,
)
from graphslam.io.source_probe import SourceProbe, file_ending
from graphslam.io.text_records import read_table

Index = npt.NDArray[np.intp]
PERIOD = 0.1
"""Default time between scans [s]: most lidars rotate at 10 Hz."""
NO_STAMPS = "no stamps"
ODOMETRY_SIGMAS = (0.03, 0.005)
"""Assumed σ of one motion between scans, per axis [m, rad]; tables of poses contain none."""
IMU_NOISE = ImuNoise(
    gyro=2e-3, gyro_bias=0.02, gyro_walk=1e-4, accelerometer=2e-2, accelerometer_bias=0.2, accelerometer_walk=1e-3
)
"""Default noise of an IMU without noise in its log: a mid-range MEMS unit."""
MOST_DECODED = 100
"""Maximal number of clouds that are decoded when a folder is opened, evenly spaced."""
LEAST_COLUMNS = 7
"""A table next to the clouds with at least this many columns may contain a path or sensor data."""
CUT_SCAN = "scan is cut: less than a quarter of the usual points, at an end of the log"
CUT = 0.25
"""Scans at the begin and the end of a log with less than this fraction of the median number of points are cut."""
COMPRESSED = (".laz", ".pcd")
"""Formats whose file size does not determine the number of points."""
LOOKED_AT = 5
"""Number of evenly spaced files from which the number of BIN columns and the unit of point times are estimated."""
_KEPT = 8  # decoded clouds in the cache


class FileClouds:
    """Clouds in files; see :class:`~graphslam.core.point_clouds.CloudSource`.

    Parameters
    ----------
    columns : int
        Number of columns of BIN files.
    stamps : (n,)
        Stamps of the scans [s], for points with stamps on the same clock.
    clock : PointClock or None
        Unit of the point times; None: they are not used.
    """

    def __init__(self, paths: list[Path], columns: int, stamps: Array, clock: PointClock | None) -> None:
        self._paths, self._columns, self._stamps, self._clock = paths, columns, stamps, clock
        self._cache: OrderedDict[int, tuple[Array, Array | None]] = OrderedDict()
        self._lock = threading.Lock()
        self.counts = np.array([max(p.stat().st_size // 12, 0) for p in paths], dtype=np.int64)
        """Upper limit of the number of points of each scan ``(n,)``, from the file size."""

    def _get(self, k: int) -> tuple[Array, Array | None]:
        with self._lock:
            if k not in self._cache:
                c = read_cloud(self._paths[k], columns=self._columns)
                ages = None if self._clock is None else self._clock.ages(c.times, float(self._stamps[k]))
                self._cache[k] = c.points, ages
                while len(self._cache) > _KEPT:
                    self._cache.popitem(last=False)
            return self._cache[k]

    def cloud(self, k: int) -> Array:
        """See :class:`~graphslam.core.point_clouds.CloudSource`."""
        return self._get(k)[0]

    def ages(self, k: int) -> Array | None:
        """See :class:`~graphslam.core.point_clouds.CloudSource`."""
        return self._get(k)[1]

    def packed(self) -> bytes:
        """See :class:`~graphslam.core.point_clouds.CloudSource`: digests of the files."""
        return b"".join(hashlib.blake2b(p.read_bytes(), digest_size=16).digest() for p in self._paths)


def read_clouds(
    path: str | os.PathLike[str],
    *,
    period: float | None = None,
    columns: int | None = None,
    poses: str | None = None,
    point_times: bool = True,
    odometry_sigmas: tuple[float, float] = ODOMETRY_SIGMAS,
) -> SensorLog:
    """Read a folder of clouds, one file per scan, in the order of stamps or numbers in the file names.

    Parameters
    ----------
    period : float, optional
        Time between scans [s]; default: stamps from ``times.txt``, from the poses, or from the file names; otherwise
        0.1 s.
    columns : int, optional
        Number of float32 columns of BIN files; default: estimated from their content.
    poses : str, optional
        Name of the table of poses (TUM or KITTI rows) in the folder, ``none``: no poses; default: the table that is
        found.
    point_times : bool
        Use the times of points, if files have them.
    odometry_sigmas : (float, float)
        σ of one motion from scan to scan, per axis [m, rad].
    """
    root = Path(path)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="a folder of clouds, one file a scan")
    look = SourceProbe(root)
    files, _ = cloud_folder(look)
    note = ""
    if columns is None:
        bins = [p for p in files if p.name.lower().endswith(".bin")]
        columns = (
            bin_columns([bins[k] for k in np.unique(np.linspace(0, len(bins) - 1, LOOKED_AT).round().astype(int))])
            if bins
            else BIN_COLUMNS
        )
        if bins and columns != BIN_COLUMNS:
            note = f"BIN of {columns} columns, by their content (--reader-option columns=)"
    table: Path | None = None
    if poses is None:
        table = pose_file(look)
    elif poses != "none":
        table = root / poses
    folder = CloudFolder(look, in_order(files), columns, point_times)
    counter = DropCounter()
    beside = None if table is None else PoseTable.read(look, table, counter)
    log = folder.log(beside, scan_stamps(folder, beside, period), odometry_sigmas, {}, counter)
    return replace(log, meta={**log.meta, "notes": [note, *log.meta["notes"]]}) if note else log


@dataclass(frozen=True, slots=True)
class PoseTable:
    """A table of poses for clouds: one pose per cloud (KITTI), or a trajectory with stamps (TUM).

    Parameters
    ----------
    matrices : (n, 3, 4) or None
    path : Trajectory or None
    T_camera_lidar : (7,) or None
        Pose of the lidar in the camera frame, if the poses are those of a camera.
    """

    file: Path
    matrices: Array | None
    path: Trajectory | None
    T_camera_lidar: Array | None = None

    @classmethod
    def read(
        cls, look: SourceProbe, file: Path, counter: DropCounter, T_camera_lidar: Array | None = None
    ) -> PoseTable:
        if is_kitti_poses(look, file):
            return cls(file, read_table(file, 12)[0].reshape(-1, 3, 4), None, T_camera_lidar)
        if is_stamped_matrices(look, file):
            return cls(file, None, _stamped_matrices(file, counter))
        return cls(file, None, _tum(file, counter))

    def missing(self, n: int) -> dict[str, npt.NDArray[np.bool_]]:
        """Masks of the ``n`` clouds without a pose, by reason."""
        if self.matrices is None:
            return {}
        if len(self.matrices) != n:
            raise DataError(
                "poses and clouds differ in number", where=str(self.file),
                got=f"{len(self.matrices)} poses, {n} clouds", wanted="one pose a cloud, or option poses=none",
            )  # fmt: skip
        return {"pose is not finite": ~np.asarray(finite_mask(self.matrices).all(axis=(1, 2)))}

    def within(self, stamps: Array, keep: Index, counter: DropCounter) -> Index:
        """Those of the clouds ``keep`` within the time span of the poses."""
        if self.path is None:
            return keep
        t = self.path.times
        slack = 0.5 * float(np.median(np.diff(t)))
        inside = (stamps[keep] >= t[0] - slack) & (stamps[keep] <= t[-1] + slack)
        if inside.sum() < 2:
            raise DataError(
                "poses and clouds have no time in common", where=str(self.file),
                wanted="one clock, or option poses=none",
                got=f"poses {t[0]:.3f} to {t[-1]:.3f} s, clouds {stamps[0]:.3f} to {stamps[-1]:.3f} s",
            )  # fmt: skip
        counter.drop("clouds", "outside the time of the poses", int((~inside).sum()))
        return keep[inside]

    def at(self, times: Array, keep: Index) -> Array:
        """Poses ``(k, 7)`` of the clouds ``keep``."""
        if self.path is not None:
            return embed_poses(self.path.interpolate(np.clip(times, self.path.times[0], self.path.times[-1])))
        assert self.matrices is not None
        M = self.matrices[keep]
        T = np.column_stack([M[:, :, 3], se3.matrix_to_quat(M[:, :, :3])])
        if self.T_camera_lidar is not None:
            T = se3.se3_compose(T, np.broadcast_to(self.T_camera_lidar, T.shape))
        return T


@dataclass(frozen=True, slots=True)
class CloudFolder:
    """Ordered files of clouds with their reading options."""

    look: SourceProbe
    files: list[Path]
    columns: int
    point_times: bool

    def __post_init__(self) -> None:
        if len(self.files) < 2:
            raise MissingDataError(
                "fewer than two clouds", where=str(self.look.path), got=str(self.look),
                wanted="a folder with one file a scan",
            )  # fmt: skip

    def log(
        self,
        poses: PoseTable | None,
        stamped: tuple[Array, str],
        sigmas: tuple[float, float],
        extra: dict[str, Stream],
        counter: DropCounter,
    ) -> SensorLog:
        """The log of the clouds; ``stamped``: stamps ``(n,)`` [s] and their origin; ``extra``: further streams."""
        noise = constant_noise(sigmas)
        root, n, (stamps, by) = self.look.path, len(self.files), stamped
        by_log = not by.startswith(NO_STAMPS)
        good, empty = _good_files(self.files, self.columns, counter)
        bad = {"file is damaged": ~good, "no point in it": empty, **({} if poses is None else poses.missing(n))}
        sizes = np.array([p.stat().st_size for p in self.files], dtype=np.int64)
        cut = cut_scans(sizes) & (file_ending(self.files[0]) not in COMPRESSED)
        counter.drop("clouds", CUT_SCAN, int(cut.sum()))
        whole = np.flatnonzero(~cut)
        bad = {reason: mask[whole] for reason, mask in bad.items()}
        keep = whole[usable_records(stamps[whole], bad, stream="clouds", where=str(root), drops=counter)]
        if poses is not None:
            keep = poses.within(stamps, keep, counter)
        times = np.ascontiguousarray(stamps[keep])
        kept = [self.files[k] for k in keep]
        timed = self._point_times(kept, times if by_log else None)
        source = FileClouds(kept, self.columns, times, timed.clock)
        streams: dict[str, Stream] = {"clouds": PointClouds(times=times, source=source)}
        notes = [by, "no poses" if poses is None else f"odometry from {self.look.relative(poses.file)}"]
        if poses is not None:
            T = poses.at(times, keep)
            streams |= {"odometry": noise.odometry(times, T), "reference": Trajectory(times, T)}
        streams |= extra
        notes.append(timed.note)
        read = {k: len(s.times) for k, s in streams.items() if k != "reference"} | {"clouds": n}
        assumed = [] if poses is None else [_assumed_noise(self.look.relative(poses.file), sigmas)]
        assumed += [*timed.assumed(), *self._not_read(poses)]
        meta = {"source": root.name, "notes": notes, "point_times": timed.state, "assumed": assumed}
        return SensorLog(name=root.name, streams=streams, read=read, dropped=dict(counter.counts), meta=meta)

    def _not_read(self, poses: PoseTable | None) -> list[tuple[str, str]]:
        """Notes on tables next to the clouds that may be a path or sensor data and are not read."""
        folders = {self.look.path, self.files[0].parent, self.files[0].parent.parent}
        known = ("times.txt", "timestamps.txt", "calib.txt")
        out = []
        for p in self.look.texts:
            if p.parent not in folders or p.name in known or (poses is not None and p == poses.file):
                continue
            rows = first_rows(self.look, p)
            if len(rows) > 2 and min(map(len, rows)) >= LEAST_COLUMNS and file_ending(p) not in CLOUD_ENDINGS:
                text = f"{self.look.relative(p)} is not read: a table of {len(rows[0])} columns, of no known kind."
                out.append(("look", text))
        return out

    def _point_times(self, files: list[Path], stamps: Array | None) -> PointTimes:
        """Unit of the point times, from some evenly spaced clouds; see :func:`choose_point_times`."""
        if not self.point_times:
            return PointTimes("none", "times of points are not used (option point_times)")
        some = np.unique(np.linspace(0, len(files) - 1, LOOKED_AT).round().astype(int))
        read = (read_cloud(files[k], columns=self.columns).times for k in some)
        return choose_point_times([float(np.ptp(t)) for t in read if t is not None and len(t) > 1], stamps)


def scan_stamps(folder: CloudFolder, poses: PoseTable | None, period: float | None = None) -> tuple[Array, str]:
    """Stamps of the scans ``(n,)`` [s], and their origin as text."""
    if period is not None and not (np.isfinite(period) and period > 0):
        raise ConfigError(f"clouds: period is {period}; wanted a positive number")
    n, path = len(folder.files), None if poses is None else poses.path
    if period is None:
        beside = folder.look.named("times.txt", "timestamps.txt")
        if beside is not None and (t := stamps_of_file(beside, n)) is not None:
            return t, f"stamps of {beside.name}"
        if path is not None and len(path) == n:
            return path.times, "stamps of the poses"
        if (t := _stamps_in_names(folder.files)) is not None:
            return t, "stamps in the names"
    if poses is not None and path is not None:
        raise DataError(
            "poses and clouds cannot be put together", where=str(poses.file),
            got=f"{len(path)} poses, {n} clouds without stamps",
            wanted="one pose a cloud, stamps in times.txt or in the names, or option poses=none",
        )  # fmt: skip
    every = period or PERIOD
    return np.asarray(every * np.arange(n, dtype=np.float64)), f"{NO_STAMPS}: scans {every:g} s apart"


def embed_poses(poses: Array) -> Array:
    """Poses ``(n, 3)`` as ``(n, 7)``; poses ``(n, 7)`` are returned unchanged."""
    if poses.shape[1] == 7:
        return poses
    out = np.zeros((len(poses), 7))
    out[:, :2], out[:, 5], out[:, 6] = poses[:, :2], np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)
    return out


def number_in_name(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key with numeric order: cloud_10 is after cloud_9."""
    words = re.split(r"(\d+)", path.name)
    return [(1, int(w), "") if w.isdigit() else (0, 0, w) for w in words], str(path)


def in_order(files: list[Path]) -> list[Path]:
    """Files sorted by the stamps in their names, or else by the numbers in them."""
    files = sorted(files, key=number_in_name)
    t = _stamps_in_names(files)
    return files if t is None else [files[k] for k in np.argsort(t, kind="stable")]


def _stamps_in_names(files: list[Path]) -> Array | None:
    """Stamps [s] in file names: seconds with a fraction, or unix time in ms, µs or ns (13, 16 or 19 digits); or None.

    A name without a decimal point among names with one is a whole second: some programs omit ``.0``.
    """
    found = [re.findall(r"\d+\.\d+|\d+", p.name[: -len(file_ending(p))]) for p in files]
    if any(not f for f in found):
        return None
    words = [max(f, key=len) for f in found]
    fractions = sum("." in w for w in words)
    if fractions == len(words) or (fractions > 0.5 * len(words) and all(len(f) == 1 for f in found)):
        factor = 1.0
    elif all(len(w) in (13, 16, 19) and len(w) == len(words[0]) for w in words):
        factor = {13: 1e-3, 16: 1e-6, 19: 1e-9}[len(words[0])]
    else:
        return None
    t = np.array([float(w) for w in words]) * factor
    return t if len(np.unique(t)) == len(t) else None


def _assumed_noise(table: str, sigmas: tuple[float, float]) -> tuple[str, str]:
    text = (
        f"odometry: poses of {table}, which states no noise; σ of {sigmas[0]:g} m and {sigmas[1]:g} rad a scan assumed."
    )
    return "", text


def cut_scans(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Mask ``(n,)`` of incomplete scans at the begin and the end of a log: recordings start and stop within a sweep."""
    few = counts < CUT * float(np.median(counts))
    inner = np.flatnonzero(~few)
    return few & ((np.arange(len(counts)) < inner[0]) | (np.arange(len(counts)) > inner[-1])) if len(inner) else few


def stamps_of_file(path: Path, n: int) -> Array | None:
    """Stamps of ``times.txt`` (seconds) or ``timestamps.txt`` (seconds, or date and time as in KITTI raw)."""
    out = []
    for line in read_text(path).splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        v = parse_numbers(line)
        if v is None:
            date = re.fullmatch(r"(\d{4}-\d\d-\d\d)[ T](\d\d):(\d\d):(\d\d(?:\.\d+)?)", line.strip())
            if date is None:
                raise FormatError("no stamp", where=str(path), got=line[:60], wanted="seconds, or date and time")
            try:
                day = float(np.datetime64(date[1]).astype("datetime64[s]").astype(np.int64))
            except ValueError:
                raise FormatError("no stamp", where=str(path), got=line[:60], wanted="date and time") from None
            out.append(day + 3600 * int(date[2]) + 60 * int(date[3]) + float(date[4]))
        else:
            out.append(v[-1] if len(v) <= 2 else v[0])
    if len(out) != n:
        raise DataError("stamps and clouds differ in number", where=str(path), got=len(out), wanted=n)
    return _seconds(np.array(out))


def _seconds(stamps: Array) -> Array:
    """Stamps in seconds, from seconds or from unix time in nanoseconds."""
    return stamps * 1e-9 if len(stamps) and np.nanmedian(np.abs(stamps)) > 1e17 else stamps


def _tum(path: Path, counter: DropCounter) -> Trajectory:
    """A TUM table, also with commas; unusable rows are dropped and counted."""
    rows = []
    for line in read_text(path).splitlines():
        v = parse_numbers(line) if line.strip() and not line.lstrip().startswith(("#", "%")) else None
        if v is not None:
            rows.append(v[:8] if len(v) in (8, 9) else [np.nan] * 8)
    a = np.array(rows).reshape(-1, 8)
    norm = np.linalg.norm(np.where(finite_mask(a[:, 4:]), a[:, 4:], 0.0), axis=1)
    bad = {
        "row is not 8 or 9 finite numbers": np.asarray(~finite_mask(a[:, 1:]).all(axis=1)),
        "rotation is no unit quaternion": np.abs(norm - 1.0) > 0.05,
    }
    keep = usable_records(a[:, 0], bad, stream="poses", where=str(path), drops=counter)
    if keep.sum() < 2:
        raise DataError("holds too few poses", where=str(path), got=int(keep.sum()), wanted="2 or more")
    a = a[keep]
    return Trajectory(a[:, 0], np.column_stack([a[:, 1:4], se3.quat_normalize(a[:, 4:])]))


def _stamped_matrices(path: Path, counter: DropCounter) -> Trajectory:
    """A table of stamps [s or ns] and 3×4 matrices."""
    rows = [v for line in read_text(path).splitlines() if (v := parse_numbers(line)) is not None and v]
    a = np.array([v if len(v) == 13 else [np.nan] * 13 for v in rows])
    times = _seconds(a[:, 0])
    if np.all(times == np.round(times)) and np.nanmax(times) < 1e7:
        raise DataError(
            "poses are given by the numbers of scans, not by stamps", where=str(path), got=f"first {times[0]:.0f}",
            wanted="a table with stamps [s] in the first column, or one row a scan; or option poses=none",
        )  # fmt: skip
    bad = {"row is not 13 finite numbers": np.asarray(~finite_mask(a).all(axis=1))}
    keep = usable_records(times, bad, stream="poses", where=str(path), drops=counter)
    M = a[keep, 1:].reshape(-1, 3, 4)
    return Trajectory(times[keep], np.column_stack([M[:, :, 3], se3.matrix_to_quat(M[:, :, :3])]))


def _good_files(
    files: list[Path], columns: int, counter: DropCounter
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Masks of readable files and of empty ones; dropped points are counted.

    All headers are read, but at most :data:`MOST_DECODED` files are decoded, so that a long drive is checked in
    seconds.
    """
    good, empty = np.ones(len(files), np.bool_), np.zeros(len(files), np.bool_)
    decoded = {int(k) for k in np.linspace(0, len(files) - 1, min(len(files), MOST_DECODED)).round()}
    lost = zero = 0
    first: GraphSlamError | None = None
    for k, p in enumerate(files):
        try:
            if k not in decoded:
                empty[k] = count_points(p, columns=columns) == 0
                continue
            c = read_cloud(p, columns=columns)
        except MissingDataError:
            raise
        except GraphSlamError as error:
            good[k], first = False, first or error
            continue
        lost, zero = lost + c.not_finite, zero + c.at_origin
        empty[k] = len(c.points) == 0
    if first is not None and good.mean() < 0.95:
        raise FormatError(
            f"{int((~good).sum())} of {len(files)} clouds are damaged, first: {first}", wanted="at most 5 %"
        )
    if empty.all():
        raise DataError("all clouds are empty", where=str(files[0].parent), got=f"{lost} points not finite")
    some = "" if len(decoded) == len(files) else f", in {len(decoded)} clouds that were looked at"
    counter.drop("clouds", f"point not finite{some}", lost)
    counter.drop("clouds", f"point at the origin (no return){some}", zero)
    return good, empty
