"""A run is made again from its folder alone, and gone on with on its own log alone: the same bytes."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run import config as cfg
from graphslam.app.run import pipeline
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.outputs import SAME_BYTES
from graphslam.app.run.reopened import rerun_without_loops
from graphslam.backend.config import BackEndConfig
from graphslam.backend.hypotheses import solve_choice
from graphslam.backend.streams import ImuSource
from graphslam.core.config import build_config
from graphslam.core.errors import FormatError, MissingDataError, RunFolderError
from graphslam.core.log import SensorLog
from graphslam.core.record_source import RecordSource
from graphslam.io.log_digest import log_digest
from graphslam.io.log_store import load_log, save_log
from tests.app.run.test_imu_run import made, solved
from tests.app.run.test_pipeline_space import solved as ring_run
from tests.faults.kills import snapshot

OPTIONS: dict[str, Any] = {"gps": {"use": "every-second"}, "frontend": {"particles": 10}}


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)


@pytest.fixture(scope="module")
def folder(log: SensorLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("again") / "run"
    gs.run(log, seed=5, out=out, config=OPTIONS, progress=False)
    return out


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy", symlinks=True))


def go_on(log: SensorLog, out: Path, **options: Any) -> gs.Run:
    return gs.run(log, seed=5, out=out, config=OPTIONS, resume=True, progress=False, **options)


def remade(folder: Path) -> None:
    before = snapshot(folder, SAME_BYTES)
    assert {"run.json", "inputs.npz", "graph.g2o", "figures/map.png"} <= set(before)
    assert (folder / "timings.json").is_file()
    rerun_without_loops(folder, [], progress=False)
    after = snapshot(folder, SAME_BYTES)
    assert [n for n in {*before, *after} if before.get(n) != after.get(n)] == []


def test_of_landmarks_with_gps(copy: Path) -> None:
    remade(copy)


@pytest.mark.parametrize("dim", [2, 3])
def test_of_dense_submaps_with_matches_and_gps(dim: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ring_run(dim, monkeypatch, tmp_path / "run")
    monkeypatch.undo()
    remade(tmp_path / "run")


def test_with_imu_factors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log, submaps = made()
    short = replace(log, streams={"imu": log["imu"].take(log["imu"].times > 1.0)})
    run = solved(short, submaps, monkeypatch, tmp_path / "run", config={"imu": {"use": "auto"}}, solver="batch")
    monkeypatch.undo()
    assert run.graph.sensors["imu"].used
    remade(tmp_path / "run")
    settings = build_config(cfg.RunConfig, {"imu": {"use": "auto"}})
    back = solve_choice(submaps, frozenset(), BackEndConfig(), imu=ImuSource(RecordSource(short), settings.imu))
    back.finish()
    assert back.graph.objective().total == pytest.approx(run.metric("objective"), rel=1e-6)


def test_a_folder_without_what_the_graph_was_made_of_says_so(
    log: SensorLog, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    odd = replace(log, streams={f"{n}/front": s for n, s in log.streams.items()})
    with caplog.at_level(logging.WARNING):
        gs.run(odd, seed=5, out=tmp_path / "run", config=OPTIONS, progress=False)
    assert "no loop closure of this run can be undone" in caplog.text
    assert gs.open_run(tmp_path / "run").metric("converged") == 1.0
    with pytest.raises(MissingDataError, match="--resume"):
        rerun_without_loops(tmp_path / "run", [], progress=False)


def test_files_of_two_states_are_distinguished(folder: Path, log: SensorLog, tmp_path: Path) -> None:
    gs.run(log, seed=6, out=tmp_path / "other", config=OPTIONS, progress=False)
    for name in ("map.npz", "association.npz", "gps_all.npz", "fixes.npz", "events.jsonl"):
        mixed = Path(shutil.copytree(folder, tmp_path / name))  # links followed: plain files
        shutil.copy(tmp_path / "other" / name, mixed / name)
        with pytest.raises(FormatError, match=rf"{name}: does not belong to the same state as run\.json"):
            gs.open_run(mixed)
    cut = Path(shutil.copytree(folder, tmp_path / "cut"))
    store = RunFolder(cut).submaps
    store.truncate(len(store) - 1)
    with pytest.raises(FormatError, match="submaps do not match"):
        gs.open_run(cut)
    assert gs.open_run(go_on(log, cut).folder).metric("converged") == 1.0


# --- the log ----------------------------------------------------------------------------------------------------


def test_the_same_log_has_the_same_digest(log: SensorLog, tmp_path: Path) -> None:
    save_log(log, tmp_path)
    assert log_digest(load_log(tmp_path)) == log_digest(log)
    assert log_digest(replace(log, meta={}, read={}, dropped={}))["landmarks"] == log_digest(log)["landmarks"]


def test_every_array_and_the_truth_count(log: SensorLog) -> None:
    whole = log_digest(log)
    assert set(whole) >= {*log.streams, "(truth)"}
    assert log.truth is not None
    for name, stream in log.streams.items():
        for f in stream.__dataclass_fields__:
            value = getattr(stream, f)
            if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.size:
                moved = value.copy()
                moved.flat[-1] = np.nextafter(moved.flat[-1], np.inf)
                other = log_digest(replace(log, streams={**log.streams, name: replace(stream, **{f: moved})}))
                assert {k for k in whole if other[k] != whole[k]} == {name}, f
    path = log.truth.trajectory
    shifted = replace(path, poses=path.poses + [1e-9, 0, 0])
    other = log_digest(replace(log, truth=replace(log.truth, trajectory=shifted)))
    assert {k for k in whole if other[k] != whole[k]} == {"(truth)"}


def test_a_run_is_not_resumed_on_another_log(copy: Path, log: SensorLog) -> None:
    before = snapshot(copy, ("*", "figures/*", "submaps/*"))
    other = gs.simulate("landmark-field", preset="quick", seed=4, gps_rate=1.0, gps_sigma=0.3)
    assert other.name == log.name
    with pytest.raises(RunFolderError, match=r"cannot resume, another log is given: run\.log\.\S+ was '\d+ records"):
        go_on(other, copy)
    end = log.interval[1]
    grown, part = log, log.slice(0.0, 0.8 * end)
    gs.run(part, seed=5, out=copy.with_name("part"), config=OPTIONS, progress=False)
    with pytest.raises(RunFolderError, match="another log is given"):
        go_on(grown, copy.with_name("part"))
    assert snapshot(copy, ("*", "figures/*", "submaps/*")) == before
    go_on(log, copy)


def test_a_run_that_failed_before_its_first_submap_does_not_block(
    log: SensorLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as m:
        m.setattr(pipeline.SubmapSlam, "step", lambda _: None)
        with pytest.raises(MissingDataError, match="no submap"):
            gs.run(log, seed=1, out=tmp_path / "run", progress=False)
    assert (tmp_path / "run" / "config.toml").is_file()
    (tmp_path / "run" / ".config.toml.12-0123abcd.part").write_text("half")
    run = gs.run(log, seed=5, out=tmp_path / "run", config=OPTIONS, progress=False)
    assert run.report["seed"] == 5
    assert not list((tmp_path / "run").glob(".*.part"))
    with pytest.raises(RunFolderError, match="holds a run already"):
        gs.run(log, seed=5, out=tmp_path / "run", config=OPTIONS, progress=False)
    only = tmp_path / "only"
    only.mkdir()
    (only / ".config.toml.12-0123abcd.part").write_text("half")
    gs.run(log, seed=5, out=only, config=OPTIONS, progress=False)
    assert json.loads((only / "run.json").read_text())["generation"] == run.report["generation"]
