"""Options of IMU factors, and the pose of the unit relative to the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphslam.core.config import check_options, flattened_field
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE3, group_of
from graphslam.core.se3 import se3_adjoint, se3_inverse, so3_exp
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factors.imu.plane import lift, lift_covariances, lift_path
from graphslam.graph.noise import RobustKernel
from graphslam.graph.submap_node import SubmapNode
from graphslam.graph.variables import Values


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuConfig:
    """Options for converting IMU readings to factors.

    Parameters
    ----------
    longest : float or None
        Consecutive nodes within this time [s] are connected by a preintegrated measurement; in 3-D others get gravity
        factors. None: 10 s in 3-D, 120 s in 2-D.
    pause : float or None
        Longest gap in the readings of a preintegrated measurement [s]; None: five times the median, at least 0.1 s.
    accelerometer : bool
        False: gyro only, without velocities and gravity.
    gravity : bool
        3-D: nodes without a preintegrated measurement get the mean specific force around them.
    window : float
        Averaging time of the mean specific force [s].
    acceleration : float
        σ of the mean acceleration in a window if the body is not static [m/s²].
    still : float
        The body can be static only if it moves less than this in a window [m]; the readings must be quiet, too.
    axes : {"refuse", "warn", "ignore"}
        Reaction to an IMU whose readings contradict its mounting (:mod:`graphslam.graph.factors.imu.axes`).
    robust : RobustKernel
        Kernel on every preintegrated measurement.
    """

    longest: float | None = None
    pause: float | None = None
    accelerometer: bool = True
    gravity: bool = True
    window: float = 1.0
    acceleration: float = 0.3
    still: float = 0.05
    axes: Literal["refuse", "warn", "ignore"] = "refuse"
    robust: RobustKernel = flattened_field(RobustKernel("none", 2.385), robust="kind", robust_width="k")

    def __post_init__(self) -> None:
        check_options(self, "imu.", {"> 0": "longest pause window acceleration still"})

    def span(self, dim: int) -> float:
        """Longest preintegrated measurement in a graph of that dimension [s]."""
        return self.longest or (10.0 if dim == 3 else 120.0)

    def pause_of(self, times: Array) -> float:
        """Longest gap allowed in readings at ``times`` ``(n,)``, n ≥ 2 [s]."""
        return max(0.1, 5.0 * float(np.median(np.diff(times)))) if self.pause is None else self.pause


@dataclass(frozen=True, slots=True, eq=False)
class BodyPlace:
    """Pose of the body relative to a node, from the path of the submap.

    Parameters
    ----------
    T_node_body : (7,)
    covariance : (6, 6)
        Right tangent at the body.
    moved : float
        Distance that the body moved in the window around ``time`` [m].
    """

    time: float
    T_node_body: Array
    covariance: Array
    moved: float

    def unit(self, T_base_imu: Array) -> tuple[Array, Array]:
        """``T_node_imu`` ``(7,)`` and its covariance ``(6, 6)``, right tangent at the unit."""
        A = se3_adjoint(se3_inverse(T_base_imu))
        return SE3.compose(self.T_node_body, T_base_imu), A @ self.covariance @ A.T


def places_on_nodes(submaps: Sequence[SubmapNode], window: float) -> dict[int, BodyPlace]:
    """Pose of the body at every node that a path covers.

    A base (or the node between two submaps) is a frame that may have been levelled: the body's pose is from the path
    that starts there. At inner nodes the body is at the node itself. At the last node it is the end of the last path.
    """
    out: dict[int, BodyPlace] = {}
    for s in submaps:
        path = s.trajectory
        if path is None or len(path) < 2:
            continue
        group = group_of(path.poses)

        def moved(t: float, path: Trajectory = path) -> float:
            ends = np.clip([t - 0.5 * window, t + 0.5 * window], path.times[0], path.times[-1])
            return float(np.linalg.norm(np.diff(path.interpolate(ends)[:, : path.dim], axis=0)))

        inner = [k for k in range(len(s.nodes) - 1) if path.times[0] <= s.times[k] <= path.times[-1]]
        if inner:
            T, P = s.local(s.times[inner], np.array(inner, dtype=np.intp))
            P = np.zeros((len(inner), 6, 6)) if P is None else lift_covariances(P)
            for k, Tk, Pk in zip(inner, lift("x", T), P):
                t = float(s.times[k])
                out[s.nodes[k]] = BodyPlace(t, Tk, Pk if k == 0 else np.zeros((6, 6)), moved(t))
        t = float(s.times[-1])
        if path.times[0] <= t <= path.times[-1] + 1e-9:
            T_end = path.interpolate(min(t, float(path.times[-1])))[0]
            T_exit_end = lift("x", group.between(s.T_base_node[-1], T_end)[None])[0]
            out[s.exit_node] = BodyPlace(t, T_exit_end, np.zeros((6, 6)), moved(t))
    return out


def body_path(submaps: Sequence[SubmapNode], values: Values) -> Trajectory:
    """3-D path of the body in the level frame at the first base, with rigid submaps at their nodes."""
    times, poses = [np.zeros(0)], [np.zeros((0, 7))]
    level = SE3.identity.copy()
    if values.tilt is not None:
        level[3:] = so3_exp(-np.append(values.tilt, 0.0))
    for s in submaps:
        if s.trajectory is None:
            continue
        path = lift_path(s.trajectory)
        T = SE3.compose(level, lift("x", values.poses[s.node : s.node + 1])[0])
        new = path.times > (times[-1][-1] if len(times[-1]) else -np.inf)
        if np.any(new):
            times.append(path.times[new])
            poses.append(SE3.compose(np.broadcast_to(T, path.poses[new].shape), path.poses[new]))
    if len(times) == 1:
        raise DataError("no submap has a path", wanted="submaps with trajectories")
    return Trajectory(np.concatenate(times), np.concatenate(poses))
