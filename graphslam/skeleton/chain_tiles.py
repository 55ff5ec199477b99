"""Chains with loops that are larger than memory: tiles on disk, one in memory at a time, processed in tasks of several
tiles.

A tile is a range of poses; it shares its last pose with the next one. The *separator* consists of these shared poses
and the ends of loops between tiles. In each step a task processes several neighbouring tiles, one by one: it moves the
poses by the last step, combines the links, eliminates all poses outside the separator and returns the rest; the main
process solves the separator exactly. So a step equals the Gauss-Newton step of the whole network in memory.

Every file is named by the digest of its bytes, and a task only reads and writes files: any worker can repeat it at any
time with the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from graphslam.core.atomic import read_json, sweep_parts, write_json
from graphslam.core.cluster import task_runner
from graphslam.core.errors import DataError, FormatError, SolverError
from graphslam.core.geometry import Array
from graphslam.skeleton import chain_kernels as chains
from graphslam.skeleton import segment_kernels as kernels
from graphslam.skeleton.chain_graph import HELD, ChainGraph, JoinedLinks, ReducedChain, block_keys
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.preconditioner import KeyframePattern
from graphslam.skeleton.problem import inverse_covariance
from graphslam.skeleton.schur import step_poses
from graphslam.skeleton.segment_kernels import SegmentLinks
from graphslam.skeleton.tile_store import store_arrays, stored_arrays

TASK_SECONDS = 1.0
"""Least CPU time of a task [s]."""
POSE_SECONDS = 2e-6
"""CPU time per pose and step [s] before the first measurement: typical value with loops at one pose in a hundred."""
FORMAT = "graphslam.chain-tiles/1"
_INDEX = "chain.json"
_SHAPE = {"format": str, "links": str, "tiles": [{"file": str, "poses": str, "begin": int, "end": int}]}
_LOOPS = ("ends", "loop_rotation", "loop_translation", "loop_covariance")

Index = npt.NDArray[np.int64]


class ChainPiece(NamedTuple):
    """Odometry that continues the previous piece, and the loops whose later ends are in it.

    Arrays as in :class:`~graphslam.skeleton.chain_graph.ChainGraph`, but ``ends`` are indices in the whole chain.
    """

    rotation: Array
    translation: Array
    covariance: Array
    ends: Index
    loop_rotation: Array
    loop_translation: Array
    loop_covariance: Array


def chain_to_disk(folder: str | Path, pieces: Iterable[ChainPiece]) -> Path:
    """Write a chain with loops as tiles, with initial poses from dead reckoning.

    Parameters
    ----------
    folder : path
        Created if it does not exist. Existing files are kept.
    pieces : iterable of ChainPiece
        One tile each.
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    sweep_parts(out)
    R, p = np.eye(3), np.zeros(3)
    tiles, between_tiles, begin = [], [], 0
    for piece in pieces:
        n = len(piece.translation) + 1
        end = begin + n - 1
        # validate the piece as a separate chain, with its loops between arbitrary poses
        loops = {name: np.asarray(getattr(piece, name)) for name in _LOOPS}
        ends = loops["ends"].astype(np.int64).reshape(-1, 2)
        if len(ends) and (ends.min() < 0 or ends.max() > end or (ends[:, 0] == ends[:, 1]).any()):
            raise DataError("loop of a tile", got=(int(ends.min()), int(ends.max())), wanted=f"poses of 0 … {end}")
        checked = ChainGraph(*piece[:3], np.tile([[0, 1]], (len(ends), 1)), *piece[4:])
        loops["loop_covariance"] = np.broadcast_to(checked.loop_covariance, (len(ends), 6, 6))
        inner = (ends >= begin).all(axis=1)
        arrays = {name: getattr(checked, name) for name in ("rotation", "translation", "covariance")}
        arrays |= {name: loops[name][inner] for name in _LOOPS} | {"ends": ends[inner] - begin}
        between_tiles.append({name: loops[name][~inner] for name in _LOOPS})
        here = Poses(np.empty((n, 3, 3)), np.empty((n, 3)))
        here.rotation[0], here.position[0] = R, p
        chains.compose_odometry(checked.rotation, checked.translation, here.rotation, here.position)
        R, p = here.rotation[-1], here.position[-1]
        start = store_arrays(out, {"rotation": here.rotation, "position": here.position})
        tiles.append({"file": store_arrays(out, arrays), "poses": start, "begin": begin, "end": end})
        begin = end
    between = store_arrays(out, {name: np.concatenate([t[name] for t in between_tiles]) for name in between_tiles[0]})
    write_json(out / _INDEX, {"format": FORMAT, "links": between, "tiles": tiles})
    return out


