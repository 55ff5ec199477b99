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

FEWEST = 5
"""Scans over which it is compared before it is doubted, or preferred."""
COMPARED = 20
"""… and over which at most."""
USELESS = 0.25
"""Square of what it misses beside that of the motion itself, from which on it tells nothing: half of the way."""
NOISE = (2e-3, 0.01)
"""What scans themselves are off by [rad], [m]: to miss no more is no fault."""


class WheelMotionPrior:
    """Tells motions by odometry, and how far they may be off.

    Parameters
    ----------
    odometry : Odometry
        Of the base.
    """

    def __init__(self, odometry: Odometry) -> None:
        self.times = np.zeros(0)
        self.steps = np.zeros((0, 7))
        """Motion up to each record, from the one before it."""
        self.stated = np.zeros((0, 2))
        """Variance of its turn and of its shift by axis."""
        self.missed: deque[Array] = deque(maxlen=COMPARED)
        self.more(odometry)

    def more(self, odometry: Odometry, since: float = -np.inf) -> None:
        """Records that came after; those before ``since`` [s] are not asked for any more."""
        d = np.diagonal(odometry.covariances, axis1=1, axis2=2)
        turn, shift = (d[:, :3], d[:, 3:]) if d.shape[1] == 6 else (d[:, 2:], d[:, :2])
        a = max(int(np.searchsorted(self.times, since)) - 1, 0)
        self.times = np.concatenate([self.times[a:], odometry.times])
        self.steps = np.concatenate([self.steps[a:], _in_space(odometry.increments)])
        self.stated = np.concatenate([self.stated[a:], np.stack([turn.max(axis=1), shift.max(axis=1)], axis=1)])

    def motion(self, first: float, last: float) -> tuple[Array, Array] | None:
        """Motion ``(7,)`` between two times, and the stated variance of its turn and shift by axis; None: not known.

        The first and the last record hold for one and a half of their own time. Nothing but the records between the two
        times enters, so that it is the same however records came.
        """
        t = self.times
        if len(t) < 2 or first < t[0] - 1.5 * (t[1] - t[0]) or last > t[-1] + 1.5 * (t[-1] - t[-2]):
            return None
        i, j = np.clip(np.searchsorted(t, [first, last], side="right"), 1, len(t) - 1)
        begin, end = (float(np.clip((x - t[k - 1]) / (t[k] - t[k - 1]), 0.0, 1.0)) for x, k in ((first, i), (last, j)))
        shares = np.ones(j - i + 1)
        shares[-1] = end
        shares[0] -= begin
        motion = np.array([0.0, 0, 0, 0, 0, 0, 1])
        for part in se3.se3_exp(shares[:, None] * se3.se3_log(self.steps[i : j + 1])):
            motion = np.asarray(se3.se3_compose(motion, part))
        return motion, shares @ self.stated[i : j + 1]

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
