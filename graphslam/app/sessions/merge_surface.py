"""The surface of several sessions in one frame, from the scans of each along its path in the merged graph."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from graphslam.app.run.surface import RunSurface, ScannedPath, read_surface, scanned_path
from graphslam.app.sessions.merge_dense import MergedSubmaps, PlacedSession
from graphslam.app.sessions.merged_map import MergedMap
from graphslam.core.errors import ConfigError
from graphslam.core.log import SensorLog
from graphslam.maps.surface.piece import SurfaceConfig


def surface_of_sessions(
    merged: MergedMap | MergedSubmaps,
    *,
    logs: Sequence[str | Path | SensorLog] | None = None,
    config: SurfaceConfig | None = None,
    progress: bool = True,
) -> RunSurface:
    """Read the logs of merged runs once more, along their paths in the merged graph.

    Parameters
    ----------
    merged : MergedMap or MergedSubmaps
        Of 3-D runs.
    logs : sequence of data set name, folder, or SensorLog; optional
        Where the logs of the runs are now, in the order of the sessions; default: their original locations.
    """
    if not isinstance(merged, MergedSubmaps):
        raise ConfigError("a surface of runs that are merged by landmarks; wanted runs of dense submaps in space")
    places: Sequence[str | Path | SensorLog | None] = logs or [None] * len(merged.sessions)
    if len(places) != len(merged.sessions):
        raise ConfigError(f"{len(places)} logs of {len(merged.sessions)} sessions; wanted one of each")
    paths = [_placed_path(s, log) for s, log in zip(merged.sessions, places)]
    return read_surface(paths, config=config, progress=progress)


def _placed_path(s: PlacedSession, log: str | Path | SensorLog | None) -> ScannedPath:
    own = scanned_path(s.run, log=log)
    path = s.trajectory
    node_times = np.clip(own.node_times, path.times[0], path.times[-1])
    return ScannedPath(
        scans=own.scans,
        path=path,
        node_times=node_times,
        node_poses=path.interpolate(node_times),
        node_covariances=None if path.covariances is None else path.interpolate_covariance(node_times),
        stream=own.stream,
    )
