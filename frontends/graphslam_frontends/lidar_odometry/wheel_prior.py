"""Motion prior from wheel odometry: initial guess of a match, and the motion of unmatched scans.

The odometry is compared with the matched scans, the last 20 of them. If it predicts their motions better than constant
velocity, it may give the initial guess. If it is useful at all (units, signs and axes are plausible), it is used for
unmatched scans and along unobservable directions, with the larger of its given and its observed error variance.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.records import Odometry

FEWEST = 5
"""Least number of scans for a comparison."""
COMPARED = 20
"""Most scans for a comparison."""
USELESS = 0.25
"""Ratio of its squared error to the squared motion above which it is useless: half the motion."""
NOISE = (2e-3, 0.01)
"""σ of the scan matches [rad], [m]; smaller errors of the odometry are not significant."""


class WheelMotionPrior:
    """Motion prior from odometry, with its covariance.

    Parameters
    ----------
    odometry : Odometry
        Of the base frame.
    """

    def __init__(self, odometry: Odometry) -> None:
        self.times = np.zeros(0)
        self.steps = np.zeros((0, 7))
        """Motion up to each record, from the previous one."""
        self.stated = np.zeros((0, 2))
        """Given variance of its rotation and translation, the largest over the axes."""
        self.missed: deque[Array] = deque(maxlen=COMPARED)
        self.more(odometry)

    def more(self, odometry: Odometry, since: float = -np.inf) -> None:
        """Append later records; those before ``since`` [s] are no longer needed."""
        d = np.diagonal(odometry.covariances, axis1=1, axis2=2)
        turn, shift = (d[:, :3], d[:, 3:]) if d.shape[1] == 6 else (d[:, 2:], d[:, :2])
        a = max(int(np.searchsorted(self.times, since)) - 1, 0)
        self.times = np.concatenate([self.times[a:], odometry.times])
        self.steps = np.concatenate([self.steps[a:], _in_space(odometry.increments)])
        self.stated = np.concatenate([self.stated[a:], np.stack([turn.max(axis=1), shift.max(axis=1)], axis=1)])

    def motion(self, first: float, last: float) -> tuple[Array, Array] | None:
        """Motion ``(7,)`` between two times; given variance of rotation and translation by axis. None: not available.

        The first and the last record may be extrapolated by half their interval. Only records between the two times are
        used, so that the result does not depend on how records arrive.
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
        """Compare with a matched scan: motions by odometry, by the match, and by constant velocity (all ``(7,)``)."""
        rows = [se3.se3_between(motion, made), se3.se3_between(even, made), made]
        xi = np.asarray(se3.se3_log(np.array(rows)))
        self.missed.append(np.stack([(xi[:, :3] ** 2).mean(axis=1), (xi[:, 3:] ** 2).mean(axis=1)], axis=1))

    @property
    def better(self) -> bool:
        """Does it predict the motion of scans better than constant velocity?"""
        return len(self.missed) >= FEWEST and bool(self._squares()[0] <= self._squares()[1])

    @property
    def useful(self) -> bool:
        """Is it usable, as far as it was compared?"""
        if len(self.missed) < FEWEST:
            return True
        own, even, made = self._squares()
        return bool(own <= max(even, USELESS * made, 2.0))

    def variances(self, stated: Array) -> Array:
        """Variance of rotation and translation ``(2,)`` by axis: the larger of given and observed."""
        seen = np.mean(self.missed, axis=0)[0] if self.missed else np.zeros(2)
        return np.maximum(np.maximum(stated, seen), np.array(NOISE) ** 2)

    def _squares(self) -> Array:
        """Mean squares ``(3,)`` of its error, the error of constant velocity, and the motion, in ``NOISE``²."""
        return np.asarray(np.mean(np.array(self.missed) / np.array(NOISE) ** 2, axis=0).sum(axis=1))


def _in_space(steps: Array) -> Array:
    if steps.shape[1] == 7:
        return steps
    out = np.zeros((len(steps), 7))
    out[:, :2], out[:, 5], out[:, 6] = steps[:, :2], np.sin(steps[:, 2] / 2), np.cos(steps[:, 2] / 2)
    return out
