"""Live view of a run: path, map and loops in the viewer Rerun, or in a file that Rerun replays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.backend.back_end import Observer
from graphslam.core.atomic import check_file_target
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.submap_node import SubmapNode
from graphslam.loops.ledger import LoopDecision
from graphslam.solve.solution import Solution

POINTS = 4000
"""Approximate largest number of points that are sent per submap."""
PATH, LANDMARKS, BELIEVED, DOUBTED = (31, 119, 180), (214, 39, 40), (44, 160, 44), (160, 160, 160)


class LiveView(Observer):
    """Shows a run in Rerun while it is computed.

    The timeline ``submap`` counts the submaps in the graph, ``seconds`` is the clock of the log. The points of a submap
    are sent once, in its own frame; its pose is sent again whenever the graph is solved.
    Under ``map``: ``submap-…`` with ``points``, ``path`` (nodes of the graph), ``landmarks``, ``loops/…``; decisions on
    loops as text under ``said``. A refinement with scans comes later and is not shown.

    Parameters
    ----------
    name : str
        Name of the log.
    file : path, optional
        Recording that is written (``.rrd``) instead of opening a viewer.
    """

    def __init__(self, name: str, file: str | Path | None = None) -> None:
        self.rr: Any = import_extra("rerun", "a live view")
        self.stream = self.rr.RecordingStream(f"graphslam {name}")
        if file is None:
            self.stream.spawn()
        else:
            self.stream.save(str(check_file_target(file)))
        self.stream.log("map", self.rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def submap_added(self, submap: Submap, graph: FactorGraph) -> None:
        """Send the points of the submap, and all current poses."""
        self.stream.set_time("submap", sequence=len(graph.submaps))
        self.stream.set_time("seconds", duration=submap.interval[1])
        points = shown_points(submap)
        if len(points):
            self.stream.log(f"map/submap-{submap.key}/points", self.rr.Points3D(points))
        self._places(graph.submaps, np.asarray(graph.values.poses), np.asarray(graph.values.landmarks))

    def loop_decided(self, decision: LoopDecision, graph: FactorGraph) -> None:
        """A line between the two bases, green if the loop was accepted, and the reason as text."""
        nodes = {s.key: s.node for s in graph.submaps}
        ends = graph.values.poses[[nodes[decision.submap_i], nodes[decision.submap_j]], : graph.dim]
        colour = BELIEVED if decision.verdict == "accepted" else DOUBTED
        line = self.rr.LineStrips3D([raise_points(ends)], colors=[colour], labels=[decision.verdict])
        self.stream.log(f"map/loops/{decision.loop}", line)
        text = f"loop {decision.loop}, submaps {decision.submap_i} and {decision.submap_j}: {decision.verdict}"
        self.stream.log("said", self.rr.TextLog(f"{text}, {decision.why}" if decision.why else text))

    def solved(self, solution: Solution) -> None:
        """Send the poses of the optimum and close the recording."""
        self._places(solution.submaps, solution.poses, solution.landmarks)
        self.stream.log("said", self.rr.TextLog("solved" if solution.converged else "not solved"))
        self.stream.disconnect()  # the file is complete

    def _places(self, submaps: Sequence[SubmapNode], poses: Array, landmarks: Array) -> None:
        rr, dim = self.rr, group_of(poses).dim
        for s in submaps:
            x, q = pose_in_space(poses[s.node])
            self.stream.log(f"map/submap-{s.key}", rr.Transform3D(translation=x, quaternion=q))
        self.stream.log("map/path", rr.LineStrips3D([raise_points(poses[:, :dim])], colors=[PATH]))
        if len(landmarks):
            self.stream.log("map/landmarks", rr.Points3D(raise_points(landmarks), radii=0.3, colors=LANDMARKS))


def shown_points(submap: Submap) -> Array:
    """Occupied points ``(n, 3)`` of a submap in the frame of its base, subsampled to about :data:`POINTS`."""
    if submap.cloud is not None:
        points = submap.cloud.points
    elif isinstance(submap.grid, EvidenceGrid):
        points = submap.grid.occupied_cloud()
    else:
        return np.zeros((0, 3))
    return raise_points(points[:: max(1, -(-len(points) // POINTS))])


def raise_points(points: Array) -> Array:
    """3-D points ``(n, 3)``; planar points get height 0."""
    points = np.asarray(points, dtype=np.float64)
    return points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])


def pose_in_space(pose: Array) -> tuple[Array, Array]:
    """Position ``(3,)`` and quaternion ``(4,)`` x y z w of a pose ``(3,)`` or ``(7,)``."""
    if len(pose) == 7:
        return pose[:3], pose[3:]
    half = 0.5 * float(pose[2])
    return np.array([pose[0], pose[1], 0.0]), np.array([0.0, 0.0, np.sin(half), np.cos(half)])
