"""The drift model: variances that add, sideways and heading together."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam_studies.frontends.drift import DriftModel

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


def test_refusals() -> None:
    for bad in ({"dim": 4}, {"z_walk": -1.0}, {"heading_scale": np.nan}, {"heading_start": 0.0}, {"tilt": 0.0}):
        with pytest.raises(ConfigError, match="drift model"):
            DriftModel(**bad)
    DriftModel(dim=2, tilt=0.0, z_start=0.0)
    for length in (-1.0, np.nan, np.inf):
        with pytest.raises(DataError, match="length"):
            DriftModel().covariance(length)
