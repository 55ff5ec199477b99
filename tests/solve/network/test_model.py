"""Residuals, Jacobians and starts of pose networks against GTSAM, finite differences and a second implementation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array, se2_between
from graphslam.core.network import PoseNetwork
from graphslam.graph.gtsam_values import from_gtsam
from graphslam.graph.network import network_values, problem_of_network
from graphslam.graph.noise import whiteners
from graphslam.graph.variables import gtsam_key
from graphslam.solve.network.diagnose import check_determined, check_full_rank
from graphslam.solve.network.start import chordal_start, landmarks_from, odometry_start, tree_start
from tests.reference.gtsam_network import to_graph
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.plain_network import (
    Layout,
    compose,
    edge_costs,
    exp,
    linearise,
    objective,
)
from tests.reference.slow_pose_network import SlowSolver, matrices


def random_network(
    rng: np.random.Generator, dim: int, n: int = 12, *, noise: float = 0.05, marks: str | None = None, **changes: Any
) -> tuple[PoseNetwork, Array, Array]:
    """A ring with chords (and landmarks); returns it with the true poses and landmarks."""
    width, d = (3, 3) if dim == 2 else (7, 6)
    step = np.zeros((n, d))
    step[:, 0 if dim == 2 else 3] = 1.0
    step[:, 2] = 2 * np.pi / n
    poses = np.zeros((n, width))
    poses[0, -1] = 0.3 if dim == 2 else 1.0
    for k in range(1, n):
        poses[k] = compose(poses[k - 1], exp(step[k] + 0.1 * rng.standard_normal(d)))
    pairs = [(k, k + 1) for k in range(n - 1)] + [(n - 1, 0), (7, 2), (3, 9)]
    edges = np.array(pairs)
    A = rng.standard_normal((len(edges), d, d))
    information = A @ np.swapaxes(A, 1, 2) + np.eye(d)
    truth = (se2_between if dim == 2 else se3.se3_between)(poses[edges[:, 0]], poses[edges[:, 1]])
    z = compose(truth, exp(noise * rng.standard_normal((len(edges), d))))
    arguments: dict[str, Any] = {
        "dim": dim,
        "ids": np.arange(n) + 5,
        "poses": poses,
        "has_initial": np.ones(n, bool),
        "edges": edges,
        "measurements": z,
        "information": information,
    }
    points = np.zeros((0, 2))
    if marks:
        points = rng.uniform(-3, 3, (4, 2)) + poses[:, :2].mean(0)
        seen = np.array([(k, k % 4) for k in range(n)])
        local = se2_between(poses[seen[:, 0]], np.pad(points[seen[:, 1]], ((0, 0), (0, 1))))[:, :2]
        values = local
        if marks == "bearing-range":
            values = np.stack([np.arctan2(local[:, 1], local[:, 0]), np.hypot(*local.T)], 1)
            values[:, 1] += 5 * noise  # or else a distance may come out negative
        B = rng.standard_normal((n, 2, 2))
        arguments |= {
            "landmark_ids": np.arange(4) + 100,
            "landmarks": points,
            "has_landmark": np.ones(4, bool),
            "observations": seen,
            "observation_values": values + noise * rng.standard_normal((n, 2)),
            "observation_information": B @ np.swapaxes(B, 1, 2) + np.eye(2),
            "observation_kind": marks,
        }
    return PoseNetwork(**{**arguments, **changes}), poses, points


CASES = [(2, None), (2, "bearing-range"), (2, "cartesian"), (3, None)]


@pytest.mark.parametrize(("dim", "marks"), CASES)
def test_objective_and_jacobian_equal_the_slow_twin(rng: np.random.Generator, dim: int, marks: str | None) -> None:
    net, poses, points = random_network(rng, dim, noise=0.4, marks=marks)
    slow = SlowSolver(net)
    J, r = linearise(net, poses, points, Layout.of(net))
    assert r @ r == pytest.approx(objective(net, poses, points), rel=1e-12)
    assert slow.objective(matrices(poses), points) == pytest.approx(objective(net, poses, points), rel=1e-10)
    # the twin whitens with another square root: compare the normal equations, which do not depend on it
    K = slow.jacobian(matrices(poses), points)
    H, H_slow = (J.T @ J).toarray(), (K.T @ K).toarray()
    assert np.allclose(H, H_slow, rtol=0, atol=1e-6 * np.abs(H).max())
    g_slow = K.T @ slow.residuals(matrices(poses), points)
    assert np.allclose(J.T @ r, g_slow, rtol=0, atol=1e-6 * np.abs(g_slow).max())
    # the problem that solvers take, in its own order of columns and in one of elimination
    values = network_values(net, poses, points)
    for ordered in (False, True):
        flat = problem_of_network(net, ordered=ordered)
        system = flat.evaluate(values, dense=False)
        assert system.objective == pytest.approx(objective(net, poses, points), rel=1e-12)
        place = np.concatenate(
            [flat.layout.at("x", np.arange(len(poses))).ravel(), flat.layout.at("l", np.arange(len(points))).ravel()]
        )
        place = place[place >= 0]
        A = system.A.toarray()[np.ix_(place, place)]
        assert np.allclose(A, H, rtol=0, atol=1e-12 * np.abs(H).max())
        assert np.allclose(system.g[place], J.T @ r, rtol=0, atol=1e-12 * np.abs(g_slow).max())
        assert np.allclose(
            flat.evaluate(values, dense=True).A, system.A.toarray(), rtol=0, atol=1e-12 * np.abs(H).max()
        )


@pytest.mark.parametrize(("dim", "marks"), [c for c in CASES if c[1] != "cartesian"])
def test_residual_is_the_one_gtsam_evaluates(rng: np.random.Generator, dim: int, marks: str | None) -> None:
    net, poses, points = random_network(rng, dim, noise=0.8, marks=marks)
    ours = network_values(net, poses, points)
    values = to_gtsam(ours, held=True)
    assert 2 * to_graph(net).error(values) == pytest.approx(objective(net, poses, points), rel=1e-10)
    # … and it is the logarithm, not the chart (x, y, θ), in 2-D too
    assert objective(net, poses, points) != pytest.approx(objective(net, poses, points, "g2o"), rel=1e-3)
    back = from_gtsam(values, ours)
    if dim == 3:
        poses = np.concatenate([poses[:, :3], se3.quat_normalize(poses[:, 3:])], axis=1)
    assert np.allclose(back.poses, poses, atol=1e-12)
    assert np.array_equal(back.landmarks[:, :2], points)


def test_g2o_residual_of_one_edge_by_hand() -> None:
    """z = identity, x_j turned by 0.6 rad about z and moved by (1, 2, 3): g2o sees t and sin(0.3)."""
    net = PoseNetwork(
        dim=3,
        ids=np.arange(2),
        poses=np.array([[0, 0, 0, 0, 0, 0, 1.0], [1, 2, 3, 0, 0, np.sin(0.3), np.cos(0.3)]]),
        has_initial=np.ones(2, bool),
        edges=np.array([[0, 1]]),
        measurements=np.array([[0, 0, 0, 0, 0, 0, 1.0]]),
        information=np.diag([7.0, 7, 4, 1, 1, 1])[None],
    )
    assert objective(net, net.poses, net.landmarks, "g2o") == pytest.approx(1 + 4 + 9 + 4 * np.sin(0.3) ** 2)
    assert edge_costs(net, net.poses)[0] > 4 * 0.6**2


def test_square_root_of_semidefinite_information(rng: np.random.Generator) -> None:
    A = rng.standard_normal((5, 3, 2))
    omega = A @ np.swapaxes(A, 1, 2)
    omega[0], omega[1] = np.diag([4.0, 9.0, 0.0]), np.diag([1.0, 0.25, 16.0])
    R = whiteners(omega)
    assert (np.diagonal(R, axis1=1, axis2=2) >= 0.0).all()  # GTSAM takes a diagonal one for standard deviations
    assert np.allclose(np.tril(R, -1), 0.0, atol=1e-15)  # GTSAM wants it upper triangular
    assert np.allclose(np.swapaxes(R, 1, 2) @ R, omega, atol=1e-12)


@pytest.mark.parametrize(("dim", "marks"), CASES)
def test_every_start_is_exact_without_noise(rng: np.random.Generator, dim: int, marks: str | None) -> None:
    net, poses, points = random_network(rng, dim, noise=0.0, marks=marks)
    for make in (odometry_start, tree_start):
        start = make(net)
        assert objective(net, start, landmarks_from(net, start)) < 1e-18
    start, found = chordal_start(net)
    assert np.allclose(start, poses, atol=1e-7)
    assert np.allclose(found, points, atol=1e-7)


def test_rotations_first_agrees_with_gtsams_chordal_initialisation(rng: np.random.Generator) -> None:
    net, _, _ = random_network(rng, 3, n=30, noise=0.05)
    net = replace(net, information=np.tile(np.eye(6), (len(net.edges), 1, 1)))  # GTSAM weights all edges alike
    ours = se3.quat_to_matrix(chordal_start(net)[0][:, 3:])
    found = gtsam.InitializePose3.computeOrientationsChordal(gtsam.InitializePose3.buildPose3graph(to_graph(net)))
    theirs = np.array([found.atRot3(gtsam_key(f"x{k}")).matrix() for k in range(len(net))])
    # GTSAM relaxes the held rotation as well, which turns everything; compare relative to the first vertex
    ours, theirs = (R[0].T @ R for R in (ours, theirs))
    angle = np.linalg.norm(se3.so3_log(se3.matrix_to_quat(np.swapaxes(ours, 1, 2) @ theirs)), axis=1)
    assert angle.max() < 0.01  # the noise of one edge is 0.09


def test_separate_parts_are_named(rng: np.random.Generator) -> None:
    net, _, _ = random_network(rng, 2)
    kept = [*range(7), 9, 10]  # 0-…-7, 9-10-11, and 8 alone
    net = replace(net, edges=net.edges[kept], measurements=net.measurements[kept], information=net.information[kept])
    with pytest.raises(IndeterminateError) as caught:
        check_determined(net, problem_of_network(net))
    assert caught.value.variables == ("vertex 13", "vertex 14", "vertex 15", "vertex 16")
    assert "2 separate parts" in str(caught.value)
    assert "FIX" in str(caught.value)


def test_singular_information_that_leaves_a_vertex_free_is_named(rng: np.random.Generator) -> None:
    net, poses, _ = random_network(rng, 2)
    info = np.tile(np.eye(3), (3, 1, 1))
    info[2, 2, 2] = 0.0  # the heading of the last vertex is not measured
    loose = PoseNetwork(
        dim=2,
        ids=net.ids[:4],
        poses=poses[:4],
        has_initial=np.ones(4, bool),
        edges=net.edges[:3],
        measurements=net.measurements[:3],
        information=info,
    )
    with pytest.raises(IndeterminateError) as caught:
        check_full_rank(loose, problem_of_network(loose), network_values(loose, poses[:4]))
    assert caught.value.variables[0] == "vertex 8"
    info[2, 2, 2] = 1e-3
    sound = replace(loose, information=info)
    check_full_rank(sound, problem_of_network(sound), network_values(sound, poses[:4]))
