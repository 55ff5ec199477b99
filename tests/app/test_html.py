"""Names from files are text in every HTML that a notebook or a page shows: none of them becomes markup.

Every class of the package with ``_repr_html_`` is found by walking it; one that has no maker here fails the test.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

import graphslam
import graphslam_studies
from graphslam.app.report.report import Report
from graphslam.app.run.residual_consistency import ResidualConsistency
from graphslam.app.run.run import Run
from graphslam.app.sessions.merged_map import MergedMap
from graphslam.core.findings import Finding, Findings
from graphslam.core.log import SensorLog, Truth
from graphslam.core.records import VelocityControls
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.consistency import Consistency
from graphslam.evaluate.figure_table import FigureTable
from graphslam.evaluate.metrics import COLUMNS
from graphslam.evaluate.residual_consistency import ClassConsistency
from graphslam.evidence.grid import EvidenceGrid
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.ledger import Ledger
from graphslam.graph.score import ClassScore, GraphScore
from graphslam.io.cards import list_cards
from graphslam.join.graph_join import solve_graph_batch
from graphslam.join.submap_solver import SubmapEstimate
from graphslam.maps.global_map import GlobalMap
from graphslam.solve.batch import BatchSolver
from graphslam_studies.montecarlo.folder import StudyFolder
from graphslam_studies.montecarlo.study import Study
from tests.reference.pose_ramp import pose_ramp

EVIL = "\"'><script>alert(1)</script><img src=x onerror=alert(2)>&"
NOTHING = np.zeros(0, dtype=np.int64)


def classes() -> dict[str, type]:
    """Every class of the package that says how it looks in a notebook."""
    found = {}
    for package in (graphslam, graphslam_studies):
        for m in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if m.name.endswith("__main__"):
                continue
            for c in vars(importlib.import_module(m.name)).values():
                if isinstance(c, type) and c.__module__ == m.name and "_repr_html_" in vars(c):
                    found[f"{m.name}.{c.__qualname__}"] = c
    return found


def evil(value: Any, depth: int = 0) -> Any:
    """The value with every text in it, names of mappings too, made into markup that must not be taken as such."""
    if isinstance(value, str):
        return EVIL
    if isinstance(value, dict):
        return {k if k in COLUMNS else evil(k, depth): evil(v, depth) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(evil(v, depth) for v in value)
    if isinstance(value, pd.DataFrame):
        texts = [c for c in value if not pd.api.types.is_numeric_dtype(value[c])]
        return type(value)(value.assign(**dict.fromkeys(texts, EVIL)))
    if isinstance(value, Study):
        return value  # made with evil names: its table and its definition must agree on them
    if dataclasses.is_dataclass(value) and not isinstance(value, type) and depth < 6:
        for f in dataclasses.fields(value):
            object.__setattr__(value, f.name, evil(getattr(value, f.name), depth + 1))
    return value


def metrics() -> list[dict[str, Any]]:
    return [{"key": "k", "value": 1.0, "unit": "m", "direction": "none"}]


def graph() -> FactorGraph:
    g = FactorGraph()
    g.add_submap(submap())
    return g


def submap() -> Submap:
    report: dict[str, Any] = {"note": "text", "list": ["text", 1.0], "map": {"key": "text"}}
    return Submap(
        key=0, interval=(0.0, 1.0), exit_pose=np.array([1.0, 0, 0]), exit_covariance=0.01 * np.eye(3), report=report
    )


def a_log(_: Path) -> SensorLog:
    t = np.arange(3.0)
    controls = VelocityControls(times=t, speed=t, yaw_rate=t)
    return SensorLog(name="log", streams={"wheel": controls}, dropped={"wheel: bad": 1}, meta={"a": "b"})


def a_run(tmp_path: Path) -> Run:
    path = Trajectory(np.arange(2.0), np.zeros((2, 3)), np.zeros((2, 3, 3)))
    m = GlobalMap(
        path, path.times, path.poses, path.covariances, NOTHING, np.zeros((0, 2)), np.zeros((0, 2, 2)), NOTHING
    )  # type: ignore[arg-type]
    return Run(
        name="run", submaps=[], map=m, metric_rows=metrics(), report={}, folder=tmp_path / EVIL.replace("/", "|")
    )


def a_study(tmp_path: Path) -> Study:
    definition = SimpleNamespace(
        name=EVIL,
        description=EVIL,
        worlds=lambda quick: (EVIL,),
        report=lambda table, timings: {EVIL: pd.DataFrame({EVIL: [EVIL, 1.0]})},
    )
    table = pd.DataFrame(
        [(EVIL, 0, "a", 0, "q", 1.0)], columns=["world", "run", "algorithm", "submap", "quantity", "value"]
    )
    failures = pd.DataFrame(columns=["world", "run", "seed", "error"])
    return Study(definition, StudyFolder(tmp_path), {"quick": False}, table, table, failures)  # type: ignore[arg-type]


def a_ledger(_: Path) -> Ledger:
    ledger = Ledger()
    ledger.spend(0, EVIL, [EVIL], (0.0, 1.0))
    return ledger


def a_solution(_: Path) -> Any:
    solver = BatchSolver(graph())
    solver.update()
    found = solver.solution()
    object.__setattr__(found, "solver", EVIL)
    object.__setattr__(found, "score", GraphScore({EVIL: ClassScore(1.0, 1, 1, 1)}))
    return found


def a_merge(_: Path) -> MergedMap:
    nothing: Any = None
    return MergedMap(
        sessions=[],
        landmark_ids=NOTHING,
        landmarks=np.zeros((0, 2)),
        landmark_covariances=np.zeros((0, 2, 2)),
        landmark_sessions=NOTHING,
        solution=nothing,
        graph=nothing,
        metric_rows=metrics(),
    )


def a_graph(_: Path) -> FactorGraph:
    return graph()  # the names of its classes of factors are those of the code


CLASS: dict[str, Any] = {
    "name": "c",
    "factors": 2,
    "rows": 4,
    "leverage": 1.0,
    "dof": 3.0,
    "chi2": 3.0,
    "mean_weight": 1.0,
    "least_weight": 1.0,
}
MAKERS: dict[str, Callable[[Path], Any]] = {
    "graphslam.evaluate.figure_table.FigureTable": lambda _: FigureTable(metrics()),
    "graphslam.core.log.SensorLog": a_log,
    "graphslam.core.findings.Findings": lambda _: Findings([Finding("look", "code", EVIL)]),
    "graphslam.core.submap.Submap": lambda _: submap(),
    "graphslam.io.cards.Card": lambda _: copy.deepcopy(list_cards()[0]),
    "graphslam.evaluate.consistency.Consistency": lambda _: Consistency(
        quantity="x", nees=[[1.0]], dof=1, gauge="g", unit="value"
    ),
    "graphslam.graph.ledger.Ledger": a_ledger,
    "graphslam.graph.score.GraphScore": lambda _: GraphScore({"class": ClassScore(1.0, 1, 1, 1)}),
    "graphslam.graph.factor_graph.FactorGraph": a_graph,
    "graphslam.core.trajectory.Trajectory": lambda path: a_run(path).trajectory,
    "graphslam.maps.global_map.GlobalMap": lambda path: a_run(path).map,
    "graphslam.join.submap_solver.SubmapEstimate": lambda _: SubmapEstimate(
        np.zeros((1, 3)), NOTHING, np.zeros((0, 2)), None, 0.0, None, 1, True, 0.0, np.zeros((0, 0))
    ),
    "graphslam.join.graph_join.GraphEstimate": lambda _: solve_graph_batch(pose_ramp(1, submaps=2)[0]),
    "graphslam.solve.solution.Solution": a_solution,
    "graphslam.evidence.grid.EvidenceGrid": lambda _: EvidenceGrid(0.1),
    "graphslam.app.run.residual_consistency.ResidualConsistency": lambda _: ResidualConsistency(
        {"c": ClassConsistency(**CLASS)}, None, None
    ),
    "graphslam_studies.montecarlo.study.Study": a_study,
    "graphslam.app.sessions.merged_map.MergedMap": a_merge,
    "graphslam.app.run.run.Run": a_run,
    "graphslam.app.report.report.Report": lambda _: Report(f"<html><body>{EVIL}</body></html>", "run", {}),
}
# texts of these stand in the code, not in a file: their HTML has no place for a foreign one
OWN_WORDS = {
    "graphslam.core.trajectory.Trajectory",
    "graphslam.maps.global_map.GlobalMap",
    "graphslam.graph.factor_graph.FactorGraph",
    "graphslam.join.submap_solver.SubmapEstimate",
    "graphslam.join.graph_join.GraphEstimate",
    "graphslam.evidence.grid.EvidenceGrid",
}
FOUND = classes()


def test_every_class_that_shows_itself_is_tested() -> None:
    assert FOUND.keys() - MAKERS.keys() == set()


@pytest.mark.parametrize("name", FOUND)
def test_names_are_text_and_never_markup(name: str, tmp_path: Path) -> None:
    shown = evil(MAKERS[name](tmp_path))._repr_html_()
    assert "<script" not in shown
    assert "<img" not in shown.replace('<img src="data:image/png;base64,', "")  # our own pictures
    if name not in OWN_WORDS:
        assert "&lt;script&gt;alert(1)" in shown  # it is there, as text


def test_results_show_a_verdict_then_a_picture_then_figures() -> None:
    import graphslam as gs

    log = gs.simulate("landmark-field", preset="quick", seed=1)
    run = gs.run(log, frontend="ekf", config={"calibrate": {"use": "none"}}, progress=False)
    assert run.graph is not None
    for thing in (run, run.submaps[0], run.graph, run.trajectory, run.map, log):
        shown = thing._repr_html_()
        first = shown.index(type(thing).__name__ if thing is not run else run.headline.text[:20])
        picture = shown.index("<svg" if thing is not run else "<img")
        assert first < picture, type(thing)
        if thing is not run.trajectory:
            assert picture < shown.index("<table"), type(thing)
        assert len(shown) < 200_000
    assert str(run.verdict).count("\n") == len(run.verdict) - 1
    assert run.trajectory.to_numpy().shape == (len(run.to_pandas()), 4)
    # links of the graph: as many as factors that close loops
    run.graph.add_between(0, 3, run.map.base_poses[3], np.eye(3), evidence="prior")
    assert run.graph._repr_html_().count("<polyline") == 3  # path, loop, scale


def test_a_sketch_is_to_scale_and_says_nothing_of_nothing() -> None:
    from graphslam.core.sketch import coverage_bar, plan_sketch

    assert plan_sketch([np.zeros((0, 2))]) is None
    assert plan_sketch([np.ones((3, 2))]) is None
    assert plan_sketch([np.full((2, 2), np.nan)]) is None
    shown = plan_sketch([np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 20.0]])])
    lines = [
        np.array([p.split(",") for p in part.split('"')[0].split()], dtype=float)
        for part in str(shown).split('points="')[1:]
    ]
    scale_bar, path = sorted(lines, key=len)
    metres = float(str(shown).partition("<text")[2].partition(">")[2].split(" m")[0])
    per_metre = (scale_bar[1, 0] - scale_bar[0, 0]) / metres
    np.testing.assert_allclose(np.diff(path, axis=0) / per_metre, [[40.0, 0.0], [0.0, -20.0]], atol=0.05)
    bar = coverage_bar(np.concatenate([np.linspace(0, 10, 200), np.linspace(50, 60, 200)]), 0.0, 100.0)
    assert bar.count("<rect") == 3  # the ground, and two intervals with records


def test_an_empty_log_shows_itself() -> None:
    assert (
        "empty"
        in SensorLog(name="nothing", streams={}, truth=Truth(Trajectory(NOTHING, np.zeros((0, 3)))))._repr_html_()
    )
