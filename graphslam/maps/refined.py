"""Map of a run along a refined path: path, nodes, and submaps with rebuilt grids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from graphslam.core.dense import CloudMap
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.points import transform_points
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from graphslam.evidence.spilled_grid import spill_grid
from graphslam.maps.global_map import GlobalMap
from graphslam.refine.result import Refinement
from graphslam.refine.scans import Scans

Index = npt.NDArray[np.int64]

KNOTS = 5
"""Places along a submap at which the covariance of its path is computed; it is interpolated between them."""
SAME = 1e-3
"""Stamps of a step and a node that differ by less are equal [s]."""


def steps_at(refinement: Refinement, times: Array) -> Index:
    """Indices ``(k,)`` of the steps at given times."""
    t = refinement.times
    j = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    j = np.where(times - t[j - 1] < t[j] - times, j - 1, j)
    bad = np.flatnonzero(np.abs(t[j] - times) > SAME)
    if len(bad):
        raise DataError(
            "a node of the graph is at no step", got=f"{times[bad[0]]:.3f} s", wanted=f"{t[j[bad[0]]]:.3f} s"
        )
    return j.astype(np.int64)


def refined_map(m: GlobalMap, refinement: Refinement, submaps: Sequence[Submap]) -> GlobalMap:
    """The solved map with the refined path in place of the graph's path.

    Nodes keep their pose relative to the body: a base can be a level frame that differs from it.
    """
    g = group_of(refinement.poses)
    at = steps_at(refinement, m.node_times)
    beside = np.tile(g.identity, (len(at), 1))  # T_body_node
    rows = np.arange(len(at)) if m.base_nodes is None else m.base_nodes
    first = submaps[0].trajectory
    if first is not None and len(first):
        beside[rows[0]] = g.inverse(first.poses[0])
    # A node is the frame of an exit. The next submap can begin with another tilt of the body after a match.
    for s, row in zip(submaps, rows[1:]):
        if s.trajectory is not None and len(s.trajectory):
            beside[row] = g.between(s.trajectory.poses[-1], s.exit_pose)
    ad = g.adjoint(g.inverse(beside))
    C = ad @ refinement.covariances[at] @ np.swapaxes(ad, 1, 2)
    return replace(
        m,
        trajectory=Trajectory(refinement.times, refinement.poses, refinement.covariances),
        node_poses=g.compose(refinement.poses[at], beside),
        node_covariances=0.5 * (C + np.swapaxes(C, 1, 2)),
        T_gps_world=m.T_gps_world if refinement.fixes is None else refinement.fixes.T_gps_world,
    )


def refined_submaps(submaps: Sequence[Submap], m: GlobalMap, refinement: Refinement, scans: Scans) -> list[Submap]:
    """The submaps along the refined path: exits, paths, grids and clouds, each from its own scans only.

    Parameters
    ----------
    submaps : sequence of Submap
        With evidence grids; their model is kept.
    m : GlobalMap
        Refined (:func:`refined_map`).
    """
    bases = base_frames(m)
    g = group_of(bases)
    ends = steps_at(refinement, m.base_times)
    out = []
    for k, s in enumerate(submaps):
        if not isinstance(s.grid, EvidenceGrid):
            raise DataError(f"submap {s.key} has no evidence grid to draw anew", wanted="a grid")
        a, b = int(ends[k]), int(ends[k + 1])
        poses = g.between(np.broadcast_to(bases[k], (b - a + 1, g.size)), refinement.poses[a : b + 1])
        exit_pose = g.between(bases[k], bases[k + 1])
        C, own = _relative(refinement, a, b), np.arange(a + (k > 0), b + 1)
        turn = g.adjoint(g.between(exit_pose, poses[-1]))  # from the body at the end to the frame of the exit
        P = turn @ C[-1] @ turn.T
        out.append(
            replace(
                s,
                exit_pose=exit_pose,
                exit_covariance=0.5 * (P + P.T),
                trajectory=Trajectory(refinement.times[a : b + 1], poses, C),
                grid=_drawn(s.grid, scans, own, poses[int(k > 0) :]),
                cloud=None if s.cloud is None else _seen(s.cloud, scans, own, poses[int(k > 0) :]),
                matches=(),
                report={**s.report, "refined": True},
            )
        )
    return out


def base_frames(m: GlobalMap) -> Array:
    """Base frames ``(k + 1, 7|3)`` of the refined submaps; levelled in 3-D if those of the run are nearly level."""
    bases = m.base_poses
    if m.dim == 2:
        return bases
    g = group_of(bases)
    lean = np.linalg.norm(g.log(g.between(remove_roll_pitch(bases), bases))[:, :2], axis=1)
    return remove_roll_pitch(bases) if np.all(lean < MOST_TILT) else bases


def map_of_frames(m: GlobalMap) -> GlobalMap:
    """The refined map with the submap frames as its only nodes, so that each submap is one piece."""
    rows = np.arange(len(m.node_poses)) if m.base_nodes is None else m.base_nodes
    return replace(
        m,
        node_times=m.node_times[rows],
        node_poses=base_frames(m),
        node_covariances=m.node_covariances[rows],
        base_nodes=None,
    )


MOST_TILT = 0.1
"""Bases with a larger tilt are not levelled [rad]."""


def _relative(refinement: Refinement, a: int, b: int) -> Array:
    """Covariances ``(b - a + 1, d, d)`` of steps a to b relative to step a, right tangents, interpolated."""
    g = group_of(refinement.poses)
    knots = np.unique(np.linspace(a, b, min(KNOTS, b - a + 1)).round().astype(np.int64))
    d = g.dof
    n = len(knots)
    J = np.zeros((n, d, n, d))  # joint steps → relative ones
    J[0] = -np.transpose(g.adjoint(g.between(refinement.poses[knots], refinement.poses[a])), (2, 0, 1))
    J[range(n), :, range(n)] += np.eye(d)
    P = refinement.joint(knots, J[:, :, 1:].reshape(n * d, -1)).reshape(n - 1, d, n - 1, d)
    out = np.zeros((n, d, d))
    out[1:] = P[range(n - 1), :, range(n - 1)]
    steps = np.arange(a, b + 1)
    j = np.clip(np.searchsorted(knots, steps, side="right") - 1, 0, max(len(knots) - 2, 0))
    if len(knots) == 1:
        return np.tile(1e-12 * np.eye(d), (1, 1, 1))
    u = ((steps - knots[j]) / (knots[j + 1] - knots[j]))[:, None, None]
    C = (1.0 - u) * out[j] + u * out[j + 1] + 1e-12 * np.eye(d)
    return np.asarray(0.5 * (C + np.swapaxes(C, 1, 2)))


def _drawn(grid: EvidenceGrid, scans: Scans, steps: Index, poses: Array) -> EvidenceGrid:
    """A grid of the same type with the scans of given steps, at ``T_grid_body`` ``(k, 7|3)``."""
    drawn = grid.empty(GridPool(grid.pool.levels))
    for k, T in zip(steps.tolist(), poses):
        points, origins, returns = scans.scan(k)
        if len(points):
            drawn.insert_scan(points, origins, pose=T, max_range=scans.max_range, returns=returns)
    return spill_grid(drawn)


def _seen(cloud: CloudMap, scans: Scans, steps: Index, poses: Array) -> CloudMap | None:
    """A cloud with the returns of given steps, at ``T_base_body`` ``(k, 7|3)``; None without returns."""
    points, origins = [], []
    scan: list[Index] = []
    for k, T in zip(steps.tolist(), poses):
        p, o, met = scans.scan(k)
        if met.any():
            points.append(transform_points(T, p[met]))
            origins.append(transform_points(T, o[met][:1]))
            scan.append(np.full(int(met.sum()), len(scan), np.int64))
    if not points:
        return None
    return CloudMap(
        points=np.concatenate(points), origins=np.concatenate(origins), scan=np.concatenate(scan), cell=cloud.cell
    )
