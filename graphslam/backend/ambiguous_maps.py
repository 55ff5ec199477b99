"""Two maps of one log, if two groups of loops contradict each other and it is undecided which group is right.

The resulting graph has neither group, so its covariance includes both cases. The graph with either group is one of the
two maps; one of them is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.backend.streams import repreintegrate_until_converged
from graphslam.core.geometry import Array
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.loops import LoopCloser
from graphslam.solve.registry import Solver


@dataclass(frozen=True, slots=True)
class AlternativeMap:
    """One of two maps.

    Parameters
    ----------
    loops : tuple of int
        Numbers (in the ledger) of the disputed loops in this map; all other loops are those of the result.
    path : Trajectory
        At full rate with covariances, in the frame of the first base.
    node_times, node_poses : (m + 1,), (m + 1, 7|3)
    """

    loops: tuple[int, ...]
    path: Trajectory
    node_times: Array
    node_poses: Array


@dataclass(frozen=True, slots=True)
class AmbiguousMaps:
    """Both maps, and the disputed loops.

    Parameters
    ----------
    maps : (AlternativeMap, AlternativeMap)
    places : list of dict
        For each pair of groups: ``loops``, the numbers in each group; ``nodes`` and ``times`` [s], first and last, of
        the earlier ends and of the later ends.
    """

    maps: tuple[AlternativeMap, AlternativeMap]
    places: list[dict[str, Any]]

    def facts(self) -> dict[str, Any]:
        """JSON-serialisable entries for the report; lengths in metres, times in seconds."""
        a, b = self.maps
        dim = 3 if a.node_poses.shape[1] == 7 else 2
        apart = np.linalg.norm(a.node_poses[:, :dim] - b.node_poses[:, :dim], axis=1)
        k = int(np.argmax(apart))
        return {
            "loops": [list(a.loops), list(b.loops)],
            "apart_max": float(apart[k]),
            "apart_median": float(np.median(apart)),
            "apart_max_node": k,
            "apart_max_time": float(a.node_times[k]),
            "places": self.places,
        }


def ambiguous_maps(graph: FactorGraph, solver: Solver, closer: LoopCloser) -> AmbiguousMaps | None:
    """The graph with each of the undecided groups; None if nothing is undecided, or the graph accepts neither group.

    Afterwards the graph is unchanged, at its optimum.

    Parameters
    ----------
    solver : Solver
        Of that graph.
    closer : LoopCloser
        That decided on its loops.
    """
    pairs = closer.undecided
    if not pairs:
        return None

    def made(side: int) -> AlternativeMap:
        with closer.with_trial_loops([n for pair in pairs for n in pair[side]]) as inside:
            repreintegrate_until_converged(graph, solver)
            s = solver.solution(gap=False)
            return AlternativeMap(tuple(inside), s.trajectory(), s.node_times, s.poses.copy())

    maps = made(0), made(1)
    if not any(m.loops for m in maps):
        return None
    return AmbiguousMaps(maps, [_place(closer, pair, maps[0].node_times) for pair in pairs])


def _place(closer: LoopCloser, pair: tuple[Sequence[int], Sequence[int]], times: Array) -> dict[str, Any]:
    ends = np.array([sorted((closer.loops[n].i, closer.loops[n].j)) for side in pair for n in side])
    nodes = [[int(ends[:, k].min()), int(ends[:, k].max())] for k in (0, 1)]
    return {
        "loops": [sorted(side) for side in pair],
        "nodes": nodes,
        "times": [[float(times[n]) for n in span] for span in nodes],
    }
