"""Shapes of points in the plane: neighbours on two walls make no line, and a corridor is not held by their pattern."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.registration.register import register
from graphslam.registration.target import Target

WIDTH, REACH = 2.4, 8.0


def corridor_scan(x: float, rng: np.random.Generator, beams: int = 181) -> np.ndarray:
    """End points of a laser in the middle of an endless corridor; ``x`` changes nothing but the noise."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, beams)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (0.5 * WIDTH) / np.abs(np.sin(angle))
    r = r + 0.01 * rng.standard_normal(len(r))
    keep = r < REACH
    return np.column_stack([r[keep] * np.cos(angle[keep]), r[keep] * np.sin(angle[keep])])


def test_neighbours_on_two_walls_make_no_line() -> None:
    scan = corridor_scan(0.0, np.random.default_rng(0))
    normals, noise = Target(scan).normals(np.arange(len(scan)))
    known = np.linalg.norm(normals, axis=1) > 0.5
    assert known.mean() > 0.9
    across = np.abs(normals[known, 1])
    assert np.all(across > np.cos(np.deg2rad(30.0)))  # of a wall, not of a line from wall to wall
    assert np.all(np.isfinite(noise))


@pytest.mark.parametrize("start", [0.0, 0.16, 0.4])
def test_a_corridor_without_ends_leaves_the_way_along_it_open(start: float) -> None:
    """The pattern of the beams moves along with the robot: it must not tell that nothing moved."""
    rng = np.random.default_rng(1)
    found = register(Target(corridor_scan(0.0, rng)), Target(corridor_scan(0.0, rng)), np.array([start, 0.0, 0.0]))
    along, side = np.sqrt(np.diag(found.covariance))[:2]
    assert along > 5.0 * side
    assert abs(found.T_target_source[0] - start) < 3.0 * along
    assert abs(found.T_target_source[1]) < 0.02


def test_a_point_of_a_dense_wall_keeps_its_line() -> None:
    rng = np.random.default_rng(2)
    x = np.linspace(0.0, 5.0, 200)
    wall = np.column_stack([x, 0.01 * rng.standard_normal(len(x))])
    normals, _ = Target(wall).normals(np.arange(len(wall)))
    assert np.all(np.abs(normals[:, 1]) > np.cos(np.deg2rad(25.0)))
