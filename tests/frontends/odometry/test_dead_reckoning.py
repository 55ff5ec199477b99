"""Six-dimensional dead reckoning: right without noise, and as far off as it says with it, errors that last included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, GeometryError, MissingDataError
from graphslam.core.log import DropCounter
from graphslam.core.poses import remove_roll_pitch
from graphslam_frontends.odometry.dead_reckoning import (
    DeadReckoningNoise,
    integrate_imu_and_wheels,
)
from graphslam_frontends.odometry.gaps import find_gaps
from graphslam_frontends.odometry.inertial_biases import (
    euler,
    euler_quat,
    tangent_of_state,
)
from graphslam_frontends.odometry.motion_prior import MotionPrior
from tests.reference.imu_drive import NOISE, STILL, drive

TIMES = np.linspace(0.0, 40.0, 101)
RUNS = 200


def motion(poses: np.ndarray, i: int, j: int, is_level: bool) -> np.ndarray:
    a, b = poses[i], poses[j]
    return se3.se3_between(remove_roll_pitch(a), remove_roll_pitch(b)) if is_level else se3.se3_between(a, b)


@pytest.mark.parametrize("gives_attitude", [True, False])
def test_without_noise_it_is_the_truth(gives_attitude: bool) -> None:
    d = drive(None, gives_attitude=gives_attitude, stated=STILL)
    r = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE)
    truth = d.truth.interpolate(TIMES)
    off = se3.se3_log(se3.se3_between(motion(r.poses, 0, 100, False), motion(truth, 0, 100, False)))
    # without an attitude of its own, gravity is seen through a filter while the base accelerates
    assert np.abs(off).max() < (1e-4 if gives_attitude else 5e-3)
    assert np.linalg.norm(motion(truth, 0, 100, False)[:3]) > 10.0
    assert np.abs(r.tilt - euler(truth)[:, :2]).max() < (1e-6 if gives_attitude else 1e-3)


def test_increments_chain_to_the_poses() -> None:
    d = drive(np.random.default_rng(1), seconds=40.0)
    r = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE)
    T = r.poses[0]
    np.testing.assert_allclose(r.poses[0][:3], 0.0)
    assert abs(euler(r.poses[0])[2]) < 1e-12
    for step in r.odometry.increments:
        T = se3.se3_compose(T, step)
    np.testing.assert_allclose(T, r.poses[-1], atol=1e-10)


def nees(gives_attitude: bool, intervals: list[tuple[int, int]]) -> dict[tuple[int, int, bool], np.ndarray]:
    out: dict[tuple[int, int, bool], list[float]] = {}
    for seed in range(RUNS):
        d = drive(np.random.default_rng(seed), gives_attitude=gives_attitude)
        r = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE)
        truth = d.truth.interpolate(TIMES)
        for i, j in intervals:
            for is_level in (False, True):
                T, C = r.between(i, j, level_start=is_level, level_end=is_level)
                e = se3.se3_log(se3.se3_between(T, motion(truth, i, j, is_level)))
                if is_level:  # both frames stand level: nothing to be wrong about but heading and position
                    assert np.abs(e[:2]).max() < 1e-6
                    e, C = e[2:], C[2:, 2:]
                out.setdefault((i, j, is_level), []).append(float(e @ np.linalg.solve(C, e)))
    return {k: np.array(v) for k, v in out.items()}


def test_errors_over_intervals_are_as_stated() -> None:
    for (_, _, is_level), d2 in nees(True, [(0, 100), (40, 100), (25, 50)]).items():
        dof = 4 if is_level else 6
        low, high = chi2.ppf([5e-4, 1 - 5e-4], RUNS * dof) / RUNS
        assert low < d2.mean() < high
        inside = np.mean(d2 < chi2.ppf(0.95, dof))
        assert 0.89 < inside < 0.995


def test_errors_with_gravity_through_a_filter_are_as_stated() -> None:
    """The filter's error follows the gyro's bias; while the base turns at the start of an interval less than stated."""
    for (_, _, is_level), d2 in nees(False, [(0, 100), (40, 100), (25, 50)]).items():
        assert 0.8 < d2.mean() / (4 if is_level else 6) < 1.2


def test_what_is_new_in_each_step_is_as_stated() -> None:
    """With errors that last switched off, increments of 0.4 s are as far off as their covariances say, each axis."""
    squares = []
    for seed in range(40):
        d = drive(np.random.default_rng(1000 + seed), biased=False)
        o = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE).odometry
        truth = d.truth.interpolate(TIMES)
        e = se3.se3_log(se3.se3_between(o.increments[1:], se3.se3_between(truth[:-1], truth[1:])))
        squares.append(np.mean(e**2 / np.diagonal(o.covariances[1:], axis1=1, axis2=2), axis=0))
    # 4000 increments; tilt errors of neighbours are alike, so the means scatter by a few per cent
    np.testing.assert_allclose(np.mean(squares, axis=0), 1.0, atol=0.12)


def test_independent_increments_promise_too_much() -> None:
    """The reason for carrying errors that last: composing white increments is overconfident many times over."""
    d = drive(np.random.default_rng(5))
    r = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE)
    P = np.zeros((6, 6))
    for step, C in zip(r.odometry.increments[1:], r.odometry.covariances[1:]):
        back = se3.se3_adjoint(se3.se3_inverse(step))
        P = back @ P @ back.T + C
    consistent = r.between(0, 100)[1]
    assert consistent[2, 2] > 5.0 * P[2, 2]


def test_transition_equals_differences_of_the_whole_integration() -> None:
    """Errors put into the measurements move the end as the transition says: gyro's bias, wheels' scale, tilt."""
    d = drive(None, stated=STILL)
    r = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE)
    F = np.linalg.multi_dot(r.biases.transitions[1:][::-1])
    eps = 1e-4

    def state(q: MotionPrior) -> np.ndarray:
        return np.concatenate([[euler(q.poses[-1])[2]], q.poses[-1][:3]])

    to_imu = se3.quat_to_matrix(d.imu.T_base_imu[3:])
    for axis in range(3):  # true = measured + error, so the estimate without it is off by the opposite
        turned = replace(d.imu, angular_rate=d.imu.angular_rate + eps * to_imu[axis])
        moved = (state(integrate_imu_and_wheels(turned, d.wheels, TIMES, NOISE)) - state(r)) / eps
        np.testing.assert_allclose(moved, F[:4, 4 + axis], atol=1e-8 + 2e-2 * np.abs(F[:4, 4 + axis]).max())
    faster = replace(d.wheels, speed=d.wheels.speed * (1 + eps))
    moved = (state(integrate_imu_and_wheels(d.imu, faster, TIMES, NOISE)) - state(r)) / eps
    np.testing.assert_allclose(moved, F[:4, 7], atol=2e-2 * np.abs(F[:4, 7]).max())
    flat = replace(d.imu, T_base_imu=np.array([0, 0, 0, 0, 0, 0, 1.0]), angular_rate=d.imu.angular_rate @ to_imu.T)
    tilt = euler(d.truth.poses)[:, :2]
    base = integrate_imu_and_wheels(replace(flat, attitude=tilt), d.wheels, TIMES, NOISE)
    for axis in range(2):
        tilted = integrate_imu_and_wheels(replace(flat, attitude=tilt + eps * np.eye(2)[axis]), d.wheels, TIMES, NOISE)
        moved = (state(tilted) - state(base)) / eps
        np.testing.assert_allclose(moved, F[:4, 10 + axis], atol=2e-2 * np.abs(F[:4, 10 + axis]).max())


def test_tangent_of_state_equals_finite_differences(rng: np.random.Generator) -> None:
    a, b = (np.concatenate([rng.normal(size=3), euler_quat(*rng.normal(scale=0.4, size=3))]) for _ in range(2))
    eps = 1e-6
    for is_level in (False, True):
        frames = [remove_roll_pitch(p) if is_level else p for p in (a, b)]
        G = tangent_of_state(frames[0][None], frames[1][None], level_start=is_level, level_end=is_level)[0]
        for k in range(14):
            e = eps * np.eye(14)[k]
            tilt_a, tilt_b = (0 * e[12:], 0 * e[12:]) if is_level else (e[12:], e[8:10] + e[10:12])
            ra, rb = euler(frames[0]), euler(frames[1])
            A = np.concatenate([frames[0][:3], euler_quat(ra[0] + tilt_a[0], ra[1] + tilt_a[1], ra[2])])
            turned = euler_quat(rb[0] + tilt_b[0], rb[1] + tilt_b[1], rb[2] + e[0])
            B = np.concatenate([frames[1][:3] + e[1:4], turned])
            T, true = se3.se3_between(frames[0], frames[1]), se3.se3_between(A, B)
            np.testing.assert_allclose(se3.se3_log(se3.se3_between(T, true)) / eps, G[:, k], atol=2e-5)


def test_gaps_are_bridged_with_doubt_and_counted() -> None:
    d = drive(np.random.default_rng(2))
    sharp = integrate_imu_and_wheels(d.imu, d.wheels, TIMES, NOISE)
    for what, inside in (("imu", 2), ("wheels", 3)):
        stream = getattr(d, what)
        hole = stream.take((stream.times <= 20.01) | (stream.times >= 21.49))
        drops = DropCounter()
        streams = {"imu": d.imu, "wheels": d.wheels, what: hole}
        r = integrate_imu_and_wheels(streams["imu"], streams["wheels"], TIMES, NOISE, drops=drops)
        assert drops.counts == {f"log/{what}: gap bridged": 1}
        # the whole gap's σ over 1.5 s: of the heading 0.3 rad/s, of the distance 0.5 m/s
        added = (r.between(49, 55)[1] - sharp.between(49, 55)[1])[inside, inside]
        expected = (
            (0.3 if what == "imu" else 0.5) * (hole.times[hole.times > 20.5][0] - hole.times[hole.times < 20.5][-1])
        ) ** 2
        np.testing.assert_allclose(added, expected, rtol=0.1)
        np.testing.assert_allclose(r.odometry.covariances[20], sharp.odometry.covariances[20], rtol=1e-9)
        late = stream.take((stream.times <= 15.01) | (stream.times >= 21.49))
        streams[what] = late
        option = r"at most 2 s \(frontend\.steps\.longest_record\)"
        with pytest.raises(DataError, match=rf"log/{what}: gap without records.*to 21\.5.*{option}"):
            integrate_imu_and_wheels(streams["imu"], streams["wheels"], TIMES, NOISE, longest=2.0)


def test_a_jump_of_the_clock_is_a_gap() -> None:
    d = drive(np.random.default_rng(2))
    t = d.imu.times + np.where(d.imu.times > 20.0, 3600.0, 0.0)
    with pytest.raises(DataError, match="3600"):
        find_gaps(t, 0.0, 4000.0, 2.0, where="imu", drops=None)


def test_a_standing_base_stays_and_only_its_heading_drifts() -> None:
    d = drive(np.random.default_rng(3))
    r = integrate_imu_and_wheels(d.imu, replace(d.wheels, speed=0.0 * d.wheels.speed), TIMES, NOISE)
    np.testing.assert_allclose(r.poses[:, :3], 0.0)
    C = r.between(0, 100)[1]
    assert np.abs(np.diag(C)[3:] - NOISE.floor_position**2).max() < 1e-15
    assert np.sqrt(C[2, 2]) > 0.05


def test_refusals() -> None:
    d = drive(np.random.default_rng(4))
    with pytest.raises(DataError, match="times outside the records"):
        integrate_imu_and_wheels(d.imu, d.wheels, [0.0, 41.0])
    with pytest.raises(DataError, match="times outside the records"):
        integrate_imu_and_wheels(d.imu, d.wheels.take(slice(10, None)), TIMES)
    with pytest.raises(MissingDataError, match="log/wheels"):
        integrate_imu_and_wheels(d.imu, d.wheels.take(slice(0, 0)), TIMES)
    with pytest.raises(DataError, match="no time"):
        integrate_imu_and_wheels(d.imu, d.wheels, [])
    with pytest.raises(DataError, match="does not increase"):
        integrate_imu_and_wheels(d.imu, d.wheels, [1.0, 1.0])
    wall = replace(d.imu, T_base_imu=np.concatenate([np.zeros(3), se3.so3_exp([0, np.pi / 2, 0])]))
    with pytest.raises(GeometryError, match="wall"):
        integrate_imu_and_wheels(wall, d.wheels, TIMES)
    weightless = replace(d.imu, attitude=None, specific_force=0.0 * d.imu.specific_force)
    with pytest.raises(DataError, match="no gravity"):
        integrate_imu_and_wheels(weightless, d.wheels, TIMES)
    with pytest.raises(DataError, match="no such interval"):
        integrate_imu_and_wheels(d.imu, d.wheels, TIMES).between(5, 101)
    for bad in ({"floor_position": 0.0}, {"wheel": -1.0}, {"wheel_scale": np.nan}):
        with pytest.raises(ConfigError):
            DeadReckoningNoise(**bad)


def test_one_time_is_a_path_without_motion() -> None:
    d = drive(np.random.default_rng(4))
    r = integrate_imu_and_wheels(d.imu, d.wheels, [3.0])
    np.testing.assert_array_equal(r.odometry.increments, [[0, 0, 0, 0, 0, 0, 1]])
    T, C = r.between(0, 0)
    np.testing.assert_allclose(T, [0, 0, 0, 0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(C, np.diag(r.biases.floor**2), atol=1e-15)
