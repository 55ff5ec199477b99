"""A small drive over waves, simulated plainly: what an IMU and wheels measure, and where the base was."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from graphslam.core import se3
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.records import VelocityControls
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.dead_reckoning import DeadReckoningNoise

STATED = ImuNoise(
    gyro=5e-4,
    gyro_bias=2e-3,
    gyro_walk=1e-4,
    accelerometer=5e-3,
    accelerometer_bias=0.03,
    accelerometer_walk=1e-3,
    attitude=float(np.hypot(np.deg2rad(0.25), np.deg2rad(0.1))),
    attitude_time=4.0,
)
NOISE = DeadReckoningNoise(attitude_bias=float(np.deg2rad(0.1)))
MOUNT = np.concatenate([[0.3, -0.2, 0.5], se3.quat_multiply(se3.so3_exp([0, 0, 0.7]), se3.so3_exp([0, 0.08, 0.0]))])
WORDS = ("gyro", "gyro_bias", "gyro_walk", "accelerometer", "accelerometer_bias", "accelerometer_walk")
STILL = ImuNoise(**dict.fromkeys(WORDS, 0.0))


@dataclass
class Drive:
    """Truth at every record of the IMU and what was measured."""

    truth: Trajectory
    imu: Imu
    wheels: VelocityControls


def rotate(axis: int, angle: float) -> np.ndarray:
    """Rotation matrix about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


def attitude_and_speed(t: np.ndarray, waves: float) -> tuple[np.ndarray, ...]:
    """Roll, pitch, heading, speed: smooth in time."""
    roll = waves * 0.05 * np.sin(0.7 * t)
    pitch = waves * 0.10 * np.sin(0.4 * t + 1.0)
    heading = 0.9 * np.sin(0.25 * t) + 0.03 * t
    return roll, pitch, heading, 1.0 + 0.3 * np.sin(0.5 * t)


@lru_cache(maxsize=4)
def noise_free(seconds: float, rate: float, waves: float) -> tuple[np.ndarray, ...]:
    """Stamps, positions, attitudes, rates of the base, specific force at the unit, speed: at the IMU's records."""
    h = 1.0 / rate
    n = int(seconds * rate) + 1
    t = h * np.arange(n)
    fine = 8  # the base is moved in small straight pieces between records
    p, position = np.zeros(3), [np.zeros(3)]
    for k in range(n - 1):
        for m in range(fine):
            r, q, y, v = attitude_and_speed(np.array(t[k] + (m + 0.5) * h / fine), waves)
            p = p + rotate(2, y) @ rotate(1, q) @ rotate(0, r) @ np.array([v * h / fine, 0.0, 0.0])
        position.append(p)

    def matrices(at: np.ndarray) -> np.ndarray:
        return np.array(
            [rotate(2, c) @ rotate(1, b) @ rotate(0, a) for a, b, c, _ in zip(*attitude_and_speed(at, waves))]
        )

    d = 1e-5  # rates of the body by differences of the attitude
    W = np.swapaxes(matrices(t - d), 1, 2) @ matrices(t + d)
    body = np.stack([W[:, 2, 1] - W[:, 1, 2], W[:, 0, 2] - W[:, 2, 0], W[:, 1, 0] - W[:, 0, 1]], -1) / (4 * d)
    Rs, speed = matrices(t), attitude_and_speed(t, waves)[3]
    # specific force at the unit: of the base's own smooth motion, turning about it, and gravity
    along = (attitude_and_speed(t + d, waves)[3] - attitude_and_speed(t - d, waves)[3]) / (2 * d)
    force = np.column_stack([along, speed * body[:, 2], -speed * body[:, 1]])
    turning = np.gradient(body, t, axis=0)
    force += np.cross(turning, MOUNT[:3]) + np.cross(body, np.cross(body, MOUNT[:3]))
    return t, np.array(position), Rs, body, force + GRAVITY * Rs[:, 2, :], speed


def drive(
    rng: np.random.Generator | None,
    *,
    seconds: float = 40.0,
    rate: float = 50.0,
    waves: float = 1.0,
    gives_attitude: bool = True,
    stated: ImuNoise = STATED,
    noise: DeadReckoningNoise = NOISE,
    biased: bool = True,
) -> Drive:
    """Drive for ``seconds``; without a generator nothing is noisy.

    Every error is drawn as ``stated`` and ``noise`` say; with ``biased`` off, biases and scales are zero.
    """
    h = 1.0 / rate

    def draw(*shape: int) -> np.ndarray:
        return np.zeros(shape) if rng is None else rng.standard_normal(shape)

    on = float(biased)
    t, straight, Rs, body, force, speed = noise_free(seconds, rate, waves)
    n = len(t)
    slip = np.sqrt(speed[:-1] * h)[:, None] * draw(n - 1, 2) * [noise.lateral, noise.vertical]
    slipped = np.cumsum(Rs[:-1, :, 1] * slip[:, :1] + Rs[:-1, :, 2] * slip[:, 1:], axis=0)
    position = straight + np.vstack([np.zeros(3), slipped])
    truth = Trajectory(t, np.column_stack([position, se3.matrix_to_quat(Rs)]))
    M = se3.quat_to_matrix(MOUNT[3:])
    bias = on * stated.gyro_bias * draw(3) + on * stated.gyro_walk * np.sqrt(h) * np.cumsum(draw(n, 3), axis=0)
    gyro = body @ M + bias + stated.gyro / np.sqrt(h) * draw(n, 3)

    walk = on * stated.accelerometer_walk * np.sqrt(h) * np.cumsum(draw(n, 3), axis=0)
    force = force @ M + on * stated.accelerometer_bias * draw(3) + walk + stated.accelerometer / np.sqrt(h) * draw(n, 3)

    attitude = None
    if gives_attitude:
        U = Rs @ M
        tilt = np.column_stack([np.arctan2(U[:, 2, 1], U[:, 2, 2]), -np.arcsin(U[:, 2, 0])])
        error, fade, w = np.empty((n, 2)), np.exp(-h / stated.attitude_time), draw(n, 2)
        sigma = np.sqrt(max(stated.attitude**2 - noise.attitude_bias**2, 0.0))
        error[0] = sigma * w[0]
        for k in range(1, n):
            error[k] = fade * error[k - 1] + sigma * np.sqrt(1 - fade**2) * w[k]
        attitude = tilt + error + on * noise.attitude_bias * draw(2)
    imu = Imu(times=t, angular_rate=gyro, specific_force=force, noise=stated, attitude=attitude, T_base_imu=MOUNT)
    every = 5
    mean = attitude_and_speed(t[:-1:every, None] + every * h * (np.arange(20) + 0.5) / 20, waves)[3].mean(axis=1)
    measured = (mean + noise.wheel * draw(len(mean))) / (1.0 + on * noise.wheel_scale * draw(1)[0])
    wheels = VelocityControls(times=t[:-1:every], speed=measured, yaw_rate=np.zeros(len(mean)))
    return Drive(truth, imu, wheels)
