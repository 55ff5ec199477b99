"""Align runs of landmarks, and match their landmarks."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from graphslam.app.run.run import Run
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.submap import Submap
from graphslam.loops.sessions import Alignment, align_by_constellation, align_by_identity

logger = logging.getLogger(__name__)
Ints = npt.NDArray[np.int64]
By = Literal["auto", "identity", "constellation", "places", "gps"]
"""Methods to align runs; the last two are for dense submaps."""


def _own_identities(run: Run) -> set[int]:
    """Ids of landmarks that the run's back end made by splitting an observation off; they are local to the run."""
    return {int(e["new"]) for e in run.events if e.get("event") == "split"}


def align_runs(
    runs: list[Run], names: list[str], by: By, tolerance: float
) -> tuple[list[int], dict[int, Alignment | None], dict[int, dict[int, int]]]:
    """Align runs of landmarks, and match their landmarks.

    The first run is the reference; then the run that shares most landmarks with the joined ones joins next.

    Parameters
    ----------
    names : list of str
        Of the runs, for messages.
    by : {"identity", "constellation"}
    tolerance : float
        Landmarks of two maps within this distance after alignment agree [m].

    Returns
    -------
    order : list of int
        Order in which the runs join.
    alignments : dict of int to Alignment or None
        Initial pose of every run in the first one's frame; None for the first.
    renamed : dict of int to dict of int to int
        For every run, its landmark ids and those in the common graph.
    """
    fresh = 1 + max((int(s.landmarks.ids.max(initial=-1)) for r in runs for s in r.submaps if s.landmarks), default=0)
    renamed: dict[int, dict[int, int]] = {}
    world_ids: Ints = np.zeros(0, dtype=np.int64)
    world: Array = np.zeros((0, 2))
    order: list[int] = [0]
    alignments: dict[int, Alignment | None] = {0: None}

    def rename(r: int, known: dict[int, int]) -> dict[int, int]:
        nonlocal fresh
        private = _own_identities(runs[r])
        table: dict[int, int] = {}
        for i in sorted({int(i) for s in runs[r].submaps if s.landmarks is not None for i in s.landmarks.ids}):
            if i in known:
                table[i] = known[i]
            elif r == 0 or (by == "identity" and i not in private):
                table[i] = i
            else:
                table[i] = fresh
                fresh += 1
        return table

    def take(r: int, T: Array) -> None:
        nonlocal world_ids, world
        m = runs[r].map
        ids = np.array([renamed[r][int(i)] for i in m.landmark_ids], dtype=np.int64)
        new = ~np.isin(ids, world_ids)
        world_ids = np.concatenate([world_ids, ids[new]])
        world = np.concatenate([world, se2_transform(T, m.landmarks[new])])

    renamed[0] = rename(0, {})
    take(0, np.zeros(3))
    waiting = list(range(1, len(runs)))
    while waiting:
        found: dict[int, Alignment] = {}
        errors: dict[int, DataError] = {}
        for r in waiting:
            m = runs[r].map
            try:
                if by == "identity":
                    usable = ~np.isin(m.landmark_ids, list(_own_identities(runs[r])))
                    ids = np.where(usable, m.landmark_ids, -1 - np.arange(len(usable)))
                    found[r] = align_by_identity(ids, m.landmarks, world_ids, world, tolerance=tolerance)
                else:
                    found[r] = align_by_constellation(m.landmarks, world, tolerance=tolerance)
            except DataError as error:
                errors[r] = error
        if not found:
            r = waiting[0]
            placed = ", ".join(names[k] for k in order)
            raise DataError(f"cannot be merged with {placed} ({errors[r]})", where=names[r])
        r = max(found, key=lambda k: (len(found[k].pairs), -k))
        alignments[r] = found[r]
        known = {}
        if by == "constellation":
            m = runs[r].map
            known = {int(m.landmark_ids[i]): int(world_ids[j]) for i, j in found[r].pairs}
        renamed[r] = rename(r, known)
        take(r, found[r].T_reference_map)
        order.append(r)
        waiting.remove(r)
        logger.info("%s joins by %d landmarks, rms %.3f m", names[r], len(found[r].pairs), found[r].rms)
    return order, alignments, renamed


def submap_of_session(submap: Submap, key: int, session: str, renamed: dict[int, int]) -> Submap:
    """The submap with its key and landmark ids in the common graph; its streams get the name of the session."""
    s = replace(submap.of_session(session), key=key)
    if s.landmarks is None:
        return s
    return s.with_ids([renamed[int(i)] for i in s.landmarks.ids])
