"""iSAM2: the gap it reports, roll-back, rejected factors, removal, merges; and the batch solver beside it."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

import graphslam.solve.isam2 as module
from graphslam.core.errors import ConfigError, IndeterminateError, SolverError, UnknownNameError
from graphslam.core.geometry import se2_between
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver, linearisation_gap, optimise_graph, state_of
from graphslam.solve.isam2 import FactorRejectedError, Isam2Solver
from graphslam.solve.registry import SOLVERS, make_solver
from tests.reference.graph_chain import dense_submap, make_chain, make_gps

C = np.diag([1e-2, 1e-2, 1e-3])


def grown(chain, upto=None, **options) -> tuple[FactorGraph, Isam2Solver]:
    g = FactorGraph()
    solver = Isam2Solver(g, **options)
    for s in chain.submaps[:upto]:
        g.add_submap(s)
        solver.update()
    return g, solver


def assert_as_before(now: tuple, before: tuple) -> None:
    """The graph to the last bit; iSAM2 holds the same factors, linearised anew: a little nearer to the optimum."""
    for k in (0, 1, 4):
        np.testing.assert_array_equal(now[k], before[k])
    for k in (2, 3):
        np.testing.assert_allclose(now[k], before[k], atol=5e-3)


def snapshot(g: FactorGraph, solver: Isam2Solver):
    estimate = solver._isam.calculateEstimate()
    return (
        g.values.poses.copy(),
        g.values.landmarks.copy(),
        np.asarray(gtsam.utilities.extractPose2(estimate)),
        np.asarray(gtsam.utilities.extractPoint2(estimate)),
        np.array(sorted(solver._held)),
    )


def absurd_submap(key: int, metres: float = 1e157) -> Submap:
    """Finite in every number, but the square of its lever overflows: GTSAM throws in the middle of an update."""
    return replace(dense_submap(key, np.array([metres, 0, 0]), C), interval=(10.0 * key, 10.0 * key + 10.0))


def test_registry():
    assert set(SOLVERS) >= {"isam2", "batch"}
    for name in SOLVERS:
        g = FactorGraph()
        solver = make_solver(name, g)
        g.add_submap(dense_submap(0, np.array([1.0, 2.0, 0.3]), C))
        solver.update()
        solver.solve_to_optimum()
        assert solver.solution().converged
        assert linearisation_gap(solver.graph) == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(solver.graph.covariance().marginal("x1"), C, rtol=1e-9)
    with pytest.raises(UnknownNameError, match="batch, gnc, isam2, lm, pcg"):
        make_solver("magic", FactorGraph())
    with pytest.raises(ConfigError, match="positive thresholds"):
        Isam2Solver(FactorGraph(), relinearize_threshold=0.0)


def test_lazy_isam2_reports_its_gap_and_gets_to_the_optimum_on_demand(rng):
    chain = make_chain(rng, m=30, landmarks=30, laps=2.5, sigma=0.25)
    g, solver = grown(chain, relinearize_threshold=1e3, relinearize_angle=1e3)
    before = solver.solution()
    optimum = optimise_graph(g).objective
    assert before.gap > 1e-3
    assert before.gap == pytest.approx(before.objective - optimum, abs=1e-6)
    assert not before.converged
    assert "not at its optimum" in before._repr_html_()
    _, eager_solver = grown(chain, relinearize_threshold=1e-3, relinearize_angle=1e-4)
    assert linearisation_gap(eager_solver.graph) < 0.1 * before.gap
    solver.solve_to_optimum()
    after = solver.solution()
    assert after.converged
    assert after.gap == pytest.approx(0.0, abs=1e-8)
    assert after.objective == pytest.approx(optimum, rel=1e-10)
    assert "at the optimum" in after._repr_html_()


def test_a_bad_factor_is_rolled_back_named_and_removed(rng):
    chain = make_chain(rng, m=10, landmarks=20)
    g, solver = grown(chain, upto=7)
    before, objective = snapshot(g, solver), g.objective().total
    fid = g.add_submap(absurd_submap(7))
    with pytest.raises(FactorRejectedError, match=rf"dense-submap x7 → x8 \(factor {fid}\)") as caught:
        solver.update()
    assert caught.value.factor_id == fid
    assert_as_before(snapshot(g, solver), before)
    assert g.objective().total == objective
    assert g.events[-1]["event"] == "removed"
    for s in chain.submaps[7:]:  # and life goes on
        g.add_submap(s)
        solver.update()
    solver.solve_to_optimum()
    clean, clean_solver = grown(chain)
    clean_solver.solve_to_optimum()
    np.testing.assert_allclose(g.values.poses, clean.values.poses, atol=1e-9)


def test_the_good_factors_of_a_failed_update_enter_at_the_next(rng):
    chain = make_chain(rng, m=6, landmarks=20)
    g, solver = grown(chain, upto=5)
    g.add_submap(chain.submaps[5])
    good = g.add_between(0, 5, se2_between(chain.poses[0], chain.poses[5]), C, evidence="shared-scan")
    bad = g.add_submap(absurd_submap(6))
    with pytest.raises(FactorRejectedError) as caught:
        solver.update()
    assert caught.value.factor_id == bad
    assert good not in solver._held
    solver.update()
    assert set(solver._held) == set(g.records)
    assert linearisation_gap(solver.graph) < 1e-2


def test_a_factor_that_throws_inside_gtsam_is_survived(rng, monkeypatch):
    """Whatever GTSAM throws, the solver answers for it and stays whole."""
    chain = make_chain(rng, m=6, landmarks=20)
    g, solver = grown(chain, upto=5)
    before = snapshot(g, solver)
    true_factor = module.gtsam_factor

    def broken(record, origin):
        if record.factor_id == 5:

            def error(this, values, H):
                raise ValueError("cable fell out")

            keys = list(true_factor(record, origin).keys())
            return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), keys, error)
        return true_factor(record, origin)

    g.add_submap(chain.submaps[5])
    monkeypatch.setattr(module, "gtsam_factor", broken)
    with pytest.raises(FactorRejectedError, match="submap 5"):
        solver.update()
    assert_as_before(snapshot(g, solver), before)
    monkeypatch.setattr(module, "gtsam_factor", true_factor)
    g.add_submap(replace(chain.submaps[5], key=55))
    solver.update()
    assert linearisation_gap(solver.graph) < 1e-2


def test_a_factor_without_a_finite_residual_is_refused_before_gtsam(rng):
    chain = make_chain(rng, m=4, landmarks=20)
    g, solver = grown(chain)
    before = snapshot(g, solver)
    g.add_submap(absurd_submap(4, 1e250))
    with pytest.raises(FactorRejectedError, match="its residual is"):
        solver.update()
    assert_as_before(snapshot(g, solver), before)


def test_nan_never_reaches_gtsam(rng):
    chain = make_chain(rng, m=4, landmarks=15)
    g, solver = grown(chain, upto=3)
    held = dict(solver._held)
    g.values.poses[3, 0] = np.nan  # where the next submap begins
    g.add_submap(chain.submaps[3])
    with pytest.raises(SolverError, match="not finite"):
        solver.update()
    assert solver._held == held
    with pytest.raises(SolverError, match="finite"):
        BatchSolver(g).update()


def test_an_underconstrained_graph_is_an_error_that_names(rng):
    chain = make_chain(rng, m=6, landmarks=1, reach=0.1)
    chain.submaps = [dense_submap(k, s.exit_pose, C) for k, s in enumerate(chain.submaps)]
    g, solver = grown(chain)
    before = snapshot(g, solver)
    g.remove(g.submaps[3].factor_id)
    for _ in range(2):
        with pytest.raises(IndeterminateError, match="x4, x5, x6"):
            solver.update()
        np.testing.assert_array_equal(g.values.poses, before[0])
    g.add_between(3, 4, se2_between(chain.poses[3], chain.poses[4]), C, evidence=EvidenceUse(["wheel"], (30, 40)))
    solver.update()
    assert linearisation_gap(solver.graph) < 1e-9


def test_removal_and_merging_follow_the_graph(rng):
    chain = make_chain(rng, m=12, landmarks=20, laps=2.0)
    g = FactorGraph()
    solver = Isam2Solver(g)
    gps = make_gps(chain, rng, np.array([3.0, 4.0, 0.7]), step=2.5)
    ids = g.add_sensor(gps, config=GpsConfig(robust=RobustKernel("cauchy", 1.0), baseline=10.0))
    for s in chain.submaps:
        g.add_submap(s, landmark_ids=s.landmarks.ids + (100 if s.key >= 6 else 0))
        solver.update()
    wrong = g.add_between(0, 9, [9.0, 9.0, 2.0], C, evidence=EvidenceUse(["wheel"], (0.0, 9.0)))
    solver.update()
    g.remove(wrong)
    g.remove(ids[7])
    solver.update()
    assert set(solver._held) == set(g.records)
    assert solver.rebuilds == 1  # for the datum; plain removals need none
    for i in [i for i in g.values.landmark_ids.tolist() if i < 100 and i + 100 in g.values.landmark_ids]:
        g.merge_landmarks(i, i + 100)
    solver.update()
    assert solver.rebuilds == 2
    assert set(solver._known) == {"x0", *g.values.layout().names()} - {"datum"}  # poses in the GPS frame
    solver.solve_to_optimum()
    other = FactorGraph()
    other.add_sensor(gps.take(np.arange(len(gps.times)) != 7), config=GpsConfig(robust=RobustKernel("cauchy", 1.0)))
    for s in chain.submaps:
        other.add_submap(s)
    BatchSolver(other).solve_to_optimum()
    np.testing.assert_allclose(g.values.poses, other.values.poses, atol=1e-6)
    for i in ids:  # the datum goes when its last fix goes
        if i in g.records:
            g.remove(i)
    solver.update()
    assert "datum" not in solver._known


def test_relinearisation_on_demand(rng):
    chain = make_chain(rng, m=30, landmarks=30, laps=2.0)
    _, solver = grown(chain, relinearize_skip=1000, relinearize_threshold=1e-4, relinearize_angle=1e-5)
    before = linearisation_gap(solver.graph)
    for _ in range(3):
        solver.update(relinearize=True)
    assert linearisation_gap(solver.graph) < 0.01 * before


def test_an_update_without_news_does_nothing(rng):
    g, solver = grown(make_chain(rng, m=4))
    updates, values = solver.updates, g.values
    solver.update()
    assert solver.updates == updates
    assert g.values is values


def test_batch_solver_says_when_the_graph_moved_on(rng):
    chain = make_chain(rng, m=8, landmarks=20)
    g = FactorGraph()
    solver = BatchSolver(g)
    for s in chain.submaps[:7]:
        g.add_submap(s)
    solver.update()
    assert solver.solution().converged
    g.add_submap(chain.submaps[7])
    stale = solver.solution()
    assert not stale.converged
    assert stale.gap > 0
    assert state_of(g).decrement == pytest.approx(stale.gap, rel=0.2)