@dataclass(frozen=True, eq=False)
class RelaxedTiles:
    """A relaxed chain on disk.

    Parameters
    ----------
    names : list of str
        Pose files, tile by tile.
    separator : int
        Number of poses in the separator.
    tasks : list of float
        CPU time of the tasks of the last step [s].
    """

    folder: Path
    names: list[str]
    objective: float
    history: list[float]
    predicted: float
    largest_move: float
    converged: bool
    separator: int
    tasks: list[float]

    def poses(self, tile: int) -> Poses:
        """Poses of one tile; its first pose is the last one of the previous tile."""
        return _poses(self.folder, self.names[tile])


def relax_tiles(
    folder: str | Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    iterations: int = 30,
    gain: float = 1e-6,
    task_seconds: float = TASK_SECONDS,
    progress: Callable[[float], None] | None = None,
) -> RelaxedTiles:
    """Gauss-Newton on a chain with loops on disk, with exact linear solves.

    Parameters
    ----------
    folder : path
        From :func:`chain_to_disk`; poses are written to the same folder.
    workers : int, optional
        Processes of a Dask cluster on this machine; default: this process only, tile by tile.
    cluster : str, optional
        Address of a running Dask scheduler, whose workers have access to the folder.
    iterations, gain, progress
        As in :func:`~graphslam.skeleton.chain_graph.relax_chain`.
    task_seconds : float
        Least CPU time of a task [s], which gets consecutive tiles accordingly. It does not affect the result.
    """
    where = Path(folder).resolve()
    index = read_json(where / _INDEX, fmt=FORMAT, shape=_SHAPE)
    tiles = index["tiles"]
    separator = _Separator(stored_arrays(where, index["links"]), [(int(t["begin"]), int(t["end"])) for t in tiles])
    seconds = [POSE_SECONDS * (int(t["end"]) - int(t["begin"])) for t in tiles]
    spent: list[float] = []
    known: list[bool] = []
    given = {index["links"], *(t["file"] for t in tiles), *(t["poses"] for t in tiles)}

    with task_runner(workers, cluster) as run:

        def step(names: list[str], x: Array | None, scale: float = 1.0) -> list[TaskResult]:
            work = [
                (str(where), t["file"], name, stay, None if x is None else x[a:b], scale)
                for t, name, stay, (a, b) in zip(tiles, names, separator.stay, separator.rows)
            ]
            # without a step a task takes half the time
            given_out = tasks_of(seconds, task_seconds * (2.0 if x is None else 1.0))
            done = [d for some in run(work_on_tiles, [(work[s],) for s in given_out]) for d in some]
            spent[:] = [sum(d.seconds for d in done[s]) for s in given_out]
            if x is not None:
                # the first call of a worker takes longer
                seconds[:] = [min(s, d.seconds) for s, d in zip(seconds if known else [np.inf] * len(done), done)]
                known.append(True)
            return done

        def keep(done: list[TaskResult]) -> None:
            """Remove the files of earlier steps."""
            needed = given | {d.poses for d in done}
            for path in where.glob("*.arrays"):
                if path.name not in needed:
                    path.unlink(missing_ok=True)

        done = step([t["poses"] for t in tiles], None)
        left = separator.gather(where, done)
        history, predicted, far, converged = [left.total], np.inf, np.inf, False
        for _ in range(iterations):
            if not np.isfinite(left.total):
                raise SolverError("objective of the chain graph is not finite")
            x = separator.solve(left)
            predicted = left.gain - float(np.einsum("ij,ij->", x, left.gradient))
            scale = 1.0
            while True:
                then = step([d.poses for d in done], x, scale)
                there = separator.gather(where, then)
                if there.total <= left.total * (1.0 + 1e-12) or scale < 1e-4:
                    break
                scale *= 0.5
            if there.total > left.total * (1.0 + 1e-12):
                break
            done, left = then, there
            keep(done)
            history.append(left.total)
            far = max(d.far for d in done)
            if progress is not None:
                progress(left.total)
            if scale == 1.0 and predicted < max(gain * left.total, 1e-9):
                converged = True
                break
    keep(done)
    sweep_parts(where)
    names = [d.poses for d in done]
    return RelaxedTiles(where, names, left.total, history, predicted, far, converged, separator.size, spent)


class TaskResult(NamedTuple):
    """Result of a task: file names, and a few values."""

    poses: str
    left: str
    total: float
    gain: float
    far: float
    seconds: float
    """CPU time of the task."""


def tasks_of(seconds: Sequence[float], least: float) -> list[slice]:
    """Group neighbouring tiles to tasks of at least ``least`` seconds; a single task if the total is shorter.

    Parameters
    ----------
    seconds : sequence of float
        Of each tile.
    """
    out, begin, total = [], 0, 0.0
    for k, s in enumerate(seconds):
        total += s
        if total >= least:
            out.append(slice(begin, k + 1))
            begin, total = k + 1, 0.0
    if begin < len(seconds):  # the rest is added to the last task
        first = out.pop().start if out else 0
        out.append(slice(first, len(seconds)))
    return out


