"""The terrain of a finished run; its log is read once more along the solved path."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.files import read_options
from graphslam.app.run.layer import Layer
from graphslam.app.run.run import Run
from graphslam.app.run.source import log_of_run
from graphslam.core import se3
from graphslam.core.atomic import read_json, read_npz, write_npz
from graphslam.core.errors import DataError, FormatError, MissingDataError, RunFolderError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.npz import floats, ints
from graphslam.core.point_clouds import PointClouds
from graphslam.core.progress import Bar
from graphslam.core.range_scans import RangeScans
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.spilled_grid import load_spilled
from graphslam.io.submap_store import read_submaps
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.moving import MovedObjects, moving_points
from graphslam.maps.terrain.ground import common_up, ground_plane, level_rotation
from graphslam.maps.terrain.layer import TerrainLayer
from graphslam.maps.terrain.lines import ScanLines, lines_of_clouds, lines_of_scans
from graphslam.maps.terrain.plan import cost_map, save_cost_map
from graphslam.maps.terrain.pyramid import ClassGrid, TerrainClass, TerrainMap
from graphslam.maps.terrain.tables import read_tables
from graphslam.maps.terrain.vehicle import LineSensor, Vehicle

FORMAT = "graphslam.terrain/1"
Ints = npt.NDArray[np.int64]
_EVERY_POINT = 7
"""Every n-th point is used to find the ground."""
_SAMPLE = 60
"""Number of scans for the up direction and the approximate height of the scanner."""
_AROUND, _LOOK = 6, 3
"""The scanner height is the median over every third scan up to 6 scans before and after."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScannedPath:
    """Scans along a solved path.

    Parameters
    ----------
    path : Trajectory
        ``T_world_base``, 3-D.
    node_times, node_poses : (k,), (k, 7)
        In time order; a scan is attached to the last node before it.
    node_covariances : (k, 6, 6), optional
        In the right tangent of each node.
    """

    scans: PointClouds | RangeScans
    path: Trajectory
    node_times: Array
    node_poses: Array
    node_covariances: Array | None = None
    stream: str = "scans"

    def inside(self) -> Ints:
        """Indices of the scans within the time of the path."""
        times = self.scans.times
        inside = (times >= self.path.times[0]) & (times <= self.path.times[-1])
        if isinstance(self.scans, RangeScans):  # beams are measured after the time stamp of their line
            inside &= times + self.scans.beam_times.max() <= self.path.times[-1]
        at = np.flatnonzero(inside)
        if not len(at):
            raise DataError("no scan lies within the solved path in time", where=self.stream)
        return at

    def nodes_of(self, at: Ints) -> Ints:
        """Index of the node that each of these scans is attached to."""
        node = np.searchsorted(self.node_times, self.scans.times[at], side="right") - 1
        return np.clip(node, 0, len(self.node_poses) - 1)


@dataclass(frozen=True)
class RunTerrain:
    """Result of :func:`read_terrain`.

    Parameters
    ----------
    layer : TerrainLayer
        One piece per node of the graph, in the level frame.
    rotation : (3, 3)
        From the frame of the run to the level frame.
    path : (n, 3)
        Positions of the nodes in the level frame [m].
    missing : int
        Scans in which the ground was not found; the height of their neighbours is used.
    moved : int
        Points of the scans that were removed because they are on a moving object.
    read_s, seconds : float
        CPU time to read the lines into pieces, and to make the map from the pieces.
    """

    layer: TerrainLayer
    map: TerrainMap
    rotation: Array
    path: Array
    missing: int
    moved: int
    read_s: float
    seconds: float
    scans: int
    lines: int
    stream: str

    def facts(self) -> dict[str, Any]:
        """Content of ``terrain.json``."""
        sensor, vehicle, tables = self.layer.sensor, self.layer.vehicle, self.layer.tables
        cells = {k.name.lower(): int(np.count_nonzero(self.map.classes == k)) for k in TerrainClass}
        return {
            "format": FORMAT,
            "stream": self.stream,
            "scans": self.scans,
            "lines": self.lines,
            "scans_without_ground": self.missing,
            "points_moved": self.moved,
            "pieces": len(self.layer.pieces),
            "rotation_level_run": self.rotation.tolist(),
            "sensor": {**asdict(sensor), "band_edges": sensor.band_edges().tolist()},
            "vehicle": asdict(vehicle),
            "threshold": tables.threshold,
            "tables": {k: tables.provenance.get(k) for k in ("made_by", "laser", "seeds")},
            "cell": self.map.cell,
            "cells": cells,
            "holes_are_seen_up_to": sensor.hole_reach(vehicle),
            "speed_bound": sensor.speed_bound(vehicle),
            "read_s": self.read_s,
            "map_s": self.seconds,
        }


