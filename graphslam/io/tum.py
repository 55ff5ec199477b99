"""Reader and writer of TUM trajectories: one line ``t x y z qx qy qz qw`` per pose [s, m]; writer of KITTI poses.

2-D poses are embedded in the plane z = 0 (the rotation about z is the heading).
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np

from graphslam.core import se3
from graphslam.core.atomic import atomic_open
from graphslam.core.errors import FormatError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import MAX_DROPPED
from graphslam.io.odometry_noise import constant_noise
from graphslam.io.recognise import is_tum
from graphslam.io.source_probe import SourceProbe

log = logging.getLogger(__name__)
_NORM_TOLERANCE = 5e-2
"""Maximal deviation of the norm of a quaternion from 1, before it is normalised; some programs print three digits."""


def embed_plane(poses: Array) -> Array:
    """Planar poses ``(n, 3)`` as ``(n, 7)``: z = 0, rotation about z."""
    half = poses[:, 2] / 2.0
    out = np.zeros((len(poses), 7))
    out[:, :2] = poses[:, :2]
    out[:, 5], out[:, 6] = np.sin(half), np.cos(half)
    return out


def write_tum(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write a trajectory atomically; with 17 digits, stamps and positions are restored bit for bit."""
    poses = embed_plane(trajectory.poses) if trajectory.dim == 2 else trajectory.poses
    rows = np.column_stack([trajectory.times, poses])
    with atomic_open(path, "w") as stream:
        stream.write("# t x y z qx qy qz qw\n")
        np.savetxt(stream, rows, fmt="%.17g")


