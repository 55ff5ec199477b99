"""Local maps drawn from their own covariance: chains of any length for the joiners, without running a filter.

The vehicle of the landmark field drives two laps, so that every feature of the second half is an old one. Every
submap's joint covariance is that of the smoother of its own scans and controls, linearised at the truth, and its error
is drawn from exactly that covariance: what the joiners are given is consistent by construction, and shaped like a real
local map (correlated through heading, the better the nearer).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, se2_between, wrap_angle
from graphslam.core.map_truth import MapTruth
from graphslam.core.random import SeedTree
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.sim.landmark_field import (
    LandmarkFieldConfig,
    landmark_field_preset,
    landmark_layout,
    visible_landmarks,
)
from graphslam.sim.vehicle import follow_route


def local_map_world(count: int, *, scans: int = 59, preset: str = "A") -> LandmarkFieldConfig:
    """A landmark field in which ``count`` submaps of ``scans`` scans make two laps, as dense with features as the
    preset.
    """
    if count < 2 or scans < 1:
        raise ConfigError(f"{count} local maps of {scans} scans; wanted at least 2 of at least 1")
    base = landmark_field_preset(preset)
    lap = count * scans * base.speed / base.scan_rate / 2.0
    density = base.landmarks / base.lap_length
    return dataclasses.replace(base, lap_length=lap, laps=2.0, landmarks=max(1, round(density * lap)))


def simulate_local_maps(
    count: int, seed: int, *, scans: int = 59, config: LandmarkFieldConfig | None = None
) -> tuple[list[Submap], MapTruth]:
    """A chain of local maps and its truth.

    Parameters
    ----------
    count : int
        Submaps.
    seed : int
        Layout and errors hang from branches of their own; the layout from ``config.layout_seed`` where that is set.
    scans : int
        Scans of every submap; the last one is taken at its end.
    config : LandmarkFieldConfig, optional
        Default: :func:`local_map_world`.

    Returns
    -------
    submaps : list of Submap
        Keys from 0, landmarks with their true ids in the order of ids, intervals [s].
    truth : MapTruth
        In the frame of the first base.
    """
    c = config or local_map_world(count, scans=scans)
    steps = count * scans * c.scan_stride
    route, landmarks = landmark_layout(c, seed)
    if steps > c.steps + c.scan_stride:
        raise ConfigError(f"{count} local maps need {steps} control steps, the vehicle drives {c.steps}")
    dt = 1.0 / c.control_rate
    poses, steering = follow_route(
        route, steps, speed=c.speed, dt=dt, wheelbase=c.wheelbase, max_steering=c.max_steering,
        steering_rate=c.steering_rate, look_ahead=c.look_ahead,
    )  # fmt: skip
    at_scan = poses[:: c.scan_stride]
    scan, feature, *_ = visible_landmarks(c, at_scan[1:], landmarks)
    order = np.lexsort((feature, scan))
    scan, feature = scan[order], feature[order]
    bounds = np.searchsorted(scan, scans * np.arange(count + 1))
    motion = _motion_noise(c, poses[:-1, 2].reshape(-1, c.scan_stride), steering.reshape(-1, c.scan_stride))
    errors = SeedTree(seed).child("local-maps")
    submaps = []
    for k in range(count):
        own = slice(bounds[k], bounds[k + 1])
        path = at_scan[k * scans : (k + 1) * scans + 1]
        ids, entry = np.unique(feature[own], return_inverse=True)
        local = se2_between(path[0], path)
        points = se2_between(path[0], np.column_stack([landmarks[ids], np.zeros(len(ids))]))[:, :2]
        turn = _turn(path[0, 2])
        Q = turn.T @ motion[k * scans : (k + 1) * scans] @ turn
        P = _smoother_covariance(c, local, Q, points, scan[own] - k * scans, entry)
        z = np.concatenate([local[-1], points.ravel()])
        z = z + np.linalg.cholesky(P) @ errors.child(k).generator().standard_normal(len(z))
        z[2] = wrap_angle(z[2])
        local_map = LandmarkMap(ids=ids.astype(np.int64), exit_pose=z[:3], positions=z[3:].reshape(-1, 2), covariance=P)
        seconds = scans / c.scan_rate
        submaps.append(Submap.from_landmarks(k, local_map, interval=(k * seconds, (k + 1) * seconds)))
    known = np.unique(feature)
    truth = MapTruth(
        keys=np.arange(count),
        exit_poses=at_scan[scans::scans][:count],
        landmark_ids=known.astype(np.int64),
        landmarks=landmarks[known],
    )
    return submaps, truth


def _turn(heading: float) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _motion_noise(c: LandmarkFieldConfig, heading: Array, steering: Array) -> Array:
    """Covariance ``(scans, 3, 3)`` of the motion between scans from the noise of the controls, in world axes."""
    dt = 1.0 / c.control_rate
    n, stride = heading.shape
    Q = np.zeros((n, 3, 3))
    for k in range(stride):
        direction = heading[:, k] + steering[:, k]
        cos, sin = c.speed * dt * np.cos(direction), c.speed * dt * np.sin(direction)
        F = np.tile(np.eye(3), (n, 1, 1))
        F[:, 0, 2], F[:, 1, 2] = -sin, cos
        G = np.zeros((n, 3, 2))
        G[:, 0, 0], G[:, 1, 0] = cos / c.speed, sin / c.speed
        G[:, 2, 0] = dt * np.sin(steering[:, k]) / c.wheelbase
        G[:, 0, 1], G[:, 1, 1] = -sin, cos
        G[:, 2, 1] = c.speed * dt * np.cos(steering[:, k]) / c.wheelbase
        G *= np.array([c.sigma_speed, c.sigma_steering])
        Q = F @ Q @ F.swapaxes(1, 2) + G @ G.swapaxes(1, 2)
    return Q


def _smoother_covariance(
    c: LandmarkFieldConfig, path: Array, Q: Array, points: Array, scan: np.ndarray, entry: np.ndarray
) -> Array:
    """Joint covariance of the last pose and the features, all inner poses integrated out.

    Parameters
    ----------
    path : (s + 1, 3)
        Base (fixed), then the pose of every scan.
    Q : (s, 3, 3)
        Covariance of the motion to each scan.
    points : (n, 2)
    scan, entry : (o,)
        Which scan saw which feature.
    """
    s, n = len(Q), len(points)
    size = 3 * s + 2 * n
    A = np.zeros((size, size))
    omega = np.linalg.inv(Q)
    step = path[1:, :2] - path[:-1, :2]
    F = np.tile(np.eye(3), (s, 1, 1))
    F[:, 0, 2], F[:, 1, 2] = -step[:, 1], step[:, 0]
    back = -F.swapaxes(1, 2) @ omega  # pose j - 1 against pose j
    blocks = A[: 3 * s, : 3 * s].reshape(s, 3, s, 3)
    j = np.arange(s)
    blocks[j, :, j, :] += omega
    blocks[j[:-1], :, j[:-1], :] -= back[1:] @ F[1:]
    blocks[j[:-1], :, j[1:], :] += back[1:]
    blocks[j[1:], :, j[:-1], :] += back[1:].swapaxes(1, 2)
    d = points[entry] - path[1 + scan, :2]
    r = np.hypot(d[:, 0], d[:, 1])
    J = np.zeros((len(scan), 2, 5))  # range and bearing against pose and feature, whitened
    J[:, 0, 0], J[:, 0, 1] = -d[:, 0] / r, -d[:, 1] / r
    J[:, 1, 0], J[:, 1, 1], J[:, 1, 2] = d[:, 1] / r**2, -d[:, 0] / r**2, -1.0
    J[:, :, 3:] = -J[:, :, :2]
    J /= np.array([c.sigma_range, c.sigma_bearing])[:, None]
    H = J.swapaxes(1, 2) @ J
    at = np.concatenate([3 * scan[:, None] + np.arange(3), 3 * s + 2 * entry[:, None] + np.arange(2)], axis=1)
    np.add.at(A, (at[:, :, None], at[:, None, :]), H)
    kept = np.arange(3 * s - 3, size)
    unit = np.zeros((size, len(kept)))
    unit[kept, np.arange(len(kept))] = 1.0
    P = cho_solve(cho_factor(A, lower=True, check_finite=False), unit, check_finite=False)[kept]
    return np.asarray(0.5 * (P + P.T))
