"""A loop that was taken out of a run by hand stays out until it is taken in again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.app.compare import compare_methods
from graphslam.app.run.files import loops_of_run, removed_loops_of_run
from graphslam.app.run.loops import redo_loop, undo_loop
from graphslam.app.run.outputs import SAME_BYTES, read_run_folder
from graphslam.app.run.pipeline import run
from graphslam.app.run.run import Run
from graphslam.app.submap_sources import submap_source
from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.join.registry import join_by_method
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from tests.app.cli.test_cli import graphslam
from tests.faults.kills import snapshot

OPTIONS: dict[str, Any] = {
    "frontend": {"filter": {"particles": 3}},
    "backend": {"loops": True},
    "map": {"fuse": False},
    "refine": {"use": False},
}


@pytest.fixture(scope="module")
def log() -> SensorLog:
    """Twice round a corner: SegSLAM enters its first map again."""
    return simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.08, max_range=8.0))


def go_on(log: SensorLog, folder: Path, *, resume: bool = True) -> Run:
    return run(log, frontend="segslam", seed=2, out=folder, config=OPTIONS, resume=resume, progress=False)


def check_that_joiners_find_the_graph(whole: Run, folder: Path) -> None:
    """Every method ends where the run's own graph does, from the run in memory and from its folder alone."""
    sources = {
        "memory": submap_source(whole),
        "folder": submap_source(folder),
        "store": submap_source(folder / "submaps"),
    }
    tables = {name: compare_methods(s.material, truth=s.truth, memory=False) for name, s in sources.items()}
    wanted = whole.graph.objective().total
    for table in tables.values():
        np.testing.assert_allclose(table["objective_polished"], wanted, rtol=1e-6)
        assert (table["nees_dof"] == 6 * len(whole.submaps)).all()
        np.testing.assert_allclose(table["nees"], table["nees"][0], rtol=1e-4)
    problem = sources["folder"].problem
    assert "levelled" in problem.factor_counts()
    assert problem.dof == whole.graph.objective().dof
    found = join_by_method(problem, "eif-tree", polish=True)
    np.testing.assert_allclose(found.poses, whole.map.node_poses, atol=1e-5)
    P = np.stack([found.pose_covariance(int(k)) for k in problem.bases[1:]])
    np.testing.assert_allclose(P, whole.map.node_covariances[problem.bases[1:]], atol=1e-4 * np.abs(P).max())


def test_an_undone_loop_stays_undone_when_the_run_is_resumed(log: SensorLog, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    whole = go_on(log, folder, resume=False)
    (loop,) = [d for d in loops_of_run(folder).current() if d.verdict == "accepted"]
    assert removed_loops_of_run(folder) == []
    check_that_joiners_find_the_graph(whole, folder)
    with pytest.raises(DataError, match="was not undone"):
        redo_loop(folder, loop.loop, progress=False)

    before = snapshot(folder, SAME_BYTES)
    undo_loop(folder, loop.loop, progress=False)
    assert snapshot(folder, SAME_BYTES)["run.json"] != before["run.json"]
    without = read_run_folder(folder).map.node_poses
    assert np.abs(without - whole.map.node_poses).max() > 1e-3
    for _ in range(2):  # and again when what was resumed is resumed
        resumed = go_on(log, folder)
        (undone,) = removed_loops_of_run(folder)
        assert (undone.submap_i, undone.submap_j, undone.i, undone.j) == (
            loop.submap_i, loop.submap_j, loop.i, loop.j,
        )  # fmt: skip
        assert not [r for r in resumed.graph.records.values() if r.group in ("match", "loop")]
        np.testing.assert_allclose(resumed.map.node_poses, without, atol=1e-9)
        assert any(e["event"] == "removed" and e["reason"] == "undone" for e in resumed.events)

    redo_loop(folder, undone.loop, progress=False)
    after = snapshot(folder, SAME_BYTES)
    assert [n for n in {*before, *after} if before.get(n) != after.get(n)] == []
    assert removed_loops_of_run(folder) == []
    np.testing.assert_allclose(read_run_folder(folder).map.node_poses, whole.map.node_poses, atol=1e-9)


def test_a_run_that_was_never_finished_has_undone_nothing(tmp_path: Path) -> None:
    assert removed_loops_of_run(tmp_path) == []


def test_the_command_takes_one_of_both(tmp_path: Path) -> None:
    done = graphslam("loops", tmp_path, "--undo", "1", "--redo", "1")
    assert done.returncode != 0
    assert "give one of them" in done.stderr
    (tmp_path / "events.jsonl").write_text(json.dumps({"event": "submap"}) + "\n")
    assert "not in the ledger" in graphslam("loops", tmp_path, "--redo", "1").stderr
