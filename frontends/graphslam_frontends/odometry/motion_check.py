"""Consistency check of scans and motion: pairs of neighbouring scans are matched and compared with the odometry.

Single matches may be wrong. Over the pairs of the whole log the matched motions are regressed on those of the odometry.
The coefficients are errors that would distort a map without being visible in it:

- distances and rotations by scan matching, relative to the odometry: units, signs, mirrored beams, scaled ranges;
- angles between the axes of scanner and base: a forward motion that scans see sideways, upwards, or tilted;
- the lever arm: a position error of the scanner shows as a displacement in rotations;
- the delay of the scans relative to the motion.

The standard errors are estimated from the residuals, so corridors and bad matches increase them. A finding needs a
lower bound (4 standard errors) beyond a tolerance. The tolerances allow for careful mounting and wheel slip: 10 % in
scale, 4°, 0.2 m, 0.2 s give the level "look", twice as much "bad".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np

from graphslam.core.findings import Finding, Level
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.register import Registration, distinct_registrations, register_starts
from graphslam.registration.target import Target
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.steps import Steps

PAIRS = 36
"""Most pairs of a log to match, evenly spaced."""
POINTS = 900
"""Most points of a matched cloud."""
MATCHING = RegistrationConfig(
    radii=(1.0, 0.5), near=0.25, floor_sigma=0.01, floor_turn=0.003, max_shift=6.0, max_turn=1.6,
    gates=RegistrationGates(
        fitness=0.55, fitness_alone=0.7, fitness_upright=0.45, degeneracy=1e-3, degeneracy_planar=1e-3, tilt=np.pi
    ),
)  # fmt: skip
MARGIN = 4.0
"""Standard errors subtracted from an error before it is compared with its tolerance."""
SCALE, ANGLE, LEVER, LAG = 0.1, float(np.deg2rad(4.0)), 0.2, 0.2
"""Tolerances: scale, angle [rad], lever arm [m], time [s]."""
BAD = 2.0
"""Multiple of the tolerance above which a finding is "bad"."""
LEAST_POINTS = 40
"""Least number of returns in a scan to match."""
LEAST_PAIRS = 8
"""Least number of pairs for a regression, and for a finding on the share of matches."""
UNLIKE, UNLIKE_NARROW = 0.5, 0.25
"""Least share of matched pairs for a working scanner: 0.8 to 1 on simulated and planar recorded logs. The second value
is for single 3-D clouds: 0.33 to 0.7 for hand-held lidars with a narrow field of view."""
STEP = 0.02
"""σ added to every matched motion [m, and a third of it in rad]."""


@dataclass(frozen=True, slots=True)
class FittedCoefficient:
    """A coefficient and its standard error."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class MotionCheck:
    """Result of the comparison of scan matches and motion.

    Parameters
    ----------
    tried, matched : int
        Number of pairs.
    least_share : float
        Least share of matched pairs for a working scanner.
    fits : dict of str to FittedCoefficient
        ``distance`` and ``turn`` (scans over odometry); true minus configured pose of the scanner: ``yaw``, ``pitch``,
        ``tilt`` [rad], ``ahead``, ``left`` [m]; ``lag`` [s]. Missing: those that the motion does not excite.
    moved, turned : (float, float)
        RMS motion of a pair by odometry and by scans [m], [rad].
    """

    tried: int
    matched: int
    fits: dict[str, FittedCoefficient]
    least_share: float = UNLIKE
    moved: tuple[float, float] = (0.0, 0.0)
    turned: tuple[float, float] = (0.0, 0.0)


