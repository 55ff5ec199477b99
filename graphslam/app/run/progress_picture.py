"""Picture of a run, drawn again while the run goes on."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.backend.back_end import Observer
from graphslam.core.atomic import atomic_open
from graphslam.core.errors import DataError, GraphSlamError
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of, remove_roll_pitch
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.dead_reckoning_baseline import dead_reckoned_path
from graphslam.evaluate.gps import gps_residuals
from graphslam.graph.factor_graph import FactorGraph

logger = logging.getLogger(__name__)

PICTURE = "figures/progress.png"
"""In the folder of a run, until the run has finished."""
SHARE = 0.05
"""Greatest share of the time that the pictures take."""
LOG_POSES = 2000
"""Number of dead-reckoned poses that are drawn."""


class ProgressPicture(Observer):
    """Draws the data so far: first the log's odometry and GPS, then segments or submaps.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / PICTURE
        self._truth: Trajectory | None = None
        self._log: SensorLog | None = None
        self._segments = 0
        self._next = 0.0  # not drawn again before this time of the clock [s]
        self._first, self._duration = 0.0, 0.0

    def log_read(self, log: SensorLog) -> None:
        """Keep the log for the first picture, and its true path for all."""
        self._first, self._duration = log.interval[0], log.duration
        if log.truth is not None and len(log.truth.trajectory):
            path = log.truth.trajectory
            T = group_of(path.poses).inverse(remove_roll_pitch(path.poses[0]))
            self._truth = path.transformed(T)  # in the frame of the first base, as the map
        self._log = log

    def stage(self, name: str) -> None:
        """Before the calibration: draw the path by the motion sensors, aligned to the GPS fixes, and the fixes."""
        if name == "calibration" and self._log is not None:
            self._draw(partial(plot_log, self._log))
            self._log = None

    def front_end_at(self, progress: Any) -> None:
        """SegSLAM: draw its segments if there is a new one."""
        if getattr(progress, "segments", 0) > self._segments:
            self._segments = progress.segments
            self._draw(lambda: self._plot_segments(progress))

    def submap_added(self, submap: Submap, graph: FactorGraph) -> None:
        """Draw the bases and landmarks of the graph."""
        self._draw(lambda: self._plot_graph(submap, graph))

    def remove(self) -> None:
        """Remove the picture, after the run has written its map."""
        self.path.unlink(missing_ok=True)

    def _plot_segments(self, at: Any) -> Any:
        from graphslam.plots.segments import plot_segments

        paths = at.paths()
        title = f"SegSLAM after {at.length:.0f} m, without loop closures (segments: {len(paths)})"
        return plot_segments(None, paths, truth=self._truth, title=title)

    def _plot_graph(self, submap: Submap, graph: FactorGraph) -> Any:
        from graphslam.plots.map import plot_map

        values = graph.values
        landmarks = values.landmarks if len(values.landmarks) else None
        ax = plot_map(trajectory=values.poses, landmarks=landmarks, truth=self._truth)
        done = submap.interval[1] - self._first
        title = f"{done:.0f} of {self._duration:.0f} s: graph of {len(graph.submaps)} submaps, not yet final"
        ax.set_title(title, fontsize="medium")
        return ax

    def _draw(self, plot: Callable[[], Any]) -> None:
        began = time.monotonic()
        if began < self._next:
            return
        try:
            ax = plot()
        except GraphSlamError as error:  # a picture must not end the run
            logger.warning("%s was not drawn: %s", self.path, error)
            return
        if ax is None:
            return
        from graphslam.plots.save import figure_png

        first = not self.path.exists()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_open(self.path) as stream:
            stream.write(figure_png(ax))
        if first:
            logger.warning("see %s: drawn again during the run", self.path)
        else:  # the first one includes the start of Matplotlib
            self._next = time.monotonic() + (time.monotonic() - began) / SHARE


def plot_log(log: SensorLog) -> Any:
    """Axes with the dead-reckoned path and the GPS fixes of a log; None if it has neither.

    The path is aligned to the fixes. Without fixes it starts in the origin.
    """
    from graphslam.plots.map import plot_map

    path = dead_reckoned_path(log, np.linspace(*log.interval, LOG_POSES))
    gps = next((s for s in log.streams.values() if isinstance(s, Gps) and len(s.times)), None)
    fixes = None if gps is None else gps.positions[:, :2] - gps.positions[0, :2]
    if path is not None and gps is not None:
        try:
            found = gps_residuals(path, gps)
        except DataError:  # fewer than two fixes on the path
            pass
        else:
            path = path.transformed(found.T_gps_map - np.array([*gps.positions[0, :2], 0.0]))
    if path is None and fixes is None:
        return None
    ax = plot_map(dead_reckoning=path, gps=fixes)
    ax.set_title(f"{log.name}: the log, before the first submap", fontsize="medium")
    return ax
