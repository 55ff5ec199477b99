"""Runs merged by common landmarks: one optimum over all, by names or by constellation, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam
from graphslam.app.cli import app
from graphslam.core.atomic import read_npz
from graphslam.core.errors import ConfigError, DataError, RunFolderError
from graphslam.core.geometry import se2_between
from graphslam.io.tum import read_tum
from tests.pictures import full_pictures
from tests.reference.surveyed import surveyed


@pytest.fixture(scope="module")
def log():
    return graphslam.simulate("landmark-field", preset="quick", seed=3)


@pytest.fixture(scope="module")
def runs(log, tmp_path_factory):
    """The two halves of a drive, as if two robots had made them."""
    a, b = log.interval
    middle = 0.5 * (a + b)
    root = tmp_path_factory.mktemp("runs")
    parts = (log.slice(a, middle), log.slice(middle, b))
    return [graphslam.run(p, out=root / f"run{k}", progress=False) for k, p in enumerate(parts)]


@pytest.fixture(scope="module")
def merged(runs):
    return graphslam.merge(runs)


def test_one_map_of_all_landmarks(runs, merged, log):
    assert merged.report["by"] == "identity"
    assert [s.name for s in merged.sessions] == ["landmark-field", "landmark-field-2"]
    ids = [set(r.map.landmark_ids.tolist()) for r in runs]
    assert set(merged.landmark_ids.tolist()) == ids[0] | ids[1]
    shared = {int(i) for i, n in zip(merged.landmark_ids, merged.landmark_sessions) if n == 2}
    assert shared == ids[0] & ids[1]
    assert len(shared) >= 2
    assert merged.metric("converged") == 1
    assert merged.metric("submaps") == sum(len(r.submaps) for r in runs)


def test_the_second_base_is_found_with_an_consistent_covariance(runs, merged, log):
    bases = log.truth.trajectory.interpolate([r.submaps[0].interval[0] for r in runs])
    true = se2_between(bases[0], bases[1])
    m = merged.sessions[1].map
    error = se2_between(m.node_poses[0], true)
    assert np.linalg.norm(error[:2]) < 1.0
    assert error @ np.linalg.solve(m.node_covariances[0], error) < 21.1  # χ²_3 at 99.99 %
    assert merged.metric("landmark_rmse_aligned") < 0.5
    assert 0.3 < merged.metric("nees_aligned_landmarks_per_dof") < 2.5
    assert merged.metric("landmark-field-2_path_rmse") < 0.5
    np.testing.assert_allclose(m.trajectory.poses[0], m.node_poses[0], atol=1e-9)


def test_the_constellation_gives_the_same_map(runs, merged):
    by_pattern = graphslam.merge(runs, by="constellation", tolerance=1.0)
    assert len(by_pattern.landmarks) == len(merged.landmarks)
    np.testing.assert_allclose(by_pattern.solution.objective, merged.solution.objective, rtol=1e-6)


def test_isam2_finds_the_same_optimum(runs, merged):
    other = graphslam.merge(runs, solver="isam2")
    np.testing.assert_allclose(other.solution.objective, merged.solution.objective, rtol=1e-6)


def test_a_run_joins_by_way_of_another(runs):
    """The stranger shares landmarks with the bridge alone, and stands before it in the list."""
    first, second = runs
    known = set(first.map.landmark_ids.tolist())

    def strange(ids):
        return np.where(np.isin(ids, list(known)), ids + 5000, ids)

    stranger = _renamed(second, strange)
    assert np.sum(stranger.map.landmark_ids < 5000) >= 2  # what only the second half saw
    with pytest.raises(DataError, match="landmark-field-2: cannot be merged with landmark-field "):
        graphslam.merge([first, stranger])
    together = graphslam.merge([first, stranger, second])
    assert together.metric("converged") == 1
    assert len(together.sessions) == 3


def _renamed(run, new):
    submaps = [s.with_ids(new(s.landmarks.ids)) for s in run.submaps]
    return replace(run, submaps=submaps, map=replace(run.map, landmark_ids=new(run.map.landmark_ids)))


def test_points_of_a_run_that_a_merge_does_not_use_are_reported(runs, merged, log, caplog):
    a, b = runs[1].map.trajectory.times[[0, -1]]
    times = np.linspace(a + 1.0, b - 1.0, 4)
    rows = surveyed(zip(times.tolist(), log.truth.trajectory.interpolate(times)[:, :2]), np.random.default_rng(2), 0.02)
    second = graphslam.run(log.slice(a, b), config={"control": rows, "check": rows[:3]}, progress=False)
    assert [s["points_not_used"] for s in merged.report["sessions"]] == [0, 0]
    with caplog.at_level("WARNING"):
        together = graphslam.merge([runs[0], second])
    assert [s["points_not_used"] for s in together.report["sessions"]] == [0, 7]
    assert "landmark-field-2: its 7 control and check rows are not used in the merged map; to do:" in caplog.text


def test_what_cannot_be_merged_is_refused(runs):
    with pytest.raises(DataError, match="share too few landmarks; got 0 common ids"):
        graphslam.merge([runs[0], _renamed(runs[1], lambda i: i + 5000)])
    with pytest.raises(ConfigError, match="at least two"):
        graphslam.merge(runs[:1])
    with pytest.raises(ConfigError, match="known: auto"):
        graphslam.merge(runs, by="looks")


def test_command_line_writes_what_can_be_read_back(runs, merged, tmp_path):
    out = tmp_path / "merged"
    arguments = ["merge", str(runs[0].folder), str(runs[1].folder), "--out", str(out), "--json"]
    with full_pictures():
        done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    value = json.loads(done.stdout)
    assert {m["key"]: m["value"] for m in value["metrics"]}["sessions"] == 2
    a = read_npz(out / "merged.npz", fmt="graphslam.merged-map/1")
    np.testing.assert_allclose(a["landmarks"], merged.landmarks, atol=1e-9)
    n = 2 * len(a["landmarks"])
    assert a["landmark_joint_covariance"].shape == (n, n)
    assert np.linalg.eigvalsh(a["landmark_joint_covariance"])[0] > 0
    path = read_tum(out / "trajectory_landmark-field-2.tum", dim=2)
    np.testing.assert_allclose(path.poses, merged.sessions[1].map.trajectory.poses, atol=1e-9)
    assert (out / "figures" / "map.png").stat().st_size > 10_000
    assert json.loads((out / "merge.json").read_text())["format"] == "graphslam.merge/1"
    with pytest.raises(RunFolderError, match="not empty"):
        graphslam.merge(runs, out=out)
