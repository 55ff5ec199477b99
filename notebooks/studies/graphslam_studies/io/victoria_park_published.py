"""What others published from the Victoria Park log: tree detections, and the input of a large-scale SLAM.

* UFastSLAM (Kim, Sakthivel, Chung, IEEE T-RO 24(4), 2008): range and bearing of trunks, without identities.
* 2D I-SLSJF (Huang, Wang, Dissanayake, IEEE T-RO 24(5), 2008): range, bearing and identity, and the same as a
  network of relative poses and Cartesian observations with covariances.

Bearings are turned to straight ahead, and stamps to the clock of :mod:`graphslam_studies.io.victoria_park`.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, FormatError
from graphslam.core.geometry import Array, vector_to_tangent_covariance, wrap_angle
from graphslam.core.log import DropCounter
from graphslam.core.network import PoseNetwork
from graphslam.core.reading import integer_mask
from graphslam.core.records import LandmarkObservations
from graphslam.io.catalog import load_recording
from graphslam.io.clock import MAX_DROPPED, usable_records
from graphslam_studies.evaluate.information import information_matrices
from graphslam_studies.io.mat import read_mat
from graphslam_studies.io.victoria_park import LASER_POSITION, mat_seconds, read_numbers

SLSJF_LANDMARK_OFFSET = 1_000_000
"""Added to feature ids in :func:`read_slsjf_network`, whose poses and landmarks share one space of ids."""
_UFASTSLAM_SLOTS = 18  # columns of the padded tables
_MAX_RANGE = 80.0
SAME_RANGE, SAME_BEARING, SAME_TIME = 0.3, float(np.deg2rad(0.5)), 0.005
"""Largest differences between two detections of one trunk in one scan [m, rad, s]."""


def read_ufastslam_detections(
    folder: str | os.PathLike[str],
    *,
    range_sigma: float = 0.1,
    bearing_sigma: float = float(np.deg2rad(1.0)),
    drops: DropCounter | None = None,
) -> LandmarkObservations:
    """The 52,974 trunk detections of UFastSLAM, one entry for each of the 7,249 scans of ``aa3_lsr2.mat``.

    Parameters
    ----------
    folder : path
        Holds ``ufastslam_ObservationDistance.txt``, ``…Angle_90.txt`` and ``ufastslam_lasersampling.txt``
        (plain or ``.gz``).
    range_sigma, bearing_sigma : float
        The files state none; the defaults are those usual for this log [m, rad].
    """
    root = Path(folder)
    distance = read_numbers(root / "ufastslam_ObservationDistance.txt", _UFASTSLAM_SLOTS)
    bearing = read_numbers(root / "ufastslam_ObservationAngle_90.txt", _UFASTSLAM_SLOTS)
    times = mat_seconds(read_numbers(root / "ufastslam_lasersampling.txt", 1)[:, 0])
    if not len(distance) == len(bearing) == len(times):
        raise FormatError(
            "the three tables differ in length: truncated?",
            where=str(root),
            got=[len(distance), len(bearing), len(times)],
            wanted="one row a scan",
        )
    counter = drops if drops is not None else DropCounter()
    keep = usable_records(times, {}, stream="detections", where=str(root), drops=counter)
    times, distance, bearing = times[keep], distance[keep], bearing[keep]
    present = distance != 0.0  # zero pads a row
    bad = present & ~(np.isfinite(distance) & np.isfinite(bearing) & (distance > 0.0))
    _count_bad(bad[present], "detections", "range or bearing is impossible", counter, root)
    present &= ~bad
    offsets = np.concatenate([[0], np.cumsum(present.sum(axis=1))]).astype(np.int64)
    return _observations(times, offsets, distance[present], bearing[present], None, range_sigma, bearing_sigma)


def read_slsjf_observations(
    folder: str | os.PathLike[str],
    *,
    range_sigma: float = 0.1,
    bearing_sigma: float = float(np.deg2rad(1.0)),
    drops: DropCounter | None = None,
) -> LandmarkObservations:
    """The 46,860 range–bearing observations of 299 trees with the identities that 2D I-SLSJF was given.

    Only the 7,122 scans in which a tree was kept have an entry. Observations marked −1 (ignore) are dropped and
    counted; the published file has none.

    Parameters
    ----------
    folder : path
        Holds ``slsjf_data_sensor_clean_clean.mat``.
    range_sigma, bearing_sigma : float
        The file states none [m, rad].
    """
    path = Path(folder) / "slsjf_data_sensor_clean_clean.mat"
    (table,) = read_mat(path, "data_sensor_clean_clean")
    if table.ndim != 2 or table.shape[1] != 6:
        raise FormatError("wrong number of columns", where=str(path), got=table.shape, wanted="(n, 6)")
    counter = drops if drops is not None else DropCounter()
    bad = ~np.isfinite(table[:, :3]).all(axis=1) | ~(table[:, 1] > 0.0) | ~integer_mask(table[:, 5])
    _count_bad(bad, "observations", "time, range, bearing or id is impossible", counter, path)
    ignored = ~bad & (table[:, 5] < 0)
    counter.drop("observations", "marked as poor", int(ignored.sum()))
    table = table[~bad & ~ignored]
    times, counts = _runs(mat_seconds(table[:, 0]), path)
    return _observations(
        times,
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        table[:, 1],
        table[:, 2] - np.pi / 2,  # from the right to straight ahead
        table[:, 5].astype(np.int64),
        range_sigma,
        bearing_sigma,
    )


def read_slsjf_network(folder: str | os.PathLike[str]) -> PoseNetwork:
    """2D I-SLSJF's input as a network: 6,898 relative poses and 45,390 Cartesian observations of 299 trees.

    Pose ids are the file's 0 … 6898; landmark ids are feature ids plus :data:`SLSJF_LANDMARK_OFFSET`. Positions are in
    the rear-axle frame of the observing pose, observation noise in that frame. The covariance of (dx, dy, dφ), which
    the file gives in the frame of the start pose, becomes that of the right tangent. No initial values.

    Parameters
    ----------
    folder : path
        Holds ``slsjf_VicPark_clean_data.mat``.
    """
    path = Path(folder) / "slsjf_VicPark_clean_data.mat"
    (table,) = read_mat(path, "VicPark_clean_data")
    if table.ndim != 2 or table.shape[1] != 12:
        raise FormatError("wrong number of columns", where=str(path), got=table.shape, wanted="(n, 12)")
    good = np.isfinite(table).all(axis=1) & np.isin(table[:, 0], (0.0, 1.0)) & integer_mask(table[:, 1:3]).all(axis=1)
    if not good.all():
        k = int(np.flatnonzero(~good)[0])
        raise FormatError(f"row {k} is neither odometry nor an observation", where=str(path), got=table[k])
    odometry, seen = table[table[:, 0] == 1.0], table[table[:, 0] == 0.0]
    if len(odometry) == 0:
        raise FormatError("holds no odometry", where=str(path), wanted="rows that begin with 1")
    P = _symmetric(odometry[:, 6:12], 3)
    tangent = np.stack([vector_to_tangent_covariance(z, C) for z, C in zip(odometry[:, 3:6], P)])
    Q = _symmetric(seen[:, 5:8], 2)
    pose_ids = np.unique(np.concatenate([odometry[:, 1], odometry[:, 2], seen[:, 1]])).astype(np.int64)
    feature_ids = np.unique(seen[:, 2]).astype(np.int64)

    def index(values: Array, names: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
        return np.searchsorted(names, values.astype(np.int64))

    return PoseNetwork(
        dim=2,
        ids=pose_ids,
        poses=np.zeros((len(pose_ids), 3)),
        has_initial=np.zeros(len(pose_ids), dtype=np.bool_),
        edges=np.stack([index(odometry[:, 1], pose_ids), index(odometry[:, 2], pose_ids)], -1),
        measurements=odometry[:, 3:6],
        information=information_matrices(tangent, str(path)),
        landmark_ids=feature_ids + SLSJF_LANDMARK_OFFSET,
        landmarks=np.zeros((len(feature_ids), 2)),
        has_landmark=np.zeros(len(feature_ids), dtype=np.bool_),
        observations=np.stack([index(seen[:, 1], pose_ids), index(seen[:, 2], feature_ids)], -1),
        observation_values=seen[:, 3:5],
        observation_information=information_matrices(Q, str(path)),
        observation_kind="cartesian",
        noise="covariance of (dx, dy, dφ), turned to the right tangent",
        source=path.name,
    )


def _symmetric(upper: Array, d: int) -> Array:
    """Matrices ``(n, d, d)`` from their upper triangles ``(n, d (d + 1) / 2)``, row by row."""
    out = np.empty((len(upper), d, d))
    i, j = np.triu_indices(d)
    out[:, i, j] = out[:, j, i] = upper
    return out


def _runs(times: Array, path: Path) -> tuple[Array, npt.NDArray[np.int64]]:
    """Distinct stamps and how many rows each has; rows of one stamp stand together."""
    if len(times) == 0:
        raise DataError("holds no observation", where=str(path))
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        k = int(back[0]) + 1
        raise DataError(f"time goes backwards at row {k}", where=str(path), got=f"{times[k]} after {times[k - 1]}")
    distinct, counts = np.unique(times, return_counts=True)
    return distinct, counts.astype(np.int64)


def _count_bad(bad: npt.NDArray[np.bool_], stream: str, reason: str, counter: DropCounter, where: Path) -> None:
    if len(bad) and bad.mean() > MAX_DROPPED:
        raise DataError(
            f"{int(bad.sum())} of {len(bad)} {stream} are unusable: {reason}",
            where=str(where),
            wanted=f"at most {MAX_DROPPED:.0%}",
        )
    counter.drop(stream, reason, int(bad.sum()))


def _observations(
    times: Array,
    offsets: npt.NDArray[np.int64],
    ranges: Array,
    bearings: Array,
    ids: npt.NDArray[np.int64] | None,
    range_sigma: float,
    bearing_sigma: float,
) -> LandmarkObservations:
    if not (range_sigma > 0 and bearing_sigma > 0):
        raise ConfigError(f"range_sigma = {range_sigma}, bearing_sigma = {bearing_sigma}; wanted > 0")
    return LandmarkObservations(
        times=times,
        offsets=offsets,
        ranges=ranges,
        bearings=bearings,
        sigmas=np.tile([range_sigma, bearing_sigma], (len(ranges), 1)),
        ids=ids,
        max_range=_MAX_RANGE,
        field_of_view=(-np.pi / 2, np.pi / 2),
        T_base_sensor=np.array([*LASER_POSITION, 0.0]),
    )


def published_identities(observations: LandmarkObservations) -> npt.NDArray[np.int64]:
    """Identity in the input of I-SLSJF of every observation of a detector on this log ``(n,)``; -1 = none."""
    published: LandmarkObservations = load_recording("victoria-park-detections", reader="slsjf-observations")
    assert published.ids is not None
    rows = match_observations(observations, published)
    return np.where(rows >= 0, published.ids[rows], -1)


def match_observations(observations: LandmarkObservations, reference: LandmarkObservations) -> npt.NDArray[np.int64]:
    """Row of the reference for every observation ``(n,)``, -1 where there is none.

    Within one scan the nearest pairs (each difference divided by its gate) are taken first, every row at most once.
    """
    times, reference_times = (np.repeat(z.times, np.diff(z.offsets)) for z in (observations, reference))
    out = np.full(len(times), -1, dtype=np.int64)
    lo = np.searchsorted(reference_times, times - SAME_TIME, "left")
    span = np.searchsorted(reference_times, times + SAME_TIME, "right") - lo
    i = np.repeat(np.arange(len(times)), span)
    j = np.arange(span.sum()) - np.repeat(np.cumsum(span) - span, span) + np.repeat(lo, span)
    dr = np.abs(observations.ranges[i] - reference.ranges[j]) / SAME_RANGE
    db = np.abs(wrap_angle(observations.bearings[i] - reference.bearings[j])) / SAME_BEARING
    ok = (dr <= 1) & (db <= 1)
    i, j, cost = i[ok], j[ok], np.hypot(dr[ok], db[ok])
    used: set[int] = set()
    for k in np.argsort(cost, kind="stable"):
        a, b = int(i[k]), int(j[k])
        if out[a] < 0 and b not in used:
            out[a] = b
            used.add(b)
    return out
