"""Which match is believed: gates, weights, the draw with the null match, and the throw-away particle filter."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.poses import pose_mean, pose_scatter
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.likelihood import EndpointLikelihood, log_weights
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.register import Registration
from graphslam_frontends.segslam.config import ChoiceConfig
from graphslam_frontends.segslam.localisation import LocalisationConfig, ScanLocalisation, localise_in_map, range_error
from graphslam_frontends.segslam.match_posterior import (
    NULL,
    Proposal,
    match_covariance,
    match_posterior,
    proposal_margins,
)
from graphslam_frontends.segslam.segmap import MATCH
from graphslam_frontends.segslam.segmentation import LookAheadWindow

C = ChoiceConfig()
RULES = RegistrationConfig(gates=RegistrationGates(fitness=0.85, degeneracy=0.006, tilt=math.radians(4.0)))


def result(x: float = 0.0, z: float = 0.0, fitness: float = 0.9, **rest: object) -> Registration:
    """A registration that passes all gates, unless told otherwise."""
    known = {
        "T_target_source": np.array([x, 0.0, z, 0, 0, 0, 1]), "covariance": np.diag([1e-6] * 3 + [1e-4] * 3),
        "fitness": fitness, "rmse": 0.1, "inliers": 200, "degeneracy": 0.04, "weakest": np.array([1.0, 0, 0]),
        "weakest_sigma": 0.01, "tilt": 0.0, "shift": 0.0, "turn": 0.0, "converged": True, "why": "",
    }  # fmt: skip
    unknown = dict.fromkeys((f.name for f in dataclasses.fields(Registration)), math.nan)
    r = Registration(**{**unknown, **known})  # type: ignore[arg-type]
    return dataclasses.replace(r, **rest)  # type: ignore[arg-type]


def proposal(
    segment: int = 0, sigma: float = 2.0, localisation: ScanLocalisation | None = None, **rest: object
) -> Proposal:
    return Proposal(
        segment=segment, registration=result(**rest), T_prior=np.array([0.0, 0, 0, 0, 0, 0, 1]), sigma=sigma,
        localisation=localisation,
    )  # type: ignore[arg-type]  # fmt: skip


def leaning(degrees: float, heading: float = 0.7) -> np.ndarray:
    """At the origin, with a heading, its vertical this far off the map's."""
    turned = se3.quat_multiply(se3.so3_exp([0, 0, heading]), se3.so3_exp([math.radians(degrees), 0, 0]))
    return np.concatenate([np.zeros(3), turned])


def test_weights_follow_fitness_and_shift() -> None:
    j = match_posterior([proposal(fitness=0.88, x=3.0), proposal(1, fitness=0.97)], C, RULES)
    assert j.why == ("", "")
    np.testing.assert_allclose(
        j.weights,
        [math.exp(-0.5 * (0.12 / 0.15) ** 2) * math.exp(-0.5 * 1.5**2), math.exp(-0.5 * (0.03 / 0.15) ** 2)],
    )
    assert j.null == 0.01
    np.testing.assert_allclose(j.probabilities, np.append(j.weights, 0.01) / (j.weights.sum() + 0.01))
    assert j.counts() == {"accepted": 2}


@pytest.mark.parametrize(
    ("change", "gate", "passes"),
    [
        ({"fitness": 0.849}, "fitness", {"fitness": 0.851}),
        ({"degeneracy": 0.0059}, "degenerate", {"degeneracy": 0.0061}),
        ({"T_target_source": leaning(4.1)}, "tilt", {"T_target_source": leaning(3.9)}),
        ({"z": 1.61}, "height", {"z": 1.59}),
        ({"x": 5.01}, "shift", {"x": 4.99}),
        ({"converged": False, "why": "2 pairs left, fewer than 20"}, "nothing", {"converged": True}),
    ],
)
def test_each_gate_keeps_out_what_is_beyond_it_alone(change: dict, gate: str, passes: dict) -> None:  # type: ignore[type-arg]
    j = match_posterior([proposal(**change)], C, RULES)
    assert j.weights[0] == 0.0
    assert j.counts() == {gate: 1, "accepted": 0}
    assert j.probabilities.tolist() == [0.0, 1.0]
    j = match_posterior([proposal(**passes)], C, RULES)
    assert j.weights[0] > 0.0
    assert j.counts() == {"accepted": 1}


