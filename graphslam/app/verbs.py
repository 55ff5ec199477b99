"""The verbs of a notebook: ``graphslam.load``, ``run``, ``compare``, ``join_submaps`` and so on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from graphslam.app import compare as comparing
from graphslam.app.run.local_maps import local_maps as local_maps
from graphslam.app.run.outputs import open_run as open_run
from graphslam.app.run.pipeline import load_log_source
from graphslam.app.run.pipeline import run as run
from graphslam.app.run.run import Run
from graphslam.app.studies.study import open_study as open_study
from graphslam.app.studies.study import study as study
from graphslam.app.submap_sources import submap_source
from graphslam.app.threads import one_blas_thread
from graphslam.app.worlds import simulate as simulate
from graphslam.core.log import SensorLog
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import Submap
from graphslam.join.registry import join

__all__ = [
    "compare",
    "join_submaps",
    "load",
    "local_maps",
    "open_run",
    "open_study",
    "run",
    "simulate",
    "solve_file",
    "study",
]


def load(source: str | Path, **options: Any) -> SensorLog:
    """A sensor log by card name, or from a folder; ``options`` are for its reader.

    Raises
    ------
    UnknownNameError, MissingDataError, FormatError
    """
    return load_log_source(source, **options)


def compare(
    source: Run | str | Path | Sequence[Submap],
    methods: Sequence[str] = comparing.DEFAULT_METHODS,
    *,
    truth: MapTruth | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Join the same submaps by several methods: objective, time, memory, non-zeros, and NEES where truth is known.

    Parameters
    ----------
    source : Run, run folder, submap store, card of submaps, or sequence of Submap
    methods : sequence of str
        Of ``isam2``, ``batch``, ``eif-tree``, ``eif-sequential``, ``ekf``.
    truth : MapTruth, optional
        Instead of the source's own.
    **options
        See :func:`graphslam.app.compare.compare`.
    """
    s = submap_source(source)
    options.setdefault("covariance_scale", s.covariance_scale)
    with one_blas_thread():
        return comparing.compare(s.submaps, methods=methods, truth=truth or s.truth, **options)


def join_submaps(source: Run | str | Path | Sequence[Submap], method: str = "eif-tree", **options: Any) -> Any:
    """Join submaps by one method; see :func:`graphslam.join.registry.join`."""
    s = submap_source(source)
    options.setdefault("covariance_scale", s.covariance_scale)
    with one_blas_thread():
        return join(s.submaps, method, **options)


def solve_file(path: str | Path, solver: str = "lm", **options: Any) -> Mapping[str, Any]:
    """Solve a pose-graph file; see :func:`graphslam.app.solve_file.solve_file`."""
    from graphslam.app import solve_file as solving

    return solving.solve_file(path, solver, **options)
