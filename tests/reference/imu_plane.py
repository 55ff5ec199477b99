"""A body on a wavy ring in the plane: its exact motion, an IMU on it, dense submaps and submaps with landmarks."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from graphslam.core.geometry import se2_between, se2_compose, se2_exp, se2_inverse, se2_log, se2_transform
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.poses import SE2
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.solve.batch import BatchSolver

NOISE = ImuNoise(
    gyro=1e-3, gyro_bias=5e-3, gyro_walk=1e-4, accelerometer=1e-2, accelerometer_bias=0.05, accelerometer_walk=1e-3
)
ARM = np.array([0.3, -0.2])
STEP = np.array([0.02, 0.02, 4e-3])
POSTS = np.array([[15.0, 1.0], [4.0, 4.0], [-3.0, 14.0]])


def true_pose(t: np.ndarray) -> np.ndarray:
    """``T_world_body`` ``(n, 3)``: about a ring of 12 m; the body starts at the origin."""
    t = np.asarray(t, dtype=float)
    r, a = 12.0 + np.sin(0.4 * t), 0.125 * t
    T = np.stack([r * np.cos(a), r * np.sin(a), 0.25 * t + 0.4 * np.sin(0.3 * t)], axis=-1)
    first = np.array([12.0, 0.0, 0.0])
    return se2_between(np.broadcast_to(first, T.shape), T)


def true_unit(t: np.ndarray, turn: float = 0.0) -> np.ndarray:
    """``T_world_imu`` ``(n, 3)``."""
    return se2_compose(true_pose(t), np.array([*ARM, turn]))


def true_velocity(t: np.ndarray) -> np.ndarray:
    """Of the unit ``(n, 2)``, frame of the first base."""
    h = 1e-4
    return (true_unit(t + h)[:, :2] - true_unit(t - h)[:, :2]) / (2 * h)


def readings(
    t: np.ndarray,
    rng: np.random.Generator | None,
    noise: ImuNoise = NOISE,
    *,
    turn: float = 0.7,
    lean: np.ndarray | None = None,
) -> tuple[Imu, np.ndarray]:
    """A unit turned by ``turn`` on the body, and its true biases ``(n, 3)`` in the axes of the body.

    With a ``lean`` ``(n, 2)`` (pitch, roll) it has three axes and sees gravity; without it it is planar.
    """
    h, n = 1e-2, len(t)
    at = [true_unit(t + k * h)[:, :2] for k in (-2, -1, 0, 1, 2)]
    a = (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * h**2)
    th = [true_pose(t + k * h)[:, 2] for k in (-1, 1)]
    rate = np.angle(np.exp(1j * (th[1] - th[0]))) / (2 * h)
    now, dt = true_pose(t)[:, 2], np.diff(t, prepend=t[0] - (t[1] - t[0]))
    c, s = np.cos(now), np.sin(now)
    body = np.stack([rate, c * a[:, 0] + s * a[:, 1], -s * a[:, 0] + c * a[:, 1]], axis=1)

    def draw(*shape: int) -> np.ndarray:
        return np.zeros(shape) if rng is None else rng.standard_normal(shape)

    walk = np.sqrt(dt)[:, None] * [noise.gyro_walk, *2 * [noise.accelerometer_walk]] * draw(n, 3)
    walk[0] = [noise.gyro_bias, *2 * [noise.accelerometer_bias]] * draw(3)
    bias = np.cumsum(walk, axis=0)
    if lean is not None:
        bias[:, 1:] += GRAVITY * lean
    z = body + bias + np.array([noise.gyro, *2 * [noise.accelerometer]]) / np.sqrt(dt)[:, None] * draw(n, 3)
    c, s = np.cos(turn), np.sin(turn)
    none = np.zeros(n)
    force = np.stack([c * z[:, 1] + s * z[:, 2], -s * z[:, 1] + c * z[:, 2], none], axis=1)
    if lean is not None:
        force[:, 2] = GRAVITY * np.sqrt(1 - np.sum(lean**2, axis=1))
    mount = np.array([*ARM, 0.4, 0.0, 0.0, np.sin(0.5 * turn), np.cos(0.5 * turn)])
    rates = np.stack([none, none, z[:, 0]], axis=1)
    return Imu(times=t, angular_rate=rates, specific_force=force, noise=noise, T_base_imu=mount), bias


def submaps(
    rng: np.random.Generator, count: int = 4, seconds: float = 6.0, every: float = 0.5, landmarks: bool = True
) -> list[Submap]:
    """Every second one with landmarks; the motion of all is seen every ``every`` seconds with independent noise."""
    Q, n, out, t0 = np.diag(STEP**2), round(seconds / every), [], 0.0
    for k in range(count):
        times = t0 + every * np.arange(n + 1)
        seen, P = [np.zeros(3)], [np.zeros((3, 3))]
        for a, b in pairwise(true_pose(times)):
            move = se2_compose(se2_between(a, b), se2_exp(STEP * rng.standard_normal(3)))
            seen.append(se2_compose(seen[-1], move))
            ad = SE2.adjoint(SE2.inverse(move))
            P.append(ad @ P[-1] @ ad.T + Q)
        path = Trajectory(times, np.array(seen), np.array(P) + 1e-14 * np.eye(3))
        kept: dict = {"exit_pose": seen[-1], "exit_covariance": P[-1]}
        if landmarks and k % 2 == 1:
            base = true_pose(times[:1])[0]
            posts = se2_transform(se2_inverse(base), POSTS) + 0.05 * rng.standard_normal((3, 2))
            R = np.eye(9)
            R[:2, :2] = [[np.cos(seen[-1][2]), -np.sin(seen[-1][2])], [np.sin(seen[-1][2]), np.cos(seen[-1][2])]]
            P9 = 0.05**2 * np.eye(9)
            P9[:3, :3] = P[-1]
            ids = np.arange(3)
            joint = R @ P9 @ R.T
            kept |= {"landmarks": LandmarkMap(ids=ids, exit_pose=seen[-1], positions=posts, covariance=joint)}
        streams = frozenset({"laser" if landmarks and k % 2 else "scans"})
        times_of = {"key": k, "interval": (float(times[0]), float(times[-1])), "uses": streams}
        out.append(Submap(**times_of, trajectory=path, **kept))
        t0 = float(times[-1])
    return out


def solved(made: list[Submap], imu: Imu | None, config: ImuConfig | None = None) -> FactorGraph:
    """The graph at its optimum."""
    g = FactorGraph(2)
    for s in made:
        g.add_submap(s, spacing=3.0)
    if imu is not None:
        g.add_sensor(imu, config=config)
    solver = BatchSolver(g)
    solver.solve_to_optimum()
    for _ in range(4):
        if not ImuFactors.of(g).recentre():
            break
        solver.solve_to_optimum()
    return g


def nees(g: FactorGraph, imu: Imu, bias: np.ndarray | None) -> dict[str, float]:
    """Mean NEES over the nodes by block, over its degrees of freedom."""
    states, cov = ImuFactors.of(g).states(), g.covariance()
    t = np.array([states.time[n] for n in states.order])
    e = se2_log(se2_between(g.values.poses[list(states.order)], true_pose(t)))
    some = np.array(states.order) > 0
    P = cov.poses()[np.array(states.order)[some]]

    def of(e: np.ndarray, P: np.ndarray) -> float:
        return float(np.mean(np.einsum("ki,ki->k", e, np.linalg.solve(P, e[..., None])[..., 0])) / e.shape[1])

    out = {"position": of(e[some, :2], P[:, :2, :2]), "heading": of(e[some, 2:], P[:, 2:, 2:])}
    v = [states.velocity[n] for n in states.order if n in states.velocity]
    if v:
        Pv = np.array([cov.marginal(f"velocity{k}") for k in v])
        out["velocity"] = of(true_velocity(t) - g.values.velocities[v], Pv)
    if bias is not None:
        b = [states.bias[n] for n in states.order]
        Pb = np.array([cov.marginal(f"imubias{k}") for k in b])
        d = np.array([np.interp(t, imu.times, c) for c in bias.T]).T - g.values.imu_biases[b]
        out |= {"gyro bias": of(d[:, :1], Pb[:, :1, :1]), "force bias": of(d[:, 1:], Pb[:, 1:, 1:])}
    return out