def check_motion(steps: Steps, seconds: float = 0.0) -> MotionCheck:
    """Match pairs of neighbouring scans and regress their motions on the odometry.

    Parameters
    ----------
    steps : Steps
        Before their motion is fused with scan matches.
    seconds : float
        Duration of a scan: half a revolution of a spinning scanner; 0: every step is a scan.
    """
    pairs = _pairs(steps, seconds)
    share = UNLIKE if seconds > 0 or steps.dim == 2 else UNLIKE_NARROW
    group = group_of(steps.odometry.increments)
    path = chain_odometry(steps.odometry)
    rows: list[tuple[float, float, Array, Array, Array]] = []
    clouds: dict[tuple[int, int], Target] = {}
    for (a0, a1), (b0, b1) in pairs:
        T = group.between(path.poses[a1 - 1], path.poses[b1 - 1])
        for window in ((a0, a1), (b0, b1)):
            if window not in clouds:
                clouds[window] = Target(_cloud(steps, path.poses, *window))
        found = _match(clouds[b0, b1], clouds[a0, a1], T, _matching(clouds[a0, a1]))
        if found is not None:
            times = float(steps.times[a1 - 1]), float(steps.times[b1 - 1])
            rows.append((*times, group.log(T), group.log(found.T_target_source), found.covariance))
    if len(rows) < LEAST_PAIRS:
        return MotionCheck(len(pairs), len(rows), {}, share)
    begin, end = np.array([r[:2] for r in rows]).T
    o, m = (np.array([r[k] for r in rows]) for k in (2, 3))
    var = np.array([np.diag(r[4]) for r in rows])
    heading = group.heading
    x = 0 if group.dim == 2 else 3
    fits: dict[str, FittedCoefficient] = {}
    drive, turn = o[:, x], o[:, heading]
    if np.sqrt(np.mean(drive**2)) > 5.0 * STEP:
        columns = [drive, turn] if np.ptp(turn) > 0.2 else [drive]
        ahead = _regress(columns, m[:, x], var[:, x], STEP)
        fits["distance"] = ahead[0]
        scale = ahead[0].value if abs(ahead[0].value) > 0.2 else 1.0
        # sideways and upward motion that the odometry also measures (hand-held) is no error
        side = _regress(columns, m[:, x + 1] - scale * o[:, x + 1], var[:, x + 1], STEP)
        fits["yaw"] = FittedCoefficient(-side[0].value / scale, side[0].sigma / abs(scale))
        if len(columns) > 1:
            # a configured position off by (ex, ey) appears as a displacement of the base in rotations
            fits["ahead"], fits["left"] = (
                FittedCoefficient(side[1].value, side[1].sigma),
                FittedCoefficient(-ahead[1].value, ahead[1].sigma),
            )
        if group.dim == 3:
            up = _regress([drive], m[:, 5] - scale * o[:, 5], var[:, 5], STEP)[0]
            fits["pitch"] = FittedCoefficient(up.value / scale, up.sigma / abs(scale))
    if np.sqrt(np.mean(turn**2)) > 5.0 * STEP / 3.0 and np.ptp(turn) > 0.2:
        seconds_of = end - begin
        fits["turn"] = _regress([turn, seconds_of], m[:, heading], var[:, heading], STEP / 3.0)[0]
        if group.dim == 3:
            across = [_regress([turn], m[:, k] - o[:, k], var[:, k], STEP / 3.0)[0] for k in (0, 1)]
            worst = max(across, key=lambda f: abs(f.value) - MARGIN * f.sigma)
            fits["tilt"] = worst
        if seconds > 0 and (sigma := _mirrored(steps, pairs)) is not None:
            fits["turn"] = FittedCoefficient(-1.0, sigma)
        lag = _lag(path.times, _headings(steps), begin, end, m[:, heading], var[:, heading])
        if lag is not None and abs(fits["turn"].value - 1.0) < 0.5:
            fits["lag"] = lag

    def rms(a: Array) -> float:
        return float(np.sqrt(np.mean(a**2)))

    size = [rms(np.linalg.norm(v[:, group.position], axis=1)) for v in (o, m)]
    return MotionCheck(
        len(pairs), len(rows), fits, share, (size[0], size[1]), (rms(turn), rms(m[:, heading]))
    )  # fmt: skip


def _pairs(steps: Steps, seconds: float) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Pairs of consecutive windows ``[a, b)`` of steps, outside the gaps of the motion."""
    t = steps.times
    windows: list[tuple[int, int]] = []
    k = 1 if len(t) > 1 else 0
    while k < len(t):
        last = int(np.searchsorted(t, t[k - 1] + seconds + 1e-6, side="right")) if seconds > 0 else k + 1
        last = max(last, k + 1)
        if last <= len(t):
            windows.append((k, last))
        k = last
    met = np.concatenate([[0], np.cumsum(steps.returns)])[steps.offsets]
    full = [w for w in windows if met[w[1]] - met[w[0]] >= LEAST_POINTS]
    if seconds <= 0:  # single scans may be dense: more distant pairs are more informative at the same cost
        full = _apart(steps, full)
    out = []
    for a, b in pairwise(full):
        begin, end = t[max(a[0] - 1, 0)], t[b[1] - 1]
        if end - begin > 3.0 * max(seconds, 1.0) + 1.0:
            continue
        if np.any((steps.gaps.begin < end) & (steps.gaps.end > begin)):
            continue
        out.append((a, b))
    if len(out) > PAIRS:
        out = [out[int(i)] for i in np.linspace(0, len(out) - 1, PAIRS).round()]
    return out


def _apart(steps: Steps, windows: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Select single scans at least half a second apart."""
    out: list[tuple[int, int]] = []
    for w in windows:
        if not out or steps.times[w[0]] - steps.times[out[-1][0]] >= 0.5 - 1e-6:
            out.append(w)
    return out


