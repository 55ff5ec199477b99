"""The pictures of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graphslam.core.geometry import se2_transform
from graphslam.core.log import Truth
from graphslam.core.plan_view import plan_pose, plan_submap
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.plots.map import plot_map
from graphslam.plots.paths import GRAPH, plot_paths
from graphslam.plots.refined import plot_before_after
from graphslam.plots.save import save
from graphslam.plots.submaps import plot_submap_chain
from graphslam.plots.trajectory import plot_gps_residuals
from graphslam.plots.without_truth import plot_innovations, plot_loop_matrix

if TYPE_CHECKING:
    from graphslam.app.run.run import Run

# A dead-reckoned path this many times larger than the map would shrink the map to a dot.
_MAX_STRETCH = 2.5


def draw_map(run: Run, ax: Any = None) -> Any:
    """Map with path, landmarks and 95 % ellipses, GPS and truth.

    In the GPS frame (east, north) where fixes were scored, else in the frame of the first base.
    """
    m = run.map
    if m.dim == 3:
        return _draw_paths(run, ax, "xy")
    fixes, T = None, np.zeros(3)
    scored = run.gps.get("all")
    if scored is not None:
        fixes, T = scored.points + scored.residuals, scored.T_gps_map
    landmarks, covariances = m.landmarks_in(T)
    truth = None
    if run.truth is not None:
        path = run.truth_path
        if path is None:
            path = Trajectory(m.base_times, np.vstack([np.zeros((1, 3)), run.truth.exit_poses]))
        truth = Truth(path.transformed(T), run.truth.landmark_ids, se2_transform(T, run.truth.landmarks))
    title = f"{run.name}: {len(run.submaps)} submaps, {len(m.landmarks)} landmarks"
    if scored is not None:
        title += f", GPS RMSE {scored.statistics.rmse:.2f} m"
    reckoned = _fitting(run.dead_reckoning, m.trajectory)
    axes = plot_map(
        ax,
        trajectory=m.trajectory.transformed(T),
        landmarks=landmarks,
        covariances=covariances,
        gps=fixes,
        truth=truth,
        dead_reckoning=None if reckoned is None else reckoned.transformed(T),
        before=None if run.graph_path is None else run.graph_path.transformed(T),
        pose_ellipses=12,
        title=title,
    )
    if scored is not None:
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
    return axes


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


def _draw_paths(run: Run, ax: Any, plane: str) -> Any:
    """A map in space: its path from above or from the side, with what it claims to know, truth and dead reckoning."""
    paths = {"path": run.map.trajectory}
    if run.graph_path is not None:
        paths[GRAPH] = Trajectory(run.graph_path.times, run.graph_path.poses)  # its ellipses would hide the map's
    reckoned = _fitting(run.dead_reckoning, run.map.trajectory)
    if reckoned is not None and reckoned.dim == 3:
        paths["dead reckoning"] = reckoned
    title = f"{run.name}: {len(run.submaps)} submaps, {len(run.map.node_poses)} nodes"
    return plot_paths(ax, paths, truth=run.truth_path, ellipses=12, plane=plane, title=title)


def _fitting(path: Trajectory | None, beside: Trajectory) -> Trajectory | None:
    """The path, if it does not dwarf the one it is drawn beside."""
    if path is None:
        return None
    own, other = np.ptp(path.positions, axis=0).max(), np.ptp(beside.positions, axis=0).max()
    return path if own <= _MAX_STRETCH * max(other, 1.0) else None


def save_figures(run: Run, folder: Path) -> list[Path]:
    """Map, submap chain, and GPS residuals, innovations and loops where there are any, as PNG files."""
    made = [save(draw_map(run), folder / "map.png")]
    submaps, bases = _as_solved(run), run.map.base_poses
    if run.map.dim == 3:
        made.append(save(_draw_paths(run, None, "xz"), folder / "side.png"))
        submaps, bases = [plan_submap(s) for s in submaps], plan_pose(bases)
    chain = plot_submap_chain(None, submaps, bases, title=f"{run.name}: submaps at their solved poses")
    made.append(save(chain, folder / "submaps.png"))
    if run.graph_path is not None:
        ax = plot_before_after(None, run.graph_path, run.map.trajectory, truth=run.truth_path)
        made.append(save(ax, folder / "refined.png"))
    if run.gps:
        made.append(save(plot_gps_residuals(None, dict(run.gps)), folder / "gps_residuals.png"))
    if run.checks is not None and run.checks.gps is not None:
        made.append(save(plot_innovations(None, run.checks.gps), folder / "gps_innovations.png"))
    if run.checks is not None and run.checks.loops is not None:
        made.append(save(plot_loop_matrix(None, run.checks.loops), folder / "loops.png"))
    return made
