"""Loops in a report: the rows of ``graphslam loops``, what was undone, ties between sessions, hypotheses."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.report.loops import COLUMNS
from graphslam.app.report.report import PAGE, make_report
from graphslam.app.run import options as run_options
from graphslam.app.run import pipeline
from graphslam.loops.ledger import LoopDecision
from tests.app.run.test_pipeline_space import ring
from tests.reference.page import Page


def run_ring(dim: int, out: Path) -> Path:
    """A chain driven twice whose second lap was matched, one match vaguely."""
    log, front = ring(dim)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_options, "make_front_end", lambda *_: front)
        patch.setattr(run_options, "recommended_options", lambda *_: {})
        config = {"gps": {"use": "every-second", "robust": "none"}}
        pipeline.run(log, frontend="ring", out=out, config=config, progress=False, solver="batch")
    return out


@pytest.fixture(scope="module", params=[2, 3])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_ring(request.param, tmp_path_factory.mktemp("ring") / "run")


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def decisions() -> list[dict[str, Any]]:
    """Loops of every verdict, one of them undone after it was in."""
    P = (0.01 * np.eye(6)).tolist()
    first = LoopDecision(
        loop=0, verdict="accepted", why="all gates", i=3, j=40, submap_i=0, submap_j=5, source="proximity", score=2.5,
        gain=3.0, gates={"fitness": 0.9, "fitness_known": 0.93, "margin": 0.2, "tilt": None}, chi2=4.25, weight=0.75,
        effect_predicted=4.5, effect=4.125, effect_earlier=1.5, factor_id=9, T_ij=[0.0, 0, 0, 0, 0, 0, 1], covariance=P,
    )  # fmt: skip
    second = replace(first, loop=1, i=5, j=30, factor_id=10, chi2=1.0)
    return [
        first.event(),
        second.event(),
        replace(second, verdict="undone", why="asked for", weight=0.0, factor_id=-1).event(),
        LoopDecision(loop=2, verdict="rejected", why="χ² 95.2 > 22.5", i=2, j=33, chi2=95.2).event(),
        LoopDecision(loop=3, verdict="switched-off", why="weight 0.001", i=7, j=31, weight=0.001, factor_id=12).event(),
        LoopDecision(loop=4, verdict="rejected", why="registration: nothing", i=8, j=34).event(),
    ]


def add_events(folder: Path, events: list[dict[str, Any]]) -> None:
    with (folder / "events.jsonl").open("a") as stream:
        for e in events:
            plain = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in e.items()}
            stream.write(json.dumps(plain) + "\n")


def shown(page: Page) -> list[dict[str, str]]:
    """Every row of the ledger, folded ones included."""
    head = list(COLUMNS.values())
    return [r for t in page.tables if t.section == "loops" and t.rows[0] == head for r in t.records()]


def as_cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def check_rows(folder: Path) -> list[dict[str, str]]:
    """The page holds the rows of ``graphslam loops``, each once."""
    printed = json.loads(CliRunner().invoke(app, ["loops", str(folder), "--json"]).stdout)
    page = Page(make_report(folder).html)
    page.check_alone()
    rows = {int(r["loop"]): r for r in shown(page)}
    assert len(rows) == len(shown(page)) == len(printed["loops"])
    for expected in printed["loops"]:
        row = rows[expected["loop"]]
        for key, heading in COLUMNS.items():
            if key != "gates":
                assert row[heading] == as_cell(expected[key]), (key, expected)
    for verdict, n in printed["counts"].items():
        assert f"{n} {verdict}" in page.sections["loops"]
    return shown(page)


def test_matches_of_a_front_end(folder: Path) -> None:
    rows = check_rows(folder)
    assert [r["verdict"] for r in rows] == ["accepted"] * 3 + ["rejected"]
    assert rows[-1]["why"] == "support 0.10 is too little"
    page = Page((folder / PAGE).read_text(encoding="utf-8"))
    assert "Loop closures by their number" in page.sections["figures"]
    assert "NEES/n of the submap end poses" in page.sections["figures"]
    kinds = {r["class of factor"]: r for r in page.table("graph", "class of factor").records()}
    assert set(kinds) == {"dense-submap", "match", "gps"}
    assert kinds["match"]["factors"] == "3"
    declared = {r["kind"]: r for r in page.table("evidence", "reason").records()}
    assert declared["shared-scan"]["factors"] == "3"


def test_every_decision_with_its_reason(copy: Path) -> None:
    out = copy
    add_events(out, decisions())
    rows = check_rows(out)
    order = [r["verdict"] for r in rows]
    assert order == ["accepted"] * 4 + ["switched-off", "undone"] + ["rejected"] * 3
    page = Page(make_report(out).html)
    ledger = page.table("loops", "loop", "gates")
    marked = {row[0]: class_ for row, class_ in zip(ledger.rows, ledger.classes)}
    assert (marked["0"], marked["1"], marked["2"]) == ("accepted", "undone", "rejected")
    first = next(r for r in rows if r["loop"] == "0")
    assert (first["fitness"], first["σ [m]"], first["effect"]) == ("0.93", "0.1", "4.125")
    assert first["gates"] == "fitness 0.9, fitness_known 0.93, margin 0.2"
    history = next(t for t in page.tables if t.section == "loops" and len(t.rows[0]) == 6).records()
    assert [(r["loop"], r["verdict"]) for r in history] == [("1", "accepted"), ("1", "undone")]
    assert "1 rejected by registration" in page.sections["loops"]


def test_hypotheses_and_runners_up(copy: Path) -> None:
    out = copy
    assert "Missing: " in Page(make_report(out).html).sections["hypotheses"]
    clearest = {"format": "graphslam.clearest/1", "why": "hypothesis 0 is contradicted"}
    facts = {"withdrawn": [0, 3], "submaps": 4, "entries": [[0, 3]], "loops": 1, "chi2": 7.5, "dof": 9, "entropy": 12.5}
    topologies = [
        {"verdict": "chosen", "choice": "hypothesis 1", "support": 0.25, **facts, "contradicted": False},
        {"verdict": "runner-up", "choice": "hypothesis 0", "support": 0.75, **facts, "contradicted": True},
    ]
    (out / "clearest.json").write_text(json.dumps({**clearest, "candidates": topologies}))
    page = Page(make_report(out).html)
    rows = page.table("hypotheses", "choice", "entry withdrawn").records()
    assert [(r["choice"], r["verdict"], r["contradicted"]) for r in rows] == [
        ("hypothesis 1", "chosen", "no"),
        ("hypothesis 0", "runner-up", "yes"),
    ]
    assert "hypothesis 0 is contradicted" in page.sections["hypotheses"]
    best = {"choice": "support ≥ 0.9", "matches": 3, "entropy": 11.5, "known_volume": 80.0, "objective": 5.5}
    candidates = [best, {**best, "choice": "no match", "entropy": 13.5}]
    (out / "clearest.json").write_text(json.dumps({**clearest, "candidates": candidates}))
    page = Page(make_report(out).html)
    choices = page.table("hypotheses", "matches", "entropy [nat m³]").records()
    assert [r["entropy [nat m³]"] for r in choices] == ["11.5", "13.5"]
    assert "support" not in choices[0]


def test_nees_of_the_ends_is_that_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is drawn from the folder is what the solution itself gives."""
    from graphslam.app.report import figures as report_figures
    from graphslam.evaluate.consistency import Consistency, pose_error

    drawn: list[Consistency] = []

    def keep(**values: Any) -> Consistency:
        drawn.append(Consistency(**values))
        return drawn[-1]

    monkeypatch.setattr(report_figures, "Consistency", keep)
    log, front = ring(3)
    monkeypatch.setattr(run_options, "make_front_end", lambda *_: front)
    monkeypatch.setattr(run_options, "recommended_options", lambda *_: {})
    r = pipeline.run(log, frontend="ring", out=tmp_path / "run", progress=False, solver="batch")
    assert r.solution is not None
    assert r.truth is not None
    error = pose_error(r.solution.poses[r.solution.exit_nodes], r.truth.exit_poses)
    wanted = [
        e @ np.linalg.solve(r.solution.covariance(f"x{n}"), e) for e, n in zip(error, r.solution.exit_nodes.tolist())
    ]
    np.testing.assert_allclose(drawn[0].nees[0], wanted, rtol=1e-6)
    assert drawn[0].dof[0, 0] == 6


