"""A chain with loops in tiles on disk is the chain in memory; and a killed worker changes no byte."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, GraphSlamError, MissingDataError
from graphslam.skeleton import chain_tiles as tiles
from graphslam.skeleton.chain_graph import ChainGraph, relax_chain
from graphslam.skeleton.chain_tiles import ChainPiece, chain_to_disk, relax_tiles, tasks_of
from graphslam.skeleton.landmark_kernels import Poses
from tests.reference.chain_pieces import cut_chain
from tests.skeleton.test_chain_graph import drawn

# inside tiles, between them, at their borders, crossed, twice, and into the same pose from both sides
LOOPS = [(2, 95), (10, 40), (41, 44), (43, 48), (30, 31), (20, 60), (60, 90), (90, 60), (88, 5), (70, 74), (72, 77)]


@pytest.fixture(scope="module")
def graph() -> ChainGraph:
    return drawn(99, LOOPS, seed=2)[0]


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


@pytest.mark.parametrize("size", [1000, 50, 20, 7])
def test_tiles_end_where_memory_does(graph: ChainGraph, tmp_path: Path, size: int) -> None:
    found = relax_tiles(chain_to_disk(tmp_path, cut_chain(graph, size)), gain=1e-12)
    wanted = relax_chain(graph, gain=1e-12)
    assert len(found.names) == -(-98 // size)
    assert found.converged
    np.testing.assert_allclose(found.history, wanted.history, rtol=1e-9)
    assert found.history[-1] == found.objective
    assert found.predicted == pytest.approx(wanted.predicted, abs=1e-8)
    assert found.largest_move == pytest.approx(wanted.largest_move, abs=1e-8)
    parts = [found.poses(k) for k in range(len(found.names))]
    for a, b in pairwise(parts):  # the shared pose is the same to the byte
        assert a.position[-1].tobytes() == b.position[0].tobytes()
        assert a.rotation[-1].tobytes() == b.rotation[0].tobytes()
    whole = Poses(*(np.concatenate([p[k][:-1] for p in parts] + [parts[-1][k][-1:]]) for k in range(2)))
    np.testing.assert_allclose(whole.position, wanted.poses.position, atol=1e-8)
    np.testing.assert_allclose(whole.rotation, wanted.poses.rotation, atol=1e-8)


def test_each_link_may_have_its_covariance(tmp_path: Path) -> None:
    graph, _ = drawn(30, [(1, 28), (12, 17)])
    scale = np.linspace(0.5, 2.0, 29)[:, None, None]
    graph = ChainGraph(
        graph.rotation,
        graph.translation,
        graph.covariance * scale,
        graph.ends,
        graph.loop_rotation,
        graph.loop_translation,
        graph.loop_covariance,
    )
    found = relax_tiles(chain_to_disk(tmp_path, cut_chain(graph, 8)))
    assert found.objective == pytest.approx(relax_chain(graph).objective, rel=1e-9)


def test_a_killed_worker_changes_no_byte(graph: ChainGraph, tmp_path: Path) -> None:
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    for folder in (alone, shared):
        chain_to_disk(folder, cut_chain(graph, 9))
    assert bytes_of(alone) == bytes_of(shared)
    wanted = relax_tiles(alone, gain=1e-12)
    killed = []
    with pytest.importorskip("distributed").LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:

        def kill(k: int) -> None:
            pid = cluster.workers[k].pid
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

        def progress(_: float) -> None:
            if not killed:
                kill(0)  # before the tasks of the next step are given out …
                threading.Timer(0.02, kill, (1,)).start()  # … and while they run

        found = relax_tiles(shared, cluster=cluster.scheduler_address, gain=1e-12, task_seconds=0.0, progress=progress)
    assert len(set(killed)) == 2
    assert found.names == wanted.names
    assert found.history == wanted.history
    assert bytes_of(shared) == bytes_of(alone)


@pytest.mark.parametrize("least", [0.0, 0.5, 1.0, 3.0, 100.0])
def test_tasks_are_whole_tiles_of_so_many_seconds(least: float) -> None:
    seconds = np.random.default_rng(3).uniform(0.01, 0.7, 60)
    tasks = tasks_of(seconds.tolist(), least)
    assert [k for s in tasks for k in range(s.start, s.stop)] == list(range(60))
    spent = np.array([seconds[s].sum() for s in tasks])
    assert spent.min() >= min(least, seconds.sum())
    assert len(tasks) == 1 or spent[:-1].max() < least + 0.7  # and no longer than they must be


def test_tasks_are_as_long_as_what_was_measured_makes_them(
    graph: ChainGraph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten times as slow as was thought: tasks of one tile where they were of ten; and no byte differs."""
    sizes: list[list[int]] = []

    def slow(work: list[Any]) -> list[tiles.TaskResult]:
        sizes[-1].append(len(work))
        return [tiles.work_on_tile(*one)._replace(seconds=0.1) for one in work]

    def run(work: Any, tasks: list[Any]) -> list[Any]:
        sizes.append([])
        return [work(*t) for t in tasks]

    folders = [chain_to_disk(tmp_path / name, cut_chain(graph, 5)) for name in ("one", "two")]
    wanted = relax_tiles(folders[0])
    monkeypatch.setattr(tiles, "POSE_SECONDS", 0.01 / 5)
    monkeypatch.setattr(tiles, "work_on_tiles", slow)
    monkeypatch.setattr(tiles, "task_runner", lambda workers, cluster: nullcontext(run))
    found = relax_tiles(folders[1], task_seconds=0.095)
    assert sizes[:2] == [[20], [10, 10]]  # first there is no step to take, and half to do
    assert all(set(s) == {1} for s in sizes[2:])
    assert found.tasks == [0.1] * 20
    assert found.names == wanted.names
    assert bytes_of(folders[0]) == bytes_of(folders[1])


