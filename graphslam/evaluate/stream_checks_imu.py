"""Checks of IMUs: units, saturation, stuck readings, and yaw rates compared with the wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.log import SensorLog
from graphslam.core.records import VelocityControls

GRAVITY_OFF = 0.1
"""Largest relative deviation of the median specific force from gravity."""
AT_LIMIT = 5
"""Consecutive records at an axis' extreme value that count as saturation."""
STUCK = 20
"""Consecutive records with six equal values that count as stuck."""
WINDOW = 0.5
"""Averaging window for yaw rates of gyro and wheels [s] …"""
LEAST_TURN = 0.1
"""… and least standard deviation of the rates for a comparison [rad/s]."""
SLIP = 2.5
"""Ratio of yaw rates above which the unit is wrong; skid-steered wheels slip by up to a factor of two."""
LEAST_ALIKE = 0.5
"""Least correlation of the two yaw rates; wheels that slip stay above 0.9."""
LATE = 0.2
"""Lag between the yaw rates of gyro and wheels above which the clocks differ [s]: half of a 0.4 s step."""
MOST_LAG = 2.0
"""Largest lag in the search [s]."""


def check_imu(imu: Imu, name: str, log: SensorLog) -> list[Finding]:
    """Check the readings of one IMU.

    Parameters
    ----------
    name : str
        Name of the stream in the messages.
    """
    if len(imu.times) == 0:
        return [Finding("bad", "imu-missing", f"{name}: no records.")]
    return [*_gravity(imu, name), *_limits(imu, name), *_stuck(imu, name)]


def _gravity(imu: Imu, name: str) -> list[Finding]:
    usual = float(np.median(np.linalg.norm(imu.specific_force, axis=1)))
    if imu.planar and np.any(imu.specific_force):
        return []
    if abs(usual / GRAVITY - 1.0) <= GRAVITY_OFF:
        return []
    if abs(usual - 1.0) <= GRAVITY_OFF:
        cause = "the accelerometer seems to be in g"
    elif usual < GRAVITY_OFF * GRAVITY:
        cause = "gravity seems to be removed already, or the accelerometer gives no data"
    else:
        cause = "unit or scale of the accelerometer is wrong"
    text = f"specific force of {name}: median {usual:.3g} m/s² [gravity: {GRAVITY:.2f}] — {cause}."
    return [Finding("bad", "imu-gravity", text)]


def _longest_runs(values: Array) -> tuple[int, int]:
    """Number of records in runs of at least :data:`AT_LIMIT` equal extremes of ``values (n,)``, and of runs."""
    total = runs = 0
    for extreme in (values.max(), values.min()):
        at = np.concatenate([[False], values == extreme, [False]]).astype(np.int8)
        edges = np.flatnonzero(np.diff(at)).reshape(-1, 2)
        long = np.diff(edges, axis=1).ravel()
        long = long[long >= AT_LIMIT]
        total, runs = total + int(long.sum()), runs + len(long)
    return total, runs


def _limits(imu: Imu, name: str) -> list[Finding]:
    out = []
    for what, values, unit in (("gyro", imu.angular_rate, "rad/s"), ("accelerometer", imu.specific_force, "m/s²")):
        for axis in range(3):
            v = values[:, axis]
            if np.ptp(v) == 0.0:
                continue  # no data on this axis
            count, runs = _longest_runs(v)
            if count:
                text = (
                    f"{what} of {name}: {count} records at the limit ({np.abs(v).max():.3g} {unit} on {'xyz'[axis]}) "
                    f"in {runs} stretches — saturated; headings after these turns are wrong."
                )
                out.append(Finding("bad", "imu-saturated", text))
    return out


