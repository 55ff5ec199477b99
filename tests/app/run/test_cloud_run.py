"""Runs whose submaps carry clouds: loops between them, fused maps of them, and every verb on their folders."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.run import options as run_options
from graphslam.app.run.files import loops_of_run
from graphslam.app.run.outputs import SAME_BYTES
from graphslam.app.run.run import Run
from graphslam.backend.back_end import Observer
from graphslam.core.config import build_config
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.io.submap_store import read_submaps
from graphslam.loops.ledger import LoopDecision
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from tests.faults.kills import snapshot
from tests.reference.cloud_front_end import CloudConfig, CloudFrontEnd


@pytest.fixture(scope="module")
def log() -> SensorLog:
    """Nearly one and a half times round a block: the way comes back to where it was."""
    return simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.02, max_range=8.0))


@pytest.fixture(scope="module")
def go(log: SensorLog) -> Any:
    """Runs the log with the front end of clouds through the public verb."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_options, "recommended_options", lambda *_: {})
        patch.setattr(
            run_options, "make_front_end", lambda _, o: CloudFrontEnd(build_config(CloudConfig, o, "frontend"))
        )

        def run(out: Path | None = None, *, every: int = 2, loops: bool = True, **how: Any) -> Run:
            front = {k: how.pop(k) for k in ("origins", "grid") if k in how}
            options = {
                "frontend": {"length": 8.0, "steps": {"max_range": 8.0}, **front},
                "backend": {"loops": loops, "look_every": every},
            }
            return gs.run(log, frontend="clouds", config=options, out=out, **{"progress": False, **how})

        yield run


@pytest.fixture(scope="module")
def finished(go: Callable[..., Run], tmp_path_factory: pytest.TempPathFactory) -> Run:
    return go(tmp_path_factory.mktemp("clouds") / "run")


def assert_right(run: Run, log: SensorLog) -> int:
    """Every accepted loop is where the truth has it, within 3 σ; returns how many there are."""
    accepted = [e for e in run.events if e["event"] == "loop" and e["verdict"] == "accepted"]
    assert log.truth is not None
    for e in accepted:
        x = log.truth.trajectory.interpolate(run.map.node_times[[e["i"], e["j"]]])
        r = SE3.log(SE3.between(SE3.between(x[0], x[1]), np.array(e["T_ij"])))
        assert r @ np.linalg.solve(np.array(e["covariance"]), r) < stats.chi2.ppf(0.9973, 6)
        assert e["gates"]["loose"] or np.linalg.norm(r[3:]) < 0.5  # along a corridor its σ says that it does not know
    return len(accepted)


def test_loops_between_clouds_close_the_map(finished: Run, go: Callable[..., Run], log: SensorLog) -> None:
    assert all(s.grid is None and s.cloud is not None for s in finished.submaps)
    assert assert_right(finished, log) >= 2
    open_chain = go(loops=False)
    assert finished.metric("path_rmse_aligned") < 0.3 * open_chain.metric("path_rmse_aligned")
    assert finished.metric("map_entropy") < 0.95 * open_chain.metric("map_entropy")
    assert finished.metric("converged") == 1


class Listener(Observer):
    """Submaps in the graph and loops accepted, in the order in which they came."""

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def submap_added(self, submap: Submap, graph: FactorGraph) -> None:
        self.calls.append(submap.key)

    def loop_decided(self, decision: LoopDecision, graph: FactorGraph) -> None:
        if decision.verdict == "accepted":
            assert decision.factor_id in graph.records
            self.calls.append((decision.submap_i, decision.submap_j))


