"""What a filter leaves of the errors of dead reckoning, against paths that were driven with such errors."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.poses import SE2, SE3, Group, remove_roll_pitch
from graphslam_frontends.grid import filter_error_model
from graphslam_frontends.grid.filter_error_model import PASSED, ErrorPassThrough, FilterDrift, interpolate_covariances

MODEL = FilterDrift(heading_walk=0.01, position_walk=0.03, position_scale=0.01, few=5.0, alone_walk=0.03)


def _bend(group: Group, n: int = 60, pitch: float = 0.0) -> np.ndarray:
    """40 m, half of them straight, then a left turn and on."""
    step = np.zeros((n, group.dof))
    step[:, group.position.start] = 40.0 / n
    step[n // 2 : n // 2 + 12, group.heading] = np.pi / 24
    if pitch:
        step[5, 1] = pitch
    poses = [group.identity]
    for u in group.exp(step):
        poses.append(group.compose(poses[-1], u))
    return np.array(poses)


@pytest.mark.parametrize(("group", "particles"), [(SE2, 40), (SE3, 5)])
def test_covariance_is_that_of_many_drives(group: Group, particles: int) -> None:
    """A heading that walks, positions that walk, wheels that are off by a factor, and a height told by a gravity that
    is off by the same all the way."""
    rng = np.random.default_rng(1)
    true = _bend(group)
    u = group.log(group.between(true[:-1], true[1:]))
    m, more, length = 4000, 1.0 + MODEL.few / particles, 40.0 / len(u)
    T = np.tile(group.identity, (m, 1))
    x = group.position.start
    wheels = 1.0 + MODEL.position_scale * rng.standard_normal((m, 1))
    for k in range(len(u)):
        noise = np.zeros((m, group.dof))
        noise[:, group.heading] = MODEL.heading_walk * np.sqrt(more * length) * rng.standard_normal(m)
        noise[:, x : x + 2] = MODEL.position_walk * np.sqrt(more * length) * rng.standard_normal((m, 2))
        if group.dim == 3:
            noise[:, 5] = MODEL.height_walk * np.sqrt(length) * rng.standard_normal(m)
        driven = np.repeat(u[k][None], m, axis=0)
        driven[:, group.position] *= wheels
        T = group.compose(group.compose(T, group.exp(driven)), group.exp(noise))
    T[:, 2] += 0.0 if group.dim == 2 else filter_error_model.HEIGHT_SCALE * 40.0 * rng.standard_normal(m)
    e = group.log(group.between(np.broadcast_to(true[-1], T.shape), T))
    drawn = e.T @ e / m
    C = MODEL.covariance(true, particles)
    kept = [group.heading, x, x + 1] + ([5] if group.dim == 3 else [])
    got, wanted = C[np.ix_(kept, kept)], drawn[np.ix_(kept, kept)]
    sigma = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(got / np.outer(sigma, sigma), wanted / np.outer(sigma, sigma), atol=0.07)
    assert abs(wanted[0, 2]) > 0.5 * sigma[0] * sigma[2]  # heading and what it moves to the side go together
    nees = np.einsum("ni,ni->n", e[:, kept], np.linalg.solve(got, e[:, kept].T).T)
    assert 0.93 < nees.mean() / len(kept) < 1.07


def test_how_many_particles_and_how_far() -> None:
    path = _bend(SE3)
    few, some, many = (np.diag(MODEL.covariance(path, n)) for n in (2, 5, 40))
    assert np.all(few >= some)
    assert np.all(some >= many)
    assert some[2] > 1.5 * many[2]
    assert MODEL.covariance(path, 1)[2, 2] > few[2]  # nobody corrects it
    lengths = [np.trace(MODEL.covariance(path[: k + 1], 20)) for k in (1, 10, 30, 60)]
    assert np.all(np.diff(lengths) > 0)


def test_frames_at_the_end_are_level_where_submaps_are() -> None:
    """On a ramp the error of the heading turns about the vertical, not about the body's own axis."""
    path = _bend(SE3, pitch=-0.3)
    flat = np.array(remove_roll_pitch(path))
    leaning = MODEL.covariance(path, 20)
    np.testing.assert_allclose(leaning, MODEL.covariance(np.vstack([path[:-1], flat[-1:]]), 20), atol=1e-12)
    assert np.abs(MODEL.covariance(path, 20, gravity=False) - leaning).max() > 1e-4
    np.linalg.cholesky(MODEL.covariance(path[:1], 20))  # no way: the starts alone


