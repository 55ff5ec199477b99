"""A run read back from disk has its ledger and its events."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pandas as pd
import pytest

import graphslam as gs
from graphslam.core.config import dump_toml, merge_options
from graphslam.core.errors import FormatError, RunFolderError


def test_ledger_and_events_come_back(tmp_path: Path) -> None:
    log = gs.simulate("landmark-field", preset="quick", gps_rate=1.0)
    config = {"gps": {"use": "every-second"}}
    run = gs.run(log, out=tmp_path / "run", solver="batch", config=config, progress=False)
    again = gs.open_run(tmp_path / "run")
    assert run.ledger is not None
    assert again.ledger is not None
    pd.testing.assert_frame_equal(again.ledger, run.ledger, check_dtype=False)
    assert {"submap", "datum"} <= {e["event"] for e in again.events}
    assert [e["event"] for e in again.events] == [e["event"] for e in run.events]
    assert repr(again) == repr(run)
    assert f"{len(run.submaps)} submaps" in repr(run)
    assert str(len(log["controls"].times)) in repr(log)
    assert repr(run.submaps[0]).startswith("Submap(0, [0.00, ")
    with (tmp_path / "run" / "events.jsonl").open("a") as stream:
        stream.write("{half a li")
    with pytest.raises(FormatError, match=r"events\.jsonl"):
        gs.open_run(tmp_path / "run")


def test_a_time_that_was_not_measured_is_left_out(tmp_path: Path) -> None:
    gs.run(gs.simulate("landmark-field", preset="quick", laps=0.3), out=tmp_path / "run", progress=False)
    file = tmp_path / "run" / "timings.json"
    rows = json.loads(file.read_text())
    row = next(r for r in rows if r["key"].startswith("seconds_"))
    row["value"] = None
    file.write_text(json.dumps(rows))
    seconds = gs.open_run(tmp_path / "run").report["seconds"]
    assert row["key"].removeprefix("seconds_") not in seconds
    assert len(seconds) == sum(r["key"].startswith("seconds_") for r in rows) - 1


def test_a_folder_with_an_option_that_is_none_is_not_resumed(tmp_path: Path) -> None:
    log, out = gs.simulate("landmark-field", preset="quick", laps=0.3), tmp_path / "run"
    gs.run(log, out=out, progress=False)
    file = out / "config.toml"
    file.write_text(dump_toml(merge_options(tomllib.loads(file.read_text()), {"backend": {"merge_reach": 6.0}})))
    with pytest.raises(RunFolderError, match=r"cannot resume, backend\.merge_reach was 6\.0 and is None now"):
        gs.run(log, out=out, resume=True, progress=False)
