"""Overlap constraints along a submap that came back into a map and was localised in it.

A re-entry is the start of a segment in an older map. Its body continued in that map, and each step was localised near
the part of the older path from which the map was built; on the way back out of a dead end it is localised in its own
map. The path contains this (its poses are near each other where the body was), but its covariance does not: it is that
of drift alone. So places of a path near an earlier part in the same map become loops: the relative pose of the two in
the frame of that map, with the covariance of localisation in a map.

In simulated buildings the errors of such pairs were 0.07 m along, 0.03 to 0.05 m across, 0.02 to 0.03 m in height, and
0.01 rad (RMS of 92 within segments and 87 between them), independent of the path length between the two. These
constraints are evidence that is in the path already (declared ``shared-scan``). They are only valid for submaps whose
end-pose covariance models drift without revisits, as in :mod:`graphslam_frontends.grid.filter_error_model`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.config import check_options
from graphslam.core.geometry import Array
from graphslam.core.poses import Group, group_of
from graphslam.core.submap import Submap
from graphslam.loops.candidates import OVERLAP, LoopCandidate
from graphslam.loops.places import Places

Entry = tuple[int, int]
"""Keys of the entered submap and of the one that entered it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlapConfig:
    """Where overlap constraints are added, and the accuracy of localisation in a map."""

    spacing: float = 6.0
    """Path length between overlap constraints of a submap [m]; neighbours share errors."""
    reach: float = 2.5
    """The body is near an earlier part of the path if the distance is smaller than this [m] …"""
    height: float = 1.25
    """… and the height difference not larger than this [m]."""
    least_path: float = 12.0
    """Minimum path length before a revisit within the same submap counts [m]."""
    sigma: float = 0.08
    """σ of an overlap constraint along and across [m] …"""
    sigma_height: float = 0.03
    """… in height [m] …"""
    sigma_angle: float = 0.011
    """… and of its angles [rad]."""

    def __post_init__(self) -> None:
        check_options(self, "overlap constraints: ", {"> 0": "*"})

    def covariance(self, group: Group) -> Array:
        """Of an overlap constraint ``(d, d)``, right tangent."""
        s = np.full(group.dof, self.sigma_angle)
        s[group.position] = self.sigma
        if group.dim == 3:
            s[-1] = self.sigma_height
        return np.diag(s**2)


def overlap_candidates(
    submaps: Sequence[Submap], places: Places, entries: Collection[Entry] = (), config: OverlapConfig | None = None
) -> list[LoopCandidate]:
    """Places of submaps near an earlier part of the path in a map in which the body was localised.

    Parameters
    ----------
    places : Places
        Of these submaps.
    entries : collection of (int, int)
        Accepted re-entries: keys of target and submap. The submap must have continued in the target's map
        (its ``report["holds"]`` contains the target).

    Returns
    -------
    list of LoopCandidate
        In path order. ``facts["entries"]`` lists the entries by which the two places are in one map (empty for the
        submap's own).
    """
    c = OverlapConfig() if config is None else config
    number = {s.key: k for k, s in enumerate(submaps)}
    seen = _frames(submaps, number, set(entries))
    out: list[LoopCandidate] = []
    for k in range(len(submaps)):
        mine = places.of_submap(k)
        last = -math.inf
        for j in mine[1:].tolist():  # the base is the place of the entry itself
            length = float(places.arc[j])
            if length - max(last, float(places.arc[mine[0]])) < c.spacing:
                continue
            found = _beside(places, j, seen[k], c)
            if found is None:
                continue
            i, T, by = found
            last = length
            out.append(
                LoopCandidate(
                    i=i, j=j, source=OVERLAP, T_ij=T, covariance=c.covariance(group_of(T)), gain=math.nan, score=1.0,
                    facts={"entries": [list(e) for e in by]},
                )
            )  # fmt: skip
    return out


def overlap_entries(gates: Mapping[str, Any]) -> set[Entry]:
    """The entries that an overlap constraint depends on, from the gates of its loop; empty for other loops."""
    return {(int(a), int(b)) for a, b in gates.get("entries", ())}


_Seen = dict[int, tuple[Array, tuple[Entry, ...]]]


def _frames(submaps: Sequence[Submap], number: dict[int, int], entries: set[Entry]) -> list[_Seen]:
    """For every submap: submaps whose paths are in its map, its base in their frames, and the entries in between."""
    out: list[_Seen] = []
    for k, s in enumerate(submaps):
        mine: _Seen = {k: (group_of(s.exit_pose).identity, ())}
        for m in s.matches:  # the most supported first
            if not _went_on(s, m.target) or (m.target, s.key) not in entries or len(mine) > 1:
                continue
            g = group_of(m.T_target_here)
            for u, (T_u_target, by) in out[number[m.target]].items():
                mine[u] = (g.compose(T_u_target, m.T_target_here), (*by, (m.target, s.key)))
        out.append(mine)
    return out


def _went_on(s: Submap, target: int) -> bool:
    """Did a submap continue in the map of another one? Without ``holds``: if it was entered by a match."""
    if "holds" in s.report:
        return target in map(int, s.report["holds"])
    return bool(s.report.get("entered") == "match")


def _beside(places: Places, j: int, seen: _Seen, c: OverlapConfig) -> tuple[int, Array, tuple[Entry, ...]] | None:
    """The nearest earlier place of a map to place ``j``: (place, ``T_ij``, entries in between)."""
    T_j = places.T_base_node[j]
    g = group_of(T_j)
    best: tuple[float, int, Array, tuple[Entry, ...]] | None = None
    for u, (T_u_base, by) in seen.items():
        T_u_j = g.compose(T_u_base, T_j)
        at = places.of_submap(u)
        at = at[places.arc[j] - places.arc[at] >= c.least_path]
        d = places.T_base_node[at, : g.dim] - T_u_j[: g.dim]
        near = np.hypot(d[:, 0], d[:, 1])
        if g.dim == 3:
            near = np.where(np.abs(d[:, 2]) <= c.height, near, np.inf)
        if len(at) and near.min() <= min(c.reach, best[0] if best else math.inf):
            i = int(at[np.argmin(near)])
            best = (float(near.min()), i, g.between(places.T_base_node[i], T_u_j), by)
    return None if best is None else best[1:]
