"""The submap contract: what it accepts, what it refuses, what it derives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.geometry import rotation2
from graphslam.core.submap import LandmarkMap, Submap


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n + 3))
    return A @ A.T * 0.01


def landmark_map(rng: np.random.Generator, **changes: Any) -> LandmarkMap:
    values: dict[str, Any] = {
        "ids": [4, 9],
        "exit_pose": [1.0, 2.0, 0.5],
        "positions": [[3.0, 4.0], [5.0, 6.0]],
        "covariance": covariance(rng, 7),
    }
    return LandmarkMap(**{**values, **changes})


def test_mean_is_the_vector_of_eq_15(rng: np.random.Generator) -> None:
    assert landmark_map(rng).mean.tolist() == [1.0, 2.0, 0.5, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("cov", "what"),
    [
        (np.zeros((7, 7)), "not positive definite"),
        (np.full((7, 7), np.nan), "not finite"),
        (np.triu(np.ones((7, 7))) + 7 * np.eye(7), "not symmetric"),
        (np.eye(5), "wrong shape"),
        (-np.eye(7), "not positive definite"),
        (np.eye(7) - 2 * np.outer(np.eye(7)[6], np.eye(7)[6]), "not positive definite"),
    ],
    ids=["zero", "nan", "asymmetric", "shape", "negative", "one negative"],
)
def test_bad_submap_covariance_is_refused(cov: np.ndarray, what: str, rng: np.random.Generator) -> None:
    with pytest.raises(CovarianceError, match=what):
        landmark_map(rng, covariance=cov)


@pytest.mark.parametrize(
    ("changes", "kind", "what"),
    [
        ({"ids": [4]}, GeometryError, "differ in number"),
        ({"exit_pose": [1.0, 2.0]}, GeometryError, "exit pose has the wrong shape"),
        ({"exit_pose": [1.0, np.nan, 0.0]}, GeometryError, "not finite"),
        ({"positions": [[3.0, np.inf], [5.0, 6.0]]}, GeometryError, "not finite"),
        ({"covariance": None}, CovarianceError, "either"),
        ({"information": sp.eye(7)}, CovarianceError, "either"),
        ({"covariance": None, "information": sp.eye(5)}, CovarianceError, "wrong shape"),
        ({"covariance": None, "information": sp.diags([np.nan] * 7)}, CovarianceError, "not finite"),
    ],
)
def test_bad_landmark_map_is_refused(changes: dict, kind: type, what: str, rng: np.random.Generator) -> None:
    with pytest.raises(kind, match=what):
        landmark_map(rng, **changes)


def test_information_and_covariance_are_the_same_map(rng: np.random.Generator) -> None:
    a = landmark_map(rng)
    b = landmark_map(rng, covariance=None, information=sp.csc_matrix(a.dense_information()))
    assert np.allclose(a.dense_covariance(), b.dense_covariance(), rtol=1e-6)
    assert np.allclose(a.dense_information(), b.dense_information(), rtol=1e-6)


def test_singular_information_is_named(rng: np.random.Generator) -> None:
    m = landmark_map(rng, covariance=None, information=sp.diags([1.0] * 6 + [0.0]))
    with pytest.raises(CovarianceError, match="singular"):
        m.dense_covariance()


def test_subset_is_a_marginal(rng: np.random.Generator) -> None:
    m = landmark_map(rng)
    for keep in ([1], [False, True]):
        s = m.subset(keep)
        assert s.ids.tolist() == [9]
        ix = [0, 1, 2, 5, 6]
        assert np.allclose(s.dense_covariance(), m.dense_covariance()[np.ix_(ix, ix)])
    assert len(m.subset([])) == 0


def test_exit_of_a_landmark_submap_is_in_the_tangent(rng: np.random.Generator) -> None:
    m = landmark_map(rng)
    s = Submap.from_landmarks(3, m)
    assert s.interval == (3.0, 4.0)
    R = rotation2(0.5)
    assert np.allclose(s.exit_covariance[:2, :2], R.T @ m.dense_covariance()[:2, :2] @ R)
    assert s.exit_covariance[2, 2] == pytest.approx(m.dense_covariance()[2, 2])


def test_three_dimensional_landmark_map(rng: np.random.Generator) -> None:
    m = LandmarkMap(ids=[1], exit_pose=[0, 0, 0, 0, 0, 0, 1.0], positions=[[1, 2, 3.0]], covariance=covariance(rng, 9))
    assert m.dim == 3
    assert np.allclose(Submap.from_landmarks(0, m).exit_covariance, m.dense_covariance()[:6, :6])


@pytest.mark.parametrize("interval", [(1.0, 1.0), (2.0, 1.0), (np.nan, 1.0)])
def test_empty_interval_is_refused(interval: tuple[float, float]) -> None:
    with pytest.raises(GeometryError, match="submap 5 is empty"):
        Submap(key=5, interval=interval, exit_pose=np.zeros(3), exit_covariance=np.eye(3))


def test_bad_exit_covariance_names_the_submap() -> None:
    with pytest.raises(CovarianceError, match="submap 5"):
        Submap(key=5, interval=(0, 1), exit_pose=np.zeros(3), exit_covariance=np.zeros((3, 3)))


def test_with_ids_renames_and_a_bare_submap_has_none(rng: np.random.Generator) -> None:
    s = Submap.from_landmarks(0, landmark_map(rng))
    assert s.with_ids([7, -1]).landmarks.ids.tolist() == [7, -1]
    assert s.landmarks.ids.tolist() == [4, 9]
    bare = Submap(key=0, interval=(0, 1), exit_pose=np.zeros(3), exit_covariance=np.eye(3))
    with pytest.raises(GeometryError, match="no landmarks"):
        bare.with_ids([1])
    assert "2 landmarks" in s._repr_html_()
