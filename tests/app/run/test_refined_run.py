"""A run of a front end with scans ends with a path refined by them: files, figures, verdict, and the verbs after it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam
from graphslam.app.cli import app
from graphslam.app.export import export
from graphslam.app.folders.generations import current_outputs
from graphslam.app.hypotheses import minimum_entropy_loops, write_minimum_entropy
from graphslam.app.report.report import make_report
from graphslam.app.run import figures, outputs, stages, submap_slam
from graphslam.app.run.outputs import SAME_BYTES, read_run_folder, refined_submaps_of
from graphslam.app.run.pipeline import run
from graphslam.app.run.remake_map import map_of_folder
from graphslam.app.run.reopened import rerun_without_loops
from graphslam.app.run.run import Run
from graphslam.app.sessions.localise import localise
from graphslam.backend.back_end import BackEnd
from graphslam.core import se3
from graphslam.core.errors import FormatError, GraphSlamError
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3, remove_roll_pitch
from graphslam.core.records import Gps
from graphslam.graph.ledger import EXCLUSIVE
from graphslam.io.tum import read_tum
from graphslam.maps import run_map
from graphslam.maps.contradictions import Contradictions
from graphslam.maps.refined import base_frames, refined_map
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from tests.faults.kills import snapshot
from tests.reference.small_maps import same_map

OPTIONS: dict[str, Any] = {"frontend": {"filter": {"particles": 1}}}


def drive(seed: int) -> SensorLog:
    """Twice round a corner of one court, by a robot of its own."""
    return simulate_crawler(ring_hall(seed=9), seed, CrawlerConfig(drift=0.08, max_range=8.0))


def made(log: SensorLog, out: Path, *, seed: int = 2, resume: bool = False, **options: Any) -> Run:
    return run(log, frontend="segslam", seed=seed, out=out, config=OPTIONS | options, resume=resume, progress=False)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return made(drive(9), tmp_path_factory.mktemp("refined") / "run")


@pytest.fixture
def copy(finished: Run, tmp_path: Path) -> Path:
    return Path(shutil.copytree(str(finished.folder), tmp_path / "copy", symlinks=True))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures take as long as the rest."""
    monkeypatch.setattr(figures, "save_figures", lambda *_: [])
    monkeypatch.setattr(outputs, "draw_run_map", lambda *_, **__: [])


