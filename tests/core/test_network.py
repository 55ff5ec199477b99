"""PoseNetwork: what it refuses, what it repairs, what it counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.core.network import PoseNetwork, check_informations, repair_informations


def chain(n: int = 4, dim: int = 2, **changes: Any) -> PoseNetwork:
    """n vertices with ids 10, 20, … in a row, one metre apart."""
    width, d = (3, 3) if dim == 2 else (7, 6)
    poses, z = np.zeros((n, width)), np.zeros((n - 1, width))
    if dim == 3:
        poses[:, 6] = z[:, 6] = 1.0
    poses[:, 0], z[:, 0] = np.arange(n), 1.0
    arguments: dict[str, Any] = {
        "dim": dim,
        "ids": 10 * (1 + np.arange(n)),
        "poses": poses,
        "has_initial": np.ones(n, dtype=bool),
        "edges": np.stack([np.arange(n - 1), np.arange(1, n)], axis=1),
        "measurements": z,
        "information": np.tile(np.eye(d), (n - 1, 1, 1)),
    }
    return PoseNetwork(**{**arguments, **changes})


def test_counts_states_and_residuals() -> None:
    net = chain(4, 3)
    assert (net.states, net.residuals, net.tangent_dim) == (18, 18, 6)
    assert net.anchors.tolist() == [0]
    held = chain(4, fixed=np.array([False, True, False, True]))
    assert held.anchors.tolist() == [1, 3]
    assert held.states == 6
    assert "4 poses" in repr(net)


@pytest.mark.parametrize("dim", [2, 3])
def test_indefinite_information_names_the_edges(dim: int) -> None:
    info = np.tile(np.eye(3 if dim == 2 else 6), (3, 1, 1))
    info[1, 0, 1] = info[1, 1, 0] = 1.5
    with pytest.raises(CovarianceError, match=r"1 of 3 .*indefinite: 20 -> 30 \(smallest eigenvalue -0.5\)"):
        chain(4, dim, information=info)


def test_semidefinite_information_is_an_unmeasured_direction_and_accepted() -> None:
    info = np.tile(np.diag([1.0, 1.0, 0.0]), (3, 1, 1))
    assert np.array_equal(chain(4, information=info).information, info)


def test_asymmetric_and_nonfinite_information_are_refused() -> None:
    info = np.tile(np.eye(3), (3, 1, 1))
    info[2, 0, 1] = 1e-3
    with pytest.raises(CovarianceError, match="not symmetric: 30 -> 40"):
        chain(4, information=info)
    info[2, 0, 1] = np.nan
    with pytest.raises(CovarianceError, match="not finite: 30 -> 40"):
        chain(4, information=info)


def test_repair_is_the_nearest_matrix_and_leaves_sound_ones_alone(rng: np.random.Generator) -> None:
    A = rng.standard_normal((50, 6, 6))
    sound = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(6)
    w, V = np.linalg.eigh(sound)
    broken = sound.copy()
    w[::5, 0] = -0.7
    broken[::5] = np.einsum("kij,kj,klj->kil", V[::5], w[::5], V[::5])
    fixed, which = repair_informations(broken)
    assert which.tolist() == list(range(0, 50, 5))
    intact = np.setdiff1d(np.arange(50), which)
    assert np.array_equal(fixed[intact], broken[intact])
    assert np.linalg.eigvalsh(fixed)[:, 0].min() > 0.0
    # Frobenius distance to the cone is the norm of the negative part: here one eigenvalue of -0.7
    assert np.linalg.norm((fixed - broken)[which], axis=(1, 2)) == pytest.approx(0.7, rel=1e-6)
    assert len(check_informations(fixed, [""] * 50, what="matrices")) == 50


def test_repair_cannot_invent_information() -> None:
    with pytest.raises(CovarianceError, match="no positive eigenvalue"):
        repair_informations(-np.eye(3)[None])
    with pytest.raises(CovarianceError, match="not finite"):
        repair_informations(np.full((1, 3, 3), np.inf))


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"ids": np.array([1, 2, 2, 3])}, DataError, "vertex given twice"),
        ({"edges": np.array([[0, 1], [1, 1], [2, 3]])}, DataError, "to itself"),
        ({"edges": np.array([[0, 1], [1, 4], [2, 3]])}, DataError, "not there"),
        ({"poses": np.full((4, 3), np.nan)}, GeometryError, "pose is not finite: vertex 10"),
        ({"poses": np.zeros((4, 7))}, GeometryError, "wrong shape"),
        ({"measurements": np.full((3, 3), np.inf)}, GeometryError, "measurement is not finite: edge 10 -> 20"),
        ({"dim": 4}, DataError, "two- or three-dimensional"),
        ({"has_initial": np.zeros(4, bool), "fixed": np.ones(4, bool)}, DataError, "fixed vertex has no pose"),
    ],
)
def test_impossible_networks_are_refused(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        chain(4, **changes)


def test_quaternions_must_be_unit() -> None:
    poses = chain(4, 3).poses.copy()
    poses[2, 3:] = 0.0
    with pytest.raises(GeometryError, match="pose 2 has no unit quaternion"):
        chain(4, 3, poses=poses)


def test_arrays_are_frozen_and_own_copies_of_values_are_made() -> None:
    net = chain(4)
    with pytest.raises(ValueError, match="read-only"):
        net.poses[0, 0] = 1.0
    other = net.with_poses(net.poses + 1.0)
    assert other.poses[0, 0] == 1.0
    assert net.poses[0, 0] == 0.0
