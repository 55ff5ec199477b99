"""Monte Carlo studies: a trial is a function of its seed, an executor runs it, a tidy table holds the results.

Statistics are elsewhere (:mod:`graphslam.evaluate.tables`): the table is what was measured, and can be judged anew.
"""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Literal

import pandas as pd
from tqdm import tqdm

from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.random import SeedTree

logger = logging.getLogger(__name__)

COLUMNS = ("run", "algorithm", "submap", "quantity", "value")


@dataclass(frozen=True, slots=True)
class Measurement:
    """One figure of one trial.

    Parameters
    ----------
    algorithm, quantity : str
    value : float
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


def run_trials(
    trial: Trial,
    trials: int | Sequence[int],
    *,
    seed: int = 0,
    executor: Literal["serial", "processes"] = "serial",
    workers: int | None = None,
    progress: bool = True,
) -> pd.DataFrame:
    """Run trials and collect their figures.

    Parameters
    ----------
    trial : callable int → iterable of Measurement
        Gets the trial's seed. With ``processes`` it must be importable (a function of a module, or a partial).
    trials : int or sequence of int
        Number of trials, or the numbers of those to run (to go on with a study, or to repeat one).
    seed : int
        Seed of the study.
    executor : {"serial", "processes"}
        ``processes`` are spawned, never forked: a forked child of a threaded library hangs or dies.
    workers : int, optional
        Number of processes; default the number of processors.
    progress : bool
        Show a progress bar.

    Returns
    -------
    DataFrame
        Columns ``run, algorithm, submap, quantity, value``, rows in order of trial: the same table whatever the
        executor.

    Raises
    ------
    TrialError
        A trial raised; its number and seed are in the message, its exception is the cause.
    """
    numbers = list(range(trials)) if isinstance(trials, int) else [int(k) for k in trials]
    if len(set(numbers)) != len(numbers):
        raise ConfigError("a trial is listed twice")
    run = {"serial": _serial, "processes": _processes}.get(executor)
    if run is None:
        raise ConfigError(f"unknown executor {executor!r}; known: serial, processes")
    seeds = {k: trial_seed(seed, k) for k in numbers}
    rows: dict[int, list[Measurement]] = {}
    for k, measured in tqdm(run(trial, seeds, workers), total=len(numbers), desc="trials", disable=not progress):
        rows[k] = measured
    flat = [(k, m.algorithm, m.submap, m.quantity, float(m.value)) for k in numbers for m in rows[k]]
    logger.info("%d trials, %d figures", len(numbers), len(flat))
    table = pd.DataFrame(flat, columns=list(COLUMNS))
    return table.astype({"run": "int64", "submap": "int64", "value": "float64"})


def _call(trial: Trial, seed: int) -> list[Measurement]:
    return list(trial(seed))


def _failed(k: int, seed: int, error: Exception) -> TrialError:
    return TrialError(f"trial {k} (seed {seed}) failed: {type(error).__name__}: {error}")


def _serial(trial: Trial, seeds: dict[int, int], workers: int | None) -> Iterator[tuple[int, list[Measurement]]]:
    for k, s in seeds.items():
        try:
            measured = _call(trial, s)
        except Exception as error:
            raise _failed(k, s, error) from error
        yield k, measured


def _processes(trial: Trial, seeds: dict[int, int], workers: int | None) -> Iterator[tuple[int, list[Measurement]]]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=workers, mp_context=context) as pool:
        futures = {pool.submit(_call, trial, s): k for k, s in seeds.items()}
        for future in as_completed(futures):
            k = futures[future]
            try:
                measured = future.result()
            except Exception as error:
                pool.shutdown(cancel_futures=True)
                raise _failed(k, seeds[k], error) from error
            yield k, measured
