"""The front end of identified points in space: consistent local maps, wrong detections left out, what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import ConfigError, MissingDataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.se3 import se3_inverse, se3_transform, so3_exp
from graphslam_frontends.landmarks.points import Points, PointsConfig
from graphslam_studies.evaluate.submap_consistency import submap_nees


def flight(seed: int, **changes: float) -> SensorLog:
    return gs.simulate("point-field", preset="quick", seed=seed, **changes)


def submaps_of(log: SensorLog, **rest) -> list[gs.Submap]:
    return list(Points(PointsConfig(max_distance=12.0)).submaps(log, seed=SeedTree(0), **rest))


@pytest.mark.parametrize(("turn", "shift"), [(0.3, 0.02), (2.5, 0.05)])
def test_local_maps_are_consistent(turn: float, shift: float) -> None:
    """Also where the rotation at their ends is uncertain by 6°; a covariance halved or doubled fails."""
    d2, dof, chi2, free = 0.0, 0, 0.0, 0
    for seed in range(6):
        log = flight(seed, sigma_turn=turn, sigma_shift=shift)
        for s in submaps_of(log):
            r = submap_nees(s, log.truth)
            d2, dof = d2 + r.joint, dof + r.joint_dof
            chi2, free = chi2 + s.report["chi2"], free + s.report["dof"]
    low, high = chi2_quantile(0.001, dof) / dof, chi2_quantile(0.999, dof) / dof
    assert low < d2 / dof < high
    assert not low < 2.0 * d2 / dof < high
    assert not low < 0.5 * d2 / dof < high
    assert chi2_quantile(0.001, free) < chi2 < chi2_quantile(0.999, free)


def test_wrong_identities_are_left_out_and_counted() -> None:
    log = flight(3)
    seen, rng = log["points"], np.random.default_rng(0)
    ids = seen.ids.copy()
    for k in rng.choice(np.arange(5, len(seen.times)), 20, replace=False):  # two points of a scan change their names
        rows = np.arange(seen.offsets[k], seen.offsets[k + 1])
        a, b = rng.choice(rows, 2, replace=False)
        ids[[a, b]] = ids[[b, a]]
    wrong = replace(log, streams={**log.streams, "points": replace(seen, ids=ids)})
    drops = DropCounter()
    judged = [submap_nees(s, log.truth) for s in submaps_of(wrong, drops=drops)]
    (left_out,) = drops.counts.values()
    assert 30 <= left_out <= 45  # of 40; a pair that stands close together changes little
    assert sum(r.joint for r in judged) / sum(r.joint_dof for r in judged) < 1.3


def test_the_mounting_of_the_sensor_is_taken_into_account() -> None:
    log = flight(4)
    mount = np.concatenate([[0.2, -0.1, 0.3], so3_exp(np.array([0.1, 0.4, -0.2]))])
    seen = log["points"]
    turned = replace(
        seen, points=se3_transform(se3_inverse(mount), seen.points), T_base_sensor=mount,
    )  # fmt: skip
    a = submaps_of(log)
    b = submaps_of(replace(log, streams={**log.streams, "points": turned}))
    np.testing.assert_allclose(a[0].exit_pose, b[0].exit_pose, atol=1e-7)
    np.testing.assert_allclose(a[0].exit_covariance, b[0].exit_covariance, rtol=1e-5, atol=1e-12)


def test_submaps_go_on_after_the_last_and_spend_no_observation_twice() -> None:
    log = flight(1)
    every = submaps_of(log)
    assert len(every) > 2
    rest = submaps_of(log, after=every[0])
    assert [s.key for s in rest] == [s.key for s in every[1:]]
    np.testing.assert_array_equal(rest[-1].landmarks.positions, every[-1].landmarks.positions)
    seen = log["points"]
    assert sum(s.report["observations"] for s in every) == len(seen.ids)
    assert all(s.uses == {"odometry", "points"} for s in every)


def test_what_is_missing_is_named() -> None:
    log = flight(1)
    with pytest.raises(MissingDataError, match="no points"):
        submaps_of(replace(log, streams={"odometry": log["odometry"]}))
    with pytest.raises(MissingDataError, match="no odometry in space"):
        submaps_of(replace(log, streams={"points": log["points"]}))
    with pytest.raises(ConfigError, match="max_distance"):
        PointsConfig(max_distance=0.0)
    with pytest.raises(ConfigError, match="gate"):
        PointsConfig(gate=1.0)
