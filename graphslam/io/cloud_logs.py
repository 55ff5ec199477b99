"""Logs of 3-D lidar scans, one file each: folders of clouds with or without poses, and the layouts of KITTI.

The log has the stream ``clouds``; ``odometry`` where there are poses (they are then also ``reference``); and ``imu``
and ``gps`` of KITTI raw. Without stamps scans are ``period`` apart. Clouds are decoded when they are asked for.

Times of points (fields ``t``, ``time``, ``timestamp``, ``offset_time``, ``gps_time``) are taken in the unit that makes
a scan last between 5 ms and 2 s, and for offsets from the stamp of the scan, or stamps on its clock.
"""

from __future__ import annotations

import hashlib
import os
import re
import threading
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, FormatError, GraphSlamError, MissingDataError
from graphslam.core.geodesy import geodetic_to_ecef
from graphslam.core.geometry import Array
from graphslam.core.gnss import TangentPlane
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import Gps, Odometry, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import usable_records
from graphslam.io.cloud_files import BIN_COLUMNS, CloudData, bin_columns, count_points, read_cloud
from graphslam.io.recognise import cloud_folder, is_kitti_poses, parse_numbers, pose_file
from graphslam.io.source_probe import SourceProbe, file_ending
from graphslam.io.text_records import read_table

PERIOD = 0.1
"""Seconds from scan to scan where nothing says it: lidars turn ten times a second."""
ODOMETRY_SIGMAS = (0.03, 0.005)
"""Stated σ of one motion between scans, per axis: metres, radians. Tables of poses state none."""
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
_SWEEP = (0.005, 2.0)  # how long a scan lasts [s]
_TIMED = {"none": "points without times", "constant": "times of points say nothing: as good as one time for all"}
MOST_DECODED = 100
"""Clouds that are decoded when a folder is opened, evenly over it."""
LOOKED_AT = 5
"""BIN files, evenly over a folder, by whose content the number of their columns is told."""
_KEPT = 8  # decoded clouds that are kept