@dataclass(frozen=True)
class Terrain(Layer):
    """Traversability, from the point clouds of a 3-D run, or else from its line laser.

    Parameters
    ----------
    sensor_height : float, optional
        Of the scanner above the ground [m]; default: estimated from the ground in point clouds. For a line laser it is
        the height of the mount above the base, which assumes that the base is on the ground.
    """

    name: ClassVar[str] = "terrain"
    sensor_height: float | None = None

    def make(self, run: Run, *, log: str | Path | SensorLog | None = None, progress: bool = True) -> RunTerrain:
        """See :meth:`Layer.make`."""
        name, scans = scans_of_run(run, log, what="terrain")
        return read_terrain(
            scans, run.map, moved=_moved(run) if isinstance(scans, PointClouds) else None,
            stream=name, sensor_height=self.sensor_height, progress=progress,
        )  # fmt: skip

    def write(self, made: RunTerrain, folder: OutputFiles, run: Run) -> list[Path]:
        """See :func:`write_terrain`."""
        return write_terrain(folder, made, generation=run.report.get("generation"))

    def draw(self, made: RunTerrain, figures: Path, *, name: str) -> list[Path]:
        """Pictures of the classes, and of free, hazard and unknown cells."""
        from graphslam.plots.save import save_figure
        from graphslam.plots.terrain import plot_terrain

        path = made.path[:, :2]
        out = [save_figure(plot_terrain(made.map, path=path, title=f"{name}: terrain"), figures / "terrain.png")]
        ax = plot_terrain(made.map, plain=True, title=f"{name}: free, hazard, unknown")
        return [*out, save_figure(ax, figures / "terrain_plain.png")]


def scans_of_run(run: Run, log: str | Path | SensorLog | None, *, what: str) -> tuple[str, PointClouds | RangeScans]:
    """Name and records of the scans of a 3-D run, from its log; errors name the missing part."""
    if run.folder is None:
        raise RunFolderError("the run has no folder to read its configuration from; wanted a run with out=…")
    if run.map.dim != 3:
        raise DataError(f"{what} is read along a path in space", got="a run in the plane", wanted="a run in space")
    settings = read_options(run.folder)["run"]
    source = log_of_run(settings, log)
    name = source.of_type(PointClouds) or source.of_type(RangeScans)
    scans = source.streams.get(name) if name else None
    if name is None or not isinstance(scans, PointClouds | RangeScans):
        raise MissingDataError(
            f"no scans to read {what} from", where=source.name, got="no such stream",
            wanted="a stream of point clouds, or of lines in space",
        )  # fmt: skip
    return name, scans


