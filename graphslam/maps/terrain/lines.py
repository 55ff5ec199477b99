"""Scan lines (beams in one vertical plane, lowest first), and the detections in them.

The detectors process each line separately. Differences between points of one line do not depend on their common pose
error, so pose noise between lines does not affect the map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.range_scans import RangeScans
from graphslam.core.trajectory import Trajectory
from graphslam.maps.terrain.line_kernels import BandCells, DetectorSettings, observe_lines, sort_into_columns
from graphslam.maps.terrain.vehicle import Vehicle

Rows = npt.NDArray[np.int32]
_LINES_AT_ONCE = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorConfig:
    """Configuration of the line detectors. Lengths in metres."""

    smooth: float = 0.05
    """Heights are averaged over neighbours within this distance, because of the range noise of close beams."""
    nearest: float = 1.3
    """Ground nearer to the sensor than this is ignored: straight below, heights are as noisy as ranges."""
    window: float = 0.3
    """Steps are differences between points within this distance, or between neighbours farther apart."""
    residual: float = 0.06
    """Largest deviation of a ground point from the extrapolated ground …"""
    residual_rate: float = 0.08
    """… plus this per metre since the last ground point."""
    memory: float = 2.0
    """Longest extrapolation of the ground."""
    support_reach: float = 2.5
    """Cells up to this distance behind the place where a beam went below the ground lack support."""
    above_limit: float = 6.0
    """Higher points above the ground are ignored."""

    def __post_init__(self) -> None:
        check_options(self, "terrain: ", {"> 0": "*"})


@dataclass(frozen=True, slots=True, eq=False)
class ScanLines:
    """Lines of points in a level frame (z up).

    Parameters
    ----------
    points : (n, m, 3)
        Lowest beam of each line first; NaN: no return [m].
    origins : (n, 3)
        Positions of the sensor [m].
    feet : (n,)
        Height of the ground under the sensor [m].
    """

    points: Array
    origins: Array
    feet: Array

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        if points.ndim != 3 or points.shape[2] != 3:
            raise GeometryError("points of lines have the wrong shape", got=points.shape, wanted="(n, m, 3)")
        n = len(points)
        missing = ~np.isfinite(points[..., 0] + points[..., 1] + points[..., 2])
        if np.any(np.isinf(points[missing])):
            raise DataError("a point of a line is infinite", wanted="finite numbers, or NaN: no return")
        points[missing] = np.nan
        object.__setattr__(self, "points", points)
        for name, shape in (("origins", (n, 3)), ("feet", (n,))):
            a = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if a.shape != shape:
                raise GeometryError(f"{name} of lines have the wrong shape", got=a.shape, wanted=shape)
            if not np.all(np.isfinite(a)):
                raise DataError(f"{name} of lines are not finite", got=a[~np.isfinite(a)][0])
            object.__setattr__(self, name, a)

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: slice | npt.NDArray[np.bool_]) -> ScanLines:
        """A subset of the lines."""
        return ScanLines(self.points[index], self.origins[index], self.feet[index])


def lines_of_scans(scans: RangeScans, path: Trajectory, height: float) -> ScanLines:
    """Lines of a scanner with a vertical scan plane, in the frame of the path.

    Parameters
    ----------
    scans : RangeScans
        Beams from the lowest to the highest, or reversed.
    path : Trajectory
        ``T_world_base`` in 3-D, z up; each beam uses the pose at its own time.
    height : float
        Height of the sensor above the ground [m].
    """
    if path.dim != 3:
        raise DataError("terrain is read along a path in space", got=f"{path.dim}-D", wanted="3-D, z up")
    n, m = scans.ranges.shape
    times = scans.times[:, None] + scans.beam_times
    if n and (times[0, 0] < path.times[0] or times[-1, -1] > path.times[-1]):
        raise DataError(
            "scans lie outside the path in time",
            got=f"{times[0, 0]:.3f} … {times[-1, -1]:.3f} s",
            wanted=f"{path.times[0]:.3f} … {path.times[-1]:.3f} s",
        )
    origin, directions = scans.head_rays()
    sign = np.sign(np.diff(directions[..., 2], axis=1))
    across = np.cross(directions[:, 0], directions[:, m // 2])
    upright = np.all(sign == sign[:, :1], axis=1) & (np.abs(across[:, 2]) < 0.35 * np.linalg.norm(across, axis=1))
    if n and np.mean(upright) < 0.5:
        raise DataError(
            "the beams of these scans are no upright lines",
            got=f"{np.mean(upright):.0%} of them upright",
            wanted="beams in an upright plane, from the lowest to the highest",
        )
    met = np.isfinite(scans.ranges) & (scans.ranges < scans.max_range)
    local = origin + np.where(met, scans.ranges, np.nan).astype(np.float64)[..., None] * directions
    begin, end = (path.interpolate(times[:, k]) for k in (0, -1))  # constant velocity within a line
    share = (scans.beam_times - scans.beam_times[0]) / max(float(scans.beam_times[-1] - scans.beam_times[0]), 1e-12)
    points, rising, origins = np.zeros((n, m, 3)), 0.0, np.zeros((n, 3))
    for T, part in ((begin, 1.0 - share), (end, share)):
        R = se3.quat_to_matrix(T[:, 3:])
        points += part[:, None] * (local @ np.swapaxes(R, 1, 2) + T[:, None, :3])
        origins += 0.5 * (np.asarray(R @ origin) + T[:, :3])
        rising += float(np.sum(np.einsum("nj,nj->n", R[:, 2], directions[:, -1] - directions[:, 0])))
    if rising < 0.0:
        points = points[:, ::-1]
    return ScanLines(points, origins, origins[:, 2] - height)


COLUMNS = 900
"""Azimuth columns per turn of a spinning scanner."""


def lines_of_clouds(points: Array, origin: Array, foot: float, *, beams: int = 64) -> ScanLines:
    """Lines of one turn of a spinning scanner: columns by azimuth, lowest point first.

    Parameters
    ----------
    points : (k, 3)
        In a level frame [m].
    origin : (3,)
        Position of the scanner [m].
    foot : float
        Height of the ground under it [m].
    beams : int
        Most points of a column; of more, the lowest are kept.
    """
    p = np.ascontiguousarray(points, dtype=np.float64)
    order, filled = np.zeros((COLUMNS, beams), np.int64), np.zeros(COLUMNS, np.int64)
    sort_into_columns(p, np.asarray(origin, dtype=np.float64), order, filled)
    lines = np.full((COLUMNS, beams, 3), np.nan)
    there = np.arange(beams) < filled[:, None]
    lines[there] = p[order[there]]
    return ScanLines(lines, np.broadcast_to(origin, (COLUMNS, 3)), np.full(COLUMNS, float(foot)))


def observe_terrain(
    lines: ScanLines, edges: Array, cells: Array, vehicle: Vehicle, config: DetectorConfig | None = None
) -> Iterator[Rows]:
    """Detections of lines, in chunks; see :mod:`graphslam.maps.terrain.line_kernels`.

    Parameters
    ----------
    edges, cells : (b,)
        Ranges at which the bands end, and widths of their cells [m].
    vehicle : Vehicle
        Its clearance and height separate steps, obstacles and objects above it; its slope is not a step. A drop starts
        on ground that the vehicle can be on.

    Yields
    ------
    (k, 6) int32
        Line, band, ix, iy, channel, value.
    """
    c = config or DetectorConfig()
    figures = DetectorSettings(
        *(c.smooth, c.window, math.tan(vehicle.max_slope), c.residual, c.residual_rate, c.memory, c.support_reach),
        *(math.tan(min(vehicle.max_slope + math.radians(5.0), 1.2)), vehicle.clearance, vehicle.height, c.above_limit),
        *(vehicle.climbable_step, vehicle.width),
    )
    lattice = BandCells(np.ascontiguousarray(edges, np.float64), np.ascontiguousarray(cells, np.float64), c.nearest)
    per_line = 8 * lines.points.shape[1] + 4 * int(lattice.edges[-1] / lattice.cells[0])
    for k in range(0, len(lines), _LINES_AT_ONCE):
        part = slice(k, k + _LINES_AT_ONCE)
        points = lines.points[part]
        rows = np.empty((per_line * len(points), 6), np.int32)
        counts = np.empty(len(points), np.int64)
        count = observe_lines(points, lines.origins[part], lines.feet[part], lattice, figures, rows, counts)
        if count == len(rows):
            raise DataError("lines say more than there is room for", got=count, wanted=f"fewer than {len(rows)} rows")
        made = rows[:count]
        made[:, 0] += k
        yield made
