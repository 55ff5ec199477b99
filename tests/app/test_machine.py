"""Threads of linear algebra."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from graphslam.app.machine import one_blas_thread


def threads() -> set[int]:
    np.linalg.inv(np.eye(2))  # the library is loaded
    return {t["num_threads"] for t in threadpool_info() if t["user_api"] == "blas"}


def test_contexts_that_overlap_hold_one_thread_until_the_last_one_ends() -> None:
    """Two runs at a time: what one gave back at its end changed the last bits of the other."""
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        assert threads() == {1}
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == before
