"""The particle core: the same bytes every time, maps that are shared, and steps that say nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import GeometryError
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.evidence.memory import measure_memory
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter import GridFilter
from graphslam_frontends.odometry.steps import Steps
from graphslam_studies.frontends.rbpf_grid import run_rbpf
from tests.frontends.grid_world import ring

CONFIG = GridFilterConfig(particles=8, voxel_size=0.2, heading_walk=0.02)


def dead_reckoned(steps: Steps) -> np.ndarray:
    """The odometry's increments one after the other."""
    poses = [steps.odometry.increments[0]]
    group = group_of(poses[0])
    for u in steps.odometry.increments[1:]:
        poses.append(group.compose(poses[-1], u))
    return np.array(poses)


@pytest.mark.parametrize("dim", [2, 3])
def test_same_seed_same_bytes_with_one_thread_and_with_two(dim: int) -> None:
    steps = ring(0, dim, length=14.0, beams=80)
    runs = [run_rbpf(steps, replace(CONFIG, threads=t), SeedTree(4)) for t in (1, 2)]
    a, b = runs
    assert a.resampled.sum() > 2
    assert a.poses.tobytes() == b.poses.tobytes()
    assert a.effective.tobytes() == b.effective.tobytes()
    assert a.ancestry.paths().tobytes() == b.ancestry.paths().tobytes()
    assert a.particles.scores.tobytes() == b.particles.scores.tobytes()
    for g, h in zip(a.particles.grids, b.particles.grids):
        assert np.array_equal(g.brick_coordinates(), h.brick_coordinates())
        assert np.array_equal(g.brick_values(), h.brick_values())
    other = run_rbpf(steps, CONFIG, SeedTree(5))
    assert not np.array_equal(other.poses, a.poses)


@pytest.mark.parametrize("dim", [2, 3])
def test_one_particle_is_dead_reckoning(dim: int) -> None:
    steps = ring(1, dim, length=8.0, beams=40, tilt_sigma=0.0)
    result = run_rbpf(steps, replace(CONFIG, particles=1), SeedTree(0))
    assert result.ancestry.path(0) == pytest.approx(dead_reckoned(steps), abs=1e-12)
    assert not result.resampled.any()
    assert np.array_equal(result.effective, np.ones(len(steps)))


def test_one_particle_takes_roll_and_pitch_from_gravity() -> None:
    steps = ring(1, 3, length=8.0, beams=40)
    assert steps.tilt is not None
    path = run_rbpf(steps, replace(CONFIG, particles=1), SeedTree(0)).ancestry.path(0)
    from graphslam_frontends.grid.motion import roll_pitch_of

    assert roll_pitch_of(path) == pytest.approx(steps.tilt, abs=1e-12)
    # the frame of the map stands level: the robot drove on one level, and stays there
    assert np.abs(path[:, 2] - path[0, 2]).max() < 0.1
    assert remove_roll_pitch(path[0]) == pytest.approx([0, 0, CONFIG.lift * CONFIG.voxel_size, 0, 0, 0, 1])


def test_particles_without_noise_are_one_and_cost_one_map() -> None:
    steps = ring(2, 3, length=8.0, beams=60, tilt_sigma=0.0)
    quiet = replace(CONFIG, motion_scale=0.0, position_walk=0.0, height_walk=0.0, heading_walk=0.0, heading_turn=0.0,
                    tilt_walk=0.0)  # fmt: skip
    result = run_rbpf(steps, quiet, SeedTree(0))
    alone = run_rbpf(steps, replace(quiet, particles=1), SeedTree(0))
    assert result.poses == pytest.approx(np.tile(dead_reckoned(steps)[-1], (8, 1)), abs=1e-12)
    together, one = measure_memory(result.particles.grids), measure_memory(alone.particles.grids[0])
    assert together.bricks == one.bricks
    assert result.tally.rays == alone.tally.rays


