"""Scans against motion: errors of a known size come out with that size, within what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.log import SensorLog
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.motion_check import MotionCheck, check_motion, motion_findings
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_studies.faults import scans as put
from tests.faults.grid_worlds import RANGE, ring_log

CONFIG = StepConfig(max_range=RANGE, most_points=240)


def checked(log: SensorLog) -> MotionCheck:
    return check_motion(make_steps(log, CONFIG))


@pytest.mark.parametrize("seed", [11, 12])
def test_a_sound_robot_agrees_with_itself(seed: int) -> None:
    found = checked(ring_log(seed))
    assert found.matched >= 0.9 * found.tried
    for key, true in (("distance", 1.0), ("turn", 1.0), ("yaw", 0.0), ("ahead", 0.0), ("left", 0.0), ("lag", 0.0)):
        fit = found.fits[key]
        assert abs(fit.value - true) < 5.0 * fit.sigma + 0.01, (key, fit)
    assert motion_findings(found) == []


@pytest.mark.parametrize(
    ("inject", "key", "true", "code", "word"),
    [
        (put.speed(2.0), "distance", 0.5, "distance-disagrees", "0.5"),
        (put.speed(-1.0), "distance", -1.0, "distance-disagrees", "wrong sign"),
        (put.speed(3.6), "distance", 1.0 / 3.6, "distance-disagrees", "km/h"),
        (put.yaw_rate(-1.0), "turn", -1.0, "turn-disagrees", "mirrored"),
        (put.mirrored, "turn", -1.0, "turn-disagrees", "mirrored"),
        (put.mounted(yaw=10.0), "yaw", np.deg2rad(-10.0), "mounting-disagrees", "turned to the left"),
        (put.mounted(y=1.0), "left", -1.0, "mounting-disagrees", "to the left"),
        (put.mounted(x=1.0), "ahead", -1.0, "mounting-disagrees", "ahead"),
        (put.late("scanner", 0.5), "lag", 0.5, "clocks-disagree", "0.5"),
    ],
)
def test_an_error_comes_out_with_its_size(inject: put.Inject, key: str, true: float, code: str, word: str) -> None:
    found = checked(inject(ring_log(11)))
    fit = found.fits[key]
    assert abs(fit.value - true) < 5.0 * fit.sigma + 0.05, fit
    lines = [f for f in motion_findings(found) if f.code == code]
    assert lines
    assert lines[0].level in ("bad", "look")
    assert word in lines[0].text


def test_wheels_that_stand_while_the_scans_move() -> None:
    lines = motion_findings(checked(put.speed(0.0)(ring_log(11))))
    assert [f.level for f in lines if f.code == "distance-disagrees"] == ["bad"]
    assert any("stand still" in f.text for f in lines)


def test_a_log_too_short_says_nothing() -> None:
    log = ring_log(11)
    found = checked(replace(log, streams=log.slice(0.0, 3.0).streams))
    assert found.fits == {}
    assert motion_findings(found) == []
