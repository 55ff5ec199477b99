"""What odometry of wheels knows of the motion from scan to scan: where a match begins, and where nothing is matched.

Two questions are asked of it by the scans that were matched, over the last twenty of them: does it tell their motions
better than an even motion does? Then a match begins where it leads. And is it of any use at all, so that wrong units,
signs or axes do no harm? Then it stands where a scan finds no place in the map, and along what no surface holds, with
what it was seen to miss, or is stated to, whichever is more.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.records import Odometry
from graphslam.frontends.lidar_odometry.inertial import running

FEWEST = 5
"""Scans over which it is compared before it is doubted, or preferred."""
COMPARED = 20
"""… and over which at most."""
USELESS = 0.25
"""Square of what it misses beside that of the motion itself, from which on it tells nothing: half of the way."""
NOISE = (2e-3, 0.01)
"""What scans themselves are off by [rad], [m]: to miss no more is no fault."""


class Reckoned:
    """Tells motions by odometry, and how far they may be off.

    Parameters
    ----------
    odometry : Odometry
        Of the base.
    """

    def __init__(self, odometry: Odometry) -> None:
        self.times, self.poses = np.zeros(0), np.zeros((0, 7))
        self.stated = np.zeros((0, 2))
        self.missed: deque[Array] = deque(maxlen=COMPARED)
        self.more(odometry)

    def more(self, odometry: Odometry, since: float = -np.inf) -> None:
        """Records that came after; those before ``since`` [s] are not asked for any more."""
        if not len(odometry.times):
            return
        steps = _in_space(odometry.increments)
        first = self.poses[-1] if len(self.poses) else np.array([0.0, 0, 0, 0, 0, 0, 1])
        q = running(steps[:, 3:])[1:] if len(steps) else steps[:, 3:]
        before = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], q[:-1]])
        way = np.concatenate([np.cumsum(se3.quat_rotate(before, steps[:, :3]), axis=0), q], axis=1)
        poses = se3.se3_compose(np.broadcast_to(first, way.shape), way)
        d = np.diagonal(odometry.covariances, axis1=1, axis2=2)
        turn, shift = (d[:, :3], d[:, 3:]) if d.shape[1] == 6 else (d[:, 2:], d[:, :2])
        stated = np.cumsum(np.stack([turn.max(axis=1), shift.max(axis=1)], axis=1), axis=0)
        stated += self.stated[-1] if len(self.stated) else 0.0
        a = max(int(np.searchsorted(self.times, since)) - 1, 0)
        self.times = np.concatenate([self.times[a:], odometry.times])
        self.poses = np.concatenate([self.poses[a:], poses])
        self.stated = np.concatenate([self.stated[a:], stated])

    def motion(self, first: float, last: float) -> tuple[Array, Array] | None:
        """Motion ``(7,)`` between two times, and the stated variance of its turn and shift by axis; None: not known.

        The first and the last record hold for as long as records are apart.
        """
        t = self.times
        if len(t) < 2:
            return None
        slack = 1.5 * float(np.median(np.diff(t[-20:])))
        if first < t[0] - slack or last > t[-1] + slack:
            return None
        a, b = self._at(first), self._at(last)
        i, j = np.clip(np.searchsorted(t, [first, last]), 0, len(t) - 1)
        return np.asarray(se3.se3_between(a, b)), self.stated[j] - self.stated[max(i - 1, 0)]

    def _at(self, time: float) -> Array:
        t = self.times
        k = int(np.clip(np.searchsorted(t, time, side="right"), 1, len(t) - 1))
        span = t[k] - t[k - 1]
        share = float(np.clip((time - t[k - 1]) / span, 0.0, 1.0)) if span > 0 else 1.0
        step = se3.se3_log(se3.se3_between(self.poses[k - 1], self.poses[k]))
        return np.asarray(se3.se3_compose(self.poses[k - 1], se3.se3_exp(share * step)))

    def learn(self, motion: Array, made: Array, even: Array) -> None:
        """A scan was matched: the odometry's motion, the one that was found, and an even one (all ``(7,)``)."""
        rows = [se3.se3_between(motion, made), se3.se3_between(even, made), made]
        xi = np.asarray(se3.se3_log(np.array(rows)))
        self.missed.append(np.stack([(xi[:, :3] ** 2).mean(axis=1), (xi[:, 3:] ** 2).mean(axis=1)], axis=1))

    @property
    def better(self) -> bool:
        """Does it tell the motions of scans better than an even motion?"""
        return len(self.missed) >= FEWEST and bool(self._squares()[0] <= self._squares()[1])

    @property
    def useful(self) -> bool:
        """Does it tell motions at all, as far as is known?"""
        if len(self.missed) < FEWEST:
            return True
        own, even, made = self._squares()
        return bool(own <= max(even, USELESS * made, 2.0))

    def variances(self, stated: Array) -> Array:
        """Variance of turn and shift ``(2,)`` by axis, as it is stated or as scans saw it."""
        seen = np.mean(self.missed, axis=0)[0] if self.missed else np.zeros(2)
        return np.maximum(np.maximum(stated, seen), np.array(NOISE) ** 2)

    def _squares(self) -> Array:
        """Mean squares ``(3,)`` of what it misses, what an even motion misses, and the motion; in noise of scans."""
        return np.asarray(np.mean(np.array(self.missed) / np.array(NOISE) ** 2, axis=0).sum(axis=1))


def _in_space(steps: Array) -> Array:
    if steps.shape[1] == 7:
        return steps
    out = np.zeros((len(steps), 7))
    out[:, :2], out[:, 5], out[:, 6] = steps[:, :2], np.sin(steps[:, 2] / 2), np.cos(steps[:, 2] / 2)
    return out
