"""Are the axes of an IMU those that its mounting says? Swapped or turned ones are found by their residuals, and named.

Over windows of about a second the gyro's turn and the mean specific force are compared with what a path says of them,
``m = A r + b T`` and ``f = A Rᵀ (0, 0, g)``, for all 48 ways A in which three axes can be exchanged and turned round.
Between the ends of a window the gyro tells, by the same A, how the body leans: a robot that balances leans to and fro
about once a second, and the mean of its two ends may be the opposite of the mean over the window.
What moves the body cancels out of f over many windows; the bias b is solved for. Ways that nothing tells apart (x and y
of a body that stays level) are no reproach: only what contradicts the stated mounting is. Where no way
explains gyro and accelerometer alike, the one that contradicts is named: a path that was made of a turned gyro agrees
with it, and not with the forces.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.trajectory import Trajectory

_AXES = "xyz"
TURNING = 0.05
"""Turns of a body over a window that a path should know of [rad/s]."""


def signed_permutations() -> Array:
    """All ways ``(48, 3, 3)`` to exchange axes and turn them round, the identity first; half of them are mirrored."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            A = np.zeros((3, 3))
            A[np.arange(3), order] = signs
            out.append(A)
    return np.stack(out)


@dataclass(frozen=True, slots=True)
class AxesCheck:
    """What a path says of the axes of an IMU.

    Parameters
    ----------
    wrong : bool
        The stated mounting is contradicted.
    A : (3, 3)
        What explains the readings best: ``reading = A · what the stated mounting would read``.
    excess : float
        By how much the residuals of the stated mounting are larger, in units of the noise that the best leaves (χ²).
    alike : int
        Ways that explain the readings as well as the best one.
    sensor : {"both", "accelerometer", "gyro"}
        Whose readings A explains.
    turns : (float, float) or None
        What the gyro turns by (root mean square over the windows), and by how much the path turns otherwise whatever
        the axes [rad/s], where that is as much: nothing can be said of the axes then.
    """

    wrong: bool
    A: Array
    excess: float
    alike: int
    windows: int
    sensor: str = "both"
    turns: tuple[float, float] | None = None

    def words(self) -> str:
        """Which axis reads what: ``"x reads −y, y reads x"``; empty if they are as stated."""
        if not self.wrong:
            return ""
        said = []
        for row in range(3):
            column = int(np.argmax(np.abs(self.A[row])))
            sign = "" if self.A[row, column] > 0 else "−"
            if column != row or sign:
                said.append(f"{_AXES[row]} reads {sign}{_AXES[column]}")
        return ", ".join(said)

    def raise_if_wrong(self, where: str = "imu") -> None:
        """Raise if the stated mounting is contradicted."""
        if self.wrong:
            several = "" if self.alike == 1 else f" (or one of {self.alike - 1} others that fit as well)"
            whose = "" if self.sensor == "both" else f" of the {self.sensor}"
            raise DataError(
                f"the axes{whose} are not those that its mounting says: {self.words()}{several}",
                where=where,
                got=f"χ² {self.excess:.0f} more than the best explanation over {self.windows} windows",
                wanted="T_base_imu as the unit is mounted",
            )


WINDOW, LIMIT, FORCE_SIGMA = 1.0, 50.0, 0.3
"""Means are over windows [s]; a mounting is contradicted if its χ² exceeds that of the best explanation by the limit;
accelerations leave at least this σ in the mean specific force of a window [m/s²]."""


