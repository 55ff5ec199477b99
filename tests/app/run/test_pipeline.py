"""The main line on a small simulated world: outputs, determinism, agreement of solvers, GPS, bad input."""

from __future__ import annotations

import html
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run.figures import save_figures
from graphslam.core.atomic import read_npz
from graphslam.core.errors import EvidenceReusedError, MissingDataError, RunFolderError, UnknownNameError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.evaluate.consistency import nees, pose_error
from graphslam.io.tum import read_tum
from tests.pictures import full_pictures

FILES = {
    *("config.toml", "run.json", "metrics.json", "events.jsonl", "ledger.csv", "landmarks.csv", "map.npz"),
    *("association.npz", "graph.g2o", "graph.npz", "nodes.tum", "trajectory.tum"),
    *("truth.npz", "truth.tum", "dead_reckoning.tum"),
    *("submaps", "figures", "gps_all.npz", "report.html", "timings.json", "inputs.npz", "inputs"),
    *("generations", "current", ".lock"),
}


@pytest.fixture(scope="module")
def log():
    return gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)


@pytest.fixture(scope="module")
def result(log, tmp_path_factory):
    return gs.run(log, seed=5, out=tmp_path_factory.mktemp("run") / "r", progress=False)


def submap_bytes(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted((folder / "submaps").iterdir())}


def test_run_folder_is_complete(result, tmp_path):
    assert {p.name for p in result.folder.iterdir()} == FILES
    assert {p.name for p in (result.folder / "figures").iterdir()} == {
        "map.png",
        "submaps.png",
        "gps_residuals.png",
        "loops.png",
    }
    with full_pictures():
        assert all(p.stat().st_size > 5_000 for p in save_figures(result, tmp_path))
    report = json.loads((result.folder / "run.json").read_text())
    assert report["seed"] == 5
    assert report["records_read"]["landmarks"] > 0
    config = tomllib.loads((result.folder / "config.toml").read_text())
    assert config["frontend"]["particles"] == 100
    rows = json.loads((result.folder / "metrics.json").read_text())
    assert {"key", "value", "unit", "direction"} == set(rows[0])
    timings = json.loads((result.folder / "timings.json").read_text())
    assert {"key", "value", "unit", "direction"} == set(timings[0])
    keys = {r["key"] for r in timings}
    assert {"seconds_total", "times_real_time", "resumed_submaps"} <= keys
    assert not keys & {r["key"] for r in rows}
    assert not {"seconds", "resumed_submaps"} & set(report)
    again = gs.open_run(result.folder)
    assert set(again.metrics["key"]) == set(result.metrics["key"])
    assert again.report["seconds"]["total"] == again.metric("seconds_total") > 0


def test_map_is_accurate_and_consistent_on_this_world(result):
    low, high = chi2_mean_bounds(result.metric("nees_dof"), 1, 0.999)
    assert low < result.metric("nees") < high
    assert result.metric("converged") == 1
    assert result.metric("landmark_rmse") < 0.6
    assert result.metric("association_pair_precision") == 1


def test_trajectory_has_the_full_rate_and_true_path_lies_within_its_covariance(result):
    path, truth = result.map.trajectory, result.truth_path
    assert len(path) > 200
    np.testing.assert_array_equal(path.times, truth.times)


def test_true_paths_lie_within_their_covariances_over_eight_worlds():
    """Errors along a path are about as many errors as it has submaps: between one (the bounds below, for that, would be
    twice as wide) and all of them. With a covariance of half or of twice the size the mean is at 2 or at 1/2."""
    means = []
    for seed in range(8):
        log = gs.simulate("landmark-field", preset="quick", seed=10 + seed, gps_rate=1.0, gps_sigma=0.3)
        r = gs.run(log, seed=seed, progress=False)
        path = r.map.trajectory
        d2 = nees(pose_error(path.poses[1:], r.truth_path.poses[1:]), path.covariances[1:])
        means.append(np.mean(d2) / 3)
    low, high = chi2_mean_bounds(3 * 3, len(means), 0.99)  # three independent errors a path
    assert low / 9 < np.mean(means) < high / 9, means


