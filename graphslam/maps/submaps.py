"""Division of a chain of submaps into pieces with poses, the input of a fused map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3, group_of, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.views import has_dense_view
from graphslam.maps.increment import own_evidence
from graphslam.maps.pieces import DivisionConfig, Piece, PieceId, node_times_every, pieces_of_submap


@dataclass(frozen=True, slots=True)
class DividedSubmaps:
    """Pieces of a chain of submaps. Names are ``(key of the submap, node)``.

    Parameters
    ----------
    pieces : by name
        Without empty pieces.
    poses : by name
        ``T_world_node`` along the open chain, the first base at the identity.
    local : by name
        ``T_base_node``.
    times : by name
        Times of the nodes [s].
    level_nodes : bool
        Nodes have no roll and pitch.
    """

    pieces: dict[PieceId, Piece]
    poses: dict[PieceId, Array]
    local: dict[PieceId, Array]
    times: dict[PieceId, float]
    level_nodes: bool

    def along(self, path: Trajectory) -> dict[PieceId, Array]:
        """``T_world_node`` along a path ``T_world_body(t)``, at the times of the nodes."""
        poses = path.interpolate(np.array(list(self.times.values())))
        return dict(zip(self.times, remove_roll_pitch(poses) if self.level_nodes else poses))


def divide_submaps(
    submaps: Sequence[Submap],
    *,
    every: float | None = 3.0,
    config: DivisionConfig | None = None,
    own: bool = True,
    grids: Mapping[int, EvidenceGrid] | None = None,
    level_nodes: bool = True,
    nodes: Mapping[int, Array] | None = None,
) -> DividedSubmaps:
    """Pieces of a chain of submaps with dense maps, and their poses along the chain.

    Parameters
    ----------
    submaps : sequence of Submap
        Each base is the exit of the previous one; those without a dense map have no pieces.
    every : float, optional
        Approximate path length between nodes [m]; None: one piece per submap, which moves with its base.
    config : DivisionConfig, optional
        Set its ``reach`` to the sensor range.
    own : bool
        Subtract the copy of an older map that a submap entered (:mod:`graphslam.maps.increment`).
    grids : mapping of key to EvidenceGrid, optional
        Own evidence of each submap, if known exactly (:mod:`graphslam.maps.segslam_evidence`).
    level_nodes : bool
        Nodes have the body's position and heading without roll and pitch (3-D): an error of the momentary tilt would
        tilt a piece that can extend over 25 m.
    nodes : mapping of key to (m,), optional
        Times of a graph's nodes in each submap [s], in place of ``every``. The first is the base, not the body. A
        submap with one node is one piece.
    """
    if not submaps:
        raise DataError("there are no submaps to make a map of", wanted="one at least")
    lost = [s.key for s in submaps if s.landmarks is None and not has_dense_view(s)]
    if lost:
        raise DataError(f"submap {lost[0]} has no map", wanted="an evidence grid or a cloud")
    dense = [s for s in submaps if has_dense_view(s)]
    if grids is None and own:
        grids, _ = own_evidence(dense)
    if grids is not None:
        dense = [replace(s, grid=grids.get(s.key)) for s in dense]
    mapped = {s.key: s for s in dense}
    group = SE3 if submaps[0].dim == 3 else SE2
    out = DividedSubmaps({}, {}, {}, {}, level_nodes)
    base = group.identity
    for s in submaps:
        if s.key not in mapped:
            base = group.compose(base, s.exit_pose)
            continue
        s = mapped[s.key]
        given = None if nodes is None else np.asarray(nodes[s.key], dtype=np.float64)
        if (every is None) if given is None else len(given) < 2:
            times, local = np.array([s.interval[0]]), group.identity[None]
            pieces = pieces_of_submap(s)
        else:
            path = _path(s)
            if given is None:
                assert every is not None
                given = node_times_every(path, every)
            times, local = _clipped(path, given), local_nodes(s, given, level_nodes)
            if nodes is None:  # the first is the body, not the base
                local[0] = _poses(path, times[:1], level_nodes)[0]
            pieces = pieces_of_submap(s, times, T_base_nodes=local, config=config)
        for name, piece in pieces.items():
            k = name[1]  # type: ignore[index]
            out.pieces[name], out.local[name], out.times[name] = piece, local[k], float(times[k])
            out.poses[name] = group.compose(base, local[k])
        base = group.compose(base, s.exit_pose)
    return out


def local_nodes(s: Submap, times: Array, level_nodes: bool) -> Array:
    """``T_base_node (m, 3|7)`` of a graph's nodes in a submap; the first is the base."""
    path = _path(s)
    out = _poses(path, _clipped(path, times), level_nodes)
    out[0] = group_of(out).identity
    return out


def _path(s: Submap) -> Trajectory:
    if s.trajectory is None:
        raise DataError(f"submap {s.key} has no path to divide it along", wanted="a trajectory")
    return s.trajectory


def _clipped(path: Trajectory, times: Array) -> Array:
    """Times limited to the path, which may begin later than its submap by a rounding error."""
    return np.clip(times, path.times[0], path.times[-1])


def _poses(path: Trajectory, times: Array, level_nodes: bool) -> Array:
    poses = path.interpolate(times)
    return remove_roll_pitch(poses) if level_nodes else poses
