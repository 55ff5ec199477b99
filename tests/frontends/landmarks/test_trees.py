"""The tree detector: against its slow twin, against trunks of known place, and its refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.records import LaserScans
from graphslam_frontends.detectors import trees
from graphslam_frontends.detectors.trees import (
    TreeDetectorConfig,
    Trunks,
    detect_trees,
    find_trunks,
    half_chord_moments,
)
from tests.reference.trees import detect_scan, moments
from tests.reference.trunk_world import cast, one_trunk_scans

BEARINGS = np.deg2rad(np.arange(361) * 0.5 - 90.0)
STEP = np.deg2rad(0.5)


def scans_of(ranges: np.ndarray) -> LaserScans:
    ranges = np.atleast_2d(ranges)
    return LaserScans(times=np.arange(len(ranges)) * 0.2, ranges=ranges, bearings=BEARINGS, max_range=80.0)


def park(rng: np.random.Generator, n: int) -> np.ndarray:
    """Scans of crowded scenes: trunks, bushes (noisy), near posts, dropouts, NaN: everything the rules must judge."""
    out = np.empty((n, 361))
    for k in range(n):
        count = int(rng.integers(0, 40))
        polar = np.stack([rng.uniform(1.5, 74, count), rng.uniform(-1.57, 1.57, count)], -1)
        centres = polar[:, :1] * np.stack([np.cos(polar[:, 1]), np.sin(polar[:, 1])], -1)
        r = cast(centres, rng.uniform(0.03, 0.8, count), BEARINGS, 81.91)
        hit = r < 80
        r[hit] += rng.choice([0.02, 0.02, 0.2]) * rng.standard_normal(int(hit.sum()))
        r[rng.random(361) < 0.02] = 81.87
        r[rng.random(361) < 0.01] = np.nan
        r[rng.random(361) < 0.003] = 0.0
        out[k] = r
    return out


@pytest.mark.parametrize("others", [{}, {"ISOLATION": 0.5, "MAX_MISSING": 1, "MIN_BEAMS": 2, "FIT_BEAMS": 4}])
def test_equals_the_slow_twin_on_crowded_scenes(
    rng: np.random.Generator, others: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scans, config = scans_of(park(rng, 150)), TreeDetectorConfig()
    for name, value in others.items():
        monkeypatch.setattr(trees, name, value)
    fast = find_trunks(scans, config)
    slow = [(k, t) for k, r in enumerate(scans.ranges) for t in detect_scan(r, BEARINGS, config)]
    assert len(slow) > 100
    np.testing.assert_array_equal(fast.scan, [k for k, _ in slow])
    np.testing.assert_array_equal(fast.beams, [t.beams for _, t in slow])
    # At the very gate of the circle fit the two optimisers may part; they must not do so often.
    same = fast.fitted == np.array([t.fitted for _, t in slow])
    assert same.mean() > 0.99
    for name, value, tolerance in (
        ("ranges", [t.range for _, t in slow], 1e-6),
        ("bearings", [t.bearing for _, t in slow], 1e-7),
        ("radii", [t.radius for _, t in slow], 1e-6),
    ):
        np.testing.assert_allclose(getattr(fast, name)[same], np.array(value)[same], atol=tolerance)
    sigmas = np.array([[t.sigma_range, t.sigma_bearing] for _, t in slow])
    np.testing.assert_allclose(fast.sigmas[same], sigmas[same], rtol=2e-3)
    assert (fast.fitted & same).sum() > 10


def test_half_chord_moments_are_those_of_uniform_edges(rng: np.random.Generator) -> None:
    mean, variance = half_chord_moments(361)
    assert mean[1] == pytest.approx(4 / 9, abs=1e-12)
    assert variance[1] == pytest.approx(1 / 4 - 16 / 81, abs=1e-12)
    for n in (1, 2, 3, 4, 7, 12):
        m, v = moments(n)
        assert mean[n] == pytest.approx(m, rel=1e-6)
        assert variance[n] == pytest.approx(v, rel=1e-4)
        u, w = rng.random((2, 400_000))
        far, near = n // 2, n // 2 if n % 2 else n // 2 - 1
        g = np.sqrt((far + u) * (near + w))
        if n % 2 == 0:
            g = 0.5 * (g + np.sqrt((near + u) * (far + w)))
        assert mean[n] == pytest.approx(g.mean(), abs=5 * g.std() / math.sqrt(len(g)))
        assert variance[n] == pytest.approx(g.var(), rel=0.02)


def normalised(found: Trunks, truth: np.ndarray) -> np.ndarray:
    error = np.stack([found.ranges, found.bearings], -1) - truth[found.scan]
    return error / found.sigmas


@pytest.mark.parametrize(
    ("half_angle", "distance", "beams"),
    [
        ((0.0, STEP), (8.0, 45.0), (1, 1)),
        ((0.0, 2.6 * STEP), (8.0, 20.0), (2, 4)),
        ((2 * STEP, 10 * STEP), (3.0, 8.0), (5, 18)),
    ],
)
def test_stated_covariance_is_that_of_the_errors(
    rng: np.random.Generator,
    half_angle: tuple[float, float],
    distance: tuple[float, float],
    beams: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two-sided, by number of beams: one (closed form), a few (closed form), many (circle fit)."""
    monkeypatch.setattr(trees, "MAX_DEPTH", 2.0)
    config = TreeDetectorConfig(max_width=2.0)
    scans, truth, _ = one_trunk_scans(rng, BEARINGS, n=6000, distance=distance, half_angle=half_angle, sigma=0.03)
    found = find_trunks(scans_of(scans), config)
    keep = (found.beams >= beams[0]) & (found.beams <= beams[1])
    e = normalised(found, truth)[keep]
    n = len(e)
    assert n > 1500
    # bias: less than 0.1 sigma; spread: mean square one, two-sided (4 sigma of a mean of n squares: 10-14 %)
    assert np.all(np.abs(e.mean(0)) < 0.1), e.mean(0)
    assert np.all(np.abs((e**2).mean(0) - 1.0) < 4 * np.sqrt(2 / n)), (e**2).mean(0)