def work_on_tiles(work: Sequence[tuple[Any, ...]]) -> list[TaskResult]:
    """:func:`work_on_tile` of each, one in memory at a time."""
    return [work_on_tile(*one) for one in work]


def work_on_tile(folder: str, tile: str, poses: str, stay: Index, x: Array | None, scale: float) -> TaskResult:
    """Move the poses of a tile, and eliminate the poses outside the separator.

    Parameters
    ----------
    folder, tile, poses : str
        Files.
    stay : (s,)
        Poses of the tile in the separator, including its first and last one.
    x : (s, 6), optional
        Their steps; None: poses are not moved.
    scale : float
        Factor on the step.
    """
    where, began = Path(folder), process_time()
    network = ReducedChain(ChainGraph(**stored_arrays(where, tile)), stay)
    inner = _Inner(network, stay)
    here, far = _poses(where, poses), 0.0
    if x is not None:
        joined = network.join(here)
        full = network.follow(joined, inner.solve(inner.eliminate(joined), x))
        here = step_poses(here, full, scale)
        poses = store_arrays(where, {"rotation": here.rotation, "position": here.position})
        far = float(np.sqrt(np.max(np.sum(full[:, 3:] ** 2, axis=1)))) * scale
    joined = network.join(here)
    left = inner.eliminate(joined)
    arrays = {
        "keys": left.keys,
        "blocks": left.blocks,
        "gradient": left.gradient,
        "rotation": here.rotation[stay],
        "position": here.position[stay],
    }
    name = store_arrays(where, arrays)
    spent = process_time() - began
    return TaskResult(poses, name, joined.total, joined.total - joined.energy + left.gain, far, spent)


def _poses(folder: Path, name: str) -> Poses:
    arrays = stored_arrays(folder, name)
    return Poses(arrays["rotation"], arrays["position"])


class EliminationResult(NamedTuple):
    """Result of the elimination of the inner poses."""

    keys: Index
    blocks: Array
    gradient: Array
    gain: float
    parts: list[tuple[Index, Index, Array]]
    """For each connected group of inner poses: their indices among the kept poses, the indices of their neighbours
    among the separator poses, and the inner steps for unit steps of these; last column: for zero steps."""


class _Inner:
    """Kept poses of a tile outside the separator: ends of loops inside it."""

    def __init__(self, network: ReducedChain, stay: Index) -> None:
        K = len(network.kept)
        self._stay = np.searchsorted(network.kept, stay)
        self._number = np.full(K, -1, np.int64)
        self._number[self._stay] = np.arange(len(stay))
        i, j = np.divmod(network.keys, K)
        inner_i, inner_j = self._number[i] < 0, self._number[j] < 0
        both = inner_i & inner_j
        group = connected_components(coo_array((np.ones(both.sum()), (i[both], j[both])), shape=(K, K)), False)[1]
        self._i, self._j = i, j
        self._outside = np.flatnonzero(~inner_i & ~inner_j)
        inside = np.flatnonzero(inner_i | inner_j)
        of = np.where(inner_i, group[i], group[j])[inside]
        order = np.argsort(of, kind="stable")
        cuts = np.flatnonzero(np.diff(of[order])) + 1
        self._parts = [self._part(e) for e in np.split(inside[order], cuts)] if len(inside) else []

    def _part(self, edges: Index) -> tuple[Index, Index, KeyframePattern, Index, Index]:
        i, j = self._i[edges], self._j[edges]
        inner = (self._number[i] < 0) & (self._number[j] < 0)
        nodes = np.unique(np.concatenate([k[self._number[k] < 0] for k in (i, j)]))
        beside = np.unique(np.concatenate([self._number[k][self._number[k] >= 0] for k in (i, j)]))
        a, b = np.searchsorted(nodes, i[inner]), np.searchsorted(nodes, j[inner])
        return nodes, beside, KeyframePattern(a * len(nodes) + b, len(nodes)), edges[inner], edges[~inner]

    def eliminate(self, joined: JoinedLinks) -> EliminationResult:
        """Matrix and gradient of the separator poses."""
        s = len(self._stay)
        numbers, blocks = [], [joined.blocks[self._outside]]
        numbers.append(np.stack([self._number[self._i[self._outside]], self._number[self._j[self._outside]]]))
        g, gain, parts = joined.gradient[self._stay].copy(), 0.0, []
        for nodes, beside, pattern, inside, across in self._parts:
            factor = pattern.factor(joined.blocks[inside])
            c, t = len(nodes), len(beside)
            B = np.zeros((c, 6, t + 1, 6))
            for e in across:
                i, j, block = self._i[e], self._j[e], joined.blocks[e]
                if self._number[i] >= 0:
                    i, j, block = j, i, block.T
                B[np.searchsorted(nodes, i), :, np.searchsorted(beside, self._number[j])] += block
            B[:, :, t, 0] = joined.gradient[nodes]
            flat = B.reshape(6 * c, 6 * t + 6)[:, : 6 * t + 1]
            X = np.column_stack([factor.solve(column) for column in flat.T])
            S = flat.T @ X
            gain += float(S[-1, -1])
            g[beside] -= S[:-1, -1].reshape(t, 6)
            a, b = np.triu_indices(t)
            numbers.append(np.stack([beside[a], beside[b]]))
            blocks.append(-S[:-1, :-1].reshape(t, 6, t, 6)[a, :, b, :])
            parts.append((nodes, beside, -X))
        i, j = np.concatenate(numbers, axis=1)
        keys, place = np.unique(i * s + j, return_inverse=True)
        out = np.zeros((len(keys), 6, 6))
        np.add.at(out, place, np.concatenate(blocks))
        return EliminationResult(keys, out, g, gain, parts)

    def solve(self, left: EliminationResult, x: Array) -> Array:
        """Steps of all kept poses from those ``(s, 6)`` of the separator poses."""
        out = np.empty((len(self._number), 6))
        out[self._stay] = x
        for nodes, beside, X in left.parts:
            out[nodes] = (X[:, :-1] @ x[beside].ravel() + X[:, -1]).reshape(-1, 6)
        return out


