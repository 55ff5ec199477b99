"""Figures of a run, written as PNG files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

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
    """Submaps with the paths that their inner nodes have bent, where they have any."""
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


def save_figures(run: Run, folder: Path) -> list[Path]:
    """Map, submap chain, and GPS residuals, innovations and loops where there are any, as PNG files."""
    made = [save_figure(run.plot(), folder / "map.png")]
    submaps, bases = _as_solved(run), run.map.base_poses
    if run.map.dim == 3:
        made.append(save_figure(run.plot(plane="xz"), folder / "side.png"))
        submaps, bases = [plan_submap(s) for s in submaps], plan_pose(bases)
    chain = plot_submap_chain(None, submaps, bases, title=f"{run.name}: submaps at their solved poses")
    made.append(save_figure(chain, folder / "submaps.png"))
    if run.graph_path is not None:
        ax = plot_before_after(None, run.graph_path, run.map.trajectory, truth=run.truth_path)
        made.append(save_figure(ax, folder / "refined.png"))
    if run.gps:
        made.append(save_figure(plot_gps_residuals(None, dict(run.gps)), folder / "gps_residuals.png"))
    if run.checks is not None and run.checks.gps is not None:
        made.append(save_figure(plot_innovations(None, run.checks.gps), folder / "gps_innovations.png"))
    if run.checks is not None and run.checks.loops is not None:
        made.append(save_figure(plot_loop_matrix(None, run.checks.loops), folder / "loops.png"))
    return made
