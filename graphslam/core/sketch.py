"""Small pictures for notebooks as SVG: maps from above, and when a stream has records."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.markup import Markup, html_element

WIDTH, HEIGHT, MARGIN = 420.0, 240.0, 14.0
"""Of a map [px]."""
MOST_PLACES, MOST_ELLIPSES, MOST_POINTS, BINS = 400, 24, 1500, 100
"""Most corners of a line, ellipses, points, and intervals of a bar."""
BLUE, VERMILION, GREY, BLACK = "#0072B2", "#D55E00", "#999999", "#000000"


def plan_sketch(
    paths: Sequence[ArrayLike],
    *,
    points: ArrayLike | None = None,
    ellipses: Iterable[tuple[Array, Array]] = (),
    links: ArrayLike | None = None,
) -> Markup | None:
    """A map from above; None if there is nothing to draw. Of points in space x and y are used.

    Parameters
    ----------
    paths : sequence of (n, ≥ 2)
        Lines [m].
    points : (n, ≥ 2), optional
        Landmarks or occupied points [m].
    ellipses : pairs of (n, ≥ 2) and (n, 2, 2)
        Centres and covariances of 95 % ellipses, thinned out.
    links : (n, 2, ≥ 2), optional
        Loop closures: pairs of places.
    """
    from graphslam.core.gaussian import ellipse_rings, largest_sigmas  # loads SciPy

    lines = [_thin(np.asarray(p, dtype=np.float64)[:, :2], MOST_PLACES) for p in paths]
    dots = _thin(np.zeros((0, 2)) if points is None else np.asarray(points, dtype=np.float64)[:, :2], MOST_POINTS)
    every = np.concatenate([np.zeros((0, 2)), *lines, dots])
    every = every[np.isfinite(every).all(axis=1)]
    if len(every) < 2 or not np.ptp(every, axis=0).max() > 0:
        return None
    low, span = every.min(axis=0), np.ptp(every, axis=0)
    scale = min((WIDTH - 2 * MARGIN) / max(span[0], 1e-9), (HEIGHT - 2 * MARGIN) / max(span[1], 1e-9))

    def place(p: ArrayLike) -> Array:
        at = (np.asarray(p, dtype=np.float64)[..., :2] - low) * scale
        return np.stack([MARGIN + at[..., 0], HEIGHT - MARGIN - at[..., 1]], axis=-1)

    parts = [html_element("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r="1.6", fill=VERMILION) for x, y in place(dots)]
    for centres, covariances in ellipses:
        visible = largest_sigmas(covariances) * scale > 0.3
        visible &= np.linalg.eigvalsh(covariances).min(axis=1, initial=np.inf) > 0.0
        known = _thin(np.flatnonzero(visible), MOST_ELLIPSES)
        rings = ellipse_rings(centres[known, :2], covariances[known], 0.95, 24)
        parts += [_line(place(ring), VERMILION, 0.8) for ring in rings]
    parts += [_line(place(pair), GREY, 1.0) for pair in _thin(np.zeros((0, 2, 2)) if links is None else links, 200)]
    parts += [_line(place(p), BLUE, 1.6) for p in lines if len(p) > 1]
    step = 10.0 ** np.floor(np.log10(100.0 / scale))  # a bar of at most 100 px
    step *= max(k for k in (1, 2, 5) if k * step * scale <= 100.0)
    parts.append(_line(np.array([[MARGIN, HEIGHT - 5.0], [MARGIN + step * scale, HEIGHT - 5.0]]), BLACK, 2.0))
    label = html_element("text", f"{step:g} m", x=f"{MARGIN + step * scale + 4:.1f}", y=f"{HEIGHT - 2:.1f}")
    view = {"viewBox": f"0 0 {WIDTH:g} {HEIGHT:g}", "font-size": "11"}
    return html_element("svg", *parts, label, width=f"{WIDTH:g}", height=f"{HEIGHT:g}", role="img", **view)


def coverage_bar(times: Array, first: float, last: float) -> Markup:
    """A bar from ``first`` to ``last`` [s], filled where there are records."""
    span = max(last - first, 1e-12)
    used = np.bincount(np.clip(((times - first) / span * BINS).astype(np.int64), 0, BINS - 1), minlength=BINS) > 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], used.astype(np.int8), [0]])))
    filled = [
        html_element("rect", x=str(a), y="0", width=str(b - a), height="8", fill=BLUE)
        for a, b in edges.reshape(-1, 2).tolist()
    ]
    ground = html_element("rect", x="0", y="0", width=str(BINS), height="8", fill="#dddddd")
    return html_element("svg", ground, *filled, width=str(BINS), height="8", role="img")


def _line(places: Array, colour: str, width: float) -> Markup:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    return html_element("polyline", points=text, fill="none", stroke=colour, **{"stroke-width": f"{width:g}"})


def _thin(rows: ArrayLike, most: int) -> Any:
    """About ``most`` of the rows, with the first and the last."""
    a = np.asarray(rows)
    return a if len(a) <= most else a[np.unique(np.linspace(0, len(a) - 1, most).astype(np.intp))]
