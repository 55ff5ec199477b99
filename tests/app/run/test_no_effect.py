"""An option that has no effect on a log is one line of the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.records import Compass, Gps, VelocityControls
from tests.app.run.test_imu_run import made, solved


def lines(run, level: str = "look") -> dict[str, str]:
    return {f.code: f.text for f in run.verdict if f.level == level}


def test_sensors_that_the_log_does_not_have(monkeypatch):
    log, submaps = made()
    config = {"gps": {"use": "all"}, "compass": {"use": "auto"}, "imu": {"use": "auto"}}
    wheels = VelocityControls(times=np.arange(48.0), speed=np.ones(48), yaw_rate=np.zeros(48))
    run = solved(replace(log, streams={"wheels": wheels}), submaps, monkeypatch, config=config)
    assert [f.text for f in run.verdict if f.code == "no-effect"] == [
        "compass.use=auto has no effect — the log has no compass.",
        "gps.use=all has no effect — the log has no GPS fixes.",
        "imu.use=auto has no effect — the log has no IMU.",
    ]


def test_an_imu_that_the_front_end_used(monkeypatch):
    log, submaps = made(frozenset({"laser", "imu"}))
    run = solved(log, submaps, monkeypatch, config={"imu": {"use": "auto"}})
    assert lines(run)["no-effect"] == "imu.use=auto has no effect — the front end used imu."
    assert "no-effect" not in lines(solved(log, submaps, monkeypatch))


@pytest.mark.parametrize("still", [False, True], ids=["shorter than the baseline", "at one place"])
def test_fixes_that_do_not_determine_the_datum(still, monkeypatch):
    """The frame of the fixes has no heading: none of them becomes a factor, and the verdict gives number and reason."""
    log, submaps = made()
    t = np.arange(1.0, 40.0, 1.0)
    at = np.zeros((len(t), 3)) if still else log.truth.trajectory.interpolate(t)[:, :3]
    gps = Gps(times=t, positions=at, sigma=np.full(len(t), 0.3), lever=np.zeros(3))
    config = {"gps": {"use": "all", "baseline": 20.0 if still else 100.0}}
    run = solved(replace(log, streams={"gps": gps}), submaps, monkeypatch, config=config)
    text = lines(run, "bad")["gps-not-used"]
    assert text.startswith("gps: 0 of 39 records used, although requested — its 39 fixes on the path span less than ")
    assert not run.graph.values.count("datum")


def test_a_sensor_that_is_used_is_no_such_line(monkeypatch):
    log, submaps = made()
    t = np.arange(1.0, 40.0, 1.0)
    compass = Compass(times=t, headings=np.zeros(len(t)), sigma=np.full(len(t), 0.5))
    both = replace(log, streams={**log.streams, "compass": compass})
    run = solved(both, submaps, monkeypatch, config={"imu": {"use": "auto"}, "compass": {"use": "auto"}})
    assert "no-effect" not in lines(run)