def test_ties_between_sessions_and_the_base_they_give(tmp_path: Path) -> None:
    """A merged folder by hand: two paths side by side, two ties of which one is a factor."""
    from graphslam.app.run.files import MERGED_DENSE_FORMAT
    from graphslam.core.atomic import write_npz
    from graphslam.core.trajectory import Trajectory
    from graphslam.io.tum import write_tum

    path = np.column_stack([np.arange(5.0), np.zeros((5, 2))])
    for name, y in (("a", 0.0), ("b", 1.0)):
        write_tum(tmp_path / f"trajectory_{name}.tum", Trajectory(np.arange(5.0), path + [0.0, y, 0.0]))
    nodes = np.concatenate([path[[0, 2, 4]], path[[0, 2, 4]] + [0.0, 1.0, 0.0]])
    of_submaps = {"session_of_submap": np.array([0, 1]), "keys": np.array([0, 1])}
    bases = {"bases": nodes, "base_covariances": np.zeros((6, 3, 3))}
    whole = {"format": MERGED_DENSE_FORMAT, "sessions": np.array(["a", "b"]), **of_submaps, **bases}
    write_npz(tmp_path / "merged.npz", {**whole, "nodes": nodes})
    row = {"submap_map": 0, "submap_here": 1, "i": 1, "j": 1, "source": "appearance", "score": 0.7, "gates": {"a": 0.5}}
    candidates = [{**row, "accepted": True, "why": "agrees"}, {**row, "accepted": False, "why": "<b>no</b>"}]
    sessions = [{"name": "a", "submaps": 1}, {"name": "b", "submaps": 1, "links": 1, "candidates": candidates}]
    report = {"format": "graphslam.merge/1", "by": "auto", "solver": "batch", "sessions": sessions}
    (tmp_path / "merge.json").write_text(json.dumps(report))
    metrics = {"converged": 1.0, "objective": 2.0, "b_base_nees": 60.0, "b_base_nees_dof": 3.0}
    rows = [{"key": k, "value": v, "unit": "", "direction": "none"} for k, v in metrics.items()]
    (tmp_path / "metrics.json").write_text(json.dumps(rows))
    (tmp_path / "timings.json").write_text(json.dumps([{"key": "seconds_merge", "value": 1.5, "unit": "s"}]))
    add_events(tmp_path, [{"event": "between", "factor_id": 3, "i": 1, "j": 4, "group": "session"}])
    page = Page(make_report(tmp_path).html)
    page.check_alone()
    assert len(page.sources) == 1
    assert "loop closures between them" in page.sections["figures"]
    listed = page.table("loops", "submap in the map").records()
    assert [(r["verdict"], r["why"], r["gates"]) for r in listed] == [
        ("accepted", "agrees", "a 0.5"),
        ("rejected", "<b>no</b>", "a 0.5"),
    ]
    assert [k for k, t in page.verdict if "base of b in the common frame" in t and "overconfident" in t] == ["bad"]
    assert "1.5" in page.sections["times"]
    add_events(tmp_path, [{"event": "between", "factor_id": 4, "i": 1, "j": 9, "group": "session"}])
    assert "cannot be drawn" in Page(make_report(tmp_path).html).sections["figures"]
