"""Beams that met a floor or a ceiling are told from those that met a wall, and weighed another way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.random import SeedTree
from graphslam.evidence.likelihood import log_weights
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter import GridFilter
from graphslam_frontends.grid.upright import NEIGHBOURS, NORMAL_SIGMA, up_directions, upright_beams
from graphslam_frontends.odometry.steps import Steps
from tests.frontends.grid_world import ring


@pytest.fixture(scope="module")
def steps() -> Steps:
    return ring(3, 3, length=6.0, beams=600)


def slow(steps: Steps) -> np.ndarray:
    """The same, point by point, every neighbour by all distances, the plane by singular values."""
    out = np.zeros(len(steps.points), dtype=bool)
    assert steps.tilt is not None
    for k in range(len(steps)):
        rows = np.arange(steps.offsets[k], steps.offsets[k + 1])
        rows = rows[steps.returns[rows]]
        roll, pitch = steps.tilt[k]
        up = np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
        for r in rows:
            distance = np.linalg.norm(steps.points[rows] - steps.points[r], axis=1)
            near = steps.points[rows[np.argsort(distance, kind="stable")[:NEIGHBOURS]]]
            _, s, axes = np.linalg.svd(near - near.mean(axis=0))
            lies = np.degrees(np.arccos(min(abs(axes[2] @ up), 1.0))) <= 45.0
            out[r] = not (lies and s[2] ** 2 <= NEIGHBOURS * NORMAL_SIGMA**2 * s[1] ** 2)
    return out


def test_flags_are_those_of_a_slow_twin(steps: Steps) -> None:
    found, wanted = upright_beams(steps), slow(steps)
    assert np.mean(found != wanted) < 1e-3  # ties of distances and of angles
    assert 0.2 < found[steps.returns].mean() < 0.8


def test_floors_are_left_out_and_walls_are_not(steps: Steps) -> None:
    assert steps.truth is not None
    poses = steps.truth.interpolate(steps.times)
    step = np.repeat(np.arange(len(steps)), np.diff(steps.offsets))
    up = np.array([up_directions(steps.tilt)[k] for k in step])  # type: ignore[arg-type]
    heights = np.einsum("ki,ki->k", steps.points, up) + poses[step, 2]
    found = upright_beams(steps)
    lies = steps.returns & ((np.abs(heights + 0.07) < 0.1) | (np.abs(heights - 2.68) < 0.1))
    stands = steps.returns & (heights > 0.4) & (heights < 2.3)
    assert found[lies].mean() < 0.25
    assert found[stands].mean() > 0.75
    assert not found[~steps.returns].any()


def test_what_is_up_is_seen_from_a_tilted_body() -> None:
    from graphslam.core import se3

    tilt = np.array([[0.0, 0.0], [0.3, -0.2], [-0.1, 0.4]])
    poses = GridFilter(
        replace(ring(1, 3, length=1.0, beams=10), tilt_sigma=0.0), GridFilterConfig(particles=1), SeedTree(0)
    ).particles.poses
    from graphslam_frontends.grid.motion import with_roll_pitch

    for t, seen in zip(tilt, up_directions(tilt)):
        q = with_roll_pitch(poses, t[None])[0, 3:]
        assert se3.quat_rotate(q, seen) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)


def test_both_kinds_of_beams_are_added(steps: Steps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphslam_frontends.grid.filter.CAST_BEAMS", 25)
    config = GridFilterConfig(particles=4, likelihood="upright", weight_beams=40, young=3)
    filter = GridFilter(steps, config, SeedTree(1))
    for k in range(8):
        filter.step(k)
    filter.predict(8)
    (ends, by_ends), (casts, by_casts) = filter.weighed_beams(8)
    points, origins, returns = steps.scan(8)
    assert len(ends) == 40
    assert len(casts) == 25
    assert returns[ends].all()
    flags = upright_beams(steps)[steps.offsets[8] : steps.offsets[9]]
    assert flags[ends].all()
    assert not flags[casts].all()
    assert (by_ends.exponent, by_casts.exponent) == (1.0, pytest.approx(4 / 25))
    wanted = sum(
        log_weights(filter.particles.grids, filter.particles.poses, points[rows], how, origin=origins[rows],
                    max_range=steps.max_range, returns=returns[rows])
        for rows, how in ((ends, by_ends), (casts, by_casts))
    )  # fmt: skip
    assert filter.weigh(8) == pytest.approx(wanted, rel=1e-12)


def test_without_gravity_and_in_the_plane_end_points_of_all_are_weighed() -> None:
    config = GridFilterConfig(particles=2, likelihood="upright")
    for steps in (ring(3, 2, length=2.0, beams=60), replace(ring(3, 3, length=2.0, beams=60), tilt=None)):
        filter = GridFilter(steps, config, SeedTree(1))
        plain = GridFilter(steps, replace(config, likelihood="endpoint"), SeedTree(1))
        for k in range(len(steps)):
            filter.step(k)
            plain.step(k)
        assert filter.particles.poses.tobytes() == plain.particles.poses.tobytes()


def test_impossible_settings_are_named() -> None:
    with pytest.raises(ConfigError, match="weight_beams"):
        GridFilterConfig(weight_beams=0)
    with pytest.raises(ConfigError, match="upright"):
        GridFilterConfig(likelihood="lying")  # type: ignore[arg-type]
