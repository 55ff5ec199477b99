"""Registration in simulated halls: right results and honest covariances."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array
from graphslam.registration.config import RegistrationConfig
from graphslam.registration.planar import linearise_alignment
from graphslam.registration.register import register, register_starts
from graphslam.registration.search import correlative_search, offset_pose
from graphslam.registration.search_field import SearchField
from graphslam.registration.target import Target
from tests.reference.box_world import around, hall, survey
from tests.reference.slow_registration import gicp_hessian, planar_error
from tests.registration.halls import along, error2, error3, flat_map, flat_scan, somewhere

IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])
OFFSET = np.array([0.02, -0.02, 0.08, 0.3, -0.2, 0.1])


@pytest.mark.parametrize("seed", range(3))
def test_scan_is_placed_in_the_map_and_the_map_in_the_scan(garage: tuple, seed: int) -> None:
    world, _, target = garage
    rng = np.random.default_rng(seed)
    T = somewhere(rng)
    source = Target(world.scan(T, around(rng, 2000), 0.025, 25.0, rng), voxel=0.3)
    r = register(source, target, se3.se3_compose(T, se3.se3_exp(OFFSET)))
    assert r.accepted, r.why
    assert r.converged
    e = error3(r, T)
    assert np.linalg.norm(e[3:]) < 0.03
    assert np.linalg.norm(e[:3]) < 0.003
    assert r.fitness > 0.9
    assert 0.0 < r.rmse < 0.2
    assert r.tilt < 0.003
    assert r.shift == pytest.approx(np.linalg.norm(OFFSET[3:]), abs=0.05)
    assert r.turn == pytest.approx(np.linalg.norm(OFFSET[:3]), abs=0.01)
    check_covariance(r.covariance, dim=6)
    # shifted and turned with the whole map: the same result there
    S = se3.se3_exp(np.array([0.0, 0.0, 0.7, 5.0, -3.0, 0.5]))
    there = Target(se3.se3_transform(S, target.points))
    moved = register(source, there, se3.se3_compose(S, se3.se3_compose(T, se3.se3_exp(OFFSET))))
    np.testing.assert_allclose(error3(moved, se3.se3_compose(S, r.T_target_source)), 0.0, atol=2e-3)
    assert moved.fitness == pytest.approx(r.fitness, abs=0.01)
    # the inverse problem: the part of the map that is in sight, in the scan
    inside = np.linalg.norm(target.points - T[:3], axis=1) < 15.0
    back = register(Target(target.points[inside]), source, se3.se3_inverse(se3.se3_compose(T, se3.se3_exp(OFFSET))))
    assert np.linalg.norm(error3(back, se3.se3_inverse(T))[3:]) < 0.1


def test_planar_scan_is_placed_in_the_map(planar: tuple) -> None:
    world, target = planar
    rng = np.random.default_rng(0)
    for _ in range(6):
        T = np.array([rng.uniform(8, 52), rng.uniform(7, 11), rng.uniform(-3, 3)])
        r = register(flat_scan(world, T, 361, 0.025, rng), target, se2.se2_compose(T, [0.3, -0.2, 0.06]))
        assert r.accepted, r.why
        e = error2(r, T)
        assert np.hypot(e[0], e[1]) < 0.04
        assert abs(e[2]) < 0.004
        assert r.tilt == 0.0
        assert np.isnan(r.fitness_upright)
        check_covariance(r.covariance, dim=3)


def test_hessian_is_the_sum_of_the_factors_where_it_ended(garage: tuple) -> None:
    """Of the last step's start, which lies within a step of the end."""
    world, _, target = garage
    rng = np.random.default_rng(4)
    T = somewhere(rng)
    source = Target(world.scan(T, around(rng, 800), 0.025, 25.0, rng), voxel=0.3)
    from graphslam.registration.register import _align

    found = _align(source, target, T, RegistrationConfig())
    H, pairs = gicp_hessian(source, target, found.T, 0.5)
    assert abs(found.pairs - pairs) <= 2
    np.testing.assert_allclose(found.hessian, H, atol=0.02 * np.abs(H).max(), rtol=0.05)


