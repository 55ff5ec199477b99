"""The verdict of a run: what a user without truth is told, in text, in JSON, and in the report."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

import graphslam as gs
from graphslam.app.cli.run import _summary, join_note
from graphslam.app.report.report import make_report
from graphslam.app.run.run import Run
from graphslam.app.run.verdict import Figures, observed, stated
from graphslam.core.findings import Finding, findings_of_json, headline, verdict_json
from tests.reference.page import Page


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    log = gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)
    return gs.run(log, seed=5, out=tmp_path_factory.mktemp("verdict") / "r", progress=False)


def test_text_json_and_report_say_the_same(run: Run) -> None:
    lines = run.verdict
    assert {"streams", "state", "chi2", "nees"} <= {f.code for f in lines}
    stored = json.loads((run.folder / "run.json").read_text())["verdict"]
    assert findings_of_json(stored) == lines
    assert gs.open_run(run.folder).verdict == lines
    text = _summary(run, Path("out"))
    page = Page(make_report(run.folder).html)
    shown = [t for _, t in page.verdict]
    for f in lines:
        assert f.text in text
        assert f.text in shown
    assert headline(lines).text in text


def test_every_stream_is_counted(run: Run) -> None:
    rows = {r["name"]: r for r in run.report["streams"]}
    assert set(rows) == set(run.log.streams)
    for name, row in rows.items():
        assert row["offered"] == len(run.log[name].times)
        assert 0 <= row["used"] <= row["offered"]
        assert row["used"] == row["offered"] or row["why"]
    assert rows["landmarks"]["used"] > 0.9 * rows["landmarks"]["offered"]
    assert (rows["gps"]["used"], rows["gps"]["why"]) == (0, "gps.use is none")


@pytest.mark.parametrize(
    ("levels", "said"),
    [
        (["good", ""], "Nothing that"),
        (["good", "look"], "point marked “look”"),
        (["bad", "bad", "look"], "the 2 points"),
    ],
)
def test_the_headline_is_that_of_the_worst_line(levels: list[str], said: str) -> None:
    assert said in headline([Finding(level, "x", "y") for level in levels]).text


def test_loops_that_disagree_are_read_by_the_verdict() -> None:
    """A mounting that is wrong by a metre shows nowhere else: the figure must reach the user."""
    solved = {"converged": True}
    dof = 400.0
    for value, expected in ((1.05, []), (1.76, ["bad"])):
        lines = stated(Figures(solved, {"loops_value": value, "loops_dof": dof, "gap": 0.0}))
        assert [f.level for f in lines if "loops" in f.text] == expected


def test_what_is_said_of_many_submaps_is_said_twice_and_counted() -> None:
    def submap(key: int) -> SimpleNamespace:
        rows = [Finding("look", "scans-unheld", f"Submap {key}: nothing holds it.").as_row()]
        rows += [Finding("", "note", text).as_row() for text in ("one", "two", "three")] if key == 0 else []
        return SimpleNamespace(key=key, report={"findings": rows})

    found = observed([], submaps=[submap(k) for k in range(20)])  # type: ignore[misc]
    assert [f.text for f in found if f.code == "note"] == ["one", "two", "three"]
    unheld = [f.text for f in found if f.code == "scans-unheld"]
    assert len(unheld) == 3
    assert unheld[0] == "Submap 0: nothing holds it."
    assert "18 more submaps: 2, 3, 4" in unheld[2]
    assert not [f for f in observed([], submaps=[submap(0), submap(1)]) if "more submaps" in f.text]


def test_what_is_no_finding_of_ours_is_left_out() -> None:
    good = Finding("bad", "x", "y")
    value = verdict_json([good])
    for row in (
        {"level": "worse", "code": "x", "text": "y"},
        {"level": "bad"},
        3,
        None,
        {"level": [], "code": "", "text": ""},
    ):
        value["lines"].append(row)
    assert findings_of_json(value) == [good]
    assert findings_of_json({"lines": 3}) == findings_of_json(None) == []


def test_the_note_on_the_join_is_one_that_honest_runs_do_not_get(run: Run) -> None:
    """Two-sided bounds at the join's own degrees of freedom; and a cause that a check names comes first."""

    def noted(chi2: float, dof: float, verdict: list[Finding]) -> list[str]:
        metrics = pd.DataFrame({"key": ["join_chi2_per_dof", "join_dof"], "value": [chi2, dof]})
        return join_note(SimpleNamespace(metrics=metrics, report={"covariance_scale": 1.0}, verdict=verdict))

    assert join_note(run) == []
    assert noted(1.5, 20, []) == []
    assert "covariance_scale=1.5" in noted(1.5, 200, [])[0]
    assert "covariance_scale=0.8" in noted(0.8, 2000, [])[0]
    (line,) = noted(1.5, 200, [Finding("bad", "calibration", "x"), Finding("", "streams", "y")])
    assert "calibration" in line
    assert "covariance_scale" not in line