def read_terrain(
    scans: PointClouds | RangeScans,
    solved: GlobalMap,
    *,
    moved: Mapping[int, Array] | None = None,
    stream: str = "scans",
    sensor_height: float | None = None,
    progress: bool = True,
) -> RunTerrain:
    """Terrain of scans along a path, with one piece per node.

    Parameters
    ----------
    solved : GlobalMap
        3-D; the z axis of the world points upwards within 20°. A scan is attached to the last node before it.
    moved : mapping, optional
        By node index: points ``(m, 3)`` of objects that moved during that submap, in the world frame. Points of
        the clouds of that time that are on these objects are removed.
    stream, sensor_height, progress
        Name of the scans; see :class:`Terrain`; show a progress bar.
    """
    path, node_times, node_poses = solved.trajectory, solved.node_times, solved.node_poses
    scanned = ScannedPath(scans=scans, path=path, node_times=node_times, node_poses=node_poses, stream=stream)
    at = scanned.inside()
    if isinstance(scans, PointClouds):
        rotation, height, step = _ground_of_clouds(scans, at, path, sensor_height)
    else:
        rotation = np.eye(3)
        _, rays = scans.head_rays()
        step = float(np.median(np.arccos(np.clip(np.sum(rays[0, 1:] * rays[0, :-1], axis=-1), -1.0, 1.0))))
        height = float(scans.T_base_mount[2] if sensor_height is None else sensor_height)
    sensor = LineSensor(height=height, beam_step=step, sweep_time=_sweep(scans, at))
    layer = TerrainLayer(read_tables(), Vehicle(), sensor)
    turn = np.concatenate([np.zeros(3), se3.matrix_to_quat(rotation)])
    level = Trajectory(path.times, se3.se3_compose(np.broadcast_to(turn, path.poses.shape), path.poses))
    poses = se3.se3_compose(np.broadcast_to(turn, node_poses.shape), node_poses)
    owner = scanned.nodes_of(at)
    begin, count = time.process_time(), 0
    nodes = np.unique(owner)
    turns = None
    if isinstance(scans, PointClouds):
        places = {k: MovedObjects(np.asarray(se3.se3_transform(turn, p))) for k, p in (moved or {}).items()}
        # a scan at the time of a node belongs to the submap that ends there
        ends = np.searchsorted(node_times, scans.times[at], side="left") - 1
        moving = [places.get(k) for k in np.maximum(ends, 0).tolist()]
        turns = _Turns(scans, at, level, height, sensor_height is None, moving)
    for node in Bar(nodes.tolist(), name="terrain", unit="node", shown=progress):
        mine = at[owner == node]
        if turns is not None:
            lines = [turns.lines(k) for k in mine.tolist()]
        else:
            assert isinstance(scans, RangeScans)
            lines = [_lines(scans, mine, level, height)]
        count += sum(len(part) for part in lines)
        layer.read(node, lines, poses[node])
    read_s = time.process_time() - begin
    begin = time.process_time()
    found = layer.classify()
    seconds = time.process_time() - begin
    missing, left_out = (turns.missing, turns.left_out) if turns else (0, 0)
    return RunTerrain(layer, found, rotation, poses[:, :3], missing, left_out, read_s, seconds, len(at), count, stream)


def _sweep(scans: PointClouds | RangeScans, at: Ints) -> float:
    """Time for one full coverage of the field of view [s]; for a panning line, until it reverses."""
    if isinstance(scans, RangeScans) and scans.spin_rate is not None:
        turns = np.flatnonzero(np.diff(np.sign(scans.spin_rate[at])) != 0)
        if len(turns) > 1:
            return float(np.median(np.diff(scans.times[at][turns])))
    return float(np.median(np.diff(scans.times[at]))) if len(at) > 1 else 1.0


def _posed(scans: PointClouds, k: int, path: Trajectory) -> tuple[Array, Array]:
    """Points of a scan, and position of the scanner, in the frame of the path."""
    T = se3.se3_compose(path.interpolate(scans.times[k : k + 1])[0], scans.T_base_sensor)
    return se3.se3_move(T, np.asarray(scans.cloud(k), dtype=np.float64)), T[:3]


