"""The correlative search against slow twins, in places that repeat themselves, and with bad input."""

from __future__ import annotations

import time

import numpy as np
import pytest

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.points import evenly_spaced, transform_points, voxel_downsample
from graphslam.registration.search import SearchConfig, correlative_search, make_lattice, offset_pose, score_lattice
from graphslam.registration.search_field import SearchField
from graphslam.registration.search_kernels import local_maxima
from tests.reference.box_world import BoxWorld, around, hall, heading, survey
from tests.reference.slow_registration import slow_field, slow_maxima, slow_scores

UNREFINED = SearchConfig(refine=False)


def map_of(world: BoxWorld, rng: np.random.Generator) -> Array:
    poses = [heading(x, rng.uniform(7, 11), 1.2, rng.uniform(-0.3, 0.3)) for x in np.arange(3.0, 58.0, 3.0)]
    return survey(world, np.array(poses), 1500, 0.025, 25.0, rng)


@pytest.fixture(scope="module")
def pillars() -> tuple[BoxWorld, SearchField]:
    world = hall()
    return world, SearchField(map_of(world, np.random.default_rng(5)))


@pytest.fixture(scope="module")
def coarse() -> SearchField:
    """Of the same map, with cells and σ of twice the size."""
    return SearchField(map_of(hall(), np.random.default_rng(5)), cell=0.4, sigma=0.6)


def value_at(field: SearchField, points: np.ndarray) -> np.ndarray:
    """The field, 0 … 1, at points ``(m, dim)`` in the frame of the map; 0 outside it."""
    c = field._cells(points)
    inside = np.all((c >= 0) & (c < field.values.shape[::-1]), axis=1)
    out = np.zeros(len(c))
    out[inside] = field.values[tuple(c[inside].T[::-1])] / 255.0
    return out


@pytest.mark.parametrize("dim", [2, 3])
def test_field_is_the_distance_to_the_nearest_occupied_cell(dim: int, rng: np.random.Generator) -> None:
    points = rng.uniform(-1.0, 1.3, (12, dim))
    field = SearchField(points, cell=0.25, sigma=0.3)
    assert field.dim == dim
    assert field.values.shape[0] == (1 if dim == 2 else field.values.shape[0])
    expected = slow_field(points, field._low, field.values.shape, 0.25, 0.3)
    assert np.array_equal(field.values, expected)
    assert 0 < np.mean(field.values > 0) < 1


@pytest.mark.parametrize("steps", [(0.2, 0.2, 0.2, 0.11), (0.4, 0.4, 0.4, 0.07), (0.4, 0.2, 0.6, 0.2)])
def test_scores_are_those_of_the_plain_exhaustive_search(steps: tuple[float, ...], rng: np.random.Generator) -> None:
    field = SearchField(rng.uniform(-2, 2, (60, 3)), cell=0.2, sigma=0.3)
    points = rng.uniform(-2.5, 2.5, (25, 3))  # some fall out of the field
    T = offset_pose(se3.se3_exp(np.r_[0.1, -0.2, 0.5, 0.3, -0.2, 0.1]), (0.0, 0.0, 0.0, 0.0))
    lattice = make_lattice(field, (1.2, 0.9, 0.6, 0.25), steps, 2.0)
    scores = score_lattice(points, field, T, lattice)
    expected = slow_scores(points, field, T, (lattice.x, lattice.y, lattice.z, lattice.yaw))
    assert np.array_equal(scores, expected)
    assert len(np.unique(scores)) > 50


def test_scores_in_the_plane_are_those_of_the_plain_exhaustive_search(rng: np.random.Generator) -> None:
    field = SearchField(rng.uniform(-2, 2, (40, 2)), cell=0.1, sigma=0.2)
    points, T = rng.uniform(-2.5, 2.5, (30, 2)), np.array([0.3, -0.2, 2.9])
    lattice = make_lattice(field, (1.0, 0.6, 0.6), (0.2, 0.1, 0.15), 2.0)
    expected = slow_scores(points, field, T, (lattice.x, lattice.y, lattice.z, lattice.yaw))
    assert np.array_equal(score_lattice(points, field, T, lattice), expected)