def test_children_of_one_particle_share_their_map_and_are_updated_once() -> None:
    steps = ring(0, 3, length=12.0, beams=80)
    filter = GridFilter(steps, CONFIG, SeedTree(2))
    for k in range(len(steps)):
        filter.predict(k)
        filter.weigh(k)
        filter.record()
        ancestors = filter.resample_if_needed(k)
        if ancestors is None or k < 5:
            filter.update(k)
            continue
        p = filter.particles
        points, origins, returns = steps.scan(k)
        apart = []
        for grid, pose in zip(p.grids, p.poses):
            one = grid.copy()
            one.insert_scan(points, origins, pose=pose, max_range=steps.max_range, returns=returns)
            apart.append(one.brick_values())
        handles = list(p.grids)
        report = filter.update(k)
        families = len(np.unique(ancestors))
        assert families < len(p)
        assert report.rays == families * len(points)
        for i, (grid, values) in enumerate(zip(p.grids, apart)):
            assert grid is handles[i]
            assert np.array_equal(grid.brick_values(), values)
            first = int(np.flatnonzero(ancestors == ancestors[i])[0])
            assert grid.same_as(p.grids[first])
        total = measure_memory(p.grids).bricks
        assert total < 0.7 * sum(measure_memory(g).bricks for g in p.grids)
        return
    pytest.fail("never resampled")


def test_survivors_are_expected_as_often_as_they_weigh() -> None:
    steps = ring(0, 2, length=1.2, beams=8)
    w = np.array([0.05, 0.45, 0.2, 0.02, 0.28, 0.0])
    n, trials = len(w), 600
    counts = np.zeros((trials, n))
    for t in range(trials):
        filter = GridFilter(steps, replace(CONFIG, particles=n, ess_fraction=1.0), SeedTree(t))
        with np.errstate(divide="ignore"):
            filter.particles.log_weights = np.log(w)
        ancestors = filter.resample_if_needed(1)
        assert ancestors is not None
        counts[t] = np.bincount(ancestors, minlength=n)
        assert np.array_equal(filter.particles.log_weights, np.full(n, -np.log(n)))
    assert np.all(np.abs(counts - n * w) < 1.0)
    assert counts.mean(axis=0) == pytest.approx(n * w, abs=4 * 0.5 / np.sqrt(trials))
    assert counts.std(axis=0).max() > 0.1  # drawn, not rounded


def test_resampling_takes_everything_along() -> None:
    filter = GridFilter(ring(0, 3, length=2.0, beams=20), CONFIG, SeedTree(0))
    filter.step(0)
    p = filter.particles
    p.poses[:, 0] = np.arange(8)
    p.ages, p.scores = np.arange(8), np.arange(8.0)
    assert p.tilt_errors is not None
    p.tilt_errors[:, 1] = np.arange(8)
    p.grids[3].lock()
    p.take(np.array([0, 3, 3, 3, 5, 5, 7, 7]))
    assert p.poses[:, 0].tolist() == p.scores.tolist() == p.tilt_errors[:, 1].tolist() == [0, 3, 3, 3, 5, 5, 7, 7]
    assert p.ages.tolist() == [0, 3, 3, 3, 5, 5, 7, 7]
    assert [g.locked for g in p.grids] == [False, True, True, True, False, False, False, False]
    assert len({id(g) for g in p.grids}) == 8


