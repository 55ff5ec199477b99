"""Calibration of odometry by scans: a robot in a furnished room, errors added to its odometry and found again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import graphslam as gs
from graphslam.calibrate.corrections import Corrections
from graphslam.calibrate.scans import calibrate_scans, regress
from graphslam.calibrate.sighted import QUICK
from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_between, se2_exp, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.records import LaserScans, Odometry
from graphslam.frontends.odometry.step_config import StepConfig
from graphslam.frontends.odometry.steps import make_steps

BIAS, SCALE, NOISE = np.deg2rad(0.6), 1.04, 0.02


def boxes(rng):
    """Walls of a room and of furniture as segments ``(n, 4)``."""
    out = [_box(0.0, 0.0, 12.0, 9.0, 0.0)]
    for _ in range(14):
        x, y = rng.uniform(-5.5, 5.5), rng.uniform(-4.0, 4.0)
        if np.hypot(x / 1.4, y) > 2.8 or np.hypot(x, y) < 1.0:
            out.append(_box(x, y, *rng.uniform(0.3, 0.9, 2), rng.uniform(0, np.pi)))
    return np.concatenate(out)


def _box(x, y, w, h, a):
    c = np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) / 2 @ [[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]] + [x, y]
    return np.column_stack([c, np.roll(c, -1, axis=0)])


def scan(pose, walls, bearings):
    """Ranges of beams from a pose."""
    d = np.column_stack([np.cos(pose[2] + bearings), np.sin(pose[2] + bearings)])
    a, e = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = d[:, None, 0] * e[:, 1] - d[:, None, 1] * e[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        u = (a[:, 0] * d[:, None, 1] - a[:, 1] * d[:, None, 0]) / cross
    return np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=1)


@pytest.fixture(scope="module")
def log():
    rng = np.random.default_rng(3)
    walls = boxes(rng)
    t = np.arange(0.0, 150.0, 0.5)
    # round and round a bend, faster and slower, so that time, way and turn are not one
    phase = np.cumsum(0.5 * 0.11 * (1.0 + 0.6 * np.sin(0.21 * t)))
    at = np.column_stack([3.6 * np.cos(phase) * (1 + 0.2 * np.sin(3 * phase)), 2.6 * np.sin(phase)])
    v = np.gradient(at, t, axis=0)
    poses = np.column_stack([at, np.unwrap(np.arctan2(v[:, 1], v[:, 0]))])
    bearings = np.linspace(-np.pi / 2, np.pi / 2, 181)
    ranges = np.array([scan(p, walls, bearings) for p in poses]) + 0.01 * rng.standard_normal((len(t), 181))
    xi = np.zeros((len(t), 3))
    xi[1:] = se2_log(se2_between(poses[:-1], poses[1:]))
    d = np.hypot(xi[:, 0], xi[:, 1])
    xi[:, :2] *= SCALE
    xi[1:, 2] += BIAS * 0.5 + NOISE * np.sqrt(d[1:]) * rng.standard_normal(len(t) - 1)
    odometry = Odometry(times=t, increments=se2_exp(xi), covariances=np.tile(1e-8 * np.eye(3), (len(t), 1, 1)))
    scans = LaserScans(times=t, ranges=ranges, bearings=bearings, max_range=30.0)
    return SensorLog(name="furnished-room", streams={"odometry": odometry, "scans": scans})


def test_added_scale_noise_and_turning_are_found(log) -> None:
    found = calibrate_scans(make_steps(log, StepConfig(period=None)), QUICK)
    c = found.corrections
    assert c.distance_scale == pytest.approx(SCALE, abs=0.005)
    metres = float(np.hypot(*log["odometry"].increments[:, :2].T).sum())
    turned = c.yaw_bias * 150.0 + c.turn_per_metre * metres + (c.turn_scale - 1) * 25.0
    assert turned == pytest.approx(BIAS * 150.0, rel=0.25)
    step = 0.5 * metres / 150.0
    heading = c.heading_metre**2 * step + c.heading_radian**2 * 0.09 + c.heading_second**2 * 0.5
    assert np.sqrt(heading) == pytest.approx(NOISE * np.sqrt(step), rel=0.35)
    assert any("distances of the motion" in f.text for f in found.findings())


def test_run_of_a_front_end_on_grids_is_calibrated(log) -> None:
    options = {"frontend": {"steps": {"period": "none"}, "filter": {"particles": 4}}, "map": {"fuse": False}}
    run = gs.run(log.slice(0.0, 60.0), frontend="rbpf-grid", config=options, progress=False)
    assert run.report["calibrate"]["given"]["distance_scale"] == pytest.approx(SCALE, abs=0.01)


def test_ranges_twice_too_long_are_a_contradiction_and_correct_nothing(log) -> None:
    scans = log["scans"]
    doubled = dataclasses.replace(scans, ranges=2.0 * scans.ranges, max_range=60.0)
    made = make_steps(dataclasses.replace(log, streams={**log.streams, "scans": doubled}), StepConfig(period=None))
    found = calibrate_scans(made, QUICK)
    scale = next(e for e in found.estimates if e.name == "distance_scale")
    assert scale.contradiction
    assert found.corrections == Corrections()
    (line,) = found.findings()
    assert (line.level, line.code) == ("bad", "calibration-contradiction")


def test_scans_that_see_nothing_are_refused(log) -> None:
    blind = dataclasses.replace(log["scans"], ranges=np.full_like(log["scans"].ranges, 99.0))
    nothing = dataclasses.replace(log, streams={**log.streams, "scans": blind})
    with pytest.raises(DataError, match="too few scans"):
        calibrate_scans(make_steps(nothing, StepConfig(period=None)), QUICK)


def test_regression_finds_noise_that_grows_and_is_not_led_by_outliers() -> None:
    rng = np.random.default_rng(1)
    d = rng.choice([0.4, 1.3], 600)
    e = 0.05 * d + np.sqrt(0.01**2 + 0.03**2 * d) * rng.standard_normal(600)
    e[::20] += 1.0
    found = regress(e, d[:, None], d[:, None])
    assert found.value[0] == pytest.approx(0.05, abs=4 * np.sqrt(found.covariance[0, 0]))
    assert found.sigmas[1] == pytest.approx(0.03, rel=0.25)
    assert not found.keep[::20].any()