def test_on_a_ramp_a_match_is_as_tilted_as_the_prediction_and_one_on_the_flat_is_refused() -> None:
    """What the registration says of the tilt between body and map is no matter."""
    ramp, flat = leaning(7.0), leaning(0.0)

    def counts(found: np.ndarray, predicted: np.ndarray) -> dict[str, int]:
        r = result(T_target_source=found, tilt=math.radians(7.0))
        return match_posterior([Proposal(segment=0, registration=r, T_prior=predicted, sigma=2.0)], C, RULES).counts()

    assert counts(ramp, ramp) == counts(ramp, leaning(7.0, heading=0.6)) == {"accepted": 1}
    assert counts(flat, ramp) == counts(ramp, flat) == {"tilt": 1, "accepted": 0}


def test_a_match_that_nothing_holds_in_some_direction_is_refused() -> None:
    fine, wide, turned = (
        np.diag([1e-6] * 3 + [1e-4] * 3),
        np.diag([1e-6] * 3 + [1e-4, 0.17, 1e-4]),
        np.diag([1e-6, 1e-6, 0.0017] + [1e-4] * 3),
    )
    j = match_posterior([proposal(k, covariance=C_) for k, C_ in enumerate((fine, wide, turned))], C, RULES)
    assert j.why == ("", "vague", "vague")
    assert j.accepted.tolist() == [0]


def test_what_stands_upright_must_fit_too() -> None:
    """Floors and ceilings fit anywhere. Where no upright surface is seen, nothing is known of them."""
    seen = [proposal(k, fitness_upright=u) for k, u in enumerate((0.85, 0.78, 0.5, math.nan))]
    j = match_posterior(seen, C, RULES)
    assert j.accepted.tolist() == [0, 3]
    assert all("upright" in j.why[k] and j.why[k].count("upright") == 1 for k in (1, 2))
    low = match_posterior(
        [proposal(fitness=0.8, fitness_upright=0.9)], C, RegistrationConfig(gates=RegistrationGates(fitness=0.5))
    )
    assert low.why == ("fitness 0.800 < 0.83",)


def test_a_rival_in_the_same_map_takes_both_out_and_elsewhere_none() -> None:
    """One pillar on, 8 m away, fits as well: nobody knows which. The same fit in another map is another hypothesis."""
    wide = 10.0
    near = [proposal(fitness=0.93, sigma=wide), proposal(fitness=0.92, x=8.0, sigma=wide)]
    assert match_posterior(near, C, RULES).counts() == {"margin": 2, "accepted": 0}
    clear = [proposal(fitness=0.97, sigma=wide), proposal(fitness=0.86, x=8.0, sigma=wide)]
    j = match_posterior(clear, C, RULES)
    assert j.accepted.tolist() == [0]
    np.testing.assert_allclose(j.margins, [0.11, -0.11])
    # a mode within 1.5 m is the same place; one that fits too badly for the gate still speaks against its rival
    assert match_posterior([proposal(fitness=0.93), proposal(fitness=0.92, x=1.4)], C, RULES).accepted.tolist() == [
        0,
        1,
    ]
    assert (
        match_posterior(
            [proposal(fitness=0.86, sigma=wide), proposal(fitness=0.84, x=8.0, sigma=wide)], C, RULES
        ).accepted.size
        == 0
    )
    assert match_posterior(
        [proposal(0, fitness=0.93), proposal(1, fitness=0.92, x=3.0)], C, RULES
    ).accepted.tolist() == [0, 1]
    # what did not converge is no rival
    assert match_posterior(
        [proposal(fitness=0.9), proposal(fitness=0.9, x=4.0, converged=False)], C, RULES
    ).accepted.tolist() == [0]
    assert proposal_margins([], 1.5).shape == (0,)


