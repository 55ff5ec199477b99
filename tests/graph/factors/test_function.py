"""Factors of a user: the same optimum as with the package's own factor, in every solver and joiner, spent once."""

from __future__ import annotations

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError, SolverError
from graphslam.core.poses import group_of
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.gtsam_values import insert_values
from graphslam.graph.noise import RobustKernel
from graphslam.join.graph_problem import JoinProblem
from graphslam.join.registry import join_by_method
from tests.reference.graph_chain import make_chain
from tests.reference.pose_ramp import pose_ramp

TAPE = gs.EvidenceUse(["tape"], (1.0, 1.0))


def tape(a, b):
    """Distance of two bases, 50 m measured."""
    d = len(a) - 1 if len(a) == 3 else 3
    return np.linalg.norm(a[:d] - b[:d]) - 50.0


def wall(a):
    """Height of a base above the x axis of the first base, 1 m measured: depends on the frame."""
    return a[1] - 1.0


def chain(rng):
    return FactorGraph.from_submaps(make_chain(rng, m=6, landmarks=12).submaps)


def test_it_is_the_factor_of_the_package(rng):
    ours, own = (chain(np.random.default_rng(1)) for _ in range(2))
    ours.add_range(1, 5, 50.0, 0.1, evidence=TAPE)
    own.add_factor([1, 5], tape, 0.01, evidence=TAPE)
    x = own.values
    assert own.objective()["user"].chi2 == pytest.approx(ours.objective()["range"].chi2, rel=1e-12)
    A, B = (g.flat().evaluate(x, dense=True) for g in (ours, own))
    np.testing.assert_allclose(B.A, A.A, atol=1e-7 * np.abs(A.A).max())  # central differences
    np.testing.assert_allclose(B.g, A.g, atol=1e-7 * np.abs(A.g).max())
    a, b = gs.solve_graph(ours), gs.solve_graph(own)
    assert b.converged
    np.testing.assert_allclose(b.poses, a.poses, atol=1e-8)
    np.testing.assert_allclose(b.covariance(1, 5), a.covariance(1, 5), rtol=1e-5, atol=1e-10)
    assert a.score.dof == b.score.dof


def test_every_solver_reaches_one_optimum_in_the_plane_and_in_space():
    for make in (lambda: chain(np.random.default_rng(2)), lambda: pose_ramp(1, submaps=4)[0].graph):
        found = {}
        for solver in gs.solvers():
            graph = make()
            last = len(graph.values.poses) - 1
            T = graph.values.poses

            def closing(a, b, T=T, last=last):
                group = group_of(T)
                return group.log(group.between(group.between(T[1], T[last]), group.between(a, b)))

            d = graph.structure.group.dof
            graph.add_factor([1, last], closing, 1e-4 * np.eye(d), evidence=TAPE, robust=RobustKernel("cauchy", 3.0))
            found[solver] = gs.solve_graph(graph, solver)
            assert found[solver].converged, solver
        for solver, s in found.items():
            np.testing.assert_allclose(s.poses, found["lm"].poses, atol=1e-6, err_msg=solver)


@pytest.mark.parametrize("frame_free", [True, False])
def test_every_joining_method_uses_it(frame_free):
    """One that depends on the frame of the first base waits for that frame; polished, all methods agree."""
    graph = chain(np.random.default_rng(3))
    if frame_free:
        graph.add_factor([1, 4], tape, 0.01, evidence=TAPE)
    else:
        graph.add_factor([4], wall, 0.01, evidence=TAPE)
    problem = JoinProblem.of_graph(graph)
    assert problem.needs_first_base.tolist() == [False] * (len(problem.factors) - 1) + [not frame_free]
    best = gs.solve_graph(graph)
    for method in ("eif-tree", "eif-sequential", "ekf"):
        joined = join_by_method(problem, method, polish=True)
        assert joined.objective_polished == pytest.approx(best.objective, rel=1e-8), method
        assert best.objective - 1e-6 < joined.objective < 1.2 * best.objective, method  # linearised once
        without = join_by_method(JoinProblem.of_graph(chain(np.random.default_rng(3))), method, polish=False)
        assert np.abs(joined.poses - without.poses).max() > 0.01, f"{method} left it out"


