"""A chain cut into pieces in memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.skeleton.chain_graph import ChainGraph
from graphslam.skeleton.chain_tiles import ChainPiece


def cut_chain(graph: ChainGraph, size: int) -> Iterator[ChainPiece]:
    """A chain in memory, cut for :func:`chain_to_disk` into pieces of ``size`` links."""
    if size < 1:
        raise ConfigError(f"tiles of {size} links; wanted 1 or more")
    last = graph.ends.max(axis=1) if len(graph.ends) else np.empty(0, np.int64)
    for a in range(0, graph.poses - 1, size):
        b = min(a + size, graph.poses - 1)
        own = (last > a) & (last <= b)
        yield ChainPiece(
            graph.rotation[a:b],
            graph.translation[a:b],
            graph.covariance[a:b] if len(graph.covariance) > 1 else graph.covariance,
            graph.ends[own],
            graph.loop_rotation[own],
            graph.loop_translation[own],
            graph.loop_covariance[own] if len(graph.loop_covariance) > 1 else graph.loop_covariance,
        )
