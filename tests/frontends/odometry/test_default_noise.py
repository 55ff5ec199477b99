"""Why default noises are what they are: each against the physics that it stands for, from below and from above.

Half of a default and twice a default must both fail here, or nothing says why it is that figure.
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from graphslam.app.worlds import mesh_world
from graphslam.sim.crawler import crawler_motion
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.crawler_sensors import yaw_bias_for
from graphslam_frontends.grid import filter_error_model
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.grid.motion import motion_covariance, walk_tilt_errors
from graphslam_studies.frontends.drift import DriftModel
from tests.reference.garage_exits import Ends, read

STEP = 0.4
"""Seconds of a step that the defaults are for."""


@cache
def garage(layout: str) -> tuple[float, float]:
    """Length of a step [m] and what the gyro's bias turns in it [rad], in a simulated garage."""
    crawler = CrawlerConfig()
    motion = crawler_motion(mesh_world("garage", layout=layout, seed=1), crawler)
    bias = yaw_bias_for(motion, crawler.drift * motion.length, 1.0, crawler.most_turned / motion.duration)
    return motion.length / motion.duration * STEP, bias * STEP


# --- walks of a filter's particles ------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["A", "B", "C", "D"])
def test_particles_walk_ten_to_twenty_times_what_biases_move_in_a_step(layout: str) -> None:
    """n steps of a constant error b come to n b, n steps of white noise of σ = r b to √n r b: particles reach what must
    be undone over r² steps. Ten to twenty are 100 to 400 steps, 30 to 120 m, as long as segments are; more only spreads
    particles. Heading: the gyro's bias; height: gravity's constant error; along the way: the wheels' scale."""
    step, turned = garage(layout)
    crawler = CrawlerConfig()
    quiet = GridFilterConfig(heading_turn=0.0)
    straight = np.array([step, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    sigma = np.sqrt(np.diag(motion_covariance(straight, np.zeros((6, 6)), quiet)))
    assert 10.0 < sigma[2] / turned < 20.0
    assert 8.0 < sigma[5] / (crawler.attitude_bias * step) < 16.0
    assert 7.0 < sigma[3] / (crawler.wheel_scale * step) < 14.0
    assert sigma[4] == sigma[3]


def test_turning_on_the_spot_costs_what_the_wheels_get_wrong_of_a_turn() -> None:
    """Wheels turn by a factor that is off by some percent: σ of the heading after one radian."""
    spot = np.array([0.0, 0.0, 1.0])
    sigma = np.sqrt(motion_covariance(spot, np.zeros((3, 3)), GridFilterConfig())[2, 2])
    assert 0.75 < sigma / CrawlerConfig().turn_scale < 1.5


def test_a_map_is_young_until_a_spun_scanner_has_seen_all_round() -> None:
    turns = GridFilterConfig().young * STEP * CrawlerConfig().spin_rate
    assert 1.0 < turns < 2.0


def test_odds_of_a_voxel_are_those_of_octomap() -> None:
    """Hornung et al. (2013): log-odds clamped at -2 and 3.5, 0.85 for a hit and -0.4 for a miss."""
    c = GridFilterConfig().beam_model()
    odds = np.log(np.array([*c.clamp, c.hit, c.miss]) / (1.0 - np.array([*c.clamp, c.hit, c.miss])))
    np.testing.assert_allclose(odds, [-2.0, 3.5, 0.85, -0.4], atol=0.02)


def test_beams_have_nothing_to_do_with_the_map_as_often_as_amcl_assumes() -> None:
    """Its likelihood fields mix 0.95 of hits with 0.05 of anything."""
    assert GridFilterConfig().floor == pytest.approx(0.05, rel=0.3)


def test_cast_ranges_are_as_unsure_as_the_voxel_they_end_in() -> None:
    c = GridFilterConfig(likelihood="cast")
    # uniform over a voxel that is met under any angle: σ between edge / √12 and the diagonal
    assert c.voxel_size / np.sqrt(3) < c.by_casting(60).sigma < c.voxel_size * np.sqrt(3)


def test_a_cast_beam_is_no_worse_where_it_rather_has_nothing_to_do_with_the_map() -> None:
    """A share of the beams has nothing to do with the map and may be of any length; the others are normal about the
    expected range. Both densities are equal at this many standard deviations."""
    c = GridFilterConfig(likelihood="cast")
    cast = c.by_casting(60)
    stray, normal = c.floor / CrawlerConfig().max_range, (1.0 - c.floor) / (cast.sigma * np.sqrt(2.0 * np.pi))
    assert 0.75 < cast.clip / np.sqrt(2.0 * np.log(normal / stray)) < 1.33


# --- what is left at the end of a segment -------------------------------------------------------------------------


ENDS = {"few": read(5, 20, 40), "one": read(1), "pieces": read(20, pieces=True)}


def covariances(model: FilterDrift | DriftModel, ends: Ends) -> np.ndarray:
    """Of heading, x, y, z at every end ``(m, 4, 4)``: the model's and the particles'."""
    if isinstance(model, FilterDrift):
        C = [model.covariance(path, int(n)) for path, n in zip(ends.paths, ends.particles)]
    else:
        C = [model.covariance(L) for L in ends.lengths]
    return np.array(C)[:, 2:, 2:] + ends.spreads


def likelihood(model: FilterDrift | DriftModel, ends: Ends) -> float:
    """Log likelihood of the true ends."""
    C = covariances(model, ends)
    d2 = np.einsum("ni,ni->n", ends.errors, np.linalg.solve(C, ends.errors[..., None])[..., 0])
    return float(-0.5 * np.sum(np.linalg.slogdet(C)[1] + d2))


def ratio(model: FilterDrift | DriftModel, ends: Ends, part: slice) -> float:
    """Mean NEES of some components per degree of freedom."""
    C, e = covariances(model, ends)[:, part, part], ends.errors[:, part]
    return float(np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(C, e[..., None])[..., 0]) / e.shape[1]))


