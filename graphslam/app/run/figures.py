"""Figures of a run, written as PNG files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.run.run import Run
from graphslam.core.plan_view import plan_pose, plan_submap
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.plots.refined import plot_before_after
from graphslam.plots.residual_consistency import plot_innovations, plot_loop_matrix
from graphslam.plots.save import save_figure
from graphslam.plots.submaps import plot_submap_chain
from graphslam.plots.trajectory import plot_gps_residuals


def _as_solved(run: Run) -> list[Submap]:
    """Submaps with their solved trajectories (inner nodes change them); unchanged if there are no inner nodes."""
    m = run.map
    if len(m.node_poses) == len(m.base_poses):
        return list(run.submaps)
    group = group_of(m.node_poses)
    out = []
    for s, base, end in zip(run.submaps, m.base_poses, m.base_poses[1:]):
        keep = (m.trajectory.times >= s.interval[0]) & (m.trajectory.times < s.interval[1])
        if s.landmarks is not None or not np.any(keep):
            out.append(s)
            continue
        poses = np.vstack([m.trajectory.poses[keep], end])
        times = np.append(m.trajectory.times[keep], s.interval[1])
        local = group.between(np.broadcast_to(base, poses.shape), poses)
        out.append(replace(s, exit_pose=local[-1], trajectory=Trajectory(times, local)))
    return out


def _submap_chain(run: Run) -> Any:
    submaps, bases = _as_solved(run), run.map.base_poses
    if run.map.dim == 3:
        submaps, bases = [plan_submap(s) for s in submaps], plan_pose(bases)
    return plot_submap_chain(None, submaps, bases, title=f"{run.name}: submaps at their solved poses")


def _refined(run: Run) -> Any:
    if run.graph_path is None:
        return None
    return plot_before_after(None, run.graph_path, run.map.trajectory, truth=run.truth_path)


def _innovations(run: Run) -> Any:
    return None if run.checks is None or run.checks.gps is None else plot_innovations(None, run.checks.gps)


def _loops(run: Run) -> Any:
    return None if run.checks is None or run.checks.loops is None else plot_loop_matrix(None, run.checks.loops)


FIGURES: dict[str, Callable[[Run], Any]] = {
    "map.png": lambda run: run.plot(),
    "side.png": lambda run: run.plot(plane="xz") if run.map.dim == 3 else None,
    "submaps.png": _submap_chain,
    "refined.png": _refined,
    "gps_residuals.png": lambda run: plot_gps_residuals(None, dict(run.gps)) if run.gps else None,
    "gps_innovations.png": _innovations,
    "loops.png": _loops,
}
"""Plots of a run by file name; each function returns axes, or None if there is nothing to draw."""


def save_figures(run: Run, folder: Path) -> list[Path]:
    """Write each plot of :data:`FIGURES` that has something to draw as a PNG file."""
    drawn = ((name, draw(run)) for name, draw in FIGURES.items())
    return [save_figure(ax, folder / name) for name, ax in drawn if ax is not None]
