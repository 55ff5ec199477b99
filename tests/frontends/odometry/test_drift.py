"""The drift model: variances that add, sideways and heading together, and parameters found again from samples."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.records import Odometry
from graphslam_frontends.odometry.drift import DriftModel, calibrate_drift, fit_drift
from graphslam_frontends.odometry.recorded import RecordedErrors

PURE = dict.fromkeys(
    ("position_walk", "position_scale", "z_walk", "z_scale", "heading_walk", "heading_scale", "bend"), 0.0
)

BENT = DriftModel(dim=2, position_start=0.01, position_walk=0.03, position_scale=0.0, heading_start=0.002,
                  heading_walk=0.002, heading_scale=0.001, bend=1.0)  # fmt: skip
"""As :func:`straight_errors` draws them."""


def test_each_term_is_what_it_says() -> None:
    model = DriftModel(**{**PURE, "position_walk": 0.02, "z_scale": 0.004, "heading_scale": 0.001})
    C = model.covariance(25.0)
    assert C[3, 3] == pytest.approx(model.position_start**2 + 0.02**2 * 25)
    assert C[5, 5] == pytest.approx(model.z_start**2 + 0.1**2)
    assert C[2, 2] == pytest.approx(model.heading_start**2 + 0.025**2)
    assert C[0, 0] == C[1, 1] == pytest.approx(model.tilt**2)
    np.testing.assert_array_equal(C, model(25.0))
    np.testing.assert_array_equal(C, np.diag(np.diag(C)))


@pytest.mark.parametrize("length", [0.0, 1.0, 40.0, 2000.0])
@pytest.mark.parametrize("dim", [2, 3])
def test_covariances_are_positive_definite_and_grow(length: float, dim: int) -> None:
    model = DriftModel(dim=dim, bend=1.0, heading_walk=0.001)
    C = model.covariance(length)
    assert C.shape == ((3, 3) if dim == 2 else (6, 6))
    np.linalg.cholesky(C)
    assert np.all(np.diag(model.covariance(length + 1.0)) >= np.diag(C))


def straight_errors(rng: np.random.Generator, lengths: np.ndarray, walk: float, scale: float) -> np.ndarray:
    """Errors ``(m, 3)`` of straight paths whose heading walks and bends, simulated centimetre by centimetre."""
    out = []
    for L in lengths:
        n = 200
        h = L / n
        psi = np.cumsum(walk * np.sqrt(h) * rng.normal(size=n)) + rng.normal() * scale * h * np.arange(1, n + 1)
        along = 0.03 * np.sqrt(L) * rng.normal() + 0.01 * rng.normal()
        side = h * psi.sum() + 0.03 * np.sqrt(L) * rng.normal() + 0.01 * rng.normal()
        out.append([along, side, psi[-1] + 0.002 * rng.normal()])
    return np.array(out)


def test_bent_paths_are_as_far_off_as_the_model_says(rng: np.random.Generator) -> None:
    model = BENT
    for L in (5.0, 40.0):
        e = straight_errors(rng, np.full(4000, L), 0.002, 0.001)
        ratio = np.linalg.solve(model.covariance(L), e.T @ e / len(e))
        np.testing.assert_allclose(np.linalg.eigvals(ratio).real, 1.0, atol=0.1)


def test_a_fit_to_samples_of_errors_finds_the_model(rng: np.random.Generator) -> None:
    lengths = rng.uniform(2.0, 60.0, size=4000)
    e = straight_errors(rng, lengths, 0.002, 0.001)
    model = fit_drift(lengths, e[:, :, None] * e[:, None, :])
    for L in (5.0, 20.0, 60.0):
        true = BENT.covariance(L)
        np.testing.assert_allclose(np.linalg.eigvals(np.linalg.solve(true, model.covariance(L))).real, 1.0, atol=0.3)
    assert model.bend == pytest.approx(1.0, abs=0.15)


def test_short_paths_do_not_hide_how_long_ones_bend(rng: np.random.Generator) -> None:
    """Of a path of some centimetres the errors are those at its start, which say nothing of how it bends."""
    lengths = rng.uniform(0.0, 60.0, size=400)
    e = straight_errors(rng, lengths, 0.002, 0.001)
    assert fit_drift(lengths, e[:, :, None] * e[:, None, :]).bend == pytest.approx(1.0, abs=0.2)


def test_a_fit_to_covariances_of_a_model_is_that_model() -> None:
    lengths = np.linspace(1.0, 80.0, 30)
    for true in (
        DriftModel(bend=0.5, heading_walk=0.001),
        DriftModel(bend=0.9, heading_walk=0.004, position_scale=0.003, position_walk=0.02, z_walk=0.01, tilt=0.02),
        DriftModel(dim=2, bend=0.0, heading_walk=0.0, heading_scale=0.0),
    ):
        model = fit_drift(lengths, np.array([true.covariance(L) for L in lengths]))
        for L in (3.0, 30.0, 80.0):
            np.testing.assert_allclose(model.covariance(L), true.covariance(L), rtol=0.03, atol=1e-9)
        assert model.dim == true.dim
        assert model.bend == pytest.approx(true.bend, abs=0.02)


def test_errors_a_tenth_as_large_give_parameters_a_tenth_as_large(rng: np.random.Generator) -> None:
    """What each path weighs in the fit goes by the errors themselves, however small they are."""
    lengths = rng.uniform(2.0, 20.0, size=300)
    errors = straight_errors(rng, lengths, 0.002, 0.001)
    errors[:, 2] += 0.02 * rng.normal(size=300)  # σ at no length far above the least one there is
    large, small = (fit_drift(lengths, (k * errors)[:, :, None] * (k * errors)[:, None, :]) for k in (1.0, 0.1))
    for name in ("start", "walk", "scale"):
        for what in ("position", "heading"):
            wanted = 0.1 * getattr(large, f"{what}_{name}")
            assert getattr(small, f"{what}_{name}") == pytest.approx(wanted, rel=1e-6), (what, name)
    assert small.bend == pytest.approx(large.bend, rel=1e-6)


def straight_drive() -> tuple[RecordedErrors, np.ndarray]:
    """80 m ahead with white noise of heading and distance, a constant yaw rate error and wheels 1 % off; and metres."""
    n, step = 801, 0.1
    odometry = Odometry(
        times=0.1 * np.arange(n),
        increments=np.vstack([np.zeros(3), np.tile([step, 0, 0], (n - 1, 1))]),
        covariances=np.tile(np.diag([0.004**2, 0.002**2, 0.0005**2]), (n, 1, 1)),
    )
    return RecordedErrors(odometry=odometry, yaw_bias=0.001, scale=0.01), step * np.arange(n)


def test_intervals_may_be_shorter_than_a_metre_and_those_of_no_length_are_left_out() -> None:
    errors, metres = straight_drive()
    model = calibrate_drift(errors, metres, lengths=(0.5, 1.0, 4.0), intervals=5)  # three lengths: none may be missing
    assert model.heading_walk == pytest.approx(0.0005 / np.sqrt(0.1), rel=0.05)
    assert calibrate_drift(errors, metres, lengths=(-1.0, 0.0, 0.5, 1.0, 4.0), intervals=5) == model
    # lengths that differ by millimetres are different ones, those that differ by arithmetic are not
    assert calibrate_drift(errors, metres / 25, lengths=(0.006, 0.01, 0.014), intervals=5).dim == 2
    with pytest.raises(DataError, match="too short"):
        calibrate_drift(errors, metres, lengths=(0.55, 0.58, 1.05), intervals=50)


def test_calibrated_on_planar_odometry() -> None:
    """Every parameter comes back."""
    errors, metres = straight_drive()
    step = metres[1]
    model = calibrate_drift(errors, metres)
    assert model.heading_walk == pytest.approx(0.0005 / np.sqrt(step), rel=0.05)
    assert model.heading_scale == pytest.approx(0.001, rel=0.02)  # 1 m/s
    assert model.bend == pytest.approx(1.0, abs=0.02)
    assert 0.006 < model.position_scale < 0.0101  # along 1 %, to the side nothing: the model has one σ for both
    assert model.dim == 2


def test_refusals() -> None:
    for bad in ({"dim": 4}, {"z_walk": -1.0}, {"heading_scale": np.nan}, {"heading_start": 0.0}, {"tilt": 0.0}):
        with pytest.raises(ConfigError, match="drift model"):
            DriftModel(**bad)
    DriftModel(dim=2, tilt=0.0, z_start=0.0)
    for length in (-1.0, np.nan, np.inf):
        with pytest.raises(DataError, match="length"):
            DriftModel().covariance(length)
    with pytest.raises(DataError, match="do not match"):
        fit_drift([1.0, 2.0], np.zeros((3, 6, 6)))
    with pytest.raises(DataError, match="too few"):
        fit_drift([1.0, 1.0, 2.0], np.zeros((3, 6, 6)))
    with pytest.raises(DataError, match="too few"):
        fit_drift([-1.0, 1.0, 2.0], np.zeros((3, 6, 6)))
    three = np.array([0.0, 1.0, 4.0])  # as many as there are terms: no length at all is one
    found = fit_drift(three, np.array([DriftModel().covariance(L) for L in three]))
    np.testing.assert_allclose(found.covariance(2.0), DriftModel().covariance(2.0), rtol=0.05, atol=1e-7)
    two = Odometry(times=np.arange(2.0), increments=np.array([[0, 0, 0], [0.1, 0, 0]]), covariances=np.zeros((2, 3, 3)))
    with pytest.raises(DataError, match="too short"):
        calibrate_drift(RecordedErrors(odometry=two), np.array([0.0, 0.1]))
