"""Parallel binary tree of joins: the joins of a level are independent.

The tree is divided into subtrees of 2^h submaps; each is one task, and so is every join above them. The division does
not change the tree, and every task uses one BLAS thread, so the result is always bitwise equal.

Measured on two cores with 2,048 submaps (1.3 s in one process): threads are not faster, because half of a join is
Python; a pool of spawned processes takes longer to start than the join, unless it is reused for many trees, or for data
association.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

from threadpoolctl import ThreadpoolController

from graphslam.core.cluster import connect_cluster
from graphslam.core.errors import ConfigError
from graphslam.core.progress import Bar
from graphslam.join.association import MapAssociationConfig, match_landmarks
from graphslam.join.eif import join_maps, match_by_id
from graphslam.join.joined_map import JoinedMap, JoinTimes

if TYPE_CHECKING:
    from distributed import Client

    Pool = Executor | Client

# Tasks per worker: enough for balanced loads, few enough for little communication. And least submaps per task.
_TASKS = 4
_LEAST = 8

_Done = tuple[JoinedMap, JoinTimes]


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def join_two(a: JoinedMap, b: JoinedMap, association: MapAssociationConfig | None, times: JoinTimes) -> JoinedMap:
    """Join B to A; landmarks are matched by id, or with ``association``."""
    with times.measure("association"):
        match = match_by_id(a, b) if association is None else match_landmarks(a, b, association)
    return join_maps(a, b, match, times)


def join_subtree(level: Sequence[JoinedMap], association: MapAssociationConfig | None, progress: bool = False) -> _Done:
    """Join maps pairwise, then the pairs, and so on; an unpaired map moves up one level."""
    times = JoinTimes()
    with (
        _blas().limit(limits=1, user_api="blas"),
        Bar(total=len(level) - 1, name="join", unit="join", shown=progress) as bar,
    ):
        while len(level) > 1:
            above = [join_two(a, b, association, times) for a, b in zip(level[::2], level[1::2])]
            bar.update(len(above))
            level = [*above, *level[len(level) - len(level) % 2 :]]
    return level[0], times


def _join_done(a: _Done, b: _Done, association: MapAssociationConfig | None) -> _Done:
    """Join of two subtrees; their times are added."""
    joined, times = join_subtree([a[0], b[0]], association)
    for part in (a[1], b[1]):
        for name, seconds in part.parts.items():
            times.parts[name] += seconds
    times.wall += max(a[1].wall, b[1].wall)
    return joined, times


def join_leaves(
    leaves: Sequence[JoinedMap],
    association: MapAssociationConfig | None,
    executor: str | Pool | None,
    workers: int | None,
    progress: bool,
) -> _Done:
    """Join the leaves of a tree with ``executor`` (see :func:`~graphslam.join.order.join_tree`)."""
    if workers is not None and workers < 1:
        raise ConfigError(f"{workers} workers; wanted at least 1")
    if executor is None:
        if workers is None or workers == 1:
            return join_subtree(leaves, association, progress)
        executor = "processes"
    with _pool(executor, workers) as (pool, hands):
        return _submit(leaves, association, pool, hands, progress)


@contextmanager
def _pool(executor: str | Pool, workers: int | None) -> Iterator[tuple[Pool, int]]:
    """A pool and its number of workers; a new pool is closed at the end."""
    if executor == "processes":
        count = workers or os.cpu_count() or 1
        # spawn, not fork: forked processes of threaded libraries can hang
        with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
            yield pool, count
    elif isinstance(executor, str):
        with connect_cluster(executor) as client:
            yield client, _hands(client)
    else:
        yield executor, _hands(executor)


def _hands(pool: Pool) -> int:
    if isinstance(pool, Executor):
        return int(getattr(pool, "_max_workers", None) or os.cpu_count() or 1)
    return max(1, len(pool.scheduler_info()["workers"]))


def _submit(
    leaves: Sequence[JoinedMap], association: MapAssociationConfig | None, pool: Pool, hands: int, progress: bool
) -> _Done:
    size = _LEAST
    while size * _TASKS * hands < len(leaves):
        size *= 2
    here = isinstance(pool, Executor)
    # Dask accepts futures as arguments of the next task: the whole tree is one graph, and maps are sent from worker to
    # worker. With a process pool they return for each level.
    level: list[Any] = [
        pool.submit(join_subtree, leaves[i : i + size], association) for i in range(0, len(leaves), size)
    ]
    with Bar(total=2 * len(level) - 1, name="join", unit="task", shown=progress) as bar:
        while len(level) > 1:
            ready = [f.result() for f in level] if here else level
            bar.update(len(level) if here else len(level) // 2)
            above = [pool.submit(_join_done, a, b, association) for a, b in zip(ready[::2], ready[1::2])]
            level = above + level[len(level) - len(level) % 2 :]
        done: _Done = level[0].result()
        bar.update(bar.total - bar.n)
    return done
