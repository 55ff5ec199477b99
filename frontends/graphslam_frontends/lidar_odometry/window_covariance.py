"""How far the pose of now is off beside the poses of the window it was matched to.

A scan is put where the cells are, and the cells are where earlier scans were thought to be. So the error of a pose is
the mean of the errors of the poses that made its cells, weighted by what each told of it, and something of its own. The
covariance of all of these is carried along as a joint one (a filter that *considers* the old poses, after Schmidt, and
no longer corrects them): what start and end of a submap share leaves its exit, and what a window shares stays in it.
"""

from __future__ import annotations

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array

SLOTS = 48
"""Poses of the window that are told apart."""
APART = (1.0, np.deg2rad(15.0))
"""A new one begins after so much way [m] or turn [rad] …"""
SCANS = 10
"""… or so many scans."""


class WindowCovariance:
    """Joint covariance of the errors of the poses of a window, right tangents.

    Slot 0 is the pose of now, slot 1 that where the submap began, the others those of the window, oldest first.
    """

    def __init__(self) -> None:
        self.poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1))
        self.ends: list[float] = []
        self.P = np.zeros((12, 12))
        self.offset = np.zeros(12)
        self._scan = 0

    @property
    def joint(self) -> Array:
        """``(12, 12)``: of the pose where the submap began, and the pose of now."""
        at = np.r_[6:12, 0:6]
        return np.asarray(self.P[np.ix_(at, at)] + np.outer(self.offset[at], self.offset[at]))

    def begin(self) -> None:
        """A submap begins at the pose of now."""
        self._clone(1)

    def step(self, pose: Array, motion: Array, Q: Array, H: Array, M: Array, bent: Array, off: Array) -> None:
        """The pose of now becomes the next one.

        Parameters
        ----------
        pose : (7,)
        motion : (7,)
            Predicted, from the last one.
        Q : (6, 6)
            Covariance of its error, right tangent.
        H : (s, 6, 6)
            Information by slot of the window, right tangent of ``pose``.
        M : (6, 6)
            Covariance of the noise of the gradient.
        bent : (6, 6)
            Covariance of what an uneven motion within the scan does to its pose.
        off : (6,)
            Known difference of ``pose`` to the best match, right tangent; its consequences are one error, as large.
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
        """The scan of the pose of now went into the map; ``alone``: its pose has an error of its own."""
        if self.ends and not alone:
            off = se3.se3_between(self.poses[-1], self.poses[0])
            near = np.linalg.norm(off[:3]) < APART[0] and np.linalg.norm(se3.so3_log(off[3:])) < APART[1]
            if near and scan - self._scan < SCANS:
                self.ends[-1] = float(scan) + 0.5
                return
        if len(self.ends) == SLOTS:
            # what the oldest made is taken for made by the next
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
        """A new map begins."""
        self.ends, self.poses = [], self.poses[:2].copy()
        self.P, self.offset = self.P[:12, :12].copy(), self.offset[:12].copy()

    def _clone(self, slot: int) -> None:
        at = slice(6 * slot, 6 * slot + 6)
        self.poses[slot] = self.poses[0]
        self.P[at] = self.P[:6]
        self.P[:, at] = self.P[:, :6]
        self.P[at, at] = self.P[:6, :6]
        self.offset[at] = self.offset[:6]
