"""Plaza: a lawn mower with ultra-wide-band ranging to four beacons (Djugash, Hamner and Roth, 2009).

* ``controls``: speed and yaw rate. The recording holds distance and heading change since the record before; divided by
  the time between, they are held over *that* interval, so that a control stands at the beginning of what it moved.
* ``landmarks``: ranges to the beacons, without bearings; the identity is the beacon's number. The ranges are too long
  by metres (antenna delay) and have multipath outliers; nothing is corrected here unless asked for. The file holds
  three stretches that overlap in time by a minute; every stamp is right, so ranges are put in order of time.
* truth, where the ``.mat`` file is there: position by RTK GPS and surveyed beacons. Its headings are not independent of
  the log: they are the sums of the recorded heading changes, so a heading error against this truth says little.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.reading import integer_mask
from graphslam.core.records import LandmarkObservations, VelocityControls
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import MAX_DROPPED, usable_records
from graphslam.io.text_records import find_text_file, read_table
from graphslam_studies.io.mat import read_mat

RANGE_SIGMA = 1.5
"""Stated σ of a range [m]; the recording states none."""
_LONGEST_STEP = 1.0  # [s]; a longer time between two records is a gap, over which no speed is known


def read_plaza(
    folder: str | os.PathLike[str],
    *,
    prefix: str | None = None,
    range_sigma: float = RANGE_SIGMA,
    range_bias: float = 0.0,
    name: str | None = None,
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read the log.

    Parameters
    ----------
    folder : path
        Holds ``<prefix>_DR.txt`` and ``<prefix>_TD.txt`` (plain or compressed), and ``<prefix>_.mat`` for the truth.
    prefix : str, optional
        By default that of the one file ``*_DR.txt``.
    range_sigma : float
        σ put on every range [m].
    range_bias : float
        Subtracted from every range [m]; what is not positive then is dropped and counted.
    name : str, optional
        Of the log; the prefix in small letters by default.
    drops : DropCounter, optional
        Counts into this one, besides ``SensorLog.dropped``.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="the folder of a Plaza data set")
    if not (range_sigma > 0 and np.isfinite(range_bias)):
        raise ConfigError(f"range_sigma = {range_sigma}, range_bias = {range_bias}; wanted σ > 0 and a finite bias")
    if prefix is None:
        found = sorted({p.name.partition("_DR.txt")[0] for p in root.glob("*_DR.txt*")})
        if len(found) != 1:
            raise MissingDataError(
                f"{len(found)} logs here", where=str(root), got=", ".join(found) or None, wanted="option prefix"
            )
        prefix = found[0]
    name = name or prefix.lower()
    counter = DropCounter()
    truth = _truth(root / f"{prefix}_.mat", counter)
    controls, n_controls = _controls(find_text_file(root, f"{prefix}_DR.txt"), truth, counter)
    span = float(controls.times[0]), float(controls.times[-1])
    ranges, n_ranges = _ranges(find_text_file(root, f"{prefix}_TD.txt"), span, range_sigma, range_bias, counter)
    if drops is not None:
        drops.counts.update(counter.counts)
    return SensorLog(
        name=name,
        streams={"controls": controls, "landmarks": ranges},
        truth=truth,
        read={"controls": n_controls, "landmarks": n_ranges},
        dropped=dict(counter.counts),
        meta={"source": root.name, "range_sigma": range_sigma, "range_bias": range_bias},
    )


def _controls(path: Path, truth: Truth | None, counter: DropCounter) -> tuple[VelocityControls, int]:
    """Speed and yaw rate over the interval *before* each stamp; zero from the last stamp on."""
    table = read_table(path, 3)[0]
    bad = {"distance or heading change is not finite": np.asarray(~np.isfinite(table[:, 1:]).all(axis=1))}
    keep = usable_records(table[:, 0], bad, stream="controls", where=str(path), drops=counter)
    times, moved = table[keep, 0], table[keep, 1:]
    if len(times) < 2:
        raise DataError("holds too few records", where=str(path), got=len(times), wanted="at least 2")
    # The first record says how far it went since a stamp that only the truth knows; else one usual step before.
    first = times[0] - float(np.median(np.diff(times)))
    if truth is not None and 0 < times[0] - truth.trajectory.times[0] < _LONGEST_STEP:
        first = float(truth.trajectory.times[0])
    stamps = np.concatenate([[first], times])
    dt = np.diff(stamps)
    counter.drop(
        "controls", f"gap longer than {_LONGEST_STEP:g} s bridged at constant speed", int((dt > _LONGEST_STEP).sum())
    )
    speed = np.append(moved[:, 0] / dt, 0.0)
    rate = np.append(moved[:, 1] / dt, 0.0)
    return VelocityControls(times=stamps, speed=speed, yaw_rate=rate), len(table)


def _ranges(
    path: Path, span: tuple[float, float], sigma: float, bias: float, counter: DropCounter
) -> tuple[LandmarkObservations, int]:
    """Ranges in order of time; two of one stamp are one scan."""
    table, lines = read_table(path, 4)
    if len(table) == 0:
        raise DataError("holds no range", where=str(path), wanted="at least one")
    beacon = table[:, 2]
    odd = np.flatnonzero(np.isfinite(beacon) & ((beacon != np.round(beacon)) | (beacon < 0)))
    if len(odd):
        raise FormatError("beacon has no number", where=f"{path}, line {lines[odd[0]]}", got=beacon[odd[0]])
    corrected = table[:, 3] - bias
    good = np.ones(len(table), dtype=np.bool_)
    for reason, wrong in (
        ("stamp, beacon or range is not finite", ~np.isfinite(table).all(axis=1)),
        ("stamp outside the time of the controls", ~((span[0] <= table[:, 0]) & (table[:, 0] <= span[1]))),
        ("range is not positive", ~(corrected > 0)),
    ):
        counter.drop("landmarks", reason, int((good & wrong).sum()))
        good &= ~wrong
    if (~good).sum() > MAX_DROPPED * len(table):
        first = int(lines[np.flatnonzero(~good)[0]])
        raise DataError(
            f"{int((~good).sum())} of {len(table)} ranges are unusable",
            where=f"{path}, first at line {first}",
            got=dict(counter.counts),
            wanted=f"at most {MAX_DROPPED:.0%} of bad records",
        )
    rows = np.flatnonzero(good)
    rows = rows[np.argsort(table[rows, 0], kind="stable")]
    stamps, start = np.unique(table[rows, 0], return_index=True)
    return LandmarkObservations.range_only(
        times=stamps,
        offsets=np.append(start, len(rows)).astype(np.int64),
        ranges=corrected[rows],
        range_sigma=sigma,
        ids=beacon[rows].astype(np.int64),
    ), len(table)


def _truth(path: Path, counter: DropCounter) -> Truth | None:
    """RTK positions with the log's own headings, and the surveyed beacons; None without the file."""
    if not path.is_file():
        return None
    poses, beacons = read_mat(path, "GT", "TL")
    for array, columns, what in ((poses, 4, "GT"), (beacons, 3, "TL")):
        if array.ndim != 2 or array.shape[1] != columns:
            raise FormatError(f"{what} has the wrong shape", where=str(path), got=array.shape, wanted=f"(n, {columns})")
    wrong = np.flatnonzero(~(integer_mask(beacons[:, 0]) & np.isfinite(beacons[:, 1:]).all(axis=1)))
    if len(wrong):
        raise FormatError(
            f"row {wrong[0]} of TL is no beacon", where=str(path), got=beacons[wrong[0]], wanted="id, x, y"
        )
    bad = {"pose is not finite": np.asarray(~np.isfinite(poses[:, 1:]).all(axis=1))}
    keep = usable_records(poses[:, 0], bad, stream="truth", where=str(path), drops=counter)
    xyt: Array = np.column_stack([poses[keep, 1:3], wrap_angle(poses[keep, 3])])
    order = np.argsort(beacons[:, 0])
    return Truth(
        trajectory=Trajectory(poses[keep, 0], xyt),
        landmark_ids=beacons[order, 0].astype(np.int64),
        landmarks=beacons[order, 1:],
    )
