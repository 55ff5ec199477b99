"""Clouds that say little or nothing: refused, or followed with a covariance and a line that say so; no traceback."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam_frontends.lidar_odometry.front_end import LidarFrontEnd

Clouds = Sequence[np.ndarray]


def room(rng: np.random.Generator, n: int, x: float = 0.0) -> np.ndarray:
    """Points on the walls of a room 10 m wide, seen ``x`` from its middle."""
    u = rng.uniform(-5, 5, (n, 3))
    side = rng.integers(0, 3, n)
    u[np.arange(n), side] = np.where(rng.random(n) < 0.5, -5.0, 5.0)
    return u + 0.01 * rng.normal(size=u.shape) - [x, 0, 0]


def followed(clouds: Clouds, times: np.ndarray | None = None, ages: np.ndarray | None = None) -> list[Submap]:
    points = np.concatenate([np.reshape(c, (-1, 3)) for c in clouds]).astype(float)
    stamps = 0.1 * np.arange(len(clouds)) if times is None else times
    stream = PointClouds.from_arrays(stamps, points, np.cumsum([0, *map(len, clouds)]), ages)
    return list(LidarFrontEnd().submaps(SensorLog(name="odd", streams={"clouds": stream}), seed=SeedTree(0)))


def codes(submaps: list[Submap], level: str) -> set[str]:
    return {f["code"] for s in submaps for f in s.report.get("findings", ()) if f["level"] == level}


EMPTY = np.zeros((0, 3))
NOTHING = {
    "empty": EMPTY,
    "one point": np.array([[3.0, 1, 0]]),
    "three points": np.array([[3.0, 1, 0], [1, 4, 0], [2, 2, 2]]),
    "equal points": np.tile([3.0, 1, 0.5], (500, 1)),
    "a line": np.column_stack([np.linspace(2, 20, 500), np.ones(500), np.zeros(500)]),
    "millimetres": 1000 * room(np.random.default_rng(1), 2000),
    "far off": room(np.random.default_rng(1), 2000) + 1e7,
}


@pytest.mark.parametrize("name", NOTHING)
def test_scans_that_cannot_be_followed_are_refused(name: str) -> None:
    with pytest.raises(DataError, match="no scan has enough points"):
        followed([NOTHING[name]] * 12)


def test_points_of_no_surface_are_followed_by_nobody(rng: np.random.Generator) -> None:
    submaps = followed([rng.uniform(-20, 20, (200, 3)) for _ in range(12)])
    assert "scans-lost" in codes(submaps, "bad")
    assert np.sqrt(submaps[-1].exit_covariance[3, 3]) > 0.1


@pytest.mark.parametrize("points", [101, 150])
def test_scans_of_few_points_say_what_they_do_not_know(points: int, rng: np.random.Generator) -> None:
    submaps = followed([room(rng, points, 0.1 * k) for k in range(15)])
    assert codes(submaps, "bad") >= {"scans-lost"}
    exit = submaps[-1].exit_pose
    assert abs(exit[0]) < 4.0 * np.sqrt(submaps[-1].exit_covariance[3, 3]) + 1.0


def test_scans_between_which_the_lidar_sees_nothing(rng: np.random.Generator) -> None:
    submaps = followed([room(rng, 3000, 0.1 * k) if k % 3 else EMPTY for k in range(25)])
    assert "scans-lost" in codes(submaps, "look")
    x = sum(s.exit_pose[0] for s in submaps)  # it does not turn
    sigma = np.sqrt(sum(s.exit_covariance[3, 3] for s in submaps))
    assert x == pytest.approx(0.1 * 24, abs=max(3 * sigma, 0.3))


def test_a_first_scan_of_the_day_before(rng: np.random.Generator) -> None:
    times = 1.7e9 + 0.1 * np.arange(15)
    times[0] -= 86_400.0
    submaps = followed([room(rng, 3000, 0.1 * k) for k in range(15)], times)
    assert all(np.isfinite(s.exit_covariance).all() and np.abs(s.exit_covariance).max() < 1e8 for s in submaps)


def test_times_of_points_in_another_unit(rng: np.random.Generator) -> None:
    clouds = [room(rng, 3000, 0.1 * k) for k in range(15)]
    submaps = followed(clouds, ages=rng.uniform(0, 1e5, sum(map(len, clouds))))
    assert "scans-lost" in codes(submaps, "bad")


def rings(rng: np.random.Generator) -> np.ndarray:
    """What 16 beams that go round see of a street: ground, and houses 20 m away with gaps."""
    az, el = np.meshgrid(np.deg2rad(np.arange(0, 360, 1.0) + rng.uniform()), np.deg2rad(np.arange(-15.0, 15.1, 2.0)))
    d = np.column_stack([(np.cos(el) * np.cos(az)).ravel(), (np.cos(el) * np.sin(az)).ravel(), np.sin(el).ravel()])
    with np.errstate(divide="ignore"):
        ground = np.where(d[:, 2] < 0, -1.8 / d[:, 2], np.inf)
        house = np.where(np.sin(7 * az.ravel()) > -0.3, 20.0 / np.abs(d[:, :2]).max(axis=1), np.inf)
    r = np.minimum(ground, house)
    keep = r < 60.0
    return d[keep] * (r[keep] + 0.02 * rng.normal(size=keep.sum()))[:, None]


def test_a_sparse_lidar_that_stands_stays_where_it_is() -> None:
    """Its first scans have no surface in common: cells of a few chance points are no word against standing."""
    rng = np.random.default_rng(0)
    submaps = followed([rings(rng) for _ in range(12)])
    path, C = submaps[0].trajectory, submaps[0].trajectory.covariances
    off = np.abs(path.poses[1:, :3])
    assert off.max() < 0.03  # 0.056 if those cells were believed
    assert np.all(off < 4.0 * np.sqrt(np.einsum("kii->ki", C[1:])[:, 3:]) + 0.02)
