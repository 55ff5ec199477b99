"""A graph from a list of submaps from anywhere: both kinds in one chain, with their matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import DataError, EvidenceReusedError, GeometryError
from graphslam.core.submap import Match
from graphslam.solve.registry import make_solver
from tests.reference.graph_chain import dense_submap, make_chain

C = np.diag([0.1, 0.1, 0.01]) ** 2


def _interval(key):
    return 10.0 * key, 10.0 * key + 10.0


def _both_kinds(rng):
    """Landmark submaps 0, 1, dense submaps 2, 3 whose last one re-enters submap 0, landmark submaps 4, 5."""
    chain = make_chain(rng, m=4).submaps
    dense = [replace(dense_submap(k, np.array([2.0, 0.1, 0.2]), C), interval=_interval(k)) for k in (2, 3)]
    later = [replace(s, key=s.key + 2, interval=_interval(s.key + 2)) for s in chain[2:]]
    matched = Match(target=0, T_target_here=np.array([1.0, 0.5, 0.2]), covariance=C, fitness=0.9, support=1.0)
    return [*chain[:2], dense[0], replace(dense[1], matches=(matched,)), *later]


def test_it_is_the_graph_built_by_hand(rng):
    submaps = _both_kinds(rng)
    graph = gs.FactorGraph.from_submaps(submaps, covariance_scale=2.0)
    by_hand = gs.FactorGraph(2)
    for s in submaps:
        by_hand.add_submap(s, covariance_scale=2.0)
    by_hand.add_match(3, submaps[3].matches[0])
    found = [make_solver("batch", g) for g in (graph, by_hand)]
    for solver in found:
        solver.solve_to_optimum()
    a, b = (s.solution() for s in found)
    assert a.objective == b.objective > 0
    assert [s.key for s in graph.submaps] == [0, 1, 2, 3, 4, 5]


def test_two_dimensions_are_refused_by_name(rng):
    space = dense_submap(7, np.array([1.0, 0, 0, 0, 0, 0, 1.0]), np.eye(6))
    with pytest.raises(GeometryError, match=r"2-D submaps 0, 1 and 3-D submaps 7.*a graph of each"):
        gs.FactorGraph.from_submaps([*make_chain(rng, m=2).submaps, space])


def test_what_does_not_fit_is_named(rng):
    submaps = _both_kinds(rng)
    with pytest.raises(DataError, match="needs submaps"):
        gs.FactorGraph.from_submaps([])
    with pytest.raises(DataError, match="submap 0 is not in the graph"):
        gs.FactorGraph.from_submaps(submaps[1:])
    with pytest.raises(DataError, match="submap 1 is already in the graph"):
        gs.FactorGraph.from_submaps([*submaps[:2], submaps[1]])
    spent = [replace(s, uses=frozenset({"wheels"})) for s in submaps[:2]]
    with pytest.raises(EvidenceReusedError, match="wheels"):
        gs.FactorGraph.from_submaps([spent[0], replace(spent[1], interval=(0.5, 2.0))])