def test_loops_enter_while_the_run_goes_on(go: Callable[..., Run], log: SensorLog) -> None:
    heard, late = Listener(), Listener()
    now = go(every=1, progress=[heard])
    end = go(every=0, progress=[late])
    last = [s.key for s in now.submaps][-1]
    for n, x in enumerate(heard.calls):
        if isinstance(x, tuple):
            assert set(x) <= set(heard.calls[:n]) | {last}
    first = next(n for n, x in enumerate(heard.calls) if isinstance(x, tuple))
    assert last in heard.calls[first:], "no loop was there before the last submap"
    assert last not in late.calls[next(n for n, x in enumerate(late.calls) if isinstance(x, tuple)) :]
    assert assert_right(now, log) >= assert_right(end, log)
    assert now.metric("path_rmse_aligned") < 1.5 * end.metric("path_rmse_aligned")


def test_points_alone_are_not_matched_where_they_do_not_fit_whole(go: Callable[..., Run], log: SensorLog) -> None:
    """Without the places from which they were seen nothing says what is free: partial overlaps are refused."""
    run = go(origins=False)
    assert_right(run, log)
    assert any(e["event"] == "loop" and "fitness" in e["why"] for e in run.events)
    assert run.fused is not None
    facts = run.fused.facts()
    assert facts["free_space_known"] is False
    assert facts["points"] == len(run.fused.points) > 1000


def test_a_grid_beside_the_cloud_gives_the_space(go: Callable[..., Run], log: SensorLog) -> None:
    run = go(origins=False, grid=True)
    assert assert_right(run, log) >= 1
    assert run.fused is not None
    assert run.fused.facts()["free_space_known"] is True
    assert run.fused.points is not None


def test_the_folder_has_the_points_and_comes_back(finished: Run) -> None:
    folder = finished.folder
    assert folder is not None
    assert finished.fused is not None
    head, rows = (folder / "cloud.ply").read_bytes().split(b"end_header\n", 1)
    assert f"element vertex {len(finished.fused.points)}".encode() in head
    np.testing.assert_allclose(np.frombuffer(rows, "<f4").reshape(-1, 3), finished.fused.points, atol=1e-4)
    # the points move with the graph: with the loops in they stand closer together than along the open chain
    assert {"map.ply", "map.bt", "fused_map.json", "cloud.ply"} <= {p.name for p in folder.iterdir()}
    back = read_submaps(folder)
    for a, b in zip(back, finished.submaps):
        np.testing.assert_array_equal(a.cloud.points, b.cloud.points)
        np.testing.assert_array_equal(a.cloud.origins[a.cloud.scan], b.cloud.origins[b.cloud.scan])


def test_every_verb_works_on_the_folder(finished: Run) -> None:
    """Loops, map, report, undo and redo, as the command line has them."""
    folder = finished.folder
    assert folder is not None

    def say(*words: object) -> Any:
        done = CliRunner().invoke(app, [*map(str, words), "--json"], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    before = snapshot(folder, SAME_BYTES)
    accepted = [d.loop for d in loops_of_run(folder).current() if d.verdict == "accepted"]
    assert sum(d["verdict"] == "accepted" for d in say("loops", folder)["loops"]) == len(accepted)
    made = say("map", folder)
    assert made["points"] == len(finished.fused.points)
    assert str(folder / "cloud.ply") in made["files"]
    assert snapshot(folder, SAME_BYTES) == before
    say("report", folder)
    say("loops", folder, "--undo", accepted[0])
    assert snapshot(folder, SAME_BYTES)["cloud.ply"] != before["cloud.ply"]
    say("loops", folder, "--redo", accepted[0])
    assert snapshot(folder, SAME_BYTES) == before


def test_a_resumed_run_is_the_run(finished: Run, go: Callable[..., Run], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / "submaps").mkdir(parents=True)
    shutil.copy(finished.folder / "config.toml", folder)
    for name in ("000000.npz", "000001.npz"):
        shutil.copy(finished.folder / "submaps" / name, folder / "submaps")
    index = json.loads((finished.folder / "submaps" / "index.json").read_text())
    index |= {"count": 2, "submaps": index["submaps"][:2]}
    (folder / "submaps" / "index.json").write_text(json.dumps(index))
    go(folder, resume=True)
    assert snapshot(folder, SAME_BYTES) == snapshot(finished.folder, SAME_BYTES)