def test_draws_come_as_often_as_their_weights_and_always_hold_the_null_match() -> None:
    j = match_posterior(
        [proposal(fitness=0.86, x=3.5), proposal(1, fitness=0.5), proposal(2, fitness=0.99, x=4.5)], C, RULES
    )
    rng = np.random.default_rng(11)
    n = 20000
    drawn = np.array([j.draw(float(u)) for u in rng.random(n)])
    assert set(drawn.tolist()) == {0, 2, NULL}
    counts = [np.sum(drawn == k) for k in (0, 2, NULL)]
    assert stats.chisquare(counts, n * j.probabilities[[0, 2, 3]]).pvalue > 1e-3
    assert j.draw(np.nextafter(1.0, 0.0)) == NULL
    assert match_posterior([], C, RULES).draw(0.0) == NULL
    assert match_posterior([proposal(fitness=0.1)], C, RULES).draw(0.0) == NULL


def test_what_is_drawn_becomes_an_entry_with_a_covariance() -> None:
    j = match_posterior([proposal(7, fitness=0.9, x=1.0)], C, RULES)
    e = j.entry(0, C)
    assert (e.kind, e.source, e.fitness) == (MATCH, 7, 0.9)
    assert e.T_entry[0] == 1.0
    assert e.covariance is not None
    np.testing.assert_allclose(np.diag(e.covariance), [1e-6 + 0.012**2] * 3 + [1e-4 + 0.1**2] * 3)


def test_localisation_weighs_as_well() -> None:
    loc = ScanLocalisation(
        pose=np.array([0.1, 0, 0, 0, 0, 0, 1]), covariance=np.eye(6) * 1e-3, error=0.04, spread=0.15, effective=0.5
    )
    shift = math.exp(-0.5 * (0.1 / 2.0) ** 2)
    fit = math.exp(-0.5 * (0.1 / 0.15) ** 2)
    sharp = math.exp(-0.5 * 0.04 / 0.4**2) * math.exp(-0.5 * (0.15 / 0.3) ** 2)
    for method, expected in (
        ("registration", shift * fit),
        ("localisation", shift * sharp),
        ("both", shift * fit * sharp),
    ):
        j = match_posterior([proposal(localisation=loc)], dataclasses.replace(C, method=method), RULES)  # type: ignore[arg-type]
        assert j.weights[0] == pytest.approx(expected)
    assert match_posterior([proposal()], dataclasses.replace(C, method="both"), RULES).counts() == {
        "localisation": 1,
        "accepted": 0,
    }
    p = proposal(localisation=loc)
    assert p.T[0] == 0.1
    np.testing.assert_allclose(np.diag(match_covariance(p, C))[3:], 1e-3 + 0.01)


