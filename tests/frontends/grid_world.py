"""A ring of corridors made of boxes, a robot that drives round it, and what it measures: steps for grid filters.

Rays are computed against the boxes themselves. The odometry turns a little too much at every step, which is the error
that a loop has to undo.
"""

from __future__ import annotations

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array, se2_between
from graphslam.core.records import Odometry
from graphslam.core.se3 import quat_rotate
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.steps import Steps

HALL = np.array([[-2.07, -2.11, -0.07], [14.06, 10.09, 2.68]])
"""Low and high corner of the hall; rays end at its walls from inside. No wall lies between two voxels."""
BLOCKS = np.array(
    [
        [[1.27, 1.28, -0.1], [10.73, 6.71, 2.7]],  # the middle: corridors are left around it
        [[3.05, -2.2, -0.1], [3.66, -1.27, 1.13]],  # cupboards along the walls
        [[8.07, 0.93, -0.1], [9.12, 1.3, 2.03]],
        [[13.27, 2.28, -0.1], [14.1, 3.15, 1.67]],
        [[10.7, 5.05, 0.45], [11.26, 5.52, 1.27]],
        [[6.35, 9.27, -0.1], [7.72, 10.1, 1.94]],
        [[2.14, 6.7, -0.1], [2.43, 7.25, 2.33]],
        [[-2.1, 5.13, -0.1], [-1.27, 6.32, 0.95]],
        [[0.87, 2.84, -0.1], [1.3, 3.65, 1.52]],
    ]
)
CORNERS = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 8.0], [0.0, 8.0]])
HEIGHT = 0.8
"""Of the scanner over the floor, which is that of the base."""


def ranges(origins: Array, directions: Array) -> Array:
    """Distances ``(n,)`` from origins ``(n, d)`` in the hall along unit directions to the nearest wall or box."""
    d = origins.shape[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / directions
        a, b = (HALL[0, :d] - origins) * inverse, (HALL[1, :d] - origins) * inverse
        best = np.nanmin(np.maximum(a, b), axis=1)
        for low, high in BLOCKS[:, :, :d]:
            t0, t1 = (low - origins) * inverse, (high - origins) * inverse
            near, far = np.nanmax(np.minimum(t0, t1), axis=1), np.nanmin(np.maximum(t0, t1), axis=1)
            best = np.where((near < far) & (near > 0.0) & (near < best), near, best)
    return best


def drive(dim: int, length: float, step: float) -> Array:
    """True poses round the ring, corners rounded with 1.5 m; in 3-D the base also rolls and pitches by a degree."""
    radius = 1.5
    points, headings = [], []
    for a, b in zip(CORNERS, np.roll(CORNERS, -1, axis=0)):
        u = (b - a) / np.linalg.norm(b - a)
        left = np.array([-u[1], u[0]])
        side = np.linalg.norm(b - a) - 2 * radius
        h = np.arctan2(u[1], u[0])
        for s in np.arange(0.0, side, 0.01):
            points.append(a + u * (radius + s))
            headings.append(h)
        centre = a + u * (radius + side) + left * radius
        for t in np.arange(0.0, np.pi / 2, 0.01 / radius):
            points.append(centre + radius * (np.sin(t) * u - np.cos(t) * left))
            headings.append(h + t)
    xy, heading = np.array(points), np.unwrap(headings)
    at = np.round(np.arange(0.0, length, step) / 0.01).astype(int)
    laps, at = at // len(xy), at % len(xy)
    heading = heading[at] + 2 * np.pi * laps
    if dim == 2:
        return np.column_stack([xy[at], np.arctan2(np.sin(heading), np.cos(heading))])
    phase = 0.9 * np.arange(len(at))
    roll, pitch = np.radians(1.0) * np.sin(phase), np.radians(1.0) * np.cos(0.7 * phase)
    q = [se3.so3_exp(np.stack(v, -1)) for v in ((0 * roll, 0 * roll, heading), (0 * roll, pitch, 0 * roll))]
    q.append(se3.so3_exp(np.stack([roll, 0 * roll, 0 * roll], -1)))
    quaternion = se3.quat_normalize(se3.quat_multiply(se3.quat_multiply(q[0], q[1]), q[2]))
    return np.column_stack([xy[at], np.full(len(at), HEIGHT), quaternion])


def fan(dim: int, beams: int) -> Array:
    """Unit directions: all round in 2-D, spread evenly over the sphere in 3-D."""
    if dim == 2:
        a = np.linspace(-np.pi, np.pi, beams, endpoint=False)
        return np.column_stack([np.cos(a), np.sin(a)])
    z = 1.0 - (2.0 * np.arange(beams) + 1.0) / beams
    a = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(beams)
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(a), r * np.sin(a), z])


