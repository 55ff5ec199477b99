"""The surface of a finished run; its log is read once more along the solved path."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from graphslam.app.folders.generations import current_outputs
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.layer import Layer
from graphslam.app.run.run import Run
from graphslam.app.run.terrain import ScannedPath, read_terrain_file, scans_of_run
from graphslam.core import se3
from graphslam.core.errors import DataError, MissingDataError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.progress import Bar
from graphslam.core.range_scans import RangeScans
from graphslam.core.trajectory import Trajectory
from graphslam.maps.surface.layer import PieceId, SurfaceLayer
from graphslam.maps.surface.mesh import Mesh, position_sigma, save_mesh, vertex_owners, zero_set
from graphslam.maps.surface.piece import Scan, SurfaceConfig
from graphslam.maps.terrain.lines import lines_of_scans
from graphslam.maps.terrain.pyramid import ClassGrid

FORMAT = "graphslam.surface/1"
COLOURS = ("height", "piece", "session", "sigma", "terrain")
"""Colours of a surface: height, node that the vertex is attached to, session of that node, σ of the position due to
the node's pose, or terrain class below the vertex."""


@dataclass(frozen=True)
class RunSurface:
    """Result of :func:`read_surface`.

    Parameters
    ----------
    layer : SurfaceLayer
        One piece per node of the graph.
    owner : (v,)
        Node that each vertex is attached to, numbered over all sessions; −1 none.
    session : (v,)
        Session of that node, in the order of the paths; −1 none.
    sigma : (v,)
        σ of the vertex position due to the pose of that node [m]; NaN if unknown.
    read_s, seconds : float
        CPU time to read the scans into pieces, and to make the surface from the pieces.
    """

    layer: SurfaceLayer
    mesh: Mesh
    owner: npt.NDArray[np.int64]
    session: npt.NDArray[np.int64]
    sigma: Array
    scans: int
    stream: str
    read_s: float
    seconds: float

    def facts(self) -> dict[str, Any]:
        """Content of ``surface.json``."""
        known = self.sigma[np.isfinite(self.sigma)]
        return {
            "format": FORMAT,
            "stream": self.stream,
            "scans": self.scans,
            "sessions": int(self.session.max(initial=-1)) + 1,
            "pieces": len(self.layer.pieces),
            "bricks": len(self.layer),
            "vertices": len(self.mesh.vertices),
            "triangles": len(self.mesh.triangles),
            "area": self.mesh.area(),
            "sigma_median": float(np.median(known)) if len(known) else None,
            "sigma_most": float(np.max(known)) if len(known) else None,
            "memory_mb": self.layer.nbytes / 1e6,
            "read_s": self.read_s,
            "surface_s": self.seconds,
            "config": asdict(self.layer.config),
        }

    def colours(self, by: str, terrain: ClassGrid | None = None) -> npt.NDArray[np.uint8]:
        """Colours ``(v, 4)`` of the vertices by one of :data:`COLOURS`; by ``terrain`` needs the terrain of the run."""
        from graphslam.plots.surface import session_colours, vertex_colours
        from graphslam.plots.terrain import class_colours

        if by == "terrain":
            if terrain is None:
                raise MissingDataError("colour by terrain needs the terrain; make it with graphslam map --terrain")
            return class_colours(terrain.at(self.mesh.vertices))
        if by == "piece":  # neighbours along the path differ
            return vertex_colours(np.asarray((7.0 * self.owner) % 20.0, dtype=np.float64), "tab20")
        if by == "session":
            return session_colours(self.session)
        if by not in COLOURS:
            raise UnknownNameError("colour of a surface", by, COLOURS)
        return vertex_colours(self.mesh.vertices[:, 2] if by == "height" else self.sigma)


@dataclass(frozen=True)
class Surface(Layer):
    """The level-set surface of a 3-D run, as PLY, GLB and OBJ.

    Parameters
    ----------
    config : SurfaceConfig, optional
    colour : str
        One of :data:`COLOURS`.
    """

    name: ClassVar[str] = "surface"
    config: SurfaceConfig | None = None
    colour: str = "height"

    def __post_init__(self) -> None:
        if self.colour not in COLOURS:
            raise UnknownNameError("colour of a surface", self.colour, COLOURS)

    def make(self, run: Run, *, log: str | Path | SensorLog | None = None, progress: bool = True) -> RunSurface:
        """See :meth:`Layer.make`."""
        self.terrain_of(run)  # a missing terrain is refused before the work
        return read_surface([scanned_path(run, log=log)], config=self.config, progress=progress)

    def write(self, made: RunSurface, folder: OutputFiles, run: Run) -> list[Path]:
        """See :func:`write_surface`."""
        terrain, generation = self.terrain_of(run), run.report.get("generation")
        return write_surface(folder, made, colour=self.colour, terrain=terrain, generation=generation)

    def terrain_of(self, run: Run) -> ClassGrid | None:
        """The terrain of the run, if the surface is coloured by it."""
        if self.colour != "terrain" or run.folder is None:
            return None
        return read_terrain_file(current_outputs(run.folder))

    def draw(self, made: RunSurface, figures: Path, *, name: str) -> list[Path]:
        """See :func:`draw_surface`."""
        return draw_surface(made, figures, name=name)


