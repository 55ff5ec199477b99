"""How every compiled function of the package is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from graphslam.core.jit import njit


def kernel(*, error_model: str = "python") -> Callable[[Any], Any]:
    """Compiled on first use, kept on disk, runs beside other threads.

    Nobody calls a kernel from C, and a wrapper for that would be a fifteenth of the time it takes to compile.
    """
    return njit(nogil=True, no_cfunc_wrapper=True, error_model=error_model)  # type: ignore[no-any-return]