def _cloud(steps: Steps, poses: Array, first: int, last: int) -> Array:
    """End points of the returns of the steps ``[first, last)``, in the base frame at the last of them."""
    group = group_of(poses)
    parts = []
    for k in range(first, last):
        points, _, met = steps.scan(k)
        T = group.between(poses[last - 1], poses[k])
        parts.append(group.transform(np.broadcast_to(T, (int(met.sum()), group.size)), points[met]))
    cloud = np.concatenate(parts)
    if len(cloud) > POINTS:
        cloud = cloud[np.linspace(0, len(cloud) - 1, POINTS).round().astype(np.int64)]
    return cast(Array, cloud)


def _matching(target: Target) -> RegistrationConfig:
    """Registration settings: the search radius is adapted to the point spacing of the cloud."""
    if len(target) < LEAST_POINTS:
        return MATCHING
    apart = float(np.median(target.tree.query(target.points, k=2)[0][:, 1]))
    near = min(max(MATCHING.near, 1.5 * apart), 1.0)
    return replace(MATCHING, near=near, radii=(max(1.0, 2.0 * near), max(0.5, near)))


def _match(source: Target, target: Target, T: Array, matching: RegistrationConfig) -> Registration | None:
    """Best match of two clouds, started at the odometry motion and at zero; if these results differ, also at motions
    with wrong signs and units. None: no accepted match."""
    group = group_of(T)
    xi = group.log(T)

    def scaled(shift: float, turn: float) -> Array:
        y = xi.copy()
        y[group.position] *= shift
        y[group.heading] *= turn
        return cast(Array, group.exp(y))

    if np.linalg.norm(xi[group.position]) < 0.2 and abs(xi[group.heading]) < 0.1:
        found = register_starts(source, target, [T], matching)
        if not (found and found[0].accepted):  # the odometry may show no motion while the body moves ahead or back
            starts = []
            for metres in (0.8, 1.6, -0.8):
                y = xi.copy()
                y[0 if group.dim == 2 else 3] = metres
                starts.append(group.exp(y))
            found = distinct_registrations([*found, *register_starts(source, target, starts, matching)])
    else:
        found = register_starts(source, target, [T, scaled(0.0, 0.0)], matching, apart=(0.2, 0.05))
        if len(found) != 1:
            more = [scaled(*v) for v in ((1.0, 0.0), (1.0, -1.0), (-1.0, 1.0), (0.4, 1.0), (2.0, 1.0))]
            again = register_starts(source, target, more, matching, apart=(0.2, 0.05))
            found = distinct_registrations([*found, *again], (0.2, 0.05))
    return found[0] if found and found[0].accepted else None


def _mirrored(steps: Steps, pairs: list[tuple[tuple[int, int], tuple[int, int]]]) -> float | None:
    """σ of the sign of rotations, if inverted rotations explain the scans better; None: they do not.

    The scans of a spinning scanner are assembled with the motion to be checked, so clouds distorted by a wrong rotation
    agree with it. So clouds are assembled with rotations of either sign, for the pairs with the largest rotations, and
    the share of matched points is compared.
    """
    paths = []
    group = group_of(steps.odometry.increments)
    for sign in (1.0, -1.0):
        xi = np.asarray(group.log(steps.odometry.increments))
        xi[:, group.heading] *= sign
        paths.append(chain_odometry(replace(steps.odometry, increments=group.exp(xi))).poses)
    heading = _headings(steps)
    turn = np.array([abs(heading[b[1] - 1] - heading[a[1] - 1]) for a, b in pairs])
    better = []
    for i in np.argsort(-turn)[:8]:
        if turn[i] < 0.2:
            break
        (a0, a1), (b0, b1) = pairs[int(i)]
        fitness = []
        for poses in paths:
            T = group.between(poses[a1 - 1], poses[b1 - 1])
            target, source = _cloud(steps, poses, a0, a1), _cloud(steps, poses, b0, b1)
            goal = Target(target)
            found = register_starts(Target(source), goal, [T], _matching(goal))
            fitness.append(found[0].fitness if found else 0.0)
        better.append(fitness[1] - fitness[0])
    if len(better) < 4:
        return None
    mean, sigma = float(np.mean(better)), float(np.std(better, ddof=1)) / np.sqrt(len(better))
    return max(float(sigma), 0.01) if mean > max(MARGIN * sigma, 0.05) else None