def test_its_own_jacobian_is_used_and_gtsam_gets_the_same():
    import gtsam

    calls = []

    def slope(a, l):
        calls.append(1)
        c, s = np.cos(a[2]), np.sin(a[2])
        return [[-c, s, 0.0, 1.0, 0.0]]  # of (l - a)_x by the right tangent of a, then by l

    graph = chain(np.random.default_rng(4))
    i = int(graph.values.landmark_ids[0])
    for jacobian in (None, slope):
        fid = graph.add_factor(
            ["x2", f"l{i}"], lambda a, l: l[0] - a[0] - 3.0, 0.04, jacobian=jacobian, evidence="prior"
        )
        record = graph.records[fid]
        values = [graph.values.poses[2], graph.landmark(i)]
        r, J = record.linearised(values, 2)
        np.testing.assert_allclose(J, 5.0 * np.asarray(slope(*values)), atol=1e-8)
        at = gtsam.Values()
        insert_values(at, record.variables(), graph.values, graph.landmark_rows)
        linear = gtsam_factor(record, {"x0": graph.origin}).linearize(at)
        np.testing.assert_allclose(linear.jacobian()[0], J, atol=1e-12)
        np.testing.assert_allclose(linear.jacobian()[1], -r, atol=1e-12)
    assert len(calls) > 3


def test_nothing_is_spent_twice_and_a_removed_one_is_released():
    graph = chain(np.random.default_rng(5))
    fid = graph.add_factor([1, 5], tape, 0.01, evidence=TAPE)
    before = graph.revision, len(graph.events)
    with pytest.raises(EvidenceReusedError, match="tape"):
        graph.add_factor([2, 5], tape, 0.01, evidence=TAPE)
    used = next(e for e in graph.ledger.entries() if e.stream != "tape")
    with pytest.raises(EvidenceReusedError, match=used.stream):
        graph.add_factor([2, 5], tape, 0.01, evidence=gs.EvidenceUse([used.stream], (used.t_start, used.t_end)))
    assert (graph.revision, len(graph.events)) == before
    graph.remove(fid)
    graph.add_factor([2, 5], tape, 0.01, evidence=TAPE)


def test_it_follows_its_landmarks():
    graph = FactorGraph.from_submaps(
        make_chain(np.random.default_rng(6), m=6, landmarks=25, reach=8.0, laps=0.7).submaps
    )
    a, b, c = graph.values.landmark_ids[:3].tolist()
    apart = lambda p, q: np.linalg.norm(p - q) - 4.0  # noqa: E731
    one = graph.add_factor([f"l{a}", f"l{c}"], apart, 0.01, evidence="prior")
    both = graph.add_factor([f"l{a}", f"l{b}"], apart, 0.01, evidence="prior")
    graph.merge_landmarks(b, a)
    assert graph.records[one].variables() == [f"l{b}", f"l{c}"]
    assert both not in graph.records
    last = graph.submaps[-1]
    new = [i for i in graph.landmark_ids_of(last.key).tolist() if len(graph.detections(i)) == 1]
    fid = graph.add_factor([f"l{new[0]}"], lambda p: p[0], 1.0, evidence="prior")
    graph.remove(last.factor_id)
    assert fid not in graph.records
    assert gs.solve_graph(graph).converged


def test_what_cannot_be_a_factor_is_refused_and_the_graph_is_unchanged(tmp_path):
    graph = chain(np.random.default_rng(7))
    before = graph.revision
    refused = [
        ((["x99"], wall, 0.01), DataError, "x99"),
        ((["x0"], wall, 0.01), DataError, "x0 alone"),
        (([1, "x1"], tape, 0.01), DataError, "each once"),
        (([1.5], wall, 0.01), SolverError, "1.5"),
        (([1], lambda a: a[7], 0.01), SolverError, "IndexError"),
        (([1], lambda a: a, 0.01), SolverError, r"shape \(3,\); wanted \(1,\)"),
        (([1], lambda a: np.nan, 0.01), DataError, "not finite"),
        (([1], wall, -1.0), DataError, "covariance"),
    ]
    for arguments, error, text in refused:
        with pytest.raises(error, match=text):
            graph.add_factor(*arguments, evidence=TAPE)
    with pytest.raises(ConfigError, match="streams"):
        graph.add_factor([1], wall, 0.01, evidence="measurement")
    with pytest.raises(ConfigError, match="gps"):
        graph.add_factor([1], wall, 0.01, evidence=TAPE, group="gps")
    assert graph.revision == before
    assert not [e for e in graph.ledger.entries() if e.stream == "tape"]
    graph.add_factor([1], wall, 0.01, evidence=TAPE)
    with pytest.raises(ConfigError, match="function of user factor"):
        JoinProblem.of_graph(graph).save(tmp_path / "graph.npz")


def test_one_that_fails_later_is_named():
    for solver, text in (("lm", "user factor of x1"), ("isam2", "user factor of x1")):
        graph = chain(np.random.default_rng(8))
        calls = []

        def tired(a, calls=calls):
            calls.append(1)
            return a[1] - 5.0 if len(calls) < 10 else 1.0 / 0.0

        graph.add_factor([1], tired, 0.01, evidence=TAPE)
        with pytest.raises(SolverError, match=text):
            gs.solve_graph(graph, solver)


def test_a_file_is_no_graph() -> None:
    with pytest.raises(DataError, match=r"gs\.solve_file"):
        gs.solve_graph("path.g2o")  # type: ignore[arg-type]
