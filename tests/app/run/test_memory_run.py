"""A run holds no more submaps in memory than there is room for, and writes the same bytes as if it held them all."""

from __future__ import annotations

import shutil
import weakref
from pathlib import Path
from typing import Any

import pytest

import graphslam as gs
from graphslam.app.run.outputs import SAME_BYTES
from graphslam.app.run.run import Run
from graphslam.core.log import SensorLog
from graphslam.core.spill_cache import SPILL_CACHE
from graphslam.evidence.pool import GridPool
from graphslam.io.submap_store import SubmapStore
from graphslam.loops import measure
from graphslam.sim.mesh_worlds import mesh_world
from graphslam_studies.sim.lidar import LidarConfig, simulate_lidar
from tests.faults.kills import snapshot

OPTIONS: dict[str, Any] = {
    "frontend": {"submap": {"length": 1.0, "points": 400, "reach": 15.0}},
    "backend": {"loops": True, "look_every": 3},
}
ROOM = 3_000_000
"""Less than two grids, or a few pieces [bytes]."""


@pytest.fixture(scope="module")
def log() -> SensorLog:
    config = LidarConfig(rate=4.0, points=3000, lines=32)
    return simulate_lidar(mesh_world("building", seed=2), 2, config, most=18.0)


def go(log: SensorLog, out: Path, **how: Any) -> Run:
    return gs.run(log, frontend="lidar-odometry", config=OPTIONS, out=out, progress=False, **how)


@pytest.fixture(scope="module")
def whole(log: SensorLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a run that has room for everything."""
    folder = tmp_path_factory.mktemp("memory") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SPILL_CACHE, "room", 1 << 40)
        run = go(log, folder)
    assert len(run.submaps) >= 10
    assert run.fused is not None
    return folder


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardly any room, for loops neither."""
    monkeypatch.setattr(SPILL_CACHE, "room", ROOM)
    monkeypatch.setattr(measure, "ROOM", 0)


@pytest.mark.usefixtures("narrow")
def test_few_grids_are_alive_and_the_files_are_the_same(
    log: SensorLog, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alive, most = weakref.WeakSet[GridPool](), [0]
    before = GridPool.__init__

    def counted(self: GridPool, *a: Any, **k: Any) -> None:
        before(self, *a, **k)
        alive.add(self)
        most[0] = max(most[0], sum(p.used_bricks > 0 for p in list(alive)))

    monkeypatch.setattr(GridPool, "__init__", counted)
    run = go(log, tmp_path / "run")
    assert len(run.submaps) >= 10
    assert most[0] <= 8  # the fused map, coarser ones, and few submaps, whatever the number of them
    assert snapshot(tmp_path / "run", SAME_BYTES) == snapshot(whole, SAME_BYTES)


@pytest.mark.usefixtures("narrow")
def test_a_run_that_is_resumed_is_the_same(log: SensorLog, whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "run", symlinks=True)
    SubmapStore(tmp_path / "run").truncate(4)
    go(log, tmp_path / "run", resume=True)
    assert snapshot(tmp_path / "run", SAME_BYTES) == snapshot(whole, SAME_BYTES)