class FileClouds:
    """Clouds in files; see :class:`~graphslam.core.point_clouds.CloudSource`.

    Parameters
    ----------
    columns : int
        Of BIN files.
    scale : float
        Factor on coordinates.
    stamps : (n,)
        Of the scans [s], for points that have stamps on the same clock.
    point_times : bool
        Are times of points used?
    """

    def __init__(self, paths: list[Path], columns: int, stamps: Array, point_times: bool) -> None:
        self._paths, self._columns, self._stamps, self._timed = paths, columns, stamps, point_times
        self._cache: OrderedDict[int, tuple[Array, Array | None]] = OrderedDict()
        self._lock = threading.Lock()
        self.counts = np.array([max(p.stat().st_size // 12, 0) for p in paths], dtype=np.int64)
        """Points of every scan ``(n,)``, at most: known from the size of a file, without decoding it."""

    def _get(self, k: int) -> tuple[Array, Array | None]:
        with self._lock:
            if k not in self._cache:
                c = read_cloud(self._paths[k], columns=self._columns)
                ages = ages_of(c, float(self._stamps[k])) if self._timed else None
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


def ages_of(cloud: CloudData, stamp: float) -> Array | None:
    """Time from each point to the stamp of the scan ``(m,)`` [s]; None where they say nothing.

    Times on the clock of the stamps are taken as they are, others as offsets from the stamp.
    """
    t = cloud.times
    if t is None or len(t) < 2:
        return None
    span = float(np.ptp(t))
    unit = next((u for u in _UNITS if _SWEEP[0] <= span * u <= _SWEEP[1]), None)
    if unit is None:
        return None
    seconds = t * unit
    if abs(float(np.median(seconds)) - stamp) <= 5.0 and abs(stamp) > 5.0:
        return np.asarray(stamp - seconds)
    offset = seconds if float(np.abs(seconds).min()) <= _SWEEP[1] else seconds - seconds.min()
    return np.asarray(-offset)


def read_clouds(
    path: str | os.PathLike[str],
    *,
    period: float | None = None,
    columns: int | None = None,
    poses: str | None = None,
    point_times: bool = True,
    odometry_sigmas: tuple[float, float] = ODOMETRY_SIGMAS,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read a folder of clouds, one file a scan, in the order of the numbers in their names.

    Parameters
    ----------
    period : float, optional
        Seconds from scan to scan; by default stamps come from ``times.txt``, from the poses, from names that are
        stamps, or else scans are 0.1 s apart.
    columns : int, optional
        Of float32 in BIN files; by default told by their content.
    poses : str, optional
        Name of the table of poses (TUM or KITTI rows) in the folder, ``none`` for none; by default the one that is
        there.
    point_times : bool
        Use times of points, where files have them.
    odometry_sigmas : (float, float)
        σ of one motion from scan to scan, per axis: metres, radians.
    """
    root = Path(path)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="a folder of clouds, one file a scan")
    look = SourceProbe(root)
    files, _ = cloud_folder(look)
    told = ""
    if columns is None:
        bins = [p for p in files if p.name.lower().endswith(".bin")]
        columns = (
            bin_columns([bins[k] for k in np.unique(np.linspace(0, len(bins) - 1, LOOKED_AT).round().astype(int))])
            if bins
            else BIN_COLUMNS
        )
        if bins and columns != BIN_COLUMNS:
            told = f"BIN of {columns} columns, by their content (--reader-option columns=)"
    table: Path | None = None
    if poses is None:
        table = pose_file(look)
    elif poses != "none":
        table = root / poses
    log = _cloud_log(
        root, look, files, table, None, period, columns, point_times, odometry_sigmas, name, drops, {}, DropCounter()
    )
    return replace(log, meta={**log.meta, "notes": [told, *log.meta["notes"]]}) if told else log


def _cloud_log(
    root: Path,
    look: SourceProbe,
    files: list[Path],
    table: Path | None,
    stamps: Array | None,
    period: float | None,
    columns: int,
    point_times: bool,
    sigmas: tuple[float, float],
    name: str | None,
    drops: DropCounter | None,
    extra: dict[str, Stream],
    counter: DropCounter,
    calibration: Array | None = None,
) -> SensorLog:
    for what, values in (("period", [period]), ("odometry_sigmas", sigmas)):
        if any(v is not None and not (np.isfinite(v) and v > 0) for v in values):
            raise ConfigError(f"clouds: {what} is {values}; wanted positive numbers")
    files = sorted(files, key=_number_in_name)
    if len(files) < 2:
        raise MissingDataError(
            "fewer than two clouds", where=str(root), got=str(look), wanted="a folder with one file a scan"
        )
    notes = []
    path_poses: Trajectory | None = None
    matrices: Array | None = None
    if table is not None:
        if is_kitti_poses(look, table):
            matrices = _kitti_poses(table)
        else:
            path_poses = _tum(table, counter)
    beside = look.named("times.txt", "timestamps.txt")
    n = len(files)
    if stamps is None and period is None and beside is not None and (t := _times(beside, n)) is not None:
        stamps, by = t, f"stamps of {beside.name}"
    elif stamps is not None:
        by = "stamps of the files"
    elif period is None and path_poses is not None and len(path_poses) == n:
        stamps, by = path_poses.times, "stamps of the poses"
    elif period is None and (t := _stamps_in_names(files)) is not None:
        stamps, by = t, "stamps in the names"
    else:
        stamps = np.asarray((period or PERIOD) * np.arange(n, dtype=np.float64))
        by = f"no stamps: scans {period or PERIOD:g} s apart"
        if path_poses is not None:
            raise DataError(
                "poses and clouds cannot be put together",
                where=str(table),
                got=f"{len(path_poses)} poses, {n} clouds without stamps",
                wanted="one pose a cloud, stamps in times.txt or in the names, or option poses=none",
            )
    assert stamps is not None
    notes.append(by)
    good, empty = _good_files(files, columns, counter)
    bad: dict[str, npt.NDArray[np.bool_]] = {"file is damaged": ~good, "no point in it": empty}
    if matrices is not None:
        if len(matrices) != n:
            raise DataError(
                "poses and clouds differ in number",
                where=str(table),
                got=f"{len(matrices)} poses, {n} clouds",
                wanted="one pose a cloud, or option poses=none",
            )
        bad["pose is not finite"] = ~np.asarray(finite_mask(matrices).all(axis=(1, 2)))
    keep = np.flatnonzero(usable_records(stamps, bad, stream="clouds", where=str(root), drops=counter))
    if path_poses is not None:
        slack = 0.5 * float(np.median(np.diff(path_poses.times)))
        inside = (stamps[keep] >= path_poses.times[0] - slack) & (stamps[keep] <= path_poses.times[-1] + slack)
        if inside.sum() < 2:
            raise DataError(
                "poses and clouds have no time in common",
                where=str(table),
                got=f"poses {path_poses.times[0]:.3f} to {path_poses.times[-1]:.3f} s, clouds {stamps[0]:.3f} to "
                f"{stamps[-1]:.3f} s",
                wanted="one clock, or option poses=none",
            )
        counter.drop("clouds", "outside the time of the poses", int((~inside).sum()))
        keep = keep[inside]
    times = np.ascontiguousarray(stamps[keep])
    kept = [files[k] for k in keep]
    source = FileClouds(kept, columns, times, point_times)
    streams: dict[str, Stream] = {"clouds": PointClouds(times=times, source=source)}
    if matrices is not None or path_poses is not None:
        if matrices is not None:
            T = np.column_stack([matrices[keep][:, :, 3], se3.matrix_to_quat(matrices[keep][:, :, :3])])
            if calibration is not None:  # poses are those of the camera
                T = se3.se3_compose(T, np.broadcast_to(calibration, T.shape))
        else:
            assert path_poses is not None
            T = path_poses.interpolate(np.clip(times, path_poses.times[0], path_poses.times[-1]))
            T = embed_poses(T)
        streams["odometry"] = _odometry(times, T, sigmas)
        streams["reference"] = Trajectory(times, T)
        assert table is not None
        notes.append(f"odometry from {look.relative(table)}")
    else:
        notes.append("no poses")
    streams |= extra
    first = source.ages(0)
    timed = "used" if first is not None else "none"
    if first is None and point_times and read_cloud(kept[0], columns=columns).times is not None:
        timed = "constant"  # or in no unit that makes a scan last as long as scans do
    notes.append(_TIMED[timed] if first is None else f"points of a scan over {np.ptp(first):.3f} s")
    if drops is not None:
        drops.counts.update(counter.counts)
    read = {k: len(s.times) for k, s in streams.items() if k != "reference"} | {"clouds": n}
    meta = {"source": root.name, "notes": notes, "point_times": timed}
    return SensorLog(name=name or root.name, streams=streams, read=read, dropped=dict(counter.counts), meta=meta)


def embed_poses(poses: Array) -> Array:
    """Poses ``(n, 3)`` as ``(n, 7)``; those that are it already, as they are."""
    if poses.shape[1] == 7:
        return poses
    out = np.zeros((len(poses), 7))
    out[:, :2], out[:, 5], out[:, 6] = poses[:, :2], np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)
    return out


def _odometry(times: Array, poses: Array, sigmas: tuple[float, float]) -> Odometry:
    steps = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(poses), 1))
    steps[1:] = se3.se3_between(poses[:-1], poses[1:])
    variance = np.diag(np.repeat([sigmas[1] ** 2, sigmas[0] ** 2], 3))  # rotation first
    return Odometry(times=times, increments=steps, covariances=np.tile(variance, (len(poses), 1, 1)))


def _number_in_name(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Numbers count as numbers: cloud_10 is after cloud_9."""
    words = re.split(r"(\d+)", path.name)
    return [(1, int(w), "") if w.isdigit() else (0, 0, w) for w in words], str(path)


def _stamps_in_names(files: list[Path]) -> Array | None:
    """Stamps in names: seconds with a fraction, or so many digits that they are unix time in ms, µs or ns."""
    found = [re.findall(r"\d+\.\d+|\d+", p.name[: -len(file_ending(p))]) for p in files]
    if any(not f for f in found):
        return None
    words = [max(f, key=len) for f in found]
    if all("." in w for w in words):
        factor = 1.0
    elif all(len(w) in (13, 16, 19) and len(w) == len(words[0]) for w in words):
        factor = {13: 1e-3, 16: 1e-6, 19: 1e-9}[len(words[0])]
    else:
        return None
    t = np.array([float(w) for w in words]) * factor
    return t if np.all(np.diff(t) > 0) else None


def _times(path: Path, n: int) -> Array | None:
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
    t = np.array(out)
    return t * 1e-9 if n and np.nanmedian(np.abs(t)) > 1e17 else t


def _kitti_poses(path: Path) -> Array:
    return read_table(path, 12)[0].reshape(-1, 3, 4)


def _tum(path: Path, counter: DropCounter) -> Trajectory:
    """A TUM table, also with commas; rows that are not usable are dropped and counted."""
    rows = []
    for line in read_text(path).lstrip("\ufeff").splitlines():
        v = parse_numbers(line) if line.strip() and not line.lstrip().startswith(("#", "%")) else None
        if v is not None:
            rows.append(v if len(v) == 8 else [np.nan] * 8)
    a = np.array(rows).reshape(-1, 8)
    norm = np.linalg.norm(np.where(finite_mask(a[:, 4:]), a[:, 4:], 0.0), axis=1)
    bad = {
        "row is not 8 finite numbers": np.asarray(~finite_mask(a[:, 1:]).all(axis=1)),
        "rotation is no unit quaternion": np.abs(norm - 1.0) > 0.01,
    }
    keep = usable_records(a[:, 0], bad, stream="poses", where=str(path), drops=counter)
    if keep.sum() < 2:
        raise DataError("holds too few poses", where=str(path), got=int(keep.sum()), wanted="2 or more")
    a = a[keep]
    return Trajectory(a[:, 0], np.column_stack([a[:, 1:4], se3.quat_normalize(a[:, 4:])]))


def _good_files(
    files: list[Path], columns: int, counter: DropCounter
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Which files can be read, and which hold no point; points that were left out are counted.

    All headers are read; decoded are all files of a small folder, and some of a large one: a drive is looked at in
    seconds, and clouds are decoded when they are asked for.
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


def read_kitti(
    path: str | os.PathLike[str],
    *,
    poses: str | None = None,
    odometry_sigmas: tuple[float, float] = ODOMETRY_SIGMAS,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read a sequence of KITTI odometry, or a drive of KITTI raw.

    Parameters
    ----------
    path : path
        Holds ``velodyne/*.bin``, perhaps ``times.txt``, ``calib.txt`` and ``poses.txt``; or
        ``velodyne_points/data/*.bin`` and ``timestamps.txt``, perhaps ``oxts``.
    poses : str, optional
        Table of poses, seen from the folder; ``none``: none. Poses of the camera are brought to the lidar by ``Tr`` of
        ``calib.txt``.
    odometry_sigmas : (float, float)
        σ of one motion from scan to scan, per axis: metres, radians.
    """
    root = Path(path)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="a sequence or drive of KITTI")
    look = SourceProbe(root)
    files = [p for p in look.by_ending.get(".bin", []) if p.parent.name in ("velodyne", "data")]
    counter = DropCounter()
    stamps: Array | None = None
    extra: dict[str, Stream] = {}
    notes: list[str] = []
    if files and files[0].parent.name == "data":
        beside = files[0].parent.parent / "timestamps.txt"
        stamps = _times(beside, len(files)) if beside.is_file() else None
        extra = _oxts(root, look, counter)
    table: Path | None = None
    if poses is None:
        found = [p for p in look.texts if is_kitti_poses(look, p) and "calib" not in p.name]
        table = found[0] if found else None
    elif poses != "none":
        table = root / poses
    calibration = _calibration(look) if table is not None else None
    if table is not None and calibration is None:
        notes.append("poses taken as those of the lidar: no calib.txt with Tr")
    log = _cloud_log(
        root, look, files, table, stamps, None, 4, True, odometry_sigmas, name, drops, extra, counter, calibration
    )
    return replace(log, meta={**log.meta, "notes": [*log.meta["notes"], *notes]})


def _calibration(look: SourceProbe) -> Array | None:
    """``T_camera_lidar`` ``(7,)`` of the line ``Tr``."""
    path = look.named("calib.txt")
    row = next((s for s in look.lines(path) if s.startswith(("Tr:", "Tr ", "Tr_velo"))), None) if path else None
    v = parse_numbers(row.partition(":")[2] or row[2:]) if row else None
    if v is None or len(v) != 12 or not np.all(finite_mask(v)):
        return None
    m = np.array(v).reshape(3, 4)
    if np.abs(m[:, :3] @ m[:, :3].T - np.eye(3)).max() > 1e-2:
        return None
    return np.concatenate([m[:, 3], se3.matrix_to_quat(m[None, :, :3])[0]])


def _oxts(root: Path, look: SourceProbe, counter: DropCounter) -> dict[str, Stream]:
    """``gps`` and ``imu`` of the records of oxts: 30 numbers each, in files of their own."""
    files = [p for p in look.by_ending.get(".txt", []) if p.parent.name == "data" and p.parent.parent.name == "oxts"]
    files = sorted(files, key=_number_in_name)
    if len(files) < 2:
        return {}
    beside = files[0].parent.parent / "timestamps.txt"
    if not beside.is_file():
        counter.drop("oxts", "records without timestamps.txt", len(files))
        return {}
    times = _times(beside, len(files))
    assert times is not None
    rows = [parse_numbers(read_text(p)) or [] for p in files]
    a = np.array([r[:30] if len(r) >= 30 else [np.nan] * 30 for r in rows])
    place = finite_mask(a[:, :3]).all(axis=1) & (np.abs(a[:, 0]) <= 90) & (np.abs(a[:, 1]) <= 360)
    bad = {"record is not whole": np.asarray(~(place & finite_mask(a[:, 8:26]).all(axis=1)))}
    keep = usable_records(times, bad, stream="oxts", where=str(files[0].parent), drops=counter)
    a, t = a[keep], times[keep]
    plane = TangentPlane(*a[0, :3].tolist())
    enu = plane.from_ecef(geodetic_to_ecef(a[:, :3]))
    accuracy = np.clip(np.where(finite_mask(a[:, 23]), a[:, 23], 1.0), 0.05, 100.0)
    gps = Gps.upright(times=t, positions=enu, horizontal=accuracy, vertical=2 * accuracy, lever=np.zeros(3))
    imu = Imu(times=t, angular_rate=a[:, 17:20], specific_force=a[:, 11:14], noise=IMU_NOISE)
    return {"gps": gps, "imu": imu}


IMU_NOISE = ImuNoise(
    gyro=2e-3, gyro_bias=0.02, gyro_walk=1e-4, accelerometer=2e-2, accelerometer_bias=0.2, accelerometer_walk=1e-3
)
"""Of an IMU whose log states no noise: a MEMS unit of middle price."""
