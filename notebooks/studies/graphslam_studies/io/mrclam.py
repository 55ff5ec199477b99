"""UTIAS multi-robot cooperative localisation and mapping (Leung, Halpern, Barfoot and Liu, 2011).

Five robots among fifteen landmarks, each an upright tube with a barcode that a camera reads at a range and a bearing.
One log a robot. The clock of odometry, measurements and Vicon is common to all of them: Unix seconds.

* ``controls``: commanded forward speed and turn rate, held from stamp to stamp, and driven a little later.
* ``landmarks``: range and bearing (positive left) of landmarks; the identity is the *subject* of the barcode, 6 to 20.
  The second column of a measurement is the barcode, whatever the header says. Measurements of one stamp are one scan.
* truth: the robot's centre by Vicon, and the surveyed landmarks, both in the Vicon frame.

What is refused and what is dropped: a file that is missing, truncated, or holds a line of another length is a
:class:`FormatError` or :class:`MissingDataError` that names file and line. Isolated bad records (not finite, repeated
or out of order, ranges that are not positive) are dropped and counted; detections of barcodes that the table does not
know, and of other robots, are dropped and counted unless asked for.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.records import LandmarkObservations, Stream, VelocityControls
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import usable_records
from graphslam.io.text_records import find_text_file, read_table

ROBOTS = 5
CONTROL_DELAY = 0.2
"""A commanded velocity is driven this much later [s]: what the bearings of landmarks in turns say, of every robot."""
RANGE_SIGMA, BEARING_SIGMA = 0.45, 0.015
"""Stated σ of a range [m] and a bearing [rad]; the recording states none. Range errors last while a barcode is looked
at from one side: they scatter by 0.15 m, and three times that covers what does not average out."""
MOST_EMPTY = 1_000_000
"""Empty scans that are put where nothing was read."""
IDLE = 0.5
"""The camera looks several times a second, but a frame in which nothing was read left no record: where that lasts
longer than this, empty scans are put in at this spacing [s], so that maps and paths can be told to have been blind."""
FIELD_OF_VIEW = (-0.6, 0.6)
"""Bearings of all measurements of the set lie inside [rad]."""
_MAX_RANGE = 9.0  # nothing in the 15 m x 8 m hall was read from farther away

Ints = npt.NDArray[np.int64]


def read_mrclam(
    folder: str | os.PathLike[str],
    *,
    robot: int | None = None,
    robots: bool = False,
    control_delay: float = CONTROL_DELAY,
    range_sigma: float = RANGE_SIGMA,
    bearing_sigma: float = BEARING_SIGMA,
    range_bias: float = 0.0,
    idle: float = IDLE,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read the log of one robot.

    Parameters
    ----------
    folder : path
        Holds ``Barcodes.dat``, ``Landmark_Groundtruth.dat`` and ``Robot<k>_Odometry.dat``, ``_Measurement.dat``,
        ``_Groundtruth.dat``, plain or compressed. Landmarks and path without truth files are a log without truth.
    robot : int, optional
        1 to 5; needed where the folder holds several.
    robots : bool
        Keep detections of other robots, as a stream ``robots`` of its own with ids 1 to 5.
    control_delay : float
        Added to the stamps of the controls [s].
    range_sigma, bearing_sigma : float
        σ put on every measurement [m], [rad].
    range_bias : float
        Subtracted from every range [m].
    idle : float
        Spacing of empty scans where nothing was read for longer [s]; ``inf`` for none. Detections of other robots are
        scans, too, with nothing in them for the stream ``landmarks``.
    name : str, optional
        The log is called ``<name>/robot<k>``; by default ``name`` is that of the folder.
    drops : DropCounter, optional
        Counts into this one, besides ``SensorLog.dropped``.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="the folder of an MRCLAM data set")
    name = name or re.sub(r"[^a-z0-9]+", "-", root.name.lower())
    there = [k for k in range(1, ROBOTS + 1) if any(root.glob(f"Robot{k}_Odometry.dat*"))]
    if robot is None and len(there) == 1:
        robot = there[0]
    if robot is None or robot not in range(1, ROBOTS + 1):
        raise ConfigError(
            f"{name} holds one log a robot, here of {', '.join(map(str, there)) or 'none'}: choose one, "
            f"--reader-option robot={there[0] if there else 1}, or of a data set {name}/robot1; got robot={robot}"
        )
    if not (range_sigma > 0 and bearing_sigma > 0 and idle > 0 and np.isfinite(range_bias + control_delay)):
        raise ConfigError(
            f"σ of range {range_sigma} and bearing {bearing_sigma}, idle {idle}, bias {range_bias}, "
            f"delay {control_delay}; wanted the first three > 0, and finite numbers"
        )
    counter = DropCounter()
    controls, n_controls = _controls(root, robot, control_delay, counter)
    table, n_measured = _measurements(root, robot, counter)
    subject = table[:, 1].astype(np.int64)
    sigma = (range_sigma, bearing_sigma)
    table[:, 2] -= range_bias
    stamps = _scan_stamps(np.unique(table[:, 0]), float(controls.times[-1]), idle, str(root))
    streams: dict[str, Stream] = {
        "controls": controls,
        "landmarks": _observations(table[subject > ROBOTS], stamps, sigma),
    }
    others = table[(subject >= 1) & (subject <= ROBOTS)]
    if robots:
        streams["robots"] = _observations(others, stamps, sigma)
    else:
        counter.drop("landmarks", "observations of other robots", len(others))
    if drops is not None:
        drops.counts.update(counter.counts)
    return SensorLog(
        name=f"{name}/robot{robot}",
        streams=streams,
        truth=_truth(root, robot, counter),
        read={"controls": n_controls, "landmarks": n_measured},
        dropped=dict(counter.counts),
        meta={
            "source": root.name,
            "robot": robot,
            "control_delay": control_delay,
            "range_sigma": range_sigma,
            "bearing_sigma": bearing_sigma,
            "range_bias": range_bias,
        },
    )


def _controls(root: Path, robot: int, delay: float, counter: DropCounter) -> tuple[VelocityControls, int]:
    path = find_text_file(root, f"Robot{robot}_Odometry.dat")
    times, speed, rate = read_table(path, 3)[0].T
    bad = {"speed or turn rate is not finite": ~(np.isfinite(speed) & np.isfinite(rate))}
    keep = usable_records(times, bad, stream="controls", where=str(path), drops=counter)
    return VelocityControls(times=times[keep] + delay, speed=speed[keep], yaw_rate=rate[keep]), len(times)


def _measurements(root: Path, robot: int, counter: DropCounter) -> tuple[Array, int]:
    """Rows stamp, subject, range, bearing in order of time, and how many were read."""
    subject_of = _barcodes(root)
    path = find_text_file(root, f"Robot{robot}_Measurement.dat")
    table, lines = read_table(path, 4)
    if len(table) == 0:
        raise DataError("holds no measurement", where=str(path), wanted="at least one")
    code = table[:, 1]
    odd = np.flatnonzero(np.isfinite(code) & (code != np.round(code)))
    if len(odd):
        k = int(odd[0])
        raise FormatError("barcode is no whole number", where=f"{path}, line {lines[k]}", got=code[k])
    # a scan has several rows of one stamp: what may not happen is that time runs backwards
    times, row_of = np.unique(table[:, 0], return_inverse=True)
    first = np.zeros(len(times), dtype=np.int64)
    first[row_of[::-1]] = np.arange(len(table))[::-1]
    in_file = np.argsort(first, kind="stable")
    keep_stamp = np.zeros(len(times), dtype=np.bool_)
    keep_stamp[in_file] = usable_records(times[in_file], {}, stream="landmarks", where=str(path), drops=counter)
    good = keep_stamp[row_of]
    for reason, bad in (
        ("range or bearing is not finite", ~np.isfinite(table[:, 1:]).all(axis=1)),
        ("range is not positive", ~(table[:, 2] > 0)),
    ):
        counter.drop("landmarks", reason, int((good & bad).sum()))
        good &= ~bad
    subject = np.array([subject_of.get(int(c), -1) if np.isfinite(c) else -1 for c in code], dtype=np.int64)
    counter.drop("landmarks", "unknown barcode", int((good & (subject < 0)).sum()))
    good &= subject >= 0
    out = np.column_stack([table[:, 0], subject, table[:, 2:]])[good]
    return out[np.argsort(out[:, 0], kind="stable")], len(table)


def _barcodes(root: Path) -> dict[int, int]:
    """Barcode → subject."""
    path = find_text_file(root, "Barcodes.dat")
    table, lines = read_table(path, 2)
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1) | (table != np.round(table)).any(axis=1))
    if len(bad):
        raise FormatError("subject or barcode is no whole number", where=f"{path}, line {lines[bad[0]]}")
    codes = table[:, 1].astype(np.int64).tolist()
    if len(set(codes)) != len(codes):
        raise FormatError("a barcode is repeated", where=str(path), wanted="each once")
    return dict(zip(codes, table[:, 0].astype(np.int64).tolist()))


def _scan_stamps(read: Array, end: float, idle: float, where: str) -> Array:
    """Stamps of frames in which something was read, and of empty ones at spacing ``idle`` where nothing was."""
    edges = np.append(read, max(end, read[-1])) if len(read) else read
    gaps = np.diff(edges)
    if np.sum(gaps[gaps > idle]) > MOST_EMPTY * idle:
        k = int(np.argmax(gaps))
        raise FormatError(
            f"nothing was read for {gaps[k]:.0f} s from {edges[k]:.3f} on: a stamp is wrong, or of another clock",
            where=where,
            wanted=f"at most {MOST_EMPTY:,} empty scans, one every {idle:g} s",
        )
    extra = [a + idle * np.arange(1, np.ceil(g / idle)) for a, g in zip(edges[:-1], gaps) if g > idle]
    return np.unique(np.concatenate([read, *extra]))


def _observations(table: Array, stamps: Array, sigma: tuple[float, float]) -> LandmarkObservations:
    """Rows stamp, subject, range, bearing, in order of time, as scans at ``stamps``."""
    return LandmarkObservations(
        times=stamps,
        offsets=np.append(np.searchsorted(table[:, 0], stamps), len(table)).astype(np.int64),
        ranges=table[:, 2],
        bearings=table[:, 3],
        sigmas=np.tile(sigma, (len(table), 1)),
        ids=table[:, 1].astype(np.int64),
        max_range=_MAX_RANGE,
        field_of_view=FIELD_OF_VIEW,
    )


def _truth(root: Path, robot: int, counter: DropCounter) -> Truth | None:
    """Vicon path and surveyed landmarks; None where either file is not there."""
    try:
        path = find_text_file(root, f"Robot{robot}_Groundtruth.dat")
        surveyed = find_text_file(root, "Landmark_Groundtruth.dat")
    except MissingDataError:
        return None
    table = read_table(path, 4)[0]
    bad = {"pose is not finite": np.asarray(~np.isfinite(table[:, 1:]).all(axis=1))}
    keep = usable_records(table[:, 0], bad, stream="truth", where=str(path), drops=counter)
    marks, lines = read_table(surveyed, 5)
    wrong = np.flatnonzero(~np.isfinite(marks).all(axis=1))
    if len(wrong):
        raise FormatError("landmark is not finite", where=f"{surveyed}, line {lines[wrong[0]]}")
    return Truth(
        trajectory=Trajectory(table[keep, 0], table[keep, 1:]),
        landmark_ids=marks[:, 0].astype(np.int64),
        landmarks=marks[:, 1:3],
    )
