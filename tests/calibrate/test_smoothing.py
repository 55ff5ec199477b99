"""The compiled smoothing against a slow twin, and what it finds in windows whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.calibrate import kernels as K
from graphslam.calibrate.smoothing import (
    CONSTANTS,
    SIGMAS,
    START,
    Smoothing,
    SmoothingWindow,
    most_open_nuisances,
    renumber_slots,
)
from tests.reference.slow_smoothing import objective_and_step, residuals, states_of


def window(rng, n=7, landmarks=4, visits=2, bearings=True):
    """A window with everything in it, its states off their optimum."""
    steps = np.column_stack([rng.normal(0.5, 0.1, n), rng.normal(0, 0.05, n), rng.normal(0, 0.2, n)])
    steps = np.column_stack([steps, rng.uniform(0.1, 0.3, n), np.hypot(steps[:, 0], steps[:, 1]), np.zeros((n, 3))])
    steps[n - 1, 5:] = 0.01, 0.02, 0.03
    poses = np.zeros((n, 3))
    K.compose_steps(steps, np.array([0.3, -0.2, 0.1]), poses)
    poses[1:] += 0.03 * rng.standard_normal((n - 1, 3))
    places = rng.uniform(-4, 4, (landmarks, 2)) + [2.0, 0.0]
    slots, seen, first = [], [], [0]
    for k in range(n):
        for l in range(landmarks):
            if rng.random() < 0.7:
                d = places[l] - poses[k, :2]
                seen.append([np.hypot(*d) + rng.normal(0, 0.1), np.arctan2(d[1], d[0]) - poses[k, 2]])
                slots.append([l, landmarks + visits * l + k * visits // n if visits else -1])
        first.append(len(seen))
    seen = np.array(seen)
    if not bearings:
        seen[::2, 1] = np.nan
    slots, order = renumber_slots(np.array(slots, dtype=np.int64))
    kinds = (order >= landmarks).astype(np.int64)
    nuisance = np.where(kinds[:, None] == 1, 0.02 * rng.standard_normal((len(order), 2)), 0.0)
    nuisance[kinds == 0] = places[order[kinds == 0]] + 0.1 * rng.standard_normal((int((kinds == 0).sum()), 2))
    rows = np.arange(len(seen))
    return SmoothingWindow(
        np.arange(n) * 1.0, steps, np.array(first, dtype=np.int64), seen, slots, kinds, rows, poses, nuisance
    )


@pytest.mark.parametrize(("visits", "bearings"), [(0, True), (2, False), (2, True)])
def test_likelihood_and_step_are_those_of_dense_algebra(visits, bearings):
    rng = np.random.default_rng(4)
    windows = [window(rng, visits=visits, bearings=bearings) for _ in range(2)]
    s = Smoothing(windows, np.array([0.4, -0.1, 0.2]), CONSTANTS, ("range", "heading_metre"))
    s.constants[:] = 0.02 * rng.standard_normal(7)
    s.sigmas["range"] = 0.31
    wanted, step = objective_and_step(s)
    assert s.objective() == pytest.approx(wanted, abs=1e-3)
    before = states_of(s)
    moved = s.copy()
    moved.converge(iterations=1)
    np.testing.assert_allclose(states_of(moved) - before, step, atol=2e-5)


def test_a_nuisance_that_goes_early_leaves_its_place_to_another():
    """Many short visits: the border is as wide as there are at a time, and the algebra is that of all at once."""
    rng = np.random.default_rng(6)
    windows = [window(rng, n=20, landmarks=3, visits=7) for _ in range(2)]
    for w in windows:
        assert most_open_nuisances(w) <= 3 + 2 * 3 < len(w.nuisance) - 6
    s = Smoothing(windows, np.array([0.4, -0.1, 0.2]), CONSTANTS, ("range",))
    s.constants[:] = 0.02 * rng.standard_normal(7)
    wanted, step = objective_and_step(s)
    assert s.objective() == pytest.approx(wanted, abs=1e-3)
    before = states_of(s)
    moved = s.copy()
    moved.converge(iterations=1)
    np.testing.assert_allclose(states_of(moved) - before, step, atol=2e-5)


def test_settled_states_are_a_minimum_of_the_residuals():
    rng = np.random.default_rng(5)
    s = Smoothing([window(rng) for _ in range(2)], np.zeros(3), ("yaw_bias", "range_offset"), ())
    value = s.converge()
    x = states_of(s)
    assert value == pytest.approx(float(np.sum(residuals(s, x)[0] ** 2)), rel=1e-9)
    for _ in range(20):
        assert np.sum(residuals(s, x + 1e-3 * rng.standard_normal(len(x)))[0] ** 2) > value


@pytest.mark.parametrize("free", [CONSTANTS, ()])
def test_gradient_is_that_of_finite_differences(free):
    """With a step of stated variances, observations without a bearing, and visits that end before others begin."""
    rng = np.random.default_rng(6)
    windows = [window(rng, n=12, landmarks=3, visits=4), window(rng, bearings=False)]
    s = Smoothing(windows, np.array([0.4, -0.1, 0.2]), free, SIGMAS)
    s.constants[:] = 0.02 * rng.standard_normal(7)
    s.sigmas.update({name: START[name] * f for name, f in zip(SIGMAS, rng.uniform(0.5, 2.0, len(SIGMAS)))})
    _, found = s.gradient()
    for name, slope in zip(SIGMAS, found):
        up, down = (s.objective({name: s.sigmas[name] * np.exp(h)}) for h in (1e-4, -1e-4))
        assert slope == pytest.approx((up - down) / 2e-4, rel=1e-4, abs=1e-3), name
        assert abs(slope) > 0.0 or name.startswith("floor"), name
