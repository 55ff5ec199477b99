"""Everything that registration has to refuse in simulated halls, with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError, CovarianceError, DataError, GeometryError
from graphslam.core.gaussian import check_covariance
from graphslam.core.log import DropCounter
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.register import register, register_starts, tilt_angle
from graphslam.registration.search import offset_pose
from graphslam.registration.target import Target
from tests.reference.box_world import around, hall, heading
from tests.registration.halls import flat_scan, somewhere

IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])


OFFSET = np.array([0.02, -0.02, 0.08, 0.3, -0.2, 0.1])


def test_scan_of_another_place_is_refused(garage: tuple) -> None:
    _, _, target = garage
    other, rng = hall(cars=9, width=12.0, period=5.0), np.random.default_rng(8)
    for _ in range(4):
        T = heading(rng.uniform(10, 50), rng.uniform(5, 7), 1.2, rng.uniform(-3, 3))
        scan = other.scan(T, around(rng, 1500), 0.025, 25.0, rng)
        r = register(Target(scan, voxel=0.3), target, offset_pose(T, (0.0, 3.0, 0.0, 0.0)))
        assert not r.accepted
        assert "fitness" in r.why


def test_tilted_result_is_refused(garage: tuple) -> None:
    world, _, target = garage
    rng = np.random.default_rng(9)
    T = heading(30.0, 9.0, 1.2, 0.3, pitch=np.radians(7))
    source = Target(world.scan(T, around(rng, 2000), 0.025, 25.0, rng), voxel=0.3)
    r = register(source, target, T)
    assert tilt_angle(T) == pytest.approx(np.radians(7))
    assert r.tilt == pytest.approx(np.radians(7), abs=0.005)
    assert r.why == "tilt 7.0° > 4.0°"
    assert register(source, target, T, RegistrationConfig(gates=RegistrationGates(tilt=np.pi))).accepted


def test_known_space_counts_alone(garage: tuple) -> None:
    """A scan that reaches out of the map: refused on all its points, accepted on those in known space."""
    world, points, _ = garage
    rng = np.random.default_rng(10)
    target = Target(points[points[:, 0] < 30.0], voxel=0.3)
    T = heading(27.0, 9.0, 1.2, 0.0)
    source = Target(world.scan(T, around(rng, 3000), 0.025, 25.0, rng), voxel=0.3)
    blind = register(source, target, T)
    assert not blind.accepted
    assert blind.fitness < 0.75
    assert np.isnan(blind.fitness_known)
    config = RegistrationConfig(gates=RegistrationGates(fitness_upright=0.0))
    seen = register(source, target, T, config, known=lambda p: p[:, 0] < 30.0)
    assert seen.accepted, seen.why
    assert seen.fitness == blind.fitness
    inside = se3.se3_transform(seen.T_target_source, source.points)[:, 0] < 30.0
    assert seen.known_share == pytest.approx(np.mean(inside))
    assert seen.best_fitness == seen.fitness_known == pytest.approx(blind.fitness / seen.known_share, rel=0.05)
    mask = register(source, target, T, config, known=inside)
    assert mask.fitness_known == seen.fitness_known
    little = register(source, target, T, config, known=lambda p: p[:, 0] < 20.0)
    assert "share in known space" in little.why
    none = register(source, target, T, config, known=np.zeros(len(source), dtype=bool))
    assert none.fitness_known == 0.0
    with pytest.raises(DataError, match="mask"):
        register(source, target, T, known=np.ones(3, dtype=bool))
    with pytest.raises(DataError, match="answer"):
        register(source, target, T, known=lambda p: np.ones(3, dtype=bool))


@pytest.mark.parametrize("dim", [2, 3])
def test_what_cannot_be_matched_has_a_reason_and_no_covariance(dim: int, rng: np.random.Generator) -> None:
    T = np.zeros(3) if dim == 2 else IDENTITY
    cloud = rng.uniform(-5, 5, (300, dim))
    target = Target(cloud)
    cases = {
        "source has 0 points": (np.empty((0, dim)), target),
        "source has 1 points": (np.concatenate([cloud[:1], np.full((400, dim), np.nan)]), target),
        "target has 0 points": (cloud, Target(np.empty((0, dim)))),
        "target has 5 points": (cloud, Target(cloud[:5])),
        "no target point within 0.5 m": (cloud + 100.0, target),
    }
    for why, (source, to) in cases.items():
        r = register(source, to, T)
        assert r.why.startswith(why), r.why
        assert not r.converged
        assert not r.accepted
        assert np.array_equal(r.T_target_source, T)
        with pytest.raises(CovarianceError):
            check_covariance(r.covariance)
    lone = np.concatenate([cloud[:10], rng.uniform(100, 900, (300, dim))])
    r = register(lone, target, T)
    assert r.why.endswith("pairs left, fewer than 20")
    assert r.inliers == 10
    assert register_starts(lone, target, [T, T]) == []


@pytest.mark.parametrize("dim", [2, 3])
def test_result_far_from_the_start_is_refused(dim: int, garage: tuple, planar: tuple) -> None:
    rng = np.random.default_rng(0)
    if dim == 3:
        world, _, target = garage
        T = heading(30.0, 9.0, 1.2, 0.3)
        source, start = world.scan(T, around(rng, 1500), 0.025, 25.0, rng), offset_pose(T, (0.5, 0.0, 0.0, 0.05))
    else:
        world, target = planar
        T = np.array([30.0, 9.0, 0.3])
        source, start = flat_scan(world, T, 361, 0.025, rng), T + [0.5, 0.0, 0.05]
    assert register(source, target, start).accepted
    for config in (RegistrationConfig(max_shift=0.2), RegistrationConfig(max_turn=0.01)):
        r = register(source, target, start, config)
        assert not r.converged
        assert "from the start" in r.why
        assert np.array_equal(r.T_target_source, start)
        assert r.shift == pytest.approx(0.5, abs=0.1)


def test_points_that_are_not_finite_are_counted_and_change_nothing(garage: tuple) -> None:
    world, _, target = garage
    rng = np.random.default_rng(1)
    T = somewhere(rng)
    scan, drops = world.scan(T, around(rng, 1000), 0.025, 25.0, rng), DropCounter()
    dirty = np.insert(scan, [0, 50, 90], [np.nan, np.inf, 1e30], axis=0)
    prepared = Target(dirty, drops=drops)
    assert prepared.dropped == 3
    assert sum(drops.counts.values()) == 3
    clean, same = register(scan, target, T), register(dirty, target, T)
    assert np.array_equal(clean.T_target_source, same.T_target_source)
    assert np.array_equal(clean.covariance, same.covariance)
    assert clean.fitness == register(prepared, target, T).fitness


def test_impossible_arguments_are_refused(garage: tuple) -> None:
    _, points, target = garage
    few = points[:100]
    for start in (np.zeros(3), np.full(7, np.nan), np.zeros(7)):
        with pytest.raises(GeometryError):
            register(few, target, start)
    with pytest.raises(GeometryError, match="dimension"):
        register(few[:, :2], target, IDENTITY)
    with pytest.raises(GeometryError, match="shape"):
        Target(np.zeros((4, 5)))
    for options in ({"voxel": 0.0}, {"voxel": np.nan}, {"neighbours": 2}):
        with pytest.raises(ConfigError):
            Target(few, **options)
    for options in ({"near": 0.0}, {"radii": ()}, {"radii": (1.0, -1.0)}, {"max_shift": np.inf}, {"iterations": 0}):
        with pytest.raises(ConfigError):
            RegistrationConfig(**options)
    with pytest.raises(ConfigError, match="fitness"):
        RegistrationGates(fitness=-0.1)
