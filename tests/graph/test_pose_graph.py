"""FactorGraph: adding, refusing, removing, merging, scoring, diagnosing."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import (
    ConfigError,
    CovarianceError,
    DataError,
    EvidenceReusedError,
    GeometryError,
    IndeterminateError,
)
from graphslam.core.geometry import se2_between
from graphslam.core.submap import Match
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.ledger import EvidenceUse
from graphslam.solve.batch import BatchSolver
from tests.reference.graph_chain import anonymous, dense_submap, make_chain, make_gps

C = np.diag([1e-2, 1e-2, 1e-3])


@pytest.fixture
def chain(rng):
    return make_chain(rng, m=8, landmarks=20)


@pytest.fixture
def graph(chain):
    g = FactorGraph()
    for s in chain.submaps:
        g.add_submap(s)
    return g


def state(g: FactorGraph):
    return (
        len(g.records),
        len(g.ledger),
        g.values.poses.copy(),
        g.values.landmark_ids.copy(),
        g.values.landmarks.copy(),
    )


def same(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b))


def test_dimension_four_is_refused():
    with pytest.raises(ConfigError, match="two or in three"):
        FactorGraph(dim=4)


def test_new_landmarks_get_fresh_ids_and_start_where_they_were_seen(chain):
    g = FactorGraph()
    g.add_submap(anonymous(chain.submaps[0]))
    n = len(chain.submaps[0].landmarks)
    np.testing.assert_array_equal(g.landmark_ids_of(0), np.arange(n))
    np.testing.assert_allclose(g.values.landmarks, chain.submaps[0].landmarks.positions)
    ids = np.full(len(chain.submaps[1].landmarks), -1)
    ids[0] = 2
    g.add_submap(anonymous(chain.submaps[1]), landmark_ids=ids)
    assert g.landmark_ids_of(1)[0] == 2
    assert g.landmark_ids_of(1)[1:].tolist() == list(range(n, n + len(ids) - 1))
    assert len(g.detections(2)) == 2


@pytest.mark.parametrize("what", ["twice", "shape", "id", "covariance", "ledger", "scale"])
def test_a_refused_submap_changes_nothing(graph, chain, what):
    before, s = state(graph), chain.submaps[0]
    fresh = replace(s, key=99, interval=(500.0, 510.0))
    cases = {
        "twice": (DataError, lambda: graph.add_submap(s)),
        "shape": (GeometryError, lambda: graph.add_submap(fresh, landmark_ids=[1, 2])),
        "id": (DataError, lambda: graph.add_submap(fresh, landmark_ids=np.full(len(s.landmarks), -7))),
        "covariance": (
            CovarianceError,
            lambda: graph.add_submap(
                replace(fresh, landmarks=replace(s.landmarks, covariance=1e-320 * np.eye(3 + 2 * len(s.landmarks))))
            ),
        ),
        "ledger": (EvidenceReusedError, lambda: graph.add_submap(replace(s, key=99, interval=(75.0, 85.0)))),
        "scale": (CovarianceError, lambda: graph.add_submap(fresh, covariance_scale=0.0)),
    }
    error, act = cases[what]
    with pytest.raises(error):
        act()
    assert same(state(graph), before)


def test_covariance_scale_divides_the_objective(chain):
    totals = []
    for scale in (1.0, 5.0):
        g = FactorGraph()
        for s in chain.submaps:
            g.add_submap(s, covariance_scale=scale)
        BatchSolver(g).update()
        totals.append(g.objective().total)
    assert totals[0] == pytest.approx(5.0 * totals[1], rel=1e-9)


def test_score_counts_degrees_of_freedom(graph, chain):
    BatchSolver(graph).update()
    rows = sum(3 + 2 * len(s.landmarks) for s in chain.submaps)
    score = graph.objective()
    assert score["submap"].dof == score.dof == rows - 3 * 8 - 2 * len(graph.values.landmarks)
    assert score.total == pytest.approx(score["submap"].chi2)
    graph.add_between(0, 5, se2_between(chain.poses[0], chain.poses[5]), C, evidence="shared-scan", group="match")
    assert graph.objective()["match"].dof == 3
    assert "match" in graph.objective()._repr_html_()


def test_between_factors_must_be_sound(graph):
    T = np.array([1.0, 0.0, 0.0])
    with pytest.raises(ConfigError, match="must name the streams"):
        graph.add_between(0, 1, T, C)
    with pytest.raises(DataError, match="not there"):
        graph.add_between(0, 77, T, C, evidence="shared-scan")
    with pytest.raises(GeometryError, match="finite"):
        graph.add_between(0, 1, [np.nan, 0, 0], C, evidence="shared-scan")
    with pytest.raises(CovarianceError, match="x0 → x1"):
        graph.add_between(0, 1, T, np.zeros((3, 3)), evidence="shared-scan")
    with pytest.raises(EvidenceReusedError, match="odometry"):
        graph.add_between(0, 1, T, C, evidence=EvidenceUse(["odometry"], (0.0, 10.0)))


def test_match_is_declared_evidence(graph, chain):
    T = se2_between(chain.poses[1], chain.poses[6])
    fid = graph.add_match(6, Match(target=1, T_target_here=T, covariance=C, fitness=0.9, support=0.8))
    assert graph.records[fid].group == "match"
    row = graph.ledger.table().set_index("factor_id").loc[fid]
    assert row.kind == "shared-scan"
    assert graph.objective()["match"].chi2 < 50


def test_removal_restores_the_graph(graph, chain):
    solver = BatchSolver(graph)
    solver.update()
    before, poses = state(graph), graph.values.poses.copy()
    wrong = se2_between(chain.poses[0], chain.poses[5]) + [3.0, -2.0, 0.4]
    fid = graph.add_between(0, 5, wrong, C, evidence=EvidenceUse(["wheel"], (0.0, 50.0)))
    solver.update()
    assert np.abs(graph.values.poses - poses).max() > 0.05
    graph.remove(fid, reason="test")
    solver.update()
    np.testing.assert_allclose(graph.values.poses, poses, atol=1e-7)
    assert len(graph.ledger) == before[1]
    graph.add_between(0, 5, wrong, C, evidence=EvidenceUse(["wheel"], (0.0, 50.0)))  # its evidence is free again
    with pytest.raises(DataError, match="not in the graph"):
        graph.remove(fid)
    assert [e["event"] for e in graph.events].count("removed") == 1


def test_removing_the_last_submap_takes_its_node_landmarks_and_fixes(rng, chain):
    g = FactorGraph()
    g.add_sensor(make_gps(chain, rng, np.array([0.0, 0.0, 1.0])))
    for s in chain.submaps[:6]:
        g.add_submap(s)
    before = state(g)
    extra = replace(anonymous(chain.submaps[6]))
    g.add_submap(extra)
    fixes = [r for r in g.records.values() if r.group == "gps" and r.node == 6]
    assert len(fixes) == 10
    g.remove(g.submaps[-1].factor_id)
    assert same(state(g)[:1] + state(g)[2:], before[:1] + before[2:])
    assert len(g.submaps) == 6


def test_removing_all_fixes_removes_the_datum(rng, chain):
    g = FactorGraph()
    ids = g.add_sensor(make_gps(chain, rng, np.array([0.0, 0.0, 1.0]), step=5.0))
    for s in chain.submaps:
        g.add_submap(s)
    assert g.values.datum is not None
    for i in ids:
        g.remove(i)
    assert g.values.datum is None
    BatchSolver(g).update()
    assert g.diagnose().ok


def test_merge_re_keys_and_equals_given_ids(chain):
    """Merging two ids after the fact is the same problem as having known it from the start."""
    known, split = FactorGraph(), FactorGraph()
    twin = None
    for s in chain.submaps:
        known.add_submap(s)
        ids = s.landmarks.ids.copy()
        if s.key >= 4:
            hit = np.flatnonzero(ids == chain.submaps[0].landmarks.ids[0])
            ids[hit] = 1000
            twin = 1000 if len(hit) else twin
        split.add_submap(s, landmark_ids=ids)
    assert twin == 1000
    split.merge_landmarks(int(chain.submaps[0].landmarks.ids[0]), 1000)
    for g in (known, split):
        BatchSolver(g).update()
    assert split.objective().total == pytest.approx(known.objective().total, rel=1e-9)
    np.testing.assert_allclose(split.values.poses, known.values.poses, atol=1e-8)
    with pytest.raises(DataError, match="merge"):
        split.merge_landmarks(0, 1000)
    with pytest.raises(DataError, match="merged-away"):
        split.add_submap(
            replace(chain.submaps[0], key=99, interval=(900, 910)),
            landmark_ids=np.full(len(chain.submaps[0].landmarks), 1000),
        )


def test_events_are_json(graph):
    graph.merge_landmarks(*map(int, graph.values.landmark_ids[:2]))
    assert len(json.loads(json.dumps(graph.events))) == 9


# ------------------------------------------------------------------ diagnosis


def test_a_sound_graph_is_found_sound(graph):
    assert graph.diagnose().ok
    graph.diagnose().raise_if_bad()


def test_a_broken_chain_is_named(rng):
    g = FactorGraph()
    for k in range(5):
        g.add_submap(dense_submap(k, np.array([5.0, 0, 0.1]), C))
    g.remove(g.submaps[2].factor_id)
    d = g.diagnose()
    assert d.unconstrained == ("x3", "x4", "x5")
    assert "x3 is not connected to x2" in d.remedies[0]
    with pytest.raises(IndeterminateError, match=r"x3, x4, x5; x3 is not connected") as caught:
        BatchSolver(g).update()
    assert caught.value.variables == ("x3", "x4", "x5")
    with pytest.raises(IndeterminateError, match="x3"):
        g.covariance()


@pytest.mark.parametrize(("shared", "ok"), [(1, False), (2, True)])
def test_one_common_landmark_leaves_a_rotation_free(rng, shared, ok):
    """Structure alone would call this connected; the numbers do not."""
    chain = make_chain(rng, m=4, landmarks=12, reach=100.0)
    g = FactorGraph()
    for s in chain.submaps:
        ids = s.landmarks.ids.copy()
        if s.key >= 2:
            ids[shared:] += 100
        g.add_submap(s, landmark_ids=ids)
    g.remove(g.submaps[1].factor_id)
    if not ok:
        # the landmarks of submap 1 that nobody else saw are gone; what is left turns about the common landmark
        names = g.diagnose().unconstrained
        assert {"x2", "x3", "x4"} <= set(names)
        assert "x1" not in names
        assert "l0" not in names
    else:
        assert g.diagnose().ok


def test_datum_with_one_place_is_named(rng, chain):
    g = FactorGraph()
    ids = g.add_sensor(make_gps(chain, rng, np.array([0.0, 0.0, 1.0]), step=5.0))
    for s in chain.submaps:
        g.add_submap(s)
    for i in ids[1:]:
        g.remove(i)
    d = g.diagnose()
    assert d.unconstrained == ("datum",)
    assert "two that are metres apart" in d.remedies[0]