def _regress(columns: list[Array], y: Array, variance: Array, floor: float) -> list[FittedCoefficient]:
    """Robust weighted regression of ``y`` on columns (Cauchy weights); σ from the residuals."""
    X = np.column_stack(columns)
    w = 1.0 / (variance + floor**2)
    robust = np.ones(len(y))
    beta: Array = np.zeros(X.shape[1])
    for _ in range(20):
        A = (X * (w * robust)[:, None]).T @ X
        beta = np.asarray(np.linalg.lstsq(A, (X * (w * robust)[:, None]).T @ y, rcond=None)[0])
        r = (y - X @ beta) * np.sqrt(w)
        scale = max(1.4826 * float(np.median(np.abs(r))), 1e-6)
        robust = np.asarray(1.0 / (1.0 + (r / (2.385 * scale)) ** 2))
    g: Array = X * ((y - X @ beta) * w * robust)[:, None]
    A = np.asarray(np.linalg.pinv((X * (w * robust)[:, None]).T @ X))
    P: Array = A @ (g.T @ g) @ A * len(y) / max(len(y) - X.shape[1], 1)  # sandwich estimator: for any noise
    P = np.maximum(np.diag(P), np.diag(A) * min(scale, 1.0) ** 2)
    return [FittedCoefficient(float(b), float(np.sqrt(p))) for b, p in zip(beta, P)]


def _headings(steps: Steps) -> Array:
    group = group_of(steps.odometry.increments)
    return np.cumsum(group.log(steps.odometry.increments)[:, group.heading])


def _lag(
    times: Array, heading: Array, begin: Array, end: Array, turn: Array, variance: Array
) -> FittedCoefficient | None:
    """Delay of the scans relative to the motion [s]: the time shift that explains the matched rotations best."""
    w = 1.0 / (variance + (STEP / 3.0) ** 2)
    shifts = np.arange(-2.0, 2.001, 0.05)
    # rotation of the odometry at the shifted times
    model = np.array([np.interp(end - s, times, heading) - np.interp(begin - s, times, heading) for s in shifts])
    r = turn - model
    r = r - np.sum(w * r, axis=1, keepdims=True) / w.sum()
    best = r[np.argmin(np.sum(w * np.abs(r), axis=1))]
    cap = 3.0 * max(1.4826 * float(np.median(np.abs(best) * np.sqrt(w))), 1.0)
    z = np.minimum(w * r**2, cap**2)
    cost = z.sum(axis=1)
    k = int(np.argmin(cost))
    if k in (0, len(shifts) - 1):
        return None
    freedom = max(len(turn) - 3, 1)
    noise = max(float(cost[k]) / freedom, 0.2)
    curve = float(cost[k - 1] - 2.0 * cost[k] + cost[k + 1]) / (0.05**2)
    if curve <= 0.0:
        return None
    shift = float(shifts[k]) - 0.5 * 0.05 * float(cost[k + 1] - cost[k - 1]) / max(curve * 0.05**2, 1e-12)
    return FittedCoefficient(shift, float(np.sqrt(2.0 * noise / curve)))


