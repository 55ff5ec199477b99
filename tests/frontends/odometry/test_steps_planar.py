"""Logs in the plane become steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_between, se2_transform
from graphslam.core.log import DropCounter
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from tests.frontends.step_logs import odometry_of, planar_log


def test_beams_that_came_back_with_nothing_may_say_nothing() -> None:
    drops = DropCounter()
    log = planar_log()
    free, silent = make_steps(log), make_steps(log, StepConfig(silent="unknown"), drops=drops)
    assert not free.returns.all()  # the corners are farther than the laser sees
    assert silent.returns.all()
    assert drops.counts["laser: beams without a range"] == len(free.points) - len(silent.points) > 0
    np.testing.assert_array_equal(free.points[free.returns], silent.points)
    # what is cut at a shorter range did come back: it stays, as free space
    cut = make_steps(log, StepConfig(silent="unknown", max_range=3.5))
    assert 0 < np.sum(~cut.returns) < len(cut.returns)
    with pytest.raises(ConfigError, match="silent"):
        StepConfig(silent="loud")  # type: ignore[arg-type]


@pytest.mark.parametrize("period", [0.05, 0.2, 0.7, None])
@pytest.mark.parametrize("recorded", [True, False])
def test_in_the_plane(period: float | None, recorded: bool) -> None:
    """Several scans a step or several steps a scan: with true motion every return is on a wall."""
    log = planar_log()
    streams = {"laser": log["laser"], "odometry": odometry_of(log.truth.trajectory)} if recorded else log.streams
    drops = DropCounter()
    steps = make_steps(replace(log, streams=streams), StepConfig(period=period), drops=drops)
    assert steps.dim == 2
    truth = steps.truth.interpolate(steps.times)
    for k in range(len(steps)):
        points, _, met = steps.scan(k)
        if np.any(met):
            world = se2_transform(truth[k], points[met])
            assert np.abs(np.abs(world).max(axis=1) - 4.0).max() < (2e-2 if period in (0.05, 0.7) else 1e-5)
    empty = np.sum(np.diff(steps.offsets) == 0)
    assert empty == drops.counts["steps: step without a beam (kept)"]
    assert (empty > 100) if period == 0.05 else (empty == 0)
    T, C = steps.errors.between(0, len(steps) - 1)
    np.testing.assert_allclose(T, se2_between(truth[0], truth[-1]), atol=2e-3)
    np.linalg.cholesky(C)


def test_planar_gap_of_controls() -> None:
    log = planar_log()
    wheels = log["wheels"]
    hole = wheels.take((wheels.times < 3.1) | (wheels.times > 4.5))
    drops = DropCounter()
    make_steps(replace(log, streams={**log.streams, "wheels": hole}), drops=drops)
    assert drops.counts["square/wheels: gap bridged"] == 1
    hole = wheels.take((wheels.times < 3.1) | (wheels.times > 6.5))
    wide = replace(log, streams={**log.streams, "wheels": hole})
    match = r"square/wheels: gap without records.*3\.000 to 6\.600.*at most 3 s \(frontend\.steps\.longest_record\)"
    with pytest.raises(DataError, match=match):
        make_steps(wide, StepConfig(longest_record=3.0))


def test_a_gap_of_controls_is_as_wide_as_the_robot_drives() -> None:
    """Speeds of the log are 0.5 and 1 m/s: the last one is held, and what the others are from it is the doubt."""
    log = planar_log()
    wheels = log["wheels"]
    wheels = replace(wheels, speed=np.where(wheels.times < 2.0, 1.0, 0.5))
    hole = wheels.take((wheels.times < 3.1) | (wheels.times > 6.5))
    steps = make_steps(replace(log, streams={**log.streams, "wheels": hole}))
    whole = make_steps(replace(log, streams={**log.streams, "wheels": wheels}))
    assert len(steps.gaps.begin) == 1
    length = float(steps.gaps.end[0] - steps.gaps.begin[0])
    spread = np.sqrt(np.mean((hole.speed - 0.5) ** 2))
    added = (steps.odometry.covariances - whole.odometry.covariances)[:, 0, 0]
    assert np.sqrt(added.sum()) == pytest.approx(spread * length, rel=0.05)
    inside = (steps.times > steps.gaps.begin[0]) & (steps.times - 0.4 < steps.gaps.end[0])
    np.testing.assert_allclose(added[~inside], 0.0, atol=1e-12)
