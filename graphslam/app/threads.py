"""One BLAS thread for everything the application does.

The matrices are small and many: threads of a linear-algebra library wait for each other and cost up to ten times more
than they give. The order of their sums would also depend on the machine, and the same seed must give the same bytes.
"""

from __future__ import annotations

from threadpoolctl import threadpool_limits


def one_blas_thread() -> threadpool_limits:
    """Context in which BLAS works on one thread; the caller's setting comes back at its end."""
    return threadpool_limits(limits=1, user_api="blas")