def motion_findings(found: MotionCheck) -> list[Finding]:
    """Findings from the comparison of scan matches and motion."""
    out: list[Finding] = []
    if found.tried >= LEAST_PAIRS and found.matched < found.least_share * found.tried:
        text = (
            f"matched pairs of neighbouring scans: {found.matched} of {found.tried} — they differ too much for a map,"
            " or do not show the motion, as in a corridor. Else check ranges, order of the beams and mounting."
        )
        out.append(Finding("look", "scans-unlike", text))
    f = found.fits
    for key, what, (odometry, scans), causes in (
        ("distance", "distances", found.moved, _distance_cause),
        ("turn", "turns", found.turned, _turn_cause),
    ):
        unit = "m" if key == "distance" else "rad"
        if key in f:
            level = _level(f[key].value - 1.0, f[key].sigma, SCALE)
            if level:
                result = f"{what} by scan matching: {f[key].value:.3g} ± {f[key].sigma:.2g} times those of the odometry"
                out.append(Finding(level, f"{key}-disagrees", f"{result} — {causes(f[key].value)}."))
        elif found.matched >= LEAST_PAIRS and scans > 0.1 and scans > 5.0 * odometry:
            result = f"motion between two scans: {scans:.2g} {unit} by scan matching, {odometry:.2g} by the odometry"
            out.append(Finding("bad", f"{key}-disagrees", f"{result} — the odometry seems to stand still."))
    if ("distance" in f and abs(f["distance"].value - 1.0) > 0.5) or ("turn" in f and abs(f["turn"].value - 1.0) > 0.5):
        return out  # angles and levers are meaningless with such errors
    mounted: list[str] = []
    worst: Level = ""
    for key, what, tolerance, scale, unit in (
        ("yaw", "turned to the left", ANGLE, 180.0 / np.pi, "°"),
        ("pitch", "pitched down", ANGLE, 180.0 / np.pi, "°"),
        ("tilt", "tilted", ANGLE, 180.0 / np.pi, "°"),
        ("ahead", "ahead", LEVER, 1.0, " m"),
        ("left", "to the left", LEVER, 1.0, " m"),
    ):
        if key in f and (level := _level(f[key].value, f[key].sigma, tolerance)):
            mounted.append(f"{scale * f[key].value:+.3g} ± {scale * f[key].sigma:.2g}{unit} {what}")
            worst = "bad" if "bad" in (worst, level) else "look"
    if mounted:
        text = (
            f"scanner mounting: {', '.join(mounted)} of the configured pose fits scans and odometry best — the "
            "mounting is wrong, bearings are mirrored, or turns have the wrong sign. Measure the mounting "
            "(T_base_sensor, T_base_mount)."
        )
        out.append(Finding(worst, "mounting-disagrees", text))
    if "lag" in f and (level := _level(f["lag"].value, f["lag"].sigma, LAG)):
        late = "later" if f["lag"].value > 0 else "earlier"
        text = (
            f"turns by scan matching: {abs(f['lag'].value):.2f} ± {f['lag'].sigma:.2g} s {late} than those of the "
            "odometry — their clocks differ."
        )
        out.append(Finding(level, "clocks-disagree", text))
    return out


def _level(error: float, sigma: float, tolerance: float) -> Level:
    least = abs(error) - MARGIN * sigma
    return "bad" if least > BAD * tolerance else "look" if least > tolerance else ""


def _distance_cause(ratio: float) -> str:
    if ratio < -SCALE:
        return "the speed has the wrong sign, or the scanner looks backwards"
    if ratio < 0.15:
        return "the scans hardly change: the scanner is stuck, or sees only the robot itself"
    for factor, why in ((3.6, "the odometry is m/s read as km/h, or"), (1.0 / 3.6, "the odometry is in km/h, or")):
        if abs(np.log(ratio / factor)) < 0.1:
            return f"{why} ranges or distances are in another unit"
    return "ranges or distances are scaled or offset, or the wheels slip"


def _turn_cause(ratio: float) -> str:
    if ratio < -SCALE:
        return "the bearings are mirrored, left and right wheel are swapped, or the yaw rate has the wrong sign"
    if abs(np.log(max(ratio, 1e-9) * 180.0 / np.pi)) < 0.7:
        return "the yaw rate seems to be in degrees"
    return "the yaw rate is scaled or saturated, or the scanner's mounting is wrong"


def half_turn_seconds(rates: Array | None) -> float:
    """Duration of half a revolution of a scanner that spins at ``rates`` [rad/s]; 0 if it does not spin."""
    rate = float(np.median(np.abs(rates))) if rates is not None and len(rates) else 0.0
    return float(np.pi / rate) if rate > 0.05 else 0.0
