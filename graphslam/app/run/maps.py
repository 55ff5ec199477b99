"""The fused map of a run, with pieces placed along the solved nodes of the graph: its files, pictures and metrics.

No scan is read: front ends store a grid or a cloud with each submap, so that a map can be made again from the run
folder alone (``graphslam map``).
"""

from __future__ import annotations

import gc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.front_ends import options_of_scans
from graphslam.core.heap import trim_heap
from graphslam.maps.coarse import drawable_map
from graphslam.maps.export import save_maps, save_points
from graphslam.maps.run_map import RunMap


def write_run_map(folder: OutputFiles, run_map: RunMap, generation: str | None = None) -> list[Path]:
    """Write ``map.ply``, ``map.bt``, ``cloud.ply`` (of clouds), floor plans, ``fused_map.json``; returns the files."""
    made = save_maps(run_map.fused.grid, folder.path, bands=run_map.bands)
    if run_map.points is not None:
        made.append(save_points(run_map.points, folder.path / "cloud.ply"))
    folder.write_json("fused_map.json", {**run_map.facts(), "generation": generation})
    return [*made, folder.path / "fused_map.json"]


def draw_run_map(run_map: RunMap, path: Any, figures: Path, *, name: str, truth: Any = None) -> list[Path]:
    """Pictures of the fused map: from above, each level, and a vertical section.

    Parameters
    ----------
    path : Trajectory
        Solved.
    figures : Path
        Existing folder.
    name : str
        Name of the run.
    truth : Trajectory, optional
        Ground-truth path, drawn with the solved one.
    """
    from graphslam.plots.evidence import plot_heights, plot_section
    from graphslam.plots.fused_map import plot_cut, plot_storey
    from graphslam.plots.save import save_figure as saved

    def save(ax: Any, file: Path) -> Path:
        out = saved(ax, file)
        gc.collect()  # figures contain reference cycles and are large
        trim_heap()
        return out

    grid = drawable_map(run_map.fused.grid)
    if grid.dim == 2:
        ax = plot_section(grid, title=f"{name}: fused map")
        if truth is not None:
            ax.plot(*truth.positions.T, color="tab:blue", lw=0.8, label="truth")
        ax.plot(*path.positions.T, color="tab:red", lw=0.8, label="path")
        ax.legend(fontsize="small")
        return [save(ax, figures / "fused.png")]
    made = []
    for k, (band, (low, high)) in enumerate(run_map.bands.items()):
        title = f"{name}: level {k}, {low:.1f} to {high:.1f} m"
        made.append(
            save(plot_storey(grid, low, high, path=path, truth=truth, title=title), figures / f"fused_{band}.png")
        )
    top = max(high for _, high in run_map.bands.values())
    ax = plot_heights(grid, below=top, title=f"{name}: fused map from above, cut at {top:.1f} m")
    made.append(save(ax, figures / "fused_above.png"))
    ax = plot_cut(grid, path, truth=truth, title=f"{name}: fused map, cut from the side")
    made.append(save(ax, figures / "fused_cut.png"))
    return made


def sensor_reach(values: Mapping[str, Any]) -> float | None:
    """Maximum range of the beams in the front end [m], from the options of a run; None if it is not set."""
    reach = options_of_scans(values).get("steps", {}).get("max_range")
    return float(reach) if isinstance(reach, (int, float)) else None
