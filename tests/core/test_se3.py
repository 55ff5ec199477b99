"""Rotations one by one and together."""

from __future__ import annotations

import numpy as np

from graphslam.core import se3


def test_a_single_rotation_has_the_bits_of_the_same_rotation_among_others(rng: np.random.Generator) -> None:
    """Single quaternions and matrices are computed in scalars, others by NumPy."""
    p, q = rng.normal(size=(2, 200, 4))
    q[::7, 0], q[::11, 3], p[3] = -0.0, -0.0, [1.0, 0.0, 0.0, 0.0]
    v = rng.normal(size=(200, 3))
    R = se3.quat_to_matrix(se3.quat_normalize(p))
    for call, *blocks in (
        (se3.quat_normalize, q),
        (se3.quat_multiply, p, q),
        (se3.quat_rotate, q, v),
        (se3.matrix_to_quat, R),
    ):
        together = call(*blocks)
        for k in range(200):
            assert call(*(b[k] for b in blocks)).tobytes() == together[k].tobytes()
            assert call(*(b[k : k + 1] for b in blocks)).shape == together[k : k + 1].shape
