"""Arrays of MATLAB ``.mat`` files (version 7 and older), by name."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.geometry import Array


def read_mat(path: str | os.PathLike[str], *names: str) -> tuple[Array, ...]:
    """The numeric arrays ``names`` of a ``.mat`` file, as float64.

    Raises
    ------
    MissingDataError
        No such file.
    FormatError
        Truncated, corrupt, of another format, without one of the arrays, or with something else under its name.
    """
    import scipy.io
    from scipy.io.matlab import MatReadError

    where = str(path)
    if not Path(path).is_file():
        raise MissingDataError("no such file", where=where)
    try:
        content: dict[str, Any] = scipy.io.loadmat(where, variable_names=list(names))
    except (
        *(MatReadError, zlib.error, OSError, EOFError, NotImplementedError, MemoryError),
        *(ValueError, TypeError, KeyError, IndexError, OverflowError, AttributeError),
    ) as error:  # what scipy lets through for a header or a length that is nonsense
        raise FormatError(f"not a MATLAB file, or truncated ({error})", where=where) from None
    out = []
    for name in names:
        value = content.get(name)
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            raise FormatError(
                f"holds no numeric array {name!r}",
                where=where,
                got="nothing" if value is None else getattr(value, "dtype", type(value).__name__),
                wanted=", ".join(names),
            )
        out.append(np.ascontiguousarray(value, dtype=np.float64))
    return tuple(out)
