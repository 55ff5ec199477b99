"""Export a run to other programs: evaluation, globe, GIS, navigation; built-in writers and plug-ins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from graphslam.app.export_bag import write_run_bag
from graphslam.app.folders.generations import name_inside, new_generation
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.remake_map import map_of_folder
from graphslam.app.run.run import Run
from graphslam.core.atomic import check_file_target
from graphslam.core.errors import ConfigError, MissingDataError
from graphslam.core.extras import import_extra
from graphslam.core.gaussian import ellipse_rings, largest_sigmas
from graphslam.core.geodesy import check_geodetic, enu_to_geodetic
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.lock import lock_folder
from graphslam.core.output_folder import check_folder_target, output_folder
from graphslam.core.plan_view import plan_pose
from graphslam.core.plugins import load_plugin
from graphslam.core.se3 import se3_transform
from graphslam.io.autoware import KIND as AUTOWARE
from graphslam.io.autoware import write_autoware
from graphslam.io.bag_writer import KIND as BAG
from graphslam.io.bag_writer import BagForm
from graphslam.io.cloud_writers import write_las
from graphslam.io.geographic import GeographicMap, write_geojson, write_kml
from graphslam.io.tum import embed_plane, write_kitti, write_tum
from graphslam.maps.export import save_maps
from graphslam.maps.run_map import RunMap

_RING = 36  # corners of the polygon of an ellipse
_FLOOR_PLANS = "set of floor plans"


def map_to_enu(run: Run, heading: float | None) -> Array:
    """``T_enu_map`` (3,) or (7,): pose of the map in an east-north frame at the datum.

    With GPS residuals, it is their GPS frame, whose origin is the datum. Otherwise the datum is the first base, and the
    user must give its heading.
    """
    scored = run.gps.get("all")
    if scored is not None:
        if heading is not None:
            raise ConfigError("the GPS of this run defines the heading; do not give one")
        return scored.T_gps_map
    if heading is None:
        raise ConfigError("this run has no GPS; give the heading of its first base, in degrees clockwise from north")
    if not np.isfinite(heading):
        raise ConfigError(f"heading = {heading}; wanted degrees clockwise from north")
    return np.array([0.0, 0.0, np.deg2rad(90.0 - heading)])


def geographic_map(
    run: Run, datum: tuple[float, float], *, heading: float | None = None, confidence: float = 0.95
) -> GeographicMap:
    """Path, landmarks with ellipses and GPS fixes of a run in latitude and longitude.

    Parameters
    ----------
    datum : (latitude, longitude)
        Of the origin of the GPS frame; of the first base in a run without GPS [deg, WGS 84].
    heading : float, optional
        Of the first base's x axis, degrees clockwise from north; for runs without GPS.
    confidence : float
        Of the ellipses.

    Of a 3-D run the path is projected to the ground plane; it has no landmarks.
    """
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence = {confidence}; wanted in (0, 1)")
    check_geodetic(*datum)
    T, m = map_to_enu(run, heading), run.map

    def place(points: Array) -> Array:
        return enu_to_geodetic(points, *datum)[..., :2]

    T = plan_pose(T) if len(T) == 7 else T
    centres, P = m.landmarks_in(T) if m.dim == 2 else (np.zeros((0, 2)), np.zeros((0, 2, 2)))
    scored = run.gps.get("all")
    fixes = np.zeros((0, 2)) if scored is None else (scored.points + scored.residuals)[:, :2]
    return GeographicMap(
        name=run.name,
        description=f"{len(run.submaps)} submaps, {len(m.landmarks)} landmarks; datum {datum[0]:.6f}, {datum[1]:.6f}",
        path=place(se2_transform(T, m.trajectory.positions[:, :2])),
        landmarks=place(centres),
        landmark_ids=m.landmark_ids,
        landmark_sigmas=largest_sigmas(P),
        ellipses=place(ellipse_rings(centres, P, confidence, _RING)),
        confidence=confidence,
        gps=place(fixes),
    )


def parse_datum(text: str) -> tuple[float, float]:
    """``LAT,LON`` in degrees."""
    try:
        latitude, longitude = (float(v) for v in text.split(","))
    except ValueError:
        raise ConfigError(f"datum {text!r}; wanted LAT,LON in degrees, as -33.88,151.19") from None
    return latitude, longitude


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Export options: ``(latitude, longitude)`` of the datum [deg], heading [deg], confidence of the ellipses."""

    datum: tuple[float, float] | None = None
    heading: float | None = None
    confidence: float = 0.95


