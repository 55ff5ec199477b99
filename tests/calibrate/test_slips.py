"""Wheels that slip for a second now and then, and wheels that are late: found, named, and harmless to the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from graphslam.calibrate.clock import profile_clock
from graphslam.calibrate.corrections import Corrections, corrected_motion, slip_noise
from graphslam.calibrate.estimate import Calibration, Estimate, Prediction
from graphslam.calibrate.landmark_calibration import QUICK, SHORT, calibrate_observations
from graphslam.calibrate.landmarks import fit_noise, smooth_observations
from graphslam.calibrate.slips import find_slips
from graphslam.calibrate.windows import ObservationLog
from graphslam.core.random import SeedTree
from graphslam_studies.calibration_robot import draw_robot, drive
from graphslam_studies.trust_faults import odometry
from graphslam_studies.trust_worlds import draw_world, world_log

FREE = ("yaw_bias", "distance_scale", "range_offset", "sensor_yaw")


def seen_in(log) -> ObservationLog:
    return ObservationLog.of(log, "landmarks", log["landmarks"])


@pytest.fixture(scope="module")
def log():
    robot = replace(draw_robot(7), clock=0.0)
    return drive(robot, 7, 60.0)


@pytest.fixture(scope="module")
def clean(log):
    return fit_noise(smooth_observations(seen_in(log), SHORT, 20, FREE))[0]


def test_statistic_of_noise_that_is_fitted_has_the_distribution_it_is_compared_with(log, clean) -> None:
    gain = np.concatenate(clean.gain_without_distances(4))
    assert np.all(gain > -1e-6)
    assert 0.75 < np.median(gain) / special.chdtri(4, 0.5) < 1.3
    assert find_slips(clean, seen_in(log).spacing) == ()


def test_distances_left_out_take_away_what_they_cost(clean) -> None:
    s = clean.copy(free=(), windows=[replace(clean.windows[0])])
    s.converge(30, 1e-9)
    gain, before = s.gain_without_distances(2)[0], s.total()
    k = int(np.argmax(gain))
    steps = s.windows[0].steps.copy()
    steps[k + 1 : k + 3, 5] = 1e6
    without = s.copy(windows=[replace(s.windows[0], steps=steps)])
    without.converge(30, 1e-9)
    assert before - without.total() == pytest.approx(gain[k], rel=0.02)


def test_slipping_wheels_are_named_and_leave_the_noise_as_it_is(log, clean) -> None:
    slipped = odometry(slip=1.5)(log)
    found = calibrate_observations(seen_in(slipped), QUICK)
    at = np.array(found.corrections.slips)
    for begin in (10.0, 20.0, 30.0, 40.0, 50.0):
        assert np.any((at[:, 0] < begin + 0.5) & (at[:, 1] > begin + 0.5))
    assert len(at) < 12
    line = next(f.text for f in found.findings() if f.code == "wheels-slipped")
    assert "slipped at t =" in line
    step = np.array([1.0, 1.0 / draw_robot(7).speed])
    variance = [x["along_metre"] ** 2 * step[0] + x["along_second"] ** 2 * step[1] for x in (found.noise, clean.sigmas)]
    assert 0.5 < variance[0] / variance[1] < 2.0  # without the search nine times as large
    assert all(f.code != "wheels-slipped" for f in calibrate_observations(seen_in(log), QUICK).findings())


def test_wheels_that_report_nothing_while_the_robot_moves_are_found_once(log) -> None:
    o = log["odometry"]
    xi = o.increments.copy()
    xi[(o.times > 20.0) & (o.times < 23.0)] = 0.0  # their σ in slip is zero, too: they stay in contradiction
    stuck = seen_in(replace(log, streams={**log.streams, "odometry": replace(o, increments=xi)}))
    s = fit_noise(smooth_observations(stuck, SHORT, 20, FREE))[0]
    found = find_slips(s, stuck.spacing)
    assert any(a < 22.0 and b > 21.0 for a, b in found)
    assert find_slips(s, stuck.spacing, found) == ()
    at = np.array(calibrate_observations(stuck, QUICK).corrections.slips)
    assert len(at) < 12
    assert np.all(at[1:, 0] >= at[:-1, 1])


def test_variance_of_a_stretch_is_its_length_squared(log) -> None:
    times, metres = np.arange(10.0), np.full(10, 0.3)
    found = slip_noise(times, metres, [(2.0, 5.0)])
    assert found.sum() == pytest.approx(0.9**2)
    assert np.flatnonzero(found).tolist() == [3, 4, 5]
    o = log["odometry"]
    P = corrected_motion(o, Corrections(slips=((10.0, 11.0),))).covariances - o.covariances
    changed = (o.times > 10.0 + 1e-3) & (o.times < 11.0 + 1e-3)
    assert np.all(P[changed, 0, 0] > 0.0)
    assert not np.any(P[~changed])
    assert not np.any(P[:, 1:, 1:])


def test_wheels_that_are_half_a_second_late_are_found_beyond_minima_of_chance() -> None:
    world = replace(draw_world(3004, seconds=80.0), gps="none")
    drawn = world_log(world, SeedTree(12))
    o = drawn["odometry"]
    late = replace(drawn, streams={**drawn.streams, "odometry": replace(o, times=o.times + 0.5)})
    seen = seen_in(late).with_withheld()
    clock = profile_clock(fit_noise(smooth_observations(seen, SHORT, 5, FREE))[0], seen)
    assert clock.applied
    assert clock.sigma < 0.1
    assert abs(clock.value - 0.5) < 3.0 * clock.sigma  # in steps of one record: 0.32 ± 0.02 s


@pytest.mark.parametrize(("timed", "kept"), [(Corrections(clock=0.5), 0.5), (Corrections(), 0.0)])
def test_clock_is_refused_where_it_predicts_worse_and_not_where_nothing_depends_on_it(timed, kept) -> None:
    estimate = Estimate(name="clock", value=0.5, sigma=0.02, gain=100.0, other=0.5, other_sigma=0.02).gated()
    found = Calibration(kind="observations", corrections=Corrections(clock=0.5, along_metre=0.1), estimates=(estimate,))
    tested = found.validated(Prediction(what="observations", count=400, gains={"all": -1.0}, timed=timed))
    assert tested.corrections == Corrections(clock=kept)
    assert tested.estimates[0].applied == bool(kept)
