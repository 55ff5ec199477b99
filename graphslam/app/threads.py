"""One BLAS thread for everything the application does.

The matrices are small and many: threads of a linear-algebra library wait for each other and cost up to ten times more
than they give. The order of their sums would also depend on the machine, and the same seed must give the same bytes.
"""

from __future__ import annotations

import os
import sys

from threadpoolctl import threadpool_limits


def one_blas_thread() -> threadpool_limits:
    """Context in which BLAS works on one thread; the caller's setting comes back at its end."""
    return threadpool_limits(limits=1, user_api="blas")


def hold_one_thread() -> None:
    """Hold BLAS, OpenMP and numba of this process to one thread, for good: for a worker among workers.

    Libraries that are loaded already are told; those that come later read the environment.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if (numba := sys.modules.get("numba")) is not None:
        numba.set_num_threads(1)  # its variable may not change any more once its threads run
    else:
        os.environ["NUMBA_NUM_THREADS"] = "1"
    threadpool_limits(limits=1)
