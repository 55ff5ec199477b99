"""The study ``charts``: consistency of local maps in different parametrisations, and its effect on joined maps.

A robot drives a random path (``slow``: in parallel rows) among features with known identities; route, features and
noise are random in every run. Odometry noise is white, with the true covariance in the log. Worlds differ in heading
drift within a submap of 35 m: ``base``, ``good`` and ``poor`` sensors, ``slow`` (0.6 m/s), ``drift`` (σ of the exit
heading about 2.5°) and ``strong-drift`` (7°). In ``space`` and ``space-drift`` (σ of the exit rotation about 6°), a
robot flies among points (:mod:`graphslam_studies.sim.point_field`).

Quantities
----------
Of local map k (``local``): ``local_joint_nees``, ``local_joint_nees_plain``, ``local_joint_dof``. Of a joined map:
``nees`` and ``nees_plain`` of all poses and landmarks per degree of freedom, in the group chart and as a plain vector;
``nees_ends`` of the end poses of the submaps only, in the group chart; ``rms`` of the poses [m]; ``objective_ratio``:
objective of the joined map over that of the optimum of the same factors; ``exit_sigma``: median σ of the exit headings
(in 3-D: of one component of the rotation) [deg]; ``failed``.

Algorithms: ``eif-tree``, ``eif-sequential``, both ``-classical``; ``batch``: optimum, started from the chained end
poses, i.e. from odometry; ``eif-tree+polish``: optimum, started from the tree; ``batch-cartesian``: optimum of the
same maps with Cartesian residuals; ``unknown-eif-tree`` and its polish: identities are unknown, both within submaps
and between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam.app.compare import MapEstimate, map_nees
from graphslam.app.machine import one_blas_thread
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, se2_between, se2_compose, se2_exp, wrap_angle
from graphslam.core.log import SensorLog, Truth
from graphslam.core.map_truth import MapTruth
from graphslam.core.poses import group_of
from graphslam.core.random import SeedTree
from graphslam.core.records import LandmarkObservations, Odometry, Stream
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.join.association import MapAssociationConfig
from graphslam.join.joined_map import JoinResult
from graphslam.join.optimise import optimise_from_join
from graphslam.join.registry import JOINERS, methods_for, prepare_submaps
from graphslam.join.submap_solver import solve_submaps
from graphslam_studies.evaluate.submap_consistency import submap_nees
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole
from graphslam_studies.sim.point_field import PRESETS, PointFieldConfig, simulate_point_field

RATE, SENSOR_RATE = 10.0, 2.0
PARTICLES = 40
"""Number of particles if identities are unknown."""
JOINED = ("eif-tree", "eif-tree-classical", "eif-sequential", "eif-sequential-classical")


@dataclass(frozen=True, kw_only=True)
class ChartConfig:
    """A robot and its world.

    Parameters
    ----------
    odometry : (3,)
        σ of x, y [m] and heading [deg] per 0.1 s.
    sensor : (2,)
        σ of ranges [m] and bearings [deg].
    """

    odometry: tuple[float, float, float] = (0.02, 0.01, 0.3)
    sensor: tuple[float, float] = (0.2, 1.5)
    speed: float = 2.0
    seconds: float = 250.0
    max_range: float = 25.0
    rows: bool = False
    submap: float = 35.0
    landmarks: int = 120


def drive(c: ChartConfig, rng: np.random.Generator) -> Array:
    """True poses ``(n, 3)`` at the odometry rate: random turns around the origin, or parallel rows."""
    n, dt = round(c.seconds * RATE), 1.0 / RATE
    poses = np.zeros((n + 1, 3))
    if c.rows:
        length, apart = rng.uniform(14.0, 20.0), rng.uniform(2.0, 3.0)
        side = 1.0
        turn, along = 0.0, 0.0
        for k in range(n):
            if turn <= 0.0 and along >= length:
                turn, along, side = np.pi * 0.5 * apart, 0.0, -side
            rate = -side * c.speed / (0.5 * apart) if turn > 0.0 else 0.0
            poses[k + 1] = se2_compose(poses[k], se2_exp(np.array([c.speed * dt, 0.0, rate * dt])))
            turn, along = turn - c.speed * dt, along + (c.speed * dt if turn <= 0.0 else 0.0)
        return poses
    half, rate = 35.0, 0.0
    for k in range(n):
        home = wrap_angle(np.arctan2(-poses[k, 1], -poses[k, 0]) - poses[k, 2])
        outside = np.hypot(poses[k, 0], poses[k, 1]) > half
        wanted = 0.35 * float(np.sign(home)) if outside else 0.0
        rate += dt * (wanted - rate) / 1.5 + 0.12 * np.sqrt(dt) * rng.standard_normal()
        poses[k + 1] = se2_compose(poses[k], se2_exp(np.array([c.speed * dt, 0.0, rate * dt])))
    return poses


def draw_log(c: ChartConfig, seed: SeedTree) -> SensorLog:
    """A random log with ground truth; its odometry covariance is the true one."""
    rng = seed.child("world").generator()
    poses = drive(c, rng)
    low, high = poses[:, :2].min(axis=0) - 12.0, poses[:, :2].max(axis=0) + 12.0
    points = rng.uniform(low, high, (c.landmarks, 2))
    rng = seed.child("noise").generator()
    times = np.arange(len(poses)) / RATE
    sigma = np.array([c.odometry[0], c.odometry[1], np.deg2rad(c.odometry[2])])
    exact = se2_between(poses[:-1], poses[1:])
    noisy = se2_compose(exact, se2_exp(sigma * rng.standard_normal(exact.shape)))
    increments = np.vstack([np.zeros((1, 3)), noisy])
    covariances = np.broadcast_to(np.diag(sigma**2), (len(poses), 3, 3)).copy()
    every = round(RATE / SENSOR_RATE)
    at = np.arange(every, len(poses), every)
    seen = se2_between(poses[at][:, None], np.dstack([np.broadcast_to(points, (len(at), *points.shape)),
                                                     np.zeros((len(at), len(points)))]))  # fmt: skip
    r, b = np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])
    visible = (r < c.max_range) & (r > 1.0)
    s = np.array([c.sensor[0], np.deg2rad(c.sensor[1])])
    noise = rng.standard_normal((*r.shape, 2)) * s
    which = np.nonzero(visible)
    detections = LandmarkObservations(
        times=times[at],
        offsets=np.concatenate([[0], np.cumsum(visible.sum(axis=1))]),
        ranges=np.maximum((r + noise[..., 0])[which], 0.05),
        bearings=wrap_angle((b + noise[..., 1])[which]),
        sigmas=np.broadcast_to(s, (len(which[0]), 2)).copy(),
        ids=which[1].astype(np.int64),
        max_range=c.max_range,
    )
    truth = Truth(Trajectory(times, poses), landmark_ids=np.arange(len(points)), landmarks=points)
    streams: dict[str, Stream] = {
        "odometry": Odometry(times=times, increments=increments, covariances=covariances),
        "landmarks": detections,
    }
    return SensorLog(name="charts", streams=streams, truth=truth)


def run_trial(c: ChartConfig | PointFieldConfig, seed: int) -> list[Measurement]:
    """All metrics of one run (see the module)."""
    with one_blas_thread():
        return list(_trial_in_space(c, seed) if isinstance(c, PointFieldConfig) else _trial(c, SeedTree(seed)))


def _trial_in_space(c: PointFieldConfig, seed: int) -> Iterator[Measurement]:
    log = simulate_point_field(c, seed)
    submaps = list(make_front_end("points", {"max_distance": 12.0}).submaps(log, seed=SeedTree(seed)))
    assert log.truth is not None
    yield from _local(submaps, log.truth)
    truth = _truth_of(submaps, log.truth)
    problem = prepare_submaps(submaps)
    methods = methods_for(problem)
    optimum = methods.solvers["batch"](problem)
    yield from _judged("batch", optimum, submaps, truth, optimum.objective)
    plain = [replace(s, landmarks=replace(s.landmarks, chart="cartesian")) for s in submaps if s.landmarks is not None]
    cartesian = methods.solvers["batch"](prepare_submaps(plain))
    yield from _judged("batch-cartesian", cartesian, submaps, truth, cartesian.objective)
    for name, join in methods.joiners.items():
        yield from _judged(name, join(problem), submaps, truth, optimum.objective)


def _local(submaps: Sequence[Submap], truth: Truth) -> Iterator[Measurement]:
    for s in submaps:
        r = submap_nees(s, truth)
        yield Measurement("local", "local_joint_nees", r.joint, s.key)
        yield Measurement("local", "local_joint_nees_plain", r.joint_plain, s.key)
        yield Measurement("local", "local_joint_dof", float(r.joint_dof), s.key)
    turns = [s.exit_covariance[2:, 2:] if s.dim == 2 else s.exit_covariance[:3, :3] for s in submaps]
    sigmas = [np.sqrt(np.trace(P) / len(P)) for P in turns]
    yield Measurement("local", "exit_sigma", float(np.rad2deg(np.median(sigmas))))


def _trial(c: ChartConfig, seed: SeedTree) -> Iterator[Measurement]:
    log = draw_log(c, seed)
    stopping = {"max_distance": c.submap, "num_features": 10**6, "time_max": 1e6, "max_scans": 10**6}
    options = {"association": "known", "particles": 4, "max_range": c.max_range, "stopping": stopping}
    submaps = list(make_front_end("rbpf-ekf", options).submaps(log, seed=seed.child("frontend")))
    assert log.truth is not None
    yield from _local(submaps, log.truth)
    truth = _truth_of(submaps, log.truth)
    optimum = solve_submaps(submaps)
    yield from _judged("batch", optimum, submaps, truth, optimum.objective)
    plain = [replace(s, landmarks=replace(s.landmarks, chart="cartesian")) for s in submaps if s.landmarks is not None]
    cartesian = solve_submaps(plain)
    yield from _judged("batch-cartesian", cartesian, submaps, truth, cartesian.objective)
    for name in JOINED:
        joined: JoinResult = JOINERS[name](submaps)
        yield from _judged(name, joined, submaps, truth, optimum.objective)
        if name == "eif-tree":
            yield from _judged(f"{name}+polish", optimise_from_join(submaps, joined), submaps, truth, optimum.objective)
    options |= {"association": "likelihood", "particles": PARTICLES}
    try:
        submaps = list(make_front_end("rbpf-ekf", options).submaps(log, seed=seed.child("unknown")))
        rule = MapAssociationConfig(rule="joint", sensor_range=c.max_range)
        joined = JOINERS["eif-tree"](submaps, association=rule)
        best = optimise_from_join(submaps, joined)
    except GraphSlamError:
        yield Measurement("unknown-eif-tree", "failed", 1.0)
        return
    yield Measurement("unknown-eif-tree", "failed", 0.0)
    nobody = replace(_truth_of(submaps, log.truth), landmark_ids=np.zeros(0, np.int64), landmarks=np.zeros((0, 2)))
    for name, found in (("unknown-eif-tree", joined), ("unknown-eif-tree+polish", best)):
        yield from _judged(name, found, submaps, nobody, _objective(best))


def _judged(
    name: str, estimate: MapEstimate, submaps: list[Submap], truth: MapTruth, optimum: float
) -> Iterator[Measurement]:
    keys = [s.key for s in submaps]
    ends = replace(truth, landmark_ids=truth.landmark_ids[:0], landmarks=truth.landmarks[:0])
    for quantity, chart, known in (
        ("nees", "group", truth),
        ("nees_plain", "cartesian", truth),
        ("nees_ends", "group", ends),
    ):
        if known is ends or len(truth.landmark_ids):
            d2, dof = map_nees(estimate, keys, known, chart=chart)
            yield Measurement(name, quantity, d2 / dof)
    error = estimate.poses[1:, :2] - truth.exit_poses[:, :2]
    yield Measurement(name, "rms", float(np.sqrt(np.mean(np.sum(error**2, axis=1)))))
    yield Measurement(name, "objective_ratio", _objective(estimate) / optimum)


def _objective(estimate: MapEstimate) -> float:
    """Objective of the map; that of the optimum if it was polished."""
    polished = estimate.objective_polished
    return estimate.objective if polished is None else polished


def _truth_of(submaps: list[Submap], truth: Truth) -> MapTruth:
    base = truth.trajectory.interpolate(np.array([submaps[0].interval[0]]))[0]
    ends = truth.trajectory.interpolate(np.array([s.interval[1] for s in submaps]))
    g = group_of(base)
    return MapTruth(
        keys=np.array([s.key for s in submaps]),
        exit_poses=g.between(base, ends),
        landmark_ids=truth.landmark_ids,
        landmarks=g.transform(g.inverse(base), truth.landmarks),
    )


WORLDS: dict[str, ChartConfig | PointFieldConfig] = {
    "base": ChartConfig(),
    "good": ChartConfig(sensor=(0.05, 0.5)),
    "poor": ChartConfig(sensor=(1.0, 8.0)),
    "slow": ChartConfig(odometry=(0.005, 0.001, 0.573), speed=0.6, seconds=400.0, max_range=10.0, rows=True),
    "drift": ChartConfig(odometry=(0.03, 0.03, 1.0)),
    "strong-drift": ChartConfig(odometry=(0.1, 0.1, 3.0)),
    "space": PRESETS["flight"],
    "space-drift": PRESETS["drift"],
}
QUICK_WORLDS: dict[str, ChartConfig | PointFieldConfig] = {
    "strong-drift-quick": ChartConfig(odometry=(0.1, 0.1, 3.0), seconds=80.0, landmarks=40),
    "space-quick": PRESETS["quick"],
}


class ChartStudy(WorldsStudy[ChartConfig | PointFieldConfig]):
    """See the module."""

    run_one = staticmethod(run_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``local``: NEES per degree of freedom of local maps in both charts; ``joined``: means over the runs."""
        return {"local": local_table(table), "joined": joined_table(table)}

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """NEES of all runs."""
        return draw_runs(table, {"nees": "joint NEES/dof, group chart"}, folder)


