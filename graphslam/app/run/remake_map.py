"""The fused map of a finished run, made again from its folder, as a new state of the folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from graphslam.app.folders.generations import new_generation, outputs
from graphslam.app.folders.lock import locked
from graphslam.app.hypotheses.runs import Clearest, clearest_of_run, write_clearest
from graphslam.app.report.report import report_beside
from graphslam.app.run.maps import RunMap, draw_run_map, map_of_folder, with_heights, write_run_map
from graphslam.app.run.outputs import open_run


@dataclass(frozen=True)
class RemadeMap:
    """What was made.

    Parameters
    ----------
    map : RunMap
    clearest : Clearest or None
        Choices of matches and loops, where they were asked for.
    files, figures : list of Path
        Written.
    """

    map: RunMap
    clearest: Clearest | None
    files: list[Path]
    figures: list[Path]


def remake_map(
    folder: str | Path,
    *,
    grid: bool = False,
    minimum_entropy: bool = False,
    low: float | None = None,
    high: float | None = None,
    progress: bool = True,
) -> RemadeMap:
    """Make the fused map of a run again, and write it with its pictures and the page of the run.

    Parameters
    ----------
    folder : path
    grid : bool
        Write the evidence grid itself too.
    minimum_entropy : bool
        Solve the run with other choices of its matches and loops, and keep the clearest map and the others.
    low, high : float, optional
        Heights of the floor plans above the path [m]; default the run's.
    progress : bool

    Raises
    ------
    RunFolderError
        Not a finished run, or another process is writing into it.
    MissingDataError
        A run without evidence grids.
    FormatError, DataError
    """
    home = Path(folder)
    if not (outputs(home) / "run.json").is_file():
        open_run(home)  # says what is wrong
    with locked(home):
        run, made = map_of_folder(home, heights=lambda c: with_heights(c, low, high))
        found = clearest_of_run(run, made, progress=progress) if minimum_entropy else None
        with new_generation(home) as new:
            files = write_run_map(new, made, run.report.get("generation"))
            if grid:
                made.fused.grid.save(new.path / "map.grid.npz")
                files.append(new.path / "map.grid.npz")
            figures = draw_run_map(made, run.map.trajectory, new.figures, name=run.name, truth=run.truth_path)
            old = ["map.ply", "map.bt", "map*.pgm", "map*.yaml", "map.grid.npz", "figures/fused*.png"]
            if found is not None:
                files += write_clearest(new.path, found, bands=made.bands)
                old += ["clearest*", "alternatives/*"]
            new.adopt(drop=old)
            report_beside(new)  # the page of the run shows the pictures and the choices
    files, figures = ([home / p.relative_to(new.path) for p in written] for written in (files, figures))
    return RemadeMap(made, found, files, figures)