HEADING, PLANE, HEIGHT = slice(0, 1), slice(1, 3), slice(3, 4)


@pytest.mark.parametrize(("which", "part"), [("few", HEADING), ("few", PLANE), ("few", HEIGHT), ("one", HEADING)])
def test_true_ends_of_segments_are_as_far_off_as_the_filter_drift_says(which: str, part: slice) -> None:
    """180 ends in eight drives of garages. A walk halved or doubled is a NEES four times as large or small: the bounds
    are half of that either way."""
    assert 0.5 < ratio(FilterDrift(), ENDS[which], part) < 2.0


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize(
    ("name", "which"),
    [("heading_walk", "few"), ("position_walk", "few"), ("position_scale", "few"), ("few", "few"),
     ("height_walk", "few")],
)  # fmt: skip
def test_true_ends_are_less_likely_with_half_or_twice_a_walk_of_the_filter(
    name: str, which: str, factor: float
) -> None:
    """By a factor e at least."""
    model = FilterDrift()
    changed = replace(model, **{name: factor * getattr(model, name)})
    assert likelihood(changed, ENDS[which]) < likelihood(model, ENDS[which]) - 1.0


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_single_particle_corrects_nothing_so_its_heading_walks_as_the_gyro_does(factor: float) -> None:
    ends = ENDS["one"]
    assert not 0.5 < ratio(replace(FilterDrift(), alone_walk=factor * FilterDrift().alone_walk), ends, HEADING) < 2.0


def test_what_lasts_is_what_the_sensors_have() -> None:
    """Wheels that are off by a factor, and gravity told with an error that stays."""
    crawler, model = CrawlerConfig(), FilterDrift()
    assert 0.75 < model.position_scale / crawler.wheel_scale < 1.5
    assert 0.75 < filter_error_model.HEIGHT_SCALE / crawler.attitude_bias < 1.5


def test_variances_at_no_length_only_keep_short_segments_regular() -> None:
    """After the 8 m of the shortest segments they are a small part of the whole; twice the σ would not be."""
    model, path = FilterDrift(), np.zeros((9, 7))
    path[:, 0], path[:, 6] = np.arange(9.0), 1.0
    start, end = (np.diag(model.covariance(path[:n], 40)) for n in (1, 9))
    assert np.all(np.sqrt((start / end)[[2, 3, 5]]) < [0.25, 0.4, 0.6])
    assert np.all(np.sqrt((start / end)[[2, 3, 5]]) > [0.05, 0.1, 0.2])
    assert start[[3, 5]] == pytest.approx([filter_error_model.POSITION_START**2, filter_error_model.HEIGHT_START**2])


@pytest.mark.parametrize("part", [HEADING, PLANE, HEIGHT])
@pytest.mark.parametrize(("shortest", "longest"), [(4.0, 15.0), (15.0, 45.0), (60.0, 90.0)])
def test_true_ends_of_pieces_are_as_far_off_as_the_drift_model_says(
    part: slice, shortest: float, longest: float
) -> None:
    ends = ENDS["pieces"]
    kept = (ends.lengths > shortest) & (ends.lengths < longest)
    some = Ends(ends.particles[kept], ends.paths[kept], ends.errors[kept], ends.spreads[kept])
    assert 0.4 < ratio(DriftModel(), some, part) < 2.0


@pytest.mark.parametrize("name", [f.name for f in fields(DriftModel) if f.name not in ("dim", "tilt")])
def test_true_ends_are_less_likely_with_half_or_twice_a_default_of_the_drift_model(name: str) -> None:
    """Fitted to pieces of 5 to 80 m of the paths of a filter of 20 particles; what is zero is not needed."""
    model, ends = DriftModel(), ENDS["pieces"]
    value, best = getattr(model, name), likelihood(model, ENDS["pieces"])
    for changed in (0.5 * value, 2.0 * value) if value else (0.01,):
        assert likelihood(replace(model, **{name: changed}), ends) < best - 1.0, changed


def test_tilt_is_the_difference_of_two_attitudes() -> None:
    """Frames stand level at both ends of a segment, each by an attitude whose slow error has another value by then."""
    c, rng = CrawlerConfig(), np.random.default_rng(0)
    first = c.attitude_sigma * rng.standard_normal((20_000, 2))
    last = walk_tilt_errors(first, 20.0, c.attitude_sigma, c.attitude_time, rng.standard_normal(first.shape))
    sigma = np.std(last - first)
    for model in (FilterDrift(), DriftModel()):
        assert 0.75 < model.tilt / sigma < 1.33
