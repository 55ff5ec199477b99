"""Loops in a run: looked for at the end, every decision in the events, listed by the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.files import loops_of_run
from graphslam.app.run.loops import undo_loop
from graphslam.backend.back_end import BackEnd
from graphslam.backend.config import BackEndConfig
from graphslam.core import se3
from graphslam.core.errors import DataError, FormatError, RunFolderError
from graphslam.core.submap import Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.loops.ledger import ledger_of_events
from tests.reference.box_submaps import mapped, straight_path
from tests.reference.box_world import hall

STEP = np.diag([0.001, 0.001, 0.003, 0.04, 0.04, 0.02]) ** 2


def there_and_back(seed: int = 0) -> tuple[list[Submap], np.ndarray]:
    """Along a hall, round its end and back: three submaps whose path drifts, and the true poses of their bases."""
    world, rng = hall(cars=60), np.random.default_rng(seed)
    turn = [straight_path(40.0, 46.0, 8.0)[:-1], straight_path(46.0, 46.0, 8.0)]
    turn.append(straight_path(46.0, 40.0, 10.0, yaw=np.pi))
    legs = [
        straight_path(10.0, 40.0, 8.0),
        np.concatenate(turn),
        straight_path(40.0, 12.0, 10.0, yaw=np.pi),
    ]
    out, t = [], 0.0
    for key, path in enumerate(legs):
        n = len(path)
        steps = se3.se3_between(path[:-1], path[1:])
        noise = rng.standard_normal((n - 1, 6)) @ np.sqrt(STEP)
        believed, P = [path[0]], [np.zeros((6, 6))]
        for T, e in zip(steps, noise):
            believed.append(se3.se3_compose(believed[-1], se3.se3_compose(T, se3.se3_exp(e))))
            A = se3.se3_adjoint(se3.se3_inverse(T))
            P.append(A @ P[-1] @ A.T + STEP)
        seen = np.stack(believed)
        local = se3.se3_between(np.broadcast_to(seen[0], seen.shape), seen)
        out.append(
            Submap(
                key=key, interval=(t, t + n - 1), exit_pose=local[-1], exit_covariance=P[-1],
                trajectory=Trajectory(t + np.arange(float(n)), local, np.stack(P)),
                grid=mapped(world, path, rng, believed=seen), uses=frozenset({"laser"}),
            )
        )  # fmt: skip
        t += n - 1
    return out, np.stack([leg[0] for leg in legs])


@pytest.fixture(scope="module")
def finished() -> tuple[BackEnd, np.ndarray, np.ndarray]:
    submaps, bases = there_and_back()
    plain, back = BackEnd(BackEndConfig(), "batch"), BackEnd(BackEndConfig(loops=True), "batch")
    for s in submaps:
        plain.add(s)
        back.add(s)
    plain.finish()
    back.finish()
    true = se3.se3_between(np.broadcast_to(bases[0], bases.shape), bases)
    nodes = [s.node for s in back.graph.submaps]
    return (
        back,
        np.linalg.norm((plain.graph.values.poses[nodes] - true)[:, :3], axis=1),
        np.linalg.norm((back.graph.values.poses[nodes] - true)[:, :3], axis=1),
    )


def test_a_back_end_finds_loops_when_it_is_asked_to(finished: tuple) -> None:
    back, before, after = finished
    events = [e for e in back.graph.events if e["event"] == "loop"]
    assert any(e["verdict"] == "accepted" for e in events)
    assert {(e["submap_i"], e["submap_j"]) for e in events if e["verdict"] == "accepted"} <= {(0, 2), (0, 1), (1, 2)}
    accepted = [e for e in events if e["verdict"] == "accepted"]
    assert back.graph.objective()["loop"].factors == len({e["factor_id"] for e in accepted})
    for e in accepted:
        assert len(e["T_ij"]) == 7
        assert np.linalg.eigvalsh(np.array(e["covariance"])).min() > 0
    assert after[-1] < before[-1] + 0.05
    assert after[-1] < 0.4
    assert back.seconds["loops"] > 0


def test_a_loop_can_be_undone(finished: tuple) -> None:
    """At the end of a run made again from the same submaps; what else was decided stays."""
    with_all = finished[0]
    accepted = [d.loop for d in ledger_of_events(with_all.graph.events).current() if d.verdict == "accepted"]
    undone = accepted[0]
    back = BackEnd(BackEndConfig(loops=True), "batch")
    for s in with_all.submaps:
        back.add(s)
    back.finish([undone])
    ledger = ledger_of_events(back.graph.events)
    assert (ledger.of(undone).verdict, ledger.of(undone).why) == ("undone", "asked for")
    assert [d.loop for d in ledger.current() if d.verdict == "accepted"] == accepted[1:]
    factors = [r for r in back.graph.records.values() if r.group == "loop"]
    assert len(factors) == len(accepted) - 1
    assert np.abs(back.graph.values.poses - with_all.graph.values.poses).max() > 1e-4
    with pytest.raises(DataError):
        back.undo_loop(undone)
    with pytest.raises(DataError):
        back.undo_loop(999)


def test_a_loop_of_an_earlier_ledger_is_known_by_what_it_joins(finished: tuple) -> None:
    """Not by its number; and what is not found again is undone still, so that the next time knows of it."""
    with_all = finished[0]
    accepted = [d for d in ledger_of_events(with_all.graph.events).current() if d.verdict == "accepted"]
    renumbered = replace(accepted[0], loop=accepted[0].loop + 50, verdict="undone")
    elsewhere = replace(accepted[0], loop=3, i=accepted[0].i + 1, verdict="undone")
    back = BackEnd(BackEndConfig(loops=True), "batch")
    for s in with_all.submaps:
        back.add(s)
    back.finish([renumbered, elsewhere])
    ledger = ledger_of_events(back.graph.events)
    undone = [d for d in ledger.current() if d.verdict == "undone"]
    assert [(d.i, d.j, d.source) for d in undone] == [(d.i, d.j, d.source) for d in (accepted[0], elsewhere)]
    assert "not found this time" in undone[1].why
    assert [d.loop for d in ledger.current() if d.verdict == "accepted"] == [d.loop for d in accepted[1:]]


def test_submaps_without_maps_cannot_be_searched() -> None:
    submaps, _ = there_and_back()
    back = BackEnd(BackEndConfig(loops=True), "batch")
    for s in submaps:
        back.add(replace(s, grid=None))
    with pytest.raises(DataError, match="no map"):
        back.finish()


@pytest.fixture
def folder(finished: tuple, tmp_path: Path) -> Path:
    back = finished[0]
    OutputFiles(tmp_path).write_lines("events.jsonl", back.graph.events)
    return tmp_path


def test_the_command_lists_them(folder: Path) -> None:
    ledger = loops_of_run(folder)
    result = CliRunner().invoke(app, ["loops", str(folder), "--json"])
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert printed["counts"] == ledger.counts()
    assert len(printed["loops"]) == len(ledger.current())
    first = printed["loops"][0]
    assert {"loop", "verdict", "why", "source", "chi2", "weight", "effect", "factor_id"} <= set(first)
    text = CliRunner().invoke(app, ["loops", str(folder), "--all"]).stdout
    assert "accepted" in text
    assert text.count("\n") == len(ledger.current()) + 2
    history = json.loads(CliRunner().invoke(app, ["loops", str(folder), "--json", "--history"]).stdout)
    assert len(history["loops"]) >= len(printed["loops"])


def test_front_ends_matches_are_listed_too(tmp_path: Path) -> None:
    submaps, _ = there_and_back()
    s = submaps[2]
    T = se3.se3_between(submaps[0].exit_pose, submaps[0].exit_pose)
    matches = tuple(
        Match(target=0, T_target_here=T, covariance=1e-2 * np.eye(6), fitness=0.9, support=x) for x in (0.9, 0.1)
    )
    back = BackEnd(BackEndConfig(), "batch")
    for x in (*submaps[:2], replace(s, matches=matches)):
        back.add(x)
    OutputFiles(tmp_path).write_lines("events.jsonl", back.graph.events)
    used, left = loops_of_run(tmp_path).current()
    assert (used.verdict, used.source, used.why, used.submap_i, used.submap_j) == (
        "accepted", "front-end", "support 0.90", 0, 2,
    )  # fmt: skip
    assert (left.verdict, left.why, left.factor_id) == ("rejected", "support 0.10 is too little", -1)
    back.graph.remove(used.factor_id, reason="wrong")
    OutputFiles(tmp_path).write_lines("events.jsonl", back.graph.events)
    assert loops_of_run(tmp_path).current()[0].verdict == "undone"


def test_only_a_loop_that_is_in_can_be_undone(folder: Path) -> None:
    refused = [d.loop for d in loops_of_run(folder).current() if d.verdict != "accepted"]
    for number in (*refused[:1], 999):
        with pytest.raises(DataError):
            undo_loop(folder, number)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError):
        loops_of_run(tmp_path)
    (tmp_path / "events.jsonl").write_text('{"event": "loop"\n')
    with pytest.raises(FormatError, match="line 1"):
        loops_of_run(tmp_path)
    (tmp_path / "events.jsonl").write_text("[]\n")
    with pytest.raises(FormatError):
        loops_of_run(tmp_path)
    (tmp_path / "events.jsonl").write_text('{"event": "submap"}\n')
    assert loops_of_run(tmp_path).counts() == {}
    assert CliRunner().invoke(app, ["loops", str(tmp_path)]).exit_code == 0