def test_no_workers_and_no_scheduler_are_refused(graph: ChainGraph, tmp_path: Path) -> None:
    folder = chain_to_disk(tmp_path / "tiles", cut_chain(graph, 25))
    with pytest.raises(GraphSlamError, match="at least 1 worker"):
        relax_tiles(folder, workers=0)
    with pytest.raises(GraphSlamError, match=r"127\.0\.0\.1:1"):
        relax_tiles(folder, cluster="127.0.0.1:1")


def test_a_run_that_was_killed_is_repeated_without_a_changed_byte(graph: ChainGraph, tmp_path: Path) -> None:
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    for folder in (whole, stopped):
        chain_to_disk(folder, cut_chain(graph, 25))

    class Stop(Exception):
        pass

    def stop(_: float) -> None:
        raise Stop

    with pytest.raises(Stop):
        relax_tiles(stopped, progress=stop)
    (stopped / ".half.arrays.1-0123abcd.part").write_bytes(b"half")
    assert relax_tiles(stopped).names == relax_tiles(whole).names
    assert bytes_of(stopped) == bytes_of(whole)


def test_impossible_tiles_are_refused(graph: ChainGraph, tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        relax_tiles(tmp_path)
    with pytest.raises(ConfigError, match="one of them"):
        relax_tiles(chain_to_disk(tmp_path, cut_chain(graph, 50)), workers=2, cluster="127.0.0.1:1")
    pieces = list(cut_chain(graph, 50))
    with pytest.raises(DataError, match="poses of 0 … 50"):
        chain_to_disk(tmp_path / "other", [ChainPiece(*pieces[0][:3], *pieces[1][3:])])
    with pytest.raises(DataError, match="finite"):
        chain_to_disk(tmp_path / "other", [pieces[0]._replace(translation=np.full((50, 3), np.nan))])
    with pytest.raises(ConfigError, match="links"):
        next(cut_chain(graph, 0))
    for path in sorted(tmp_path.glob("*.arrays")):
        good = path.read_bytes()
        path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
        with pytest.raises(FormatError, match="digest"):
            relax_tiles(tmp_path)
        path.write_bytes(good)
        break
    index = tmp_path / "chain.json"
    index.write_text(index.read_text().replace(path.name, "../" + path.name))
    with pytest.raises(FormatError, match="name of a file"):
        relax_tiles(tmp_path)