def check_imu_axes(imu: Imu, path: Trajectory) -> AxesCheck:
    """Compare an IMU with a path that is about right and whose frame is about level.

    Parameters
    ----------
    path : Trajectory
        ``T_world_base``, z up.
    """
    begin, end = max(imu.times[0], path.times[0]), min(imu.times[-1], path.times[-1])
    n = int((end - begin) // WINDOW)
    if n < 10:
        raise DataError("IMU and path share too little time", got=f"{end - begin:.1f} s", wanted=f"{10 * WINDOW:g} s")
    edges = begin + WINDOW * np.arange(n + 1)
    which = np.searchsorted(edges, imu.times, side="right") - 1
    used = (which >= 0) & (which < n)
    counts = np.bincount(which[used], minlength=n)
    full = counts >= max(2, 0.5 * np.median(counts))
    if np.count_nonzero(full) < 10:
        raise DataError("IMU and path share too little time", got=f"{np.count_nonzero(full)} full windows", wanted="10")

    def mean(values: Array) -> Array:
        sums = np.stack([np.bincount(which[used], weights=values[used, k], minlength=n) for k in range(3)], axis=1)
        return np.asarray(sums[full] / counts[full, None])

    q = se3.quat_multiply(path.interpolate(edges)[:, 3:], np.broadcast_to(imu.T_base_imu[3:], (n + 1, 4)))
    R = se3.quat_to_matrix(q)
    turn = se3.so3_log(se3.quat_multiply(_conjugate(q[:-1]), q[1:]))[full] / WINDOW
    ups = R[:, 2, :] * GRAVITY
    rate, force = mean(imu.angular_rate), mean(imu.specific_force)
    ways = signed_permutations()
    r = rate - np.einsum("aij,kj->aki", ways, turn)
    r -= r.mean(axis=1, keepdims=True)  # the bias
    # a gyro that no way brings near the path (degrees for radians) tells nothing of how the body leans
    squares = float((r**2).sum(axis=(1, 2)).min()), float(((rate - rate.mean(axis=0)) ** 2).sum())
    missed, moved = (float(np.sqrt(x / len(rate))) for x in squares)
    believed = missed**2 < 0.5 * moved**2
    unlike = not believed and moved > max(TURNING, 5.0 * imu.noise.gyro / np.sqrt(WINDOW))
    turned = _turned(imu) if believed else np.zeros((len(imu.times), 3))
    ends = np.stack([np.interp(edges, imu.times, turned[:, k]) for k in range(3)], axis=1)
    since, left = mean(turned) - ends[:-1][full], ends[1:][full] - mean(turned)
    since, left = (np.einsum("aji,kj->aki", ways, x) for x in (since, left))  # in the axes that A says
    up = 0.5 * (ups[:-1][full] - np.cross(since, ups[:-1][full]) + ups[1:][full] + np.cross(left, ups[1:][full]))
    f = force - np.einsum("aij,akj->aki", ways, up)
    gyro, pull = (r**2).sum(axis=(1, 2)), (f**2).sum(axis=(1, 2))
    # what the best way of each sensor leaves is its noise, path errors and all
    rows = 3.0 * len(rate)
    s2_gyro = max(float(gyro.min()) / rows, imu.noise.gyro**2 / WINDOW, 1e-12)
    s2_pull = max(float(pull.min()) / rows, FORCE_SIGMA**2)
    # forces that one way explains are a word on the mounting even where the path turns by itself
    unlike &= float(pull.min()) > 0.25 * float(pull[0])
    gyro, pull = (gyro - gyro.min()) / s2_gyro, (pull - pull.min()) / s2_pull
    chi2, sensor = gyro + pull, "both"
    if max(gyro[np.argmin(chi2)], pull[np.argmin(chi2)]) > LIMIT:
        # no way explains both: one of them was turned, or the path was made of the very gyro; the other one is named
        chi2, sensor = (pull, "accelerometer") if pull[0] > LIMIT else (gyro, "gyro")
    best = int(np.argmin(chi2))
    excess = float(chi2[0] - chi2[best])
    alike = int(np.sum(chi2 - chi2[best] <= LIMIT))
    turns = (moved, missed) if unlike else None
    return AxesCheck(excess > LIMIT and not unlike, ways[best], excess, alike, len(rate), sensor, turns)


def _turned(imu: Imu) -> Array:
    """Integral of the rates ``(n, 3)`` by the trapezoidal rule [rad]."""
    steps = 0.5 * np.diff(imu.times)[:, None] * (imu.angular_rate[1:] + imu.angular_rate[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _conjugate(q: Array) -> Array:
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))
