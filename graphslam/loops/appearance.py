"""Loop candidates by similarity of places, for drift that is too large for proximity."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.config import check_options
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, level_poses
from graphslam.loops.candidates import APPEARANCE, LoopCandidate
from graphslam.loops.places import Places
from graphslam.registration.place_descriptor import PlaceDescriptors, descriptor_similarity


@dataclass(frozen=True, slots=True, kw_only=True)
class AppearanceConfig:
    """Which similar places are candidates."""

    top: int = 2
    """Largest number of candidates of each place, in different stretches."""
    least: float = 0.5
    """Minimum correlation of descriptors …"""
    lead: float = 0.05
    """… and its minimum lead over the next stretch: if many places look the same, none is a candidate."""
    least_path: float = 30.0
    """Minimum path length between the two places [m]."""
    stretch: float = 12.0
    """Places with a smaller distance along the path are in one stretch [m]."""
    sigma: float = 2.0
    """σ of the position predicted by a descriptor [m] …"""
    height: float = 1.0
    """… of its height [m] …"""
    angle: float = 0.1
    """… and of its heading [rad]."""

    def __post_init__(self) -> None:
        check_options(self, "loop candidates by appearance: ", {"≥ 0": "lead least least_path", "> 0": "*"})


def appearance_candidates(
    places: Places,
    descriptors: PlaceDescriptors,
    config: AppearanceConfig | None = None,
    *,
    exclude: Collection[tuple[int, int]] = (),
) -> list[LoopCandidate]:
    """Pairs of similar places in different submaps, most similar first; only one place per stretch.

    Parameters
    ----------
    descriptors : PlaceDescriptors
        Of these places.
    exclude : collection of (int, int)
        Pairs of submaps, in any order, that are not compared.

    Returns
    -------
    list of LoopCandidate
        ``T_ij`` has no translation, and the heading of the largest correlation; its covariance is that of the
        configuration. ``facts``: ``correlation`` and ``lead`` over the best place that is not a candidate.
    """
    c = AppearanceConfig() if config is None else config
    if len(descriptors) != len(places):
        raise DataError("descriptors do not belong to the places", got=len(descriptors), wanted=len(places))
    shut = {tuple(sorted(pair)) for pair in exclude}
    keys = descriptors.ring_keys()
    tree = cKDTree(keys)
    g = group_of(places.T_base_node)
    covariance = _covariance(c, g.dim)
    found: list[LoopCandidate] = []
    for j in range(len(places)):
        if places.arc[j] < c.least_path:
            continue
        rows = np.sort(tree.query(keys[j], min(descriptors.config.shortlist, len(places)))[1]).astype(np.int64)
        usable = places.arc[j] - places.arc[rows] >= c.least_path
        usable &= places.submap[rows] != places.submap[j]
        usable &= [tuple(sorted((int(s), int(places.submap[j])))) not in shut for s in places.submap[rows]]
        rows = rows[usable]
        if not len(rows):
            continue
        correlation, turn = descriptor_similarity(descriptors, j, descriptors, rows)
        best = _stretches(places.arc[rows], correlation, c.stretch, c.top + 1)
        # the best ones together must lead over the next stretch; otherwise this place looks like many others
        beaten = float(correlation[best[c.top]]) if len(best) > c.top else -1.0
        for k in best[: c.top]:
            lead = float(correlation[k]) - beaten
            if correlation[k] < c.least or lead < c.lead:
                break
            found.append(
                LoopCandidate(
                    i=int(rows[k]),
                    j=j,
                    source=APPEARANCE,
                    T_ij=np.array([0.0, 0.0, turn[k]]) if g.dim == 2 else level_poses(np.zeros(3), turn[k]),
                    covariance=covariance,
                    gain=math.nan,
                    score=float(correlation[k]),
                    facts={"correlation": float(correlation[k]), "lead": lead},
                )
            )
    return _thinned(places, sorted(found, key=lambda x: -x.score), c.stretch)


def _covariance(c: AppearanceConfig, dim: int) -> Array:
    if dim == 2:
        return np.diag([c.sigma**2, c.sigma**2, c.angle**2])
    tilt = 0.03
    return np.diag([tilt**2, tilt**2, c.angle**2, c.sigma**2, c.sigma**2, c.height**2])


def _stretches(along: Array, score: Array, stretch: float, count: int) -> list[int]:
    """Indices of the best ``score``, one per stretch."""
    left = np.ones(len(along), bool)
    out: list[int] = []
    for k in np.argsort(-score, kind="stable").tolist():
        if left[k]:
            out.append(k)
            left &= np.abs(along - along[k]) >= stretch
        if len(out) == count:
            break
    return out


def _thinned(places: Places, found: list[LoopCandidate], stretch: float) -> list[LoopCandidate]:
    """The best pair of each two stretches."""
    kept: list[LoopCandidate] = []
    for x in found:
        if all(
            abs(places.arc[x.i] - places.arc[y.i]) >= stretch or abs(places.arc[x.j] - places.arc[y.j]) >= stretch
            for y in kept
        ):
            kept.append(x)
    return kept
