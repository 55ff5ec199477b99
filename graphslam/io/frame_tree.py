"""Coordinate frames of a bag: static and moving transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask
from graphslam.core.trajectory import Trajectory
from graphslam.io import ros_messages as ros

ODOMETRY_FRAMES = ("odom", "odom_combined", "odometry", "world_odom")
BASE_FRAMES = ("base_link", "base_footprint", "base")
MAP_FRAMES = ("map", "world", "earth", "utm")
"""Frames above the odometry frame: motion relative to them is already a result of SLAM or GPS."""
LEAST_PATH = 1.0
"""A moving transform with an unknown name is odometry only if its range along x, y or z is at least this [m]; that of
joints is smaller."""


@dataclass
class TopicRows:
    """Values of the messages of one topic, with stamps and frames; ``frame`` is that of most of them."""

    stamps: list[float] = field(default_factory=list)
    bag_stamps: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    frame: str = ""
    frames: list[str] = field(default_factory=list)
    child: str = ""
    damaged: int = 0
    why: str = ""


def leaf(frame: str) -> str:
    """Name without the namespace of a robot: ``robot1/odom`` is ``odom``."""
    return frame.rsplit("/", 1)[-1].lower()


class FrameTree:
    """Transforms between frames: ``fixed`` ones by (parent, child), and ``moving`` ones with their records."""

    def __init__(self) -> None:
        self.fixed: dict[tuple[str, str], list[float]] = {}
        self.moving: dict[tuple[str, str], TopicRows] = {}

    def add(self, message: Any, bag_stamp: float, static: bool) -> None:
        for t in message.transforms:
            key = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            pose = ros.pose_of_message(t.transform)
            norm = float(np.linalg.norm(pose[3:]))
            if not np.all(finite_mask(pose)) or abs(norm - 1.0) > 0.05:
                continue
            if static:
                self.fixed[key] = pose
            else:
                rows = self.moving.setdefault(key, TopicRows())
                rows.stamps.append(ros.stamp_of(t))
                rows.bag_stamps.append(bag_stamp)
                rows.values.append(pose)

    def fix_constant(self) -> None:
        """Treat transforms of ``tf`` that never changed as fixed, except from odometry frames."""
        for key, rows in list(self.moving.items()):
            if np.ptp(np.array(rows.values), axis=0).max() == 0.0 and leaf(key[0]) not in ODOMETRY_FRAMES:
                self.fixed.setdefault(key, rows.values[0])
                del self.moving[key]

    def know(self, a: str, b: str) -> bool:
        """Are the frames connected by fixed transforms?"""
        return self.between(a, b) is not None

    def between(self, a: str, b: str) -> Array | None:
        """``T_a_b`` ``(7,)`` over fixed transforms, or None."""
        return self._reached(a).get(b)

    def _reached(self, a: str) -> dict[str, Array]:
        """``T_a_b`` of all frames b that are connected to a by fixed transforms."""
        steps: dict[str, list[tuple[str, Array]]] = {}
        for (parent, child), pose in self.fixed.items():
            T = np.concatenate([pose[:3], se3.quat_normalize(np.array(pose[3:]))])
            steps.setdefault(parent, []).append((child, T))
            steps.setdefault(child, []).append((parent, se3.se3_inverse(T)))
        reached = {a: np.array([0.0, 0, 0, 0, 0, 0, 1])}
        todo = [a]
        while todo:
            at = todo.pop(0)
            for to, T in steps.get(at, []):
                if to not in reached:
                    reached[to] = se3.se3_compose(reached[at], T)
                    todo.append(to)
        return reached

    def odometry(self, scanners: set[str], parent: str | None = None) -> tuple[str, str] | None:
        """Parent and child of the moving transform that is odometry, or None.

        Known names are preferred, and map frames come last. For an unknown name, the base or a scanner must be fixed to
        the child, the base must not be fixed to the parent, and the motion must reach :data:`LEAST_WAY`.

        Parameters
        ----------
        scanners : set of str
            Frames of the scanners.
        parent : str, optional
            Parent frame, if it is given by the user.
        """
        found = []
        for key, rows in self.moving.items():
            if len(rows.values) < 3 or (parent is not None and key[0] != parent):
                continue
            known = leaf(key[0]) in ODOMETRY_FRAMES
            carried, behind = self._reached(key[1]), self._reached(key[0])
            bases = {f for f in carried if leaf(f) in BASE_FRAMES}
            if parent is None and not known:
                extent = float(np.ptp(np.array(rows.values)[:, :3], axis=0).max())
                based = any(leaf(f) in BASE_FRAMES for f in behind)
                if based or extent < LEAST_PATH or not (bases or scanners & carried.keys()):
                    continue
            found.append((known, leaf(key[0]) not in MAP_FRAMES, len(rows.values), key))
        return max(found)[3] if found else None

    def moving_place(self, base: str, frame: str, times: Array) -> Array | None:
        """``T_base_frame`` ``(n, 7)`` at times, if one moving transform connects base and frame; or None."""
        for (parent, child), rows in self.moving.items():
            for up, down, inverse in ((parent, child, True), (child, parent, False)):
                near, far = self.between(base, down), self.between(up, frame)
                t = np.array(rows.stamps)
                order = np.unique(t, return_index=True)[1]
                if near is None or far is None or len(order) < 2:
                    continue
                values = np.array(rows.values)[order]
                path = Trajectory(t[order], np.column_stack([values[:, :3], se3.quat_normalize(values[:, 3:])]))
                T = path.interpolate(np.clip(times, path.times[0], path.times[-1]))  # T_parent_child
                T = se3.se3_inverse(T) if inverse else T  # T_down_up
                many = (len(T), 7)
                return np.asarray(
                    se3.se3_compose(se3.se3_compose(np.broadcast_to(near, many), T), np.broadcast_to(far, many))
                )
        return None
