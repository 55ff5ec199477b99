"""Fixes inside landmark submaps: points of the path that are part of the submap's own Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end
from graphslam.core.errors import GeometryError
from graphslam.core.geometry import rotation2, se2_compose, se2_exp, se2_transform
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.evaluate.gps_innovation import gps_innovations
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.landmark_submap import PathRecord
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.io.submap_file import submap_arrays, submap_from_arrays
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from graphslam_frontends.landmarks.smoothing_kernels import (
    SmoothingMeasurements,
    path_covariances,
    smoothed_covariances,
)
from graphslam_studies.charts import ChartConfig, draw_log

FRAME = np.array([50.0, -20.0, 0.6])


def log_with_fixes(seed: int, sigma: float, *, every: int = 10, lever=(0.0, 0.0)) -> SensorLog:
    """A short drive; fixes at instants that are no scan's."""
    c = ChartConfig(seconds=60.0, landmarks=50, speed=1.5, odometry=(0.03, 0.02, 0.6))
    log = draw_log(c, SeedTree(seed))
    path = log.truth.trajectory
    times = path.times[3::every] + 0.02
    times = times[times < path.times[-1]]
    antenna = se2_transform(path.interpolate(times), np.broadcast_to(lever, (len(times), 2)))
    noise = sigma * SeedTree(seed).child("fixes").generator().standard_normal((len(times), 2))
    fixes = Gps(
        times=times, positions=se2_transform(FRAME, antenna) + noise, sigma=np.full(len(times), sigma),
        lever=np.array(lever),
    )  # fmt: skip
    return SensorLog(name="fixes", streams={**log.streams, "gps": fixes}, truth=log.truth)


def submaps_of(log: SensorLog, front_end: str = "rbpf-ekf") -> list[Submap]:
    stopping = {"max_distance": 18.0, "num_features": 10**6, "time_max": 1e6, "max_scans": 10**6}
    options = {"association": "known", "max_range": 25.0, "stopping": stopping}
    if front_end == "rbpf-ekf":
        options["particles"] = 4
    return list(make_front_end(front_end, options).submaps(log, seed=SeedTree(3)))


def solved(submaps, gps, *, solver=BatchSolver, **config) -> FactorGraph:
    graph = FactorGraph()
    graph.add_sensor(gps, config=GpsConfig(baseline=5.0, **config))
    made = solver(graph)
    for s in submaps:
        graph.add_submap(s)
        if solver is Isam2Solver:
            made.update()
    graph.finish_sensors()
    made.solve_to_optimum()
    return graph


@pytest.fixture(scope="module")
def drive() -> tuple[SensorLog, list[Submap]]:
    log = log_with_fixes(5, 0.05)
    return log, submaps_of(log)


def dense_covariance(poses, landmarks, evidence):
    """The slow twin: the whole normal matrix of all poses and landmarks by numeric derivatives of the residuals."""
    T, n = len(poses), len(landmarks)

    def residuals(step):
        x = se2_compose(poses, se2_exp(step[: 3 * T].reshape(T, 3)))
        l = landmarks + step[3 * T :].reshape(n, 2)
        before = np.concatenate([np.zeros((1, 3)), x[:-1]])
        out = []
        for k in range(T):
            R = rotation2(before[k, 2])
            between = np.array([*(R.T @ (x[k, :2] - before[k, :2])), x[k, 2] - before[k, 2]])
            Ru = rotation2(evidence.u[k, 2])
            e = np.array([*(Ru.T @ (between[:2] - evidence.u[k, :2])), between[2] - evidence.u[k, 2]])
            out.append(np.linalg.cholesky(evidence.W[k]).T @ e)
        for k, j, z in zip(evidence.ob_pose, evidence.ob_lm, evidence.ob):
            d = rotation2(x[k, 2]).T @ (l[j] - x[k, :2])
            out.append(np.array([np.hypot(*d) / np.sqrt(z[2]), np.arctan2(d[1], d[0]) / np.sqrt(z[3])]))
        return np.concatenate(out)

    size, h = 3 * T + 2 * n, 1e-6
    J = np.stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(size)], axis=1)
    return np.linalg.inv(J.T @ J)


