"""Summary statistics of a set of errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import ArrayLike


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of ``count`` non-negative errors, in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    std: float
    minimum: float
    p95: float
    maximum: float
    count: int

    @classmethod
    def of(cls, errors: ArrayLike) -> ErrorStatistics:
        """Statistics of ``(n,)`` errors."""
        e = np.asarray(errors, dtype=np.float64).ravel()
        if not len(e):
            raise DataError("no errors to summarise", got=0, wanted="at least one pair of estimate and reference")
        if not np.all(np.isfinite(e)):
            k = int(np.flatnonzero(~np.isfinite(e))[0])
            raise DataError(f"error {k} is not finite", got=e[k], wanted="finite numbers")
        return cls(
            rmse=float(np.sqrt(np.mean(e**2))),
            mean=float(np.mean(e)),
            median=float(np.median(e)),
            std=float(np.std(e)),
            minimum=float(np.min(e)),
            p95=float(np.quantile(e, 0.95)),
            maximum=float(np.max(e)),
            count=len(e),
        )

    def as_dict(self) -> dict[str, float | int]:
        """Plain dictionary, for tables and JSON."""
        return asdict(self)
