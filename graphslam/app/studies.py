"""Monte-Carlo studies: functions of the notebooks, implemented in the distribution of the studies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graphslam.core.plugins import load_plugin

_GROUP = "graphslam.verbs"


def study(
    name: str,
    trials: int | None = None,
    *,
    out: str | Path | None = None,
    worlds: Sequence[str] | None = None,
    seed: int = 0,
    workers: int | str | None = None,
    quick: bool = False,
    progress: bool = True,
) -> Any:
    """Run a study, or resume one: finished trials in the folder are kept, failed ones are run again.

    Parameters
    ----------
    name : str
        Registered name (``combined-slam``, ``association-ambiguity``), or your own study as ``module:object``.
    trials : int, optional
        Trials per world; default: that of the study.
    out : path, optional
        Folder of the study; default ``study-NAME`` in the working directory.
    worlds : sequence of str, optional
        A subset of the study's worlds; default: all.
    seed : int
        Root of the seed tree. Trial k has the same seed in every world, so worlds with one layout share it.
    workers : int or str, optional
        Number of processes, or the address of a Dask scheduler; default: none, the trials run in this process.
    quick : bool
        The study's small version.
    progress : bool
        Show a progress bar on stderr.

    Returns
    -------
    Study
        Also written to the folder: ``table.csv``, ``timings.csv``, ``report.md``, ``figures/``.

    Raises
    ------
    UnknownNameError, ConfigError
        Unknown study or world, or an impossible option.
    RunFolderError
        The folder holds another study.
    KeyboardInterrupt
        After finished trials were written.

    Examples
    --------
    >>> study = gs.study("charts", 1, quick=True, out="studies/one", progress=False)
    >>> list(study.table.columns)
    ['world', 'run', 'algorithm', 'submap', 'quantity', 'value']
    """
    return load_plugin(_GROUP, "function", "study")(
        name,
        trials,
        out=out,
        worlds=worlds,
        seed=seed,
        workers=workers,
        quick=quick,
        progress=progress,
    )


def open_study(folder: str | Path, definition: Any = None) -> Any:
    """Read a study from its folder, finished or not; nothing is run.

    Parameters
    ----------
    folder : path
    definition : StudyDefinition or str, optional
        Your own study: the object, or ``module:object``. The folder names its study too, but a folder from another
        person must not decide which code is imported: without this argument only registered studies are opened.

    Returns
    -------
    Study
        Its tidy ``table`` (``world, run, algorithm, submap, quantity, value``), ``report()`` and figures.

    Raises
    ------
    MissingDataError, FormatError
        Not the folder of a study.
    UnknownNameError
        A study that is not registered.

    Examples
    --------
    >>> made = gs.study("charts", 1, quick=True, out="studies/charts", progress=False)
    >>> gs.open_study("studies/charts")
    Study('charts': runs strong-drift-quick: 1, space-quick: 1; 0 failed)
    """
    return load_plugin(_GROUP, "function", "open_study")(folder, definition)


def find_study(name: str) -> Any:
    """The study registered as ``name``, or your own as ``module:object``.

    Parameters
    ----------
    name : str

    Returns
    -------
    StudyDefinition
        Name, worlds, algorithms, and the function of one trial.

    Raises
    ------
    UnknownNameError
        Nothing is registered under that name.
    ConfigError
        ``module:object`` cannot be imported, or is not a study.

    Examples
    --------
    >>> gs.find_study("segslam-garage").worlds(quick=False)
    ('garage-A', 'garage-B', 'garage-C', 'garage-D', 'garage-drawn')
    """
    return load_plugin(_GROUP, "function", "find_study")(name)
