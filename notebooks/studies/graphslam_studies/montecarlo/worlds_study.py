"""What the studies of grid front ends have in common: worlds with a configuration each, and figures of all runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

import pandas as pd

from graphslam.core.errors import UnknownNameError
from graphslam.plots.save import save_figure
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.plots.association import plot_runs

C = TypeVar("C")


class WorldsStudy(Generic[C]):
    """Worlds and trials of a study; what is made of the table is the study's own.

    Parameters
    ----------
    full, quick : mapping of world to its configuration
    trials : int
        Of each world where none are asked for; two in quick mode.
    """

    run_one: Callable[[C, int], Iterable[Measurement]]
    """One trial, a function of a module: of a configuration and a seed. Each kind of study has its own."""

    def __init__(
        self, name: str, description: str, full: Mapping[str, C], quick: Mapping[str, C], trials: int = 20
    ) -> None:
        self.name, self.description = name, description
        self.full, self.quick, self._trials = full, quick, trials

    def worlds(self, quick: bool) -> tuple[str, ...]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return tuple(self.quick if quick else self.full)

    def default_trials(self, quick: bool) -> int:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return 2 if quick else self._trials

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        known = {**self.full, **self.quick}
        if world not in known:
            raise UnknownNameError(f"world of {self.name}", world, known)
        return partial(self.run_one, known[world])


def whole(table: pd.DataFrame, quantity: str) -> pd.DataFrame:
    """Rows of one figure of whole runs that are numbers."""
    return table[(table["quantity"] == quantity) & (table["submap"] == -1) & table["value"].notna()]


def draw_runs(table: pd.DataFrame, drawn: Mapping[str, str], folder: Path) -> list[Path]:
    """One picture of each quantity in ``drawn`` (its label) that the table has: every run of every algorithm."""
    made = []
    for quantity, label in drawn.items():
        rows = whole(table, quantity)
        if not rows.empty:
            made.append(save_figure(plot_runs(rows, label=label), folder / f"{quantity}.png"))
    return made
