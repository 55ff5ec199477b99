"""Ties along a submap: where its body came back into a map that holds it, and was held by it.

A re-entry says where a segment began in an older map. Its body went on in that map, and what it saw there placed it,
step by step, beside the stretch of the older path that had laid the map down; and on the way back out of a dead end it
is placed by the map of its own way in. A path says so (its poses are beside each other where the bodies were), its
covariance does not: that is what drift alone leaves. So places of a path that lie beside an earlier stretch in the same
map become loops of their own: the relative pose of the two in the frame of that map, with the covariance with which a
map places a body.

In simulated buildings such pairs were off by 0.07 m along, 0.03 to 0.05 m across, 0.02 to 0.03 m in height, and 0.01
rad (RMS of 92 within segments and 87 between them), whatever the way between the two. Ties are evidence that was in
the path already (declared ``shared-scan``): only submaps whose exits state drift as if no ground had been seen twice,
as those of :mod:`graphslam_frontends.grid.filter_error_model` do, may be given them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.poses import Group, group_of
from graphslam.core.submap import Submap
from graphslam.loops.candidates import TIE, LoopCandidate
from graphslam.loops.places import Places

Entry = tuple[int, int]
"""Keys of the submap that was entered and of the one that entered it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OverlapConfig:
    """Where ties are, and how well a map places a body."""

    spacing: float = 6.0
    """Between the ties of a submap [m]: neighbours share what they are off by."""
    reach: float = 2.5
    """The body is beside an earlier stretch if it is nearer than this [m] …"""
    height: float = 1.25
    """… and not farther above or below than this [m]."""
    least_way: float = 12.0
    """Ground of the same submap counts as seen again after so much way [m]."""
    sigma: float = 0.08
    """σ of a tie along and across [m] …"""
    sigma_height: float = 0.03
    """… in height [m] …"""
    sigma_angle: float = 0.011
    """… and of its angles [rad]."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"ties: {f.name} = {value}; wanted a number > 0")

    def covariance(self, group: Group) -> Array:
        """Of a tie ``(d, d)``, right tangent."""
        s = np.full(group.dof, self.sigma_angle)
        s[group.position] = self.sigma
        if group.dim == 3:
            s[-1] = self.sigma_height
        return np.diag(s**2)


def overlap_candidates(
    submaps: Sequence[Submap], places: Places, entries: Collection[Entry] = (), config: OverlapConfig | None = None
) -> list[LoopCandidate]:
    """Places of submaps beside an earlier stretch of a map that held the body there.

    Parameters
    ----------
    places : Places
        Of these.
    entries : collection of (int, int)
        Re-entries that are believed: keys of target and submap. The submap is one that went on in the target's map
        (its ``report["holds"]`` names the target).

    Returns
    -------
    list of LoopCandidate
        Along the way. ``facts["entries"]`` names the entries by which the two places are in one map (none: it is the
        submap's own).
    """
    c = OverlapConfig() if config is None else config
    number = {s.key: k for k, s in enumerate(submaps)}
    seen = _frames(submaps, number, set(entries))
    out: list[LoopCandidate] = []
    for k in range(len(submaps)):
        mine = places.of_submap(k)
        last = -math.inf
        for j in mine[1:].tolist():  # the base is where the entry itself is
            way = float(places.way[j])
            if way - max(last, float(places.way[mine[0]])) < c.spacing:
                continue
            found = _beside(places, j, seen[k], c)
            if found is None:
                continue
            i, T, by = found
            last = way
            out.append(
                LoopCandidate(
                    i=i, j=j, source=TIE, T_ij=T, covariance=c.covariance(group_of(T)), gain=math.nan, score=1.0,
                    facts={"entries": [list(e) for e in by]},
                )
            )  # fmt: skip
    return out


def overlap_entries(gates: Mapping[str, Any]) -> set[Entry]:
    """The entries that a tie needs, from the figures of its loop; of another loop none."""
    return {(int(a), int(b)) for a, b in gates.get("entries", ())}


_Seen = dict[int, tuple[Array, tuple[Entry, ...]]]


def _frames(submaps: Sequence[Submap], number: dict[int, int], entries: set[Entry]) -> list[_Seen]:
    """Of every submap: whose paths are in its map, where its base is in their frames, and by which entries."""
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
    """Whether a submap went on in the map of another; one that does not say what it holds, if a match began it."""
    if "holds" in s.report:
        return target in map(int, s.report["holds"])
    return bool(s.report.get("entered") == "match")


def _beside(places: Places, j: int, seen: _Seen, c: OverlapConfig) -> tuple[int, Array, tuple[Entry, ...]] | None:
    """The nearest earlier place of a map to place ``j`` there: (place, ``T_ij``, by which entries)."""
    T_j = places.T_base_node[j]
    g = group_of(T_j)
    best: tuple[float, int, Array, tuple[Entry, ...]] | None = None
    for u, (T_u_base, by) in seen.items():
        T_u_j = g.compose(T_u_base, T_j)
        at = places.of_submap(u)
        at = at[places.way[j] - places.way[at] >= c.least_way]
        d = places.T_base_node[at, : g.dim] - T_u_j[: g.dim]
        near = np.hypot(d[:, 0], d[:, 1])
        if g.dim == 3:
            near = np.where(np.abs(d[:, 2]) <= c.height, near, np.inf)
        if len(at) and near.min() <= min(c.reach, best[0] if best else math.inf):
            i = int(at[np.argmin(near)])
            best = (float(near.min()), i, g.between(places.T_base_node[i], T_u_j), by)
    return None if best is None else best[1:]
