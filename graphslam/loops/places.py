"""Places of a chain of submaps between which loops are possible: nodes at regular distances.

A place is a node of the graph: the base of a submap, or a pose of its path. ``arc`` is the path length along the whole
chain, which distinguishes stretches. The relative pose of two places with its covariance comes from the graph
(:class:`RelativePoses`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array, arc_length
from graphslam.core.poses import group_of

Ints = npt.NDArray[np.int64]


class RelativePoses(Protocol):
    """Estimated poses of nodes j relative to nodes i, ``(k,)`` each.

    Returns ``T_ij (k, 7|3)`` and its covariance ``(k, d, d)`` in the right tangent, from the joint marginal of each
    pair.
    """

    def __call__(self, i: Ints, j: Ints) -> tuple[Array, Array]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places of a chain of submaps, in path order.

    Parameters
    ----------
    node : (n,) int64
        In the graph.
    submap : (n,) int64
        Number of the submap of each in the chain.
    T_base_node : (n, 7) or (n, 3)
        In the frame of that submap's base.
    arc : (n,)
        Path length from the start of the chain [m].
    time : (n,)
        Time of the body at the place [s].
    """

    node: Ints
    submap: Ints
    T_base_node: Array
    arc: Array
    time: Array

    def __post_init__(self) -> None:
        n = len(self.node)
        sizes = tuple(map(len, (self.node, self.submap, self.T_base_node, self.arc, self.time)))
        if len(set(sizes)) != 1:
            raise GeometryError("places differ in number", got=sizes)
        group_of(self.T_base_node)  # refuses other shapes
        if n and np.any(np.diff(self.arc) < 0):
            raise DataError("places are not in the order of the path", wanted="rising lengths")

    def __len__(self) -> int:
        return len(self.node)

    def of_submap(self, k: int) -> Ints:
        """Indices of the places in submap ``k``."""
        return np.flatnonzero(self.submap == k).astype(np.int64)

    def nearest(self, submap: int, position: Array) -> int:
        """The place of a submap nearest to a position ``(dim,)`` in the frame of its base."""
        at = self.of_submap(submap)
        if not len(at):
            raise DataError(f"submap {submap} has no place")
        d = self.T_base_node[at, : len(position)] - position
        return int(at[np.argmin(np.einsum("ij,ij->i", d, d))])


def places_at_nodes(poses: Sequence[Array], times: Sequence[Array]) -> Places:
    """Places at the nodes of a chain of submaps; the path length is summed between nodes, accurate enough here.

    Parameters
    ----------
    poses : sequence of (n, 7) or (n, 3)
        ``T_base_node`` of every submap, the base first; the last is its end, which is not a place because it is the
        next base.
    times : sequence of (n,)
    """
    stretches = []
    for T, t in zip(poses, times, strict=True):
        along = arc_length(T[:, : group_of(T).dim])
        stretches.append((T[:-1], along[:-1], np.asarray(t[:-1]), float(along[-1])))
    return _places(stretches)


def _places(stretches: Sequence[tuple[Array, Array, Array, float]]) -> Places:
    """Concatenate poses, path lengths from the base, and times of all submaps."""
    poses, distances, times, lengths = zip(*stretches)
    begin = np.concatenate([[0.0], np.cumsum(lengths)])
    counts = [len(T) for T in poses]
    return Places(
        np.arange(sum(counts), dtype=np.int64),
        np.repeat(np.arange(len(counts), dtype=np.int64), counts),
        np.concatenate(poses),
        np.concatenate([b + w for b, w in zip(begin, distances)]),
        np.concatenate(times),
    )
