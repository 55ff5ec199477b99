"""Clouds matched in pairs: found where they are, with an honest covariance; refused where they are not."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.evidence.views import CloudView
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.submap_pairs import PreparedMap, contradiction_share, match_pair
from tests.reference.box_submaps import clouded, drifted, straight_path
from tests.reference.box_world import BoxWorld, hall, heading

CONFIG = PairConfig()
LOOSE = np.diag([0.02, 0.02, 0.08, 2.0, 2.0, 0.3]) ** 2
PLACE = heading(8.0, 0.0, 0.0, 0.1)


def prepared(world: BoxWorld, path: Array, rng: np.random.Generator, **how: object) -> PreparedMap:
    return PreparedMap(CloudView(clouded(world, path, rng, **how)), CONFIG)


@pytest.fixture(scope="module", params=[True, False], ids=["seen from places", "points alone"])
def pair(request: pytest.FixtureRequest) -> tuple[PreparedMap, PreparedMap, Array]:
    """A target and a source of one hall, and where the place truly lies.

    Points alone are matched only where all of them have a partner: that drive goes the same way, and sees the same.
    """
    world, rng = hall(cars=60), np.random.default_rng(5)
    there = straight_path(14.0, 44.0, 8.0)
    back = straight_path(40.0, 18.0, 10.0, yaw=np.pi) if request.param else straight_path(18.0, 40.0, 8.0)
    target, source = (prepared(world, path, rng, origins=request.param) for path in (there, back))
    return target, source, se3.se3_compose(se3.se3_between(there[0], back[0]), PLACE)


def test_the_right_place_is_found_and_its_alias_is_not(pair: tuple[PreparedMap, PreparedMap, Array]) -> None:
    target, source, T = pair
    m = match_pair(source, PLACE, target, se3.se3_compose(T, se3.se3_exp([0.0, 0, 0.1, 2.0, -1.0, 0.3])), LOOSE)
    assert m.accepted, m.why
    e = se3.se3_log(se3.se3_between(T, m.T_target_source))
    assert np.linalg.norm(e[3:]) < 0.08
    assert e @ np.linalg.solve(m.covariance, e) < chi2_quantile(0.999, 6)
    alias = T.copy()
    alias[0] += 8.0  # one pillar further
    near = np.diag([0.01, 0.01, 0.02, 0.4, 0.4, 0.1]) ** 2
    assert not match_pair(source, PLACE, target, alias, near).accepted
    both = match_pair(source, PLACE, target, alias, np.diag([0.02, 0.02, 0.05, 4.0, 1.0, 0.2]) ** 2)
    assert both.accepted, both.why
    assert np.linalg.norm((both.T_target_source - T)[:3]) < 0.1


def test_another_hall_is_refused(pair: tuple[PreparedMap, PreparedMap, Array]) -> None:
    target, *_ = pair
    other = hall(period=7.0, width=15.0, cars=3)
    source = prepared(other, straight_path(10.0, 30.0, 7.0), np.random.default_rng(2))
    wide = np.diag([0.02, 0.02, 0.1, 3, 3, 0.3]) ** 2
    assert not match_pair(source, PLACE, target, heading(10.0, 0.0, 0.0, 0.0), wide).accepted


def test_free_space_contradicts_only_where_it_is_known(pair: tuple[PreparedMap, PreparedMap, Array]) -> None:
    target, source, T = pair
    off = se3.se3_compose(T, se3.se3_exp([0.0, 0, 0, 2.0, 1.5, 0.0]))
    points = source.around(PLACE)
    right, wrong = (contradiction_share(source, PLACE, target, at, points) for at in (T, off))
    assert right < 0.02
    assert (wrong > 0.03) == target.view.knows_space


def test_covariance_is_consistent_for_clouds_that_are_bent_inside() -> None:
    """Monte Carlo: pairs of clouds of one place, each with drift of its own inside; NEES a degree of freedom.

    Of what drift bends: along, across and heading, without a direction that the match itself calls loose. The floors of
    5 cm and 10 mrad keep it on the safe side; twice or half the covariance would leave the bounds.
    """
    world = hall(cars=24)
    nees, dof = 0.0, 0
    for seed in range(10):
        rng = np.random.default_rng(200 + seed)
        there, back = straight_path(14.0, 40.0, 8.0, step=2.0), straight_path(38.0, 18.0, 10.0, yaw=np.pi, step=2.0)
        seen = [drifted(path, rng, 0.02, 2.5e-3) for path in (there, back)]
        target, source = (prepared(world, path, rng, believed=at) for path, at in zip((there, back), seen))
        k = 6
        place = se3.se3_between(seen[1][0], seen[1][k])
        near = int(np.argmin(np.linalg.norm(there[:, :3] - back[k, :3], axis=1)))
        T = se3.se3_compose(se3.se3_between(seen[0][0], seen[0][near]), se3.se3_between(there[near], back[k]))
        m = match_pair(source, place, target, se3.se3_compose(T, se3.se3_exp([0, 0, 0.05, 1.0, -1, 0.1])), LOOSE)
        assert m.accepted, m.why
        e = se3.se3_log(se3.se3_between(T, m.T_target_source))
        held = [2, 4] if m.loose else [2, 3, 4]
        nees += e[held] @ np.linalg.solve(m.covariance[np.ix_(held, held)], e[held])
        dof += len(held)
    assert 0.08 < nees / dof < 0.25
