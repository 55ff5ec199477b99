"""Are graphs with an IMU honest, and does the IMU help? Simulated rings in space, many runs, NEES by block.

``python -m tests.benchmarks.bench_imu`` prints the table of the page.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.core.se3 import align_se3, quat_rotate, quat_to_matrix, so3_exp
from graphslam.evaluate.residual_consistency import class_consistency
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.solve.batch import BatchSolver
from tests.reference.imu_ring import STEP, Ring, ring, true_pose

BLOCKS = {"position": slice(3, 6), "heading": slice(2, 3), "level": slice(0, 2)}
LEVER = np.array([0.2, 0.1, 1.2])
LEAN = 0.03


@dataclass
class Trial:
    """NEES of one run by block, errors, χ²."""

    nees: dict[str, float]
    ate: float
    heading: float
    level: float
    chi2: dict[str, tuple[float, float]]


def solved(
    made: Ring, rng: np.random.Generator, imu: ImuConfig | None, gps: bool, spacing: float | None
) -> FactorGraph:
    """The graph of a ring, with what it is to have, at its optimum."""
    g = FactorGraph(3)
    for s in made.submaps:
        g.add_submap(s, spacing=spacing)
    # the first base is level within LEAN: how it was levelled is all that is known of it before
    g.add_attitude(0, [0.0, 0.0, -1.0], LEAN, evidence="prior")
    if gps:
        t = np.arange(0.25, made.submaps[-1].interval[1], 1.0)
        z = SE3.transform(true_pose(t), np.broadcast_to(LEVER, (len(t), 3))) + 0.3 * rng.standard_normal((len(t), 3))
        g.add_sensor(Gps(times=t, positions=z, sigma=np.full(len(t), 0.3), lever=LEVER), config=GpsConfig(baseline=5.0))
        g.finish_sensors()
    if imu is not None:
        g.add_sensor(made.imu, config=imu)
    solver = BatchSolver(g)
    solver.solve_to_optimum()
    for _ in range(4):
        if not ImuFactors.of(g).recentre():
            break
        solver.solve_to_optimum()
    return g


def true_nodes(g: FactorGraph, made: Ring) -> np.ndarray:
    """Truth of every node ``(m + 1, 7)``: the body, seen back from where its path has it on the node."""
    out = np.zeros_like(g.values.poses)
    for s in g.submaps:
        T = s.T_base_node
        body = s.trajectory.interpolate(s.times)
        out[list(s.nodes)] = SE3.compose(made.truth(s.times), SE3.between(body, T))
    return out


def trial(
    rng: np.random.Generator,
    imu: ImuConfig | None,
    *,
    gps: bool = False,
    spacing: float | None = 3.0,
    step: np.ndarray = STEP,
    submaps: int = 8,
    seconds: float = 6.0,
) -> Trial:
    """One run."""
    made = ring(rng, submaps=submaps, seconds=seconds, step=step, lean=LEAN)
    g = solved(made, rng, imu, gps, spacing)
    truth = true_nodes(g, made)
    e = SE3.log(SE3.between(g.values.poses, truth))[1:]
    P = g.covariance().poses()[1:]

    def of(e: np.ndarray, P: np.ndarray) -> float:
        return float(np.mean(np.einsum("ki,ki->k", e, np.linalg.solve(P, e[..., None])[..., 0])) / e.shape[1])

    nees = {name: of(e[:, s], P[:, s, s]) for name, s in BLOCKS.items()}
    states = ImuFactors.of(g).states()
    cov = g.covariance()
    if states.velocity:
        t = np.array([states.time[n] for n in states.velocity])
        rows = list(states.velocity.values())
        nees["velocity"] = of(
            made.velocity(t) - g.values.velocities[rows], np.array([cov.marginal(f"velocity{k}") for k in rows])
        )
    if states.bias:
        t = np.array([states.time[n] for n in states.bias])
        rows = list(states.bias.values())
        d, Q = made.bias_at(t) - g.values.imu_biases[rows], np.array([cov.marginal(f"imubias{k}") for k in rows])
        nees["gyro bias"], nees["force bias"] = of(d[:, :3], Q[:, :3, :3]), of(d[:, 3:], Q[:, 3:, 3:])
    if g.values.tilt is not None:
        up = quat_rotate(made.base[3:] * [-1.0, -1.0, -1.0, 1.0], [0.0, 0.0, 1.0])
        seen = quat_to_matrix(so3_exp(np.append(g.values.tilt, 0.0)))[:, 2]
        d = np.cross(seen, up)[:2]
        nees["tilt"] = of(d[None], cov.marginal("tilt")[None])
    aligned, _ = align_se3(g.values.poses[:, :3], truth[:, :3])
    gap = SE3.transform(aligned, g.values.poses[:, :3]) - truth[:, :3]
    classes = class_consistency(g)
    return Trial(
        nees,
        float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))),
        float(np.sqrt(np.mean(e[:, 2] ** 2))),
        float(np.sqrt(np.mean(e[:, :2] ** 2))),
        {k: (c.chi2, c.dof) for k, c in classes.items()},
    )
