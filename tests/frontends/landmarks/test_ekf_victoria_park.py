"""One EKF over the recorded park: close to the floor of the GPS, and far from dead reckoning."""

from __future__ import annotations

import json

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.run.pipeline import load, run
from graphslam.core.random import SeedTree


@pytest.mark.data
def test_whole_log_against_gps(data_dir, tmp_path):
    run("victoria-park", frontend="ekf-slam", out=tmp_path / "run", config={"frontend": {"association": "nearest"}})
    metrics = {m["key"]: m["value"] for m in json.loads((tmp_path / "run" / "metrics.json").read_text())}
    assert metrics["gps_fixes"] == 947
    assert metrics["gps_dead_reckoning_rmse"] > 30
    # the GPS itself is good to 1.1-1.3 m; half a landmark's spacing would be 2 m and more
    assert 0.8 < metrics["gps_rmse"] < 1.6
    assert 0.5 < metrics["gps_median"] < 1.0
    assert 250 < metrics["landmarks_confirmed"] < 450


@pytest.mark.data
def test_joint_compatibility_and_nearest_neighbour_agree_on_separate_trees(data_dir):
    log = load("victoria-park")
    log = log.slice(log.interval[0], log.interval[0] + 120.0)
    maps = []
    for association in ("nearest", "jcbb"):
        options = {**recommended_options(log, "ekf-slam")["frontend"], "association": association}
        maps.append(next(make_front_end("ekf-slam", options).submaps(log, seed=SeedTree(0))))
    nearest, joint = maps
    assert len(nearest.landmarks) > 40
    assert abs(len(nearest.landmarks) - len(joint.landmarks)) <= 2
    sigma = np.sqrt(np.diag(nearest.exit_covariance))
    assert np.all(np.abs(nearest.exit_pose - joint.exit_pose) < 4 * sigma)
    assert joint.report["jcbb_capped_scans"] == 0
