"""What figures need of a study's tidy table."""

from __future__ import annotations

import pandas as pd

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam_studies.evaluate.tables import values_of
from graphslam_studies.plots.algorithms import in_order


def algorithms_with(table: pd.DataFrame, quantity: str, *, online: bool) -> list[str]:
    """Algorithms that have a quantity, along the run (``online``) or of the whole run, in the order of drawing."""
    if "world" in table and table["world"].nunique() > 1:
        raise DataError("a figure is of one world", got=", ".join(sorted(set(table["world"]))), wanted="rows of one")
    of = (table["quantity"] == quantity) & ((table["submap"] >= 0) == online)
    found = in_order(table.loc[of, "algorithm"])
    if not found:
        raise DataError(f"table has no {quantity!r}", wanted=", ".join(sorted(set(table["quantity"]))) or "figures")
    return found


def curve_of(table: pd.DataFrame, algorithm: str, quantity: str) -> tuple[Array, Array]:
    """Submaps ``(k,)`` and values ``(runs, k)`` along the run."""
    return values_of(table[table["submap"] >= 0], algorithm, quantity)
