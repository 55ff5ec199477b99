"""Check the axes of an IMU against its mounting: swapped or reversed axes are detected by their residuals, and named.

Over windows of 1 s the gyro's rotation and the mean specific force are compared with those of a path,
``m = A r + b T`` and ``f = A Rᵀ (0, 0, g)``, for all 48 signed permutations A of the three axes. The attitude inside a
window is interpolated with the gyro, by the same A: a balancing robot leans to and fro about once a second, so the mean
over the window may differ in sign from the mean of its two ends.
Accelerations of the body average out of f over many windows; the bias b is estimated. Permutations that cannot be
distinguished (x and y of a body that stays level) are no error: only a contradiction to the stated mounting is. If no
permutation explains both gyro and accelerometer, the contradicting one is named: a path that was made with a wrongly
mounted gyro agrees with it, but not with the forces.
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
"""Turn rate over a window that a correct path should contain [rad/s]."""


def signed_permutations() -> Array:
    """All signed permutations ``(48, 3, 3)`` of the axes, the identity first; half of them are reflections."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            A = np.zeros((3, 3))
            A[np.arange(3), order] = signs
            out.append(A)
    return np.stack(out)


@dataclass(frozen=True, slots=True)
class AxesCheck:
    """Result of the comparison of an IMU's axes with a path.

    Parameters
    ----------
    wrong : bool
        The stated mounting is contradicted.
    A : (3, 3)
        Best explanation: ``reading = A · reading of a correctly mounted unit``.
    excess : float
        χ² of the stated mounting minus that of the best explanation; the noise is the residual of the best.
    alike : int
        Number of permutations that explain the readings as well as the best one, with itself.
    sensor : {"both", "accelerometer", "gyro"}
        Sensor whose readings A explains.
    turns : (float, float) or None
        RMS turn rate of the gyro, and RMS difference to the path for the best axes [rad/s], if they are similar: then
        the axes cannot be checked.
    """

    wrong: bool
    A: Array
    excess: float
    alike: int
    windows: int
    sensor: str = "both"
    turns: tuple[float, float] | None = None

    def words(self) -> str:
        """Reading of each wrong axis: ``"x reads −y, y reads x"``; empty if all are as stated."""
        if not self.wrong:
            return ""
        readings = []
        for row in range(3):
            column = int(np.argmax(np.abs(self.A[row])))
            sign = "" if self.A[row, column] > 0 else "−"
            if column != row or sign:
                readings.append(f"{_AXES[row]} reads {sign}{_AXES[column]}")
        return ", ".join(readings)

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
"""Length of a window [s]; limit on the χ² of the stated mounting minus that of the best explanation; minimum σ of the
mean specific force of a window due to accelerations [m/s²]."""


def check_imu_axes(imu: Imu, path: Trajectory) -> AxesCheck:
    """Compare an IMU with an approximately correct path in an approximately level frame.

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
    mountings = signed_permutations()
    r = rate - np.einsum("aij,kj->aki", mountings, turn)
    r -= r.mean(axis=1, keepdims=True)  # the bias
    # a gyro that no permutation brings near the path (degrees for radians) is not used for the attitude
    squares = float((r**2).sum(axis=(1, 2)).min()), float(((rate - rate.mean(axis=0)) ** 2).sum())
    missed, moved = (float(np.sqrt(x / len(rate))) for x in squares)
    believed = missed**2 < 0.5 * moved**2
    unlike = not believed and moved > max(TURNING, 5.0 * imu.noise.gyro / np.sqrt(WINDOW))
    turned = _turned(imu) if believed else np.zeros((len(imu.times), 3))
    ends = np.stack([np.interp(edges, imu.times, turned[:, k]) for k in range(3)], axis=1)
    since, left = mean(turned) - ends[:-1][full], ends[1:][full] - mean(turned)
    since, left = (np.einsum("aji,kj->aki", mountings, x) for x in (since, left))  # in the axes of each A
    up = 0.5 * (ups[:-1][full] - np.cross(since, ups[:-1][full]) + ups[1:][full] + np.cross(left, ups[1:][full]))
    f = force - np.einsum("aij,akj->aki", mountings, up)
    gyro, pull = (r**2).sum(axis=(1, 2)), (f**2).sum(axis=(1, 2))
    # the residual of the best permutation of each sensor is its noise, with the errors of the path
    rows = 3.0 * len(rate)
    s2_gyro = max(float(gyro.min()) / rows, imu.noise.gyro**2 / WINDOW, 1e-12)
    s2_pull = max(float(pull.min()) / rows, FORCE_SIGMA**2)
    # if one permutation explains the forces, the mounting is tested although the rotations of the path differ
    unlike &= float(pull.min()) > 0.25 * float(pull[0])
    gyro, pull = (gyro - gyro.min()) / s2_gyro, (pull - pull.min()) / s2_pull
    chi2, sensor = gyro + pull, "both"
    if max(gyro[np.argmin(chi2)], pull[np.argmin(chi2)]) > LIMIT:
        # no permutation explains both: one sensor is turned, or the path was made with this gyro; name the other one
        chi2, sensor = (pull, "accelerometer") if pull[0] > LIMIT else (gyro, "gyro")
    best = int(np.argmin(chi2))
    excess = float(chi2[0] - chi2[best])
    alike = int(np.sum(chi2 - chi2[best] <= LIMIT))
    turns = (moved, missed) if unlike else None
    return AxesCheck(excess > LIMIT and not unlike, mountings[best], excess, alike, len(rate), sensor, turns)


def _turned(imu: Imu) -> Array:
    """Integral of the rates ``(n, 3)`` by the trapezoidal rule [rad]."""
    steps = 0.5 * np.diff(imu.times)[:, None] * (imu.angular_rate[1:] + imu.angular_rate[:-1])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _conjugate(q: Array) -> Array:
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))
