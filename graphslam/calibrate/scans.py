"""Calibration of logs with scans: regression of odometry minus scan match between key scans.

Each key scan is matched with the next and with the third next (in 3-D also with the eighth). The noise of a match does
not depend on the distance between the scans, that of the odometry grows with it: one regression separates the two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize, minimize_scalar
from scipy.special import gammaln

from graphslam.calibrate.corrections import CERTAIN
from graphslam.calibrate.estimate import (
    AGREE,
    NAMES,
    SIGNIFICANT,
    Calibration,
    Estimate,
    Prediction,
    round_digits,
)
from graphslam.calibrate.landmark_calibration import CalibrationBudget, calibration_of
from graphslam.core.errors import DataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.registration.config import LEAST_POINTS, RegistrationConfig
from graphslam.registration.register import register
from graphslam.registration.target import Target
from graphslam_frontends.odometry.steps import Steps

KEY = (0.4, 0.3)
"""A scan farther than this from the last key scan, in metres driven or angle turned, is a key scan [m, rad]."""
APART = {2: (1, 3), 3: (1, 3, 8)}
"""Differences of key-scan index in a pair, by dimension."""
TURN = 0.1
"""Smaller turns tell nothing about their scale: their errors would give one [rad]."""
HELD = (0.06, 0.03)
"""A match with a larger σ in its weakest direction [m] or in heading [rad] is rejected, as in corridors."""
BLOCK = 10
"""Number of consecutive matches in a block of the cross-validation."""
_MATCHES = (math.log(1e-4), math.log(0.3))
FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of the errors."""
ALIKE = 0.9
"""Of two constants with a larger correlation of their errors, only one is estimated."""
LEAST = 30
MANY = 100
"""Least number of matches for a smaller σ than that of the log: with fewer, slips in 3 % of them may be missed."""
CLEAR = 2.0
"""The σ of the log is replaced by a smaller one only if it is larger than that by more than this factor."""
LEAST_SHARE = 0.5
"""Fraction of the neighbouring pairs that must match. Otherwise, as along a street, matches are a biased sample, and
cross-validation cannot detect it, because the withheld half has the same bias."""
MATCHING = {
    2: RegistrationConfig(radii=(1.0, 0.3), near=0.15),
    3: RegistrationConfig(radii=(1.0, 0.5), near=0.4),
}
FITNESS = 0.6
VOXEL = {2: None, 3: 0.3}
POINTS = 20000
"""Minimal limit of the points per 3-D cloud: normals cannot be estimated in sparse clouds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanPairs:
    """Matched pairs of scans.

    Parameters
    ----------
    apart : (n,)
        Difference of their key-scan indices.
    seconds, metres : (n,)
        Time in motion and distance of the odometry between them.
    turn, turned : (n,)
        Angle of the match: signed, 0 below :data:`TURN`, and absolute [rad].
    chord : (n,)
        Translation of the match, projected onto the direction of the odometry displacement [m].
    stated_heading, stated_along : (n,)
        Variances of the odometry between them, from the log or the front end [rad², m²].
    heading, along, side : (n,)
        Odometry minus match [rad, m, m]; ``side`` is a magnitude.
    """

    apart: Array
    seconds: Array
    metres: Array
    turn: Array
    turned: Array
    stated_heading: Array
    stated_along: Array
    chord: Array
    heading: Array
    along: Array
    side: Array

    def take(self, keep: Array) -> ScanPairs:
        """Subset of the pairs."""
        return ScanPairs(**{k: getattr(self, k)[keep] for k in self.__dataclass_fields__})

    def __len__(self) -> int:
        return len(self.apart)


def matched_pairs(steps: Steps, most: int) -> ScanPairs:
    """Matched pairs of key scans spread over the log, at most ``most`` for each index difference."""
    o = steps.odometry
    g = group_of(o.increments)
    xi = g.log(o.increments)
    d, turns = np.linalg.norm(xi[:, g.position], axis=1), xi[:, g.heading]
    seen = np.diff(steps.offsets) >= LEAST_POINTS
    keys, length, turned = [], np.inf, np.inf
    for k in range(len(steps)):
        length, turned = length + d[k], turned + abs(turns[k])
        if seen[k] and (length > KEY[0] or turned > KEY[1]):
            keys.append(k)
            length = turned = 0.0
    dt = np.concatenate([[0.0], np.diff(steps.times)])[: len(steps)]
    moving = (d > 0.005 * np.maximum(dt, 1e-9)) | (np.abs(turns) > 0.005 * np.maximum(dt, 1e-9))
    variances = np.diagonal(o.covariances, axis1=1, axis2=2)
    growing = (dt * moving, d, variances[:, g.heading], variances[:, g.position].mean(axis=1))
    sums = [np.cumsum(v) for v in growing]
    targets: dict[int, Target] = {}
    rows, tried = [], 0
    config = MATCHING[steps.dim]
    for apart in APART[steps.dim]:
        count = len(keys) - apart
        for i in np.unique(np.linspace(0, count - 1, min(most, max(count, 0))).astype(int)) if count > 0 else ():
            a, b = keys[i], keys[i + apart]
            T = g.identity
            for u in o.increments[a + 1 : b + 1]:
                T = g.compose(T, u)
            for k in (a, b):
                if k not in targets:
                    points, _, returns = steps.scan(k)
                    targets[k] = Target(points[returns], voxel=VOXEL[steps.dim])
            if min(len(targets[a]), len(targets[b])) < LEAST_POINTS:
                continue
            tried += apart == 1
            found = register(targets[b], targets[a], T, config)
            if not found.converged or found.fitness < FITNESS:
                continue
            sigma = math.sqrt(float(found.covariance[g.heading, g.heading]))
            if found.weakest_sigma > HELD[0] or sigma > HELD[1]:
                continue
            e = g.log(g.between(found.T_target_source, T))
            direction = np.asarray(T[: steps.dim]) / max(float(np.linalg.norm(T[: steps.dim])), 1e-9)
            start, shift = g.log(T)[g.position], e[g.position]
            start = start / max(float(np.linalg.norm(start)), 1e-9)
            along = float(shift @ start)
            side = float(np.linalg.norm(shift - along * start)) / math.sqrt(steps.dim - 1)
            # translation and turn of the match, not of the odometry: noise in the regressor would bias the scale
            chord = float(np.asarray(found.T_target_source[: steps.dim]) @ direction)
            turn = float(g.log(found.T_target_source)[g.heading])
            seconds, metres, *stated = [float(s[b] - s[a]) for s in sums]
            scaled = turn if abs(turn) > TURN else 0.0
            rows.append([apart, seconds, metres, scaled, abs(turn), *stated, chord, float(e[g.heading]), along, side])
    if len(rows) < LEAST:
        raise DataError("too few scans match to calibrate the odometry", where=steps.name, got=len(rows), wanted=LEAST)
    near = sum(row[0] == 1 for row in rows)
    if near < LEAST_SHARE * tried:
        got, wanted = f"{near} of {tried} neighbouring key scans", f"{LEAST_SHARE:.0%}"
        raise DataError("most scans do not match the next: a biased sample", where=steps.name, got=got, wanted=wanted)
    return ScanPairs(**dict(zip(ScanPairs.__dataclass_fields__, np.array(rows).T)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Regression:
    """Errors as a linear function of constants, with noise that has several growing parts.

    Parameters
    ----------
    value : (p,)
    covariance : (p, p)
    sigmas : (1 + s,)
        σ of a match, then of each growing part.
    score : float
        Negative log-likelihood [nats].
    keep : (n,) bool
        Errors that were not trimmed.
    """

    value: Array
    covariance: Array
    sigmas: Array
    score: float
    keep: npt.NDArray[np.bool_]


def regress_errors(e: Array, A: Array, grows: Array, *, trim: float = 4.0) -> Regression:
    """Maximum Student likelihood of errors ``(n,)`` with design ``(n, p)`` and variances ``c² + grows · s²``.

    Parameters
    ----------
    e : (n,)
    A : (n, p)
    grows : (n, s)
        Factors of the variances s².
    trim : float
        Residuals above this many σ are removed, and the rest is fitted again; 0: no trimming.
    """
    spread = max(1.4826 * float(np.median(np.abs(e - np.median(e)))), 1e-5)
    start = np.concatenate([[spread**2], spread**2 / np.maximum(2.0 * grows.mean(axis=0), 1e-9)])
    keep = np.ones(len(e), dtype=np.bool_)
    x = 0.5 * np.log(start)
    x0 = x.copy()

    def at(x: Array) -> tuple[float, Array, Array]:
        v = np.exp(2.0 * x[0]) + grows[keep] @ np.exp(2.0 * x[1:])
        w, c = 1.0 / v, np.zeros(A.shape[1])
        H = np.eye(A.shape[1])
        for _ in range(6 if A.shape[1] else 1):
            if A.shape[1]:
                H = (A[keep] * w[:, None]).T @ A[keep]
                c = np.linalg.lstsq(H, (A[keep] * w[:, None]).T @ e[keep], rcond=None)[0]
            r2 = (e[keep] - A[keep] @ c) ** 2 / v
            w = (FREEDOM + 1.0) / (FREEDOM + r2) / v
        return student_likelihood(e[keep] - A[keep] @ c, v * FREEDOM / (FREEDOM - 2.0)), c, H

    for _ in range(2 if trim else 1):
        found = minimize(
            lambda x: at(x)[0] + 0.5 * float(np.sum(((x - x0) / 2.0) ** 2)),
            x,
            method="L-BFGS-B",
            options={"ftol": 1e-8, "maxfun": 600},
        )
        x = found.x
        score, c, H = at(x)
        v = np.exp(2.0 * x[0]) + grows @ np.exp(2.0 * x[1:])
        inside = np.abs(e - A @ c) < trim * np.sqrt(v) * math.sqrt(FREEDOM / (FREEDOM - 2.0)) if trim else keep
        if not trim or np.array_equal(inside, keep):
            break
        keep = inside
    covariance = np.asarray(np.linalg.pinv(H) if A.shape[1] else np.zeros((0, 0)), dtype=np.float64)
    # σ of a Student variable is its scale times √(ν / (ν - 2))
    return Regression(
        value=c, covariance=covariance, sigmas=np.exp(x) * math.sqrt(FREEDOM / (FREEDOM - 2.0)), score=score, keep=keep
    )


HEADING = ("yaw_bias", "turn_per_metre", "turn_scale")


def calibrate_scans(steps: Steps, effort: CalibrationBudget) -> Calibration:
    """Estimate odometry noise and constants from scan matches.

    Parameters
    ----------
    steps : Steps
        Steps with the recorded odometry, not corrected by scan matching.
    """
    most = 200 if effort.windows is not None and effort.windows <= 20 else 1000
    most = max(int(most * effort.poses / 2000) if most == 200 else most, 40)
    if steps.dim == 3:
        most = min(most, 60 if most <= 200 else 300)
    p = matched_pairs(steps, most)
    estimates, notes, noise, cover = _heading(p)
    scale, moved = _distance(p)
    noise |= moved
    kind = "scans" if steps.dim == 2 else "clouds"
    if steps.dim == 3:
        text = f"odometry noise: upper limit {noise['along_metre']:.3g} m/√m and "
        text += f"{math.hypot(noise['heading_metre'], noise['heading_second']):.2g} rad/√m — limited by scan matching."
        notes.append(Finding("", "calibrated", text))
    found = calibration_of(kind, [*estimates, scale], noise, notes, f"{len(p)} scan matches")
    if kind == "scans" and not found.contradictions():
        found = replace(found, corrections=replace(found.corrections, heading_cover=cover))
    return found if found.contradictions() else found.validated(cross_validate(p, found, widen=kind == "scans"))


def cross_validate(p: ScanPairs, found: Calibration, *, widen: bool) -> Prediction:
    """Two-fold cross-validation: matches of one half of the log under the estimate of the other half.

    The halves are alternating blocks of :data:`BLOCK` matches.

    Parameters
    ----------
    found : Calibration
        Its applied constants are tested; each half estimates them again.
    widen : bool
        The noise is at least that of the log, that of the heading up to :func:`heading_cover`.
    """
    applied = {e.name for e in found.estimates if e.applied}
    turning, along = (
        np.column_stack([x for n, x in of.items() if n in applied] or [p.metres[:, None][:, :0]])
        for of in (
            {"yaw_bias": p.seconds, "turn_per_metre": p.metres, "turn_scale": p.turn},
            {"distance_scale": p.chord},
        )
    )
    grows = np.column_stack([p.metres, p.turned, p.seconds])
    half = np.arange(len(p)) // BLOCK % 2 == 0
    gains = {"all": 0.0, "noise": 0.0}
    for train in (half, ~half):
        for e, A, g, stated in (
            (p.heading, turning, grows, p.stated_heading),
            (p.along, along, grows[:, :1], p.stated_along),
        ):
            test = ~train
            match = _match_noise(e[train], stated[train])
            before = student_likelihood(e[test], match**2 + stated[test])
            for name, columns in (("all", A), ("noise", A[:, :0])):
                r = regress_errors(e[train], columns[train], g[train])
                v = g[test] @ r.sigmas[1:] ** 2
                if widen:
                    kept = stated[test]
                    if e is p.heading and found.corrections.heading_cover is not None:
                        errors, grown = e[train] - columns[train] @ r.value, g[train] @ r.sigmas[1:] ** 2
                        cover = heading_cover(errors, grown, stated[train])
                        kept = kept if cover is None else np.minimum(kept, cover**2 * v)
                    v = np.maximum(v, kept)
                v = r.sigmas[0] ** 2 + v
                gains[name] += before - student_likelihood(e[test] - columns[test] @ r.value, v)
    return Prediction(what="scan matches", count=len(p), gains=gains)


def heading_cover(e: Array, variances: Array, stated: Array) -> float | None:
    """Factor on the estimated σ of the heading with which it covers every error, if the log's σ is clearly larger.

    Matches are assumed exact, so inaccurate ones give no small σ. The σ of distances is never replaced by a smaller
    one: wheels that slip or run backwards change distances, and rarely.

    Parameters
    ----------
    e : (n,)
        Errors of the odometry [rad].
    variances, stated : (n,)
        Estimated ones, and those of the log [rad²].

    Returns
    -------
    float or None
        ≥ 1; None: the σ of the log is not clearly larger.
    """
    sigmas = np.sqrt(np.maximum(variances, 1e-12))
    cover = max(1.0, float(np.max(np.abs(e) / sigmas)) / CERTAIN)
    clear = float(np.median(np.sqrt(stated) / sigmas)) > CLEAR * cover
    return round_digits(cover) if clear else None


def student_likelihood(e: Array, variances: Array) -> float:
    """Negative log-likelihood of errors ``(n,)`` under a Student distribution with these variances [nats]."""
    v = variances * (FREEDOM - 2.0) / FREEDOM
    constant = gammaln(0.5 * FREEDOM) - gammaln(0.5 * (FREEDOM + 1.0)) + 0.5 * math.log(FREEDOM * math.pi)
    terms = 0.5 * (FREEDOM + 1.0) * np.log1p(e**2 / (FREEDOM * v)) + 0.5 * np.log(v)
    return float(terms.sum()) + len(e) * float(constant)


def _match_noise(e: Array, stated: Array) -> float:
    """Maximum-likelihood σ of a match for given variances of the odometry."""
    found = minimize_scalar(
        lambda x: student_likelihood(e, math.exp(2.0 * x) + stated), bounds=_MATCHES, method="bounded"
    )
    return math.exp(found.x)


def _heading(p: ScanPairs) -> tuple[list[Estimate], list[Finding], dict[str, float], float | None]:
    columns = {"yaw_bias": p.seconds, "turn_per_metre": p.metres, "turn_scale": p.turn}
    names, notes = list(HEADING), list[Finding]()
    grows = np.column_stack([p.metres, p.turned, p.seconds])

    def fit(names: list[str], rows: Any = slice(None), **options: Any) -> Regression:
        A = np.column_stack([columns[n] for n in names] or [p.metres[:, None][:, :0]])
        return regress_errors(p.heading[rows], A[rows], grows[rows], **options)

    full = fit(names)
    for pair in (("yaw_bias", "turn_per_metre"), ("turn_scale", "turn_per_metre"), ("yaw_bias", "turn_scale")):
        if not set(pair) <= set(names):
            continue
        i, j = (names.index(n) for n in pair)
        C = full.covariance
        rho = float(C[i, j] / math.sqrt(C[i, i] * C[j, j]))
        if abs(rho) > ALIKE:
            rest = [[n for n in names if n != drop] for drop in pair]
            names = min(rest, key=lambda r: fit(r, trim=0).score)
            full = fit(names)
            text = (
                f"errors of {NAMES[pair[0]]} and {NAMES[pair[1]]}: correlation {rho:.2f} in this log — only an error "
            )
            notes.append(Finding("", "calibrated", f"{text}of {NAMES[(set(pair) & set(names)).pop()]} is estimated."))
    unused: list[Estimate] = []
    while True:
        out, A = list[Estimate](), np.column_stack([columns[n] for n in names])
        ends = (p.apart == p.apart.min(), p.apart == p.apart.max())
        parts = [regress_errors(p.heading[m], A[m], grows[m][:, :1]) for m in ends]
        for k, name in enumerate(names):
            gain = math.nan
            if abs(full.value[k]) > SIGNIFICANT * math.sqrt(full.covariance[k, k]):
                gain = fit([n for n in names if n != name], full.keep, trim=0).score - full.score
            out.append(_gated(name, full, parts, k, gain))
        applied = [e.name for e in out if e.applied]
        unused += [e for e in out if not e.applied]
        if len(applied) in (0, len(names)):
            break
        names = applied  # the others are not removed, so their part must not be missing in these
        full = fit(names)
    errors = p.heading - A @ (full.value if applied else 0.0 * full.value)
    cover = heading_cover(errors, grows @ full.sigmas[1:] ** 2, p.stated_heading) if len(p) >= MANY else None
    noise = dict(zip(("heading_metre", "heading_radian", "heading_second"), full.sigmas[1:].tolist()))
    return [e for e in out if e.applied] + unused, notes, noise, cover


def _gated(name: str, full: Regression, parts: list[Regression], k: int, gain: float) -> Estimate:
    """Estimate from all pairs; near and far pairs must agree with each other."""
    near, far = ((float(r.value[k]), math.sqrt(r.covariance[k, k])) for r in parts)
    value, sd = float(full.value[k]), math.sqrt(full.covariance[k, k])
    agree = abs(near[0] - far[0]) <= max(AGREE * math.hypot(near[1], far[1]), 0.15 * abs(value))
    other = (value, sd) if agree else far if abs(far[0] - value) > abs(near[0] - value) else near
    return Estimate(name=name, value=value, sigma=sd, gain=gain, other=other[0], other_sigma=other[1]).gated()


def _distance(p: ScanPairs) -> tuple[Estimate, dict[str, float]]:
    """Scale of the distances, and longitudinal and lateral noise."""
    grows = p.metres[:, None]
    A = p.chord[:, None]
    full = regress_errors(p.along, A, grows)
    parts = [regress_errors(p.along[m], A[m], grows[m]) for m in (p.apart == p.apart.min(), p.apart == p.apart.max())]
    gain = math.nan
    if abs(full.value[0]) > SIGNIFICANT * math.sqrt(full.covariance[0, 0]):
        gain = regress_errors(p.along[full.keep], A[full.keep][:, :0], grows[full.keep], trim=0).score - full.score
    raw = _gated("distance_scale", full, parts, 0, gain)
    # (odometry - match) / match is the factor minus 1
    scale = replace(raw, value=math.log1p(max(raw.value, -0.9)), other=math.log1p(max(raw.other, -0.9)))
    side = regress_errors(p.side, p.metres[:, None] * 0.0 + 1.0, grows)
    return scale, {"along_metre": float(full.sigmas[1]), "lateral_metre": float(side.sigmas[1])}
