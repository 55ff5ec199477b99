"""A run of which two maps are true alike keeps both: in its folder, its verdict and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from graphslam.app.report.folder import read_folder
from graphslam.app.report.scene import report_scene
from graphslam.app.run.outputs import SAME_BYTES, TWO_MAPS, read_run_folder
from graphslam.app.run.pipeline import run
from graphslam.app.run.run import Run
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.loops import loops as decisions
from graphslam.loops.candidates import LoopCandidate
from graphslam.loops.conflicting_groups import AMBIGUOUS
from graphslam.loops.measure import Loop, LoopMeasurer
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
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


def shifted(loops: Sequence[Loop]) -> list[Loop]:
    """Every loop that is measured, and one of the next place that is 1 m off."""
    out = list(loops)
    for x in loops:
        if not x.why:
            g = group_of(x.T_ij)
            off = np.zeros(g.dof)
            off[3] = 1.0
            T = g.compose(x.T_ij, g.exp(off))
            out.append(replace(x, T_ij=T, gates={}, source="proximity"))
    return out


def disputed(log: SensorLog, folder: Path) -> Run:
    """A run with such loops, of which nothing tells which are right."""
    with pytest.MonkeyPatch.context() as patch:
        measure = LoopMeasurer.measure_in_slices

        def measured(self: LoopMeasurer, candidates: Sequence[LoopCandidate], **k: Any) -> Any:
            return shifted((yield from measure(self, candidates, **k)))

        patch.setattr(LoopMeasurer, "measure_in_slices", measured)
        patch.setattr(decisions, "choose_group", lambda *_: ("ambiguous", f"{AMBIGUOUS}, two groups: by the test"))
        return run(log, frontend="segslam", seed=2, out=folder, config=OPTIONS, progress=False)


@pytest.fixture(scope="module")
def finished(log: SensorLog, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return disputed(log, tmp_path_factory.mktemp("two") / "run")


def test_both_maps_are_in_the_folder_with_their_loops(finished: Run) -> None:
    folder = finished.folder
    assert folder is not None
    facts = finished.report["two_maps"]
    first, second = facts["loops"]
    assert first
    assert second
    assert not set(first) & set(second)
    opened = read_run_folder(folder)
    assert opened.two_maps is not None
    assert finished.two_maps is not None
    for name, path, stored, own, other in zip(
        TWO_MAPS, finished.two_maps, opened.two_maps, facts["loops"], facts["loops"][::-1]
    ):
        np.testing.assert_allclose(stored.poses, path.poses, atol=1e-6)
        loops = pd.read_csv(folder / f"{name}.csv").set_index("loop")
        assert (loops.loc[own, "verdict"] == "accepted").all()
        assert (loops.loc[other, "verdict"] != "accepted").all()
    assert facts["apart_max"] >= facts["apart_median"] >= 0.0
    assert 0.3 < facts["apart_max"] < 3.0
    assert opened.report["two_maps"] == facts


def test_the_verdict_says_so_in_one_line_and_the_report_shows_both(finished: Run) -> None:
    (line,) = [f for f in finished.verdict if "two-maps" in f.code]
    assert line.level == "bad"
    assert line.text.startswith("ambiguous loop closures: two maps")
    assert f"{finished.report['two_maps']['apart_max']:.2f} m (at" in line.text
    assert "To do: check which of the two is right" in line.text
    assert finished.headline.level == "bad"
    assert finished.folder is not None
    drawn = report_scene(read_folder(finished.folder, finished.folder))
    assert drawn is not None
    layers = {x["name"]: x for x in drawn["layers"]}
    a, b = layers["two maps, the first"], layers["two maps, the second"]
    assert a["xyz"] != b["xyz"]
    assert "ambiguous loop closures: two maps" in (finished.folder / "report.html").read_text()


def test_the_same_seed_gives_the_same_bytes(log: SensorLog, finished: Run, tmp_path: Path) -> None:
    disputed(log, tmp_path / "run")
    assert finished.folder is not None
    a, b = snapshot(finished.folder, SAME_BYTES), snapshot(tmp_path / "run", SAME_BYTES)
    assert {f"{n}.{e}" for n in TWO_MAPS for e in ("tum", "csv")} <= set(a)
    assert [n for n in {*a, *b} if a.get(n) != b.get(n)] == []


def test_where_all_is_decided_there_is_one_map(log: SensorLog, tmp_path: Path) -> None:
    plain = run(log, frontend="segslam", seed=2, out=tmp_path / "run", config=OPTIONS, progress=False)
    assert plain.two_maps is None
    assert "two_maps" not in plain.report
    assert not [f for f in plain.verdict if f.code == "two-maps"]
    assert not (tmp_path / "run" / "two_maps").exists()