def test_reopened_run_is_the_run(result):
    again = gs.open_run(result.folder)
    np.testing.assert_array_equal(again.map.landmarks, result.map.landmarks)
    np.testing.assert_array_equal(again.map.trajectory.poses, result.map.trajectory.poses)
    assert [list(s.landmarks.ids) for s in again.submaps] == [list(s.landmarks.ids) for s in result.submaps]
    assert again.metric("nees") == pytest.approx(result.metric("nees"))
    assert again._repr_html_()
    np.testing.assert_array_equal(again.gps["all"].residuals, result.gps["all"].residuals)
    np.testing.assert_allclose(
        read_tum(result.folder / "trajectory.tum", dim=2).poses, result.map.trajectory.poses, atol=1e-8
    )


def test_same_seed_same_bytes_other_seed_other_submaps(log, result, tmp_path):
    gs.run(log, seed=5, out=tmp_path / "same", progress=False)
    gs.run(log, seed=6, out=tmp_path / "other", progress=False)
    assert submap_bytes(tmp_path / "same") == submap_bytes(result.folder)
    assert submap_bytes(tmp_path / "other") != submap_bytes(result.folder)
    for name in ("landmarks.csv", "trajectory.tum", "graph.g2o"):
        assert (tmp_path / "same" / name).read_bytes() == (result.folder / name).read_bytes()


def test_resume_after_any_submap_gives_the_same_run(log, result, tmp_path):
    for keep in (0, 1, len(result.submaps) - 1):
        out = tmp_path / f"cut{keep}"
        gs.run(log, seed=5, out=out, progress=False)
        index = json.loads((out / "submaps" / "index.json").read_text())
        index["submaps"], index["count"] = index["submaps"][:keep], keep
        (out / "submaps" / "index.json").write_text(json.dumps(index))
        (out / "submaps" / ".000009.npz.1-0123abcd.part").write_bytes(b"half a file")
        again = gs.run(log, seed=5, out=out, resume=True, progress=False)
        assert submap_bytes(out) == submap_bytes(result.folder)
        assert again.report["resumed_submaps"] == keep
        assert (out / "landmarks.csv").read_bytes() == (result.folder / "landmarks.csv").read_bytes()


def test_resume_refuses_another_configuration(log, result):
    with pytest.raises(RunFolderError, match=r"run\.seed was 5 and is 7"):
        gs.run(log, seed=7, out=result.folder, resume=True, progress=False)
    with pytest.raises(RunFolderError, match=r"frontend\.particles"):
        gs.run(log, seed=5, out=result.folder, resume=True, config={"frontend": {"particles": 9}}, progress=False)
    with pytest.raises(RunFolderError, match="--resume"):
        gs.run(log, seed=5, out=result.folder, progress=False)


def test_a_folder_with_something_else_is_not_touched(log, tmp_path):
    (tmp_path / "thesis.tex").write_text("dear diary")
    with pytest.raises(RunFolderError, match="not a run folder"):
        gs.run(log, out=tmp_path, progress=False)
    with pytest.raises(RunFolderError, match="not a finished run"):
        gs.open_run(tmp_path)


def test_solvers_reach_the_same_map(log, result):
    batch = gs.run(log, seed=5, solver="batch", progress=False)
    assert batch.metric("objective") == pytest.approx(result.metric("objective"), rel=1e-9)
    np.testing.assert_allclose(batch.map.landmarks, result.map.landmarks, atol=1e-5)


def test_all_methods_agree_on_a_run(result):
    table = gs.compare(result, memory=False)
    assert set(table["method"]) == {"isam2", "batch", "eif-tree", "eif-sequential", "ekf"}
    np.testing.assert_allclose(table["objective_polished"], result.metric("objective"), rtol=1e-6)
    for name in ("nees", "nees_plain"):
        np.testing.assert_allclose(table[name], result.metric(name), rtol=1e-4)
    assert result.metric("nees") != pytest.approx(result.metric("nees_plain"), rel=1e-4)
    from_disk = gs.compare(result.folder, methods=["batch"], memory=False)
    assert from_disk["nees"].iloc[0] == pytest.approx(result.metric("nees"), rel=1e-6)