@pytest.mark.parametrize("group", [SE2, SE3])
def test_a_single_step_by_hand(group: Group) -> None:
    """A heading that errs at the start moves the end to the left by the way; one that errs at the end does not."""
    path = np.stack([group.identity, group.identity])
    path[1, 0] = 2.0
    C = MODEL.covariance(path, 20, gravity=False)
    y, walk = group.position.start + 1, MODEL.heading_walk**2 * (1.0 + MODEL.few / 20) * 2.0
    assert C[group.heading, group.heading] == pytest.approx(filter_error_model.HEADING_START**2 + walk)
    assert C[group.heading, y] == pytest.approx(0.5 * walk * 2.0)


def test_impossible_models_and_paths() -> None:
    with pytest.raises(ConfigError, match="heading_walk"):
        FilterDrift(heading_walk=-1.0)
    with pytest.raises(ConfigError, match="singular"):
        FilterDrift(tilt=0.0)
    with pytest.raises(DataError, match="no path or no particle"):
        MODEL.covariance(np.zeros((0, 7)), 5)
    with pytest.raises(DataError, match="no path or no particle"):
        MODEL.covariance(_bend(SE2), 0)


# --- what is passed on -------------------------------------------------------------------------------------------


def _reckoned(d: int, seed: int = 3) -> np.ndarray:
    A = np.random.default_rng(seed).standard_normal((d, d))
    return A @ A.T


@pytest.mark.parametrize(("dim", "tilt"), [(3, None), (6, None), (6, 0.01)])
def test_errors_of_which_a_share_is_passed_on_have_that_covariance(dim: int, tilt: float | None) -> None:
    """Drawn: of every error of dead reckoning its share reaches the end, and the floor pulls by tilt² a metre."""
    passed, O, rng = (
        ErrorPassThrough(heading=0.5, position=0.8, height_tilt=200.0),
        _reckoned(dim),
        np.random.default_rng(0),
    )
    share = {3: [0.8, 0.8, 0.5], 6: [0.5, 0.5, 0.5, 0.8, 0.8, 0.8]}[dim]
    if tilt is not None:  # roll, pitch and heights are gravity's
        share = [0.0, 0.0, 0.5, 0.8, 0.8, 0.0]
    e = np.array(share) * rng.multivariate_normal(np.zeros(dim), O, 40_000)
    if tilt is not None:
        e[:, 5] += 200.0 * tilt**2 * 30.0 * rng.standard_normal(len(e))
    C = passed.covariance(O, 30.0, 20, tilt=tilt)
    sigma = np.sqrt(np.diag(C) + 1e-12)
    np.testing.assert_allclose(C / np.outer(sigma, sigma), e.T @ e / len(e) / np.outer(sigma, sigma), atol=0.03)


def test_a_single_particle_passes_everything_on_and_more_never_less_than_nothing() -> None:
    path, O = _bend(SE3), 0.01 * _reckoned(6)
    assert np.array_equal(ErrorPassThrough().covariance(O, 40.0, 1, tilt=0.01), O)
    quiet = FilterDrift(few=0.0)
    # of one the heading walks as dead reckoning says, not as the robot that the model was fitted to
    assert quiet.covariance(path, 1, reckoned=O) - O == pytest.approx(quiet.covariance(path, 40))
    for tilt in (None, 0.005):
        more = MODEL.covariance(path, 20, reckoned=O, tilt_sigma=tilt) - MODEL.covariance(path, 20)
        assert np.linalg.eigvalsh(more).min() > -1e-12  # the fitted constants are a floor
        assert more == pytest.approx(PASSED.covariance(O, 40.0, 20, tilt=tilt), rel=1e-3, abs=1e-12)


def test_impossible_shares_are_refused() -> None:
    for bad in ({"heading": -0.1}, {"position": 1.1}, {"height_tilt": np.nan}):
        with pytest.raises(ConfigError, match="passed on"):
            ErrorPassThrough(**bad)


@pytest.mark.parametrize("group", [SE2, SE3])
def test_between_knots_covariances_are_those_of_a_slow_twin(group: Group) -> None:
    poses = _bend(group)
    n, d = len(poses), group.dof
    along = np.linspace(0.0, 40.0, n)
    knots = np.array([0, 20, 45, n - 1])
    C = np.array([k * _reckoned(d, 5) + np.eye(d) for k in range(4)])
    got = interpolate_covariances(knots, C, poses, along)
    assert got[knots] == pytest.approx(C)
    for at in (7, 33, 58):
        j = int(np.searchsorted(knots, at)) - 1
        u = (at - knots[j]) / (knots[j + 1] - knots[j])
        total = np.zeros((d, d))
        for knot, share in ((j, 1.0 - u), (j + 1, u)):
            turn = group.between(poses[at], poses[knots[knot]])  # the same error, told in the axes of the body there
            turn[: group.dim] = 0.0
            A = group.adjoint(turn)
            total += share * A @ C[knot] @ A.T
        np.testing.assert_allclose(got[at], total, atol=1e-9)
