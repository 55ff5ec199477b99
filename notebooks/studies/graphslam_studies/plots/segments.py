"""Figures of segmentation scores, samples of maps and their entropies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.plots import style
from graphslam.plots.segments import (
    REASON_STYLES,
    DrawnMatch,
    Path,
    finish_plan,
    placed_segments,
    plan_axes,
    plan_positions,
)
from graphslam_frontends.segslam.sampling import OPEN, MapSample, nearest_step
from graphslam_frontends.segslam.segmap import KINDS, MATCH, SegMap


def plot_scores(
    ax: Axes | None,
    lengths: npt.ArrayLike,
    scores: npt.ArrayLike,
    *,
    boundaries: Sequence[tuple[float, str]] = (),
    threshold: float | None = None,
    relative: float | None = None,
    title: str | None = None,
) -> Axes:
    """Predictive score along the path, with the boundaries of segments and why they are there (SegSLAM Fig. 6).

    Parameters
    ----------
    lengths, scores : (n,)
        Metres driven; share of the look-ahead beams that the maps predict, NaN where there is none.
    boundaries : sequence of (length, reason)
    threshold : float, optional
        Score below which a segment ends.
    relative : float, optional
        … or below this share of the running maximum of its segment, which is drawn.

    Raises
    ------
    DataError
        Lengths and scores differ in number, or fall.
    """
    s, y = np.asarray(lengths, dtype=np.float64), np.asarray(scores, dtype=np.float64)
    if s.shape != y.shape or s.ndim != 1 or np.any(np.diff(s) < 0):
        raise DataError("scores do not belong to the path", got=f"{y.shape} on {s.shape}", wanted="one each, in order")
    ax = style.new_axes(ax, (8.0, 3.2))
    ax.plot(s, y, color=style.ESTIMATE, lw=1.1, marker="o", ms=2.2, label="predictive score", zorder=3)
    at = sorted(boundaries)
    reasons = sorted({why for _, why in at})
    for length, why in at:
        k = reasons.index(why)
        ax.axvline(length, color=style.colour(k + 1), ls=REASON_STYLES[k % len(REASON_STYLES)], lw=1.0, zorder=2)
    for k, why in enumerate(reasons):
        n = sum(w == why for _, w in at)
        ax.plot([], [], color=style.colour(k + 1), ls=REASON_STYLES[k % len(REASON_STYLES)], lw=1.0,
                label=f"segment ends: {why} ({n})")  # fmt: skip
    if threshold:
        ax.axhline(threshold, color=style.GREY, lw=0.8, label=f"threshold {threshold:g}")
    if relative:
        ax.plot(s, relative * running_maximum(s, y, [length for length, _ in at]), color=style.GREY, lw=0.8, ls="--",
                drawstyle="steps-post", label=f"{relative:g} × running maximum")  # fmt: skip
    ax.set_ylim(0.0, 1.0)
    ax.set_xlabel("path [m]")
    ax.set_ylabel("share of beams predicted")
    finish_plan(ax, title)
    return ax


def running_maximum(lengths: Array, scores: Array, boundaries: Sequence[float]) -> Array:
    """Maximum of the scores so far since the last boundary before or at each length ``(n,)``; NaN before the first."""
    segment = np.searchsorted(np.sort(np.asarray(boundaries, dtype=np.float64)), lengths, side="left")
    out = np.full(len(scores), np.nan)
    for k in np.unique(segment):
        rows = np.flatnonzero(segment == k)
        out[rows] = np.fmax.accumulate(scores[rows])
    return out


def sample_paths(
    segmap: SegMap, sample: MapSample, *, frame: Literal["root", "first"] = "root"
) -> tuple[list[Array], list[DrawnMatch], list[str]]:
    """Paths of the closed segments of a map sample, in the order of time, for :func:`plot_segments`; the matches
    between them; and their labels.

    Parameters
    ----------
    frame : {"root", "first"}
        In the frame of the sample's root, or of its first segment in time.

    Returns
    -------
    paths : list of (n, dim)
    matches : list of DrawnMatch
        Of segments that entered a map which the sample holds.
    labels : list of str
        Number in time, with "m" where an older map was entered.
    """
    g = segmap.group
    if frame not in ("root", "first"):
        raise ConfigError(f"frame {frame!r} of a map sample; known: root, first")
    poses = sample.poses
    if frame == "first":
        first = g.inverse(poses[int(sample.in_time[0])])
        poses = g.compose(np.broadcast_to(first, poses.shape), poses)
    place = {int(i): k for k, i in enumerate(sample.segments.tolist()) if i != OPEN}
    paths: list[Array] = []
    matches: list[DrawnMatch] = []
    labels: list[str] = []
    for k in sample.in_time.tolist():
        i = int(sample.segments[k])
        if i == OPEN:
            continue
        s = segmap[i]
        paths.append(placed_segments(poses[k], s.path))
        labels.append(f"{len(labels)}{'m' if s.kind == KINDS[MATCH] else ''}")
        if s.kind != KINDS[MATCH] or s.source not in place:
            continue
        source = segmap[s.source]
        at = poses[place[s.source]]
        nearest = source.path[nearest_step(segmap, s.source, s.T_entry) - source.interval[0]]
        matches.append(DrawnMatch(paths[-1][0], placed_segments(at, nearest[None])[0]))
    return paths, matches, labels


def plot_samples(
    ax: Axes | None,
    trajectories: Sequence[Path],
    *,
    best: int | None = None,
    truth: Path | None = None,
    plane: str = "xy",
    what: str = "map sample",
    title: str | None = None,
) -> Axes:
    """Map samples over each other: where they agree, the map is sure.

    Parameters
    ----------
    trajectories : sequence of Trajectory or (n, dim)
        Of the samples, in one frame.
    best : int, optional
        The one to set off, as that of least entropy.
    truth : Trajectory or (n, dim), optional
    plane : {"xy", "xz", "yz"}
    what : str
        Name of one of them, in the legend.
    """
    if not trajectories:
        raise DataError("no sample to draw")
    i, j = plan_axes(plane)
    ax = style.new_axes(ax)
    n = len(trajectories)
    for k, path in enumerate(trajectories):
        p = plan_positions(path, max(i, j))
        if k != best:
            ax.plot(p[:, i], p[:, j], color=style.SKY, lw=0.7, alpha=max(0.12, min(1.0, 4.0 / n)), zorder=2)
    ax.plot([], [], color=style.SKY, lw=1.2, label=f"{n} {what}{'s' if n != 1 else ''}")
    if best is not None:
        p = plan_positions(trajectories[best], max(i, j))
        ax.plot(p[:, i], p[:, j], color=style.ESTIMATE, lw=1.5, label="the best of them", zorder=3)
    if truth is not None:
        t = plan_positions(truth, max(i, j))
        ax.plot(t[:, i], t[:, j], color=style.TRUTH, lw=0.9, ls="--", label="truth", zorder=4)
    style.metric_axes(ax, *plane)
    finish_plan(ax, title)
    return ax


def plot_entropies(
    ax: Axes | None,
    entropies: Mapping[str, npt.ArrayLike],
    *,
    bins: int = 20,
    unit: str = "nat m³",
    title: str | None = None,
) -> Axes:
    """Histograms of the entropy of map samples, a method each; lower is a clearer map (SegSLAM eq. 20–22).

    Parameters
    ----------
    entropies : mapping of label to (n,)
        A single value is drawn as a line.
    bins : int
        Of all histograms together, so that areas compare.

    Raises
    ------
    DataError
        Nothing to draw, or a value that is not finite.
    """
    values = {k: np.atleast_1d(np.asarray(v, dtype=np.float64)) for k, v in entropies.items()}
    if not values or any(len(v) == 0 or not np.all(np.isfinite(v)) for v in values.values()):
        raise DataError("no entropies to draw", wanted="finite numbers for each label")
    ax = style.new_axes(ax, (7.0, 3.2))
    everything = np.concatenate(list(values.values()))
    low, high = float(everything.min()), float(everything.max())
    edges = np.linspace(low, high, bins + 1).tolist() if high > low else [low - 0.5, low + 0.5]
    for k, (label, v) in enumerate(values.items()):
        if len(v) == 1:
            ax.axvline(v[0], color=style.colour(k), lw=1.6, ls="--", label=f"{label}: {v[0]:,.0f}")
            continue
        ax.hist(v, edges, histtype="stepfilled", alpha=0.35, color=style.colour(k), zorder=2)
        ax.hist(v, edges, histtype="step", color=style.colour(k), lw=1.2, zorder=3,
                label=f"{label}: least {v.min():,.0f}, median {np.median(v):,.0f} of {len(v)}")  # fmt: skip
    ax.set_xlabel(f"entropy of the map [{unit}]")
    ax.set_ylabel("samples")
    finish_plan(ax, title)
    return ax