def ring(
    seed: int,
    dim: int = 3,
    *,
    length: float = 45.0,
    step: float = 0.4,
    beams: int = 120,
    yaw_bias: float = 0.004,
    max_range: float = 8.0,
    range_sigma: float = 0.02,
    tilt_sigma: float = 0.002,
) -> Steps:
    """A drive round the ring; 37.4 m are once around.

    Parameters
    ----------
    yaw_bias : float
        By which the odometry turns too far in every step [rad]. It is in no covariance.
    tilt_sigma : float
        σ of roll and pitch from gravity [rad]; 0 in 3-D: no gravity.
    """
    rng = np.random.default_rng([seed, dim])
    truth = drive(dim, length, step)
    n, d = len(truth), 3 if dim == 2 else 6
    sigma = np.array([0.004, 0.004, 0.001]) if dim == 2 else np.array([0.0005, 0.0005, 0.001, 0.004, 0.004, 0.002])
    noise = rng.normal(size=(n, d)) * sigma
    noise[:, 2] += yaw_bias
    if dim == 2:
        from graphslam.core.geometry import se2_compose, se2_exp

        increments = se2_compose(se2_between(truth[:-1], truth[1:]), se2_exp(noise[1:]))
        identity = np.zeros((1, 3))
    else:
        increments = se3.se3_compose(se3.se3_between(truth[:-1], truth[1:]), se3.se3_exp(noise[1:]))
        identity = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
    increments = np.concatenate([identity, increments])
    directions = np.tile(fan(dim, beams), (n, 1))
    pose = np.repeat(truth, beams, axis=0)
    if dim == 2:
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x, y = directions.T
        world = np.column_stack([c * x - s * y, s * x + c * y])
    else:
        world = quat_rotate(pose[:, 3:], directions)
    true = ranges(pose[:, :dim], world)
    returns = true < max_range
    measured = np.where(returns, true + rng.normal(scale=range_sigma, size=len(true)), max_range)
    times = 0.4 * np.arange(n)
    tilt = None
    if dim == 3 and tilt_sigma > 0:
        from graphslam_frontends.grid.motion import roll_pitch_of

        tilt = roll_pitch_of(truth) + tilt_sigma * rng.normal(size=(n, 2))
    return Steps(
        times=times,
        odometry=Odometry(times=times, increments=increments, covariances=np.tile(np.diag(sigma**2), (n, 1, 1))),
        offsets=beams * np.arange(n + 1, dtype=np.int64),
        points=measured[:, None] * directions,
        origins=np.zeros((n * beams, dim)),
        returns=returns,
        max_range=max_range,
        range_sigma=range_sigma,
        tilt=tilt,
        tilt_sigma=tilt_sigma,
        tilt_time=1.0,
        uses=frozenset({"scanner", "odometry"}),
        name=f"ring{seed}",
        truth=Trajectory(times, truth),
    )


def true_end(steps: Steps) -> Array:
    """True pose ``(7,)`` or ``(3,)`` at the end in the gravity-aligned frame of the first base."""
    from graphslam.core.poses import group_of, remove_roll_pitch

    assert steps.truth is not None
    poses = steps.truth.poses
    group = group_of(poses)
    return group.between(remove_roll_pitch(poses[0]), poses[-1])