@dataclass(frozen=True, slots=True)
class Writer:
    """An export format; other formats are registered under the entry point ``graphslam.writers``.

    Parameters
    ----------
    write : callable (run, path, options)
        Writes a finished :class:`~graphslam.app.run.run.Run`.
    file : str or None
        Default name in the folder of the run; None: it writes a folder, whose name is required.
    needs_datum : bool
    folder : str
        Kind of the folder (:func:`~graphslam.core.output_folder.check_folder_target`), which is then checked before
        the work.
    """

    write: Callable[[Run, Path, WriteOptions], Any]
    file: str | None
    needs_datum: bool = False
    folder: str = ""


def _globe(write: Callable[[Path, GeographicMap], Any], file: str) -> Writer:
    def written(run: Run, path: Path, o: WriteOptions) -> None:
        assert o.datum is not None
        write(path, geographic_map(run, o.datum, heading=o.heading, confidence=o.confidence))

    return Writer(written, file, needs_datum=True)


def _floor_plans(run: Run, path: Path, _: WriteOptions) -> None:
    made = _dense_map(run)
    with output_folder(path, _FLOOR_PLANS, last=("*.yaml",)) as folder:
        save_maps(made.fused.grid, folder, bands=made.bands)


def _placed_points(run: Run, o: WriteOptions) -> Array:
    """Points of the dense map: east, north, up of the datum; without one in the frame of the map."""
    points = map_points(run)
    if o.datum is None:
        return points
    check_geodetic(*o.datum)
    T = map_to_enu(run, o.heading)
    return se3_transform(embed_plane(T[None])[0] if len(T) == 3 else T, points)


def _tiles(run: Run, path: Path, o: WriteOptions) -> None:
    write_autoware(path, _placed_points(run, o), datum=o.datum)


def _las(run: Run, path: Path, o: WriteOptions) -> None:
    write_las(path, _placed_points(run, o))


def _bag(form: BagForm) -> Callable[[Run, Path, WriteOptions], Any]:
    def written(run: Run, path: Path, o: WriteOptions) -> None:
        write_run_bag(run, path, form, o.confidence, _dense_map(run, required=False))

    return written


WRITERS = {
    "tum": Writer(lambda run, path, _: write_tum(path, run.map.trajectory), "path.tum"),
    "kitti": Writer(lambda run, path, _: write_kitti(path, run.map.trajectory), "path.kitti.txt"),
    "kml": _globe(write_kml, "map.kml"),
    "geojson": _globe(write_geojson, "map.geojson"),
    "nav2": Writer(_floor_plans, None, folder=_FLOOR_PLANS),
    "las": Writer(_las, "map.las"),
    "autoware": Writer(_tiles, None, folder=AUTOWARE),
    "mcap": Writer(_bag("mcap"), "run.mcap"),
    "ros2": Writer(_bag("ros2"), None, folder=BAG),
}