def _stuck(imu: Imu, name: str) -> list[Finding]:
    both = np.concatenate([imu.angular_rate, imu.specific_force], axis=1)
    same = np.concatenate([[False], (np.diff(both, axis=0) == 0.0).all(axis=1), [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same)).reshape(-1, 2)
    long = np.diff(edges, axis=1).ravel()
    long = long[long >= STUCK]
    if not len(long):
        return []
    text = (
        f"records of {name} equal to the one before: {int(long.sum())} in {len(long)} stretches — the IMU is stuck "
        "there."
    )
    return [Finding("bad", "imu-stuck", text)]


@dataclass(frozen=True, slots=True)
class TurnAgreement:
    """Yaw rates of a gyro compared with those of the wheels.

    Parameters
    ----------
    slope, sigma : float
        Gyro over wheels, by total least squares, and its σ.
    lag : float
        Delay of the gyro relative to the wheels [s].
    correlation : float
        At that lag.
    """

    slope: float
    sigma: float
    lag: float
    correlation: float
    windows: int


def turn_agreement(times_a: Array, a: Array, times_b: Array, b: Array) -> TurnAgreement | None:
    """Compare two yaw rates ``(n,)`` and ``(m,)`` [rad/s] on their own stamps; None without enough turns.

    Both are averaged over :data:`WINDOW`. The slope is the ratio of the standard deviations with the sign of the
    correlation, which is symmetric in both; its σ is that of a ratio of n windows.
    """
    begin, end = max(times_a[0], times_b[0]), min(times_a[-1], times_b[-1])
    n = int((end - begin) // WINDOW)
    if n < 20:
        return None
    edges = begin + WINDOW * np.arange(n + 1)
    x = _means(times_b, b, edges)
    best: tuple[float, float, Array] | None = None
    for lag in np.arange(-MOST_LAG, MOST_LAG + 0.01, 0.05):
        y = _means(times_a, a, edges + lag)
        r = _correlation(x, y)
        if best is None or abs(r) > abs(best[0]) + 1e-12:
            best = (r, float(lag), y)
    assert best is not None
    r, lag, y = best
    good = np.isfinite(x) & np.isfinite(y)
    sx, sy = float(np.std(x[good])), float(np.std(y[good]))
    if min(sx, sy) == 0.0 or max(sx, sy) < LEAST_TURN or int(good.sum()) < 20:
        return None
    slope = float(np.sign(r)) * sy / sx
    sigma = abs(slope) * float(np.sqrt(max(1.0 - r * r, 1e-9) / good.sum()))
    return TurnAgreement(slope, sigma, lag, abs(r), int(good.sum()))


def _means(times: Array, values: Array, edges: Array) -> Array:
    """Mean of ``values`` in each window; NaN where there is no record."""
    which = np.searchsorted(edges, times, side="right") - 1
    ok = (which >= 0) & (which < len(edges) - 1)
    n = np.bincount(which[ok], minlength=len(edges) - 1)
    s = np.bincount(which[ok], weights=values[ok], minlength=len(edges) - 1)
    return np.where(n > 0, s / np.maximum(n, 1), np.nan)


def _correlation(x: Array, y: Array) -> float:
    ok: npt.NDArray[np.bool_] = np.isfinite(x) & np.isfinite(y)
    if ok.sum() < 10 or np.std(x[ok]) == 0 or np.std(y[ok]) == 0:
        return 0.0
    return float(np.corrcoef(x[ok], y[ok])[0, 1])


def check_turns(imu: Imu, name: str, log: SensorLog) -> list[Finding]:
    """Compare the yaw rates of the gyro with those of the wheels, if the log has any."""
    wheels = next((s for s in log.streams.values() if isinstance(s, VelocityControls)), None)
    return [] if wheels is None else compare_turns(imu, wheels, name)


def compare_turns(imu: Imu, wheels: VelocityControls, name: str) -> list[Finding]:
    """Compare the yaw rate of the gyro about the base's z axis with that of the wheels.

    Parameters
    ----------
    name : str
        Name of the IMU in the messages.
    """
    if len(imu.times) < 2 or len(wheels.times) < 2:
        return []
    rate = se3.quat_rotate(imu.T_base_imu[3:], imu.angular_rate)[:, 2]
    found = turn_agreement(imu.times, rate, wheels.times, wheels.yaw_rate)
    if found is None:
        return []
    if found.correlation < LEAST_ALIKE:
        text = (
            f"yaw rates of {name} and of the wheels: correlation {found.correlation:.2f} [≥ {LEAST_ALIKE:g}] — the IMU "
            "axes or the mounting (T_base_imu) may be wrong."
        )
        return [Finding("look", "turns-disagree", text)]
    out = []
    result = f"turns of {name}: {found.slope:.3g} ± {found.sigma:.2g} times those of the wheels"
    size = abs(found.slope)
    if not 1.0 / SLIP <= size <= SLIP:
        cause = "one of them is in another unit"
        if abs(np.log(size * np.pi / 180.0)) < np.log(SLIP):
            cause = "the gyro seems to be in degrees, wanted rad/s"
        elif abs(np.log(size * 180.0 / np.pi)) < np.log(SLIP):
            cause = "the wheels' yaw rate seems to be in degrees, wanted rad/s"
        out.append(Finding("bad", "turns-disagree", f"{result} — {cause}."))
    elif found.slope < 0:
        cause = "left and right wheel are swapped, or a gyro axis is reversed"
        out.append(Finding("look", "turns-disagree", f"{result} — {cause}."))
    if abs(found.lag) > LATE:
        order = "after" if found.lag > 0 else "before"
        result = f"turns of {name}: {abs(found.lag):.2f} s {order} those of the wheels"
        text = f"{result} — their clocks differ."
        out.append(Finding("bad", "clocks-disagree", text))
    return out
