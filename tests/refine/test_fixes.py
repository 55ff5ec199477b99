"""Fixes in a refinement: derivatives, the frame they are in, errors that last, and what contradicts the scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.backend.refining import refinement_findings
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.refine.fixes import FixModel
from graphslam.refine.problem import RefinementProblem
from graphslam.refine.refine import refine_by_scans
from tests.refine.test_problem import dense_terms, some_problem
from tests.refine.world import court_scans

EPS = 1e-6
DATUM = np.array([400.0, -250.0, 30.0, 0.0, 0.0, np.sin(0.6), np.cos(0.6)])
"""``T_gps_world``: a shift, and a turn by 1.2 rad."""


def fixes_along(truth, times, rng, sigma=0.05, lever=(0.2, -0.1, 0.5), **more):
    """Fixes of an antenna on the body at the stamps of steps, in the frame of :data:`DATUM`."""
    g = group_of(truth)
    lever = np.array(lever[: g.dim])
    p = g.transform(DATUM, g.transform(truth, np.broadcast_to(lever, (len(truth), g.dim))))
    z = p + sigma * rng.standard_normal(p.shape)
    return Gps(times=times, positions=z, sigma=np.full(len(z), sigma), lever=lever, **more)


@pytest.fixture(scope="module")
def plain():
    """The drive of seed 3 refined without fixes."""
    scans, reckoned, _ = court_scans(3, beams=31)
    return refine_by_scans(scans, reckoned)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("correlated", [{}, {"bias_sigma": 0.5}, {"bias_sigma": 0.5, "bias_time": 6.0}])
def test_jacobians(rng, dim, correlated):
    problem, _, _, poses, states = some_problem(rng, dim)
    t = problem.motion.steps.times
    A = rng.standard_normal((9, dim, dim))
    gps = Gps(
        times=np.linspace(t[0] + 0.01, t[-1] - 0.01, 9),
        positions=rng.standard_normal((9, dim)) + 100.0,
        sigma=np.full(9, 0.3),
        lever=rng.standard_normal(dim),
        covariances=A @ np.swapaxes(A, 1, 2) + np.eye(dim),
    )
    config = GpsConfig(segment_gap=0.2, robust=RobustKernel("none"), **correlated)
    model = FixModel(gps, config, problem.motion, poses)
    problem = RefinementProblem(problem.motion, problem.cloud, poses[0].copy(), model)
    g = problem.motion.group
    datum = g.exp(0.3 * rng.standard_normal(g.dof))
    states = (*states, datum, rng.standard_normal((len(model.keep), dim)))
    assert len(model.keep) == (9 if correlated else 0)
    assert len(model.terms(poses, states)) == 1 + 2 * bool(correlated) + (dim == 3)
    for k, terms in enumerate(model.terms(poses, states)):
        _, J = dense_terms(terms, problem.widths)
        plain = np.zeros_like(J)
        for c in range(problem.widths.sum()):
            step = np.zeros(problem.widths.sum())
            step[c] = EPS
            up, down = (model.terms(*problem.moved(poses, states, s * step))[k].r for s in (1, -1))
            plain[..., c] = (up - down) / (2 * EPS)
        np.testing.assert_allclose(J, plain, atol=3e-5 * max(1.0, np.abs(plain).max()), err_msg=terms.name)


def test_fixes_hold_what_scans_and_motion_do_not(rng, plain):
    """The frame of the fixes is found, and the path in it is nearer the truth and surer."""
    scans, reckoned, truth = court_scans(3, beams=31)
    gps = fixes_along(truth[::3], scans.times[::3], rng, sigma=0.02)
    with_fixes = refine_by_scans(scans, reckoned, gps=(gps, GpsConfig(baseline=5.0)))
    assert with_fixes.fixes is not None
    assert with_fixes.fixes.used == len(gps.times)
    assert with_fixes.fixes.typical == pytest.approx(1.0, abs=0.35)
    assert with_fixes.fixes.wild <= 2
    assert not with_fixes.fixes.contradicted
    g = group_of(truth)
    off = g.log(g.between(DATUM, with_fixes.fixes.T_gps_world))
    assert np.linalg.norm(off[3:]) < 0.1
    assert np.linalg.norm(off[:3]) < 0.01
    # where the antenna was in the frame of the fixes, against the truth there
    lever = np.broadcast_to(gps.lever, (len(truth), 3))
    there = g.transform(with_fixes.fixes.T_gps_world, g.transform(with_fixes.poses, lever))
    true = g.transform(DATUM, g.transform(truth, lever))
    assert np.sqrt(np.mean(np.sum((there - true) ** 2, axis=1))) < 0.02
    assert plain.fixes is None
    assert np.trace(with_fixes.covariances[-1][3:, 3:]) < np.trace(plain.covariances[-1][3:, 3:])


def test_the_covariance_with_fixes_is_neither_too_small_nor_too_large():
    """Anchored NEES of many draws: first position and heading held, datum solved for."""
    values = []
    for seed in range(4):
        scans, reckoned, truth = court_scans(100 + seed)
        gps = fixes_along(truth[::5], scans.times[::5], np.random.default_rng(seed))
        found = refine_by_scans(scans, reckoned, gps=(gps, GpsConfig(baseline=5.0)))
        g = group_of(truth)
        e = g.log(g.between(truth, found.poses))
        k = np.arange(5, len(truth), 10)
        C = found.covariances[k] + 1e-10 * np.eye(6)
        values.append(np.mean(np.einsum("ki,kij,kj->k", e[k], np.linalg.inv(C), e[k])) / 6.0)
    assert 0.65 < np.mean(values) < 1.6  # half or twice the covariance would be outside


def test_errors_that_last_are_no_news_fix_after_fix(rng):
    """A bias of half a metre that wanders over a minute and is taken for white noise is found and told."""
    scans, reckoned, truth = court_scans(4)
    gps = fixes_along(truth, scans.times, rng, sigma=0.02)
    bias = np.zeros_like(gps.positions)
    for k in range(1, len(bias)):
        keep = np.exp(-(gps.times[k] - gps.times[k - 1]) / 60.0)
        bias[k] = keep * bias[k - 1] + np.sqrt(1 - keep**2) * 0.5 * rng.standard_normal(3)
    gps = replace(gps, positions=gps.positions + bias)
    white = refine_by_scans(scans, reckoned, gps=(gps, GpsConfig(baseline=5.0)))
    correlated = refine_by_scans(scans, reckoned, gps=(gps, GpsConfig(baseline=5.0, bias_sigma=0.5, bias_time=60.0)))
    assert white.fixes is not None
    assert correlated.fixes is not None
    assert white.fixes.contradicted
    assert not correlated.fixes.contradicted
    g = group_of(truth)
    errors = [np.sqrt(np.mean(g.log(g.between(truth, r.poses))[:, 3:] ** 2)) for r in (white, correlated)]
    assert errors[1] < errors[0]
    findings = {f.code: f for f in refinement_findings(white)}
    assert findings["refine-fixes"].level == "look"
    assert {f.code: f for f in refinement_findings(correlated)}["refine-fixes"].level == "good"


def test_fixes_that_do_not_say_where_north_is_hold_nothing(rng, plain):
    scans, reckoned, truth = court_scans(3, beams=31)
    gps = fixes_along(truth[:4], scans.times[:4], rng)
    found = refine_by_scans(scans, reckoned, gps=(gps, GpsConfig(baseline=20.0)))
    assert found.fixes is None
    np.testing.assert_array_equal(found.poses, plain.poses)


def test_fixes_outside_the_path_are_left_out_and_counted(rng):
    scans, reckoned, truth = court_scans(3, beams=31)
    gps = fixes_along(truth[::3], scans.times[::3], rng)
    late = replace(gps, times=gps.times + 0.5 * (scans.times[-1] - scans.times[0]))
    found = refine_by_scans(scans, reckoned, gps=(late, GpsConfig(baseline=1.0)))
    inside = int(np.sum(late.times <= scans.times[-1]))
    assert found.fixes is not None
    assert (found.fixes.used, found.fixes.left) == (inside, len(late.times) - inside)
