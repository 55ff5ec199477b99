"""The GTSAM landmark-submap factor: Jacobian, noise, and what it must never do to GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from graphslam.core.geometry import se2_compose, se2_exp
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.noise import whitener
from graphslam.graph.variables import gtsam_key, key_name, vector_form
from tests.reference.graph_chain import correlated_covariance, dense_submap, end_only_submap, make_chain
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.submap_model import submap_residual


def build(rng, start: int, ids: np.ndarray, chart: str = "cartesian"):
    n = len(ids)
    z = np.concatenate([[3.0, 1.0, 0.4], rng.normal(0, 5, 2 * n)])
    P = correlated_covariance(rng, 3 + 2 * n, 0.3)
    factor = gtsam_factor(SubmapRecord(0, 0, start, ids, z, whitener(P), chart=chart), {"x0": np.zeros(3)})
    poses = {start: np.array([1.0, -2.0, 2.9]) if start else np.zeros(3), start + 1: np.array([4.0, 1.0, -2.8])}
    points = {int(i): rng.normal(0, 5, 2) for i in ids}
    values = gtsam.Values()
    for k, p in poses.items():
        if k:
            values.insert(gtsam_key(f"x{k}"), gtsam.Pose2(*p))
    for i, p in points.items():
        values.insert(gtsam_key(f"l{i}"), p)
    return factor, values, z, P, poses, points


def plain_residual(ids, z, poses, points, start, chart="cartesian"):
    seen = np.array([points[int(i)] for i in ids]).reshape(-1, 2)
    return submap_residual(poses[start], poses[start + 1], seen, z, chart)


@pytest.mark.parametrize("chart", ["cartesian", "group"])
@pytest.mark.parametrize("start", [0, 3])
@pytest.mark.parametrize("ids", [[], [7], [9, 2, 5], [4, 8, 4, 1, 8]], ids=["none", "one", "unsorted", "twice"])
def test_linearisation_matches_finite_differences(rng, start, ids, chart):
    ids = np.array(ids, dtype=np.int64)
    factor, values, z, P, poses, points = build(rng, start, ids, chart)
    W = whitener(P)
    r = W @ plain_residual(ids, z, poses, points, start, chart)
    np.testing.assert_allclose(factor.unwhitenedError(values), r, atol=1e-12)
    J, b = factor.linearize(values).jacobian()
    np.testing.assert_allclose(-b, r, atol=1e-12)
    h, columns = 1e-6, []
    for key in list(factor.keys()):
        name = key_name(key)
        for axis in range(3 if name[0] == "x" else 2):
            sides = []
            for sign in (h, -h):
                p, q = dict(poses), dict(points)
                step = np.zeros(3 if name[0] == "x" else 2)
                step[axis] = sign
                if name[0] == "x":
                    p[int(name[1:])] = se2_compose(p[int(name[1:])], se2_exp(step))
                else:
                    q[int(name[1:])] = q[int(name[1:])] + step
                sides.append(W @ plain_residual(ids, z, p, q, start, chart))
            columns.append((sides[0] - sides[1]) / (2 * h))
    np.testing.assert_allclose(J, np.array(columns).T, atol=2e-6)


def test_without_landmarks_it_is_a_between_factor(rng):
    exit_pose, P = np.array([2.0, 0.5, 0.7]), correlated_covariance(rng, 3, 0.1)
    base = np.array([1.0, 2.0, -0.9])
    systems = []
    for make in (end_only_submap, dense_submap):
        g = FactorGraph()
        g.add_submap(make(0, base, P))
        g.add_submap(make(1, exit_pose, P))
        systems.append([gtsam_factor(r, {"x0": g.origin}).linearize(to_gtsam(g.values)) for r in g.records.values()])
    for ours, native in zip(*systems):
        np.testing.assert_allclose(ours.information(), native.information(), rtol=1e-9)


def test_linearised_factor_gives_back_mean_and_covariance(rng):
    chain = make_chain(rng, m=1)
    s = chain.submaps[0]
    g = FactorGraph()
    g.add_submap(s)
    np.testing.assert_allclose(g.values.poses[1], s.landmarks.exit_pose, atol=1e-12)
    np.testing.assert_allclose(g.values.landmarks, s.landmarks.positions, atol=1e-12)
    (record,) = g.records.values()
    linear = gtsam_factor(record, {"x0": g.origin}).linearize(to_gtsam(g.values))
    names = [key_name(k) for k in list(linear.keys())]
    assert names == g.flat().layout.names()
    P = np.linalg.inv(linear.information())
    np.testing.assert_allclose(vector_form(P, g.values.poses[1:], [0]), s.landmarks.covariance, rtol=1e-9, atol=1e-14)


def test_it_never_raises_and_fills_every_jacobian(rng):
    factor, values, *_ = build(rng, 2, np.array([5, 6]))
    values.erase(gtsam_key("l6"))
    assert np.all(np.isnan(factor.unwhitenedError(values)))
    full = factor.linearize(build(rng, 2, np.array([5, 6]))[1])
    assert full.jacobian()[0].shape == (7, 10)


def test_heading_is_wrapped(rng):
    z = np.array([1.0, 0.0, np.pi - 0.01])
    factor = gtsam_factor(SubmapRecord(0, 0, 1, np.zeros(0, dtype=np.int64), z, np.eye(3)), {"x0": np.zeros(3)})
    values = gtsam.Values()
    values.insert(gtsam_key("x1"), gtsam.Pose2(0, 0, 0))
    values.insert(gtsam_key("x2"), gtsam.Pose2(1, 0, -np.pi + 0.01))
    np.testing.assert_allclose(factor.unwhitenedError(values), [0, 0, 0.02], atol=1e-12)


def test_start_pose_enters_only_through_the_relative_pose(rng):
    """Moving everything rigidly leaves the residual alone."""
    ids = np.array([1, 2, 3])
    factor, values, *_ = build(rng, 1, ids)
    T = gtsam.Pose2(3.0, -7.0, 1.3)
    moved = gtsam.Values()
    for key in list(factor.keys()):
        if key_name(key)[0] == "x":
            moved.insert(key, T.compose(values.atPose2(key)))
        else:
            moved.insert(key, T.transformFrom(values.atPoint2(key)))
    np.testing.assert_allclose(factor.unwhitenedError(moved), factor.unwhitenedError(values), atol=1e-10)
