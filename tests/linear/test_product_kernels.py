"""Products by blocks against products of whole matrices."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from graphslam.linear.product_kernels import subtract_product


@pytest.mark.parametrize(
    ("k", "m", "n"), [(1, 1, 1), (64, 64, 64), (63, 65, 130), (200, 17, 129), (3, 128, 1), (0, 5, 5)]
)
@pytest.mark.parametrize("turned", [False, True])
def test_product_is_subtracted(k: int, m: int, n: int, turned: bool, rng: np.random.Generator) -> None:
    A = rng.standard_normal((m, k)).T if turned else rng.standard_normal((k, m))
    B, C = rng.standard_normal((k, n)), rng.standard_normal((m + 2, n + 3))
    wanted = C.copy()
    wanted[1:-1, 2:-1] -= A.T @ B
    subtract_product(A, B, C[1:-1, 2:-1], False)
    np.testing.assert_allclose(C, wanted, rtol=0, atol=1e-12)


def test_upper_blocks_only(rng: np.random.Generator) -> None:
    A, C = rng.standard_normal((70, 150)), np.zeros((150, 150))
    subtract_product(A, A, C, True)
    wanted = -A.T @ A
    np.testing.assert_allclose(np.triu(C), np.triu(wanted), rtol=0, atol=1e-12)
    assert not C[64:, :64].any()


def test_threads_change_no_byte(rng: np.random.Generator) -> None:
    A, B = rng.standard_normal((300, 700)), rng.standard_normal((300, 500))
    found = []
    for threads in (1, 2):
        C = np.zeros((700, 500))
        with threadpool_limits(limits=threads, user_api="blas"):
            subtract_product(A, B, C, False)
        found.append(C.tobytes())
    assert found[0] == found[1]
