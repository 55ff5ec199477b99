"""The laps world: its measurements have the noise that the network states, and a seed means the same bytes."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.skeleton.schur import Network, Workers, WorkRanges
from graphslam_studies.sim.laps import Laps, LapsConfig, draw_laps

CONFIG = LapsConfig(poses=480, laps=6, gps_every=5)


@pytest.fixture(scope="module")
def world() -> Laps:
    return draw_laps(CONFIG, seed=2)


def test_points_have_their_noise(world: Laps) -> None:
    """Along the ray and across it, about the true places of the landmarks."""
    c, S = CONFIG, world.shared.shape[0]
    points = world.points().astype(float)
    along, across, m = [], [], 0
    for i in range(c.poses):
        for s in range(max(0, i - c.reach + 1), i + 1):
            for j in range(c.begin):
                if i % 7 == 0:
                    true = world.truth.rotation[i].T @ (world.places[s % S, j] - world.truth.position[i])
                    r = np.linalg.norm(true)
                    e = points[m] - true
                    out = e @ true / r
                    along.append(out / c.range_sigma)
                    across.append((e @ e - out**2) / (c.bearing_sigma * r) ** 2)
                m += 1
    assert m == len(points)
    assert np.std(along) == pytest.approx(1.0, abs=0.03)
    assert np.mean(across) == pytest.approx(2.0, abs=0.06)


def test_network_is_consistent_at_the_truth(world: Laps) -> None:
    """χ² at the truth: what is measured, less what the landmarks take."""
    problem = world.problem()
    found = Network(WorkRanges(problem, Workers(1)), world.truth).objective
    freedom = problem.freedom + 6 * problem.poses
    assert found / freedom == pytest.approx(1.0, abs=4 * np.sqrt(2 / freedom))
    per = world.shared.shape[0]
    assert (problem.gps_pose % per < per // 2).all()
    assert len(problem.gps_pose) > CONFIG.poses // 12
    # six laps of one route, each a little beside the others
    lap = world.truth.position.reshape(6, per, 3)
    apart = np.linalg.norm(lap[1:] - lap[0], axis=2)
    assert 0.0 < apart.max() < 2.5


def test_a_seed_means_the_same_bytes(world: Laps) -> None:
    again, other = draw_laps(CONFIG, seed=2).problem(), draw_laps(CONFIG, seed=3).problem()
    mine = world.problem()
    for name in ("points", "landmark", "odometry_rotation", "gps_position", "up"):
        assert getattr(mine, name).tobytes() == getattr(again, name).tobytes()
    assert mine.points.tobytes() != other.points.tobytes()


def test_impossible_worlds_are_refused() -> None:
    for wrong in ({"poses": 10}, {"begin": 65}, {"reach": 0}):
        with pytest.raises(ConfigError, match="laps world"):
            LapsConfig(**wrong)
