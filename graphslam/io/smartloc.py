"""smartLoc: raw pseudoranges, wheels and gyro of a car among high buildings, and its surveyed path.

* ``pseudoranges``: of GPS and GLONASS. Numbers of satellites of other systems than GPS are told apart by their system.
* ``odometry``: increments in space from one record to the next, made of the body's velocity and turn rate, which hold
  from each stamp to the next, with the variances that the file states.
* ``reference``: surveyed positions of the car, in the tangent plane (east, north, up) at the first of them; the
  attitudes in it are not known and stand for nothing. Heights are those of the file, whose zero is not that of the
  satellites (here they differ by tens of metres).

``meta["plane"]`` is latitude, longitude [deg] and height [m] of that plane.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from graphslam.core.errors import DataError, FormatError, MissingDataError
from graphslam.core.geodesy import ecef_to_geodetic
from graphslam.core.geometry import Array
from graphslam.core.gnss import Pseudoranges, TangentPlane
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.poses import SE3
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import Odometry
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import MAX_DROPPED, usable_records
from graphslam.io.text_records import Records, Rows, find_text_file

INPUT, TRUTH = "Berlin_Potsdamer_Platz_Input.txt", "Berlin_Potsdamer_Platz_GT.txt"
_SURFACE = (6.2e6, 6.5e6)  # distance of places near the ground from the Earth's centre [m]
_ORBIT = (1e7, 1e8)  # … of satellites
_SYSTEMS = (1, 2, 4, 8, 16, 32)
_LONGEST_STEP = 1.0  # [s]


def read_smartloc(
    folder: str | os.PathLike[str], *, name: str = "smartloc-gnss", drops: DropCounter | None = None
) -> SensorLog:
    """Read the log.

    Parameters
    ----------
    folder : path
        Holds the two text files, plain or compressed.
    name : str
        Of the log.
    drops : DropCounter, optional
        Counts into this one, besides ``SensorLog.dropped``.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="the folder of the smartLoc data set")
    counter = DropCounter()
    source, surveyed = find_text_file(root, INPUT), find_text_file(root, TRUTH)
    rows = Records(source, read_text(source), {"odom3": (0, 13), "pseudorange3": (0, 10)}).rows
    points = Records(surveyed, read_text(surveyed), {"point3": (0, 13)}).rows["point3"]
    odometry = _odometry(rows["odom3"], str(source), counter)
    ranges = _pseudoranges(rows["pseudorange3"], str(source), counter)
    reference, plane = _reference(points, str(surveyed), counter)
    if drops is not None:
        drops.counts.update(counter.counts)
    return SensorLog(
        name=name,
        streams={"pseudoranges": ranges, "odometry": odometry, "reference": reference},
        read={"pseudoranges": len(rows["pseudorange3"]), "odometry": len(rows["odom3"]), "reference": len(points)},
        dropped=dict(counter.counts),
        meta={"source": root.name, "plane": [plane.latitude, plane.longitude, plane.height]},
    )


def _odometry(rows: Rows, where: str, counter: DropCounter) -> Odometry:
    """Increments over the time *after* each record, standing at the next one."""
    a = rows.real
    bad = {
        "a velocity is not finite": np.asarray(~finite_mask(a[:, 1:7]).all(axis=1)),
        "a variance is not positive": np.asarray(~(finite_mask(a[:, 7:]) & (a[:, 7:] > 0)).all(axis=1)),
    }
    a = a[usable_records(a[:, 0], bad, stream="odometry", where=where, drops=counter)]
    if len(a) < 2:
        raise DataError("holds too few records of the odometry", where=where, got=len(a), wanted="at least 2")
    dt = np.diff(a[:, 0])[:, None]
    counter.drop(
        "odometry", f"gap longer than {_LONGEST_STEP:g} s bridged at constant speed", int((dt > _LONGEST_STEP).sum())
    )
    twist = np.concatenate([a[:-1, 4:7], a[:-1, 1:4]], axis=1) * dt  # right tangents: rotation first
    variance = np.concatenate([a[:-1, 10:13], a[:-1, 7:10]], axis=1) * dt**2
    increments = np.concatenate([SE3.identity[None], SE3.exp(twist)])
    variance = np.concatenate([variance[:1], variance])
    return Odometry(times=a[:, 0], increments=increments, covariances=variance[:, :, None] * np.eye(6))