def test_gps_is_spent_once_and_withheld_fixes_are_scored(log):
    r = gs.run(log, seed=5, config={"gps": {"use": "every-second"}}, progress=False)
    n = len(log["gps"].times)
    assert r.metric("gps_dof") > 0
    assert r.metric("gps_withheld_fixes") <= n // 2
    # honest fixes of 0.3 m: the withheld ones lie within what the map and the fixes allow, not far below either
    assert 0.25 < r.metric("gps_withheld_rmse") < 0.9
    T_true = r.map.T_gps_world  # the simulator's GPS frame is the first base's
    assert abs(T_true[2]) < 0.05
    with pytest.raises(EvidenceReusedError):
        r.graph.add_sensor(log["gps"].take(slice(0, 1)))


def test_unknown_association_finds_the_true_one(log):
    options = {"frontend": {"association": "likelihood", "min_hits": 3}, "backend": {"associate": True}}
    r = gs.run(log, seed=5, config=options, progress=False)
    # features are scattered at random here, some pairs closer than the sensor can tell apart
    assert r.metric("association_pair_precision") > 0.95
    assert r.metric("association_pair_recall") > 0.9
    assert r.report["identities"] == "run"
    table = gs.compare(r, methods=["batch"], memory=False)
    assert table["nees_dof"].iloc[0] == 3 * len(r.submaps)  # landmarks have names of their own


def test_paper_mode_and_fastslam_1_run(log):
    r = gs.run(log, config={"frontend": {"handover": "moments", "proposal": "1.0", "particles": 40}}, progress=False)
    assert {s.report["handover"] for s in r.submaps} == {"moments"}
    assert all(s.report["moment_kl"] > 0 for s in r.submaps)


def test_every_submap_says_why_it_ended(result):
    reasons = [s.report["ended"] for s in result.submaps]
    assert reasons[-1] == "end-of-log"
    assert set(reasons[:-1]) <= {"features", "distance", "no-features", "diversity", "scans"}
    assert all(s.uses == {"controls", "landmarks"} for s in result.submaps)


def test_missing_streams_and_names_are_refused(log):
    with pytest.raises(MissingDataError, match="odometry or velocities in addition to the landmark observations"):
        gs.run(replace(log, streams={"landmarks": log["landmarks"]}), progress=False)
    with pytest.raises(MissingDataError, match=r"no front end .* got controls .* wanted laser scans with odometry"):
        gs.run(replace(log, streams={"controls": log["controls"]}), progress=False)
    with pytest.raises(MissingDataError, match="SteeringControls"):
        gs.run(replace(log, streams={"landmarks": log["landmarks"]}), frontend="rbpf-ekf", progress=False)
    with pytest.raises(UnknownNameError, match="isam2"):
        gs.run(log, solver="oracle", progress=False)
    with pytest.raises(UnknownNameError):
        gs.load("no-such-card")


def test_scans_before_the_first_control_are_counted(log):
    cut = replace(log, streams={**log.streams, "controls": log["controls"].take(slice(400, None))})  # 10 s later
    r = gs.run(cut, progress=False)
    early = int(np.sum(log["landmarks"].times < cut["controls"].times[0] - 0.5))
    assert r.report["records_dropped"]["landmarks: before the first control"] == early > 0


def test_association_file_names_every_landmark(result):
    a = read_npz(result.folder / "association.npz", fmt="graphslam.association/1")
    assert len(a["ids"]) == sum(len(s.landmarks) for s in result.submaps)
    assert set(a["ids"]) == set(result.map.landmark_ids)


def test_a_run_shows_its_verdict_first_and_a_picture(result) -> None:
    shown = result._repr_html_()
    assert shown.index(html.escape(result.headline.text, quote=True)[:40]) < shown.index("data:image/png;base64,")
    assert "<details>" in shown
    lines = str(result.verdict).splitlines()
    assert len(lines) == len(result.verdict)
    assert lines[0].endswith(result.verdict[0].text)
