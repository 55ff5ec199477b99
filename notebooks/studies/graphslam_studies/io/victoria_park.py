"""The Victoria Park log: SICK laser, wheel speed and steering, GPS (Guivant and Nebot, 2001).

Frames and geometry. The base is the middle of the rear axle, x forward, y left. The laser sits at (3.78, 0.50):
a = 3.78 m is the wheelbase 2.83 plus the 0.95 that the log's ``info.txt`` gives, which counts from the *front* axle;
with 0.95 dead reckoning disagrees with the GPS from the first minute. Speed is that of the left rear wheel, 0.76 m
left of the middle. Steering is positive to the left. Beam k looks at k · 0.5° − 90° from straight ahead,
counter-clockwise. The GPS antenna is not documented; the fixes fit the laser's place best.

One clock: seconds of the ASCII files. The ``.mat`` files count milliseconds of another: t = (ms − 20967) / 1000, and
their GPS has another origin.

What is refused and what is dropped. A file that is missing, truncated, or not made of whole records is a
:class:`FormatError` or :class:`MissingDataError`; a log in which one stream ends long before another, or more than
5 % of one stream is unusable, is a :class:`DataError`. Isolated bad records (stamps not finite, repeated or out of
order; speed, steering or position not finite; scans without a finite range) are dropped and counted. A single beam
whose range is NaN, infinite or not positive becomes NaN, "no return", and is counted under ``laser beams``.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Literal

import numpy as np

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import read_text
from graphslam.core.records import AckermannGeometry, Gps, LaserScans, SteeringControls
from graphslam.io.clock import usable_records
from graphslam_studies.io.mat import read_mat

LASER_POSITION = (3.78, 0.50)
"""Laser in the base frame [m]."""
VEHICLE = AckermannGeometry(wheelbase=2.83, encoder_offset=0.76, model="rear-axle")
BEAMS = 361
BEARINGS = np.deg2rad(0.5 * np.arange(BEAMS) - 90.0)
"""Beam directions in the laser frame [rad]."""
MAX_RANGE = 80.0
"""Ranges at or above mean "no return" [m]."""

_MAT_EPOCH_MS = 20967.0
# origin of the ASCII GPS (its first fix) in the frame of the .mat file [m]
_MAT_ORIGIN_NORTH, _MAT_ORIGIN_EAST = -41.7142, -67.6493
_MAX_STEERING = 1.4  # [rad]; no car steers further, and tan() must stay finite
_CLOCK_SLACK = 1.0  # streams may begin or end this much apart [s]


def mat_seconds(milliseconds: Array) -> Array:
    """Seconds of the log's clock from the milliseconds of the ``.mat`` files."""
    return np.asarray((milliseconds - _MAT_EPOCH_MS) / 1000.0)


def read_victoria_park(
    folder: str | os.PathLike[str],
    *,
    controls: Literal["ascii", "mat"] = "ascii",
    gps: Literal["good", "all", "none"] = "good",
    gps_sigma: float = 1.0,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read the raw log.

    Parameters
    ----------
    folder : path
        Holds ``LASER.txt``, ``DRS.txt`` and ``GPS.txt`` (plain or ``.gz``), and for the other forms ``aa3_dr.mat`` and
        ``aa3_gpsx.mat``.
    controls : {"ascii", "mat"}
        61,763 records of the ASCII log, or the 61,945 of the ``.mat`` file: the same log, 4.6 s longer and unrounded,
        but with steering of another calibration, 0.9441 · ascii − 0.0025 rad, given here as it stands. Dead reckoning
        with it is worse (8.2 m against 0.7 m rms over the fixes from 20 to 200 s).
    gps : {"good", "all", "none"}
        The 948 fixes of the ASCII log, all 4,466 of the ``.mat`` file with their jumps and multipath (use a robust
        kernel), or no such stream.
    gps_sigma : float
        σ of each coordinate of a fix [m]. Repeated passes disagree by 1.1–1.3 m a fix; within a minute the error is
        nearly constant.
    drops : DropCounter, optional
        Counts into this one, besides ``SensorLog.dropped``.

    Returns
    -------
    SensorLog
        "victoria-park" with streams ``laser``, ``controls`` and (unless "none") ``gps``: x east, y north from the
        first fix, lever = the laser.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="the folder of the Victoria Park log")
    if controls not in ("ascii", "mat") or gps not in ("good", "all", "none"):
        raise ConfigError(f"controls = {controls!r}, gps = {gps!r}; known: ascii, mat; good, all, none")
    if not (gps_sigma > 0 and np.isfinite(gps_sigma)):
        raise ConfigError(f"gps_sigma = {gps_sigma}; wanted a positive number of metres")
    counter = DropCounter()
    laser, laser_read = _read_laser(root, counter)
    steering, steering_read = _read_controls(root, controls, counter)
    streams: dict[str, LaserScans | SteeringControls | Gps] = {"laser": laser, "controls": steering}
    read = {"laser": laser_read, "controls": steering_read}
    if gps != "none":
        streams["gps"], read["gps"] = _read_gps(root, gps, gps_sigma, counter)
    for edge, what in ((0, "begin"), (-1, "end")):
        gap = float(laser.times[edge] - steering.times[edge]) * (1 if edge else -1)
        if gap > _CLOCK_SLACK:
            raise DataError(
                f"controls {what} {gap:.1f} s inside the laser's time: truncated?",
                where=str(root),
                got=f"{steering.times[edge]:.3f} s against {laser.times[edge]:.3f} s",
                wanted=f"within {_CLOCK_SLACK} s",
            )
    if drops is not None:
        drops.counts.update(counter.counts)
    return SensorLog(
        name="victoria-park",
        streams=streams,
        read=read,
        dropped=dict(counter.counts),
        meta={"source": root.name, "controls": controls, "gps": gps, "gps_sigma": gps_sigma},
    )


