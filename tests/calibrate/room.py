"""A robot that drives round and round a furnished room, in the plane: true poses, scans, and odometry with errors."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import se2_between, se2_exp, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.records import LaserScans, Odometry


def boxes(rng):
    """Walls of a room and of furniture as segments ``(n, 4)``."""
    out = [_box(0.0, 0.0, 12.0, 9.0, 0.0)]
    for _ in range(14):
        x, y = rng.uniform(-5.5, 5.5), rng.uniform(-4.0, 4.0)
        if np.hypot(x / 1.4, y) > 2.8 or np.hypot(x, y) < 1.0:
            out.append(_box(x, y, *rng.uniform(0.3, 0.9, 2), rng.uniform(0, np.pi)))
    return np.concatenate(out)


def _box(x, y, w, h, a):
    c = np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) / 2 @ [[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]] + [x, y]
    return np.column_stack([c, np.roll(c, -1, axis=0)])


def scan(pose, walls, bearings):
    """Ranges of beams from a pose."""
    d = np.column_stack([np.cos(pose[2] + bearings), np.sin(pose[2] + bearings)])
    a, e = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = d[:, None, 0] * e[:, 1] - d[:, None, 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        u = (a[:, 0] * d[:, None, 1] - a[:, 1] * d[:, None, 0]) / cross
    return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=1)


def drive(*, bias=0.0, scale=1.0, noise=0.0, spread=0.0, bend=0.0, slip=0.0, stated=1e-4, seconds=150.0, seed=3):
    """Its log, and the true poses ``(n, 3)``.

    Parameters
    ----------
    bias, bend : float
        Of the heading, each second and each metre [rad/s, rad/m].
    scale : float
        Of the distances.
    noise : float
        Of the heading [rad/√m].
    spread : float
        Noise of each increment, on every axis [m, rad].
    slip : float
        What the wheels measure too much in one step, half way [m].
    stated : float
        σ of increments that the log states [m, rad].
    """
    rng = np.random.default_rng(seed)
    walls = boxes(rng)
    t = np.arange(0.0, seconds, 0.5)
    # round and round a bend, faster and slower, so that time, way and turn are not one
    phase = np.cumsum(0.5 * 0.11 * (1.0 + 0.6 * np.sin(0.21 * t)))
    at = np.column_stack([3.6 * np.cos(phase) * (1 + 0.2 * np.sin(3 * phase)), 2.6 * np.sin(phase)])
    v = np.gradient(at, t, axis=0)
    poses = np.column_stack([at, np.unwrap(np.arctan2(v[:, 1], v[:, 0]))])
    bearings = np.linspace(-np.pi / 2, np.pi / 2, 181)
    ranges = np.array([scan(p, walls, bearings) for p in poses]) + 0.01 * rng.standard_normal((len(t), 181))
    xi = np.zeros((len(t), 3))
    xi[1:] = se2_log(se2_between(poses[:-1], poses[1:]))
    d = np.hypot(xi[:, 0], xi[:, 1])
    xi[:, :2] *= scale
    xi[1:, 2] += bias * 0.5 + bend * d[1:] + noise * np.sqrt(d[1:]) * rng.standard_normal(len(t) - 1)
    if spread:
        xi[1:] += spread * rng.standard_normal((len(t) - 1, 3))
    xi[len(t) // 2, 0] += slip
    odometry = Odometry(times=t, increments=se2_exp(xi), covariances=np.tile(stated**2 * np.eye(3), (len(t), 1, 1)))
    scans = LaserScans(times=t, ranges=ranges, bearings=bearings, max_range=30.0)
    return SensorLog(name="furnished-room", streams={"odometry": odometry, "scans": scans}), poses