class _Together(NamedTuple):
    """The network of the separator."""

    total: float
    gain: float
    keys: Index
    blocks: Array
    gradient: Array


class _Separator:
    """Poses shared by tiles, and ends of loops between tiles."""

    def __init__(self, raw: dict[str, npt.NDArray[Any]], spans: list[tuple[int, int]]) -> None:
        ends = raw["ends"].astype(np.int64).reshape(-1, 2)
        cuts = np.array([a for a, _ in spans] + [spans[-1][1]], dtype=np.int64)
        nodes = np.unique(np.concatenate([cuts, ends.ravel()]))
        if nodes[0] < cuts[0] or nodes[-1] > cuts[-1] or (np.diff(cuts) < 1).any():
            raise FormatError("tiles of a chain that do not follow each other, or loops that end beyond them")
        self.size = len(nodes)
        self.rows = [tuple(np.searchsorted(nodes, [a, b]) + [0, 1]) for a, b in spans]
        self.stay = [nodes[lo:hi] - a for (lo, hi), (a, _) in zip(self.rows, spans)]
        self._ends = np.searchsorted(nodes, ends).astype(np.int64)
        covariance = raw["loop_covariance"].reshape(-1, 6, 6)
        info = inverse_covariance(covariance, "loop_covariance") if len(covariance) else covariance
        first = np.arange(len(ends) + 1)
        self._links = SegmentLinks(self._ends, first, raw["loop_rotation"], raw["loop_translation"], covariance, info)
        self._pattern: KeyframePattern | None = None

    def gather(self, folder: Path, done: list[TaskResult]) -> _Together:
        """Sum of the results of the tiles and the loops between them."""
        K = self.size
        keys, blocks, g = [], [], np.zeros((K, 6))
        poses = Poses(np.empty((K, 3, 3)), np.empty((K, 3)))
        for d, (a, b) in zip(done, self.rows):
            left = stored_arrays(folder, d.left)
            i, j = np.divmod(left["keys"].astype(np.int64), b - a)
            keys.append((a + i) * K + a + j)
            blocks.append(left["blocks"])
            g[a:b] += left["gradient"]
            poses.rotation[a:b], poses.position[a:b] = left["rotation"], left["position"]
        own, where = block_keys(self._ends, K)
        covariance, misfit = np.empty((len(self._ends), 6, 6)), np.empty((len(self._ends), 6))
        total = float(kernels.join_links(self._links, poses, covariance, misfit))
        between = np.zeros((len(own), 6, 6))
        kernels.add_end_blocks(self._ends, poses.position, covariance, misfit, (where[:K], where[K:]), between, g)
        every, place = np.unique(np.concatenate([*keys, own]), return_inverse=True)
        out = np.zeros((len(every), 6, 6))
        np.add.at(out, place, np.concatenate([*blocks, between]))
        return _Together(total + sum(d.total for d in done), sum(d.gain for d in done), every, out, g)

    def solve(self, left: _Together) -> Array:
        """Steps ``(K, 6)`` of the separator."""
        if self._pattern is None:
            self._pattern = KeyframePattern(left.keys, self.size)
        left.blocks[0] += HELD
        return np.asarray(self._pattern.factor(left.blocks).solve(-left.gradient.ravel())).reshape(-1, 6)
