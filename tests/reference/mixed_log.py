"""A small planar log with everything: a robot drives round a ring, through a building on one side, among trees on the
other; a laser, landmark observations, velocities, GPS outdoors."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import se2_between, se2_compose, se2_transform, wrap_angle
from graphslam.core.log import SensorLog, Truth
from graphslam.core.records import Gps, LandmarkObservations, LaserScans, VelocityControls
from graphslam.core.trajectory import Trajectory

RADIUS, SPEED, REACH = 16.0, 1.0, 12.0
SIGMA_V, SIGMA_W = 0.03, 0.01
"""σ of speed [m/s] and yaw rate [rad/s] of a record; ten come a second."""


def mixed_log(seed: int = 0, laps: float = 2.0, *, ids: bool = True) -> SensorLog:
    """Two laps: trees where x > 0, walls where x < 0 (frame of the ring's centre)."""
    rng = np.random.default_rng(seed)
    n = int(laps * 2 * np.pi * RADIUS / SPEED * 10)
    times = np.arange(n + 1) / 10.0
    angle = SPEED / RADIUS * times
    start = np.array([RADIUS, 0.0, np.pi / 2])
    ring = np.column_stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), wrap_angle(angle + np.pi / 2)])
    poses = se2_between(np.tile(start, (n + 1, 1)), ring)
    controls = VelocityControls(
        times=times,
        speed=SPEED + SIGMA_V * rng.standard_normal(n + 1),
        yaw_rate=SPEED / RADIUS + SIGMA_W * rng.standard_normal(n + 1),
    )
    trees = _trees(np.random.default_rng(99))
    return SensorLog(
        name="ring",
        streams={
            "controls": controls,
            "laser": _laser(times[::4], ring[::4], rng),
            "landmarks": _landmarks(times[1::5], ring[1::5], trees, rng, ids=ids),
            "gps": _gps(times[::20], poses[::20], ring[::20], rng),
        },
        truth=Truth(Trajectory(times, poses), np.arange(len(trees)), _in_first_base(start, trees)),
    )


def _in_first_base(start, points):
    return se2_transform(se2_between(start, np.zeros(3)), points)


def _trees(rng):
    angle = np.linspace(-1.35, 1.35, 30) + 0.02 * rng.standard_normal(30)
    radius = np.where(np.arange(30) % 2, RADIUS - 4.0, RADIUS + 4.0) + rng.uniform(-1.5, 1.5, 30)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def _walls() -> np.ndarray:
    """Segments ``(k, 4)`` of two walls round the left half of the ring, with niches so that the way along is seen."""
    out = []
    for radius, depth in ((RADIUS - 3.0, -1.0), (RADIUS + 3.0, 1.0)):
        angles = np.linspace(np.pi / 2 + 0.05, 1.5 * np.pi - 0.05, 41)
        r = radius + depth * (np.arange(41) // 2 % 2)
        corners = np.column_stack([r * np.cos(angles), r * np.sin(angles)])
        out.append(np.hstack([corners[:-1], corners[1:]]))
    return np.concatenate(out)


def _laser(times, ring, rng) -> LaserScans:
    bearings = np.radians(np.arange(-180, 180, 2.0))
    walls = _walls()
    a, d = walls[:, :2], walls[:, 2:] - walls[:, :2]
    heading = ring[:, 2:] + bearings
    u = np.stack([np.cos(heading), np.sin(heading)], axis=-1)  # (n, m, 2)
    rel = a[None] - ring[:, None, :2]  # (n, k, 2)
    cross = u[:, :, None, 0] * d[None, None, :, 1] - u[:, :, None, 1] * d[None, None, :, 0]
    along = (rel[:, None, :, 0] * d[None, None, :, 1] - rel[:, None, :, 1] * d[None, None, :, 0]) / cross
    share = (rel[:, None, :, 0] * u[:, :, None, 1] - rel[:, None, :, 1] * u[:, :, None, 0]) / cross
    along = np.where((along > 0) & (share >= 0) & (share <= 1), along, np.inf).min(axis=2)
    ranges = np.where(along < REACH, along + 0.02 * rng.standard_normal(along.shape), REACH)
    return LaserScans(times=times, ranges=ranges, bearings=bearings, max_range=REACH)


def _landmarks(times, ring, trees, rng, *, ids: bool) -> LandmarkObservations:
    rows, counts = [], []
    for pose in ring:
        local = se2_transform(se2_between(pose, np.zeros(3)), trees)
        far = np.hypot(*local.T)
        seen = np.flatnonzero((far < 9.0) & (pose[0] > -1.0))
        counts.append(len(seen))
        rows += [(far[i], np.arctan2(local[i, 1], local[i, 0]), i) for i in seen]
    z = np.array(rows)
    sigmas = np.tile([0.05, 0.01], (len(z), 1))
    return LandmarkObservations(
        times=times,
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        ranges=z[:, 0] + sigmas[:, 0] * rng.standard_normal(len(z)),
        bearings=wrap_angle(z[:, 1] + sigmas[:, 1] * rng.standard_normal(len(z))),
        sigmas=sigmas,
        ids=z[:, 2].astype(np.int64) if ids else None,
        max_range=9.0,
    )


def _gps(times, poses, ring, rng) -> Gps:
    open_sky = ring[:, 0] > 0
    T_gps_world = np.array([100.0, -50.0, 0.7])
    at = se2_compose(np.tile(T_gps_world, (len(poses), 1)), poses)[:, :2]
    fixes = at + 0.3 * rng.standard_normal(at.shape)
    return Gps(
        times=times[open_sky], positions=fixes[open_sky], sigma=np.full(int(open_sky.sum()), 0.3), lever=np.zeros(2)
    )
