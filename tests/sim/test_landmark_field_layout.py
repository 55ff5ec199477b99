"""The landmark field: routes and where its features stand, as stated."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from graphslam.core.geometry import wrap_angle
from graphslam.sim.landmark_field import (
    PRESETS,
    landmark_layout,
)
from graphslam.sim.vehicle import follow_route, offset_from_route, wavy_loop
from tests.reference.route import follow_route_slowly
from tests.sim.normality import P_VALUE, assert_normal

QUICK = PRESETS["quick"]


@pytest.mark.parametrize("look_ahead", [2.0, 6.0])
def test_route_follower_equals_its_slow_twin(look_ahead: float) -> None:
    route = wavy_loop(90.0, 3, 0.2)
    limits = {"max_steering": math.radians(20), "steering_rate": math.radians(15)}
    args = {"speed": 3.0, "dt": 1 / 40, "wheelbase": 4.0, "look_ahead": look_ahead, **limits}
    P, G = follow_route(route, 2500, **args)
    Q, H = follow_route_slowly(route, 2500, **args)
    assert np.abs(P[:, :2] - Q[:, :2]).max() < 1e-8
    assert np.abs(wrap_angle(P[:, 2] - Q[:, 2])).max() < 1e-8
    assert np.abs(G - H).max() < 1e-8
    assert np.abs(G).max() <= limits["max_steering"]
    assert np.abs(np.diff(G)).max() <= limits["steering_rate"] / 40 + 1e-12
    assert np.abs(G).max() == pytest.approx(limits["max_steering"])  # the limit is reached, so it is tested


def test_wavy_loop_is_closed_even_and_of_the_stated_length() -> None:
    r = wavy_loop(500.0, 5, 0.1)
    step = np.linalg.norm(np.diff(np.vstack([r, r[:1]]), axis=0), axis=1)
    assert step.sum() == pytest.approx(500.0, abs=1e-3)
    assert step.max() < 1.001 * step.min()
    assert np.allclose(r[0], 0.0, atol=1e-9)
    assert abs(math.atan2(*(r[1] - r[0])[::-1])) < 0.01  # starts along x
    circle = wavy_loop(2 * math.pi * 10, 0, 0.5)
    assert np.allclose(np.linalg.norm(circle - circle.mean(0), axis=1), 10.0, atol=1e-3)


def test_offset_from_route_is_to_the_left() -> None:
    route = wavy_loop(2 * math.pi * 100, 0, 0.0)  # counter-clockwise circle about (0, 100)
    p = offset_from_route(route, np.array([0.0, 50.0, 700.0]), np.array([10.0, 10.0, -10.0]))
    assert np.allclose(np.hypot(p[:, 0], p[:, 1] - 100.0), [90.0, 90.0, 110.0], atol=1e-2)


def test_features_lie_in_the_lateral_band() -> None:
    route, features = landmark_layout(PRESETS["A"], 0)
    d = np.min(np.linalg.norm(features[:, None] - route[None, ::5], axis=2), axis=1)
    assert d.min() > 2.8
    assert d.max() < 20.1
    assert np.mean(d) == pytest.approx(11.5, abs=5 * 17 / math.sqrt(12 * 554))


def test_pairs_stand_at_the_stated_distance_and_never_nearer_to_the_road() -> None:
    c = dataclasses.replace(PRESETS["pairs"], pair_fraction=0.6, pair_distance=2.0)
    route, p = landmark_layout(c, 3)
    _, plain = landmark_layout(dataclasses.replace(c, pair_fraction=0.0), 3)
    n = 2 * (int(0.6 * 150) // 2)
    assert np.allclose(np.linalg.norm(p[0:n:2] - p[1:n:2], axis=1), 2.0, atol=1e-9)
    assert np.array_equal(p[n:], plain[n:])  # the rest stays where it was
    assert np.array_equal(p[0:n:2], plain[0:n:2])
    assert not np.any(np.all(p[1:n:2] == plain[1:n:2], axis=1))
    d = np.min(np.linalg.norm(p[:, None] - route[None, ::3], axis=2), axis=1)
    assert d.min() > c.lateral_min - 0.2
    away = np.arctan2(*(p[1:n:2] - p[0:n:2]).T[::-1])
    assert stats.kstest(away / (2 * np.pi) + 0.5, "uniform").pvalue > P_VALUE  # the road has every direction


def test_rows_are_regular_along_the_route_on_both_sides() -> None:
    c = dataclasses.replace(PRESETS["rows"], row_jitter=0.0, row_spacing=7.0, row_lateral=5.0)
    route, p = landmark_layout(c, 3)
    rows = p[c.landmarks :].reshape(2, c.row_periods, 2)
    assert c.row_periods == 86
    assert c.features == 30 + 172 == len(p)
    far = np.linalg.norm(rows[:, :, None] - route[None, None], axis=3)
    assert np.allclose(far.min(axis=2), 5.0, atol=0.1)
    s = 0.1 * np.argmin(far, axis=2)  # arc length of the nearest point
    assert np.allclose(np.diff(s, axis=1), 600 / 86, atol=0.5)
    assert np.allclose(np.linalg.norm(rows[0] - rows[1], axis=1), 10.0, atol=1e-6)  # opposite each other
    jittered = landmark_layout(dataclasses.replace(c, row_jitter=0.3), 3)[1][c.landmarks :] - p[c.landmarks :]
    assert_normal(jittered.ravel(), 0.3, "row jitter")
    assert np.array_equal(p[:30], landmark_layout(dataclasses.replace(c, row_spacing=0.0), 3)[1])


def test_a_map_of_a_row_shifted_by_one_period_looks_the_same() -> None:
    """What makes it hard: a row shifted along the route has its trees near trees again, the scattered have not."""
    route, p = landmark_layout(PRESETS["rows"], 0)
    forward = offset_from_route(route, np.arange(0.0, 600.0, 4.0) + 4.0, np.zeros(150))
    here = offset_from_route(route, np.arange(0.0, 600.0, 4.0), np.zeros(150))
    left, scattered = p[30:180], p[:30]

    def shifted(points: np.ndarray) -> np.ndarray:
        nearest = np.argmin(np.linalg.norm(points[:, None] - here[None], axis=2), axis=1)
        return points + forward[nearest] - here[nearest]

    gap = np.min(np.linalg.norm(shifted(left)[:, None] - left[None], axis=2), axis=1)
    assert np.quantile(gap, 0.9) < 1.0  # a quarter of the spacing
    alone = np.min(np.linalg.norm(shifted(scattered)[:, None] - scattered[None], axis=2), axis=1)
    assert np.median(alone) > 2.0
