"""Wrong identities: the statistic is the fall of the objective, χ² where nothing is wrong, and finds the culprit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.association.identity import find_association_outliers, identity_statistics
from graphslam.backend.back_end import BackEnd
from graphslam.backend.config import BackEndConfig
from graphslam.core.errors import DataError
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.solve.batch import BatchSolver
from tests.reference.graph_chain import make_chain


def solved(submaps):
    g = FactorGraph()
    for s in submaps:
        g.add_submap(s)
    BatchSolver(g).solve_to_optimum()
    return g


def misread(submaps, submap, entry, metres):
    """The same submaps, one observation displaced."""
    s = submaps[submap]
    positions = s.landmarks.positions.copy()
    positions[entry] += [metres, 0.0]
    wrong = replace(s, landmarks=replace(s.landmarks, positions=positions))
    return [*submaps[:submap], wrong, *submaps[submap + 1 :]]


@pytest.mark.parametrize("submap", [0, 4])
def test_the_statistic_is_what_the_objective_falls_by(rng, submap):
    g = solved(misread(make_chain(rng, m=8, landmarks=20).submaps, submap, 1, 0.3))
    record = next(r for r in g.records.values() if isinstance(r, SubmapRecord) and r.submap_key == submap)
    T = identity_statistics(g, record)
    before = g.objective().total
    new = g.split_landmark(record.factor_id, 1)
    BatchSolver(g).solve_to_optimum()
    assert before - g.objective().total == pytest.approx(T[1], rel=0.02)
    assert new in g.landmark_ids_of(submap)


def test_consistent_observations_are_chi_square(rng):
    values = []
    for _ in range(12):
        g = solved(make_chain(rng, m=8, landmarks=20).submaps)
        values += [identity_statistics(g, r) for r in g.records.values() if isinstance(r, SubmapRecord)]
    T = np.concatenate(values)
    T = T[np.isfinite(T)]
    assert len(T) > 500
    assert np.mean(T) == pytest.approx(2.0, abs=0.25)
    assert np.mean(T > 5.99) == pytest.approx(0.05, abs=0.02)
    assert not np.any(T > 25)


def test_landmarks_of_one_submap_cannot_be_judged(rng):
    g = solved(make_chain(rng, m=2, landmarks=20).submaps)
    seen_once = {i for i in g.values.landmark_ids.tolist() if len(g.detections(i)) == 1}
    assert seen_once
    for r in g.records.values():
        T = identity_statistics(g, r)
        assert all(np.isnan(t) == (int(i) in seen_once) for i, t in zip(r.landmark_ids, T))


@pytest.mark.parametrize("solver", ["isam2", "batch"])
def test_the_back_end_splits_the_culprit_and_nothing_else(rng, solver):
    clean = make_chain(rng, m=10, landmarks=20).submaps
    bad = misread(misread(clean, 3, 0, 1.0), 6, 2, 1.5)
    believing = BackEnd(BackEndConfig(associate=False, merge_every=0), solver)
    doubting = BackEnd(BackEndConfig(associate=False, merge_every=0, identity_gate=25.0), solver)
    for s in bad:
        believing.add(s)
        doubting.add(s)
    worse, better = believing.finish(), doubting.finish()
    assert better.converged
    split = [(e["submap"], e["landmark"]) for e in doubting.graph.events if e["event"] == "split"]
    ids = [s.landmarks.ids for s in clean]
    assert set(split) == {(3, ids[3][0]), (6, ids[6][2])}
    assert better.score["submap"].chi2_per_dof < 1.3 < worse.score["submap"].chi2_per_dof


def test_impossible_splits_are_refused(rng):
    g = solved(make_chain(rng, m=2, landmarks=20).submaps)
    record = next(iter(g.records.values()))
    lone = next(k for k, i in enumerate(record.landmark_ids) if len(g.detections(int(i))) == 1)
    with pytest.raises(DataError, match="nowhere else"):
        g.split_landmark(record.factor_id, lone)
    with pytest.raises(DataError, match="no such observation"):
        g.split_landmark(record.factor_id, 999)
    assert find_association_outliers(g, 1e9) == []