def _pseudoranges(rows: Rows, where: str, counter: DropCounter) -> Pseudoranges:
    a = rows.real
    if len(a) == 0:
        raise DataError("holds no pseudorange", where=where, wanted="at least one")
    distance = np.linalg.norm(np.where(finite_mask(a[:, 3:6]), a[:, 3:6], 0.0), axis=1)
    whole = np.isfinite(a[:, 6:8]).all(axis=1)
    whole &= (np.round(np.where(np.isfinite(a[:, 6:8]), a[:, 6:8], -1.0)) == a[:, 6:8]).all(axis=1)
    good = np.ones(len(a), dtype=np.bool_)
    for reason, wrong in (
        ("a number is not finite", ~finite_mask(a).all(axis=1)),
        ("variance is not positive", ~(a[:, 2] > 0)),
        ("no number of a satellite", ~(whole & (a[:, 6] >= 0) & (a[:, 6] < 1e6) & np.isin(a[:, 7], _SYSTEMS))),
        ("satellite is not in an orbit", ~((_ORBIT[0] < distance) & (distance < _ORBIT[1]))),
        (
            "elevation or carrier-to-noise ratio is impossible",
            ~((abs(a[:, 8]) <= 90) & (a[:, 9] > 0) & (a[:, 9] < 100)),
        ),
        ("the same satellite twice at one epoch", _again(a[:, [0, 6, 7]])),
    ):
        counter.drop("pseudoranges", reason, int((good & wrong).sum()))
        good &= ~wrong
    if (~good).sum() > MAX_DROPPED * len(a):
        first = int(rows.lines[np.flatnonzero(~good)[0]])
        raise DataError(
            f"{int((~good).sum())} of {len(a)} pseudoranges are unusable",
            where=f"{where}, first at line {first}",
            got=dict(counter.counts),
            wanted=f"at most {MAX_DROPPED:.0%} of bad records",
        )
    a = a[good]
    a = a[np.argsort(a[:, 0], kind="stable")]
    times, start = np.unique(a[:, 0], return_index=True)
    return Pseudoranges(
        times=times,
        offsets=np.append(start, len(a)).astype(np.int64),
        ranges=a[:, 1],
        sigmas=np.sqrt(a[:, 2]),
        satellites=a[:, 3:6],
        ids=a[:, 6].astype(np.int64),
        systems=a[:, 7].astype(np.int64),
        elevation=np.deg2rad(a[:, 8]),
        density=a[:, 9],
    )


def _again(keys: Array) -> np.ndarray:
    """Rows that are there before ``(n,)``."""
    _, first = np.unique(keys, axis=0, return_index=True)
    again = np.ones(len(keys), dtype=np.bool_)
    again[first] = False
    return again


def _reference(rows: Rows, where: str, counter: DropCounter) -> tuple[Trajectory, TangentPlane]:
    a = rows.real
    radius = np.linalg.norm(np.where(finite_mask(a[:, 1:4]), a[:, 1:4], 0.0), axis=1)
    bad = {
        "position is not finite": np.asarray(~finite_mask(a[:, 1:4]).all(axis=1)),
        "position is not on the ground": np.asarray(~((_SURFACE[0] < radius) & (radius < _SURFACE[1]))),
    }
    a = a[usable_records(a[:, 0], bad, stream="reference", where=where, drops=counter)]
    if len(a) == 0:
        raise FormatError("holds no position", where=where, wanted="at least one")
    plane = TangentPlane(*ecef_to_geodetic(a[0, 1:4]).tolist())
    poses = np.tile(SE3.identity, (len(a), 1))
    poses[:, :3] = plane.from_ecef(a[:, 1:4])
    return Trajectory(a[:, 0], poses), plane