def test_joint_covariances_equal_the_dense_ones(rng):
    T, n = 6, 4
    u = np.column_stack([rng.uniform(0.5, 1.0, T), 0.1 * rng.standard_normal(T), 0.2 * rng.standard_normal(T)])
    poses = np.zeros((T, 3))
    for k in range(T):
        poses[k] = se2_compose(poses[k - 1] if k else np.zeros(3), u[k])
    landmarks = rng.uniform(-4.0, 8.0, (n, 2))
    pairs = np.array([(k, j) for j in range(n) for k in range(T) if (k + j) % 2 == 0])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    first = list(dict.fromkeys(pairs[:, 1].tolist()))
    landmarks = landmarks[first]
    pairs[:, 1] = [first.index(j) for j in pairs[:, 1]]
    W = np.stack([np.linalg.inv(np.diag(rng.uniform(1e-3, 1e-2, 3))) for _ in range(T)])
    z = np.column_stack([np.zeros((len(pairs), 2)), np.full(len(pairs), 0.01), np.full(len(pairs), 1e-3)])
    d = np.einsum("kji,kj->ki", rotation2(poses[pairs[:, 0], 2]), landmarks[pairs[:, 1]] - poses[pairs[:, 0], :2])
    z[:, 0], z[:, 1] = np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])
    evidence = SmoothingMeasurements(u, W, pairs[:, 0].copy(), pairs[:, 1].copy(), z, np.ones(len(z)), np.zeros(3))
    at = np.array([-1, 1, 1, 3, 4], dtype=np.int64)
    G0, G1 = rng.standard_normal((5, 2, 3)), rng.standard_normal((5, 2, 3))
    G0[0] = 0.0
    cross, own = path_covariances(poses, landmarks, evidence, at, G0, G1)
    P = dense_covariance(poses, landmarks, evidence)
    M = np.zeros((10, len(P)))
    for p, k in enumerate(at):
        if k >= 0:
            M[2 * p : 2 * p + 2, 3 * k : 3 * k + 3] += G0[p]
        M[2 * p : 2 * p + 2, 3 * k + 3 : 3 * k + 6] += G1[p]
    kept = np.concatenate([np.arange(3 * T - 3, 3 * T), np.arange(3 * T, len(P))])
    assert np.allclose(own, M @ P @ M.T, rtol=1e-4, atol=1e-9)
    assert np.allclose(cross, (M @ P)[:, kept], rtol=1e-4, atol=1e-9)
    assert np.allclose(smoothed_covariances(poses, landmarks, evidence)[0], P[np.ix_(kept, kept)], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("front_end", ["rbpf-ekf", "ekf"])
@pytest.mark.parametrize("lever", [(0.0, 0.0), (1.2, -0.4)])
def test_points_are_where_the_path_has_the_antenna(front_end, lever):
    log = log_with_fixes(6, 0.05, lever=lever)
    for s in submaps_of(log, front_end):
        p = s.landmarks.path
        assert len(p) > 8
        assert np.array_equal(p.lever, lever)
        joint = np.block([[s.landmarks.covariance, p.cross.T], [p.cross, p.covariance]])
        assert np.linalg.eigvalsh(joint).min() > 0
        if front_end == "rbpf-ekf":  # a filter's own path is not the smoothed one
            poses = s.trajectory.interpolate(p.times)
            assert np.allclose(p.positions, se2_transform(poses, np.broadcast_to(lever, (len(p), 2))), atol=1e-9)
        # the last fix is a little before the exit: nearly as unsure, and nearly the same error
        own, exit_ = p.covariance[-2:, -2:], s.landmarks.covariance[:2, :2]
        if lever == (0.0, 0.0):
            assert np.trace(own) == pytest.approx(np.trace(exit_), rel=0.35)
            assert np.trace(p.cross[-2:, :2]) > 0.8 * np.trace(own)


def test_a_point_that_nobody_measures_changes_nothing(drive):
    log, submaps = drive
    gps = log["gps"]
    bare = [replace(s, landmarks=replace(s.landmarks, path=None)) for s in submaps]
    measured = solved(submaps, gps.with_sigma(1e5))
    plain = solved(bare, gps.with_sigma(1e5))
    assert np.allclose(measured.values.poses, plain.values.poses, atol=1e-6)
    P, Q = (g.covariance().poses() for g in (measured, plain))
    assert np.allclose(P, Q, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("chart", ["group", "cartesian"])
def test_batch_and_isam2_agree_and_no_dof_is_made(drive, chart):
    log, submaps = drive
    of = [replace(s, landmarks=replace(s.landmarks, chart=chart)) for s in submaps]
    one, other = solved(of, log["gps"]), solved(of, log["gps"], solver=Isam2Solver)
    assert one.objective().total == pytest.approx(other.objective().total, rel=1e-7)
    assert np.allclose(one.values.poses, other.values.poses, atol=1e-5)
    assert np.allclose(one.values["point"], other.values["point"], atol=1e-5)
    assert one.objective()["path"].dof == 0
    assert one.values.count("point") == sum(r.point is not None for r in one.records.values() if hasattr(r, "point"))


def test_joint_rows_are_consistent_and_nearer_where_arms_are_not():
    """5 cm: arms with a variance of their own claim half of the error they make."""
    scores = {True: [], False: []}
    errors = {True: [], False: []}
    for seed in range(6):
        log = log_with_fixes(20 + seed, 0.05)
        submaps = submaps_of(log)
        for kept in (True, False):
            some = submaps if kept else [replace(s, landmarks=replace(s.landmarks, path=None)) for s in submaps]
            graph = solved(some, log["gps"])
            nodes = np.array([s.exit_node for s in graph.submaps])
            lay, cov = graph.flat().layout, graph.covariance()
            times = np.array([s.interval[1] for s in submaps])
            D = graph.values.datum.copy()
            D[:2] += graph.gps_origin
            where = se2_transform(D, graph.values.poses[nodes, :2])
            true = se2_transform(FRAME, log.truth.trajectory.interpolate(times)[:, :2])
            for k, node in enumerate(nodes):
                columns = np.concatenate([lay.pose_columns(np.array([node]))[0], lay.columns("datum")])
                R = rotation2(D[2])
                x = graph.values.poses[node]
                J = np.zeros((2, 6))
                J[:, :2], J[:, 3:5] = R @ rotation2(x[2]), R
                J[:, 5] = R @ np.array([-x[1], x[0]])
                P = J @ cov.columns(columns) @ J.T
                e = where[k] - true[k]
                scores[kept].append(e @ np.linalg.solve(P, e) / 2.0)
                errors[kept].append(e @ e)
    assert 0.5 < np.mean(scores[True]) < 1.5
    assert np.mean(scores[False]) > 1.8
    assert np.mean(errors[True]) < 0.8 * np.mean(errors[False])


def test_a_withheld_fix_is_predicted_by_the_joint_rows(drive):
    """The slow twin: the same fixes in the graph with no weight, each at a point that the graph then solves for."""
    log, submaps = drive
    gps = log["gps"]
    used, withheld = gps.take(slice(0, None, 2)), gps.take(slice(1, None, 2))
    graph = solved(submaps, used)
    got = gps_innovations(graph, withheld)
    graph.add_sensor(withheld, config=GpsConfig(sigma=1000.0, baseline=5.0))
    graph.finish_sensors()
    BatchSolver(graph).solve_to_optimum()
    lay, cov, v = graph.flat().layout, graph.covariance(), graph.values
    R = rotation2(v.datum[2])
    at = {r.time: r for r in graph.records.values() if getattr(r, "point", None) is not None}
    rows = [k for k, t in enumerate(got.times) if t in at]
    assert len(rows) > 0.8 * len(got.times)
    columns, J = [lay.columns("datum")], np.zeros((2 * len(rows), 3 + 2 * len(rows)))
    where = np.zeros((len(rows), 2))
    for i, k in enumerate(rows):
        r = at[got.times[k]]
        p = v["point"][r.point]
        columns.append(lay.columns(f"point{r.point}"))
        J[2 * i : 2 * i + 2, :2], J[2 * i : 2 * i + 2, 2] = R, R @ np.array([-p[1], p[0]])
        J[2 * i : 2 * i + 2, 3 + 2 * i : 5 + 2 * i] = R
        where[i] = r.z - (R @ p + v.datum[:2])
    S = J @ cov.columns(np.concatenate(columns)) @ J.T + 0.05**2 * np.eye(len(J))
    assert np.allclose(got.innovations[rows], where, atol=2e-4)
    ix = (2 * np.array(rows)[:, None] + np.arange(2)).ravel()
    assert np.abs(got.covariance[np.ix_(ix, ix)] - S).max() < 0.01 * np.diag(S).mean()


def test_points_leave_with_their_submap_and_follow_its_landmarks(drive):
    log, submaps = drive
    graph = solved(submaps, log["gps"])
    merged = {int(i) for i in graph.values.landmark_ids}
    drop = int(graph.values.landmark_ids[-1])
    keep = int(graph.values.landmark_ids[0])
    graph.merge_landmarks(keep, drop)
    assert merged - {drop} == set(graph.values.landmark_ids.tolist())
    paths = [r for r in graph.records.values() if isinstance(r, PathRecord)]
    assert len(paths) == len(submaps)
    assert all(drop not in r.landmark_ids for r in paths)
    last = graph.submaps[-1]
    before = graph.values.count("point")
    removed = len(last.inner_points.rows)
    graph.remove(last.factor_id)
    assert graph.values.count("point") == before - removed > 0
    BatchSolver(graph).solve_to_optimum()
    held = [n for r in graph.records.values() for n in r.variables() if n.startswith("point")]
    assert {int(n[5:]) for n in held} == set(range(before - removed))


def test_the_store_keeps_them_and_maps_without_them_are_read(drive):
    _, submaps = drive
    arrays = {k: np.asarray(v) for k, v in submap_arrays(submaps[1]).items()}
    back = submap_from_arrays(arrays, where="here")
    for part in ("times", "lever", "positions", "covariance", "cross"):
        assert np.array_equal(getattr(back.landmarks.path, part), getattr(submaps[1].landmarks.path, part))
    old = {k: v for k, v in arrays.items() if not k.startswith("path_")}
    assert submap_from_arrays(old, where="here").landmarks.path is None
    fewer = submaps[1].landmarks.subset([0, 2])
    assert fewer.path.cross.shape == (2 * len(fewer.path), 7)
    assert np.array_equal(fewer.path.cross[:, 3:5], submaps[1].landmarks.path.cross[:, 3:5])
    with pytest.raises(GeometryError, match="fit"):
        replace(fewer.path, positions=np.zeros((1, 2)))
