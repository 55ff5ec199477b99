"""The solved map of a run as plain arrays: path, nodes, landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.gaussian import largest_sigmas
from graphslam.core.geometry import Array, rotation2, se2_transform
from graphslam.core.markup import html_element, join_parts, pair_list
from graphslam.core.poses import position_covariances
from graphslam.core.sketch import plan_sketch
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.loops.places import Ints
from graphslam.solve.solution import Solution


@dataclass(frozen=True, repr=False)
class GlobalMap:
    """The solved map, in the frame of the first base.

    Parameters
    ----------
    trajectory : Trajectory
        Full rate, ``T_world_base(t)`` with covariances.
    node_times, node_poses, node_covariances : (m + 1,), (m + 1, 3|7), (m + 1, d, d)
        Bases of the submaps, their inner nodes, and the end pose of the last.
    landmark_ids, landmarks, landmark_covariances : (n,), (n, 2), (n, 2, 2)
        Confirmed landmarks.
    landmark_hits : (n,)
        Number of observations in all submaps.
    T_gps_world : (3,) or (7,) or None
        Map → GPS frame, if the graph has GPS.
    base_nodes : (k + 1,) int or None
        Indices of the nodes that are bases of submaps or the end of the last; None: all.
    """

    trajectory: Trajectory
    node_times: Array
    node_poses: Array
    node_covariances: Array
    landmark_ids: Ints
    landmarks: Array
    landmark_covariances: Array
    landmark_hits: Ints
    T_gps_world: Array | None = None
    base_nodes: Ints | None = None

    def __repr__(self) -> str:
        nodes, landmarks = len(self.node_poses), len(self.landmarks)
        return f"GlobalMap({self.trajectory!r}, {nodes} nodes, {landmarks} landmarks, in the frame of the first base)"

    def _repr_html_(self) -> str:
        d, P = self.dim, position_covariances(self.node_poses, self.node_covariances)[:, :2, :2]
        worst = f"σ of a position at most {largest_sigmas(P).max():.3g} m" if len(P) else "empty"
        text = (
            f": {worst}; {len(self.node_poses)} nodes, {len(self.landmarks)} landmarks, in the frame of the first base"
        )
        ellipses = [(self.node_poses[:, :2], P), (self.landmarks, self.landmark_covariances)]
        picture = plan_sketch([self.trajectory.positions[:, :d]], points=self.landmarks, ellipses=ellipses)
        figures = {
            "path [m]": self.trajectory.length(),
            "largest σ of a landmark [m]": largest_sigmas(self.landmark_covariances).max(initial=0.0),
            "observations of landmarks": int(self.landmark_hits.sum()),
            "in the frame of GPS": self.T_gps_world is not None,
        }
        return join_parts([html_element("b", "GlobalMap"), text, picture, pair_list(figures)])

    def landmarks_in(self, T: Array) -> tuple[Array, Array]:
        """Landmarks ``(n, 2)`` and their covariances ``(n, 2, 2)`` in another frame, ``T_frame_world`` ``(3,)``."""
        R = rotation2(T[2])
        return se2_transform(T, self.landmarks), R @ self.landmark_covariances @ R.T

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.trajectory.dim

    @property
    def base_poses(self) -> Array:
        """Bases of the submaps and the end of the last ``(k + 1, 3|7)``."""
        return self.node_poses if self.base_nodes is None else self.node_poses[self.base_nodes]

    @property
    def base_times(self) -> Array:
        """When the body was there ``(k + 1,)`` [s]."""
        return self.node_times if self.base_nodes is None else self.node_times[self.base_nodes]


def make_global_map(solution: Solution, submaps: list[Submap], hits: dict[int, int], confirmed: int) -> GlobalMap:
    """Trajectory at full rate, nodes, and the landmarks seen at least ``confirmed`` times."""
    n = np.array([hits.get(int(i), 0) for i in solution.landmark_ids], dtype=np.int64)
    keep = n >= confirmed
    return GlobalMap(
        trajectory=solution.trajectory(),
        node_times=solution.node_times,
        node_poses=solution.poses,
        node_covariances=solution.node_covariances(),
        landmark_ids=solution.landmark_ids[keep],
        landmarks=solution.landmarks[keep],
        landmark_covariances=solution.landmark_covariances()[keep],
        landmark_hits=n[keep],
        T_gps_world=solution.T_gps_world,
        base_nodes=np.append(solution.base_nodes, solution.exit_nodes[-1]).astype(np.int64),
    )
