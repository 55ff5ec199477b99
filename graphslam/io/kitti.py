"""The layouts of KITTI: odometry sequences with poses, and raw drives with ``gps`` and ``imu``."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import MissingDataError
from graphslam.core.geodesy import geodetic_to_ecef
from graphslam.core.geometry import Array
from graphslam.core.gnss import TangentPlane
from graphslam.core.imu import Imu
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import Gps, Stream
from graphslam.io.clock import usable_records
from graphslam.io.cloud_files import BIN_COLUMNS
from graphslam.io.cloud_logs import (
    IMU_NOISE,
    ODOMETRY_SIGMAS,
    CloudFolder,
    PoseTable,
    number_in_name,
    scan_stamps,
    stamps_of_file,
)
from graphslam.io.recognise import is_kitti_poses, parse_numbers
from graphslam.io.source_probe import SourceProbe


def read_kitti(
    path: str | os.PathLike[str],
    *,
    poses: str | None = None,
    odometry_sigmas: tuple[float, float] = ODOMETRY_SIGMAS,
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
        stamps = stamps_of_file(beside, len(files)) if beside.is_file() else None
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
    folder = CloudFolder(look, sorted(files, key=number_in_name), BIN_COLUMNS, True)
    posed = None if table is None else PoseTable.read(look, table, counter, calibration)
    stamped = scan_stamps(folder, posed) if stamps is None else (stamps, "stamps of the files")
    log = folder.log(posed, stamped, odometry_sigmas, extra, counter)
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
    files = sorted(files, key=number_in_name)
    if len(files) < 2:
        return {}
    beside = files[0].parent.parent / "timestamps.txt"
    if not beside.is_file():
        counter.drop("oxts", "records without timestamps.txt", len(files))
        return {}
    times = stamps_of_file(beside, len(files))
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
