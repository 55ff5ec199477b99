"""IMUs whose readings cannot be right: wrong units, at their limit, stuck, or against the turns of the wheels."""

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
"""Share by which the median specific force may be off gravity: biases and scales of accelerometers are far below it."""
AT_LIMIT = 5
"""Records in a row at one axis' greatest value that are no accident: noise never repeats a number."""
STUCK = 20
"""Records in a row whose six numbers are all the same."""
WINDOW = 0.5
"""Turns of gyro and wheels are compared over so long [s] …"""
LEAST_TURN = 0.1
"""… where their RMS is at least this [rad/s]: who does not turn, says nothing of turning."""
SLIP = 2.5
"""Skid-steered wheels tell up to twice the turn or half of it, since they slide sideways; more is another unit."""
LEAST_ALIKE = 0.5
"""Correlation of the two below which they do not tell the same turns; wheels that slide keep above 0.9."""
LATE = 0.2
"""Lag between the turns of gyro and wheels beyond which the clocks differ [s]: a step of 0.4 s is then half off."""
MOST_LAG = 2.0
"""Lags that are looked for [s]."""


def check_imu(imu: Imu, name: str, log: SensorLog) -> list[Finding]:
    """Look at the readings of one IMU by themselves.

    Parameters
    ----------
    name : str
        For the sentences.
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
    """Records that belong to runs of at least :data:`AT_LIMIT` equal extremes of ``values`` ``(n,)``, and runs."""
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
                continue  # an axis that is not there
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
    """Turns of a gyro against those of wheels.

    Parameters
    ----------
    slope, sigma : float
        Gyro over wheels, by total least squares, and its σ.
    lag : float
        By which the gyro is later than the wheels [s].
    correlation : float
        At that lag.
    """

    slope: float
    sigma: float
    lag: float
    correlation: float
    windows: int


def turn_agreement(times_a: Array, a: Array, times_b: Array, b: Array) -> TurnAgreement | None:
    """Compare two rates of turn ``(n,)`` and ``(m,)`` [rad/s] on their own stamps; None where there is too little turn.

    Means over :data:`WINDOW`; the slope is the ratio of their spreads with the sign of the correlation, which favours
    neither, and its σ that of a ratio of so many windows.
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
    """Compare the turns of the gyro with those of the wheels, where the log has any."""
    wheels = next((s for s in log.streams.values() if isinstance(s, VelocityControls)), None)
    return [] if wheels is None else compare_turns(imu, wheels, name)


def compare_turns(imu: Imu, wheels: VelocityControls, name: str) -> list[Finding]:
    """Compare the turns of the gyro about the base's z axis with those of the wheels.

    Parameters
    ----------
    name : str
        Of the IMU, for the sentences.
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
    said = f"turns of {name}: {found.slope:.3g} ± {found.sigma:.2g} times those of the wheels"
    size = abs(found.slope)
    if not 1.0 / SLIP <= size <= SLIP:
        cause = "one of them is in another unit"
        if abs(np.log(size * np.pi / 180.0)) < np.log(SLIP):
            cause = "the gyro seems to be in degrees, wanted rad/s"
        elif abs(np.log(size * 180.0 / np.pi)) < np.log(SLIP):
            cause = "the wheels' yaw rate seems to be in degrees, wanted rad/s"
        out.append(Finding("bad", "turns-disagree", f"{said} — {cause}."))
    elif found.slope < 0:
        cause = "left and right wheel are swapped, or a gyro axis is reversed"
        out.append(Finding("look", "turns-disagree", f"{said} — {cause}."))
    if abs(found.lag) > LATE:
        order = "after" if found.lag > 0 else "before"
        said = f"turns of {name}: {abs(found.lag):.2f} s {order} those of the wheels"
        text = f"{said} — their clocks differ."
        out.append(Finding("bad", "clocks-disagree", text))
    return out