def without(steps: Steps, what: str) -> Steps:
    """The same drive with no beams at all in some steps, or with none that met anything."""
    n = len(steps)
    hit = np.zeros(n, dtype=np.bool_)
    hit[n // 3 : 2 * n // 3] = True
    beams = np.diff(steps.offsets)
    rows = np.repeat(hit, beams)
    if what == "beams":
        offsets = np.concatenate([[0], np.cumsum(np.where(hit, 0, beams))])
        return replace(steps, offsets=offsets, points=steps.points[~rows], origins=steps.origins[~rows],
                       returns=steps.returns[~rows])  # fmt: skip
    points = np.where(rows[:, None], steps.points / np.linalg.norm(steps.points, axis=1, keepdims=True) * 8.0,
                      steps.points)  # fmt: skip
    return replace(steps, points=points, returns=steps.returns & ~rows)


@pytest.mark.parametrize("what", ["beams", "returns"])
@pytest.mark.parametrize("likelihood", ["endpoint", "cast"])
@pytest.mark.parametrize("dim", [2, 3])
def test_steps_that_say_nothing_are_counted_and_do_no_harm(what: str, likelihood: str, dim: int) -> None:
    steps = without(ring(3, dim, length=12.0, beams=40), what)
    config = replace(CONFIG, likelihood=likelihood)  # type: ignore[arg-type]
    result = run_rbpf(steps, config, SeedTree(0))
    quiet = len(steps) // 3 if len(steps) % 3 == 0 else 2 * len(steps) // 3 - len(steps) // 3
    assert result.tally.without_beams == (quiet if what == "beams" else 0)
    assert result.tally.without_returns == (quiet if what == "returns" else 0)
    for a in (result.poses, result.effective, result.particles.scores, result.particles.weights):
        assert np.all(np.isfinite(a))
    assert np.all(np.abs(result.poses) < 50.0)
    if what == "beams" or likelihood == "endpoint":
        middle = slice(len(steps) // 3 + 1, 2 * len(steps) // 3)
        assert np.ptp(result.effective[middle]) < 1e-9  # nothing was learnt


def test_a_log_without_any_beam_gives_dead_reckoning_and_empty_maps() -> None:
    steps = ring(0, 3, length=4.0, beams=10)
    blind = replace(steps, offsets=np.zeros(len(steps) + 1, dtype=np.int64), points=np.zeros((0, 3)),
                    origins=np.zeros((0, 3)), returns=np.zeros(0, dtype=np.bool_))  # fmt: skip
    result = run_rbpf(blind, CONFIG, SeedTree(0))
    assert result.tally.without_beams == len(steps)
    assert result.effective == pytest.approx(np.full(len(steps), 8.0))
    assert all(g.root == 0 for g in result.particles.grids)


def test_locked_maps_are_weighed_by_and_not_written() -> None:
    steps = ring(0, 3, length=6.0, beams=60)
    filter = GridFilter(steps, replace(CONFIG, ess_fraction=0.01), SeedTree(0))
    for k in range(5):
        filter.step(k)
    p = filter.particles
    p.grids[2].lock()
    before, ages = p.grids[2].brick_values(), p.ages.copy()
    filter.predict(5)
    gains = filter.weigh(5)
    report = filter.update(5)
    assert report.locked == 1
    assert gains[2] != 0.0
    assert np.array_equal(p.grids[2].brick_values(), before)
    assert (p.ages - ages).tolist() == [1, 1, 0, 1, 1, 1, 1, 1]


def test_a_likelihood_that_rules_everything_out_leaves_equal_weights() -> None:
    filter = GridFilter(ring(0, 2, length=2.0, beams=10), CONFIG, SeedTree(0))
    filter.particles.gain(np.full(8, -np.inf))
    assert filter.particles.weights == pytest.approx(np.full(8, 1 / 8))
    filter.particles.gain(np.array([-np.inf] * 7 + [-3.0]))
    assert filter.particles.weights.tolist() == [0.0] * 7 + [1.0]
    filter.particles.gain(np.zeros(8))
    assert np.all(np.isfinite(filter.particles.weights))
    assert filter.effective == 1.0


def test_starts_in_the_middle_and_impossible_starts() -> None:
    steps = ring(0, 2, length=6.0, beams=20)
    filter = GridFilter(steps, CONFIG, SeedTree(0), first=5, start=np.array([1.0, 2.0, 0.3]))
    filter.step(5)
    assert np.array_equal(filter.particles.poses, np.tile([1.0, 2.0, 0.3], (8, 1)))
    filter.step(6)
    assert len(np.unique(filter.particles.poses[:, 0])) == 8
    with pytest.raises(GeometryError, match="no step"):
        GridFilter(steps, CONFIG, SeedTree(0), first=len(steps))
    with pytest.raises(GeometryError, match="impossible start"):
        GridFilter(steps, CONFIG, SeedTree(0), start=np.array([0.0, np.nan, 0.0]))
    with pytest.raises(GeometryError, match="impossible start"):
        GridFilter(steps, CONFIG, SeedTree(0), start=np.zeros(7))
