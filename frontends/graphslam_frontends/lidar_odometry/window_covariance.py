"""Joint covariance of the current pose and the poses of the window that it was matched to.

A scan is matched to cells, and cells have the errors of the poses of earlier scans. So the error of a pose is the mean
of the errors of the poses that made its cells, weighted by their information, plus an independent part. The joint
covariance of all of them is propagated; old poses are considered, not corrected (Schmidt–Kalman filter). Errors common
to start and end of a submap cancel in its end pose; errors common to a window stay in it.
"""

from __future__ import annotations

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array

SLOTS = 48
"""Most poses in the window."""
APART = (1.0, np.deg2rad(15.0))
"""A new window pose begins after this much path [m] or rotation [rad] …"""
SCANS = 10
"""… or this many scans."""


class WindowCovariance:
    """Joint covariance of the pose errors of a window, right tangents.

    Slot 0 is the current pose, slot 1 the first pose of the submap, the others are window poses, oldest first.
    """

    def __init__(self) -> None:
        self.poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1))
        self.ends: list[float] = []
        self.P = np.zeros((12, 12))
        self.offset = np.zeros(12)
        self._scan = 0

    @property
    def joint(self) -> Array:
        """Joint covariance ``(12, 12)`` of the first pose of the submap and the current pose."""
        at = np.r_[6:12, 0:6]
        return np.asarray(self.P[np.ix_(at, at)] + np.outer(self.offset[at], self.offset[at]))

    def begin(self) -> None:
        """Start a submap at the current pose."""
        self._clone(1)

    def step(self, pose: Array, motion: Array, Q: Array, H: Array, M: Array, bent: Array, off: Array) -> None:
        """Propagate to the next pose.

        Parameters
        ----------
        pose : (7,)
        motion : (7,)
            Predicted motion from the last pose.
        Q : (6, 6)
            Covariance of its error, right tangent.
        H : (s, 6, 6)
            Information by slot of the window, right tangent of ``pose``.
        M : (6, 6)
            Covariance of the noise of the gradient.
        bent : (6, 6)
            Covariance of the pose error caused by non-uniform motion within the scan.
        off : (6,)
            Known offset of ``pose`` from the best match, right tangent; propagated as a deterministic error.
        """
        L = np.linalg.inv(Q)
        total = H.sum(axis=0)
        K = np.linalg.inv(total + L)
        n = len(self.P)
        G = np.zeros((6, n))
        G[:, :6] = K @ L @ se3.se3_adjoint(se3.se3_inverse(motion))
        if self.ends:
            slots = K @ H @ se3.se3_adjoint(se3.se3_between(pose, self.poses[2:]))
            G[:, 12:] = slots.transpose(1, 0, 2).reshape(6, -1)
        own = K @ (M + L + total @ bent @ total.T) @ K.T
        GP = G @ self.P
        new = GP @ G.T + own
        self.P[:6, 6:], self.P[6:, :6] = GP[:, 6:], GP[:, 6:].T
        self.P[:6, :6] = 0.5 * (new + new.T)
        self.offset[:6] = G @ self.offset + off
        self.poses[0] = pose

    def lay(self, scan: int, alone: bool = False) -> None:
        """Add the scan of the current pose to the map; ``alone``: always as a new window pose."""
        if self.ends and not alone:
            off = se3.se3_between(self.poses[-1], self.poses[0])
            near = np.linalg.norm(off[:3]) < APART[0] and np.linalg.norm(se3.so3_log(off[3:])) < APART[1]
            if near and scan - self._scan < SCANS:
                self.ends[-1] = float(scan) + 0.5
                return
        if len(self.ends) == SLOTS:
            # cells of the oldest pose are attributed to the next one
            self.ends.pop(0)
            self.poses = np.delete(self.poses, 2, axis=0)
            keep = np.r_[0:12, 18 : len(self.P)]
            self.P, self.offset = np.ascontiguousarray(self.P[np.ix_(keep, keep)]), self.offset[keep]
        self.ends.append(float(scan) + 0.5)
        self._scan = scan
        self.poses = np.concatenate([self.poses, self.poses[:1]])
        n = len(self.P)
        P = np.zeros((n + 6, n + 6))
        P[:n, :n] = self.P
        self.P, self.offset = P, np.append(self.offset, np.zeros(6))
        self._clone(len(self.poses) - 1)

    def forget(self) -> None:
        """Delete the window poses, because a new map begins."""
        self.ends, self.poses = [], self.poses[:2].copy()
        self.P, self.offset = self.P[:12, :12].copy(), self.offset[:12].copy()

    def _clone(self, slot: int) -> None:
        at = slice(6 * slot, 6 * slot + 6)
        self.poses[slot] = self.poses[0]
        self.P[at] = self.P[:6]
        self.P[:, at] = self.P[:, :6]
        self.P[at, at] = self.P[:6, :6]
        self.offset[at] = self.offset[:6]
