"""Reader of KITTI: odometry sequences with poses, and raw drives with GPS and IMU (``oxts``)."""

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
from graphslam.io.text_records import read_table

CAMERA_AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation from the axes of a lidar (x ahead, y left, z up) to those of a camera (x right, y down, z ahead)."""


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
        Contains ``velodyne/*.bin``, optionally ``times.txt``, ``calib.txt`` and ``poses.txt``; or
        ``velodyne_points/data/*.bin`` and ``timestamps.txt``, optionally ``oxts``.
    poses : str, optional
        Table of poses, relative to the folder; ``none``: no poses. Poses of the camera are transformed to the lidar
        with ``Tr`` of ``calib.txt``.
    odometry_sigmas : (float, float)
        σ of one motion from scan to scan, per axis [m, rad].
    """
    root = Path(path)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="a sequence or drive of KITTI")
    look = SourceProbe(root)
    files = [p for p in look.by_ending.get(".bin", []) if p.parent.name in ("velodyne", "data")]
    counter = DropCounter()
    stamps: Array | None = None
    extra: dict[str, Stream] = {}
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
    assumed: list[tuple[str, str]] = []
    if table is not None and calibration is None:
        calibration, text = _without_tr(read_table(table, 12)[0].reshape(-1, 3, 4))
        assumed.append(("look", f"{look.relative(table)}: no calib.txt with the line Tr; {text}"))
    folder = CloudFolder(look, sorted(files, key=number_in_name), BIN_COLUMNS, True)
    posed = None if table is None else PoseTable.read(look, table, counter, calibration)
    stamped = scan_stamps(folder, posed) if stamps is None else (stamps, "stamps of the files")
    log = folder.log(posed, stamped, odometry_sigmas, extra, counter)
    return replace(log, meta={**log.meta, "assumed": [*log.meta["assumed"], *assumed]})


def _without_tr(matrices: Array) -> tuple[Array | None, str]:
    """``T_camera_lidar`` ``(7,)`` or None, and a note, from the main direction of motion: z of a camera, x of a lidar.

    None means that the poses are those of the lidar.
    """
    R, t = matrices[:-1, :, :3], matrices[:, :, 3]
    moved = np.abs(np.einsum("kji,kj->ki", R, np.diff(t, axis=0)))
    ahead = np.median(moved, axis=0) if len(moved) else np.zeros(3)
    if ahead[2] > 2.0 * ahead[0]:
        text = (
            "the poses move along z, so they are used as those of a camera that looks ahead, at the place of the lidar."
        )
        return np.concatenate([np.zeros(3), se3.matrix_to_quat(CAMERA_AXES[None])[0]]), text
    return None, "the poses move along x, so they are used as those of the lidar."


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
    """Streams ``gps`` and ``imu`` from the files of oxts, one per record with 30 numbers."""
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
