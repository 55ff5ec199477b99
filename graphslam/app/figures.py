"""The pictures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.run import Run
from graphslam.core.geometry import rotation2, se2_transform
from graphslam.core.log import Truth
from graphslam.core.trajectory import Trajectory
from graphslam.plots.map import plot_map
from graphslam.plots.save import save
from graphslam.plots.submaps import plot_submap_chain
from graphslam.plots.trajectory import plot_gps_residuals
from graphslam.plots.without_truth import plot_innovations, plot_loop_matrix

# A dead-reckoned path this many times larger than the map would shrink the map to a dot.
_MAX_STRETCH = 2.5


def draw_map(run: Run, ax: Any = None) -> Any:
    """Map with path, landmarks and 95 % ellipses, GPS and truth.

    In the GPS frame (east, north) where fixes were scored, else in the frame of the first base.
    """
    m = run.map
    fixes, T = None, np.zeros(3)
    scored = run.gps.get("all")
    if scored is not None:
        fixes, T = scored.points + scored.residuals, scored.T_gps_map
    R = rotation2(T[2])
    truth = None
    if run.truth is not None:
        path = run.truth_path
        if path is None:
            path = Trajectory(m.node_times, np.vstack([np.zeros((1, 3)), run.truth.exit_poses]))
        truth = Truth(path.transformed(T), run.truth.landmark_ids, se2_transform(T, run.truth.landmarks))
    title = f"{run.name}: {len(run.submaps)} submaps, {len(m.landmarks)} landmarks"
    if scored is not None:
        title += f", GPS RMSE {scored.statistics.rmse:.2f} m"
    reckoned = _fitting(run.dead_reckoning, m.trajectory)
    axes = plot_map(
        ax,
        trajectory=m.trajectory.transformed(T),
        landmarks=se2_transform(T, m.landmarks),
        covariances=R @ m.landmark_covariances @ R.T,
        gps=fixes,
        truth=truth,
        dead_reckoning=None if reckoned is None else reckoned.transformed(T),
        pose_ellipses=12,
        title=title,
    )
    if scored is not None:
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
    return axes


def _fitting(path: Trajectory | None, beside: Trajectory) -> Trajectory | None:
    """The path, if it does not dwarf the one it is drawn beside."""
    if path is None:
        return None
    own, other = np.ptp(path.positions, axis=0).max(), np.ptp(beside.positions, axis=0).max()
    return path if own <= _MAX_STRETCH * max(other, 1.0) else None


def save_figures(run: Run, folder: Path) -> list[Path]:
    """Map, submap chain, and GPS residuals, innovations and loops where there are any, as PNG files."""
    made = [save(draw_map(run), folder / "map.png")]
    chain = plot_submap_chain(None, run.submaps, run.map.node_poses, title=f"{run.name}: submaps at their solved poses")
    made.append(save(chain, folder / "submaps.png"))
    if run.gps:
        made.append(save(plot_gps_residuals(None, dict(run.gps)), folder / "gps_residuals.png"))
    if run.checks is not None and run.checks.gps is not None:
        made.append(save(plot_innovations(None, run.checks.gps), folder / "gps_innovations.png"))
    if run.checks is not None and run.checks.loops is not None:
        made.append(save(plot_loop_matrix(None, run.checks.loops), folder / "loops.png"))
    return made
