"""A body on a wavy ring in space: its exact motion, an IMU on it with every error as stated, and dense submaps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graphslam.core import se3
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.poses import SE3, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory

NOISE = ImuNoise(
    gyro=1e-3, gyro_bias=5e-3, gyro_walk=1e-4, accelerometer=1e-2, accelerometer_bias=0.05, accelerometer_walk=1e-3
)
MOUNT = np.concatenate([[0.3, -0.2, 0.5], se3.quat_multiply(se3.so3_exp([0, 0, 0.7]), se3.so3_exp([0, 0.08, 0.0]))])
STEP = np.array([2e-3, 2e-3, 2e-3, 0.02, 0.02, 0.02])
"""σ of the motion of every half a second that a front end sees, right tangent."""


def _angles(t: np.ndarray) -> tuple[np.ndarray, ...]:
    return 0.06 * np.sin(0.8 * t), 0.08 * np.sin(0.5 * t + 1.0), 0.25 * t + 0.4 * np.sin(0.3 * t)


def true_pose(t: np.ndarray) -> np.ndarray:
    """``T_level_body`` ``(n, 7)``: about a ring of 12 m, with waves."""
    r, p, y = _angles(t)
    q = [se3.so3_exp(np.outer(a, e)) for a, e in zip((y, p, r), ([0, 0, 1], [0, 1, 0], [1, 0, 0]))]
    turn = se3.quat_multiply(se3.quat_multiply(q[0], q[1]), q[2])
    at = np.stack([12 * np.cos(0.125 * t), 12 * np.sin(0.125 * t), 0.5 * np.sin(0.4 * t) + 0.2 * np.sin(0.11 * t)], -1)
    return np.concatenate([at, turn], axis=1)


def true_unit(t: np.ndarray, mount: np.ndarray = MOUNT) -> np.ndarray:
    """``T_level_imu`` ``(n, 7)``."""
    T = true_pose(t)
    return SE3.compose(T, np.broadcast_to(mount, T.shape))


def true_velocity(t: np.ndarray, mount: np.ndarray = MOUNT) -> np.ndarray:
    """Of the unit ``(n, 3)``, level frame, by central differences."""
    h = 1e-4
    return (true_unit(t + h, mount)[:, :3] - true_unit(t - h, mount)[:, :3]) / (2 * h)


def true_readings(t: np.ndarray, mount: np.ndarray = MOUNT) -> tuple[np.ndarray, np.ndarray]:
    """Rates and specific forces ``(n, 3)`` without error."""
    h = 1e-4
    before, here, after = (true_unit(t + d, mount) for d in (-h, 0.0, h))
    conjugate = [-1.0, -1.0, -1.0, 1.0]
    rate = se3.so3_log(se3.quat_multiply(before[:, 3:] * conjugate, after[:, 3:])) / (2 * h)
    d = 1e-2  # fourth-order differences of the position: rounding stays below 1e-9
    at = [true_unit(t + k * d, mount)[:, :3] for k in (-2, -1, 0, 1, 2)]
    a = (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * d**2)
    return rate, se3.quat_rotate(here[:, 3:] * conjugate, a + [0.0, 0.0, GRAVITY])


@dataclass
class Ring:
    """One run: truth in the frame of the first base.

    Parameters
    ----------
    imu : Imu
    bias : (n, 6)
        True biases at every reading.
    submaps : list of Submap
    """

    imu: Imu
    bias: np.ndarray
    submaps: list[Submap]
    base: np.ndarray

    def truth(self, times: np.ndarray) -> np.ndarray:
        """Poses of the body ``(n, 7)``."""
        T = true_pose(times)
        return SE3.between(np.broadcast_to(self.base, T.shape), T)

    def velocity(self, times: np.ndarray) -> np.ndarray:
        """Of the unit ``(n, 3)``."""
        v = true_velocity(times)
        return se3.quat_rotate(self.base[3:] * [-1.0, -1.0, -1.0, 1.0], v)

    def bias_at(self, times: np.ndarray) -> np.ndarray:
        """``(n, 6)``."""
        return np.array([np.interp(times, self.imu.times, b) for b in self.bias.T]).T


def unit_on(t: np.ndarray, rng: np.random.Generator | None, noise: ImuNoise = NOISE) -> tuple[Imu, np.ndarray]:
    """An IMU with readings at ``t``; without a generator they have no error."""
    rate, force = true_readings(t)
    n, dt = len(t), np.diff(t, prepend=t[0] - (t[1] - t[0]))[:, None]

    def draw(*shape: int) -> np.ndarray:
        return np.zeros(shape) if rng is None else rng.standard_normal(shape)

    walk = np.sqrt(dt) * np.repeat([noise.gyro_walk, noise.accelerometer_walk], 3) * draw(n, 6)
    walk[0] = np.repeat([noise.gyro_bias, noise.accelerometer_bias], 3) * draw(6)
    bias = np.cumsum(walk, axis=0)
    white = np.repeat([noise.gyro, noise.accelerometer], 3) / np.sqrt(dt) * draw(n, 6)
    z = np.hstack([rate, force]) + bias + white
    return Imu(times=t, angular_rate=z[:, :3], specific_force=z[:, 3:], noise=noise, T_base_imu=MOUNT), bias


def ring(
    rng: np.random.Generator,
    *,
    submaps: int = 4,
    seconds: float = 6.0,
    hz: float = 100.0,
    every: float = 0.5,
    step: np.ndarray = STEP,
    lean: float = 0.03,
    noise: ImuNoise = NOISE,
) -> Ring:
    """Submaps of ``seconds`` each whose motion is seen every ``every`` seconds with independent noise.

    Bases do not stand as the body does: they are levelled, with an error of ``lean`` [rad], and the path of a submap
    says where the body is in its frame.
    """
    imu, bias = unit_on(np.arange(-10, round((submaps * seconds + 0.2) * hz)) / hz, rng, noise)
    bodies = true_pose(seconds * np.arange(submaps + 1))
    leans = SE3.exp(np.column_stack([lean * rng.standard_normal((submaps + 1, 2)), np.zeros((submaps + 1, 4))]))
    leans = SE3.compose(
        SE3.between(bodies, remove_roll_pitch(bodies)), leans
    )  # a level base, and the error of levelling it
    Q, made, n = np.diag(step**2), [], round(seconds / every)
    t0 = 0.0
    for k in range(submaps):
        times = t0 + every * np.arange(n + 1)
        T = true_pose(times)
        seen, P = [SE3.inverse(leans[k])], [np.zeros((6, 6))]
        for a, b in pairwise(T):
            move = SE3.compose(SE3.between(a, b), SE3.exp(step * rng.standard_normal(6)))
            seen.append(SE3.compose(seen[-1], move))
            ad = SE3.adjoint(SE3.inverse(move))
            P.append(ad @ P[-1] @ ad.T + Q)
        A = SE3.adjoint(SE3.inverse(leans[k + 1]))
        exit_pose = SE3.compose(seen[-1], leans[k + 1])
        path = Trajectory(times, np.array(seen), np.array(P) + 1e-14 * np.eye(6))
        made.append(
            Submap(
                key=k,
                interval=(float(times[0]), float(times[-1])),
                exit_pose=exit_pose,
                exit_covariance=A @ P[-1] @ A.T,
                trajectory=path,
                uses=frozenset({"laser"}),
            )
        )
        t0 = float(times[-1])
    return Ring(imu, bias, made, SE3.compose(true_pose(np.zeros(1)), leans[:1])[0])
