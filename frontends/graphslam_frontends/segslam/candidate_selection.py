"""Candidate selection for loop closure (A10): earlier segments, old enough and near enough in a map sample.

Matching is far more expensive than this selection: one to three of some tens of segments remain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array, ArrayLike
from graphslam.evidence.contents import box_query
from graphslam_frontends.segslam.config import SegmentCandidateConfig
from graphslam_frontends.segslam.sampling import OPEN, MapSample
from graphslam_frontends.segslam.segmap import SegMap

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentCandidates:
    """Candidate segments for matching, nearest first (in σ), each ``(c, …)``.

    Parameters
    ----------
    segments : (c,) int64
    T_map_body : (c, 7) or (c, 3)
        Predicted body pose in the frame of the segment's map: the start of the search.
    distance : (c,)
        Horizontal distance from the body to the segment's path [m].
    travelled : (c,)
        Path length from now to the nearest point of that path, through the sample [m], which determines the drift.
    sigma : (c,)
        σ of the path-length model over that length [m].
    known : (c,) int64
        Number of known voxels near the body.
    """

    segments: Ints
    T_map_body: Array
    distance: Array
    travelled: Array
    sigma: Array
    known: Ints

    def __len__(self) -> int:
        return len(self.segments)


@dataclass(slots=True)
class CandidateSelection:
    """Number of segments rejected by each criterion."""

    recent: int = 0
    far: int = 0
    unknown: int = 0
    surplus: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Segments of a sample that ended long enough ago, with the concatenated poses of their paths.

    Parameters
    ----------
    place : (c,) int64
        In the sample.
    index : (c,) int64
        In the SegMap.
    positions : (m, dim)
        Of all paths, in the frames of their segments.
    owner : (m,) int64
        Index of the segment of each position, 0 … c - 1.
    first : (c,) int64
        Index of the first position of each segment.
    length : (m,)
        Path length from the root's anchor, through the sample [m].
    sigma : (m,)
        Of the path-length model [m].
    """

    place: Ints
    index: Ints
    positions: Array
    owner: Ints
    first: Ints
    length: Array
    sigma: Array


def _places(
    segmap: SegMap, sample: MapSample, step: int, config: SegmentCandidateConfig, exclude: frozenset[int] | set[int]
) -> tuple[_Places | None, int]:
    """The part that does not depend on the particle, and the number of segments that ended too recently."""
    t = segmap.table
    place = np.array([k for k, i in enumerate(sample.segments.tolist()) if i != OPEN and i not in exclude], np.int64)
    if len(place) and sample.segments[0] != OPEN:
        place = place[place != 0]
    old = segmap.times[step] - segmap.times[sample.intervals[place, 1]] >= config.gap
    recent = int(np.sum(~old))
    place = place[old]
    if not len(place):
        return None, recent
    index = sample.segments[place]
    paths = [cast(Array, t.paths[i])[:, : segmap.group.dim] for i in index.tolist()]
    sizes = np.array([len(p) for p in paths])
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    owner = np.repeat(np.arange(len(place)), sizes)
    steps = np.arange(int(sizes.sum())) - first[owner] + t.start[index][owner]
    L = segmap.path_length
    length = sample.travelled[place][owner] + np.abs(L[steps] - L[sample.anchor[place]][owner])
    return _Places(place, index, np.concatenate(paths), owner, first, length, config.drift(length)), recent


def select_candidates(
    segmap: SegMap,
    sample: MapSample,
    T_root_body: ArrayLike,
    step: int,
    config: SegmentCandidateConfig,
    *,
    exclude: frozenset[int] | set[int] = frozenset(),
    tally: CandidateSelection | None = None,
) -> list[SegmentCandidates]:
    """Candidates, at one step, of particles that share a map sample.

    Parameters
    ----------
    sample : MapSample
        Its root is the current segment of the particles.
    T_root_body : (n, 7) or (n, 3)
        Their poses.
    step : int
        The current step.
    exclude : set of int
        Segments to leave out, such as the one whose map the particles already use.
    tally : CandidateSelection, optional
        Counts are added to it.
    """
    T = np.asarray(T_root_body, dtype=np.float64)
    tally = CandidateSelection() if tally is None else tally
    # 1. temporal separation
    places, recent = _places(segmap, sample, step, config, exclude)
    tally.recent += recent * len(T)
    if places is None:
        return [_none(segmap)] * len(T)
    # 2. spatial proximity: to the paths of all segments at once
    g, c, n = segmap.group, len(places.place), len(T)
    frames = np.broadcast_to(sample.poses[places.place], (n, c, g.size))
    T_seg_body = g.between(frames, np.broadcast_to(T[:, None], frames.shape))
    at = T_seg_body[:, places.owner, : g.dim]
    flat = np.hypot(places.positions[:, 0] - at[..., 0], places.positions[:, 1] - at[..., 1])
    measure = flat / places.sigma
    far = measure > config.sigmas
    if g.dim == 3:
        height = config.height + config.rise(places.length)
        far |= np.abs(places.positions[:, 2] - at[..., 2]) > height
    measure[far] = np.inf
    ends = [*places.first[1:].tolist(), len(places.owner)]
    nearest = np.stack(
        [a + np.argmin(measure[:, a:b], axis=1) for a, b in zip(places.first.tolist(), ends)], axis=1
    )  # (n, c)
    return [
        _known(segmap, places, T_seg_body[k], nearest[k], flat[k], measure[k, nearest[k]], config, tally)
        for k in range(n)
    ]


def _known(
    segmap: SegMap,
    places: _Places,
    T_seg_body: Array,
    nearest: Ints,
    flat: Array,
    measure: Array,
    config: SegmentCandidateConfig,
    tally: CandidateSelection,
) -> SegmentCandidates:
    """Criterion 3, known voxels at the place, for one particle: nearest first, until there are enough."""
    g = segmap.group
    near = np.isfinite(measure)
    tally.far += int(np.sum(~near))
    rows = [k for k in np.lexsort((places.index, measure)).tolist() if near[k]]
    chosen: list[int] = []
    known: list[int] = []
    poses: list[Array] = []
    for tried, k in enumerate(rows):
        if len(chosen) == config.keep:
            tally.surplus += len(rows) - tried
            break
        grid, T = segmap.map_of(int(places.index[k])), T_seg_body[k]
        half = np.full(g.dim, 0.5 * config.near)
        half[:2] += config.sigmas * places.sigma[nearest[k]]
        half[2:] += config.height + config.rise(places.length[nearest[k]])
        count = int(box_query(grid, (T[: g.dim] - half)[None], (T[: g.dim] + half)[None]).known[0])
        if count < config.known:
            tally.unknown += 1
            continue
        chosen.append(k)
        known.append(count)
        poses.append(T)
    if not chosen:
        return _none(segmap)
    at = nearest[chosen]
    return SegmentCandidates(
        segments=places.index[chosen],
        T_map_body=np.stack(poses),
        distance=flat[at],
        travelled=places.length[at],
        sigma=places.sigma[at],
        known=np.array(known, np.int64),
    )


def _none(segmap: SegMap) -> SegmentCandidates:
    z = np.zeros(0)
    return SegmentCandidates(
        segments=z.astype(np.int64), T_map_body=np.zeros((0, segmap.group.size)), distance=z, travelled=z, sigma=z,
        known=z.astype(np.int64),
    )  # fmt: skip