def room() -> EvidenceGrid:
    """An L-shaped room, 2-D, voxels of 0.2 m: nothing looks the same from two places in it."""
    grid = EvidenceGrid(0.2, dim=2)
    corners = np.array([[-4.1, -3.1], [5.1, -3.1], [5.1, 1.1], [0.9, 1.1], [0.9, 4.1], [-4.1, 4.1]])
    walls = [
        a + np.linspace(0, 1, 200)[:, None] * (b - a)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    for _ in range(3):
        grid.insert_scan(np.concatenate(walls))
    return grid


def seen_from(grid: EvidenceGrid, pose: np.ndarray, n: int, sigma: float, seed: int) -> LookAheadWindow:
    a = np.linspace(-np.pi, np.pi, n, endpoint=False)
    d = np.stack([np.cos(a), np.sin(a)], 1)
    c = grid.cast(np.zeros(2), d, 20.0, pose=pose)
    r = c.ranges + sigma * np.random.default_rng(seed).standard_normal(n)
    keep = c.hit
    return LookAheadWindow(points=(d * r[:, None])[keep], origins=np.zeros((int(keep.sum()), 2)), beams=n)


TRUE = np.array([1.2, -1.3, 0.4])


def test_the_throw_away_filter_finds_what_a_dense_search_of_the_posterior_finds() -> None:
    """All poses of a lattice, weighed by prior and likelihood at once, against 400 drawn ones."""
    grid = room()
    config = LocalisationConfig(particles=400, rounds=5)
    window = seen_from(grid, TRUE, 90, 0.03, 1)
    start = TRUE + [0.3, -0.25, 0.04]
    s = np.array([config.position, config.position, config.angle])
    axes = [np.linspace(-2.5, 2.5, 41) * si for si in s]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    likelihood = EndpointLikelihood(exponent=config.effective_beams / len(window))
    poses = start + offsets
    logs = log_weights([grid] * len(poses), poses, window.points, likelihood) - 0.5 * ((offsets / s) ** 2).sum(1)
    w = np.exp(logs - logs.max())
    mean = pose_mean(poses, w)
    sigma = np.sqrt(np.diag(pose_scatter(poses, mean, w)))
    found = [localise_in_map(grid, start, window, 20.0, np.random.default_rng(k), config) for k in range(6)]
    at = np.stack([f.pose for f in found])
    assert np.all(np.abs(at.mean(axis=0) - mean) < 0.5 * sigma + 0.002)
    assert np.all(np.abs(at[:, :2] - TRUE[:2]) < 0.15)
    spread = np.mean([np.sqrt(np.diag(f.covariance)) for f in found], axis=0)
    assert np.all((spread > 0.6 * sigma) & (spread < 1.6 * sigma))
    for f in found:
        assert f.spread == pytest.approx(np.linalg.det(f.covariance[:2, :2]) ** 0.25)
        assert 0 < f.effective <= 1


def test_a_wrong_place_has_the_larger_error() -> None:
    grid, config = room(), LocalisationConfig()
    window = seen_from(grid, TRUE, 90, 0.03, 1)
    right = localise_in_map(grid, TRUE + [0.2, 0.1, 0.02], window, 20.0, np.random.default_rng(0), config)
    wrong = localise_in_map(grid, np.array([-2.5, 2.5, 2.0]), window, 20.0, np.random.default_rng(0), config)
    assert right.error < 0.05 < 0.15 < wrong.error
    assert range_error(grid, TRUE, window, 20.0, clip=0.6) < 0.03**2 + 0.1**2
    assert range_error(grid.empty(), TRUE, window, 20.0, clip=0.6) == pytest.approx(0.36)
    again = localise_in_map(grid, TRUE + [0.2, 0.1, 0.02], window, 20.0, np.random.default_rng(0), config, threads=2)
    np.testing.assert_array_equal(again.pose, right.pose)


def test_a_single_throw_away_particle_and_no_beams() -> None:
    grid = room()
    window = seen_from(grid, TRUE, 30, 0.03, 1)
    one = localise_in_map(grid, TRUE, window, 20.0, np.random.default_rng(0), LocalisationConfig(particles=1))
    assert np.all(np.isfinite(one.pose))
    assert one.spread == pytest.approx(0.0, abs=1e-6)
    empty = LookAheadWindow(points=np.zeros((0, 2)), origins=np.zeros((0, 2)), beams=5)
    with pytest.raises(DataError, match="nothing to localise by"):
        localise_in_map(grid, TRUE, empty, 20.0, np.random.default_rng(0), LocalisationConfig())
    assert math.isnan(range_error(grid, TRUE, empty, 20.0, clip=0.6))


def test_in_three_dimensions_roll_and_pitch_stay() -> None:
    rng = np.random.default_rng(0)
    grid = EvidenceGrid(0.2)
    p = rng.uniform(-1, 1, (6000, 3)) * [6.0, 4.0, 2.0]
    p[np.arange(6000), rng.integers(0, 3, 6000)] = np.nan
    p = np.where(np.isnan(p), rng.choice([-1.0, 1.0], (6000, 1)) * [6.1, 4.1, 2.1], p)
    for _ in range(2):
        grid.insert_scan(p)
    tilt = se3.quat_multiply(se3.so3_exp([0, 0, 0.3]), se3.so3_exp([0.05, -0.1, 0]))
    true = np.concatenate([[1.0, 0.5, -0.3], tilt])
    seen = p[:300]
    points = se3.se3_transform(np.broadcast_to(se3.se3_inverse(true), (300, 7)), seen)
    window = LookAheadWindow(points=points, origins=np.zeros_like(points), beams=300)
    start = true.copy()
    start[:3] += [0.3, -0.2, 0.2]
    f = localise_in_map(grid, start, window, 20.0, rng, LocalisationConfig(particles=200))
    assert np.linalg.norm(f.pose[:3] - true[:3]) < 0.12
    up = se3.quat_rotate(f.pose[3:], [0, 0, 1])[2], se3.quat_rotate(tilt, [0, 0, 1])[2]
    assert up[0] == pytest.approx(up[1], abs=2e-4)
