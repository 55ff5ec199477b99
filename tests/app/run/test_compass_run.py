"""A recorded compass, distances to beacons, wild fixes: in a run from a log on disk, through every solver."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import MissingDataError
from graphslam.core.geometry import se2_transform
from graphslam.core.log import SensorLog
from graphslam.core.records import Compass, LandmarkObservations
from graphslam.io.log_store import load_log, save_log

POSTS = np.array([[-20.0, 30.0], [35.0, 10.0], [5.0, -30.0]])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> SensorLog:
    """The quick field with a compass and a radio, written to disk and read again."""
    log = gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)
    rng, path = np.random.default_rng(0), log.truth.trajectory
    t = np.arange(path.times[0] + 0.5, path.times[-1] - 0.5, 1.0)
    T = path.interpolate(t)
    compass = Compass(times=t, headings=T[:, 2] + 0.8 + 0.02 * rng.standard_normal(len(t)), sigma=np.full(len(t), 0.02))
    antenna = se2_transform(T, np.array([0.5, 0.0]))
    d = np.linalg.norm(antenna[:, None] - POSTS, axis=2).ravel()
    radio = LandmarkObservations.range_only(
        times=t, offsets=3 * np.arange(len(t) + 1), ranges=d + 0.1 * rng.standard_normal(len(d)),
        range_sigma=np.full(len(d), 0.1), ids=np.tile([11, 12, 13], len(t)), T_base_sensor=np.array([0.5, 0.0, 0.0]),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("log") / "field"
    save_log(dataclasses.replace(log, streams={**log.streams, "compass": compass, "radio": radio}), folder)
    return load_log(folder)


@pytest.mark.parametrize("solver", ["isam2", "lm", "gnc", "pcg"])
def test_a_recorded_compass_and_beacons_enter_the_graph(recorded: SensorLog, solver: str, tmp_path: Path) -> None:
    config = {"compass": {"use": "auto"}, "beacons": {"use": "radio", "robust": "huber"}, "gps": {"use": "all"}}
    run = gs.run(recorded, seed=5, solver=solver, out=tmp_path / "r", progress=False, config=config)
    assert run.metric("converged") == 1.0
    rows = {r["name"]: r for r in run.report["streams"]}
    for name in ("compass", "radio"):
        assert rows[name]["role"] == {"compass": "compass", "radio": "beacons"}[name]
        assert rows[name]["asked"]
        assert rows[name]["used"] > 0.9 * rows[name]["offered"]
    chi2 = run.solution.score
    assert 0.5 < chi2["compass"].chi2_per_dof < 1.6
    assert 0.5 < chi2["beacon"].chi2_per_dof < 1.6
    spent = run.ledger if not hasattr(run.ledger, "table") else run.ledger.table()
    assert {"compass", "radio/11", "radio/12", "radio/13"} <= set(spent["stream"])
    P = run.solution.covariance("compass0")
    assert abs(run.solution.values["compass"][0, 0] - 0.8) < 4 * np.sqrt(P[0, 0]) + 0.02
    again = gs.open_run(tmp_path / "r")
    assert again.report["streams"] == run.report["streams"]


def test_what_is_asked_for_and_not_there_is_refused(recorded: SensorLog) -> None:
    for config in ({"compass": {"use": "fluxgate"}}, {"beacons": {"use": "uwb"}}):
        with pytest.raises(MissingDataError, match=r"uses? names no"):
            gs.run(recorded, seed=5, progress=False, config=config)


def test_gnc_names_wild_fixes_and_the_others_do_not_lose_the_map(recorded: SensorLog, tmp_path: Path) -> None:
    gps = recorded["gps"]
    wild = np.array(gps.positions)
    bad = np.arange(4, len(wild), 9)
    wild[bad, :2] += [14.0, -9.0]
    log = dataclasses.replace(recorded, streams={**recorded.streams, "gps": dataclasses.replace(gps, positions=wild)})
    config = {"gps": {"use": "all", "robust": "none"}}
    run = gs.run(log, seed=5, solver="gnc", out=tmp_path / "r", progress=False, config=config)
    events = [json.loads(line) for line in (run.folder / "events.jsonl").read_text().splitlines()]
    named = [e for e in events if e["event"] == "outlier"]
    assert {e["group"] for e in named} == {"gps"}
    assert len(bad) <= len(named) <= len(bad) + 2
    assert run.metric("converged") == 1.0
    line = next(f for f in run.verdict if f.code == "outliers")
    assert f"{len(named)} of class gps" in line.text
