"""Monte Carlo studies: a trial is a function of its seed, an executor runs it, a tidy table holds the results.

Statistics are elsewhere (:mod:`graphslam_studies.evaluate.tables`): the table is what was measured.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass

import pandas as pd

from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.progress import Bar
from graphslam.core.random import SeedTree
from graphslam_studies.montecarlo.executors import Executor, Job, execute

logger = logging.getLogger(__name__)

COLUMNS = ("run", "algorithm", "submap", "quantity", "value")


@dataclass(frozen=True, slots=True)
class Measurement:
    """One figure of one trial.

    Parameters
    ----------
    submap : int
        Submap (or step) the figure belongs to; -1 for a figure of the whole run.
    timing : bool
        A measured time: never the same twice, so it goes to a table of its own and the other one stays reproducible.
    """

    algorithm: str
    quantity: str
    value: float
    submap: int = -1
    timing: bool = False


Trial = Callable[[int], Iterable[Measurement]]


class TrialError(GraphSlamError):
    """A trial failed; says which, and with which seed it can be repeated."""


def trial_seed(study_seed: int, trial: int) -> int:
    """Seed of a trial: a fixed 63-bit function of study seed and trial number, so any trial can be repeated alone."""
    return int(SeedTree(study_seed).child("trial", trial).generator().integers(0, 2**63))


def check_measurements(values: Iterable[object]) -> str | None:
    """What is wrong with what a trial gave, or None: something else than a measurement, or a figure given twice."""
    seen: set[tuple[str, str, int, bool]] = set()
    for m in values:
        if not isinstance(m, Measurement):
            return f"the trial gave a {type(m).__name__}; wanted Measurement"
        key = (m.algorithm, m.quantity, m.submap, m.timing)
        if key in seen:
            return f"{m.quantity!r} of {m.algorithm!r} at submap {m.submap} is repeated"
        seen.add(key)
    return None


def run_trials(
    trial: Trial,
    trials: int | Sequence[int],
    *,
    seed: int = 0,
    executor: Executor = "serial",
    workers: int | None = None,
    address: str | None = None,
    timings: bool = False,
    progress: bool = True,
) -> pd.DataFrame:
    """Run trials and collect their figures.

    Parameters
    ----------
    trial : callable int → iterable of Measurement
        Gets the trial's seed. Anywhere but in this process it must be importable (a function of a module, or a
        partial).
    trials : int or sequence of int
        Number of trials, or the numbers of those to run (to go on with a study, or to repeat one).
    seed : int
        Seed of the study.
    executor, workers, address
        See :func:`graphslam_studies.montecarlo.executors.execute`.
    timings : bool
        Give the measured times instead of the reproducible figures.
    progress : bool
        Show a progress bar.

    Returns
    -------
    DataFrame
        Columns ``run, algorithm, submap, quantity, value``, rows in order of trial: the same table whatever the
        executor.
    """
    numbers = list(range(trials)) if isinstance(trials, int) else [int(k) for k in trials]
    if len(set(numbers)) != len(numbers):
        raise ConfigError("a trial is listed twice")
    jobs = {k: Job(f"trial {k}", trial, trial_seed(seed, k)) for k in numbers}
    number_of = {job.name: k for k, job in jobs.items()}
    rows: dict[int, tuple[Measurement, ...]] = {}
    outcomes = execute(list(jobs.values()), executor=executor, workers=workers, address=address)
    with closing(outcomes):
        for outcome in Bar(outcomes, total=len(numbers), name="trials", shown=progress):
            error = outcome.error or check_measurements(outcome.values)
            if error is not None:
                failure = TrialError(f"{outcome.job.name} (seed {outcome.job.seed}) failed: {error}")
                if outcome.details:
                    failure.add_note(outcome.details)
                raise failure
            rows[number_of[outcome.job.name]] = outcome.values
    flat = [
        (k, m.algorithm, m.submap, m.quantity, float(m.value)) for k in numbers for m in rows[k] if m.timing == timings
    ]
    logger.info("%d trials, %d figures", len(numbers), len(flat))
    table = pd.DataFrame(flat, columns=list(COLUMNS))
    return table.astype({"run": "int64", "submap": "int64", "value": "float64"})
