"""Messages of ROS 2 from a run: transforms, path, poses with covariances, map, points, ellipses and loop closures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.run.run import Run
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import position_covariances
from graphslam.evidence.formats import to_dense
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.io.bag_writer import BagForm, BagRecord, MessageFactory, ellipsoid, ros_covariances, write_bag
from graphslam.io.tum import embed_plane
from graphslam.loops.ledger import LoopLedger
from graphslam.maps.coarse import drawable_map
from graphslam.maps.export import floor_plan
from graphslam.maps.run_map import RunMap

MAP, BASE = "map", "base"
"""Frames: of the first base, and of the robot."""
ELLIPSES = 60
"""About the most ellipses along the path."""
BLUE, VERMILION, GREEN = (0.0, 0.45, 0.7, 0.5), (0.84, 0.37, 0.0, 0.5), (0.0, 0.62, 0.45, 1.0)
SPHERE, CYLINDER, LINES, SPHERES = 2, 3, 5, 7


def write_run_bag(run: Run, path: Path, form: BagForm, confidence: float, fused: RunMap | None) -> None:
    """Write a run as a bag.

    Parameters
    ----------
    confidence : float
        Of the ellipses.
    fused : RunMap or None
        The dense map; without it there is no map and no cloud.
    """
    factory = MessageFactory()
    write_bag(path, run_records(run, factory, confidence, fused), form, factory)


def run_records(run: Run, factory: MessageFactory, confidence: float, fused: RunMap | None) -> Iterator[BagRecord]:
    """Messages of a run; those of the whole map have the first stamp of the path."""
    path = run.trajectory
    if not len(path) or path.times[0] < 0.0:
        got = f"{path.times[0]:.3f} s" if len(path) else "an empty path"
        raise DataError("stamps of ROS are not negative", where=run.name, got=got, wanted="a path with stamps ≥ 0 s")
    poses = embed_plane(path.poses) if path.dim == 2 else path.poses
    P = np.zeros((len(path), 6, 6)) if path.covariances is None else ros_covariances(path.poses, path.covariances)
    stamps = [round(t * 1e9) for t in path.times.tolist()]
    placed = []
    for stamp, T, C in zip(stamps, poses, P):
        head, pose = factory.header(stamp, MAP), factory.pose(T)
        placed.append(factory.make("geometry_msgs/PoseStamped", header=head, pose=pose))
        full = factory.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=C.reshape(-1))
        yield BagRecord("/tf", factory.transforms(stamp, MAP, BASE, T), stamp)
        yield BagRecord("/pose", factory.make("geometry_msgs/PoseWithCovarianceStamped", header=head, pose=full), stamp)
    first = stamps[0]
    whole = factory.make("nav_msgs/Path", header=factory.header(first, MAP), poses=placed)
    yield BagRecord("/path", whole, first, latched=True)
    if fused is not None:
        grid = fused.fused.grid
        for name, plan in floor_plans(grid, fused):
            yield BagRecord(f"/map{name}", _occupancy(factory, first, plan), first, latched=True)
        points = np.asarray(grid.occupied_cloud(), dtype=np.float64)
        points = points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])
        yield BagRecord("/points", factory.cloud(first, MAP, points), first, latched=True)
    markers = factory.make("visualization_msgs/MarkerArray", markers=list(_markers(run, factory, first, confidence)))
    yield BagRecord("/markers", markers, first, latched=True)


def floor_plans(grid: EvidenceGrid, made: RunMap) -> Iterator[tuple[str, EvidenceGrid]]:
    """Planar maps with the ends of their topics: the grid itself, or one of each height band."""
    if grid.dim == 2:
        yield "", grid
        return
    for band, (low, high) in made.bands.items():
        plan = floor_plan(grid, low, high)
        if plan.voxel_counts().known:
            yield "" if len(made.bands) == 1 else f"/{band.replace('-', '_')}", plan


def _occupancy(factory: MessageFactory, time: int, plan: EvidenceGrid) -> Any:
    dense = to_dense(drawable_map(plan))
    cells = np.where(dense.values >= plan.model.threshold_step, 100, 0)
    cells[dense.values == UNKNOWN] = -1
    corner = np.array([*dense.origin, 0.0, 0.0, 0.0, 0.0, 1.0])
    return factory.occupancy(time, MAP, cells.T, corner, float(dense.voxel_size))


def _markers(run: Run, factory: MessageFactory, time: int, confidence: float) -> Iterator[Any]:
    m, head = run.map, factory.header(time, MAP)
    here = np.array([0.0, 0, 0, 0, 0, 0, 1])
    some = np.unique(np.linspace(0, len(m.node_poses) - 1, min(len(m.node_poses), ELLIPSES)).astype(np.intp))
    nodes = m.node_poses[some, : m.dim], position_covariances(m.node_poses[some], m.node_covariances[some])
    for name, (centres, P), colour in (
        ("pose ellipses", nodes, BLUE),
        ("landmark ellipses", (m.landmarks, m.landmark_covariances), VERMILION),
    ):
        for k, (centre, C) in enumerate(zip(centres, P)):
            pose, scale = ellipsoid(centre, C, confidence)
            if scale.min() > 0.0:  # the first base is certain
                kind = CYLINDER if len(centre) == 2 else SPHERE
                yield factory.marker(head, name, k, kind, pose, scale.tolist(), colour=colour)
    if len(m.landmarks):
        points = np.column_stack([m.landmarks, np.zeros((len(m.landmarks), 3 - m.landmarks.shape[1]))])
        dots = {"points": points, "colour": (*VERMILION[:3], 1.0)}
        yield factory.marker(head, "landmarks", 0, SPHERES, here, [0.2, 0.2, 0.2], **dots)
    ends = loop_ends(run)
    if len(ends):
        yield factory.marker(head, "loops", 0, LINES, here, [0.05, 0.0, 0.0], points=ends.reshape(-1, 3), colour=GREEN)


def loop_ends(run: Run) -> Array:
    """Positions ``(n, 2, 3)`` of the two bases of each accepted loop closure."""
    place = {s.key: k for k, s in enumerate(run.submaps)}
    bases = run.map.base_poses[:, : run.map.dim]
    bases = np.column_stack([bases, np.zeros((len(bases), 3 - run.map.dim))])
    loops = [d for d in LoopLedger.from_events(run.events).current() if d.verdict == "accepted"]
    pairs = [(place[d.submap_i], place[d.submap_j]) for d in loops if d.submap_i in place and d.submap_j in place]
    return np.asarray(bases[np.array(pairs, dtype=np.intp).reshape(-1, 2)])
