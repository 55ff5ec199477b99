"""Submaps matched in pairs: the right place is found with an honest covariance, everything else is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, CovarianceError, GeometryError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.views import GridView
from graphslam.registration.pair_config import PairConfig
from graphslam.registration.submap_pairs import (
    PairMatch,
    PreparedMap,
    contradiction_share,
    half_widths,
    match_pair,
    prediction_chi2,
)
from tests.reference.box_submaps import drifted, mapped, straight_path
from tests.reference.box_world import corridor, hall, heading

CONFIG = PairConfig()
LOOSE = np.diag([0.02, 0.02, 0.08, 2.0, 2.0, 0.3]) ** 2


@pytest.fixture(scope="module")
def pair() -> tuple[PreparedMap, PreparedMap, Array, Array]:
    """A target and a source of one hall, driven through in opposite directions, and where they truly begin."""
    world, rng = hall(cars=60), np.random.default_rng(5)
    there, back = straight_path(14.0, 44.0, 8.0), straight_path(40.0, 18.0, 10.0, yaw=np.pi)
    return (
        PreparedMap(GridView(mapped(world, there, rng)), CONFIG),
        PreparedMap(GridView(mapped(world, back, rng)), CONFIG),
        there[0],
        back[0],
    )


def truth(pair: tuple[PreparedMap, PreparedMap, Array, Array], T_base_place: Array) -> Array:
    return se3.se3_compose(se3.se3_between(pair[2], pair[3]), T_base_place)


PLACE = heading(8.0, 0.0, 0.0, 0.1)


def test_the_right_place_is_found_from_metres_off(pair: tuple) -> None:
    target, source, *_ = pair
    T = truth(pair, PLACE)
    for offset in ([0.0, 0, 0.1, 2.0, -1.0, 0.3], [0.0, 0, -0.15, -3.0, 2.0, -0.2]):
        m = match_pair(source, PLACE, target, se3.se3_compose(T, se3.se3_exp(offset)), LOOSE)
        assert m.accepted, m.why
        e = se3.se3_log(se3.se3_between(T, m.T_target_source))
        assert np.linalg.norm(e[3:]) < 0.08
        assert np.linalg.norm(e[:3]) < 0.01
        assert e @ np.linalg.solve(m.covariance, e) < chi2_quantile(0.999, 6)
        assert m.contradiction < 0.03
        assert not m.loose
        assert m.gates()["fitness_known"] > 0.8
        sigma = np.sqrt(np.diag(m.covariance))
        assert 0.04 < sigma[3:].min() < sigma[3:].max() < 0.2


def test_what_the_prediction_contradicts_is_refused(pair: tuple) -> None:
    """The right place, but the graph is sure that it is not there."""
    target, source, *_ = pair
    T = truth(pair, PLACE)
    off = se3.se3_compose(T, se3.se3_exp([0.0, 0, 0, 1.0, 0.0, 0.0]))
    tight = np.diag([0.005, 0.005, 0.005, 0.05, 0.05, 0.05]) ** 2
    m = match_pair(source, PLACE, target, off, tight)
    assert not m.accepted
    assert m.why.startswith("prediction")
    assert m.chi2 > chi2_quantile(CONFIG.chi2_level, 6)
    wide = match_pair(source, PLACE, target, off, 400.0 * tight)
    assert wide.accepted
    assert wide.chi2 < m.chi2


def test_one_pillar_further_is_refused(pair: tuple) -> None:
    """Searched only where the alias is: it fits well, and is no match."""
    target, source, *_ = pair
    T = truth(pair, PLACE)
    alias = T.copy()
    alias[0] += 8.0
    near = np.diag([0.01, 0.01, 0.02, 0.4, 0.4, 0.1]) ** 2
    m = match_pair(source, PLACE, target, alias, near)
    assert not m.accepted
    # searched over both, the right one wins
    both = match_pair(source, PLACE, target, alias, np.diag([0.02, 0.02, 0.05, 4.0, 1.0, 0.2]) ** 2)
    assert both.accepted, both.why
    assert np.linalg.norm((both.T_target_source - T)[:3]) < 0.1


def test_another_hall_is_refused(pair: tuple) -> None:
    target, _, *_ = pair
    other = hall(period=7.0, width=15.0, cars=3)
    source = PreparedMap(GridView(mapped(other, straight_path(10.0, 30.0, 7.0), np.random.default_rng(2))), CONFIG)
    m = match_pair(source, PLACE, target, heading(10.0, 0.0, 0.0, 0.0), np.diag([0.02, 0.02, 0.1, 3, 3, 0.3]) ** 2)
    assert not m.accepted


def test_a_corridor_holds_all_but_one_direction() -> None:
    """Kept, and as uncertain along it as before; or refused, as one likes."""
    world, rng = corridor(), np.random.default_rng(3)
    there, back = straight_path(-12.0, 12.0, 0.0), straight_path(8.0, -8.0, 0.3, yaw=np.pi)
    target, source = (
        PreparedMap(GridView(mapped(world, there, rng)), CONFIG),
        PreparedMap(GridView(mapped(world, back, rng)), CONFIG),
    )
    place = heading(8.0, 0.0, 0.0, 0.0)
    T = se3.se3_compose(se3.se3_between(there[0], back[0]), place)
    P = np.diag([0.01, 0.01, 0.05, 1.0, 0.5, 0.2]) ** 2
    start = se3.se3_compose(T, se3.se3_exp([0, 0, 0.03, 0.5, 0.3, 0.1]))
    config = replace(CONFIG, radius=8.0)
    m = match_pair(source, place, target, start, P, config)
    assert m.accepted, m.why
    assert m.loose
    along, across = np.sqrt(m.covariance[3, 3]), np.sqrt(m.covariance[4, 4])
    assert along > 3.0 * np.sqrt(P[3, 3])
    assert across < 0.15
    e = se3.se3_log(se3.se3_between(T, m.T_target_source))
    assert abs(e[4]) < 0.1
    assert np.linalg.norm(e[:3]) < 0.02
    refused = match_pair(source, place, target, start, P, replace(config, loose=False))
    assert "degenerate" in refused.why


def test_covariance_is_consistent_for_maps_that_are_bent_inside() -> None:
    """Pairs of maps of one place, each with drift of its own inside: mean NEES of all, two-sided."""
    world = hall(cars=24)
    nees, accepted = [], 0
    for seed in range(5):
        rng = np.random.default_rng(100 + seed)
        there, back = straight_path(14.0, 40.0, 8.0, step=2.0), straight_path(38.0, 18.0, 10.0, yaw=np.pi, step=2.0)
        seen = drifted(there, rng), drifted(back, rng)
        target = PreparedMap(GridView(mapped(world, there, rng, believed=seen[0])), CONFIG)
        source = PreparedMap(GridView(mapped(world, back, rng, believed=seen[1])), CONFIG)
        k = 6
        place = se3.se3_between(seen[1][0], seen[1][k])
        # what is true near the place: seen from the pose of the target's path that is nearest
        near = int(np.argmin(np.linalg.norm(there[:, :3] - back[k, :3], axis=1)))
        T = se3.se3_compose(se3.se3_between(seen[0][0], seen[0][near]), se3.se3_between(there[near], back[k]))
        m = match_pair(source, place, target, se3.se3_compose(T, se3.se3_exp([0, 0, 0.05, 1.0, -1, 0.1])), LOOSE)
        if m.accepted:
            accepted += 1
            e = se3.se3_log(se3.se3_between(T, m.T_target_source))
            nees.append(e @ np.linalg.solve(m.covariance, e) / 6)
    assert accepted >= 4
    # On the safe side, by four: each map's drift inside may be all of the error, and level maps have next to none in
    # roll and pitch. Twenty degrees of freedom tell that from half and from twice the covariance.
    assert 0.125 < np.mean(nees) < 0.42


def test_in_the_plane() -> None:
    world, rng = hall(cars=24), np.random.default_rng(1)

    def flat(path: Array) -> EvidenceGrid:
        grid = EvidenceGrid(0.2, dim=2)
        base = path[0]
        for T in path:
            a = rng.uniform(-np.pi, np.pi, 361)
            points = world.scan(T, np.stack([np.cos(a), np.sin(a), 0 * a], 1), 0.025, 20.0, rng)
            at = se3.se3_between(base, T)
            grid.insert_scan(points[:, :2], pose=np.array([at[0], at[1], 2 * np.arctan2(at[5], at[6])]))
        return grid

    there, back = straight_path(14.0, 44.0, 8.0, 0.5), straight_path(40.0, 18.0, 10.0, 0.5, yaw=np.pi)
    target, source = PreparedMap(GridView(flat(there)), CONFIG), PreparedMap(GridView(flat(back)), CONFIG)
    place = np.array([8.0, 0.0, 0.0])
    T = np.array([40.0 - 8.0 - 14.0, 2.0, np.pi])
    m = match_pair(source, place, target, T + np.array([1.5, -1.0, 0.1]), np.diag([1.0, 1.0, 0.1]) ** 2)
    assert m.accepted, m.why
    assert np.hypot(*(m.T_target_source - T)[:2]) < 0.1
    assert math.isnan(m.gates()["fitness_upright"])


def test_contradiction_is_what_one_has_occupied_and_the_other_free(pair: tuple) -> None:
    target, source, *_ = pair
    T = truth(pair, PLACE)
    points = source.around(PLACE)
    right = contradiction_share(source, PLACE, target, T, points)
    shifted = T.copy()
    shifted[:2] += [2.0, 1.5]
    wrong = contradiction_share(source, PLACE, target, shifted, points)
    assert right < 0.02
    assert wrong > 0.03 > right
    empty = PreparedMap(GridView(EvidenceGrid(0.2)), CONFIG)
    assert contradiction_share(empty, PLACE, empty, T, np.zeros((0, 3))) == 0.0


def test_search_is_as_wide_as_the_prediction_allows() -> None:
    T = heading(0.0, 0.0, 0.0, np.pi / 2)  # its x lies along the target's y
    P = np.diag([0.01, 0.01, 0.1, 2.0, 1.0, 0.5]) ** 2
    assert half_widths(T, P, CONFIG) == pytest.approx([3.0, 6.0, 1.5, 0.3])
    assert half_widths(T, 1e-6 * P, CONFIG) == pytest.approx([1.5, 1.5, 0.8, 0.1])
    assert half_widths(T, 1e6 * P, CONFIG) == pytest.approx([30.0, 30.0, 3.0, math.pi])


def test_chi2_against_the_prediction_is_that_of_samples() -> None:
    """Match and prediction, each with its own error: 6 on average."""
    rng = np.random.default_rng(0)
    T = se3.se3_exp([0.1, -0.2, 0.9, 3.0, 1.0, 0.2])
    A, B = 0.02 * rng.standard_normal((6, 6)), 0.03 * rng.standard_normal((6, 6))
    P, C = A @ A.T + 1e-5 * np.eye(6), B @ B.T + 1e-5 * np.eye(6)
    L_p, L_c = np.linalg.cholesky(P), np.linalg.cholesky(C)
    D = []
    for _ in range(600):
        prior = se3.se3_compose(T, se3.se3_exp(L_p @ rng.standard_normal(6)))
        match = se3.se3_compose(T, se3.se3_exp(L_c @ rng.standard_normal(6)))
        D.append(prediction_chi2(match, C, prior, P))
    assert np.mean(D) == pytest.approx(6.0, abs=4 * math.sqrt(12 / 600))


def test_what_is_impossible_is_refused_by_name(pair: tuple) -> None:
    target, source, *_ = pair
    empty = PreparedMap(GridView(EvidenceGrid(0.2)), CONFIG)
    for m in (match_pair(empty, PLACE, target, PLACE, LOOSE), match_pair(source, PLACE, empty, PLACE, LOOSE)):
        assert not m.accepted
        assert m.why.startswith("nothing")
        assert np.isnan(m.covariance).all()
        assert isinstance(m, PairMatch)
    far = match_pair(source, heading(500.0, 0, 0, 0), target, PLACE, LOOSE)
    assert far.why.startswith("nothing: 0 points")
    with pytest.raises(CovarianceError):
        match_pair(source, PLACE, target, PLACE, -LOOSE)
    with pytest.raises(GeometryError):
        match_pair(source, PLACE, target, np.full(7, np.nan), LOOSE)
    with pytest.raises(GeometryError):
        match_pair(source, PLACE, target, np.zeros(3), np.eye(3))
    for bad in ({"radius": 0.0}, {"chi2_level": 1.0}, {"least": (0.0, 1.0, 1.0)}, {"sigmas": math.nan}):
        with pytest.raises(ConfigError):
            PairConfig(**bad)
