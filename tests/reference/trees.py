"""Slow, obvious twin of the tree detector: one scan at a time, Python lists, a library optimiser for the circle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.integrate import quad
from scipy.optimize import least_squares

from graphslam_frontends.detectors import trees
from graphslam_frontends.detectors.trees import TreeDetectorConfig


@dataclass
class Trunk:
    range: float
    bearing: float
    radius: float
    sigma_range: float
    sigma_bearing: float
    beams: int
    fitted: bool


def moments(beams: int) -> tuple[float, float]:
    """Mean and variance of the half chord behind the middle, by adaptive quadrature over both edges."""
    far = beams // 2
    near = far if beams % 2 else far - 1

    def mean(f):
        return quad(f, 0.0, 1.0)[0]

    first = mean(lambda u: math.sqrt(far + u)) * mean(lambda u: math.sqrt(near + u))
    second = (far + 0.5) * (near + 0.5)
    if beams % 2 == 0:
        second = 0.5 * second + 0.5 * mean(lambda u: math.sqrt((far + u) * (near + u))) ** 2
    return first, second - first**2


def detect_scan(ranges: np.ndarray, bearings: np.ndarray, config: TreeDetectorConfig) -> list[Trunk]:
    """Trunks of one scan, from right to left."""
    step = float(np.mean(np.diff(bearings)))
    good = [k for k, r in enumerate(ranges) if np.isfinite(r) and 0 < r < config.max_range]
    clusters: list[list[int]] = []
    for k in good:
        previous = clusters[-1][-1] if clusters else None
        if (
            previous is None
            or k - previous - 1 > trees.MAX_MISSING
            or abs(ranges[k] - ranges[previous]) > trees.BREAK_DISTANCE
        ):
            clusters.append([])
        clusters[-1].append(k)

    def point(k: int) -> np.ndarray:
        return ranges[k] * np.array([math.cos(bearings[k]), math.sin(bearings[k])])

    found = []
    for cluster in clusters:
        a, b = cluster[0], cluster[-1]
        n = b - a + 1
        if n < trees.MIN_BEAMS or a == 0 or b == len(ranges) - 1:
            continue
        distance = [abs(2 * k - a - b) for k in cluster]
        inner = [k for k, d in zip(cluster, distance) if d == min(distance)]
        middle = float(np.mean([ranges[k] for k in inner]))
        values = [ranges[k] for k in cluster]
        if (n - 1) * step * middle >= config.max_width or max(values) - min(values) >= trees.MAX_DEPTH:
            continue
        hidden = [
            out
            for out, mine in ((a - 1, a), (b + 1, b))
            if ranges[out] > 0 and ranges[out] < ranges[mine] - trees.OCCLUSION
        ]
        close = [
            other
            for other in clusters
            if other is not cluster
            and (
                np.linalg.norm(point(a) - point(other[-1])) < trees.ISOLATION
                or np.linalg.norm(point(b) - point(other[0])) < trees.ISOLATION
            )
        ]
        if hidden or close:
            continue
        found.append(_measure(ranges, bearings, cluster, inner, middle, step, config))
    return found


def _measure(ranges, bearings, cluster, inner, middle, step, config) -> Trunk:
    a, b = cluster[0], cluster[-1]
    n = b - a + 1
    mean_g, var_g = moments(n)
    g = mean_g * step
    rho = middle / (1 - math.sin(g))
    bearing = 0.5 * (bearings[a] + bearings[b])
    radius = rho * math.sin(0.5 * n * step)
    # derivative of middle / (1 - sin g) with respect to g, by finite differences
    h = 1e-6
    slope = (middle / (1 - math.sin(g + h)) - middle / (1 - math.sin(g - h))) / (2 * h)
    variance = (trees.BEAM_SIGMA / (1 - math.sin(g))) ** 2 / len(inner) + (slope * step) ** 2 * var_g
    plain = Trunk(rho, bearing, radius, math.sqrt(variance), step / math.sqrt(24), n, False)
    if n < trees.FIT_BEAMS:
        return plain
    half = math.asin(min(radius / rho, 0.99))
    used = [k for k in cluster if abs(bearings[k] - bearing) <= 0.7 * half]

    def residual(p):
        alpha = math.asin(p[2] / p[0])
        edges = [(bearings[b] + step / 2) - (p[1] + alpha), (bearings[a] - step / 2) - (p[1] - alpha)]
        psi = [bearings[k] - p[1] for k in used]
        model = [p[0] * math.cos(x) - math.sqrt(p[2] ** 2 - (p[0] * math.sin(x)) ** 2) for x in psi]
        return np.array(
            [e / (step / math.sqrt(12)) for e in edges]
            + [(ranges[k] - m) / trees.BEAM_SIGMA for k, m in zip(used, model)]
        )

    try:
        fit = least_squares(residual, [rho, bearing, radius], method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    except ValueError:  # the optimiser stepped to an impossible circle
        return plain
    if 2 * fit.cost > 9.0 * max(len(used) - 1, 1):
        return plain
    P = np.linalg.inv(fit.jac.T @ fit.jac)
    return Trunk(fit.x[0], fit.x[1], fit.x[2], math.sqrt(P[0, 0]), math.sqrt(P[1, 1]), n, True)