def _ground_of_clouds(
    scans: PointClouds, at: Ints, path: Trajectory, height: float | None
) -> tuple[Array, float, float]:
    """Rotation to a level frame, height of the scanner and angle between its beams, from a sample of the scans."""
    some = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), _SAMPLE)).astype(np.int64))]
    posed = [_posed(scans, k, path) for k in some.tolist()]
    up, about = np.array([0.0, 0.0, 1.0]), height
    for _ in range(2):
        planes = [ground_plane(points[::_EVERY_POINT], origin, up, about) for points, origin in posed]
        up = common_up(planes)
        if about is None:
            about = float(np.median([p.below for p in planes if p is not None]))
    assert about is not None
    return level_rotation(up), about, _beam_step(*posed[len(posed) // 2])


def _moved(run: Run) -> dict[int, Array]:
    """Points of moving objects in the world frame, by node, for a run whose submaps have grids and clouds."""
    if run.folder is None or not any(s.cloud is not None for s in run.submaps):
        return {}
    submaps = read_submaps(run.folder, load_grid=load_spilled)
    bases = np.asarray(run.map.node_poses)[: len(submaps)]
    return {
        k: np.asarray(se3.se3_transform(bases[k], s.cloud.points[mask]))
        for k, (s, mask) in enumerate(zip(submaps, moving_points(submaps, bases)))
        if s.cloud is not None and mask.any()
    }


class _Turns:
    """Lines of clouds, each decoded once; the height above the ground is the median over neighbouring scans.

    Parameters
    ----------
    at : (k,)
        Scans to read, in this order.
    level : Trajectory
        In the level frame.
    height : float
        Approximate height of the scanner above the ground [m].
    look : bool
        Estimate the height from the scans.
    moving : list of k MovedObjects or None
        Moving objects at the time of each scan, in the level frame.
    """

    def __init__(
        self,
        scans: PointClouds,
        at: Ints,
        level: Trajectory,
        height: float,
        look: bool,
        moving: Sequence[MovedObjects | None],
    ) -> None:
        self.scans, self.level, self.height, self.look, self.moving = scans, level, height, look, moving
        self.coming = deque(at.tolist())
        self.read: dict[int, tuple[Array, Array]] = {}
        self.below: dict[int, float] = {}
        self.place = {k: i for i, k in enumerate(at.tolist())}
        self.missing = self.left_out = 0

    def lines(self, k: int) -> ScanLines:
        """Lines of one scan."""
        i = self.place[k]
        while self.coming and self.place[self.coming[0]] <= i + (_AROUND if self.look else 0):
            self._decode(self.coming.popleft())
        points, origin = self.read.pop(k)
        for old in [j for j in self.below if j < i - _AROUND]:
            if len(self.below) > 1:  # if no ground is found for long, the last height is used
                del self.below[old]
        height = float(np.median(list(self.below.values()))) if self.below else self.height
        return lines_of_clouds(points, origin, float(origin[2] - height))

    def _decode(self, k: int) -> None:
        points, origin = _posed(self.scans, k, self.level)
        objects = self.moving[self.place[k]]
        if objects is not None:
            moved = objects.parts(points)
            points, self.left_out = points[~moved], self.left_out + int(np.count_nonzero(moved))
        self.read[k] = points, origin
        if self.look and self.place[k] % _LOOK == 0:
            plane = ground_plane(points[::_EVERY_POINT], origin, np.array([0.0, 0.0, 1.0]), self.height)
            if plane is None:
                self.missing += 1
            else:
                self.below[self.place[k]] = plane.below


def _beam_step(points: Array, origin: Array) -> float:
    """Median angle between neighbouring beams below the horizon, within columns of half a degree [rad]."""
    d = points - origin
    column = np.floor(np.arctan2(d[:, 1], d[:, 0]) * 720.0 / (2.0 * np.pi)).astype(np.int64)
    elevation = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))
    low = elevation < -0.03
    order = np.lexsort((elevation[low], column[low]))
    gap = np.diff(elevation[low][order])[np.diff(column[low][order]) == 0]
    gap = gap[gap > 1e-3]  # smaller gaps are between neighbours in azimuth
    return float(np.clip(np.median(gap), 2e-3, 0.1)) if len(gap) else 0.01


def _lines(scans: RangeScans, at: Ints, level: Trajectory, height: float) -> ScanLines:
    mine = np.zeros(len(scans.times), np.bool_)
    mine[at] = True
    return lines_of_scans(scans.take(mine), level, height)


def read_terrain_file(folder: Path) -> ClassGrid:
    """Read the terrain of a run folder."""
    facts = read_json(folder / "terrain.json", fmt=FORMAT, shape={"rotation_level_run": [(float,) * 3]})
    a = read_npz(
        folder / "terrain.npz", fmt=FORMAT, fields={"origin": floats(2), "cell": floats(), "classes": ints("ny", "nx")}
    )
    rotation = np.array(facts["rotation_level_run"], dtype=np.float64)
    known = len(a["classes"]) == 0 or bool(a["classes"].min() >= 0 and a["classes"].max() < len(TerrainClass))
    if rotation.shape != (3, 3) or not a["cell"] > 0 or not known:
        raise FormatError("terrain that does not fit", where=str(folder / "terrain.npz"))
    return ClassGrid(a["origin"], float(a["cell"]), a["classes"].astype(np.int8), rotation)


def write_terrain(folder: OutputFiles, made: RunTerrain, *, generation: str | None = None) -> list[Path]:
    """Write ``terrain.npz`` (classes, probabilities, ground), ``terrain.json``, a cost map ``terrain_cost.yaml``."""
    found = made.map
    target = folder.path / "terrain.npz"
    arrays = {
        "classes": found.classes,
        "probability": found.probability.astype(np.float32),
        "ground": found.ground.astype(np.float32),
        "roughness": found.roughness.astype(np.float32),
        "band": found.band,
        "provisional": found.provisional,
    }
    write_npz(target, {"format": FORMAT, "origin": found.origin, "cell": found.cell, **arrays})
    folder.write_json("terrain.json", {**made.facts(), "generation": generation})
    costs = save_cost_map(cost_map(found, made.layer.vehicle), folder.path / "terrain_cost.yaml")
    return [target, folder.path / "terrain.json", *costs]
