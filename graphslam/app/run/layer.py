"""Layers over the map of a finished run (terrain, surface, …), computed from the log along the solved path."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from graphslam.app.folders.generations import current_outputs, new_generation
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.report.report import add_report
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.run import Run
from graphslam.core.lock import lock_folder
from graphslam.core.log import SensorLog


class Layer(ABC):
    """One kind of layer with its options.

    Attributes
    ----------
    name : str
        Prefix of its files: ``NAME*`` and ``figures/NAME*.png``.
    """

    name: ClassVar[str]

    @abstractmethod
    def make(self, run: Run, *, log: str | Path | SensorLog | None = None, progress: bool = True) -> Any:
        """Read the log of a 3-D run once more, along its solved path.

        Parameters
        ----------
        log : data set name, folder, or SensorLog; optional
            Where the run's log is now; default: its original location.

        Returns
        -------
        object
            With ``facts()``, a mapping for JSON.
        """

    @abstractmethod
    def write(self, made: Any, folder: OutputFiles, run: Run) -> list[Path]:
        """Write its files."""

    @abstractmethod
    def draw(self, made: Any, figures: Path, *, name: str) -> list[Path]:
        """Write its pictures."""


def make_layer(
    folder: str | Path, layer: Layer, *, log: str | Path | SensorLog | None = None, progress: bool = True
) -> tuple[Any, list[Path], list[Path]]:
    """Make a layer of a finished run; write its files, its pictures and the report page of the run.

    Returns
    -------
    made, files, figures
    """
    home = Path(folder)
    if not (current_outputs(home) / "run.json").is_file():
        read_run_folder(home)  # raises the error
    with lock_folder(home):
        run = read_run_folder(home)
        made = layer.make(run, log=log, progress=progress)
        with new_generation(home) as new:
            files, figures = layer.write(made, new, run), layer.draw(made, new.figures, name=run.name)
            new.adopt(drop=[f"{layer.name}*", f"figures/{layer.name}*.png"])
            add_report(new)
    files, figures = ([home / p.relative_to(new.path) for p in written] for written in (files, figures))
    return made, files, figures
