"""Reader of logs of the CARMEN robot toolkit: planar laser scans with their odometry poses.

Scans of one laser are read, from these lines:

* ``FLASER n r_1 … r_n x y θ odom_x odom_y odom_θ ipc_stamp host logger_stamp`` (``RLASER``: the rear laser).
* ``ROBOTLASER1 type start fov resolution max_range accuracy remission n r_1 … r_n k rem_1 … rem_k laser_x laser_y
  laser_θ robot_x robot_y robot_θ tv rv forward_safety side_safety turn_axis ipc_stamp host logger_stamp``
* ``RAWLASER1``: the same up to the remissions, then the stamps, without a pose.

The first two have laser and odometry in one record, so no delay between two processes separates them: lines ``ODOM``
are then counted and not used. For scans without a pose, or with a constant one, poses are interpolated from ``ODOM``.
Scans with an unusual beam layout are resampled to the most frequent one.

Stamps of such logs may decrease if the computer was busy, while the order of the lines is right. They are not dropped,
but corrected to the nearest increasing stamps (isotonic regression), if no stamp moves by more than ``most_mended``.
Corrected logs often have one stamp for all scans, or rounded ones: stamps that the motion excludes are replaced by
those of a robot of usual speed (:func:`usual_stamps`).
"""

from __future__ import annotations

import os
import re
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import isotonic_regression

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array, se2_between, se2_compose, se2_inverse
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import LaserScans, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import MAX_DROPPED
from graphslam.io.odometry_noise import DEFAULT_NOISE, OdometryNoise
from graphslam.io.planar_scans import unify_layout
from graphslam.io.recognise import CARMEN_SCANS
from graphslam.io.source_probe import SourceProbe

MAX_RANGE = 80.0
"""Default maximal range, if the log has none [m]: ranges at or above it are "no return"."""

_LASER_PARAM = re.compile(r"PARAM (?:robot|laser)_(front|rear)_?laser_(fov|max|max_range) (\d+\.?\d*)\b")
USUAL_BEAMS = (180, 181, 360, 361)
"""Numbers of beams of 180° scanners with steps of 1° and 0.5°."""
_SPACING = 1e-3  # minimal time between corrected stamps [s]
USUAL_MOTION = (0.5, 0.5, 0.1)
"""Speed [m/s], yaw rate [rad/s] and least interval [s] of stamps that replace those without information."""
IMPOSSIBLE, TOGETHER = (10.0, 10.0), 20
"""Speed [m/s] and yaw rate [rad/s] that no robot with such a log has. If half of the motions over so many scans are
faster, the stamps contain no information; single motions are also faster where delayed scans have stamps in bunches."""
_POSED = {"FLASER": 9, "RLASER": 9, "ROBOTLASER": 14, "RAWLASER": 3}  # words after ranges (and remissions)


def beam_bearings(n: int) -> Array:
    """Directions ``(n,)`` of the beams of a 180° scanner, from right to left [rad].

    With an odd number, beams are at both ends; with an even number, there is none at the left end.
    """
    return np.asarray(-0.5 * np.pi + np.pi / (n - 1 if n % 2 else n) * np.arange(n))