def scanned_path(run: Run, *, log: str | Path | SensorLog | None = None) -> ScannedPath:
    """The scans of a 3-D run along its solved path."""
    name, scans = scans_of_run(run, log, what="a surface")
    m = run.map
    return ScannedPath(
        scans=scans, path=m.trajectory, node_times=m.node_times, node_poses=m.node_poses,
        node_covariances=m.node_covariances, stream=name,
    )  # fmt: skip


def read_surface(
    paths: Sequence[ScannedPath], *, config: SurfaceConfig | None = None, progress: bool = True
) -> RunSurface:
    """The surface of scans along paths in one frame, with one piece per node.

    Parameters
    ----------
    paths : sequence of ScannedPath
        One per session.
    """
    layer = SurfaceLayer(config)
    covariances: dict[PieceId, Array] = {}
    scans, first = 0, np.cumsum([0, *(len(p.node_poses) for p in paths)])
    begin = time.process_time()
    for start, p in zip(first.tolist(), paths):
        at = p.inside()
        owner = p.nodes_of(at)
        scans += len(at)
        for node in Bar(np.unique(owner).tolist(), name="surface", unit="node", shown=progress):
            layer.read(start + node, _scans(p.scans, at[owner == node], p.path), p.node_poses[node])
            if p.node_covariances is not None:
                covariances[start + node] = p.node_covariances[node]
    read_s = time.process_time() - begin
    streams = ", ".join(dict.fromkeys(p.stream for p in paths))
    begin = time.process_time()
    mesh = zero_set(layer.bricks(), layer.config.voxel)
    if not len(mesh.triangles):
        raise DataError("the scans show no surface", where=streams, wanted="dense points")
    seconds = time.process_time() - begin
    nodes = np.array([*layer.pieces, -1])[vertex_owners(mesh, layer)]
    session = np.where(nodes >= 0, np.searchsorted(first, nodes, side="right") - 1, -1)
    return RunSurface(
        layer, mesh, nodes, session, position_sigma(mesh, layer, covariances), scans, streams, read_s, seconds
    )


def _scans(scans: PointClouds | RangeScans, at: npt.NDArray[np.int64], path: Trajectory) -> Iterator[Scan]:
    if isinstance(scans, RangeScans):
        mine = np.zeros(len(scans.times), np.bool_)
        mine[at] = True
        lines = lines_of_scans(scans.take(mine), path, 0.0)
        met = np.isfinite(lines.points[..., 0])
        yield lines.points[met], np.broadcast_to(lines.origins[:, None], lines.points.shape)[met]
        return
    for k in at.tolist():
        T = se3.se3_compose(path.interpolate(scans.times[k : k + 1])[0], scans.T_base_sensor)
        points = np.asarray(scans.cloud(k), dtype=np.float64)
        yield se3.se3_transform(np.broadcast_to(T, (len(points), 7)), points), T[:3]


def write_surface(
    folder: OutputFiles,
    made: RunSurface,
    *,
    colour: str = "height",
    terrain: ClassGrid | None = None,
    generation: str | None = None,
) -> list[Path]:
    """Write ``surface.ply``, ``surface.glb``, ``surface.obj`` in the chosen colours, and ``surface.json``."""
    colours = made.colours(colour, terrain)
    files = [save_mesh(made.mesh, folder.path / f"surface{ending}", colours) for ending in (".ply", ".glb", ".obj")]
    folder.write_json("surface.json", {**made.facts(), "colour": colour, "generation": generation})
    return [*files, folder.path / "surface.json"]


def draw_surface(made: RunSurface, figures: Path, *, name: str) -> list[Path]:
    """Oblique views: by height, by session if there are several, and by σ of the position if it is known."""
    from graphslam.plots.save import save_figure
    from graphslam.plots.surface import plot_surface

    v, t = made.mesh.vertices, made.mesh.triangles
    ax = plot_surface(v, t, v[:, 2], label="height [m]", title=f"{name}: surface")
    out = [save_figure(ax, figures / "surface.png")]
    if np.any(made.session > 0):
        ax = plot_surface(v, t, (made.session + 1).astype(np.float64), label="session", title=f"{name}: by session")
        out.append(save_figure(ax, figures / "surface_sessions.png"))
    if np.any(np.isfinite(made.sigma)):
        ax = plot_surface(v, t, 1e3 * made.sigma, label="σ of the position [mm]", title=f"{name}: σ of the surface")
        out.append(save_figure(ax, figures / "surface_sigma.png"))
    return out
