"""Whoever listens is told what a run does, in the order in which it does it, and changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run import front_ends
from graphslam.app.run import options as run_options
from graphslam.app.run.config import RunConfig
from graphslam.backend.back_end import Observer
from graphslam.core.errors import ConfigError
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.ledger import LoopDecision
from graphslam.solve.solution import Solution
from tests.app.run.test_pipeline_space import Ring, ring


class Listener(Observer):
    """Writes down what it is told."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, Any]] = []

    def front_end_at(self, progress: Any) -> None:
        self.calls.append(("step", progress))

    def submap_added(self, submap: Submap, graph: FactorGraph) -> None:
        self.calls.append(("submap", (submap.key, len(graph.submaps))))

    def loop_decided(self, decision: LoopDecision, graph: FactorGraph) -> None:
        self.calls.append(("loop", decision.loop))

    def solved(self, solution: Solution) -> None:
        self.calls.append(("solved", len(solution.poses)))


class Watched(Ring):
    """Says how far it is before each submap."""

    def submaps(self, log: Any, *, after: Any = None, watch: Any = None, **_: Any) -> Any:
        for s in super().submaps(log, after=after):
            watch(s.key)
            yield s


def test_submaps_steps_and_the_solution_are_reported_in_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    log, front = ring(2)
    monkeypatch.setattr(run_options, "make_front_end", lambda *_: Watched(front.made))
    monkeypatch.setattr(run_options, "recommended_options", lambda *_: {})
    heard = Listener()
    r = gs.run(log, frontend="ring", progress=[heard, Observer()], out=tmp_path / "run")
    n = len(front.made)
    expected = [("step", k) if first else ("submap", (k, k + 1)) for k in range(n) for first in (True, False)]
    assert heard.calls == [*expected, ("solved", len(r.solution.poses))]
    # a resumed run tells of the submaps that are there already; and it is the same run without a listener
    again = Listener()
    back = gs.run(log, frontend="ring", progress=[again], out=tmp_path / "run", resume=True)
    assert again.calls == [x for x in heard.calls if x[0] != "step"]
    alone = gs.run(log, frontend="ring", progress=False)
    np.testing.assert_array_equal(back.map.node_poses, alone.map.node_poses)
    np.testing.assert_array_equal(r.map.node_poses, alone.map.node_poses)


def test_what_is_no_front_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Nothing:
        def __init__(self, config: RunConfig) -> None:
            self.config = config

    monkeypatch.setattr(front_ends, "_kind", lambda name: (Nothing, RunConfig))
    with pytest.raises(ConfigError, match="'nothing' is none: Nothing does not inherit"):
        front_ends.make_front_end("nothing", {})
