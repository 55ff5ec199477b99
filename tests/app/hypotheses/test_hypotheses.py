"""Several graphs of one SegMap: grouped by what particles say, each optimised, the clearest chosen."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from graphslam.app.hypotheses.hypotheses import HypothesesConfig, Hypothesis, find_hypotheses, topologies, topology
from graphslam.app.studies.segslam_trial import QUICK, GridTrial
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.frontends.grid.filter_drift import FilterDrift
from graphslam.frontends.segslam.result import SegSlamResult
from graphslam.frontends.segslam.segmap import MATCH, NEW
from graphslam.frontends.segslam.segslam import run_segslam
from graphslam.frontends.segslam.submaps import sampled_chain, settled_chain
from graphslam.maps.pieces import DivisionConfig

COURT = FilterDrift(heading_walk=0.02, position_walk=0.03)
CONFIG = HypothesesConfig(spacing=1.5, division=DivisionConfig(reach=8.5))


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
    said = [[entry[2] for entry in topology(divided.segmap, chain)][-1] for *_, chain in found]
    assert set(said) == {"new", "match"}
    for p, support, chain in found:
        told = topology(divided.segmap, chain)
        assert all(a[1] == b[0] for a, b in pairwise(told))  # each goes on where the one before ended
        same = [
            k for k in range(8)
            if topology(divided.segmap, settled_chain(divided.segmap, int(divided.closed[k]))) == told
        ]  # fmt: skip
        assert support == pytest.approx(divided.weights[same].sum())
        assert p == max(same, key=lambda k: divided.weights[k])


def test_the_clearest_graph_is_chosen_and_the_others_are_kept(trial: GridTrial, result: SegSlamResult) -> None:
    found = find_hypotheses(result, COURT, CONFIG)
    assert len(found.order) == 2  # the loop, and what would be without it
    honest = [h for h in found.order if not h.contradicted]
    assert found.best is min(honest, key=lambda h: h.clarity.entropy)
    assert found.best_map.entropy() == pytest.approx(found.best.clarity.entropy)
    closed, open_chain = found.order
    assert closed.withdrawn is None
    (entry,) = [d for d in closed.ledger.current() if d.source == "front-end"]  # beside it ties along the segment
    assert (entry.verdict, entry.submap_i, entry.submap_j) == ("accepted", *closed.entries[0])
    assert closed.loops >= 1
    assert open_chain.withdrawn == closed.entries[0]
    assert open_chain.loops == 0
    assert closed.clarity.entropy < 0.97 * open_chain.clarity.entropy

    def error(h: Hypothesis) -> float:
        path = h.solution.trajectory()
        truth = Trajectory(trial.steps.times, trial.truth).interpolate(path.times)
        return float(ate(path, Trajectory(path.times, truth), alignment="se").statistics.rmse)

    assert error(closed) < 0.5 * error(open_chain)


def test_what_is_said_of_them(result: SegSlamResult) -> None:
    found = find_hypotheses(result, COURT, CONFIG)
    events = found.events()
    assert json.loads(json.dumps(events)) == events
    assert events[-1]["hypothesis"] == found.best.number
    assert f"hypothesis {found.best.number}" in found.why()
    assert list(found.table()["hypothesis"]) == [h.number for h in found.order]
    one = find_hypotheses(result, COURT, replace(CONFIG, most=1))
    assert len(one.order) == 1
    assert "one topology" in one.why()
    again = find_hypotheses(result, COURT, CONFIG)
    np.testing.assert_array_equal(again.best.solution.poses, found.best.solution.poses)


def test_map_samples_become_graphs_too(trial: GridTrial, result: SegSlamResult) -> None:
    """Chains of segments of several particles, each different, all solved before they are compared."""
    few = find_hypotheses(result, COURT, replace(CONFIG, withdraw=False))
    found = find_hypotheses(result, COURT, replace(CONFIG, withdraw=False, samples=6))
    sampled = [h for h in found.order if h.particle == -1]
    assert 1 <= len(sampled) <= 6
    assert len(found.order) == len(few.order) + len(sampled)
    assert len({h.chain.tobytes() for h in found.order}) == len(found.order)
    segmap = result.segmap
    for h in sampled:
        bounds = [segmap[int(i)].interval for i in h.chain]
        assert all(a[1] == b[0] for a, b in pairwise(bounds))
        assert (bounds[0][0], bounds[-1][1]) == (0, max(b for _, b in bounds))
        # what a sample stands for is the share of the particles that tell the same
        assert h.support == pytest.approx(few.order[0].support)
        path = h.solution.trajectory()
        assert path.times[-1] == few.best.solution.trajectory().times[-1]
    assert found.best.clarity.entropy <= few.best.clarity.entropy
    sample = result.sample(0)
    assert sorted(sample.segments.tolist()) == sorted(sampled_chain(segmap, sample).tolist())
    with pytest.raises(DataError, match="open"):
        sampled_chain(segmap, replace(sample, segments=np.array([*sample.segments[:-1], -1])))


def test_impossible_settings() -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        HypothesesConfig(most=0)
    with pytest.raises(ConfigError, match="probabilities"):
        HypothesesConfig(contradiction=0.0)
