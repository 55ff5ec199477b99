"""Plug-ins of other distributions, found by entry points, and what to install if one is missing.

A distribution registers its parts under one of these groups; the names are those for the user:

* ``graphslam.studies``: Monte-Carlo studies (:func:`graphslam.study`);
* ``graphslam.worlds``: simulated worlds (:func:`graphslam.simulate`);
* ``graphslam.readers``: readers of data sets (:func:`graphslam.load`);
* ``graphslam.writers``: formats that runs are exported to (:func:`graphslam.export`);
* ``graphslam.frontends``: front ends (:func:`graphslam.run`);
* ``graphslam.identities``: published identities of the landmarks of a log, by its name: a function of the observations;
* ``graphslam.presets``: packages of recommended settings, ``SOURCE.FRONTEND.toml``;
* ``graphslam.commands``: commands of ``graphslam``, Typer functions;
* ``graphslam.verbs``: functions behind ``graphslam.study``, ``open_study`` and ``find_study``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from graphslam.core.errors import GraphSlamError, MissingExtraError, UnknownNameError

STUDIES = "graphslam-studies"
INSTALL_STUDIES = "pip install ./notebooks/studies in a clone of the repository"

IN_STUDIES: dict[str, tuple[str, ...]] = {
    "graphslam.commands": ("study", "terrain-tables"),
    "graphslam.frontends": ("ekf-slam", "rbpf-grid", "rbpf-slam"),
    "graphslam.readers": (
        *("kitti-gps", "lidar-pack", "mrclam", "plaza", "slsjf-local-maps", "slsjf-network"),
        *("slsjf-observations", "smartloc", "tuc", "ufastslam-detections", "victoria-park"),
    ),
    "graphslam.verbs": ("find_study", "open_study", "study"),
    "graphslam.worlds": ("building", "campus", "mine", "point-field"),
}
"""Parts of the studies' distribution by group, for errors that name what to install."""


def plugins(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, sorted; nothing is imported."""
    state = tuple((f, os.stat(f or ".").st_mtime_ns) for f in sys.path if os.path.isdir(f or "."))
    return dict(_read_entry_points(entry_points, group, state))


@lru_cache(maxsize=64)
def _read_entry_points(
    find: Callable[..., Iterable[EntryPoint]], group: str, state: tuple[tuple[str, int], ...]
) -> dict[str, EntryPoint]:
    """Entry points of all distributions, cached until the folders or their times in ``state`` change."""
    return {e.name: e for e in sorted(find(group=group), key=lambda e: e.name)}


def load_plugin(group: str, kind: str, name: str, own: Iterable[str] = ()) -> Any:
    """The object that is registered under a name; ``kind`` and ``own`` (built-in names) are for messages."""
    found = plugins(group)
    if name not in found:
        raise unknown(group, kind, name, [*own, *found])
    try:
        return found[name].load()
    except (ImportError, AttributeError) as error:
        raise GraphSlamError(f"{kind} {name!r} cannot be imported ({error})") from error


def unknown(group: str, kind: str, name: str, known: Iterable[str]) -> GraphSlamError:
    """The error for an unknown name: what to install, or the known names."""
    if name in IN_STUDIES.get(group, ()):
        return MissingExtraError(
            f"{kind} {name!r} is part of {STUDIES}, which is not installed", wanted=INSTALL_STUDIES
        )
    return UnknownNameError(kind, name, list(known))