def test_planar_gradient_and_hessian_are_those_of_finite_differences(planar: tuple) -> None:
    world, target = planar
    rng = np.random.default_rng(4)
    T = np.array([20.0, 9.0, 0.4])
    source = Target(flat_scan(world, T, 60, 0.025, rng))
    at = se2.se2_compose(T, [0.1, -0.05, 0.02])
    H, b, half, pairs = linearise_alignment(source, target, at, 1.0)
    assert pairs > 40

    def error(xi: Array) -> float:
        return planar_error(source, target, se2.se2_compose(at, se2.se2_exp(xi)), 1.0, at)

    assert half == pytest.approx(error(np.zeros(3)), rel=1e-9)
    h, axes = 1e-4, np.eye(3)
    numeric = np.array([(error(h * a) - error(-h * a)) / (2 * h) for a in axes])
    np.testing.assert_allclose(b, numeric, rtol=1e-5, atol=1e-6 * np.abs(b).max())
    # in translation the error is a square, so that the second difference is the Hessian itself
    for i in range(2):
        for j in range(2):
            d, f = h * axes[i], h * axes[j]
            second = (error(d + f) - error(d - f) - error(f - d) + error(-d - f)) / (4 * h * h)
            assert H[i, j] == pytest.approx(second, rel=1e-4, abs=1e-3 * np.abs(H[:2, :2]).max())
    step = -np.linalg.solve(H, b)
    assert error(step) < half


def nees(errors: list[Array], covariances: list[Array]) -> Array:
    e, P = np.array(errors), np.array(covariances)
    return np.einsum("ni,ni->n", e, np.linalg.solve(P, e[..., None])[..., 0]) / e.shape[1]


def test_covariance_of_a_match_to_a_perfect_map_is_calibrated() -> None:
    """No floor, a map of noisy points at true poses: NEES per degree of freedom about 1, not far on either side."""
    world, rng, errors, covariances = hall(cars=24), np.random.default_rng(1), [], []
    config = RegistrationConfig(floor_sigma=1e-6, floor_turn=1e-7)
    for k in range(36):
        if k % 12 == 0:
            target = Target(survey(world, along(rng), 3000, 0.025, 25.0, rng), voxel=0.3)
        T = somewhere(rng)
        source = Target(world.scan(T, around(rng, 1500), 0.025, 25.0, rng), voxel=0.3)
        r = register(source, target, se3.se3_compose(T, se3.se3_exp(0.3 * rng.standard_normal(6) * OFFSET)), config)
        if r.accepted:
            errors.append(error3(r, T))
            covariances.append(r.covariance)
    assert len(errors) >= 34
    n = nees(errors, covariances)
    assert 0.4 < np.mean(n) < 1.4
    assert np.mean(n < 2.1) > 0.85  # 95 % of a χ² of six, over six, lie below


def test_default_covariance_is_consistent_where_the_map_is_2_cm_and_2_mrad_wrong() -> None:
    world, rng, errors, covariances = hall(cars=24), np.random.default_rng(2), [], []
    for k in range(30):
        if k % 5 == 0:
            points = []
            for pose in along(rng):
                wrong = se3.se3_compose(pose, se3.se3_exp(rng.standard_normal(6) * [*[0.002] * 3, *[0.02] * 3]))
                points.append(se3.se3_transform(wrong, world.scan(pose, around(rng, 3000), 0.025, 25.0, rng)))
            target = Target(np.concatenate(points), voxel=0.3)
        T = somewhere(rng)
        source = Target(world.scan(T, around(rng, 1500), 0.025, 25.0, rng), voxel=0.3)
        r = register(source, target, se3.se3_compose(T, se3.se3_exp(0.3 * rng.standard_normal(6) * OFFSET)))
        if r.accepted:
            errors.append(error3(r, T))
            covariances.append(r.covariance)
    assert len(errors) >= 28
    assert 0.3 < np.mean(nees(errors, covariances)) < 1.3


