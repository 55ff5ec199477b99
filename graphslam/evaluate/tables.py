"""Statistics of a tidy Monte-Carlo table (``run, algorithm, submap, quantity, value``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.evaluate.consistency import Consistency, Unit

_INDEX = ["algorithm", "quantity", "submap"]


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Mean, standard error, median, extremes and number of runs per algorithm, quantity and submap.

    The median is there because means over few runs are ruled by the worst one.
    """
    groups = table.groupby(_INDEX, sort=True)["value"]
    out = groups.agg(["mean", "median", "std", "min", "max", "count"])
    out.insert(1, "standard_error", out["std"] / np.sqrt(out["count"]))
    return out.reset_index()


def values_of(table: pd.DataFrame, algorithm: str, quantity: str) -> tuple[Array, Array]:
    """Submap numbers ``(k,)`` and values ``(runs, k)`` of one curve; nan where a run has no figure.

    Raises
    ------
    DataError
        No such figures, or one stands twice.
    """
    rows = table[(table["algorithm"] == algorithm) & (table["quantity"] == quantity)]
    if rows.empty:
        raise DataError(f"table has no {quantity!r} of {algorithm!r}", wanted=sorted(set(table["quantity"])))
    if rows.duplicated(["run", "submap"]).any():
        raise DataError(f"{quantity!r} of {algorithm!r} stands twice in a run")
    wide = rows.pivot(index="run", columns="submap", values="value")
    return np.asarray(wide.columns, dtype=np.float64), wide.to_numpy(dtype=np.float64)


def consistency_of(
    table: pd.DataFrame,
    algorithm: str,
    quantity: str,
    *,
    dof: float,
    gauge: str,
    confidence: float = 0.95,
    unit: Unit = "run",
) -> tuple[Array, Consistency]:
    """Submap numbers and :class:`Consistency` of a NEES column."""
    submaps, values = values_of(table, algorithm, quantity)
    return submaps, Consistency(
        quantity=quantity, nees=values, dof=np.array(dof), gauge=gauge, confidence=confidence, unit=unit
    )


@dataclass(frozen=True, slots=True)
class PairedRatio:
    """How one algorithm compares with another over the same runs.

    Parameters
    ----------
    mean, half_width : float
        Mean of the per-run ratios a/b and 1.96 standard errors of it.
    geometric_mean : float
        Not ruled by single bad runs of b.
    wins, runs : int
        Runs in which a is smaller, and runs in all.
    """

    mean: float
    half_width: float
    geometric_mean: float
    wins: int
    runs: int


def paired_ratio(table: pd.DataFrame, quantity: str, a: str, b: str, *, submap: int = -1) -> PairedRatio:
    """Ratio of a positive figure of algorithms ``a`` and ``b``, run by run: runs differ far more than algorithms.

    Raises
    ------
    DataError
        Fewer than two common runs, or a figure that is not positive.
    """
    rows = table[(table["quantity"] == quantity) & (table["submap"] == submap)]
    wide = rows.pivot(index="run", columns="algorithm", values="value")
    for name in (a, b):
        if name not in wide:
            raise DataError(f"table has no {quantity!r} of {name!r}", wanted=sorted(wide.columns))
    pair = wide[[a, b]].dropna().to_numpy(dtype=np.float64)
    if len(pair) < 2:
        raise DataError(f"too few runs have both {a!r} and {b!r}", got=len(pair), wanted="at least 2")
    if np.any(pair <= 0):
        raise DataError(f"{quantity!r} is not positive in every run", got=float(pair.min()), wanted="> 0")
    ratio = pair[:, 0] / pair[:, 1]
    return PairedRatio(
        mean=float(ratio.mean()),
        half_width=float(1.96 * ratio.std(ddof=1) / np.sqrt(len(ratio))),
        geometric_mean=float(np.exp(np.log(ratio).mean())),
        wins=int(np.sum(ratio < 1.0)),
        runs=len(ratio),
    )