def local_table(table: pd.DataFrame) -> pd.DataFrame:
    """One row per world: maps, median σ of exit headings, NEES per degree of freedom in both charts, 95 % bounds."""
    out = []
    for world in table["world"].unique():
        own = table[table["world"] == world]
        sums = {q: own[own["quantity"] == q]["value"] for q in
                ("local_joint_nees", "local_joint_nees_plain", "local_joint_dof")}  # fmt: skip
        dof = float(sums["local_joint_dof"].sum())
        if dof:
            out.append(
                {
                    "world": world,
                    "maps": len(sums["local_joint_dof"]),
                    "exit_sigma": float(whole(own, "exit_sigma")["value"].median()),
                    "group": float(sums["local_joint_nees"].sum()) / dof,
                    "plain": float(sums["local_joint_nees_plain"].sum()) / dof,
                    "bound": 1.96 * float(np.sqrt(2.0 / dof)),
                }
            )
    return pd.DataFrame(out)


def joined_table(table: pd.DataFrame) -> pd.DataFrame:
    """Means over the runs, one row per world and algorithm."""
    names = ["nees", "nees_plain", "nees_ends", "rms", "objective_ratio", "failed"]
    rows = table[table["quantity"].isin(names) & (table["submap"] == -1)]
    if rows.empty:
        return pd.DataFrame(columns=["world", "algorithm", *names])
    wide = rows.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", sort=False)
    return wide.reindex(columns=names).reset_index()


STUDY = ChartStudy(
    "charts",
    "in which coordinates local maps are consistent, and the filters and optima that are made of them",
    WORLDS,
    QUICK_WORLDS,
    trials=10,
)