@pytest.mark.parametrize(("jitter", "low", "high"), [(0.0, 0.15, 0.6), (0.02, 0.4, 1.5)])
def test_planar_covariance_is_consistent(jitter: float, low: float, high: float) -> None:
    world, rng, errors, covariances = hall(cars=24), np.random.default_rng(3), [], []
    for k in range(60):
        if k % (6 if jitter else 20) == 0:
            target = flat_map(world, rng, jitter)
        T = np.array([rng.uniform(8, 52), rng.uniform(7, 11), rng.uniform(-3, 3)])
        r = register(flat_scan(world, T, 181, 0.025, rng), target, T + rng.standard_normal(3) * [0.1, 0.1, 0.02])
        if r.accepted:
            errors.append(error2(r, T))
            covariances.append(r.covariance)
    assert len(errors) >= 57
    assert low < np.mean(nees(errors, covariances)) < high


def test_capture_radius(garage: tuple) -> None:
    """What the docstring says: 1 m and 10° are corrected, 4 m are not."""
    world, _, target = garage
    rng = np.random.default_rng(6)
    config = RegistrationConfig(max_shift=20.0, max_turn=2.0)
    right = {1.0: 0, 4.0: 0}
    for distance in right:
        for _ in range(12):
            T = somewhere(rng)
            source = Target(world.scan(T, around(rng, 1500), 0.025, 25.0, rng), voxel=0.3)
            side = rng.choice([-1.0, 1.0], 2)
            start = offset_pose(T, (side[0] * distance, 0.0, 0.0, side[1] * np.radians(10)))
            e = error3(register(source, target, start, config), T)
            right[distance] += bool(np.linalg.norm(e[3:]) < 0.3 and np.linalg.norm(e[:3]) < np.radians(2))
    assert right[1.0] >= 11
    assert right[4.0] <= 3


def test_search_and_registration_find_the_place_and_refuse_its_aliases(garage: tuple) -> None:
    """From 8 m off, where no iterative matcher gets home: search, match every mode, take the best of what passes."""
    world, points, target = garage
    field = SearchField(points)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        T = somewhere(rng)
        scan = world.scan(T, around(rng, 1500), 0.025, 25.0, rng)
        start = offset_pose(T, (rng.choice([-8.0, 8.0]), 2.0, 0.3, 0.15))
        starts = correlative_search(scan, field, start, (12.0, 12.0, 0.8, 0.3), (0.4, 0.4, 0.4, 0.0))
        results = register_starts(Target(scan, voxel=0.3), target, [s.T for s in starts])
        assert np.linalg.norm(error3(results[0], T)[3:]) < 0.05
        assert results[0].accepted, results[0].why
        assert np.all(np.diff([r.best_fitness for r in results]) <= 0)
        for r in results[1:]:
            assert not r.accepted, (r.fitness, r.fitness_upright, r.degeneracy)
        lone = register(scan, target, start)
        assert not lone.accepted or np.linalg.norm(error3(lone, T)[3:]) < 0.1


def test_starts_that_end_in_one_place_are_one_result(garage: tuple) -> None:
    world, _, target = garage
    rng = np.random.default_rng(3)
    T = somewhere(rng)
    source = Target(world.scan(T, around(rng, 1500), 0.025, 25.0, rng), voxel=0.3)
    same = register_starts(source, target, [T, offset_pose(T, (0.2, 0.1, 0.0, 0.02))])
    assert len(same) == 1
    both = register_starts(source, target, [offset_pose(T, (8.0, 0.0, 0.0, 0.0)), T])
    assert len(both) == 2
    assert np.linalg.norm(error3(both[0], T)[3:]) < 0.05


def test_copy_of_the_target_is_matched_with_the_floor_as_its_covariance(garage: tuple) -> None:
    """No noise at all in the pairs must not make the covariance singular."""
    _, _, target = garage
    r = register(target.points[:4000], target, IDENTITY)
    assert np.allclose(r.T_target_source, IDENTITY, atol=1e-6)
    check_covariance(r.covariance)
    assert np.sqrt(np.diag(r.covariance)[3:]).max() < 0.02
