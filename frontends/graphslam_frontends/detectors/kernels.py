"""Kernels of the tree detector: plain arrays in, plain arrays out. Reference: ``tests/reference/trees.py``."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee, njit

# columns of the result
SCAN, RANGE, BEARING, RADIUS, VAR_RANGE, VAR_BEARING, BEAMS, FITTED = range(8)
COLUMNS = 8
# entries of the parameter vector
(P_MAX_RANGE, P_BREAK, P_MISSING, P_WIDTH, P_DEPTH, P_ISOLATION, P_OCCLUSION, P_MIN_BEAMS, P_FIT_BEAMS, P_SIGMA) = (
    range(10)
)
# Beams beyond this fraction of the half width graze the trunk; their range has an unbounded slope and is not used.
_INTERIOR = 0.7
# Largest chi-square per beam of an accepted circle; above it the cluster is no cylinder.
_FIT_GATE = 9.0
_MAX_ITERATIONS = 20


@callee
def _clusters(r, angles, max_range, jump, missing, first, last, ends):  # type: ignore[no-untyped-def]
    """Split the returns of one scan; fills first/last beam and the end points (x0, y0, x1, y1) of each cluster."""
    count = 0
    previous = -1
    for k in range(r.shape[0]):
        if not (r[k] > 0.0 and r[k] < max_range):  # NaN fails both: no return
            continue
        if previous < 0 or k - previous > missing + 1 or abs(r[k] - r[previous]) > jump:
            first[count] = k
            ends[count, 0] = r[k] * math.cos(angles[k])
            ends[count, 1] = r[k] * math.sin(angles[k])
            count += 1
        last[count - 1] = k
        ends[count - 1, 2] = r[k] * math.cos(angles[k])
        ends[count - 1, 3] = r[k] * math.sin(angles[k])
        previous = k
    return count


@callee
def _isolated(c, count, ends, distance):  # type: ignore[no-untyped-def]
    """Are all other clusters farther than ``distance`` (their last point to this first one, and vice versa)?"""
    d2 = distance * distance
    for k in range(count):
        if k == c:
            continue
        dx, dy = ends[c, 0] - ends[k, 2], ends[c, 1] - ends[k, 3]
        if dx * dx + dy * dy < d2:
            return False
        dx, dy = ends[c, 2] - ends[k, 0], ends[c, 3] - ends[k, 1]
        if dx * dx + dy * dy < d2:
            return False
    return True


@callee
def _middle_range(r, a, b, max_range):  # type: ignore[no-untyped-def]
    """Mean range of the one or two returns nearest to the middle of beams a..b, and their number."""
    best, total, used = 2 * (b - a) + 2, 0.0, 0
    for k in range(a, b + 1):
        if not (r[k] > 0.0 and r[k] < max_range):
            continue
        offset = abs(2 * k - a - b)
        if offset < best:
            best, total, used = offset, r[k], 1
        elif offset == best:
            total += r[k]
            used += 1
    return total / used, used


@callee
def _fit_circle(beams_of, a, b, rho, bearing, radius, out):  # type: ignore[no-untyped-def]
    """Weighted least squares of (rho, bearing, radius) on both edge angles and the ranges of the inner beams.

    Fills ``out`` with rho, bearing, radius, var(rho), var(bearing); True if it converged and passed the χ² gate.
    """
    r, angles, step, max_range, sigma = beams_of
    edge_variance = step * step / 12.0
    half = math.asin(min(radius / rho, 0.99))
    centre = bearing
    w_range = 1.0 / (sigma * sigma)
    w_edge = 1.0 / edge_variance
    upper, lower = angles[b] + 0.5 * step, angles[a] - 0.5 * step
    chi2 = 0.0
    beams = 0
    for _ in range(_MAX_ITERATIONS):
        h00 = h01 = h02 = h11 = h12 = h22 = g0 = g1 = g2 = chi2 = 0.0
        beams = 0
        ratio = radius / rho
        if not (0.0 < ratio < 0.99):
            return False
        cosine = math.sqrt(1.0 - ratio * ratio)
        d_rho, d_radius = -ratio / (rho * cosine), 1.0 / (rho * cosine)
        alpha = math.asin(ratio)
        for side in range(2):  # edges: bearing ± asin(radius / rho)
            sign = 1.0 if side == 0 else -1.0
            e = (upper if side == 0 else lower) - (bearing + sign * alpha)
            j0, j1, j2 = sign * d_rho, 1.0, sign * d_radius
            h00 += w_edge * j0 * j0
            h01 += w_edge * j0 * j1
            h02 += w_edge * j0 * j2
            h11 += w_edge * j1 * j1
            h12 += w_edge * j1 * j2
            h22 += w_edge * j2 * j2
            g0 += w_edge * j0 * e
            g1 += w_edge * j1 * e
            g2 += w_edge * j2 * e
            chi2 += w_edge * e * e
        for k in range(a, b + 1):
            if not (r[k] > 0.0 and r[k] < max_range) or abs(angles[k] - centre) > _INTERIOR * half:
                continue
            psi = angles[k] - bearing
            sn, cs = math.sin(psi), math.cos(psi)
            square = radius * radius - rho * rho * sn * sn
            if square <= 1e-4 * radius * radius:
                return False
            root = math.sqrt(square)
            e = r[k] - (rho * cs - root)
            j0 = cs + rho * sn * sn / root
            j1 = rho * sn - rho * rho * sn * cs / root
            j2 = -radius / root
            h00 += w_range * j0 * j0
            h01 += w_range * j0 * j1
            h02 += w_range * j0 * j2
            h11 += w_range * j1 * j1
            h12 += w_range * j1 * j2
            h22 += w_range * j2 * j2
            g0 += w_range * j0 * e
            g1 += w_range * j1 * e
            g2 += w_range * j2 * e
            chi2 += w_range * e * e
            beams += 1
        c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
        determinant = h00 * c00 + h01 * c01 + h02 * c02
        if determinant <= 0.0:
            return False
        c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
        s0 = (c00 * g0 + c01 * g1 + c02 * g2) / determinant
        s1 = (c01 * g0 + c11 * g1 + c12 * g2) / determinant
        s2 = (c02 * g0 + c12 * g1 + c22 * g2) / determinant
        rho += s0
        bearing += s1
        radius += s2
        if abs(s0) < 1e-9 and abs(s1) < 1e-10 and abs(s2) < 1e-9:
            if chi2 > _FIT_GATE * max(beams - 1, 1):  # beams + 2 edges - 3 unknowns
                return False
            out[0], out[1], out[2] = rho, bearing, radius
            out[3], out[4] = c00 / determinant, c11 / determinant
            return True
    return False


@njit
def detect_kernel(ranges, angles, step, parameters, mean_g, var_g):  # type: ignore[no-untyped-def]
    """Trunks of all scans.

    Parameters
    ----------
    ranges : (n, m)
        NaN, zero, negative or ≥ ``max_range`` is no return.
    angles : (m,)
        Beam bearings, ``step`` apart [rad].
    parameters : (10,)
        In the order of the ``P_`` constants.
    mean_g, var_g : (m + 1,)
        Mean and variance, by the number of beams on the trunk, of the half chord behind the middle beam, in units of
        the step (see :mod:`graphslam_frontends.detectors.trees`).

    Returns
    -------
    (q, 8)
        Columns as the constants above, in scan order, and in each scan from right to left.
    """
    n, m = ranges.shape
    max_range, sigma = parameters[P_MAX_RANGE], parameters[P_SIGMA]
    missing = int(parameters[P_MISSING])
    first, last = np.empty(m, np.int64), np.empty(m, np.int64)
    ends = np.empty((m, 4))
    fit = np.empty(5)
    out = np.empty((max(16, 8 * n), COLUMNS))
    q = 0
    for s in range(n):
        r = ranges[s]
        count = _clusters(r, angles, max_range, parameters[P_BREAK], missing, first, last, ends)
        for c in range(count):
            a, b = first[c], last[c]
            beams = b - a + 1
            if beams < parameters[P_MIN_BEAMS] or a == 0 or b == m - 1:  # cut by the edge of the scan: width unknown
                continue
            middle, used = _middle_range(r, a, b, max_range)
            if (beams - 1) * step * middle >= parameters[P_WIDTH]:
                continue
            nearest, farthest = r[a], r[a]
            for k in range(a, b + 1):
                if r[k] > 0.0 and r[k] < max_range:
                    nearest, farthest = min(nearest, r[k]), max(farthest, r[k])
            if farthest - nearest >= parameters[P_DEPTH]:
                continue
            # a nearer object next to it hides part of the trunk
            if (r[a - 1] > 0.0 and r[a - 1] < r[a] - parameters[P_OCCLUSION]) or (
                r[b + 1] > 0.0 and r[b + 1] < r[b] - parameters[P_OCCLUSION]
            ):
                continue
            if not _isolated(c, count, ends, parameters[P_ISOLATION]):
                continue
            g = min(mean_g[beams] * step, 1.4)
            shrink = 1.0 - math.sin(g)
            slope = middle * math.cos(g) * step / (shrink * shrink)
            rho = middle / shrink
            bearing = 0.5 * (angles[a] + angles[b])
            radius = rho * math.sin(min(0.5 * beams * step, 1.4))
            var_range = sigma * sigma / (used * shrink * shrink) + slope * slope * var_g[beams]
            var_bearing = step * step / 24.0
            fitted = 0.0
            if beams >= parameters[P_FIT_BEAMS] and _fit_circle(
                (r, angles, step, max_range, sigma), a, b, rho, bearing, radius, fit
            ):
                rho, bearing, radius, var_range, var_bearing = fit
                fitted = 1.0
            if q == out.shape[0]:
                grown = np.empty((2 * q, COLUMNS))
                grown[:q] = out
                out = grown
            out[q, SCAN], out[q, RANGE], out[q, BEARING], out[q, RADIUS] = s, rho, bearing, radius
            out[q, VAR_RANGE], out[q, VAR_BEARING], out[q, BEAMS], out[q, FITTED] = (
                var_range,
                var_bearing,
                beams,
                fitted,
            )
            q += 1
    return out[:q].copy()