def test_trunk_radius_and_fit_beat_the_closed_form(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    scans, truth, radii = one_trunk_scans(rng, BEARINGS, n=3000, distance=(2.0, 8.0), radius=(0.1, 0.4), sigma=0.03)
    error = {}
    for fit_beams in (5, 400):
        monkeypatch.setattr(trees, "FIT_BEAMS", fit_beams)
        found = find_trunks(scans_of(scans), TreeDetectorConfig())
        many = found.beams >= 5
        assert found.fitted[many].mean() > (0.95 if fit_beams == 5 else -1)
        assert not found.fitted[~many].any()
        error[fit_beams] = np.std(found.ranges[many] - truth[found.scan[many], 0])
        radius_error = found.radii[many] - radii[found.scan[many]]
        assert abs(np.median(radius_error)) < 0.005
    assert error[5] < 0.9 * error[400]


def test_sigmas_fixed_and_fit(rng: np.random.Generator) -> None:
    scans, _, _ = one_trunk_scans(rng, BEARINGS, n=50, distance=(5, 45), radius=(0.1, 0.4), sigma=0.02)
    fixed = detect_trees(scans_of(scans))
    np.testing.assert_allclose(fixed.sigmas[:, 0], 0.08 + 0.001 * fixed.ranges)
    np.testing.assert_allclose(fixed.sigmas[:, 1], np.deg2rad(0.5))
    fit = detect_trees(scans_of(scans), TreeDetectorConfig(noise="fit"))
    np.testing.assert_array_equal(fit.ranges, fixed.ranges)
    far = fit.ranges > 35
    assert fit.sigmas[far, 0].mean() > 1.5 * fit.sigmas[fit.ranges < 10, 0].mean()


def ring(trunks: list[tuple[float, float, float]]) -> np.ndarray:
    p = np.array(trunks)
    centres = p[:, :1] * np.stack([np.cos(p[:, 1]), np.sin(p[:, 1])], -1)
    return cast(centres, p[:, 2], BEARINGS, 81.91)


@pytest.mark.parametrize(
    ("trunks", "expected"),
    [
        ([(10.0, 0.0, 0.2)], 1),
        ([(10.0, 0.0, 0.2), (10.0, 0.5, 0.2)], 2),
        ([(10.0, 0.0, 0.2), (12.0, 0.1, 0.2)], 0),  # 2.2 m apart: neither is isolated
        ([(10.0, 0.0, 0.9)], 0),  # too wide
        ([(10.0, np.pi / 2, 0.3)], 0),  # cut by the edge of the scan
        ([(20.0, 0.0, 0.3), (5.0, 0.03, 0.1)], 1),  # the far one is half hidden by the near one, which is whole
        ([(76.0, 0.0, 0.5)], 0),  # beyond max_range
    ],
)
def test_rules(trunks: list[tuple[float, float, float]], expected: int) -> None:
    assert len(detect_trees(scans_of(ring(trunks))).ranges) == expected


def test_empty_nan_and_single_scans() -> None:
    nothing = detect_trees(scans_of(np.full((3, 361), 81.91)))
    assert list(nothing.offsets) == [0, 0, 0, 0]
    assert len(detect_trees(scans_of(np.full((1, 361), np.nan))).ranges) == 0
    assert len(detect_trees(scans_of(np.full((1, 361), -1.0))).ranges) == 0
    none = detect_trees(scans_of(np.zeros((0, 361))))
    assert list(none.offsets) == [0]
    # NaN beside a trunk is "no return": same answer as with the no-return range
    scan = ring([(10.0, 0.0, 0.2)])
    holes = np.where(scan > 80, np.nan, scan)
    np.testing.assert_array_equal(detect_trees(scans_of(holes)).ranges, detect_trees(scans_of(scan)).ranges)


def test_float32_and_uneven_beams() -> None:
    scan = ring([(10.0, 0.0, 0.2)])
    assert detect_trees(scans_of(scan.astype(np.float32))).ranges == pytest.approx(
        detect_trees(scans_of(scan)).ranges, abs=1e-5
    )
    bent = LaserScans(
        times=[0.0], ranges=scan[None], bearings=BEARINGS + 0.001 * BEARINGS**2 * np.sign(BEARINGS), max_range=80
    )
    with pytest.raises(DataError, match="evenly spaced"):
        detect_trees(bent)


@pytest.mark.parametrize(
    "bad",
    [
        {"noise": "guess"},
        {"max_range": 0.0},
        {"range_slope": -1.0},
        {"max_width": 0.0},
        {"bearing_sigma": float("nan")},
    ],
)
def test_impossible_configuration_is_refused(bad: dict) -> None:
    with pytest.raises(ConfigError, match="tree detector"):
        TreeDetectorConfig(**bad)