def read_carmen(
    path: str | os.PathLike[str],
    *,
    max_range: float | None = None,
    laser: str | None = None,
    fov: float | None = None,
    noise: OdometryNoise = DEFAULT_NOISE,
    most_mended: float = 3.0,
) -> SensorLog:
    """Read a CARMEN log, and the corrected log in the same folder.

    Parameters
    ----------
    path : path
        A log, plain or compressed, or a folder with one log and optionally one named ``*-corrected.log``: poses from
        another SLAM program, matched to the scans by their ranges.
    max_range : float, optional
        Ranges at or above it are "no return" [m]. Default: the value in the log, or 80 m: the usual scanner writes
        81.8 m and more for "no return".
    laser : str, optional
        Tag of the lines to read, for instance ``ROBOTLASER1``; default: the most frequent tag.
    fov : float, optional
        Field of view of scans in lines FLASER and RLASER, which do not contain it [deg]. Default: that of a line
        PARAM, or 180°.
    noise : OdometryNoise
        Noise of the odometry; the logs contain none.
    most_mended : float
        Maximal correction of a stamp [s].

    Returns
    -------
    SensorLog
        Streams ``laser``, ``odometry`` (one motion per scan; none if the log has no poses) and, with a corrected log,
        ``reference``: a Trajectory of the base. It is the output of another SLAM program, not ground truth.
    """
    for what, value in (("max_range", max_range), ("most_mended", most_mended), ("fov", fov)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ConfigError(f"carmen: {what} is {value}; wanted a positive number")
    raw, corrected = _files(Path(path))
    where = str(raw)
    counter = DropCounter()
    scans = _scans(raw, counter, laser, fov)
    reach = max_range or scans.max_range or MAX_RANGE
    ranges, poses = scans.ranges, scans.poses
    times, mended = mend_stamps(scans.stamps, most_mended, where=where)
    counter.drop("laser", "stamp corrected (kept)", mended)
    if poses is None or _still(poses):
        found = _between(scans.odom, times, most_mended, where)
        if found is not None:
            inside, robot = found
            counter.drop("laser", "scan outside the time of lines ODOM", int((~inside).sum()))
            times, ranges, robot = times[inside], ranges[inside], robot[inside]
            poses = np.column_stack([robot, robot])
    else:
        counter.drop("log", "line ODOM not used: scans have their own odometry", len(scans.odom))
    T_base_sensor = np.zeros(3)
    streams: dict[str, Stream] = {}
    assumed = list(scans.assumed)
    if poses is not None and (instead := usual_stamps(times, poses[:, 3:])) is not None:
        times, seconds = instead, float(np.ptp(times))
        counter.counts.pop("laser: stamp corrected (kept)", None)
        counter.drop("laser", "stamp replaced (kept)", len(times))
        text = (
            f"stamps of the scans: {seconds:.6g} s for all of the path, which is impossible. They were replaced by "
            f"those of a robot with {USUAL_MOTION[0]:g} m/s and {USUAL_MOTION[1]:g} rad/s."
        )
        assumed.append(("look", text))
    if poses is not None:
        T_base_sensor = np.median(se2_between(poses[:, 3:], poses[:, :3]), axis=0)
        streams["odometry"] = noise.odometry(times, poses[:, 3:])
    scan_stream = LaserScans(
        times=times, ranges=ranges, bearings=scans.bearings, max_range=reach, T_base_sensor=T_base_sensor
    )
    streams = {"laser": scan_stream, **streams}
    reference = "none"
    if corrected is not None:
        index, theirs = _match(ranges, corrected, counter)
        base = se2_compose(theirs, np.broadcast_to(se2_inverse(T_base_sensor), theirs.shape))
        streams["reference"] = Trajectory(times[index], base)
        reference = f"{corrected.name}: another SLAM's output, matched by ranges; not surveyed"
    return SensorLog(
        name=raw.name.split(".")[0],
        streams=streams,
        read={k: len(times) for k in streams if k != "reference"},
        dropped=dict(counter.counts),
        meta={
            "source": raw.name,
            "reference": reference,
            "assumed": assumed,
            "odometry_sigmas": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(noise).items()},
        },
    )


def mend_stamps(stamps: Array, most: float, *, where: str) -> tuple[Array, int]:
    """Least-squares correction to stamps that increase by at least 1 ms, and the number of corrected stamps.

    Parameters
    ----------
    stamps : (n,)
        Finite [s].
    most : float
        Maximal correction of a stamp [s]; above it, :class:`DataError`.
    """
    if np.all(np.diff(stamps) > 0):
        return stamps, 0
    start = stamps[0]  # unix times would lose digits
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


def usual_stamps(times: Array, poses: Array) -> Array | None:
    """Stamps of a robot of usual speed, from the first stamp on; None if the robot can have moved as the stamps say.

    Parameters
    ----------
    times : (n,)
        Increasing [s].
    poses : (n, 3)
        Of the odometry [m, rad].
    """
    step = se2_between(poses[:-1], poses[1:])
    metres, radians, seconds = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2]), np.diff(times)
    n = min(TOGETHER, len(seconds))
    length, turn, time = (np.convolve(v, np.ones(n), "valid") if n else v for v in (metres, radians, seconds))
    if not n or np.mean((length > IMPOSSIBLE[0] * time) | (turn > IMPOSSIBLE[1] * time)) < 0.5:
        return None
    spent = np.maximum(np.maximum(metres / USUAL_MOTION[0], radians / USUAL_MOTION[1]), USUAL_MOTION[2])
    spent = np.minimum(spent, 3.0 * np.median(spent))  # a large step between two scans is no gap in the records
    return np.asarray(times[0] + np.concatenate([[0.0], np.cumsum(spent)]))


def _files(path: Path) -> tuple[Path, Path | None]:
    if path.is_file():
        return path, None
    if not path.is_dir():
        raise MissingDataError("no such file or folder", where=str(path), wanted="a CARMEN log")
    look = SourceProbe(path)
    logs = [p for p in look.texts if any(CARMEN_SCANS.match(s) or s.startswith("PARAM ") for s in look.lines(p, 4000))]
    corrected = [p for p in logs if "-corrected" in p.name]
    raw = [p for p in logs if p not in corrected]
    if len(raw) != 1 or len(corrected) > 1:
        raise MissingDataError(
            "folder does not hold one log",
            where=str(path),
            got=", ".join(look.relative(p) for p in logs) or str(look),
            wanted="one CARMEN log, perhaps a *-corrected one beside it; or give the file itself",
        )
    return raw[0], corrected[0] if corrected else None


