"""Which earlier segments a particle may have come back to (A10): long enough ago, and near enough in a map sample.

Matching costs far more than looking: out of some tens of segments one to three are left here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from frontends.segslam.config import WinnowConfig
from frontends.segslam.sampling import OPEN, MapSample
from frontends.segslam.segmap import SegMap
from graphslam.core.geometry import Array, ArrayLike
from graphslam.evidence.contents import box_query

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Segments worth matching, nearest first (in σ), each ``(c, …)``.

    Parameters
    ----------
    segments : (c,) int64
    T_map_body : (c, 7) or (c, 3)
        Where the sample puts the body in the frame of the segment's map: where the search begins.
    distance : (c,)
        From the body to the segment's path, horizontally [m].
    travelled : (c,)
        Way from now to the nearest point of that path, through the sample [m]: what may have drifted.
    sigma : (c,)
        σ of the path-length model over that way [m].
    known : (c,) int64
        Voxels near the body that the map knows.
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
class Winnowed:
    """How many segments fell at which sieve."""

    recent: int = 0
    far: int = 0
    unknown: int = 0
    surplus: int = 0


def winnow(
    segmap: SegMap,
    sample: MapSample,
    T_root_body: ArrayLike,
    step: int,
    config: WinnowConfig,
    *,
    exclude: frozenset[int] | set[int] = frozenset(),
    tally: Winnowed | None = None,
) -> Candidates:
    """Candidates of one particle at one step.

    Parameters
    ----------
    segmap : SegMap
    sample : MapSample
        Its root is the segment the particle is in.
    T_root_body : (7,) or (3,)
        The particle's pose.
    step : int
        The step of now.
    config : WinnowConfig
    exclude : set of int
        Segments that are not asked for, such as the one whose map the particle works in already.
    tally : Winnowed, optional
        Counts are added.
    """
    g, t = segmap.group, segmap.table
    tally = Winnowed() if tally is None else tally
    place = np.array([k for k, i in enumerate(sample.segments.tolist()) if i != OPEN and i not in exclude], np.int64)
    if len(place) and sample.segments[0] != OPEN:
        place = place[place != 0]
    # 1. temporal separation
    now = segmap.times[step]
    old = now - segmap.times[sample.intervals[place, 1]] >= config.gap
    tally.recent += int(np.sum(~old))
    place = place[old]
    if not len(place):
        return _none(segmap)
    # 2. spatial proximity: to the paths of all segments at once
    T_seg_body = g.between(sample.poses[place], np.broadcast_to(T_root_body, (len(place), g.size)))
    index = sample.segments[place]
    paths = [cast(Array, t.paths[i])[:, : g.dim] for i in index.tolist()]
    sizes = np.array([len(p) for p in paths])
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    owner = np.repeat(np.arange(len(place)), sizes)
    d = np.concatenate(paths) - T_seg_body[owner, : g.dim]
    flat = np.hypot(d[:, 0], d[:, 1])
    steps = np.arange(len(d)) - first[owner] + t.start[index][owner]
    L = segmap.path_length
    way = sample.travelled[place][owner] + np.abs(L[steps] - L[sample.anchor[place]][owner])
    sigma = config.drift(way)
    far = flat > config.sigmas * sigma
    if g.dim == 3:
        far |= np.abs(d[:, 2]) > config.height
    measure = np.where(far, np.inf, flat / sigma)
    best = np.array([a + int(np.argmin(measure[a : a + n])) for a, n in zip(first.tolist(), sizes.tolist())])
    near = np.isfinite(measure[best])
    tally.far += int(np.sum(~near))
    rows = [k for k in np.lexsort((index, measure[best])).tolist() if near[k]]
    # 3. does the map know the place? nearest first, until there are enough
    chosen: list[int] = []
    known: list[int] = []
    poses: list[Array] = []
    for tried, k in enumerate(rows):
        if len(chosen) == config.keep:
            tally.surplus += len(rows) - tried
            break
        grid, T_map = segmap.map_of(int(index[k]))
        T = g.compose(T_map, T_seg_body[k])
        half = np.full(g.dim, 0.5 * config.near)
        half[:2] += config.sigmas * sigma[best[k]]
        half[2:] += config.height
        count = int(box_query(grid, (T[: g.dim] - half)[None], (T[: g.dim] + half)[None]).known[0])
        if count < config.known:
            tally.unknown += 1
            continue
        chosen.append(k)
        known.append(count)
        poses.append(T)
    if not chosen:
        return _none(segmap)
    at = best[chosen]
    return Candidates(
        segments=index[chosen],
        T_map_body=np.stack(poses),
        distance=flat[at],
        travelled=way[at],
        sigma=sigma[at],
        known=np.array(known, np.int64),
    )


def _none(segmap: SegMap) -> Candidates:
    z = np.zeros(0)
    return Candidates(
        segments=z.astype(np.int64), T_map_body=np.zeros((0, segmap.group.size)), distance=z, travelled=z, sigma=z,
        known=z.astype(np.int64),
    )  # fmt: skip
