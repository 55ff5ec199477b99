"""Local maps by themselves are those that a run joins, and the particles shown are those they were made of."""

from __future__ import annotations

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run.local_maps import first_particles, local_maps
from graphslam.core.errors import ConfigError

SMALL = {"particles": 30, "stopping": {"scans": 20}}


def test_local_maps_are_those_of_a_run() -> None:
    log = gs.simulate("landmark-field", seed=4, preset="quick").slice(0.0, 15.0)
    alone = gs.local_maps(log, seed=4, options=SMALL)
    joined = gs.run(log, seed=4, solver="batch", config={"frontend": SMALL}, progress=False).submaps
    assert len(alone) == len(joined) >= 2
    for a, b in zip(alone, joined):
        np.testing.assert_array_equal(a.landmarks.dense_covariance(), b.landmarks.dense_covariance())
        np.testing.assert_array_equal(a.exit_pose, b.exit_pose)
    other = local_maps(log, seed=5, options=SMALL)
    assert [s.report["min_ess"] for s in other] != [s.report["min_ess"] for s in alone]


def test_single_map_front_ends_give_one_submap() -> None:
    log = gs.simulate("landmark-field", seed=4, preset="quick").slice(0.0, 8.0)
    for name in ("ekf-slam", "rbpf-slam"):
        (whole,) = local_maps(log, name)
        assert whole.interval[1] == log["landmarks"].times[-1]


def test_particles_are_those_of_the_moments() -> None:
    log = gs.simulate("landmark-field", seed=4, preset="quick").slice(0.0, 8.0)
    options = {**SMALL, "handover": "moments"}
    submap, particles = first_particles(log, seed=4, options=options)
    np.testing.assert_array_equal(submap.exit_pose, local_maps(log, seed=4, options=options)[0].exit_pose)
    # no particle was dropped, so the moments' position is the weighted mean of the particles shown
    assert submap.report["dropped_particles"] == 0
    np.testing.assert_allclose(submap.exit_pose[:2], particles.weights @ particles.pose[:, :2], atol=1e-12)
    with pytest.raises(ConfigError, match="no local maps of particles"):
        first_particles(log, "ekf")
