"""Runs on a small campus: a wrong pan encoder is named, and bad GPS, IMU and scans are survived, or refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.worlds import simulate
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.range_scans import RangeScans
from graphslam_frontends.scan_window.encoder import encoder_offset, turning_heads

SMALL = {"size": (66.0, 66.0), "block": 55.0, "every": 3, "every_beam": 3, "speed": 1.5, "movers": 1}
SHARP = {"reflect_sigma": (1e-3, 1e-3), "hidden_share": (1e-6, 1e-6), "orbit_sigma": (0.05, 0.05)}
GPS = {"use": "all", "every": 2.0, "bias_sigma": 0.1, "bias_time": 100.0}
SECONDS = 50.0


def drive(**changes: Any) -> SensorLog:
    return simulate("campus", preset="quick", seed=2, **{**SMALL, **SHARP, **changes}).slice(0.0, SECONDS)


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return drive()


def run(log: SensorLog, **gps: Any) -> Any:
    config = {"gps": {**GPS, **gps}, "refine": {"use": False}}
    return gs.run(log, frontend="scan-window", config=config, progress=False)


def codes_of(made: Any, level: str = "") -> set[str]:
    return {f.code for f in made.verdict if level in ("", f.level)}


@pytest.fixture(scope="module")
def clean(log: SensorLog) -> Any:
    return run(log)


def test_a_good_log_is_found_good(clean: Any) -> None:
    assert clean.metric("path_rmse_aligned") < 0.2
    assert not codes_of(clean) & {"scan-encoder", "gps-not-used", "imu-saturated", "turns-disagree", "motion-gap"}
    assert "consistency-test" not in codes_of(clean, "bad")


# ---------------------------------------------------------------- the pan encoder


def test_a_good_encoder_is_found_good(log: SensorLog) -> None:
    assert turning_heads(log) == {"panning": 1.0}
    steps = recommended_steps(log)
    e = encoder_offset(log, steps)
    assert e.stream == "panning"
    assert abs(e.offset) < np.deg2rad(0.34)
    assert 0.0 < e.sigma < np.deg2rad(0.2)


@pytest.mark.parametrize("degrees", [-1.0, 3.0])
def test_a_wrong_encoder_is_found_and_named_with_its_size(degrees: float) -> None:
    off = drive(encoder_offset=float(np.deg2rad(degrees)))
    (line,) = [f for f in run(off, use="none").verdict if f.code == "scan-encoder"]
    assert line.level == "bad"
    assert "panning" in line.text
    assert ("too much" if degrees > 0 else "too little") in line.text
    size = float(line.text.partition("encoder of panning: ")[2].partition(" ±")[0])
    assert size == pytest.approx(abs(degrees), abs=0.35)


def test_without_a_head_that_turns_there_is_no_encoder(log: SensorLog) -> None:
    still = replace(log, streams={k: v for k, v in log.streams.items() if k != "panning"})
    assert turning_heads(still) == {}
    with pytest.raises(MissingDataError, match="upright axis"):
        encoder_offset(still)
    with pytest.raises(MissingDataError, match="vertical"):
        encoder_offset(log, stream="vertical")


def recommended_steps(log: SensorLog) -> Any:
    from graphslam_studies.campus import QUICK_WORLDS

    return QUICK_WORLDS["quick"].front_end.steps


# ---------------------------------------------------------------- bad input


def with_streams(log: SensorLog, **streams: Any) -> SensorLog:
    return replace(log, streams={**log.streams, **streams})


def correlated(n: int, time: float, sigma: float) -> np.ndarray:
    rng, keep = np.random.default_rng(0), np.exp(-1.0 / time)
    x = sigma * rng.standard_normal((n, 3))
    for k in range(1, n):
        x[k] = keep * x[k - 1] + np.sqrt(1.0 - keep**2) * x[k]
    return x


def only_at_the_start(log: SensorLog) -> SensorLog:
    return with_streams(log, gps=log["gps"].take(log["gps"].times < 8.0))


def correlated_fixes(log: SensorLog) -> SensorLog:
    g = log["gps"]
    return with_streams(log, gps=replace(g, positions=g.positions + correlated(len(g.times), 20.0, 3.0)))


def saturated(log: SensorLog) -> SensorLog:
    return with_streams(log, imu=replace(log["imu"], angular_rate=np.clip(log["imu"].angular_rate, -0.3, 0.3)))


def in_degrees(log: SensorLog) -> SensorLog:
    return with_streams(log, imu=replace(log["imu"], angular_rate=np.rad2deg(log["imu"].angular_rate)))


def with_a_gap(log: SensorLog) -> SensorLog:
    t = log["imu"].times
    return with_streams(log, imu=log["imu"].take((t < 30.0) | (t > 34.0)))


def with_empty_scans(log: SensorLog) -> SensorLog:
    s: RangeScans = log["panning"]
    empty = np.floor(s.times).astype(int) % 8 == 0
    return with_streams(log, panning=replace(s, ranges=np.where(empty[:, None], np.nan, s.ranges)))


@pytest.mark.parametrize(
    ("spoil", "code", "level"),
    [
        (only_at_the_start, {"gps-not-used"}, "bad"),
        (correlated_fixes, {"consistency-test", "gps-correlated"}, ""),
        (saturated, {"imu-saturated"}, "bad"),
        (in_degrees, {"turns-disagree"}, "bad"),
        (with_a_gap, {"motion-gap"}, ""),
    ],
)
def test_what_is_wrong_is_reported(
    log: SensorLog, clean: Any, spoil: Callable[[SensorLog], SensorLog], code: set[str], level: str
) -> None:
    made = run(spoil(log))
    assert code & codes_of(made, level)
    assert not code & codes_of(clean)
    if spoil in (with_a_gap, only_at_the_start):  # and survived
        assert made.metric("path_rmse_aligned") < 2.0 * clean.metric("path_rmse_aligned") + 0.1


def test_fixes_off_by_a_constant_change_nothing(log: SensorLog, clean: Any) -> None:
    g = log["gps"]
    made = run(with_streams(log, gps=replace(g, positions=g.positions + [300.0, -200.0, 50.0])))
    np.testing.assert_allclose(made.map.trajectory.poses, clean.map.trajectory.poses, atol=1e-4)


def test_scans_without_points_are_survived_and_a_log_of_them_is_refused(log: SensorLog, clean: Any) -> None:
    made = run(with_empty_scans(log))
    assert made.metric("path_rmse_aligned") < 2.0 * clean.metric("path_rmse_aligned") + 0.1
    blind = {k: replace(log[k], ranges=np.full_like(log[k].ranges, np.nan)) for k in ("panning", "vertical")}
    with pytest.raises(DataError, match="no beam of any scan met anything"):
        run(with_streams(log, **blind))


def test_two_scans_of_one_instant_are_refused_by_their_number(log: SensorLog) -> None:
    s: RangeScans = log["panning"]
    times = s.times.copy()
    times[700] = times[699]
    with pytest.raises(DataError, match="record 700"):
        replace(s, times=times)