def export(
    run: Run | str | Path,
    datum: tuple[float, float] | None = None,
    *,
    format: str = "tum",
    heading: float | None = None,
    confidence: float = 0.95,
    out: str | Path | None = None,
) -> Path:
    """Export a run for other programs.

    Parameters
    ----------
    run : Run, or folder of one
    datum : (latitude, longitude), optional
        Of the origin of the GPS frame; of the first base in a run without GPS [deg, WGS 84]. KML and GeoJSON need it;
        Autoware and LAS points are east, north, up of the datum, or without a datum in the frame of the map.
    format : str
        One of the following, or the name of a registered :class:`Writer`.
        ``tum`` or ``kitti``: the path at full rate, in the frame of the first base (input of evo). ``kml``,
        ``geojson``: path, landmarks with ellipses, fixes. ``nav2``: floor plans (map_server). ``autoware``: the map's
        points in tiles, with ``map_projector_info.yaml``. ``las``: the same points in one file. ``mcap`` (a file) and
        ``ros2`` (a bag folder): messages of ROS 2 in the frames ``map`` (first base) and ``base``, with the stamps of
        the log: ``/tf``, ``/path``, ``/pose`` with covariances, ``/markers`` (ellipses, landmarks, loop closures) and,
        with a dense map, ``/map`` and ``/points``.
    heading : float, optional
        Of the first base's x axis, degrees clockwise from north; with a datum, for runs without GPS.
    confidence : float
        Of the ellipses.
    out : path, optional
        Default: ``map.<format>`` (LAS: ``.laz`` compresses), ``path.<format>`` or ``run.mcap`` in the run's folder;
        ``nav2``, ``autoware`` and ``ros2`` write a folder, whose name is required.

    Returns
    -------
    Path
        The file, or the folder.

    Raises
    ------
    UnknownNameError
        There is no such format.
    ConfigError
        A datum or a heading is missing, or must not be given; no output path.
    MissingDataError
        A run without a dense map, for ``nav2``, ``las`` and ``autoware``.
    MissingExtraError
        The extra ``ros`` is not installed, for ``mcap`` and ``ros2``; or ``las``, for ``las``.
    RunFolderError, FormatError
        Not a finished run, or a damaged one.
    OutputError
        There is no place for the output.

    Examples
    --------
    >>> gs.export("runs/field", format="tum").name
    'path.tum'
    >>> gs.export("runs/field", (-33.8886, 151.1892), heading=90.0, format="geojson").name
    'map.geojson'
    """
    writer: Writer = WRITERS.get(format) or load_plugin("graphslam.writers", "format", format, WRITERS)
    if writer.needs_datum and datum is None:
        raise ConfigError(
            f"{format} needs a datum: latitude and longitude of the GPS frame's origin, or of the first base"
        )
    if out is not None and writer.file is not None:
        check_file_target(out)
    elif out is not None and writer.folder:
        check_folder_target(out, writer.folder)
    options = WriteOptions(datum, heading, confidence)
    opened = run if isinstance(run, Run) else read_run_folder(run)
    home = opened.folder
    if out is None and writer.file is None:
        raise ConfigError(f"{format} writes a folder: name it (out)")
    if out is None and home is None:
        raise ConfigError("this run has no folder; give a file name (out)")
    name = writer.file if out is None else None if home is None or writer.file is None else name_inside(home, out)
    if home is None or name is None:
        writer.write(opened, Path(out or ""), options)
        return Path(out or "")
    with lock_folder(home):
        if not isinstance(run, Run):
            opened = read_run_folder(home)  # read again under the lock
        with new_generation(home) as new:
            writer.write(opened, new.path / name, options)
            new.adopt()
    return home / name


@overload
def _dense_map(run: Run) -> RunMap: ...
@overload
def _dense_map(run: Run, *, required: bool) -> RunMap | None: ...
def _dense_map(run: Run, *, required: bool = True) -> RunMap | None:
    try:
        made = run.fused if run.folder is None or run.holds("fused") else map_of_folder(run.folder)[1]
    except MissingDataError:
        if required:
            raise
        made = None
    if made is None and required:
        raise MissingDataError("the run has no dense map", where=run.name, wanted="a front end with grids or clouds")
    return made


def map_points(run: Run) -> Array:
    """Points of a run's dense map ``(n, 3)`` in the frame of the first base [m]: centres of the occupied voxels."""
    points = np.asarray(_dense_map(run).fused.grid.occupied_cloud(), dtype=np.float64)
    return points if points.shape[1] == 3 else np.column_stack([points, np.zeros(len(points))])


def to_open3d(run: Run) -> Any:
    """The dense map of a run as a cloud of Open3D.

    Parameters
    ----------
    run : Run

    Returns
    -------
    open3d.geometry.PointCloud
        Centres of the occupied voxels in the frame of the first base [m].

    Raises
    ------
    MissingExtraError
        The extra ``open3d`` is not installed.
    MissingDataError
        The run has no dense map.

    Examples
    --------
    >>> court = gs.simulate("court", preset="light", seed=1, progress=False)
    >>> hall = gs.run(court.slice(0.0, 15.0), frontend="scan-window", progress=False)
    >>> len(gs.to_open3d(hall).points) > 100
    True
    """
    o3d = import_extra("open3d", "a cloud of Open3D")
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(map_points(run)))
