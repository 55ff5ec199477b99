"""A run on the globe."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphslam.app.folders.generations import name_inside, new_generation
from graphslam.app.folders.lock import locked
from graphslam.app.run.outputs import open_run
from graphslam.app.run.run import Run
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.gaussian import ellipse_rings, largest_sigmas
from graphslam.core.geodesy import check_geodetic, enu_to_geodetic
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.plan_view import plan_pose
from graphslam.io.geographic import WRITERS, GeographicMap

_RING = 36  # corners of an ellipse


def map_to_enu(run: Run, heading: float | None) -> Array:
    """``T_enu_map`` (3,): the map in east and north from the datum.

    Where GPS fixes were scored, their frame is east and north and its origin is the datum. Else the datum is the first
    base, and only the user knows where it looked.

    Raises
    ------
    ConfigError
        A heading for a run that knows its own, or none for one that does not.
    """
    scored = run.gps.get("all")
    if scored is not None:
        if heading is not None:
            raise ConfigError("the GPS of this run says how its map lies: leave the heading out")
        return scored.T_gps_map
    if heading is None:
        raise ConfigError("this run has no GPS: give the heading of its first base, degrees clockwise from north")
    if not np.isfinite(heading):
        raise ConfigError(f"heading = {heading}; wanted degrees clockwise from north")
    return np.array([0.0, 0.0, np.deg2rad(90.0 - heading)])


def geographic_map(
    run: Run, datum: tuple[float, float], *, heading: float | None = None, confidence: float = 0.95
) -> GeographicMap:
    """Path, landmarks with ellipses and GPS fixes of a run in latitude and longitude.

    Parameters
    ----------
    run : Run
    datum : (latitude, longitude)
        Of the origin of the GPS frame; of the first base in a run without GPS [deg, WGS 84].
    heading : float, optional
        Of the first base's x axis, degrees clockwise from north; for runs without GPS.
    confidence : float
        Of the ellipses.

    A run in space is seen from above; it has no landmarks.

    Raises
    ------
    ConfigError, GeometryError
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
    """``LAT,LON`` in degrees.

    Raises
    ------
    ConfigError
    """
    try:
        latitude, longitude = (float(v) for v in text.split(","))
    except ValueError:
        raise ConfigError(f"datum {text!r}; wanted LAT,LON in degrees, as -33.88,151.19") from None
    return latitude, longitude


def export(
    run: Run | str | Path,
    datum: tuple[float, float],
    *,
    format: str = "kml",
    heading: float | None = None,
    confidence: float = 0.95,
    out: str | Path | None = None,
) -> Path:
    """Write a run as KML or GeoJSON; see :func:`geographic_map`.

    Parameters
    ----------
    out : path, optional
        Default: ``map.<format>`` in the run's folder.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    UnknownNameError
        There is no such format.
    ConfigError
        A heading is missing, or not wanted; a run without a folder and without ``out``.
    RunFolderError, FormatError
        Not a finished run, or a damaged one.

    Examples
    --------
    >>> gs.export("runs/field", (-33.8886, 151.1892), heading=90.0, format="geojson").name
    'map.geojson'
    """
    if format not in WRITERS:
        raise UnknownNameError("format", format, WRITERS)
    opened = run if isinstance(run, Run) else open_run(run)
    home = opened.folder
    if out is None and home is None:
        raise ConfigError("a run without a folder needs a file name to be exported to")
    name = f"map.{format}" if out is None else None if home is None else name_inside(home, out)
    if home is None or name is None:
        target = Path(out or "")
        WRITERS[format](target, geographic_map(opened, datum, heading=heading, confidence=confidence))
        return target
    with locked(home):
        if not isinstance(run, Run):
            opened = open_run(home)  # as it is now that nobody else changes it
        content = geographic_map(opened, datum, heading=heading, confidence=confidence)
        with new_generation(home) as new:
            WRITERS[format](new.path / name, content)
            new.adopt()
    return home / name
