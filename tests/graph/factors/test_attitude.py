"""Gravity: the residual, its tilt, levelled bases that do not drift, and what is no double count of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError, GeometryError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.poses import SE3, level_poses
from graphslam.core.se3 import quat_multiply, quat_rotate, so3_exp
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import DOWN, attitude_terms, level_turn, tangent_basis, up_turn
from graphslam.graph.ledger import EvidenceUse
from graphslam.solve.batch import BatchSolver
from graphslam.solve.isam2 import Isam2Solver
from tests.reference.space_chain import dense_chain

SIGMA = 5e-3
NOISE = np.array([2 * SIGMA, 2 * SIGMA, 3e-3, 0.02, 0.02, 0.02])


def test_across_is_an_orthonormal_basis(rng):
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    B = tangent_basis(d)
    np.testing.assert_allclose(np.swapaxes(B, 1, 2) @ B, np.broadcast_to(np.eye(2), (50, 2, 2)), atol=1e-12)
    np.testing.assert_allclose(np.einsum("kij,ki->kj", B, d), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(tangent_basis(DOWN)), [[1, 0], [0, 1], [0, 0]], atol=1e-15)


def test_the_residual_is_the_sine_of_the_angle(rng):
    """Whatever the heading and the tilt of the frame; zero where the direction is what it should be."""
    pose, tilt = SE3.exp(rng.normal(size=6)), np.array([0.2, -0.1])
    up = up_turn(tilt)[0][:, 2]
    seen = quat_rotate(pose[3:] * [-1, -1, -1, 1], -up)
    r, _ = attitude_terms(pose[None], tilt, seen[None])
    np.testing.assert_allclose(r, 0.0, atol=1e-14)
    turned = pose.copy()
    turned[3:] = quat_multiply(so3_exp(0.7 * up), pose[3:])  # a turn about the vertical changes nothing
    np.testing.assert_allclose(attitude_terms(turned[None], tilt, seen[None])[0], 0.0, atol=1e-14)
    angle = 0.03
    axis = tangent_basis(seen)[:, 0]
    off = quat_rotate(so3_exp(angle * axis), seen)
    assert np.linalg.norm(attitude_terms(pose[None], tilt, off[None])[0]) == pytest.approx(np.sin(angle), rel=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-6, 9e-5, 1.1e-4, 9e-4, 1.1e-3, 0.03, 1.0])
def test_the_lean_turn_is_the_plain_one(size):
    E, J = up_turn(size * np.array([0.6, -0.8]))
    lean_E, lean_J = level_turn(size * 0.6, size * -0.8)
    np.testing.assert_allclose(lean_E, E, atol=1e-13)
    np.testing.assert_allclose(lean_J, J, atol=1e-11)


def levelled_chain(rng: np.random.Generator, m: int = 20) -> tuple[list[Submap], np.ndarray]:
    """Submaps whose bases are levelled anew, each with an error of its own; truth in the frame of the first base.

    What a submap says of its exit is level by construction: it carries the errors of levelling of both of its bases.
    """
    heading = np.cumsum(rng.uniform(-0.8, 0.8, m + 1))
    places = np.cumsum(np.column_stack([8 * np.cos(heading), 8 * np.sin(heading), rng.uniform(-0.3, 0.3, m + 1)]), 0)
    true = level_poses(places, heading)
    error = np.zeros((m + 1, 6))
    error[:, :2] = SIGMA * rng.standard_normal((m + 1, 2))
    bases = SE3.compose(true, SE3.exp(error))  # where the bases really stand
    P = np.diag(NOISE**2)
    P[[0, 1], [0, 1]] = 2 * SIGMA**2
    submaps = []
    for k in range(m):
        rest = np.zeros(6)
        rest[2:] = NOISE[2:] * rng.standard_normal(4)
        T = SE3.compose(SE3.between(bases[k], bases[k + 1]), SE3.exp(rest))
        relative = SE3.between(true[k], true[k + 1])
        half = heading[k + 1] - heading[k] + rest[2]
        exit_pose = level_poses(T[:3], half)
        assert np.abs(SE3.log(SE3.between(relative, exit_pose))).max() < 1.0
        submaps.append(Submap(key=k, interval=(10.0 * k, 10.0 * k + 10.0), exit_pose=exit_pose, exit_covariance=P))
    return submaps, SE3.between(np.broadcast_to(bases[0], bases.shape), bases)


def nees(rng: np.random.Generator, runs: int, level_sigma: float | None) -> np.ndarray:
    """Mean NEES of roll and pitch of every node along the chain ``(m,)``."""
    rows = []
    for _ in range(runs):
        submaps, truth = levelled_chain(rng)
        g = FactorGraph(3)
        for s in submaps:
            g.add_submap(s, level_sigma=level_sigma)
        BatchSolver(g).solve_to_optimum()
        e = SE3.log(SE3.between(g.values.poses, truth))[1:, :2]
        P = g.covariance().poses()[1:, :2, :2]
        rows.append(np.einsum("ki,kij,kj->k", e, np.linalg.inv(P), e))
    return np.mean(rows, axis=0)


def test_roll_and_pitch_of_levelled_bases_are_consistent_with_it_and_not_without(rng):
    runs = 60
    with_it, without = nees(rng, runs, SIGMA), nees(rng, runs, None)
    low, high = chi2_mean_bounds(2, runs, 0.999)
    assert np.all((low < with_it) & (with_it < high))
    # neighbours share a base, so the mean over the chain is known less well than that of as many independent values
    assert chi2_mean_bounds(2, 2 * runs, 0.99)[0] < with_it.mean() < chi2_mean_bounds(2, 2 * runs, 0.99)[1]
    assert without[10:].mean() < 0.5 * low  # errors that do not add up, taken for errors that do


def test_a_level_sigma_that_is_too_small_is_over_confident(rng):
    assert nees(rng, 20, 0.4 * SIGMA).mean() > chi2_mean_bounds(2, 20, 0.999)[1]


def test_roll_and_pitch_stay_bounded_along_the_chain(rng):
    submaps, _ = levelled_chain(rng, m=40)
    sigma = {}
    for level in (None, SIGMA):
        g = FactorGraph(3)
        for s in submaps:
            g.add_submap(s, level_sigma=level)
        BatchSolver(g).solve_to_optimum()
        P = g.covariance().poses()[:, :2, :2]
        sigma[level] = np.sqrt(np.trace(P, axis1=1, axis2=2) / 2)
    assert sigma[None][40] == pytest.approx(np.sqrt(40 * 2) * SIGMA, rel=0.05)
    assert sigma[SIGMA][40] == pytest.approx(np.sqrt(2) * SIGMA, rel=0.05)  # its own levelling and the first base's


@pytest.mark.parametrize("spacing", [None, 3.0])
def test_what_the_exit_says_of_all_else_is_kept(rng, spacing):
    """Giving up roll and pitch leaves position and heading as well known as before: seen from a level base."""
    chain = dense_chain(rng, 3, m=1)
    g, level = FactorGraph(3), FactorGraph(3)
    g.add_submap(chain.submaps[0], spacing=spacing)
    level.add_submap(chain.submaps[0], spacing=spacing, level_sigma=SIGMA)
    name = f"x{g.submaps[0].exit_node}"
    np.testing.assert_allclose(
        level.covariance().marginal(name)[2:, 2:], g.covariance().marginal(name)[2:, 2:], rtol=1e-4, atol=1e-9
    )
    s = level.submaps[0]
    np.testing.assert_allclose(s.stated, g.submaps[0].covariances, rtol=1e-12)
    assert s.covariances[-1][0, 0] > 1.0 > s.stated[-1][0, 0]
    assert level.ledger.table().query("kind == 'levelled'")["stream"].tolist() == ["gravity", "gravity"]
    assert level.objective()["levelled"].dof == 2 * 2 - 2  # the tilt is paid for by those who bring it in
    assert level.objective().dof == sum(r.rows for r in level.records.values()) - level.flat().layout.size
    level.remove(s.factor_ids[0])
    assert len(level.values.poses) == 1
    assert [r.group for r in level.records.values()] == ["levelled"]  # the first base still is level


def test_tilt_comes_and_goes(rng):
    chain = dense_chain(rng, 3, m=3)
    g = FactorGraph(3)
    solver = Isam2Solver(g)
    for s in chain.submaps:
        g.add_submap(s)
        solver.update()
    up = quat_rotate(chain.poses[2][3:] * [-1, -1, -1, 1], [0, 0, -9.81])
    fid = g.add_attitude(2, up, 0.01, evidence=EvidenceUse(["imu"], (15.0, 25.0)))
    assert g.values.tilt is not None
    solver.update()
    solver.solve_to_optimum()
    assert np.abs(g.values.tilt).max() < 0.05
    first = g.add_attitude(0, DOWN, 1e-3, evidence=EvidenceUse(["imu"], (0.0, 1.0)))
    solver.update()
    assert g.diagnose().ok
    assert np.sqrt(np.diag(g.covariance().marginal("tilt"))).max() < 1e-3
    with pytest.raises(EvidenceReusedError, match="imu"):
        g.add_attitude(1, DOWN, 0.01, evidence=EvidenceUse(["imu"], (20.0, 21.0)))
    g.remove(fid)
    g.remove(first)
    assert g.values.tilt is None
    solver.update()
    BatchSolver(g).solve_to_optimum()


def test_what_an_attitude_refuses(rng):
    g = FactorGraph(3)
    with pytest.raises(ConfigError, match="must name the streams"):
        g.add_attitude(0, DOWN, 0.01)
    with pytest.raises(DataError, match="not there"):
        g.add_attitude(1, DOWN, 0.01, evidence="prior")
    with pytest.raises(GeometryError, match="direction of gravity"):
        g.add_attitude(0, np.zeros(3), 0.01, evidence="prior")
    with pytest.raises(ConfigError, match="positive sigma"):
        g.add_attitude(0, DOWN, 0.0, evidence="prior")
    with pytest.raises(GeometryError, match="plane"):
        FactorGraph().add_attitude(0, DOWN, 0.01, evidence="prior")
    flat = dense_chain(rng, 2, m=1).submaps[0]
    with pytest.raises(ConfigError, match="in space"):
        FactorGraph().add_submap(flat, level_sigma=0.01)
    broken = replace(flat, trajectory=Trajectory(np.zeros(0), np.zeros((0, 3))))
    FactorGraph().add_submap(broken, spacing=3.0)
