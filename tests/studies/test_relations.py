"""Relation errors: against a loop over matrices, blind to the frame, and not to what is bent."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import rotation2, se2_compose
from graphslam.core.trajectory import Trajectory
from graphslam_studies.evaluate.relations import consecutive_pairs, covered_part, random_pairs, relation_error


def winding(dim: int, n: int = 60) -> Trajectory:
    s = 0.1 * np.arange(n)
    if dim == 2:
        return Trajectory(s, np.column_stack([4 * np.cos(s), 3 * np.sin(s), s % 3.0 - 1.5]))
    turn = se3.so3_exp(np.column_stack([0.2 * np.sin(s), 0.3 * np.cos(2 * s), 0.9 * np.sin(s)]))
    return Trajectory(s, np.concatenate([np.column_stack([4 * np.cos(s), 3 * np.sin(s), 0.1 * s]), turn], axis=1))


def planar_matrix(T: np.ndarray) -> np.ndarray:
    M = np.eye(3)
    M[:2, :2], M[:2, 2] = rotation2(T[2]), T[:2]
    return M


@pytest.mark.parametrize("dim", [2, 3])
def test_equals_a_loop_over_matrices(dim: int, rng: np.random.Generator) -> None:
    reference = winding(dim)
    matrix = planar_matrix if dim == 2 else se3.pose_to_matrix
    noise = rng.normal(size=(60, 3 if dim == 2 else 6)) * 0.05
    poses = se2_compose(reference.poses, noise) if dim == 2 else se3.se3_compose(reference.poses, se3.se3_exp(noise))
    estimate = Trajectory(reference.times, poses)
    i, j = random_pairs(60, 40, rng)
    assert not np.any(i == j)
    error = relation_error(estimate, reference, (i, j))
    for k in range(40):
        R, E = (np.linalg.inv(matrix(t.poses[i[k]])) @ matrix(t.poses[j[k]]) for t in (reference, estimate))
        D = np.linalg.inv(R) @ E
        angle = np.arctan2(D[1, 0], D[0, 0]) if dim == 2 else np.arccos(np.clip((np.trace(D[:3, :3]) - 1) / 2, -1, 1))
        assert error.translation[k] == pytest.approx(np.linalg.norm(D[:dim, dim]), abs=1e-9)
        assert error.rotation[k] == pytest.approx(abs(angle), abs=1e-6)


def test_another_frame_is_no_error_and_a_bend_is_one_between_far_pairs_only() -> None:
    reference = winding(2)
    moved = reference.transformed(np.array([5.0, -3.0, 2.0]))
    for pairs in (consecutive_pairs(60), random_pairs(60, 100, np.random.default_rng(0))):
        assert relation_error(moved, reference, pairs).as_row()["translation_p95"] < 1e-9
    bent = reference.poses.copy()
    half = se2_compose(np.array([0.0, 0.0, 0.5]), bent[30:])  # the second half turned
    estimate = Trajectory(reference.times, np.concatenate([bent[:30], half]))
    near = relation_error(estimate, reference, consecutive_pairs(60))
    assert np.sum(near.rotation > 1e-9) == 1
    far = relation_error(estimate, reference, (np.arange(30), np.arange(30, 60)))
    np.testing.assert_allclose(far.rotation, 0.5)
    assert far.as_row()["rotation_mean_deg"] == pytest.approx(np.degrees(0.5))


def test_refusals() -> None:
    reference = winding(2)
    short = reference.take(np.arange(10, 50))
    with pytest.raises(DataError, match="20 poses of the reference lie outside"):
        relation_error(short, reference, consecutive_pairs(60))
    part = covered_part(reference, short)
    assert len(part) == 40
    assert relation_error(short, part, consecutive_pairs(40)).translation.max() < 1e-12
    with pytest.raises(DataError, match="dimension"):
        relation_error(winding(3), reference, consecutive_pairs(60))
    with pytest.raises(DataError, match="there are none"):
        relation_error(reference, reference, consecutive_pairs(1))
    with pytest.raises(DataError, match="too few"):
        random_pairs(1, 4, np.random.default_rng(0))
