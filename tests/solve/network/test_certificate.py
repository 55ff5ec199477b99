"""Certificates: the dual matrix against dense algebra and differences, global minima certified, local ones refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.solve_file import solve_file
from graphslam.core.network import PoseNetwork
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.network import network_values, problem_of_network
from graphslam.io.g2o import write_g2o
from graphslam.io.network_file import read_network
from graphslam.solve.batch import BatchSolver
from graphslam.solve.descent import descend_to_minimum
from graphslam.solve.network.certificate import (
    _descend,
    _matrices,
    _stack,
    certify,
    dual_matrix,
    isotropic,
    residual_matrix,
)
from graphslam.solve.network.solve import solve_network
from graphslam.solve.sparse import SparseProblem
from tests.reference.plain_network import exp
from tests.solve.network.test_model import random_network


def relaxed(net: PoseNetwork, poses: np.ndarray) -> float:
    """F, one edge at a time."""
    t, R = _matrices(net, poses)
    z, Z = _matrices(net, net.measurements)
    total = 0.0
    for (i, j), k, s, a, A in zip(net.edges, *isotropic(net), z, Z, strict=True):
        total += k * np.sum((R[j] - R[i] @ A) ** 2) + s * np.sum((t[j] - t[i] - R[i] @ a) ** 2)
    return float(total)


@pytest.mark.parametrize("dim", [2, 3])
def test_relaxed_objective_and_its_stationary_points(rng: np.random.Generator, dim: int) -> None:
    net, poses, _ = random_network(rng, dim, noise=0.1)
    A = residual_matrix(net, *isotropic(net))
    Q = A.T @ A
    X = _stack(*_matrices(net, poses))
    assert np.sum(X * (Q @ X)) == pytest.approx(relaxed(net, poses), rel=1e-10)
    Y, value, stationary = _descend(net, A, poses)
    assert stationary
    assert value < relaxed(net, poses)
    # X S = 0 at a stationary point, and only there; at the minimum S has the gauge as null space and nothing below
    S = dual_matrix(A, Y).toarray()
    assert np.abs(S @ Y).max() < 1e-5 * np.abs(Q @ X).max()
    assert np.abs(dual_matrix(A, X) @ X).max() > 1e-3 * np.abs(Q @ X).max()
    w = np.linalg.eigvalsh(S)
    assert w[0] > -1e-7 * w[-1]
    assert (np.abs(w[: dim + 1]) < 1e-7 * w[-1]).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_small_isotropic_noise_is_certified(rng: np.random.Generator, dim: int) -> None:
    net, _, _ = random_network(rng, dim, noise=0.05)
    d = net.tangent_dim
    net = replace(net, information=np.tile(np.diag(np.linspace(100, 100, d)), (len(net.edges), 1, 1)))
    found = solve_network(net, certificate=True).certificate
    assert found is not None
    assert str(found) == "certified"
    assert abs(found.smallest_eigenvalue) < 1e-5


def twisted_ring(n: int, turns: int) -> tuple[PoseNetwork, np.ndarray]:
    """A ring of headings that should all be equal, wound up by whole turns: a local minimum that everyone can see."""
    poses = np.zeros((n, 3))
    edges = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    net = PoseNetwork(
        2,
        np.arange(n),
        poses,
        np.ones(n, bool),
        edges,
        np.zeros((n, 3)),
        np.tile(np.diag([1e-3, 1e-3, 1.0]), (n, 1, 1)),
    )
    wound = poses.copy()
    wound[:, 2] = 2 * np.pi * turns * np.arange(n) / n
    return net, wound


def test_a_wound_up_ring_is_a_local_minimum_and_refused() -> None:
    net, wound = twisted_ring(20, 1)
    problem = SparseProblem(problem_of_network(net))
    end = descend_to_minimum(problem, (network_values(net, wound)))
    assert end.status == "converged"
    assert end.objective == pytest.approx(20 * (2 * np.pi / 20) ** 2, rel=1e-6)
    refused = certify(net, end.values.poses, end.objective)
    assert refused.verdict == "not certified"
    assert refused.smallest_eigenvalue < -1e-3
    assert str(refused) == f"not certified (λ_min = {refused.smallest_eigenvalue:.3g})"
    straight = solve_network(net, certificate=True)
    assert str(straight.certificate) == "certified"


def test_a_graph_of_a_run_is_judged_too(rng: np.random.Generator) -> None:
    net, wound = twisted_ring(20, 1)
    graph = FactorGraph(2)
    cov = np.linalg.inv(net.information)
    graph.add_betweens(net.edges, net.measurements, cov, poses=wound[1:], evidence="shared-scan")
    solver = BatchSolver(graph)
    solver.solve_to_optimum()
    assert solver.solution().converged
    assert solver.solution().objective == pytest.approx(20 * (2 * np.pi / 20) ** 2, rel=1e-6)
    assert solver.solution().certificate().verdict == "not certified"
    graph.add_range(2, 9, 4.0, 0.3, evidence="shared-scan")
    assert "other kinds (range)" in str(solver.solution().certificate())


def test_what_cannot_be_judged_says_why(rng: np.random.Generator) -> None:
    marks, poses, _ = random_network(rng, 2, marks="bearing-range")
    assert str(certify(marks, poses, 0.0)) == "not known (landmark observations are not part of the relaxation)"
    net, poses, _ = random_network(rng, 3)
    fixed = np.zeros(len(net), bool)
    fixed[[0, 5]] = True
    assert "held in place" in str(certify(replace(net, fixed=fixed), poses, 0.0))
    flat = net.information.copy()
    flat[2] = np.diag([1.0, 1, 1, 1, 1, 0])
    assert "singular" in str(certify(replace(net, information=flat), poses, 0.0))
    # a claim about another objective than that of the basin is not certified
    solved = solve_network(net)
    assert certify(net, solved.poses, 0.5 * solved.objective).verdict != "certified"


def test_report_holds_the_certificate_only_if_asked(rng: np.random.Generator, tmp_path: Path) -> None:
    net, _, _ = random_network(rng, 2, noise=0.01)
    write_g2o(tmp_path / "a.g2o", net)
    assert "certificate" not in solve_file(tmp_path / "a.g2o")
    report = solve_file(tmp_path / "a.g2o", certificate=True)
    assert report["certificate"] == "certified"
    assert report["certificate_numbers"]["verdict"] == "certified"
    assert "certificate" in solve_file(tmp_path / "a.g2o", "gnc", certificate=True)


@pytest.mark.data
@pytest.mark.parametrize("name", ["intel", "smallGrid3D", "kitti_06"])
def test_best_known_objectives_are_certified(data_dir: Path, name: str) -> None:
    net = read_network(data_dir / "posegraphs" / f"{name}.g2o.xz")
    solved = solve_network(net, starts=("chordal",), certificate=True)
    assert str(solved.certificate) == "certified"


@pytest.mark.data
def test_a_grid_solved_from_nonsense_is_refused(data_dir: Path) -> None:
    """Local minima of a recorded network, reached from random headings, are not certified."""
    net = read_network(data_dir / "posegraphs" / "smallGrid3D.g2o.xz")
    best = solve_network(net, starts=("chordal",)).objective
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(4):
        poses = exp(np.concatenate([2.0 * rng.standard_normal((len(net), 3)), rng.standard_normal((len(net), 3))], 1))
        poses[0] = net.poses[0]
        problem = SparseProblem(problem_of_network(net))
        end = descend_to_minimum(problem, (network_values(net, poses)))
        if end.status != "converged" or end.objective < 1.001 * best:
            continue
        found = certify(net, end.values.poses, end.objective)
        assert found.verdict != "certified"
        refused += 1
    assert refused