@dataclass(frozen=True, slots=True)
class _Scans:
    """Scans ``(k, n)`` with stamps ``(k,)``; poses of laser and robot ``(k, 6)`` or None; rows (t, x, y, θ) of ODOM."""

    ranges: npt.NDArray[np.float32]
    bearings: Array
    stamps: Array
    poses: Array | None
    odom: list[tuple[float, float, float, float]]
    max_range: float | None
    assumed: list[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class _Line:
    """One scan: layout of beams (first angle, step, number); poses of laser and robot, or None."""

    layout: tuple[float, float, int]
    ranges: npt.NDArray[np.float32]
    pose: list[float] | None
    stamp: float
    max_range: float | None


def _parse(words: list[str]) -> _Line | str:
    """A parsed scan line, or the reason for its rejection."""
    tag = words[0].rstrip("0123456789")
    at = 1 if tag in ("FLASER", "RLASER") else 8
    try:
        n = int(words[at])
        if not 2 <= n <= 10_000:
            return "number of beams is impossible"
        end = at + 1 + n
        if at == 8:
            end += 1 + int(words[end])
        if len(words) != end + _POSED[tag] or end <= at + n:
            return "scan is truncated, or of another size"
        ranges = np.array(words[at + 1 : at + 1 + n], dtype=np.float64)
        rest = [float(w) for w in (*words[end:-2], words[-1])]
        head = [float(w) for w in words[2:6]] if at == 8 else []
    except IndexError:
        return "scan is truncated, or of another size"
    except ValueError:
        return "scan holds something that is no number"
    if not np.all(finite_mask([*rest, *head])):
        return "pose or stamp is not finite"
    if at == 1:
        return _Line((-0.5 * np.pi, 0.0, n), ranges.astype(np.float32), rest[:6], rest[6], None)
    start, fov, step, reach = head
    step = step if step > 0 else fov / (n - 1)
    if not (0 < step * (n - 1) <= 2.2 * np.pi and abs(start) <= 4 * np.pi):
        return "angles of the laser are impossible (wanted radians)"
    pose = rest[:6] if tag == "ROBOTLASER" else None
    stamp = rest[-2]
    return _Line((start, step, n), ranges.astype(np.float32), pose, stamp, reach if reach > 0 else None)


def _scans(path: Path, drops: DropCounter, laser: str | None = None, fov: float | None = None) -> _Scans:
    rows: dict[str, list[tuple[int, list[str]]]] = {}
    odom: list[tuple[float, float, float, float]] = []
    settings = _Settings()
    for at, line in enumerate(read_text(path).splitlines(), start=1):
        found = CARMEN_SCANS.match(line)
        if found:
            rows.setdefault(found[1], []).append((at, [found[1], *line[found.end() :].split()]))
        elif line.startswith("PARAM "):
            settings.read(line)
        elif line.startswith("ODOM "):
            words = line.split()
            try:
                w = [float(x) for x in (*words[-3:-2], *words[1:4])]
            except ValueError:
                w = [np.nan]
            if len(w) == 4 and np.all(finite_mask(w)):
                odom.append((w[0], w[1], w[2], w[3]))
            else:
                drops.drop("odometry", "line ODOM is truncated or not finite")
    if not rows:
        raise FormatError(
            "holds no scan", where=str(path), wanted="lines FLASER, ROBOTLASER1 or RAWLASER1 of a CARMEN log"
        )
    if laser is not None and laser not in rows:
        raise ConfigError(f"carmen: no lines {laser!r} in {path}; there are {', '.join(rows)}")
    tag = laser or max(rows, key=lambda t: (len(rows[t]), t.startswith(("FLASER", "ROBOTLASER"))))
    for other in rows.keys() - {tag}:
        drops.drop("laser", f"line {other} not used (choose it with option laser={other})", len(rows[other]))
    lines: list[_Line] = []
    lost: dict[str, list[int]] = {}
    for number, words in rows[tag]:
        parsed = _parse(words)
        if isinstance(parsed, str):
            lost.setdefault(parsed, []).append(number)
        else:
            lines.append(parsed)
    bad, all_ = sum(len(v) for v in lost.values()), len(rows[tag])
    if bad > MAX_DROPPED * all_ or not lines:
        reason = max(lost, key=lambda r: len(lost[r]))
        raise FormatError(
            f"{bad} of {all_} scans are unusable, {len(lost[reason])} of them because: {reason}",
            where=f"{path}, first in line {lost[reason][0]}",
            wanted=f"at most {MAX_DROPPED:.0%} of bad scans",
        )
    for reason, numbers_of in lost.items():
        drops.drop("laser", reason, len(numbers_of))
    layouts = {x.layout for x in lines}
    beside = settings.rear if tag.startswith("RLASER") else settings.front
    if fov is not None:
        beside.fov = float(np.deg2rad(fov))
    directions = {x: _directions(x, beside.fov) for x in layouts}
    assumed = [] if tag[:6] not in ("FLASER", "RLASER") else [beside.in_words(max(layouts)[2])]
    ranges, beams, moved = unify_layout([(x.ranges, directions[x.layout]) for x in lines])
    drops.drop("laser", f"scan of other beams mapped to the usual {len(beams)} (kept)", moved)
    poses = [x.pose for x in lines if x.pose is not None]
    reach = [x.max_range for x in lines if x.max_range is not None]
    return _Scans(
        ranges=ranges,
        bearings=beams,
        stamps=np.array([x.stamp for x in lines]),
        poses=np.array(poses) if poses else None,
        odom=odom,
        max_range=float(np.median(reach)) if reach else beside.max_range,
        assumed=assumed,
    )


def _directions(layout: tuple[float, float, int], fov: float | None) -> Array:
    start, step, n = layout
    if step > 0:
        return np.asarray(start + step * np.arange(n, dtype=np.float64))
    if fov is None or abs(fov - np.pi) < 0.01:
        return beam_bearings(n)
    return np.linspace(-0.5 * fov, 0.5 * fov, n)


@dataclass
class _Laser:
    """Values of lines PARAM for one laser: field of view [rad] and maximal range [m]."""

    fov: float | None = None
    max_range: float | None = None

    def in_words(self, beams: int) -> tuple[str, str]:
        fov = 180.0 if self.fov is None else float(np.rad2deg(self.fov))
        by = "no line states it (reader option fov=)" if self.fov is None else "by a line PARAM"
        return ("" if self.fov or beams in USUAL_BEAMS else "look"), f"field of view of the laser: {fov:g}°, {by}."


class _Settings:
    """Lines PARAM of the lasers, ``PARAM name value``."""

    def __init__(self) -> None:
        self.front, self.rear = _Laser(), _Laser()

    def read(self, line: str) -> None:
        found = _LASER_PARAM.match(line)
        value = float(found[3]) if found else 0.0
        if found is None or value <= 0.0:
            return
        laser = self.rear if found[1] == "rear" else self.front
        if found[2] == "fov":
            laser.fov = float(np.deg2rad(value)) if value > 2.0 * np.pi else value
        else:
            laser.max_range = value


def _still(poses: Array) -> bool:
    return bool(np.all(np.ptp(poses[:, 3:], axis=0) == 0.0))


def _between(
    odom: list[tuple[float, float, float, float]], times: Array, most_mended: float, where: str
) -> tuple[npt.NDArray[np.bool_], Array] | None:
    """Mask of the stamps within the time of the lines ODOM, and interpolated robot poses; None without such lines."""
    if len(odom) < 2:
        return None
    a = np.array(odom)
    t, _ = mend_stamps(a[:, 0], most_mended, where=f"{where}, lines ODOM")
    inside = (times >= t[0]) & (times <= t[-1])
    if not inside.any():
        raise DataError(
            "scans and lines ODOM have no time in common",
            where=where,
            got=f"scans {times[0]:.1f} to {times[-1]:.1f} s, ODOM {t[0]:.1f} to {t[-1]:.1f} s",
        )
    heading = np.unwrap(a[:, 3])
    return inside, np.column_stack([np.interp(times, t, c) for c in (a[:, 1], a[:, 2], heading)])


def _match(ranges: npt.NDArray[np.float32], corrected: Path, drops: DropCounter) -> tuple[npt.NDArray[np.intp], Array]:
    """Increasing indices ``(m,)`` of the scans in the corrected log, and its poses of the laser ``(m, 3)``.

    Stamps of corrected logs are rounded, but their ranges are identical, so scans are matched by ranges.
    """
    found = _scans(corrected, DropCounter())
    theirs, poses = found.ranges, found.poses
    if poses is None:
        raise DataError("corrected log tells no poses", where=str(corrected), wanted="lines FLASER or ROBOTLASER1")
    if theirs.shape[1] != ranges.shape[1]:
        raise DataError(
            "corrected log has other beams", where=str(corrected), got=theirs.shape[1], wanted=ranges.shape[1]
        )
    known: dict[bytes, list[int]] = {}
    for k, row in enumerate(ranges):
        known.setdefault(row.tobytes(), []).append(k)
    index, kept, last = [], [], -1
    for k, row in enumerate(theirs):  # both are in order: of equal scans, use the first after the last match
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
