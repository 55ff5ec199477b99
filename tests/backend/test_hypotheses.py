"""Several graphs of one SegMap: grouped by what particles say, each optimised, the clearest chosen."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from graphslam.backend.config import BackEndConfig
from graphslam.backend.hypotheses import TopologyHypothesis, hypotheses_of, solve_hypotheses, topologies, topology
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.maps.alternatives import Alternative, rank_alternatives
from graphslam.maps.pieces import DivisionConfig
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segmap import MATCH, NEW
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_frontends.segslam.submaps import common_ancestor_chain, sampled_chain
from graphslam_studies.segslam_trial import QUICK, GridTrial

COURT = FilterDrift(heading_walk=0.02, position_walk=0.03)
CONFIG = BackEndConfig(node_spacing=1.5, level_sigma=0.006, loops=True)
DIVISION = DivisionConfig(reach=8.5)


def solved(result: SegSlamResult, most: int = 5, **options: Any) -> tuple[list[TopologyHypothesis], list[Alternative]]:
    hypotheses, _ = hypotheses_of(result, most, drift=COURT, **options)
    return hypotheses, solve_hypotheses(hypotheses, CONFIG, division=DIVISION)


@pytest.fixture(scope="module")
def trial() -> GridTrial:
    return GridTrial(QUICK, 1)


@pytest.fixture(scope="module")
def result(trial: GridTrial) -> SegSlamResult:
    return run_segslam(trial.steps, replace(QUICK.segslam_filter, particles=8), QUICK.segslam, SeedTree(2))


@pytest.fixture(scope="module")
def divided(result: SegSlamResult) -> SegSlamResult:
    """Two of the particles say that they entered nothing."""
    segmap = copy.deepcopy(result.segmap)
    t = segmap.table
    last = np.unique(result.closed)
    entered = [int(i) for i in last if t.kind[i] == MATCH]
    assert len(entered) == len(last) > 2, "all particles closed the loop"
    t.kind[entered[:2]], t.source[entered[:2]] = NEW, -1
    return replace(result, segmap=segmap)


def test_particles_are_grouped_by_what_they_tell(result: SegSlamResult, divided: SegSlamResult) -> None:
    (alone,) = topologies(result)
    assert alone[1] == pytest.approx(result.weights.sum())
    assert alone[0] == int(np.argmax(result.weights))
    found = topologies(divided)
    assert len(found) == 2
    assert sum(support for _, support, _ in found) == pytest.approx(divided.weights.sum())
    last = [[entry[2] for entry in topology(divided.segmap, chain)][-1] for *_, chain in found]
    assert set(last) == {"new", "match"}
    for p, support, chain in found:
        entries = topology(divided.segmap, chain)
        assert all(a[1] == b[0] for a, b in pairwise(entries))  # each goes on where the one before ended
        same = [
            k for k in range(8)
            if topology(divided.segmap, common_ancestor_chain(divided.segmap, int(divided.closed[k]))) == entries
        ]  # fmt: skip
        assert support == pytest.approx(divided.weights[same].sum())
        assert p == max(same, key=lambda k: divided.weights[k])


def test_the_loop_and_what_would_be_without_it(trial: GridTrial, result: SegSlamResult) -> None:
    hypotheses, graphs = solved(result)
    assert len(hypotheses) == len(graphs) == 2
    choice = rank_alternatives(graphs)
    assert [j.alternative.name for j in choice.order] == ["hypothesis 0", "hypothesis 1"]
    assert choice.best_map.entropy() == pytest.approx(choice.best.clarity.entropy)
    closed, open_chain = hypotheses
    assert closed.withdrawn is None
    assert open_chain.withdrawn == closed.entries[0]
    assert [a.facts["loops"] > 0 for a in graphs] == [True, False]
    assert choice.order[0].clarity.entropy < 0.97 * choice.order[1].clarity.entropy

    def error(a: Alternative) -> float:
        path = a.solution.trajectory()
        truth = Trajectory(trial.steps.times, trial.truth).interpolate(path.times)
        return float(ate(path, Trajectory(path.times, truth), alignment="se").statistics.rmse)

    assert error(graphs[0]) < 0.5 * error(graphs[1])
    rows = choice.rows()
    assert json.loads(json.dumps(rows)) == rows
    assert [r["withdrawn"] for r in rows] == [None, list(closed.entries[0])]
    again = solved(result)[1]
    np.testing.assert_array_equal(again[0].solution.poses, graphs[0].solution.poses)
    one, alone = solved(result, 1)
    assert len(one) == 1
    assert "only one" in rank_alternatives(alone).why()


def test_map_samples_become_graphs_too(trial: GridTrial, result: SegSlamResult) -> None:
    """Chains of segments of several particles, each different, all solved before they are compared."""
    hypotheses, left_out = hypotheses_of(result, 1, drift=COURT, samples=6)
    assert left_out == 0
    sampled = [h for h in hypotheses if h.particle == -1]
    assert 1 <= len(sampled) <= 6
    assert len(hypotheses) == 1 + len(sampled)
    assert len({h.chain.tobytes() for h in hypotheses}) == len(hypotheses)
    segmap = result.segmap
    for h in sampled:
        bounds = [segmap[int(i)].interval for i in h.chain]
        assert all(a[1] == b[0] for a, b in pairwise(bounds))
        assert (bounds[0][0], bounds[-1][1]) == (0, max(b for _, b in bounds))
        # what a sample stands for is the share of the particles that tell the same
        assert h.support == pytest.approx(hypotheses[0].support)
    few = solve_hypotheses(hypotheses[:2], CONFIG, division=DIVISION)
    assert few[0].solution.trajectory().times[-1] == few[1].solution.trajectory().times[-1]
    sample = result.sample(0)
    assert sorted(sample.segments.tolist()) == sorted(sampled_chain(segmap, sample).tolist())
    with pytest.raises(DataError, match="open"):
        sampled_chain(segmap, replace(sample, segments=np.array([*sample.segments[:-1], -1])))


def test_at_least_one_is_asked_for(result: SegSlamResult) -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        hypotheses_of(result, 0, drift=COURT)
