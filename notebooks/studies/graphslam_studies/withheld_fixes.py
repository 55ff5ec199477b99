"""The study ``withheld-fixes``: prediction of withheld positions by an IMU or a constant-velocity model.

One position every few seconds is used; all others are withheld and scored: error of their prediction, and consistency
of its covariance. There is a node at every position, so the prediction uses measurements before and after it.

``euroc-…``: EuRoC machine hall 01, IMU and tracked prism. Initial attitudes and gyro bias come from the used positions
(:mod:`graphslam_studies.graph.inertial_start`); path, velocities, biases, tilt and the pose of the map in the frame
of the positions are estimated. ``kitti-…``: fixes of a car without its IMU; the motion model is constant velocity with
white acceleration noise. Its density is computed from second differences of the used fixes in the plane, times a factor
(the acceleration of a car is smoother than white noise). The factor is chosen on the first half of the drive with its
withheld fixes; the second half is scored.

Quantities
----------
``rmse``, ``median`` and ``worst`` error of the withheld positions [m]; ``rmse_plane``; ``straight``: root mean square
error of straight lines between the used ones; ``nees`` and ``nees_plane``: NEES (covariance with position noise) per
degree of freedom, 3 and 2, mean over at most 240 positions; ``inside``: share inside the 95 % ellipsoid; ``sigma``: RMS
of the predicted σ per coordinate [m]; ``chi2_…`` per degree of freedom, of the used positions and of the IMU; ``share``
and ``nees_chosen``: the chosen factor, and ``nees_plane`` on the first half.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from graphslam.app.machine import one_blas_thread
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.core.se3 import quat_rotate
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps_innovation import gps_innovations
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import antenna_terms
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.io.catalog import load_recording
from graphslam.solve.batch import BatchSolver
from graphslam_studies.graph.inertial_start import inertial_start, integrate_attitude
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs

Mask = npt.NDArray[np.bool_]
NOTHING = np.repeat([0.5, 3.0], 3)
"""σ of the motion between nodes [rad], [m]: a weak prior, so that the IMU determines the motion."""
MOST = 240
"""Maximum number of withheld positions whose covariances are computed."""
EDGE = 0.1
"""IMU readings extend beyond the first and the last node by this time [s]."""
STEADY_STEP = 0.25
"""Sampling time of the simulated IMU of the constant-velocity model [s]."""
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)
"""Candidate factors on the acceleration density."""


@dataclass(frozen=True, kw_only=True)
class WithheldConfig:
    """A recording, and the selection of its positions."""

    source: str
    every: float
    """Interval of the used positions [s]."""
    span: tuple[float, float] = (0.0, np.inf)
    """Part of the recording [s]."""


def used_of(times: Array, every: float) -> Mask:
    """Mask ``(n,)``: the first of ``times``, each about ``every`` seconds after the last used one, and the last."""
    used = np.zeros(len(times), dtype=np.bool_)
    last = -np.inf
    for k, t in enumerate(times.tolist()):
        if t - last >= every - 1e-3 * every - 0.01:
            used[k], last = True, t
    used[-1] = True
    return used


def steady_motion(fixes: Gps, share: float = 1.0) -> Imu:
    """Constant-velocity model as IMU readings: no rotation, gravity only, acceleration noise estimated from the fixes.

    A second difference of positions with interval T has the variance ``2/3 q T³ + 6 σ²``, where q is the power spectral
    density of the acceleration noise; q is computed from the mean square in the plane. ``share`` is a factor on √q.
    """
    T = np.diff(fixes.times)
    alike = np.abs(T[1:] - T[:-1]) < 0.1 * T[1:]
    step = T[1:][alike][:, None]
    bend = np.diff(fixes.positions[:, :2], n=2, axis=0)[alike]
    q = float(np.mean((bend**2 - 6.0 * fixes.sigma[2:][alike, None] ** 2) / (2.0 / 3.0 * step**3)))
    density = share * float(np.sqrt(max(q, 1e-6)))
    n = int(np.ceil((fixes.times[-1] - fixes.times[0]) / STEADY_STEP)) + 1
    times = fixes.times[0] - EDGE + (fixes.times[-1] - fixes.times[0] + 2.0 * EDGE) * np.arange(n) / (n - 1)
    noise = ImuNoise(
        gyro=1e-3, gyro_bias=0.0, gyro_walk=0.0, accelerometer=density, accelerometer_bias=0.0, accelerometer_walk=0.0
    )
    return Imu(
        times=times, angular_rate=np.zeros((n, 3)), specific_force=np.tile([0.0, 0.0, GRAVITY], (n, 1)), noise=noise
    )


def graph_of_fixes(imu: Imu, fixes: Gps, used: Mask, attitudes: Array) -> FactorGraph:
    """Graph with a node at every position, IMU factors between them, and the used positions as fixes; optimised.

    Parameters
    ----------
    fixes : Gps
        Within the time span of the IMU.
    used : (n,) bool
    attitudes : (n, 4)
        Initial values (quaternions), in the frame of the positions.
    """
    at = fixes.times
    line = np.stack([np.interp(at, at[used], c) for c in fixes.positions[used].T], axis=-1)
    path = np.concatenate([line - line[0], attitudes], axis=1)
    path[:, :3] -= quat_rotate(attitudes, np.broadcast_to(fixes.lever, (len(at), 3)))
    graph, P = FactorGraph(3), np.diag(NOTHING**2)
    frame = np.append(path[0, :3], [0.0, 0.0, 0.0, 1.0])  # first base: level; others: attitude of the body
    for k in range(len(at) - 1):
        local = SE3.between(np.stack([frame, frame]), path[k : k + 2])
        rows = Trajectory(at[k : k + 2], local, np.stack([1e-12 * np.eye(6), P]))
        span = float(at[k]), float(at[k + 1])
        graph.add_submap(
            Submap(key=k, interval=span, exit_pose=local[1], exit_covariance=P, trajectory=rows, uses=frozenset({"-"}))
        )
        frame = path[k + 1]
    graph.add_attitude(0, [0.0, 0.0, -1.0], 0.2, evidence="prior")
    graph.add_sensor(fixes.take(used), config=GpsConfig(baseline=0.3))
    graph.finish_sensors()
    graph.add_sensor(imu, config=ImuConfig(axes="ignore", longest=60.0, pause=60.0))
    solver = BatchSolver(graph)
    solver.update()
    for _ in range(4):
        if not ImuFactors.of(graph).recentre():
            break
        solver.update()
    return graph


def predicted(graph: FactorGraph, fixes: Gps) -> Array:
    """All positions ``(n, 3)``, used or not, as estimated by a graph of :func:`graph_of_fixes` [m]."""
    nodes = np.array([s.node for s in graph.submaps] + [graph.submaps[-1].exit_node])
    T = graph.values.poses[nodes]
    first = graph.submaps[0].trajectory
    assert first is not None
    assert graph.values.datum is not None
    assert graph.gps_origin is not None
    T[0] = SE3.compose(T[0], first.poses[0])  # first body pose, relative to the level first base
    arm = np.broadcast_to(fixes.lever, (len(nodes), 3))
    return antenna_terms(T, graph.values.datum, graph.values.tilt, arm)[0] + graph.gps_origin


def run_withheld_trial(config: WithheldConfig, seed: int) -> list[Measurement]:
    """All metrics of one run; it is deterministic."""
    with one_blas_thread():
        return list(_figures(config))


def _figures(config: WithheldConfig) -> Iterator[Measurement]:
    log = load_recording(config.source)
    fixes: Gps = log[str(log.of_type(Gps))]
    unit = log.of_type(Imu)
    low, high = config.span
    if unit is not None:
        imu: Imu = log[unit]
        low, high = max(low, imu.times[0] + EDGE), min(high, imu.times[-1] - EDGE)
        fixes = fixes.take((fixes.times >= low) & (fixes.times <= high))
        used = used_of(fixes.times, config.every)
        fixed = fixes.take(used)
        attitude, bias = inertial_start(imu, fixed.times, fixed.positions)
        attitudes = integrate_attitude(attitude, imu, fixes.times, bias)
        values = scores(graph_of_fixes(imu, fixes, used, attitudes), fixes, used)
    else:
        fixes = fixes.take((fixes.times >= low) & (fixes.times <= high))
        middle = fixes.times[len(fixes.times) // 2]
        known, scored = fixes.take(fixes.times < middle), fixes.take(fixes.times >= middle)
        found = {s: scores_steady(known, config.every, s)["nees_plane"] for s in SHARES}
        share = min(found, key=lambda s: abs(np.log(found[s])))
        values = {**scores_steady(scored, config.every, share), "share": share, "nees_chosen": found[share]}
    for quantity, value in values.items():
        yield Measurement("steady" if unit is None else "imu", quantity, float(value))


def scores_steady(fixes: Gps, every: float, share: float) -> dict[str, float]:
    """Metrics of fixes with the constant-velocity model; see :func:`steady_motion`."""
    used = used_of(fixes.times, every)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(fixes.times), 1))
    return scores(graph_of_fixes(steady_motion(fixes.take(used), share), fixes, used, level), fixes, used)


def scores(graph: FactorGraph, fixes: Gps, used: Mask) -> dict[str, float]:
    """Metrics of a graph of :func:`graph_of_fixes`; see the module."""
    off = predicted(graph, fixes) - fixes.positions
    wrong = np.linalg.norm(off[~used], axis=1)
    fixed = fixes.take(used)
    line = np.stack([np.interp(fixes.times, fixed.times, c) for c in fixed.positions.T], axis=-1) - fixes.positions
    rows = np.flatnonzero(~used)
    some = rows[np.unique(np.linspace(0, len(rows) - 1, min(MOST, len(rows))).astype(int))]
    seen = gps_innovations(graph, fixes.take(some))
    each = seen.tests()[0]
    plane, e = seen.blocks[:, :2, :2], seen.innovations[:, :2]
    score = graph.objective()
    return {
        "rmse": float(np.sqrt(np.mean(wrong**2))),
        "median": float(np.median(wrong)),
        "worst": float(wrong.max()),
        "rmse_plane": float(np.sqrt(np.mean(np.sum(off[~used, :2] ** 2, axis=1)))),
        "straight": float(np.sqrt(np.mean(np.sum(line[~used] ** 2, axis=1)))),
        "nees": float(each["value"]),
        "inside": float(each["inside"]),
        "nees_plane": float(np.mean(np.einsum("ki,ki->k", e, np.linalg.solve(plane, e[..., None])[..., 0])) / 2.0),
        "sigma": float(np.sqrt(np.mean(np.trace(seen.blocks, axis1=1, axis2=2)) / 3.0)),
        "chi2_gps": score["gps"].chi2_per_dof,
        "chi2_imu": score["imu"].chi2_per_dof,
        "used": float(used.sum()),
        "withheld": float((~used).sum()),
    }


class WithheldStudy(WorldsStudy[WithheldConfig]):
    """See the module."""

    run_one = staticmethod(run_withheld_trial)

    def default_trials(self, quick: bool) -> int:
        """One, because the study is deterministic."""
        return 1

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``errors`` and ``consistency`` (consistency), one row per world."""
        wide = table.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", sort=False)
        errors = ["used", "withheld", "rmse", "median", "worst", "rmse_plane", "straight"]
        consistency = ["nees", "nees_plane", "inside", "sigma", "chi2_gps", "chi2_imu"]
        return {"errors": wide[errors].reset_index(), "consistency": wide[consistency].reset_index()}

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Error and NEES of all runs."""
        return draw_runs(table, {"rmse": "error of withheld positions [m]", "nees": "NEES/n"}, folder)


_FLIGHT = WithheldConfig(source="euroc-mh01-imu-leica", every=1.0)
_DRIVE = WithheldConfig(source="gtsam-kitti-gps", every=2.0)
STUDY = WithheldStudy(
    "withheld-fixes",
    "predicting withheld GPS fixes with an IMU or constant-velocity model: error and consistency on recorded logs",
    {
        "euroc-1s": _FLIGHT,
        "euroc-2s": replace(_FLIGHT, every=2.0),
        "euroc-5s": replace(_FLIGHT, every=5.0),
        "kitti-2s": _DRIVE,
        "kitti-4s": replace(_DRIVE, every=4.0),
    },
    {"euroc-quick": replace(_FLIGHT, span=(40.0, 60.0)), "kitti-quick": replace(_DRIVE, span=(0.0, 60.0))},
    trials=1,
)
