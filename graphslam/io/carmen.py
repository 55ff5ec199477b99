"""Logs of the CARMEN robot toolkit: planar laser scans with the odometry pose of each.

Only the lines ``FLASER n r_1 … r_n x y θ odom_x odom_y odom_θ ipc_stamp host logger_stamp`` are used: they bring laser
and odometry in one record, which no delay between two processes can part. Lines ``ODOM`` are counted and left alone.

Stamps of such logs may fall back where a computer was busy, while the order of the lines stays right. They are mended,
not dropped: the nearest stamps that rise (isotonic regression), if none has to move far.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import isotonic_regression

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array, se2_between, se2_compose, se2_inverse
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import read_text
from graphslam.core.records import LaserScans, Odometry, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import MAX_DROPPED

_TAIL = 9  # numbers after the ranges: two poses, stamp, host, stamp
_SPACING = 1e-3  # least time between mended stamps [s]
_ENDINGS = (".clf", ".clf.bz2", ".clf.gz", ".clf.xz", ".log", ".log.gz", ".log.bz2", ".log.xz")


def bearings(n: int) -> Array:
    """Directions ``(n,)`` of the beams of a scanner of 180°, from the right to the left [rad].

    An odd number of beams has one at either end, an even number none at the left end.
    """
    return np.asarray(-0.5 * np.pi + np.pi / (n - 1 if n % 2 else n) * np.arange(n))


def read_carmen(
    path: str | os.PathLike[str],
    *,
    max_range: float = 80.0,
    floor: tuple[float, float] = (0.01, 0.005),
    per_metre: tuple[float, float] = (0.1, 0.15),
    per_radian: float = 0.2,
    most_mended: float = 3.0,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read a CARMEN log, and the corrected one beside it.

    Parameters
    ----------
    path : path
        A log, plain or compressed, or a folder that holds one, and perhaps one named ``*-corrected.log``: the poses
        that another SLAM found, matched to the scans by their ranges.
    max_range : float
        Ranges at or above it are "no return": 81.8 m and more for the usual scanner [m].
    floor : (float, float)
        σ that one motion of the odometry has at least: metres, radians. The logs state none; with the defaults motions
        of a metre differ from those of corrected logs about as stated (median).
    per_metre : (float, float)
        σ per metre driven: of position [m/m] and heading [rad/m].
    per_radian : float
        σ of the heading per radian turned.
    most_mended : float
        Farthest that a stamp may be moved [s].
    name : str, optional
    drops : DropCounter, optional

    Returns
    -------
    SensorLog
        Streams ``laser``, ``odometry`` (one motion a scan) and, with a corrected log, ``reference``: a Trajectory of
        the base. It is the output of another SLAM, not truth.

    Raises
    ------
    MissingDataError, FormatError, DataError, ConfigError
    """
    for what, values in (("max_range", [max_range]), ("floor", floor), ("most_mended", [most_mended])):
        if not all(np.isfinite(v) and v > 0 for v in values):
            raise ConfigError(f"carmen: {what} is {values}; wanted positive numbers")
    if not all(np.isfinite(v) and v >= 0 for v in (*per_metre, per_radian)):
        raise ConfigError(f"carmen: per_metre {per_metre}, per_radian {per_radian}; wanted numbers ≥ 0")
    raw, corrected = _files(Path(path))
    where = str(raw)
    counter = DropCounter()
    ranges, poses, stamps, others = _scans(raw, counter)
    counter.drop("log", "line ODOM not used: scans bring their odometry", others)
    times, mended = mend_stamps(stamps, most_mended, where=where)
    counter.drop("laser", "stamp mended (kept)", mended)
    T_base_sensor = np.median(se2_between(poses[:, 3:], poses[:, :3]), axis=0)
    motions = np.zeros((len(poses), 3))
    motions[1:] = se2_between(poses[:-1, 3:], poses[1:, 3:])
    driven, turned = np.linalg.norm(motions[:, :2], axis=1), np.abs(motions[:, 2])
    covariances = np.zeros((len(poses), 3, 3))
    covariances[:, 0, 0] = covariances[:, 1, 1] = floor[0] ** 2 + (per_metre[0] * driven) ** 2
    covariances[:, 2, 2] = floor[1] ** 2 + (per_metre[1] * driven) ** 2 + (per_radian * turned) ** 2
    streams: dict[str, Stream] = {
        "laser": LaserScans(
            times=times,
            ranges=ranges,
            bearings=bearings(ranges.shape[1]),
            max_range=max_range,
            T_base_sensor=T_base_sensor,
        ),
        "odometry": Odometry(times=times, increments=motions, covariances=covariances),
    }
    says = "none"
    if corrected is not None:
        index, laser = _match(ranges, corrected, counter)
        base = se2_compose(laser, np.broadcast_to(se2_inverse(T_base_sensor), laser.shape))
        streams["reference"] = Trajectory(times[index], base)
        says = f"{corrected.name}: another SLAM's output, matched by ranges; not surveyed"
    if drops is not None:
        drops.counts.update(counter.counts)
    return SensorLog(
        name=name or raw.name.split(".")[0],
        streams=streams,
        read={"laser": len(times), "odometry": len(times)},
        dropped=dict(counter.counts),
        meta={
            "source": raw.name,
            "reference": says,
            "odometry_sigmas": {"floor": list(floor), "per_metre": list(per_metre), "per_radian": per_radian},
        },
    )


