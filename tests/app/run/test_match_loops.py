"""A front end's matches in a run that looks for loops: decided on like all others, with ties along their submaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.run import loops as app_loops
from graphslam.backend import back_end
from graphslam.backend.back_end import BackEnd
from graphslam.backend.config import BackEndConfig
from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.submap import Match, Submap
from graphslam.loops.ledger import LoopDecision, ledger_of_events
from tests.app.run.test_loops import there_and_back

C = np.diag([0.01, 0.01, 0.01, 0.05, 0.05, 0.03]) ** 2
CONFIG = BackEndConfig(loops=True)


@pytest.fixture(autouse=True)
def no_pairs_by_place(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("LOOP_OVERLAP", "LOOP_HEIGHT"):
        monkeypatch.setattr(back_end, name, 0.1)


@pytest.fixture(scope="module")
def drive() -> tuple[list[Submap], Array]:
    """The third submap says truly where it is in the first, in whose map it went on; the second lies about it."""
    submaps, bases = there_and_back()
    true = Match(target=0, T_target_here=se3.se3_between(bases[0], bases[2]), covariance=C, fitness=0.9, support=0.9)
    far = se3.se3_between(bases[0], bases[1]).copy()
    far[1] += 8.0
    wrong = Match(target=0, T_target_here=far, covariance=C, fitness=0.9, support=0.8)
    few = replace(wrong, support=0.1)
    submaps[1] = replace(submaps[1], matches=(wrong, few))
    submaps[2] = replace(submaps[2], matches=(true,), report={"entered": "match", "holds": [0, 2]})
    return submaps, bases


def run(submaps: list[Submap], config: BackEndConfig, solver: str, undo: tuple[int, ...] = ()) -> BackEnd:
    back = BackEnd(config, solver)
    for s in submaps:
        back.add(s)
    back.finish(undo)
    return back


@pytest.mark.parametrize("solver", ["batch", "isam2"])
def test_they_are_decided_on_with_all_loops(drive: tuple[list[Submap], Array], solver: str) -> None:
    submaps, bases = drive
    trusting, back = run(submaps, replace(CONFIG, loops=False), solver), run(submaps, CONFIG, solver)
    assert sum(r.group == "match" for r in trusting.graph.records.values()) == 2  # by their support alone
    assert not any(r.group == "match" for r in back.graph.records.values())
    ledger = ledger_of_events(back.graph.events).current()
    front = {(d.submap_i, d.submap_j, d.verdict) for d in ledger if d.source == "front-end"}
    assert front == {(0, 2, "accepted"), (0, 1, "rejected")}
    overlaps = [d for d in ledger if d.source == "overlap"]
    assert overlaps
    assert all(d.verdict == "accepted" for d in overlaps)
    assert {(d.submap_i, d.submap_j) for d in overlaps} == {(0, 2)}
    end = se3.se3_between(bases[0], bases[2])
    off = [np.linalg.norm(b.graph.values.poses[b.graph.submaps[2].node][:3] - end[:3]) for b in (trusting, back)]
    assert off[1] < 0.2


def test_a_match_is_undone_with_its_overlap_constraints(
    drive: tuple[list[Submap], Array], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = ledger_of_events(run(drive[0], CONFIG, "batch").graph.events).current()
    (match,) = [d.loop for d in ledger if d.source == "front-end" and d.verdict == "accepted"]
    back = run(drive[0], CONFIG, "batch", undo=(match,))
    assert not any(r.group in ("loop", "match") for r in back.graph.records.values())
    undone = [d for d in ledger_of_events(back.graph.events).current() if d.verdict == "undone"]
    assert {d.source for d in undone} == {"front-end", "overlap"}
    assert {d.why for d in undone} == {"asked for", f"by loop {match}, which was undone"}

    # and comes back with them
    asked: list[LoopDecision] = []
    monkeypatch.setattr(app_loops, "loops_of_run", lambda folder: ledger_of_events(back.graph.events))
    monkeypatch.setattr(app_loops, "removed_loops_of_run", lambda folder: undone)
    monkeypatch.setattr(app_loops, "rerun_without_loops", lambda folder, numbers, progress: asked.extend(numbers))
    app_loops.redo_loop(tmp_path, match)
    assert asked == []
    overlap = next(d.loop for d in undone if d.source == "overlap")
    app_loops.redo_loop(tmp_path, overlap)
    assert {d.loop for d in asked} == {d.loop for d in undone} - {overlap}
