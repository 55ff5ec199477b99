"""Decorator with the numba options of all kernels of the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from graphslam.core.jit import njit


def kernel(*, error_model: str = "python") -> Callable[[Any], Any]:
    """Compiled at the first call and cached on disk; releases the GIL.

    The wrapper for calls from C is not needed; it would add a fifteenth to the compile time.
    """
    return njit(nogil=True, no_cfunc_wrapper=True, error_model=error_model)  # type: ignore[no-any-return]
