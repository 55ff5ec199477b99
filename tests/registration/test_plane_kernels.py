"""Eigenvalues of small matrices and shapes of neighbourhoods against NumPy, over nine orders of magnitude."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.random import SeedTree
from graphslam.registration.plane_kernels import fit_surfaces, principal_axes, symmetric_eigen
from graphslam.registration.target import Target


def neighbourhoods(d: int, count: int = 400, m: int = 10) -> np.ndarray:
    """``(count, m, d)``: Gaussian points with random axes and scales."""
    rng = SeedTree(3).child("neighbourhoods", d).generator()
    x = rng.standard_normal((count, m, d)) * 10.0 ** rng.uniform(-6.0, 3.0, (count, 1, d))
    return np.einsum("kni,kij->knj", x, np.linalg.qr(rng.standard_normal((count, d, d)))[0])


@pytest.mark.parametrize("d", [2, 3])
def test_axes_are_those_of_numpy(d: int) -> None:
    x = neighbourhoods(d)
    rows = np.arange(x.size // d).reshape(x.shape[:2])
    spread, axes = np.empty((len(x), d)), np.empty((len(x), d, d))
    principal_axes(x.reshape(-1, d), rows, spread, axes)
    C = np.array([np.cov(p.T, bias=True) for p in x])
    largest = np.linalg.norm(C, axis=(1, 2))[:, None]
    assert np.max(np.abs(spread - np.linalg.eigvalsh(C)) / largest) < 1e-14
    assert np.max(np.abs(C @ axes - axes * spread[:, None]) / largest[:, :, None]) < 1e-14
    assert np.max(np.abs(np.swapaxes(axes, 1, 2) @ axes - np.eye(d))) < 1e-14


@pytest.mark.parametrize(
    "A", [np.zeros((3, 3)), np.eye(3), np.diag([2.0, 0.0, 1.0]), np.ones((3, 3)), 1e-200 * np.eye(2)]
)
def test_equal_and_zero_eigenvalues(A: np.ndarray) -> None:
    w, V = np.empty(len(A)), np.empty_like(A)
    symmetric_eigen(A.copy(), w, V)
    np.testing.assert_allclose(w, np.linalg.eigvalsh(A), atol=1e-15)
    np.testing.assert_allclose(V @ np.diag(w) @ V.T, A, atol=1e-15)


def test_surfaces_of_incomplete_neighbourhoods() -> None:
    x = SeedTree(5).generator().standard_normal((20, 3)) * np.array([0.5, 0.01, 1.0])
    rows = np.arange(20).reshape(2, 10)
    rows[0, 7:], rows[1, 3:] = -1, -1
    normal, flat, tilt = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 2, 3))
    fit_surfaces(x, rows, 6, normal, flat, tilt)
    C = np.cov(x[:7].T, bias=True)
    np.testing.assert_allclose(flat[0], np.linalg.eigvalsh(C), rtol=1e-9)
    assert np.linalg.norm(C @ normal[0] - flat[0, 0] * normal[0]) < 1e-12 * flat[0, 2]
    sigmas = np.sqrt(flat[0, 0] / (4 * flat[0, 1:]))  # seven points, three parameters
    np.testing.assert_allclose(np.linalg.norm(tilt[0], axis=1), sigmas, rtol=1e-9)
    assert np.all(np.isnan(flat[1]))
    assert not np.any(tilt[1])


@pytest.mark.parametrize("d", [2, 3])
def test_normals_of_a_cloud_are_those_of_its_nearest_points(d: int) -> None:
    rng = SeedTree(4).generator()
    p = rng.uniform(-1.0, 1.0, (300, d))
    p[:, 0] *= 1e-3
    normals, _ = Target(p).normals(np.arange(300))
    for k in range(0, 300, 30):
        near = p[np.argsort(np.linalg.norm(p - p[k], axis=1))[:10]]
        expected = np.linalg.eigh(np.cov(near.T))[1][:, 0]
        assert abs(normals[k] @ expected) == pytest.approx(1.0, abs=1e-12) or not np.any(normals[k])
    assert np.mean(np.any(normals != 0.0, axis=1)) > 0.8
