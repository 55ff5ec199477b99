"""Particles: where they end, what is left of their paths, who descends from whom, and which Gaussian results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.ticker import MaxNLocator

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_between
from graphslam.core.log import Truth
from graphslam.core.submap import Submap
from graphslam.plots import style
from graphslam.plots.map import landmark_blocks, plot_ellipses
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_studies.evaluate.submap_consistency import true_submap
from graphslam_studies.frontends.rbpf_grid import RbpfResult
from graphslam_studies.plots.exit_points import draw_exits

_COLOURS = (style.ESTIMATE, style.VERMILION, style.PURPLE, style.ORANGE, style.SKY)


def plot_exit(
    ax: Axes | None,
    handovers: Mapping[str, Submap],
    *,
    particles: ParticleSet | None = None,
    truth: Truth | None = None,
    confidence: float = 0.95,
    title: str | None = None,
) -> Axes:
    """Where a submap ends: the Gaussians of several outputs, the particles of one of them, ground truth.

    Parameters
    ----------
    handovers : mapping of label to Submap
        2-D landmark submaps of the same scans.
    particles : ParticleSet, optional
        Their exit positions; the area of a dot grows with the weight.
    truth : Truth, optional
        The true exit in the frame of the first base: nothing is aligned.
    confidence : float
        Of the ellipses.
    """
    if not handovers:
        raise DataError("no submap to draw")
    ax = style.new_axes(ax, (5.0, 4.5))
    if particles is not None:
        n = len(particles.weights)
        # one dot for particles that stand on the same spot, so that a collapsed set looks collapsed
        at, which = np.unique(particles.pose[:, :2], axis=0, return_inverse=True)
        weight = np.bincount(which.ravel(), weights=particles.weights)
        ax.scatter(at[:, 0], at[:, 1], s=np.minimum(12.0 * n * weight, 90.0), color=style.GREY, alpha=0.55, lw=0,
                   label="particles", zorder=2)  # fmt: skip
    ends = {}
    for label, submap in handovers.items():
        mean, cov = _vector(submap)
        ends[label] = mean[:2], cov[:2, :2]
    true_exit = None if truth is None else true_submap(next(iter(handovers.values())), truth)[0]
    draw_exits(ax, ends, colours=_COLOURS, truth=true_exit, truth_label="true exit", confidence=confidence, title=title)
    style.legend(ax, outside=False, loc="best")
    return ax


def plot_exit_panels(
    panels: Mapping[str, tuple[ParticleSet | None, Mapping[str, Submap]]],
    *,
    truth: Truth | None = None,
    confidence: float = 0.95,
) -> list[Axes]:
    """One :func:`plot_exit` per title, side by side on the same scales; the legend is next to the last."""
    if not panels:
        raise DataError("no submap to draw")
    n = len(panels)
    fig, made = plt.subplots(1, n, dpi=style.DPI, layout="constrained", sharex=True, sharey=True, squeeze=False)
    axes = list(made.ravel())
    for ax, (title, (particles, handovers)) in zip(axes, panels.items(), strict=True):
        plot_exit(ax, handovers, particles=particles, truth=truth, confidence=confidence, title=title)
        ax.label_outer()
        if (box := ax.get_legend()) is not None:
            box.remove()
    style.legend(axes[-1])
    # equal scales in x and y: a figure of the data's own shape wastes no space
    wide = float(np.ptp(axes[0].get_xlim()) / np.ptp(axes[0].get_ylim()))
    fig.set_size_inches(n * float(np.clip(4.0 * wide, 1.6, 4.0)) + 2.5, float(np.clip(4.0 / wide, 2.4, 4.4)))
    return axes


def plot_handovers(
    ax: Axes | None,
    handovers: Mapping[str, Submap],
    *,
    truth: Truth | None = None,
    confidence: float = 0.95,
    title: str | None = None,
) -> Axes:
    """Several hand-overs of the same scans as maps over each other: exits and landmarks with their ellipses.

    Parameters
    ----------
    handovers : mapping of label to Submap
        2-D landmark submaps.
    truth : Truth, optional
        In the frame of the first base: nothing is aligned.
    """
    if not handovers:
        raise DataError("no submap to draw")
    ax = style.new_axes(ax)
    for k, (label, submap) in enumerate(handovers.items()):
        mean, cov = _vector(submap)
        colour = _COLOURS[k % len(_COLOURS)]
        points = np.vstack([mean[None, :2], mean[3:].reshape(-1, 2)])
        blocks = np.concatenate([cov[None, :2, :2], landmark_blocks(cov, (len(mean) - 3) // 2, offset=3)])
        plot_ellipses(ax, points, blocks, confidence=confidence, colour=colour, label=f"{label}, {confidence:.0%}",
                      alpha=0.10)  # fmt: skip
    ax.plot(0.0, 0.0, "s", color=style.BLACK, ms=6, label="base: zero by definition", zorder=4)
    if truth is not None:
        exit_pose, _, points = true_submap(next(iter(handovers.values())), truth)
        ax.plot(*exit_pose[:2], "+", color=style.TRUTH, ms=10, mew=1.6, label="true exit", zorder=5)
        ax.plot(points[:, 0], points[:, 1], "x", color=style.TRUTH, ms=5, mew=1.0, label="true landmark", zorder=5)
    style.metric_axes(ax)
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def plot_lineage(
    ax: Axes | None, particles: ParticleSet, submap: Submap, *, sigmas: float = 2.0, title: str | None = None
) -> Axes:
    """Paths of the particles that are left at the end, sideways from the smoothed path, over its own band.

    Every resampling kills histories: towards the start all particles share one path, and no spread is left where the
    posterior has some.

    Parameters
    ----------
    particles : ParticleSet
        At the end of the submap.
    submap : Submap
        Smoothed, of the same scans, with its trajectory.
    sigmas : float
        Half width of the band in the smoothed path's own standard deviations.
    """
    path = submap.trajectory
    scans = particles.scans
    if path is None or path.covariances is None or len(path.poses) < scans or scans < 1:
        raise DataError(f"submap {submap.key} has no path for {scans} scans", wanted="a trajectory with covariances")
    ax = style.new_axes(ax, (8.0, 3.6))
    smooth, cov = path.poses[-scans:], path.covariances[-scans:]
    off = se2_between(smooth[None], particles.path[:, :scans])[..., 1]  # sideways in the smoothed body frame
    sigma = np.sqrt(cov[:, 1, 1])  # right tangent: the same frame
    x = np.arange(1, scans + 1)
    ax.fill_between(x, -sigmas * sigma, sigmas * sigma, color=style.ESTIMATE, alpha=0.18, lw=0,
                    label=f"smoothed path, ±{sigmas:g}σ", zorder=0)  # fmt: skip
    histories = np.unique(off, axis=0)
    ax.plot(x, histories.T, color=style.GREY, lw=0.7, alpha=0.6, zorder=2)
    ax.plot([], [], color=style.GREY, lw=1.0, label=f"{len(particles.weights)} particles' paths")
    ax.axhline(0.0, color=style.ESTIMATE, lw=0.9, zorder=1)
    ax.set_xlabel("scan of the submap")
    ax.set_ylabel("sideways [m]")
    ancestors = particles.ancestors
    descent = f"{particles.resamplings} resamplings, {ancestors} ancestor{'s' if ancestors != 1 else ''} left"
    ax.set_title(title or descent, fontsize="medium")
    style.legend(ax)
    return ax


def plot_histories(ax: Axes | None, sets: Mapping[str, ParticleSet], *, title: str | None = None) -> Axes:
    """How many different histories of every scan are still carried at the end of the submap.

    Parameters
    ----------
    sets : mapping of label to ParticleSet
    """
    if not sets:
        raise DataError("no particles to draw")
    ax = style.new_axes(ax, (8.0, 3.2))
    for k, (label, particles) in enumerate(sets.items()):
        left = histories_left(particles)
        every = max(1, len(left) // 8)
        ax.plot(np.arange(1, len(left) + 1), left, lw=1.5, ms=4.5, markevery=every, label=label, **style.line(k))
    ax.set_yscale("log")
    ax.set_xlabel("scan of the submap")
    ax.set_ylabel("different poses left")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax)
    return ax


def plot_ancestry(
    result: RbpfResult | SegSlamResult,
    ax: Axes | None,
    segment_boundaries: Sequence[float] | None = None,
    *,
    since: float | None = None,
    title: str | None = None,
) -> Axes:
    """Who descends from whom: particles over time, joined to those they went on from (SegSLAM Fig. 2–3).

    Parameters
    ----------
    result : RbpfResult or SegSlamResult
        Its run must have kept the lineages that died out (``prune_every=0``) for them to be shown.
    segment_boundaries : sequence of float, optional
        Times [s] at which segments end. Only within a segment does it matter that the particles have met: across a
        boundary any of them may follow any other.
    since : float, optional
        Time [s] at which the picture begins; default the start.
    """
    stamps = np.asarray(result.times if isinstance(result, RbpfResult) else result.steps.times)
    tree, times = result.ancestry, stamps - stamps[0]
    ax = style.new_axes(ax, (8.0, 3.6))
    edges, alive = tree.links()
    # from the particle it went on from, one step earlier, to the particle itself
    lines = np.stack(
        [np.column_stack([times[edges[:, 0] - 1], edges[:, 2]]), np.column_stack([times[edges[:, 0]], edges[:, 1]])], 1
    )
    if not alive.all():
        ax.add_collection(LineCollection(list(lines[~alive]), colors=style.PALE, linewidths=0.6, zorder=1))
        ax.plot([], [], color=style.PALE, lw=1.2, label="died out")
    ax.add_collection(LineCollection(list(lines[alive]), colors=style.ESTIMATE, linewidths=0.9, zorder=2))
    ax.plot([], [], color=style.ESTIMATE, lw=1.2, label="ancestors of the last")
    met = tree.coalescence()
    if met >= 0 and tree.particles > 1:
        who = int(tree.numbers()[met, 0])
        ax.plot(times[met], who, "o", color=style.VERMILION, ms=6, mec="white", mew=0.6, zorder=4,
                label=f"their last common ancestor, {times[-1] - times[met]:.1f} s back")  # fmt: skip
    for k, t in enumerate(segment_boundaries or ()):
        ax.axvline(t - stamps[0], color=style.BLACK, lw=0.9, ls="--", zorder=3,
                   label="segments end" if k == 0 else None)  # fmt: skip
    ax.set_xlim(0.0 if since is None else since - stamps[0], max(float(times[-1]), 1e-9))
    ax.set_ylim(-0.7, tree.particles - 0.3)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("time [s]")
    ax.set_ylabel("particle")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax, outside=False, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncol=4)
    return ax


def plot_effective(result: RbpfResult, ax: Axes | None, *, title: str | None = None) -> Axes:
    """How many particles are effective after each scan (SegSLAM eq. 7), when they were resampled, and how many
    ancestors of each step are left.
    """
    times, n = np.asarray(result.times) - result.times[0], result.ancestry.particles
    ax = style.new_axes(ax, (8.0, 3.2))
    ax.plot(times, result.effective, color=style.ESTIMATE, lw=0.8, label="effective, before resampling")
    at = result.resampled
    share = float(np.mean(at))
    ax.plot(times[at], result.effective[at], "o", color=style.VERMILION, ms=2.6, lw=0,
            label=f"resampled ({at.sum()}, {share:.0%} of the steps)")  # fmt: skip
    ax.step(times, result.ancestry.survivors(), where="mid", color=style.BLACK, lw=1.0, ls="--",
            label="ancestors of the last particles")  # fmt: skip
    ax.axhline(n, color=style.GREY, lw=0.7)
    ax.set_xlim(0.0, max(float(times[-1]), 1e-9))
    ax.set_ylim(0.0, 1.06 * n)
    ax.set_xlabel("time [s]")
    ax.set_ylabel(f"particles, of {n}")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax, outside=False, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncol=3)
    return ax


def plot_pasts(rbpf: RbpfResult, segslam: SegSlamResult, ax: Axes | None, *, title: str | None = None) -> Axes:
    """How many different pasts are left of each time: of one filter, and in a SegMap (SegSLAM Fig. 2–3 in numbers).

    A filter remembers of each step as many pasts as its particles have ancestors there. Of a SegMap any segment of an
    interval may follow any of the one before (A6), so the pasts of all intervals multiply.

    Parameters
    ----------
    segslam : SegSlamResult
        Of the same steps.
    """
    stamps = np.asarray(segslam.steps.times)
    if len(rbpf.times) != len(stamps):
        raise DataError("the two runs have different steps", got=len(rbpf.times), wanted=len(stamps))
    ax = style.new_axes(ax, (8.0, 3.2))
    segmap, times = segslam.segmap, stamps - stamps[0]
    intervals = segmap.intervals()
    counts = np.array([len(segmap.in_interval((int(a), int(b)))) for a, b in intervals])
    for k, ((a, b), n) in enumerate(zip(intervals, counts)):
        label = f"segments of each interval; together {_power(counts)} ways through the SegMap"
        ax.fill_between(times[[a, b]], 0, n, color=style.SKY, alpha=0.45, lw=0, label=label if k == 0 else None)
        ax.plot(times[[a, b]], [n, n], color=style.ESTIMATE, lw=1.6)
        ax.axvline(times[b], color=style.BLACK, lw=0.6, ls="--") if k + 1 < len(counts) else None
    ax.step(times, rbpf.ancestry.survivors(), where="mid", color=style.VERMILION, lw=1.4,
            label="RBPF: ancestors of its last particles")  # fmt: skip
    ax.set_xlim(0.0, max(float(times[-1]), 1e-9))
    ax.set_ylim(0.0, 1.1 * max(int(counts.max()), rbpf.ancestry.particles))
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("time [s]")
    ax.set_ylabel("different pasts")
    if title:
        ax.set_title(title, fontsize="medium")
    style.legend(ax, outside=False, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncol=2)
    return ax


def _power(counts: npt.NDArray[np.int64]) -> str:
    """The product of numbers, whole while it is small."""
    exponent = float(np.sum(np.log10(counts)))
    return f"{round(10**exponent):,}" if exponent < 5 else f"about $10^{{{exponent:.0f}}}$"


def histories_left(particles: ParticleSet) -> Array:
    """Number of different poses ``(scans,)`` of every scan that the particles of the end still remember."""
    path = particles.path[:, : particles.scans]
    return np.array([len(np.unique(path[:, t], axis=0)) for t in range(particles.scans)])


def _vector(submap: Submap) -> tuple[Array, Array]:
    """Mean and covariance of ``[x, y, θ, l1x, …]`` of a 2-D landmark submap."""
    if submap.dim != 2 or submap.landmarks is None:
        raise DataError(f"submap {submap.key} is no 2-D landmark map", wanted="a Gaussian over exit and landmarks")
    return submap.landmarks.mean, submap.landmarks.dense_covariance()