def read_numbers(path: Path, columns: int) -> Array:
    """Whitespace-separated numbers of a text file as ``(n, columns)``; line breaks carry no meaning."""
    file = next((p for p in (path, path.with_name(path.name + ".gz")) if p.is_file()), None)
    if file is None:
        raise MissingDataError("no such file", where=str(path), wanted=f"{path.name} or {path.name}.gz")
    text = read_text(file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # older NumPy only warns, and returns what it has
            values = np.fromstring(text, sep=" ")
    except (ValueError, DeprecationWarning):
        raise FormatError("holds something that is no number", where=str(file), got=_first_bad_word(text)) from None
    if len(values) == 0 or len(values) % columns:
        raise FormatError(
            f"{len(values)} values do not make whole records: truncated?",
            where=str(file),
            got=f"{len(values) // columns} records and {len(values) % columns} values",
            wanted=f"a multiple of {columns}",
        )
    return np.asarray(values.reshape(-1, columns))


def _first_bad_word(text: str) -> str:
    for number, word in enumerate(text.split()):
        try:
            float(word)
        except ValueError:
            return f"{word[:40]!r}, value number {number}"
    return "an unreadable number"


def _read_laser(root: Path, counter: DropCounter) -> tuple[LaserScans, int]:
    table = read_numbers(root / "LASER.txt", 1 + BEAMS)
    times, ranges = table[:, 0], table[:, 1:]
    bad = ~(np.isfinite(ranges) & (ranges > 0.0))
    where = str(root / "LASER.txt")
    keep = usable_records(
        times,
        {"no range is finite and positive": np.asarray(bad.all(axis=1))},
        stream="laser",
        where=where,
        drops=counter,
    )
    counter.drop("laser beams", "range is not finite or not positive", int(bad[keep].sum()))
    ranges = np.where(bad, np.nan, ranges)[keep] if bad.any() else ranges[keep]
    # ranges in centimetres, as in the .mat form, would all be "no return"
    if not np.any(ranges < MAX_RANGE):
        raise DataError("no beam of the whole log returned: are the ranges in metres?", where=where)
    scans = LaserScans(
        times=times[keep],
        ranges=ranges,
        bearings=BEARINGS,
        max_range=MAX_RANGE,
        T_base_sensor=np.array([*LASER_POSITION, 0.0]),
    )
    return scans, len(times)


def _read_controls(root: Path, form: str, counter: DropCounter) -> tuple[SteeringControls, int]:
    if form == "ascii":
        where = str(root / "DRS.txt")
        times, speed, steering = read_numbers(root / "DRS.txt", 3).T
    else:
        where = str(root / "aa3_dr.mat")
        milliseconds, speed, steering = _columns(where, "time", "speed", "steering")
        times = mat_seconds(milliseconds)
    keep = usable_records(
        times,
        {
            "speed or steering is not finite": ~(np.isfinite(speed) & np.isfinite(steering)),
            f"steering is beyond {_MAX_STEERING} rad": np.abs(steering) > _MAX_STEERING,
        },
        stream="controls",
        where=where,
        drops=counter,
    )
    return SteeringControls(times=times[keep], speed=speed[keep], steering=steering[keep], geometry=VEHICLE), len(times)


def _read_gps(root: Path, form: str, sigma: float, counter: DropCounter) -> tuple[Gps, int]:
    if form == "good":
        where = str(root / "GPS.txt")
        times, north, east = read_numbers(root / "GPS.txt", 3).T  # the file gives latitude first
    else:
        where = str(root / "aa3_gpsx.mat")
        milliseconds, north, east = _columns(where, "timeGps", "La_m", "Lo_m")
        times = mat_seconds(milliseconds)
        north, east = north - _MAT_ORIGIN_NORTH, east - _MAT_ORIGIN_EAST
    positions = np.stack([east, north], -1)
    keep = usable_records(
        times,
        {"position is not finite": np.asarray(~np.isfinite(positions).all(axis=1))},
        stream="gps",
        where=where,
        drops=counter,
    )
    fixes = Gps(
        times=times[keep],
        positions=positions[keep],
        sigma=np.full(int(keep.sum()), sigma),
        lever=np.array(LASER_POSITION),
    )
    return fixes, len(times)


def _columns(path: str, *names: str) -> tuple[Array, ...]:
    """Vectors of one length from a ``.mat`` file."""
    arrays = tuple(a.ravel() for a in read_mat(path, *names))
    if len({len(a) for a in arrays}) != 1:
        raise FormatError("arrays differ in length", where=path, got=[len(a) for a in arrays], wanted="one length")
    return arrays