def write_kitti(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write the poses of a trajectory in KITTI odometry format: upper three rows of ``T`` per line, no stamps."""
    poses = embed_plane(trajectory.poses) if trajectory.dim == 2 else trajectory.poses
    T = np.concatenate([se3.quat_to_matrix(poses[:, 3:]), poses[:, :3, None]], axis=2)
    with atomic_open(path, "w") as stream:
        np.savetxt(stream, T.reshape(len(T), 12), fmt="%.17g")


def read_tum(path: str | os.PathLike[str], *, dim: int | None = None) -> Trajectory:
    """Read a trajectory.

    Parameters
    ----------
    path : path
        Lines that are empty or start with ``#`` are skipped.
    dim : 2, 3 or None
        None: 2 if every pose has z = 0 and rotates about z only, else 3.
    """
    where = str(path)
    text = read_text(path)
    rows: list[list[float]] = []
    lines: list[int] = []
    marks = 0
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) == 9 and fields[8].lstrip("-").isdigit():  # RTAB-Map: number of the pose, negative: a landmark
            number_of = int(fields.pop())
            marks += number_of < 0
            if number_of < 0:
                continue
        if len(fields) != 8:
            raise FormatError(
                "wrong number of columns",
                where=f"{where}:{number}",
                got=f"{len(fields)}: {line.strip()[:60]!r}",
                wanted="8: t x y z qx qy qz qw (matrices are read beside clouds only)",
            )
        try:
            rows.append([float(f) for f in fields])
        except ValueError as error:
            wanted = "numbers with a decimal point; time in seconds"
            raise FormatError(f"not a number ({error})", where=f"{where}:{number}", wanted=wanted) from None
        lines.append(number)
    if marks:
        log.warning("%s: %d rows of landmarks (negative numbers at their end) are not read", where, marks)
    data = np.array(rows).reshape(-1, 8)
    _refuse(~np.all(finite_mask(data), axis=1), "not finite", where, lines, rows)
    norm = np.linalg.norm(data[:, 4:], axis=1)
    _refuse(np.abs(norm - 1.0) > _NORM_TOLERANCE, "rotation is no unit quaternion", where, lines, norm)
    data, lines = _without_repeats(data, lines, where)
    if len(back := np.flatnonzero(np.diff(data[:, 0]) <= 0)):
        k = int(back[0]) + 1
        got, wanted = f"{data[k, 0]} after {data[k - 1, 0]}", "rows in the order of time: sort the file"
        raise FormatError("stamps do not increase", where=f"{where}:{lines[k]}", got=got, wanted=wanted)
    off_plane = np.any(data[:, 3:6] != 0.0, axis=1)
    if dim is None:
        dim = 3 if np.any(off_plane) or not len(data) else 2
    if dim == 3:
        quat = se3.quat_normalize(data[:, 4:]) if len(data) else data[:, 4:]
        return Trajectory(data[:, 0], np.column_stack([data[:, 1:4], quat]))
    _refuse(off_plane, "pose leaves the plane z = 0", where, lines, rows)
    heading = wrap_angle(2.0 * np.arctan2(data[:, 6], data[:, 7]))
    return Trajectory(data[:, 0], np.column_stack([data[:, 1:3], heading]))


def read_path(path: str | os.PathLike[str]) -> Trajectory:
    """Read a TUM file, or a KITTI file (12 numbers per line), whose stamps are the numbers of its lines."""
    rows = [line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    if not rows or any(len(fields) != 12 for fields in rows):
        return read_tum(path)
    try:
        T = np.array(rows, dtype=np.float64).reshape(-1, 3, 4)
    except ValueError as error:
        raise FormatError(f"not a number ({error})", where=str(path), wanted="numbers with a decimal point") from None
    R = T[:, :, :3]
    good = finite_mask(T).all(axis=(1, 2))
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    good &= (off < _NORM_TOLERANCE) & (np.linalg.det(np.where(good[:, None, None], R, 0.0)) > 0.0)
    if not good.all():
        k = int(np.flatnonzero(~good)[0])
        raise FormatError("not a pose", where=f"{path}: pose {k + 1}", got=rows[k], wanted="a rotation and a position")
    poses = np.column_stack([T[:, :, 3], se3.quat_normalize(se3.matrix_to_quat(R))])
    return Trajectory(np.arange(len(T), dtype=np.float64), poses)


def _without_repeats(data: Array, lines: list[int], where: str) -> tuple[Array, list[int]]:
    """Remove rows with the stamp of the previous row, if these are at most :data:`MAX_DROPPED` of all rows."""
    again = np.r_[False, np.diff(data[:, 0]) == 0][: len(data)]
    if not again.any() or again.mean() > MAX_DROPPED:
        return data, lines
    first = lines[int(np.flatnonzero(again)[0])]
    log.warning("%s:%d: %d poses that repeat the stamp before them are left out", where, first, again.sum())
    return data[~again], [n for n, repeated in zip(lines, again) if not repeated]


def _refuse(bad: np.ndarray, what: str, where: str, lines: list[int], got: object) -> None:
    if np.any(bad):
        k = int(np.flatnonzero(bad)[0])
        raise FormatError(what, where=f"{where}:{lines[k]}", got=got[k])  # type: ignore[index]


def read_tum_log(
    path: str | os.PathLike[str],
    *,
    odometry_sigmas: tuple[float, float] = (0.03, 0.005),
) -> SensorLog:
    """Read a trajectory as a log with one stream, ``odometry``.

    Parameters
    ----------
    path : path
        The table, or a folder with one.
    odometry_sigmas : (float, float)
        Assumed σ of one motion, per axis [m, rad].
    """
    file = Path(path)
    if file.is_dir():
        look = SourceProbe(file)
        file = next((p for p in look.texts if is_tum(look, p)), file / "trajectory.tum")
    found = read_tum(file)
    if len(found) < 2:
        raise FormatError("holds fewer than two poses", where=str(file), got=len(found))
    odometry = constant_noise(odometry_sigmas).odometry(found.times, found.poses)
    return SensorLog(
        name=file.stem,
        streams={"odometry": odometry},
        read={"odometry": len(found)},
        meta={"source": file.name},
    )
