"""Control and check rows of worlds whose truth is known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from graphslam.core.control import ControlTable, control_lines
from graphslam.core.geometry import se2_transform

T_SURVEY_WORLD = np.array([5e5, -1e5, 2.0])


def table(rows: Sequence[Mapping[str, Any]]) -> ControlTable:
    """Rows in memory as a run reads them."""
    given = control_lines(list(rows))
    return ControlTable.parse(given["source"], given["rows"])


def surveyed(
    places: Iterable[tuple[Any, np.ndarray]], rng: np.random.Generator, sigma: float, **cells: Any
) -> list[dict[str, Any]]:
    """A row for each place: what it is called, and where it truly is in the map."""
    out = []
    for name, at in places:
        z = np.array(at, dtype=np.float64)
        z[:2] = se2_transform(T_SURVEY_WORLD, z[:2])
        z += sigma * rng.standard_normal(len(z))
        out.append({"place": name, **dict(zip("xyz", z.tolist())), "sigma": sigma, **cells})
    return out
