"""Plug-ins: parts that other distributions bring, found by entry points, and what to install where one is missing.

A distribution registers what it brings under one of these groups; names are those that a user types:

* ``graphslam.studies``: Monte-Carlo studies (:func:`graphslam.study`);
* ``graphslam.worlds``: simulated worlds (:func:`graphslam.simulate`);
* ``graphslam.readers``: readers of data sets (:func:`graphslam.load`);
* ``graphslam.writers``: formats that runs are exported to (:func:`graphslam.export`);
* ``graphslam.frontends``: front ends (:func:`graphslam.run`);
* ``graphslam.identities``: published identities of the landmarks of a log, by its name: a function of the observations;
* ``graphslam.presets``: packages of recommended settings, ``SOURCE.FRONTEND.toml``;
* ``graphslam.commands``: commands of ``graphslam``, functions as Typer takes them;
* ``graphslam.verbs``: what ``graphslam.study``, ``open_study`` and ``find_study`` call.
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
"""What the distribution of the studies brings, by group, so that an error can say what to install."""


def plugins(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by name, sorted; nothing is imported."""
    state = tuple((f, os.stat(f or ".").st_mtime_ns) for f in sys.path if os.path.isdir(f or "."))
    return dict(_read_entry_points(entry_points, group, state))


@lru_cache(maxsize=64)
def _read_entry_points(
    find: Callable[..., Iterable[EntryPoint]], group: str, state: tuple[tuple[str, int], ...]
) -> dict[str, EntryPoint]:
    """Read from all distributions, until one is installed or removed: ``state`` has the folders and their times."""
    return {e.name: e for e in sorted(find(group=group), key=lambda e: e.name)}


def load_plugin(group: str, kind: str, name: str, own: Iterable[str] = ()) -> Any:
    """The object that is registered under a name; ``kind`` and ``own``, names that are built in, are for messages."""
    found = plugins(group)
    if name not in found:
        raise unknown(group, kind, name, [*own, *found])
    try:
        return found[name].load()
    except (ImportError, AttributeError) as error:
        raise GraphSlamError(f"{kind} {name!r} cannot be imported ({error})") from error


def unknown(group: str, kind: str, name: str, known: Iterable[str]) -> GraphSlamError:
    """The error for a name that is not registered: what to install, or which names there are."""
    if name in IN_STUDIES.get(group, ()):
        return MissingExtraError(
            f"{kind} {name!r} is part of {STUDIES}, which is not installed", wanted=INSTALL_STUDIES
        )
    return UnknownNameError(kind, name, list(known))
