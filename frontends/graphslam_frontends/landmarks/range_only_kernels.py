"""Compiled trilateration: a beacon from ranges along a known path, with covariance and alternative solutions.

One range is a circle, two circles intersect twice, and ranges from a straight path are symmetric to it. So Gauss-Newton
is started at several points of one circle, every minimum found is kept, and the χ² difference to the second best one is
returned.
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee, njit
from graphslam_frontends.landmarks.measurement_kernels import LOG_2PI, TWO_PI

STARTS = 16
ITERATIONS = 40
# Layout of a fit
FIT_X, FIT_Y, FIT_XX, FIT_XY, FIT_YY, FIT_CHI2, FIT_MARGIN, FIT_LOG_LIKELIHOOD, FIT_USED, FIT_MEAN_RANGE = range(10)
FIT_LENGTH = 10


@callee(error_model="numpy")
def _normal(x, y, anchors, ranges, variances, limit, out):
    """Truncated χ² Σ min(d², limit) at (x, y); out: gradient (2), Gauss-Newton matrix (xx, xy, yy), inliers.

    Derivatives are those of the inliers only, so a step ignores ranges that are *currently* outside the gate.
    """
    cost = 0.0
    out[:] = 0.0
    for k in range(len(ranges)):
        dx, dy = x - anchors[k, 0], y - anchors[k, 1]
        r = math.sqrt(dx * dx + dy * dy)
        if r < 1e-6:
            r = 1e-6
        e = r - ranges[k]
        d2 = e * e / variances[k]
        if d2 > limit:
            cost += limit
            continue
        cost += d2
        ux, uy = dx / r, dy / r
        w = 1.0 / variances[k]
        out[0] += w * e * ux
        out[1] += w * e * uy
        out[2] += w * ux * ux
        out[3] += w * ux * uy
        out[4] += w * uy * uy
        out[5] += 1.0
    return cost


@callee(error_model="numpy")
def _descend(p, anchors, ranges, variances, limit, n):
    """Damped Gauss-Newton from p, in place; returns the truncated χ²; n holds the normal equations at the end."""
    damping = 1e-3
    trial = np.empty(6)
    cost = _normal(p[0], p[1], anchors, ranges, variances, limit, n)
    for _ in range(ITERATIONS):
        if n[5] < 2.0:
            break
        a, b, c = n[2] * (1.0 + damping), n[3], n[4] * (1.0 + damping)
        det = a * c - b * b
        if not det > 0.0:
            break
        sx, sy = -(c * n[0] - b * n[1]) / det, -(a * n[1] - b * n[0]) / det
        new = _normal(p[0] + sx, p[1] + sy, anchors, ranges, variances, limit, trial)
        if new <= cost:
            gain = cost - new
            p[0] += sx
            p[1] += sy
            cost = new
            n[:] = trial
            damping = max(0.1 * damping, 1e-9)
            if gain <= 1e-9 * max(cost, 1.0) and sx * sx + sy * sy < 1e-12:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return cost


@njit(error_model="numpy")
def circle_starts(anchors, ranges, limit):
    """Points (m, 2) on the circle of the shortest range, which the beacon is on, within noise.

    With outliers (finite ``limit``) the shortest range may be one, so as many points on the median range are added.
    """
    order = np.argsort(ranges)
    circles = 1 if math.isinf(limit) else 2
    out = np.empty((circles * STARTS, 2))
    for i in range(len(out)):
        k = order[0] if i < STARTS else order[len(ranges) // 2]
        angle = TWO_PI * (i % STARTS + 0.3) / STARTS  # not on the axis of a straight path: a saddle
        out[i, 0] = anchors[k, 0] + ranges[k] * math.cos(angle)
        out[i, 1] = anchors[k, 1] + ranges[k] * math.sin(angle)
    return out


@njit(error_model="numpy")
def trilaterate_kernel(anchors, ranges, variances, limit, starts, fit, used, minima):
    """Beacon from ``ranges`` (k,) with ``variances`` (k,) at ``anchors`` (k, 2); ranges with d² > limit are not used.

    Descends from each of starts (m, 2). Fills fit (FIT_LENGTH): position, covariance, χ² of the inliers, χ² margin to
    the second best minimum (inf if there is none), log-likelihood of all ranges with the beacon integrated out
    (Laplace, flat prior; an outlier counts as one at the gate), number of inliers and their mean range; used (k,) bool;
    and minima (m, 3): x, y, truncated χ² of the distinct minima. Returns their number; 0, with fit undefined, if none
    has three inliers and full rank.
    """
    n = np.empty(6)
    p = np.empty(2)
    count = 0
    for start in range(len(starts)):
        p[0], p[1] = starts[start, 0], starts[start, 1]
        # outliers first have full weight: a distant start must use every range
        cost = _descend(p, anchors, ranges, variances, np.inf, n)
        if not math.isinf(limit):
            cost = _descend(p, anchors, ranges, variances, limit, n)
        if n[5] < 3.0 or not n[2] * n[4] - n[3] * n[3] > 1e-12 * n[2] * n[4]:
            continue
        known = False
        for i in range(count):  # the same minimum, within its own σ
            dx, dy = p[0] - minima[i, 0], p[1] - minima[i, 1]
            if n[2] * dx * dx + 2.0 * n[3] * dx * dy + n[4] * dy * dy < 1e-6:
                known = True
                break
        if not known:
            minima[count, 0], minima[count, 1], minima[count, 2] = p[0], p[1], cost
            count += 1
    if count == 0:
        return 0
    best = 0
    for i in range(1, count):
        if minima[i, 2] < minima[best, 2]:
            best = i
    x, y = minima[best, 0], minima[best, 1]
    cost = _normal(x, y, anchors, ranges, variances, limit, n)
    det = n[2] * n[4] - n[3] * n[3]
    margin = np.inf
    for i in range(count):  # an alternative is a minimum more than 3 σ away
        dx, dy = minima[i, 0] - x, minima[i, 1] - y
        if n[2] * dx * dx + 2.0 * n[3] * dx * dy + n[4] * dy * dy > 9.0:
            margin = min(margin, minima[i, 2] - cost)
    fit[FIT_X], fit[FIT_Y] = x, y
    fit[FIT_XX], fit[FIT_XY], fit[FIT_YY] = n[4] / det, -n[3] / det, n[2] / det
    fit[FIT_MARGIN], fit[FIT_USED] = margin, n[5]
    fit[FIT_CHI2] = 0.0
    fit[FIT_MEAN_RANGE] = 0.0
    fit[FIT_LOG_LIKELIHOOD] = LOG_2PI - 0.5 * math.log(det) - 0.5 * cost
    for i in range(len(ranges)):
        e = math.sqrt((x - anchors[i, 0]) ** 2 + (y - anchors[i, 1]) ** 2) - ranges[i]
        used[i] = e * e / variances[i] <= limit
        if used[i]:
            fit[FIT_CHI2] += e * e / variances[i]
            fit[FIT_MEAN_RANGE] += ranges[i] / n[5]
        fit[FIT_LOG_LIKELIHOOD] -= 0.5 * (LOG_2PI + math.log(variances[i]))
    return count


@njit(error_model="numpy")
def trilaterate_all_kernel(anchors, ranges, variances, limit, starts, fits, used, solved):
    """:func:`trilaterate_kernel` for every particle: anchors (n, k, 2), fits (n, FIT_LENGTH), used (n, k), solved
    (n,)."""
    minima = np.empty((len(starts), 3))
    for i in range(len(anchors)):
        solved[i] = trilaterate_kernel(anchors[i], ranges, variances, limit, starts, fits[i], used[i], minima) > 0
