"""Trajectories: interpolation of positions, headings and covariances; what they refuse."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import se2_compose, se2_exp
from graphslam.core.trajectory import Trajectory
from tests.reference.groups import SE2, SE3


def test_interpolation_follows_the_arc_not_the_chord() -> None:
    # a quarter of a circle of radius 1: the middle lies on the circle
    t = Trajectory([0.0, 2.0], [[0.0, 0.0, 0.0], [1.0, 1.0, np.pi / 2]])
    middle = t.interpolate(1.0)[0]
    assert np.allclose(middle, [np.sin(np.pi / 4), 1 - np.cos(np.pi / 4), np.pi / 4], atol=1e-12)


def test_heading_interpolates_the_short_way_over_the_cut() -> None:
    t = Trajectory([0.0, 1.0], [[0.0, 0.0, np.pi - 0.1], [0.0, 0.0, -np.pi + 0.3]])
    assert SE2.difference(t.interpolate(0.5)[0], np.array([0.0, 0.0, -np.pi + 0.1])) < 1e-12


@pytest.mark.parametrize("dim", [2, 3])
def test_interpolation_is_exact_for_constant_velocity(dim: int, rng: np.random.Generator) -> None:
    group, exp = (SE2, se2_exp) if dim == 2 else (SE3, se3.se3_exp)
    xi = rng.normal(size=group.dim) * 0.2
    times = np.array([0.0, 0.5, 1.7, 3.0])
    t = Trajectory(times, exp(times[:, None] * xi))
    q = np.array([0.0, 0.2, 1.0, 1.7, 2.9, 3.0])
    assert group.difference(t.interpolate(q), exp(q[:, None] * xi)) < 1e-12


def test_interpolation_at_the_stamps_returns_the_poses(rng: np.random.Generator) -> None:
    poses = se2_exp(rng.normal(size=(6, 3)))
    t = Trajectory(np.arange(6.0), poses)
    assert np.allclose(t.interpolate(np.arange(6.0)), poses, atol=1e-12)


def test_covariances_interpolate_between_their_neighbours() -> None:
    C = np.stack([np.eye(3), 3 * np.eye(3)])
    t = Trajectory([0.0, 1.0], np.zeros((2, 3)), C)
    assert np.allclose(t.interpolate_covariance([0.0, 0.25, 1.0])[:, 0, 0], [1.0, 1.5, 3.0])
    with pytest.raises(DataError, match="no covariances"):
        Trajectory([0.0], np.zeros((1, 3))).interpolate_covariance(0.0)


def test_time_outside_is_refused_and_says_the_span() -> None:
    t = Trajectory([1.0, 2.0], np.zeros((2, 3)))
    for q in (0.999, 2.001, np.nan):
        with pytest.raises(DataError, match=r"\[1\.000, 2\.000\]"):
            t.interpolate(q)
    with pytest.raises(DataError, match="empty trajectory"):
        Trajectory(np.zeros(0), np.zeros((0, 3))).interpolate(0.0)


def test_gap_is_refused_only_inside_it() -> None:
    t = Trajectory([0.0, 1.0, 5.0], np.zeros((3, 3)))
    t.interpolate([0.5, 1.0, 5.0], max_gap=2.0)
    with pytest.raises(DataError, match="gap"):
        t.interpolate(3.0, max_gap=2.0)


def test_a_single_pose_is_a_trajectory() -> None:
    t = Trajectory([1.0], [[1.0, 2.0, 3.0]])
    assert np.allclose(t.interpolate(1.0), [[1.0, 2.0, 3.0]])
    assert t.length() == 0.0


@pytest.mark.parametrize(
    ("times", "poses", "kind", "what"),
    [
        ([0.0, 0.0], np.zeros((2, 3)), DataError, "does not increase"),
        ([1.0, 0.0], np.zeros((2, 3)), DataError, "does not increase"),
        ([0.0], np.zeros((2, 3)), DataError, "stamps"),
        ([0.0, 1.0], np.zeros((2, 4)), GeometryError, "wrong shape"),
        ([0.0, 1.0], [[0, 0, 0], [0, np.nan, 0]], GeometryError, "pose 1 is not finite"),
    ],
)
def test_bad_trajectory_is_refused(times: list, poses: np.ndarray, kind: type, what: str) -> None:
    with pytest.raises(kind, match=what):
        Trajectory(times, poses)


def test_covariances_of_the_wrong_shape_are_refused() -> None:
    with pytest.raises(GeometryError, match="covariances"):
        Trajectory([0.0], np.zeros((1, 3)), np.eye(3))
    with pytest.raises(GeometryError, match="covariance 0 is not finite"):
        Trajectory([0.0], np.zeros((1, 3)), np.full((1, 3, 3), np.nan))


def test_points_transformed_and_length() -> None:
    t = Trajectory([0.0, 1.0], [[0.0, 0.0, 0.0], [3.0, 4.0, np.pi / 2]])
    assert np.allclose(t.points([1.0, 0.0]), [[1.0, 0.0], [3.0, 5.0]])
    assert t.length() == 5.0
    T = np.array([1.0, 1.0, np.pi])
    assert np.allclose(t.transformed(T).poses, se2_compose(T, t.poses))
    assert t.transformed(T).length() == pytest.approx(5.0)
