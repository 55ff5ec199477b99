"""The coordinates in which a landmark map is Gaussian.

An error of the heading turns the end of a submap and its landmarks together, along arcs; a Gaussian over Cartesian
coordinates lets them err along straight lines. In the *group chart* of SE₁₊ₙ(2) the residual of a pose (t, θ) and of
every point l that hangs on it is, with ``d = θ - θ̂``,

    (V(d)⁻¹ (t - R(d) t̂),  d,  V(d)⁻¹ (l - R(d) l̂)),        V(d) = ∫₀¹ R(s d) ds.

Because ``R(d) = I + S V(d) d`` (S the quarter turn), this is

    (V(d)⁻¹ (t - t̂) - S t̂ d,  d,  V(d)⁻¹ (l - l̂) - S l̂ d),

and the terms in ``S`` are what the change of the information matrix to this chart takes back: the weighted square of
the residual is that of ``u = (V(d)⁻¹ (t - t̂), d, V(d)⁻¹ (l - l̂))`` with the *Cartesian* information matrix. So mean
and covariance of a map stay what they are, and the chart is one scaled rotation,

    V(d)⁻¹ = a I - b S,        a = (d/2) cot(d/2),  b = d/2.

In a joined map a point hangs on its *anchor*, the end pose of the submap that saw it first.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, ArrayLike, wrap_angle

Chart = Literal["cartesian", "group"]
CHARTS: tuple[str, ...] = get_args(Chart)

_SMALL = 1e-3
"""Below this half angle [rad] series are exact to rounding, and differences of cotangents are not."""


def check_chart(chart: str) -> str:
    """The name of a chart, or a refusal of what is none.

    Raises
    ------
    ConfigError
    """
    if chart not in CHARTS:
        raise ConfigError(f"unknown chart {chart!r}; wanted {' or '.join(repr(c) for c in CHARTS)}")
    return chart


def arc_terms(d: ArrayLike) -> tuple[Array, Array, Array]:
    """``a``, ``b`` and ``da/dd`` of ``V(d)⁻¹ = a I - b S`` for headings ``d`` in [-π, π]."""
    h = 0.5 * np.asarray(d, dtype=np.float64)
    small = np.abs(h) < _SMALL
    safe = np.where(small, 1.0, h)
    cot, sin2 = 1.0 / np.tan(safe), np.sin(safe) ** 2
    a = np.where(small, 1.0 - h**2 / 3.0 - h**4 / 45.0, safe * cot)
    slope = np.where(small, -h / 3.0 - 2.0 * h**3 / 45.0, 0.5 * (cot - safe / sin2))
    return a, h, slope


def along_arc(difference: Array, d: ArrayLike) -> Array:
    """``V(d)⁻¹ e`` for differences e ``(..., 2)`` of points that hang on a pose whose heading differs by ``d``."""
    a, b, _ = arc_terms(d)
    x, y = difference[..., 0], difference[..., 1]
    return np.stack([a * x + b * y, a * y - b * x], -1)


def map_difference(x: ArrayLike, mean: ArrayLike, chart: str) -> Array:
    """What a vector ``[x, y, θ, l1x, l1y, …]`` differs from a mean by, in the coordinates of a chart ``(n,)``.

    ``rᵀ P⁻¹ r`` with the covariance P of the Cartesian vector is the squared distance in that chart.

    Parameters
    ----------
    x, mean : (n,)
        In the base frame.
    chart : "cartesian" or "group"
    """
    r = np.asarray(x, dtype=np.float64) - np.asarray(mean, dtype=np.float64)
    r[2] = wrap_angle(r[2])
    if chart == "group":
        points = along_arc(np.concatenate([r[:2], r[3:]]).reshape(-1, 2), r[2])
        r[:2], r[3:] = points[0], points[1:].ravel()
    return r
