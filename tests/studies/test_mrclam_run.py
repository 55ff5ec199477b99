"""A robot of MRCLAM 7 with its preset: near the truth, and consistent about how near."""

from __future__ import annotations

import pytest

import graphslam


@pytest.mark.data
def test_robot_2_with_known_association(data_dir):
    r = graphslam.run("mrclam-dataset7/robot2", progress=False)
    assert len(r.map.landmarks) == 15
    assert r.metric("association_pair_precision") == 1.0
    assert 0.005 < r.metric("landmark_rmse_aligned") <= 0.10
    assert 0.02 < r.metric("path_rmse_aligned") <= 0.15
    assert 0.7 < r.metric("join_chi2_per_dof") < 1.4
    assert 0.3 < r.metric("nees_aligned_landmarks_per_dof") < 3.0
    assert r.metric("converged") == 1
