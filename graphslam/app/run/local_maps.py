"""Submaps of a log as the front end outputs them, without joining, for inspection and comparison."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graphslam.app.machine import one_blas_thread
from graphslam.app.run import config as cfg
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.run.source import load
from graphslam.core.config import build_config, merge_options
from graphslam.core.errors import ConfigError
from graphslam.core.log import SensorLog
from graphslam.core.progress import Bar
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.submap import Submap
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf


def _front_end(log: SensorLog, frontend: str, options: Mapping[str, Any] | None) -> Any:
    settings: cfg.RunConfig = build_config(
        cfg.RunConfig, merge_options(recommended_options(log, frontend), {"frontend": options or {}})
    )
    return make_front_end(frontend, settings.frontend)


def local_maps(
    source: str | Path | SensorLog,
    frontend: str = "rbpf-ekf",
    *,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    progress: bool = False,
) -> list[Submap]:
    """The submaps that :func:`graphslam.run` with the same seed and options would join.

    Parameters
    ----------
    source : data set name, folder, or SensorLog
    frontend : str
        Registered name. The single-map front ends (``ekf-slam``, ``rbpf-slam``) give one submap over the whole log.
    seed : int
        Root of the seed tree.
    options : mapping, optional
        Of the front end, overriding the source's preset, e.g. ``{"particles": 500, "stopping": {"scans": 59}}``.
    progress : bool
        Show a progress bar.

    Returns
    -------
    list of Submap
        Each in the frame of its first pose [m, rad].

    Raises
    ------
    GraphSlamError
        Or one of its children.

    Examples
    --------
    >>> submaps = gs.local_maps(log, "rbpf-ekf", seed=1)
    >>> submaps[0].key
    0
    """
    log = load(source)
    made = _front_end(log, frontend, options)
    submaps = []
    with one_blas_thread(), Bar(name=log.name, unit="submap", shown=progress) as bar:
        for submap in made.submaps(log, seed=SeedTree(seed).child("frontend")):
            submaps.append(submap)
            bar.update()
    return submaps


def first_particles(
    source: str | Path | SensorLog,
    frontend: str = "rbpf-ekf",
    *,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
) -> tuple[Submap, ParticleSet]:
    """The first submap of a log, with its particles at the last scan of the submap.

    Parameters
    ----------
    source, frontend, seed, options
        As in :func:`local_maps`; slice the log to start later.

    Returns
    -------
    submap : Submap
        In the frame of its first pose [m, rad].
    particles : ParticleSet
        Poses ``(N, 3)`` in the same frame, weights ``(N,)``, and the landmarks of each.

    Raises
    ------
    ConfigError
        The front end has no particles to show.
    GraphSlamError
        Or another of its children.

    Examples
    --------
    >>> submap, particles = gs.first_particles(log, options={"particles": 10})
    >>> submap.key
    0
    """
    log = load(source)
    made = _front_end(log, frontend, options)
    if not isinstance(made, RbpfEkf):
        raise ConfigError(f"front end {frontend!r} makes no local maps of particles; wanted rbpf-ekf")
    with one_blas_thread():
        found = made.with_particles(RecordSource(log), seed=SeedTree(seed).child("frontend"))
        return next(x for x in found if x is not None)