def mend_stamps(stamps: Array, most: float, *, where: str) -> tuple[Array, int]:
    """The nearest stamps that rise by a millisecond at least, in the order of the records, and how many had to move.

    Parameters
    ----------
    stamps : (n,)
        Finite [s].
    most : float
        Farthest that any may move [s].
    where : str

    Raises
    ------
    DataError
        A stamp is too far off: the clock was set, or lines are out of order. Names it.
    """
    if np.all(np.diff(stamps) > 0):
        return stamps, 0
    start = stamps[0]  # large numbers would cost digits
    ramp = _SPACING * np.arange(len(stamps))
    times = start + isotonic_regression(stamps - start - ramp).x + ramp
    moved = np.abs(times - stamps)
    if moved.max() > most:
        k = int(np.argmax(moved))
        raise DataError(
            f"stamp of scan {k} is {moved[k]:.1f} s out of order",
            where=where,
            got=f"{stamps[k]:.3f} s between {stamps[max(k - 1, 0)]:.3f} and {stamps[min(k + 1, len(stamps) - 1)]:.3f}",
            wanted=f"at most {most:g} s",
        )
    return times, int(np.sum(moved > 0.5 * _SPACING))


def _files(path: Path) -> tuple[Path, Path | None]:
    if path.is_file():
        return path, None
    if not path.is_dir():
        raise MissingDataError("no such file or folder", where=str(path), wanted="a CARMEN log")
    logs = sorted(p for p in path.iterdir() if p.name.endswith(_ENDINGS))
    corrected = [p for p in logs if "-corrected" in p.name]
    raw = [p for p in logs if p not in corrected]
    if len(raw) != 1 or len(corrected) > 1:
        raise MissingDataError(
            "folder does not hold one log",
            where=str(path),
            wanted=f"one of {', '.join(_ENDINGS)}, perhaps a *-corrected one; found {', '.join(p.name for p in logs)}",
        )
    return raw[0], corrected[0] if corrected else None


def _scans(path: Path, drops: DropCounter) -> tuple[npt.NDArray[np.float32], Array, Array, int]:
    """Ranges ``(k, n)``, poses of laser and robot ``(k, 6)``, stamps ``(k,)``, and the number of lines ODOM."""
    rows: list[tuple[int, list[str]]] = []
    others = 0
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        others += line.startswith("ODOM ")
        if line.startswith("FLASER "):
            rows.append((number, line.split()))
    if not rows:
        raise FormatError("holds no scan", where=str(path), wanted="lines FLASER of a CARMEN log")
    sizes = [w[1] if len(w) > 1 else "" for _, w in rows]
    usual = max(set(sizes), key=sizes.count)
    if not usual.isdecimal() or not 2 <= int(usual) <= 10_000:
        raise FormatError("number of beams is impossible", where=f"{path}, line {rows[0][0]}", got=usual)
    n = int(usual)
    values: list[list[float]] = []
    lost: dict[str, list[int]] = {}
    for number, words in rows:
        if len(words) != n + 2 + _TAIL or words[1] != usual:
            lost.setdefault("scan is truncated, or of another size", []).append(number)
            continue
        try:
            numbers = [float(w) for w in (*words[2:-2], words[-1])]
        except ValueError:
            lost.setdefault("scan holds something that is no number", []).append(number)
            continue
        if not np.all(np.isfinite(numbers[n:])):
            lost.setdefault("pose or stamp is not finite", []).append(number)
            continue
        values.append(numbers)
    bad = sum(len(v) for v in lost.values())
    if bad > MAX_DROPPED * len(rows) or not values:
        reason = max(lost, key=lambda r: len(lost[r]))
        raise FormatError(
            f"{bad} of {len(rows)} scans are unusable, {len(lost[reason])} of them because: {reason}",
            where=f"{path}, first in line {lost[reason][0]}",
            wanted=f"at most {MAX_DROPPED:.0%} of bad scans",
        )
    for reason, numbers_of in lost.items():
        drops.drop("laser", reason, len(numbers_of))
    table = np.array(values)
    return table[:, :n].astype(np.float32), table[:, n : n + 6], table[:, n + 6], others


def _match(ranges: npt.NDArray[np.float32], corrected: Path, drops: DropCounter) -> tuple[npt.NDArray[np.intp], Array]:
    """Scans ``(m,)`` that the corrected log holds, rising, and its poses of the laser ``(m, 3)``.

    A corrected log has lost digits of its stamps, but its ranges are those of the scans.
    """
    theirs, poses, _, _ = _scans(corrected, DropCounter())
    if theirs.shape[1] != ranges.shape[1]:
        raise DataError(
            "corrected log has other beams", where=str(corrected), got=theirs.shape[1], wanted=ranges.shape[1]
        )
    known: dict[bytes, list[int]] = {}
    for k, row in enumerate(ranges):
        known.setdefault(row.tobytes(), []).append(k)
    index, kept, last = [], [], -1
    for k, row in enumerate(theirs):  # both are in order, so of equal scans the first after the last match is meant
        later = next((j for j in known.get(row.tobytes(), []) if j > last), None)
        if later is None:
            continue
        index.append(later)
        kept.append(k)
        last = later
    drops.drop("reference", "corrected scan is not in the log", len(theirs) - len(kept))
    if len(kept) < 0.5 * len(theirs):
        raise DataError(
            "corrected log is of another recording",
            where=str(corrected),
            got=f"{len(kept)} of {len(theirs)} scans found",
            wanted="most of them",
        )
    return np.array(index, dtype=np.intp), poses[kept, :3]
