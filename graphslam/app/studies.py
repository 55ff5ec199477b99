"""Monte-Carlo studies: what the verbs of a notebook call, from the distribution of the studies."""

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
    """Run a study, or resume one: trials that are in the folder are not run again, failed ones are.

    Parameters
    ----------
    name : str
        Registered name (``combined-slam``, ``association-ambiguity``), or a study of your own, ``module:object``.
    trials : int, optional
        Trials of each world; default the study's own.
    out : path, optional
        Folder of the study; default ``study-NAME`` in the working directory.
    worlds : sequence of str, optional
        Some of the study's worlds; default all.
    seed : int
        Root of the seed tree. Trial k has the same seed in every world, so worlds of one layout share it.
    workers : int or str, optional
        Processes, or the address of a Dask scheduler; default none, the trials run here.
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
        After what is done has been written.

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
    """Read a study from its folder, finished or not, without running anything.

    Parameters
    ----------
    folder : path
    definition : StudyDefinition or str, optional
        A study of your own: itself, or ``module:object``. A folder names its study, too, but a folder that somebody
        gave you must not choose what is imported: without this argument only the registered studies are opened.

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
    """The study registered as ``name``, or a user's own as ``module:object``.

    Parameters
    ----------
    name : str

    Returns
    -------
    StudyDefinition
        Name, worlds, algorithms, and what one trial is.

    Raises
    ------
    UnknownNameError
        Nothing is registered under that name.
    ConfigError
        ``module:object`` cannot be imported, or is no study.

    Examples
    --------
    >>> gs.find_study("segslam-garage").worlds(quick=False)
    ('garage-A', 'garage-B', 'garage-C', 'garage-D', 'garage-drawn')
    """
    return load_plugin(_GROUP, "function", "find_study")(name)
