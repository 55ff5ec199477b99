"""The simulated crawler in the garage: dead reckoning of its segments is as far off as stated, both ways."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.poses import remove_roll_pitch
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.garage import garage
from graphslam_frontends.odometry.dead_reckoning import integrate_imu_and_wheels
from graphslam_frontends.odometry.motion_prior import MotionPrior

Drive = tuple[MotionPrior, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def drives() -> list[Drive]:
    """Six drives: what was reckoned, true poses at its times, metres driven until then."""
    world, config = garage("A"), CrawlerConfig(beams=2, scan_rate=0.2)  # the scanner is not looked at
    out = []
    for seed in range(100, 106):
        log = simulate_crawler(world, seed, config)
        times = np.arange(0.4, log["imu"].times[-1] - 0.5, 0.4)
        r = integrate_imu_and_wheels(log["imu"], log["wheels"], times)
        length = np.cumsum(np.linalg.norm(r.odometry.increments[:, :3], axis=1))
        out.append((r, log.truth.trajectory.interpolate(times), length))
    return out


def segments(drive: Drive, metres: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Errors of heading and position ``(4,)`` over segments of a drive, frames level, and their covariances."""
    r, truth, length = drive
    out = []
    for start in np.arange(0.0, length[-1] - metres, metres):
        i, j = (int(k) for k in np.searchsorted(length, [start, start + metres]))
        T, C = r.between(i, j, level_start=True, level_end=True)
        true = se3.se3_between(remove_roll_pitch(truth[i]), remove_roll_pitch(truth[j]))
        out.append((se3.se3_log(se3.se3_between(T, true)), C))
    return out


def nees(e: np.ndarray, C: np.ndarray) -> float:
    return float(e[2:] @ np.linalg.solve(C[2:, 2:], e[2:]) / 4.0)


def test_segments_are_as_far_off_as_stated(drives: list[Drive]) -> None:
    found = [s for d in drives for s in segments(d, 35.0)]
    assert len(found) > 40
    assert 0.6 < np.mean([nees(e, C) for e, C in found]) < 1.3
    # the bias of the gyro is one of σ in every log, and it is what heading and position are off by
    squares = np.mean([e[2:] ** 2 / np.diag(C)[2:] for e, C in found], axis=0)
    assert np.all((squares > 0.5) & (squares < 1.6))
