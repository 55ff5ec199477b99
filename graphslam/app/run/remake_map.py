"""Make the fused map of a finished run again from its folder; the result is a new state of the folder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from graphslam.app.folders.generations import current_outputs, new_generation
from graphslam.app.hypotheses import (
    MinimumEntropyMap,
    minimum_entropy_loops,
    minimum_entropy_topology,
    write_minimum_entropy,
)
from graphslam.app.report.report import add_report
from graphslam.app.run.files import read_options
from graphslam.app.run.maps import draw_run_map, sensor_reach, write_run_map
from graphslam.app.run.outputs import read_run_folder, refined_submaps_of
from graphslam.app.run.run import Run
from graphslam.core.config import build_config, merge_options
from graphslam.core.errors import ConfigError, MissingDataError
from graphslam.core.lock import lock_folder
from graphslam.core.log import SensorLog
from graphslam.evidence.spilled_grid import load_spilled
from graphslam.io.submap_store import read_submaps
from graphslam.maps.refined import map_of_frames
from graphslam.maps.run_map import MapConfig, RunMap, has_maps, make_run_map


@dataclass(frozen=True)
class RemadeMap:
    """Result of :func:`remake_map`.

    Parameters
    ----------
    clearest : MinimumEntropyMap or None
        Choices of matches and loops, if requested.
    files, figures : list of Path
        Written files.
    """

    map: RunMap
    clearest: MinimumEntropyMap | None
    files: list[Path]
    figures: list[Path]


def remake_map(
    folder: str | Path,
    *,
    grid: bool = False,
    minimum_entropy: bool = False,
    hypotheses: int = 0,
    log: str | Path | SensorLog | None = None,
    low: float | None = None,
    high: float | None = None,
    progress: bool = True,
) -> RemadeMap:
    """Make the fused map of a run again, and write it with its pictures and the report page of the run.

    Parameters
    ----------
    grid : bool
        Write the evidence grid itself too.
    minimum_entropy : bool
        Solve the run with other choices of its matches and loops; keep the map of lowest entropy and the others.
    hypotheses : int
        Solve this number of topologies from the SegSLAM particles instead; the log is read once more.
    log : data set name, folder, or SensorLog; optional
        Where the run's log is now; default: its original location.
    low, high : float, optional
        Heights of the floor plans above the path [m]; default the run's.
    """
    if minimum_entropy and hypotheses:
        raise ConfigError("minimum_entropy and hypotheses exclude each other; give one of them")
    home = Path(folder)
    if not (current_outputs(home) / "run.json").is_file():
        read_run_folder(home)  # raises the error
    with lock_folder(home):
        run, made = map_of_folder(home, low=low, high=high)
        found = minimum_entropy_loops(run, made, progress=progress) if minimum_entropy else None
        if hypotheses:
            found = minimum_entropy_topology(run, hypotheses, log=log, progress=progress)
        with new_generation(home) as new:
            files = write_run_map(new, made, run.report.get("generation"))
            if grid:
                made.fused.grid.save(new.path / "map.grid.npz")
                files.append(new.path / "map.grid.npz")
            figures = draw_run_map(made, run.map.trajectory, new.figures, name=run.name, truth=run.truth_path)
            old = ["map.ply", "map.bt", "cloud.ply", "map*.pgm", "map*.yaml", "map.grid.npz", "figures/fused*.png"]
            if found is not None:
                files += write_minimum_entropy(new.path, found, bands=made.bands)
                old += ["clearest*", "alternatives/*"]
            new.adopt(drop=old)
            add_report(new)  # the report page shows the pictures and the choices
    files, figures = ([home / p.relative_to(new.path) for p in written] for written in (files, figures))
    return RemadeMap(made, found, files, figures)


def map_of_folder(path: str | Path, *, low: float | None = None, high: float | None = None) -> tuple[Run, RunMap]:
    """The run with its dense submaps, and its fused map made again from the folder alone.

    Parameters
    ----------
    low, high : float, optional
        Heights of the floor plans above the path [m]; default the run's.
    """
    run = read_run_folder(path)
    root = Path(path)
    refined = refined_submaps_of(run)
    submaps = refined or read_submaps(root, load_grid=load_spilled)
    if not has_maps(submaps):
        raise MissingDataError(
            f"{root}: the run has no evidence grids or clouds, so there is no dense map",
            got=f"front end {run.report.get('frontend')}",
            wanted="a run of a front end with dense maps: segslam, scan-window, lidar-odometry, rbpf-grid",
        )
    values = read_options(root)
    heights = {k: v for k, v in (("low", low), ("high", high)) if v is not None}
    config: MapConfig = build_config(MapConfig, merge_options(values.get("map", {}), heights), "map")
    frames = map_of_frames(run.map) if refined else run.map
    made = make_run_map(submaps, frames, reach=sensor_reach(values), config=config)
    return replace(run, submaps=submaps, fused=made), made