def differing(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    return [n for n in sorted({*before, *after}) if before.get(n) != after.get(n)]


def test_nodes_stand_beside_the_body_as_exits_do(finished: Run) -> None:
    """A submap that was entered by a match may begin with a body that leans otherwise than the exit before it."""
    m = finished.map
    C = np.tile(1e-6 * np.eye(6), (len(m.trajectory), 1, 1))
    path = SimpleNamespace(times=m.trajectory.times, poses=m.trajectory.poses, covariances=C, fixes=None)
    lean = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
    submaps = []
    for k, s in enumerate(finished.submaps):
        poses = s.trajectory.poses.copy()
        if k:
            poses[0] = SE3.compose(poses[0], SE3.exp(lean))
        submaps.append(replace(s, trajectory=replace(s.trajectory, poses=poses)))
    nodes = refined_map(m, path, submaps).base_poses
    for k, s in enumerate(finished.submaps):
        body = m.trajectory.interpolate(np.array([s.interval[1]]))[0]
        wanted = SE3.compose(body, SE3.between(s.trajectory.poses[-1], s.exit_pose))
        np.testing.assert_allclose(SE3.log(SE3.between(wanted, nodes[k + 1])), 0.0, atol=1e-6)


def test_the_path_is_refined_and_the_folder_has_both(finished: Run) -> None:
    assert finished.metric("path_rmse_aligned") < 0.03
    assert finished.metric("path_rmse_aligned") < 0.3 * finished.metric("path_rmse_aligned_graph")
    assert finished.metric("refine_agreement") > finished.metric("refine_agreement_graph") + 0.1
    assert finished.folder is not None
    for name in ("refined/index.json", "scans.npz", "trajectory_graph.tum", "figures/refined.png"):
        assert (finished.folder / name).is_file(), name
    again_read = read_run_folder(finished.folder)
    assert again_read.graph_path is not None
    assert finished.refined is not None
    np.testing.assert_allclose(again_read.graph_path.poses, finished.refined.graph_path.poses, atol=1e-6)
    np.testing.assert_array_equal(again_read.map.trajectory.poses, finished.refined.refinement.poses)
    assert {"refined", "refine-evidence"} <= {f.code for f in again_read.verdict}
    assert again_read.report["refine"]["rounds"][-1]["pairs"] == finished.metric("refine_pairs")
    page = make_report(finished.folder)
    assert "refine" not in " ".join(page.problems)
    for text in ("Refinement by scans", "wheel scale", "Yaw rate bias at its knots", "scan-pairs", ">odometry<"):
        assert text in page.html, text


def test_fixes_hold_the_refined_path_and_its_frame_scores_those_kept_back(undrawn: None) -> None:
    log = drive(9)
    assert log.truth is not None
    path = log.truth.trajectory
    turn = np.array([30.0, -20.0, 5.0, 0.0, 0.0, np.sin(0.4), np.cos(0.4)])  # T_gps_truth
    rng = np.random.default_rng(3)
    times, true = path.times[:: max(1, len(path) // 80)], path.poses[:: max(1, len(path) // 80)]
    z = se3.se3_transform(turn, true[:, :3]) + 0.05 * rng.standard_normal((len(true), 3))
    gps = Gps(times=times, positions=z, sigma=np.full(len(z), 0.05), lever=np.zeros(3))
    log = replace(log, streams={**log.streams, "gps": gps})
    options = OPTIONS | {"gps": {"use": "every-second", "baseline": 5.0}, "map": {"fuse": False}}
    r = run(log, frontend="segslam", seed=2, config=options, progress=False)
    assert r.refined is not None
    assert r.refined.refinement.fixes is not None
    assert {f.code: f.level for f in r.verdict}["refine-fixes"] == "good"
    np.testing.assert_array_equal(r.map.T_gps_world, r.refined.refinement.fixes.T_gps_world)
    assert r.metric("gps_withheld_rmse") < 0.13  # of fixes whose own errors are 0.087 m
    assert r.metric("path_rmse_aligned") < 0.03
    assert r.ledger is not None
    spent = r.ledger[r.ledger["kind"] == EXCLUSIVE]
    assert set(spent["factor"]) == {"scan-pairs", "fixes"}
    assert set(spent[spent["factor"] == "fixes"]["stream"]) == {"gps"}
    assert "refine-streams" not in {f.code for f in r.verdict}


def test_the_ledger_says_what_the_refined_path_spends(finished: Run) -> None:
    """Every stream of the scans once, and nothing else: the graph's factors are named as its start."""
    assert finished.ledger is not None
    assert finished.graph is not None
    t = finished.ledger
    spent = t[t["kind"] == EXCLUSIVE]
    assert set(spent["factor"]) == {"scan-pairs"}
    assert set(spent["stream"]) == set(finished.submaps[0].uses)
    assert spent["stream"].is_unique
    path = finished.map.trajectory
    assert (spent["t_start"] == path.times[0]).all()
    assert (spent["t_end"] == path.times[-1]).all()
    rest = t[t["kind"] != EXCLUSIVE]
    assert set(rest["kind"]) == {"start"}
    assert set(rest["factor_id"]) == set(finished.graph.ledger.table()["factor_id"])


def test_bases_of_the_refined_submaps_stand_level_in_the_frame_of_the_truth(finished: Run) -> None:
    base = np.array(finished.report["T_world_base"])
    np.testing.assert_allclose(remove_roll_pitch(base), base, atol=1e-12)
    submaps = refined_submaps_of(finished)
    frames = base_frames(finished.map)
    for s, a, b in zip(submaps, frames, frames[1:]):
        np.testing.assert_allclose(SE3.between(a, b), s.exit_pose, atol=1e-12)
        assert s.trajectory is not None
        where = SE3.compose(np.broadcast_to(a, s.trajectory.poses.shape), s.trajectory.poses)
        np.testing.assert_allclose(where, finished.map.trajectory.interpolate(s.trajectory.times), atol=1e-6)
        assert np.linalg.eigvalsh(s.exit_covariance).min() > 0


@pytest.mark.usefixtures("undrawn")
def test_interrupted_and_made_again_it_is_the_same_to_the_last_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = drive(9).slice(0.0, 16.0)

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as m:
        m.setattr(stages, "refine_run", stopped)
        with pytest.raises(KeyboardInterrupt):
            made(log, tmp_path / "stopped")
    assert not (tmp_path / "stopped" / "run.json").exists()
    made(log, tmp_path / "stopped", resume=True)
    made(log, tmp_path / "whole")
    wanted = snapshot(tmp_path / "whole", SAME_BYTES)
    assert {"refined/index.json", "refined/000000.grid.npz", "trajectory_graph.tum", "scans.npz"} <= set(wanted)
    assert differing(wanted, snapshot(tmp_path / "stopped", SAME_BYTES)) == []
    rerun_without_loops(tmp_path / "whole", [], progress=False)
    assert differing(wanted, snapshot(tmp_path / "whole", SAME_BYTES)) == []


@pytest.mark.usefixtures("undrawn")
def test_without_it_everything_is_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a front end that gives no steps, which nothing refines; its options apart."""
    log = drive(9).slice(0.0, 16.0)
    plain = made(log, tmp_path / "off", refine={"use": False})
    assert plain.refined is None
    assert not any(k.startswith("refine") for k in plain.metrics["key"])
    with monkeypatch.context() as m:
        m.setattr(submap_slam.Scans, "of", staticmethod(lambda *_: None))
        made(log, tmp_path / "none")
    off, none = (snapshot(tmp_path / n, SAME_BYTES) for n in ("off", "none"))
    assert differing(off, none) == ["config.toml"]
    assert not [n for n in off if n.startswith("refined") or n == "scans.npz" or "graph.tum" in n]


@pytest.mark.usefixtures("undrawn")
def test_switched_off_it_leaves_nothing_of_a_refined_state(copy: Path) -> None:
    config = copy / "config.toml"
    text = config.read_text()
    at = text.index("[refine]")
    config.write_text(text[:at] + text[at:].replace("use = true", "use = false", 1))
    rerun_without_loops(copy, [], progress=False)
    assert refined_submaps_of(read_run_folder(copy)) == []
    for name in ("refined/index.json", "trajectory_graph.tum", "figures/refined.png"):
        assert not (copy / name).is_symlink(), name
    assert read_run_folder(copy).graph_path is None


def test_residuals_of_the_start_do_not_judge_the_refined_path(finished: Run) -> None:
    """Its graph has residuals that are alike from one to the next, and too small: neither says anything of the path."""
    lines = {f.code: f for f in finished.verdict}
    assert "correlated" not in lines
    assert lines["trust"].level == ""
    assert "covariances: not tested" in lines["trust"].text
    assert lines["chi2"].level == ""
    assert "does not depend on it" in lines["chi2"].text
    assert finished.checks is not None
    assert any(r.of == "map" for r in finished.checks.evidence(finished.submaps))
    assert not finished.report["evidence"]


@pytest.mark.parametrize(("contradicted", "kept"), [(1, "loops"), (90, "matches")])
def test_passes_that_deny_each_other_are_given_loops(
    copy: Path, undrawn: None, monkeypatch: pytest.MonkeyPatch, contradicted: int, kept: str
) -> None:
    def told(share: int) -> Contradictions:
        return Contradictions(np.array([[0, 2]]), np.array([1000 - 10 * share]), np.array([10 * share]))

    options = copy / "config.toml"
    options.write_text(options.read_text().replace("loops = true", 'loops = "auto"'))
    said = iter([told(40), told(contradicted)])  # one map per graph
    monkeypatch.setattr(run_map, "find_contradictions", lambda *_: next(said))
    looked: list[bool] = []
    finish = BackEnd.finish

    def watched(self: BackEnd, *undo: Any) -> Any:
        looked.append(self.config.looks)
        return finish(self, *undo)

    monkeypatch.setattr(BackEnd, "finish", watched)
    r = rerun_without_loops(copy, [], progress=False)
    assert looked == [False, True]
    assert next(said, None) is None
    attempts = r.report["map_attempts"]
    assert [a["kept"] for a in attempts] == [kept == "matches", kept == "loops"]
    assert [(a["draw"], a["loops"], a["share"]) for a in attempts] == [(0, False, 0.4), (0, True, contradicted / 100)]
    assert r.metric("map_contradicted") == (contradicted / 100 if kept == "loops" else 0.4)
    line = next(f for f in r.verdict if f.code == "passes-attempts")
    assert line.level == ("" if kept == "loops" else "look")
    assert read_run_folder(copy).verdict == r.verdict


def test_the_map_is_made_again_of_the_refined_submaps(finished: Run, copy: Path) -> None:
    read, remade = map_of_folder(copy)
    assert finished.fused is not None
    assert same_map(remade.fused.grid, finished.fused.fused.grid)
    found = minimum_entropy_loops(read, remade, progress=False)
    rows = found.choice.rows()
    assert len(rows) > 1
    own = [r for r in rows if r["choice"] == "as the run"]
    assert own[0]["entropy"] > finished.metric("map_entropy")  # the path of the graph is less accurate
    assert found.refined is not None  # the chosen one is refined, whichever it is
    assert found.refined_map is not None
    assert found.refined_map.fused.entropy() < rows[0]["entropy"]
    write_minimum_entropy(copy, found)
    kept = json.loads((copy / "clearest.json").read_text())
    assert kept["refined_entropy"] == found.refined_map.fused.entropy()
    np.testing.assert_allclose(
        read_tum(copy / "clearest.tum", dim=3).poses, found.refined.map.trajectory.poses, atol=1e-6
    )


def test_a_store_that_is_damaged_or_of_another_state_is_refused(copy: Path) -> None:
    """Of plain files, as they are copied by hand."""
    plain = Path(shutil.copytree(copy, copy.with_name("plain")))
    assert len(refined_submaps_of(read_run_folder(plain))) > 2
    store = plain / "refined"
    keep = (store / "000001.npz").read_bytes()
    for foreign in ((plain / "submaps" / "000001.npz").read_bytes(), keep[: len(keep) // 2], b""):
        (store / "000001.npz").write_bytes(foreign)
        with pytest.raises(GraphSlamError, match="refined"):
            map_of_folder(plain)
    (store / "000001.npz").write_bytes(keep)
    index = json.loads((store / "index.json").read_text())
    (store / "index.json").write_text(
        json.dumps(index | {"submaps": index["submaps"][:-1], "count": index["count"] - 1})
    )
    with pytest.raises(FormatError, match="do not belong to this run"):
        map_of_folder(plain)


@pytest.mark.usefixtures("undrawn")
def test_two_refined_sessions_are_merged_by_their_refined_submaps(finished: Run, tmp_path: Path) -> None:
    other = made(drive(11), tmp_path / "other", seed=4)
    assert finished.folder is not None
    both = graphslam.merge([finished.folder, other.folder])
    assert [s.session.refined for s in both.sessions] == [True, True]
    assert both.metric("path_rmse_aligned") < 0.03
    base = both.sessions[1]
    assert both.metric(f"{base.name}_base_nees") < 22.5  # χ² of six degrees of freedom, 99.9 %
    # no re-entry or loop of a run is a factor: its scans are spent; ties between the sessions are declared
    groups = {e["group"] for e in both.graph.events if e.get("event") == "between"}
    assert groups == {"session"}
    t = both.graph.ledger.table()
    scans = t[t["stream"].str.endswith("/scan")]
    assert set(scans["kind"]) == {"shared-scan"}
    assert [s["refined"] for s in both.report["sessions"]] == [True, True]
    found = localise(finished, refined_submaps_of(other)[:2])
    assert found.found, found.why
    true = SE3.between(np.array(finished.report["T_world_base"]), np.array(other.report["T_world_base"]))
    e = SE3.log(SE3.between(found.T_map_base, true))
    assert np.linalg.norm(e[3:]) < 0.05


def test_it_is_exported_as_it_is_seen_from_above(finished: Run, tmp_path: Path) -> None:
    file = export(finished, (48.1, 11.5), format="geojson", heading=90.0, out=tmp_path / "map.geojson")
    lines = [f["geometry"] for f in json.loads(file.read_text())["features"]]
    (path,) = [g["coordinates"] for g in lines if g["type"] == "LineString"]
    east = [111_320.0 * np.cos(np.deg2rad(48.1)) * (p[0] - 11.5) for p in path]  # x looks east
    np.testing.assert_allclose(east, finished.map.trajectory.positions[:, 0], atol=0.1)


def test_scans_are_read_again_as_they_were(finished: Run) -> None:
    assert finished.folder is not None
    assert finished.inputs is not None
    scans = finished.inputs.scans
    assert scans is not None
    read = type(scans).load(finished.folder / "scans.npz")
    for name in ("times", "offsets", "points", "origins", "returns", "tilt"):
        np.testing.assert_array_equal(getattr(read, name), getattr(scans, name))
    assert read.biases == scans.biases


@pytest.mark.parametrize(("second", "settled"), [(50, True), (0, False)])
def test_particles_are_drawn_anew_where_passes_still_deny_each_other(
    tmp_path: Path, undrawn: None, monkeypatch: pytest.MonkeyPatch, second: int, settled: bool
) -> None:
    """The better draw is the run's, also after a kill before or after the folder settled on it."""

    def told(share: int) -> Contradictions:
        return Contradictions(np.array([[0, 2]]), np.array([1000 - 10 * share]), np.array([10 * share]))

    log, folder = drive(9), tmp_path / "run"
    options: dict[str, Any] = {"refine": {"use": False}, "backend": {"loops": "auto", "draws": 2}}
    shares: list[int] = []

    def say(*values: int) -> None:
        shares[:] = values
        monkeypatch.setattr(run_map, "find_contradictions", lambda *_: told(shares.pop(0)))

    say(40, 40, second, *([60] if second else []))
    r = made(log, folder, **options)
    assert not shares
    rows = r.report["map_attempts"]
    assert [(a["draw"], a["loops"]) for a in rows] == [(0, False), (0, True), (1, False), (1, True)][: len(rows)]
    assert next(a["draw"] for a in rows if a["kept"]) == (0 if second else 1)
    assert sorted(p.name for p in folder.glob("submaps*")) == ["submaps"]
    before = snapshot(folder, SAME_BYTES)
    assert "draws.json" in before

    # killed while it was settling, or just before its state was written
    if not settled:
        (folder / "draws.json").unlink()
        if not second:
            (folder / "submaps").rename(folder / "submaps-1")
            say(0)
            assert made(log, tmp_path / "first", **options | {"backend": {"draws": 1, "loops": "auto"}}).metric(
                "submaps"
            )
            shutil.copytree(tmp_path / "first" / "submaps", folder / "submaps-beaten")
    say(*([second, *([60] if second else [])] if settled else [40, 40, second, *([60] if second else [])]))
    if settled and second:
        say(40, 40)
    again_made = made(log, folder, resume=True, **options)
    assert not shares
    assert again_made.report["map_attempts"] == rows
    assert differing(before, snapshot(folder, SAME_BYTES)) == []


def test_a_run_is_relaxed_with_its_scans_beside_its_graph(finished: Run, tmp_path: Path) -> None:
    assert finished.folder is not None
    before = snapshot(finished.folder, ["*"])
    path, picture = tmp_path / "relaxed.tum", tmp_path / "relaxed.png"
    options = ["--out", str(path), "--save-plot", str(picture), "--json"]
    done = CliRunner().invoke(app, ["relax", str(finished.folder), *options], catch_exceptions=False)
    value = json.loads(done.stdout)
    rows = {row["path"]: row for row in value["paths"]}
    assert list(rows) == ["graph", "refined", "skeleton"]
    assert rows["skeleton"]["ate"] < 0.5 * rows["graph"]["ate"]
    assert rows["skeleton"]["spread"] < 0.7 * rows["graph"]["spread"]
    assert rows["skeleton"]["seconds"] > 0
    assert value["measurements"] > 6 * value["poses"]
    assert len(read_tum(path)) == value["poses"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert snapshot(finished.folder, ["*"]) == before


def test_a_run_without_scans_is_not_relaxed(copy: Path) -> None:
    (current_outputs(copy) / "scans.npz").unlink()
    done = CliRunner().invoke(app, ["relax", str(copy)])
    assert done.exit_code != 0
    assert "no scans to relax" in str(done.exception)