def test_more_points_than_a_block_do_not_overflow(rng: np.random.Generator) -> None:
    """All of 700 points on occupied cells: the greatest sum there is."""
    field = SearchField(np.array([[0.1, 0.1, 0.1]]), cell=0.2, sigma=0.3)
    points = np.full((700, 3), 0.1)
    lattice = make_lattice(field, (0.4, 0.4, 0.0, 0.0), (0.2, 0.2, 0.2, 0.1), 1.0)
    scores = score_lattice(points, field, np.array([0.0, 0, 0, 0, 0, 0, 1]), lattice)
    assert scores.max() == scores[0, 0, 2, 2] == 700 * 255


def test_maxima_are_those_of_a_look_at_all_neighbours(rng: np.random.Generator) -> None:
    for _ in range(5):
        w = rng.integers(0, 6, (3, 4, 5, 6)).astype(np.float32)  # many ties
        w[rng.random(w.shape) < 0.2] = -np.inf
        assert [tuple(int(c) for c in m) for m in local_maxima(w)] == slow_maxima(w)


def test_best_start_is_the_best_of_the_plain_exhaustive_search(rng: np.random.Generator) -> None:
    """Modes: the lattice's best, then the best local maximum that is not near it, and so on."""
    field = SearchField(rng.uniform(-3, 3, (80, 3)), cell=0.2, sigma=0.3)
    points, T = rng.uniform(-2, 2, (20, 3)), np.array([0.2, 0.1, -0.1, 0, 0, 0, 1.0])
    half, steps = (2.0, 2.0, 0.4, 0.3), (0.4, 0.4, 0.4, 0.1)
    config = SearchConfig(refine=False, apart=1.0, turned=0.15)
    starts = correlative_search(points, field, T, half, steps, 4, config=config)
    lattice = make_lattice(field, half, steps, 1.0)
    p = voxel_downsample(points, 0.2)
    scores = slow_scores(p, field, T, (lattice.x, lattice.y, lattice.z, lattice.yaw)) / (255.0 * len(p))
    left = sorted(slow_maxima(scores), key=lambda m: (-scores[m], m))
    chosen: list[tuple[float, ...]] = []
    for m in left:
        at = (lattice.x[m[3]], lattice.y[m[2]], lattice.z[m[1]], lattice.yaw[m[0]])
        if all(np.linalg.norm(np.subtract(at, c)[:3]) >= 1.0 or abs(at[3] - c[3]) >= 0.15 for c in chosen):
            chosen.append(at)
    assert len(starts) == 4
    for start, at in zip(starts, chosen):
        np.testing.assert_allclose(start.offset, at, atol=1e-12)
        np.testing.assert_allclose(start.T, offset_pose(T, at), atol=1e-12)
    np.testing.assert_allclose(starts[0].score, scores.max(), rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_true_place_and_its_aliases_are_all_found(pillars: tuple[BoxWorld, SearchField], seed: int) -> None:
    """Pillars every 8 m, and nothing else in sight: which of them is the true place cannot be told here."""
    world, field = pillars
    rng = np.random.default_rng(seed)
    T = heading(rng.uniform(24, 36), rng.uniform(7, 11), 1.2, rng.uniform(-3, 3))
    scan = world.scan(T, around(rng, 2000), 0.025, 12.0, rng)  # no end wall is seen
    start = offset_pose(T, rng.uniform(-1, 1, 4) * [3.0, 3.0, 0.4, 0.2])
    starts = correlative_search(scan, field, start, (12.0, 12.0, 0.8, 0.3), (0.4, 0.4, 0.4, 0.0), 12)
    offsets = np.array([s.T[:3] - T[:3] for s in starts])
    scores = np.array([s.score for s in starts])
    for alias in (-8.0, 0.0, 8.0):
        if abs(T[0] + alias - start[0]) < 11.5:
            away = np.linalg.norm(offsets - [alias, 0, 0], axis=1)
            assert np.min(away) < 0.5, (alias, offsets)
            assert scores[np.argmin(away)] > scores[0] - 0.05
    assert np.all(np.diff([s.score for s in starts]) <= 0)
    assert 0.6 < scores[0] <= 1.0


@pytest.mark.parametrize("seed", range(4))
def test_true_place_is_best_where_an_end_wall_is_in_sight(pillars: tuple[BoxWorld, SearchField], seed: int) -> None:
    world, field = pillars
    rng = np.random.default_rng(seed)
    T = heading(rng.uniform(8, 16), rng.uniform(7, 11), 1.2, rng.uniform(-3, 3))
    scan = world.scan(T, around(rng, 2000), 0.025, 25.0, rng)
    start = offset_pose(T, rng.uniform(-1, 1, 4) * [6.0, 3.0, 0.4, 0.2])
    starts = correlative_search(scan, field, start, (12.0, 12.0, 0.8, 0.3), (0.4, 0.4, 0.4, 0.0))
    assert np.linalg.norm(starts[0].T[:3] - T[:3]) < 0.5, starts
    assert starts[0].score > starts[1].score


@pytest.mark.parametrize("seed", range(6))
def test_a_coarse_look_first_finds_what_the_whole_search_finds(
    pillars: tuple[BoxWorld, SearchField], coarse: SearchField, seed: int
) -> None:
    """Six times as many offsets, most of them scored by a third of the points on a blurred field."""
    world, field = pillars
    rng = np.random.default_rng(seed)
    T = heading(rng.uniform(8, 16), rng.uniform(7, 11), 1.2, rng.uniform(-3, 3))
    scan = world.scan(T, around(rng, 2000), 0.025, 25.0, rng)
    start = offset_pose(T, rng.uniform(-1, 1, 4) * [9.0, 5.0, 0.7, 0.3])
    half, steps = (16.0, 16.0, 0.8, 0.5), (0.8, 0.8, 0.8, 0.1)
    found = correlative_search(scan, field, start, half, steps, 3, coarse=coarse)
    assert min(np.linalg.norm(s.T[:3] - T[:3]) for s in found) < 0.3, found
    whole = correlative_search(scan, field, start, half, (0.4, 0.4, 0.4, 0.05), 1)[0]
    assert found[0].score > whole.score - 0.05
    # what is scored coarsely is not what is reported: scores are those of the fine field
    p = evenly_spaced(voxel_downsample(scan, field.cell), 300)
    assert found[0].score == pytest.approx(value_at(field, transform_points(found[0].T, p)).mean(), abs=0.01)


def test_refined_starts_are_nearer(pillars: tuple[BoxWorld, SearchField]) -> None:
    world, field = pillars
    coarse, fine = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        T = heading(rng.uniform(15, 45), rng.uniform(7, 11), 1.2, rng.uniform(-3, 3))
        scan = world.scan(T, around(rng, 2000), 0.025, 25.0, rng)
        start = offset_pose(T, rng.uniform(-1, 1, 4) * [2.0, 2.0, 0.4, 0.2])
        for config, errors in ((UNREFINED, coarse), (None, fine)):
            first = correlative_search(scan, field, start, (4.0, 4.0, 0.8, 0.3), keep=1, config=config)[0]
            errors.append(np.linalg.norm(first.T[:3] - T[:3]))
    assert np.mean(fine) < np.mean(coarse) < 0.35
    assert np.max(fine) < 0.45


def test_whole_turn_in_the_plane(rng: np.random.Generator) -> None:
    """A scan in an irregular room, heading unknown altogether; the two ends of a turn are one mode."""
    world = hall(length=20.0, width=11.0, cars=7)
    a = rng.uniform(-np.pi, np.pi, 720)
    flat = np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    points = np.concatenate(
        [
            se3.se3_transform(T, world.scan(T, flat, 0.02, 25.0, rng))[:, :2]
            for T in (heading(x, 5.0, 0.5, 0.0) for x in (3.0, 9.0, 17.0))
        ]
    )
    T = np.array([11.0, 6.0, 3.1])
    scan = world.scan(heading(11.0, 6.0, 0.5, 3.1), flat, 0.02, 25.0, rng)[:, :2]
    field = SearchField(points, cell=0.1, sigma=0.2)
    starts = correlative_search(scan, field, [10.0, 5.0, -0.1], (2.0, 2.0, np.pi), (0.2, 0.2, 0.0), 5)
    error = se2.se2_log(se2.se2_between(T, starts[0].T))
    assert np.hypot(error[0], error[1]) < 0.2
    assert abs(error[2]) < 0.05
    assert len(starts[0].offset) == 3
    for k, s in enumerate(starts):
        for t in starts[:k]:
            moved = np.hypot(*(s.T - t.T)[:2])
            assert moved >= 1.5 - 1e-9 or abs(se2.wrap_angle(s.T[2] - t.T[2])) >= 0.35 - 1e-9


def test_same_input_same_bytes(pillars: tuple[BoxWorld, SearchField], rng: np.random.Generator) -> None:
    world, field = pillars
    T = heading(20.0, 8.0, 1.2, 0.0)
    scan = world.scan(T, around(rng, 1000), 0.025, 25.0, rng)
    runs = [correlative_search(scan, field, T, (4.0, 4.0, 0.4, 0.2)) for _ in range(2)]
    again = SearchField(map_of(world, np.random.default_rng(5)))
    runs.append(correlative_search(scan, again, T, (4.0, 4.0, 0.4, 0.2)))
    for other in runs[1:]:
        assert [(s.T.tobytes(), s.score) for s in other] == [(s.T.tobytes(), s.score) for s in runs[0]]


def test_a_search_of_a_loop_closure_takes_a_frame(pillars: tuple[BoxWorld, SearchField]) -> None:
    """± 12 m, ± 12 m, ± 0.8 m, ± 0.3 rad in steps of 0.4 m with 300 points: 50 ms of one idle core."""
    world, field = pillars
    rng = np.random.default_rng(0)
    T = heading(30.0, 8.0, 1.2, 0.3)
    scan = world.scan(T, around(rng, 3000), 0.025, 25.0, rng)
    spent = []
    for _ in range(6):
        begin = time.process_time()
        correlative_search(scan, field, T, (12.0, 12.0, 0.8, 0.3), (0.4, 0.4, 0.4, 0.0))
        spent.append(time.process_time() - begin)
    assert min(spent) < 0.25  # the other core works, too; a search at every pose would take minutes


def test_bad_input_is_refused_or_left_out(rng: np.random.Generator) -> None:
    points = rng.uniform(-3, 3, (50, 3))
    dirty = np.concatenate([points, [[np.nan, 0, 0], [0, np.inf, 0], [1e300, 0, 0]]])
    field = SearchField(dirty)
    assert field.dropped == 3
    assert np.array_equal(field.values, SearchField(points).values)
    T, half = np.array([0.0, 0, 0, 0, 0, 0, 1]), (1.0, 1.0, 0.2, 0.1)
    clean = correlative_search(points, field, T, half)
    assert correlative_search(dirty, field, T, half)[0].score == clean[0].score == pytest.approx(1.0)
    assert correlative_search(np.empty((0, 3)), field, T, half) == []
    assert correlative_search(np.full((5, 3), np.nan), field, T, half) == []
    assert correlative_search(points + 100.0, field, T, half) == []  # nothing of the map under any point
    for bad in (np.empty((0, 3)), np.full((4, 3), np.nan)):
        with pytest.raises(DataError, match="needs points"):
            SearchField(bad)
    with pytest.raises(DataError, match="too far apart"):
        SearchField(np.array([[0.0, 0, 0], [9e5, 9e5, 9e5]]))
    with pytest.raises(GeometryError, match="wrong shape"):
        SearchField(np.zeros(3))
    with pytest.raises(ConfigError, match="positive"):
        SearchField(points, cell=0.0)
    with pytest.raises(GeometryError, match="dimension"):
        correlative_search(points[:, :2], field, T, half)
    for pose in (T[:3], np.full(7, np.nan), np.zeros(7)):
        with pytest.raises(GeometryError):
            correlative_search(points, field, pose, half)
    for steps in ((0.3, 0.4, 0.4, 0.1), (0.0, 0.4, 0.4, 0.1), (0.4, 0.4, 0.4, -0.1), (0.4, 0.4, 0.1)):
        with pytest.raises(ConfigError):
            correlative_search(points, field, T, half, steps)
    with pytest.raises(ConfigError, match="starts"):
        correlative_search(points, field, T, (500.0, 500.0, 500.0, 3.0))
    with pytest.raises(ConfigError, match="half widths"):
        correlative_search(points, field, T, (np.nan, 1.0, 1.0, 1.0))
    with pytest.raises(ConfigError, match="modes"):
        correlative_search(points, field, T, half, keep=0)
    with pytest.raises(ConfigError, match="apart"):
        SearchConfig(apart=-1.0)
