"""Scans for the evidence-grid benchmark: two simulated scenes and two recordings, each as poses and points.

*tunnel* (0.1 m voxels): a mine, three galleries across three, 25 m apart, bore radius 2.2 m with rough walls, and a
robot at 1 m/s with a planar fan of 181 beams over 180° at 37.5 Hz, whose plane turns about the forward axis at 0.25 Hz.
Range σ 2 cm; beams are cut at 30 m. Straight: 1,000 scans, 27 m. Loop: 7,500 scans, 200 m around four blocks.

*street* (0.2 m): a lidar of 64 rings × 1,875 azimuths between facades, cars, poles and a side street, 10 scans 1 m
apart. Range σ 2 cm; cut at 50 m.

*kitti* (0.2 m, cut at 50 m): ``lidar3d-kitti-0005``, an HDL-64E in a city; poses by scan matching (KISS-ICP), made
once and kept in the folder for temporary files. *hall* (0.1 m, cut at 50 m): ``lidar3d-balm-hall`` with its poses.

Rays of the simulated scenes are computed against the shapes themselves, not against a map. Beams that meet nothing
before the limit are given as points beyond it.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.core.se3 import quat_multiply, quat_rotate, se3_transform

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scene:
    """Scans at known poses.

    Parameters
    ----------
    name : str
    voxel_size, max_range : float
        [m]
    poses : (n, 7)
        ``T_grid_scan``; beams begin at their origins.
    clouds : list of (m, 3)
        Ends of the beams in the frame of the scan; what is farther than ``max_range`` is no return.
    rate : float
        Scans a second, in the time of the recording.
    """

    name: str
    voxel_size: float
    max_range: float
    poses: Array
    clouds: list[Array]
    rate: float

    def __len__(self) -> int:
        return len(self.clouds)

    def __iter__(self) -> Iterator[tuple[Array, Array, Array]]:
        """Pose ``(7,)``, points ``(m, 3)`` in the frame of the scan, returns ``(m,)`` bool."""
        for pose, points in zip(self.poses, self.clouds):
            yield pose, points, np.linalg.norm(points, axis=1) < self.max_range

    def world(self) -> list[tuple[Array, Array]]:
        """Origins ``(3,)`` and points ``(m, 3)`` in the frame of the map, as OctoMap wants them."""
        return [(p[:3].copy(), se3_transform(p, c)) for p, c in zip(self.poses, self.clouds)]

    def first(self, n: int) -> Scene:
        """The first ``n`` scans."""
        return Scene(self.name, self.voxel_size, self.max_range, self.poses[:n], self.clouds[:n], self.rate)


# --- tunnel ----------------------------------------------------------------------------------------------------------

BORE, BLOCK, OVERHANG, TURN = 2.2, 50.8584073464, 30.0, 2.0  # [m]; 4 (BLOCK - 2 TURN) + 2 π TURN = 200
CORNER = np.array([0.013, 0.027, 0.041])  # of the map, in the tunnel's own coordinates
FAN_RATE, SPIN_RATE, SPEED, FAN_BEAMS, FAN_RANGE, FAN_SIGMA = 37.5, 0.25, 1.0, 181, 30.0, 0.02
_WAVES = np.array(  # amplitude [m], along [rad/m], around [1]: a wall as it is left by blasting
    [(0.10, 0.9, 2), (0.08, 2.3, 3), (0.06, 4.1, 5), (0.05, 7.7, 4), (0.04, 11.3, 9)]
)
_STEEPEST = float(np.sum(_WAVES[:, 0] * np.hypot(_WAVES[:, 1], _WAVES[:, 2] / (0.7 * BORE))))


def _galleries(x: Array, y: Array) -> list[tuple[Array, Array, float, float]]:
    """Of each gallery: coordinate along and across, where its middle is across, phase of its walls."""
    middles = (0.0, BLOCK / 2, BLOCK)
    return [(x, y, m, 0.3 + 1.4 * k) for k, m in enumerate(middles)] + [
        (y, x, m, 4.5 + 1.4 * k) for k, m in enumerate(middles)
    ]


def _clearance(points: Array) -> Array:
    """How far inside the mine points ``(n, 3)`` are: bore radius minus distance to the centre line, of the gallery that
    leaves most; negative in the rock."""
    x, y, z = points.T
    best = np.full(len(points), -np.inf)
    for along, across, where, phase in _galleries(x, y):
        side = across - where
        near = np.flatnonzero(np.abs(side) < 1.25 * BORE)
        s, o, up = along[near], side[near], z[near]
        around = np.arctan2(up, o)
        radius = np.full(len(near), BORE)
        for k, (a, w, m) in enumerate(_WAVES):
            radius += a * np.sin(w * s + m * around + phase * (k + 1))
        inside = np.minimum(radius - np.hypot(o, up), np.minimum(s + OVERHANG, BLOCK + OVERHANG - s))
        best[near] = np.maximum(best[near], inside)
    return best


def tunnel_ranges(origins: Array, directions: Array, limit: float) -> Array:
    """Ranges ``(n,)`` to the wall along unit directions ``(n, 3)`` from origins inside; ``limit`` where it is farther.

    Sphere tracing: the clearance changes by at most ``1 + steepest slope of the wall`` a metre, so a step of that
    share of it never leaves the mine. Within half a millimetre of the wall the ray has arrived.
    """
    ranges = np.zeros(len(origins))
    active = np.arange(len(origins))
    while len(active):
        clear = _clearance(origins[active] + ranges[active, None] * directions[active])
        ranges[active] += np.maximum(clear, 0.0) / np.hypot(1.0, _STEEPEST)
        active = active[(clear > 5e-4) & (ranges[active] < limit)]
    return np.minimum(ranges, limit)


def _loop(s: Array) -> tuple[Array, Array]:
    """Positions ``(n, 2)`` and headings ``(n,)`` after ``s`` metres around the block, corners rounded."""
    side, arc = BLOCK - 2 * TURN, TURN * np.pi / 2
    lap = s % (4 * (side + arc))
    corner = (lap // (side + arc)).astype(int)
    rest = lap - corner * (side + arc)
    turn = np.clip(rest - side, 0.0, None) / TURN
    x = TURN + np.minimum(rest, side) + TURN * np.sin(turn)
    y = TURN * (1 - np.cos(turn))
    for _ in range(3):  # a quarter turn about the middle of the block for every corner behind
        more = corner > 0
        x, y = np.where(more, BLOCK - y, x), np.where(more, x, y)
        corner = corner - more
    return np.column_stack([x, y]), ((lap // (side + arc)) * np.pi / 2 + turn)


def tunnel(scans: int = 1000, *, seed: int = 4) -> Scene:
    """The first ``scans`` scans of the way around the block; 1,000 are straight, 7,500 come back to the beginning.

    The map begins at `CORNER`: the sensor's height and way would lie between two voxels exactly, and into which of them
    a whole level fan falls would be decided by OctoMap's rounding to single precision.
    """
    t = np.arange(scans) / FAN_RATE
    xy, heading = _loop(SPEED * t)
    yaw = np.zeros((scans, 4))
    yaw[:, 2], yaw[:, 3] = np.sin(heading / 2), np.cos(heading / 2)
    spin = np.zeros((scans, 4))
    angle = 2 * np.pi * SPIN_RATE * t
    spin[:, 0], spin[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
    poses = np.column_stack([xy, np.full(scans, -0.6), quat_multiply(yaw, spin)])
    a = np.linspace(-np.pi / 2, np.pi / 2, FAN_BEAMS)
    fan = np.column_stack([np.cos(a), np.sin(a), np.zeros(FAN_BEAMS)])
    # "No return" is at 40 m: anything beyond the limit does, and the rays end sooner.
    true = np.empty((scans, FAN_BEAMS))
    for k in range(0, scans, 250):
        rows = slice(k, k + 250)
        directions = quat_rotate(poses[rows, None, 3:], fan[None])
        origins = np.broadcast_to(poses[rows, None, :3], directions.shape)
        true[rows] = tunnel_ranges(origins.reshape(-1, 3), directions.reshape(-1, 3), 40.0).reshape(-1, FAN_BEAMS)
    noise = SeedTree(seed).child("tunnel").generator().normal(scale=FAN_SIGMA, size=true.shape)
    measured = np.where(true < FAN_RANGE, np.maximum(true + noise, 0.05), true)
    clouds = list(np.ascontiguousarray(measured[:, :, None] * fan))
    poses[:, :3] -= CORNER
    return Scene("tunnel", 0.1, FAN_RANGE, poses, clouds, FAN_RATE)


# --- street ----------------------------------------------------------------------------------------------------------

RINGS, AZIMUTHS, STREET_RANGE, STREET_SIGMA, MAST = 64, 1875, 50.0, 0.02, 1.73


def _street_shapes(seed: int) -> tuple[Array, Array, Array]:
    """Boxes: low and high corners ``(k, 3)``; poles: x, y, radius, height ``(p, 4)``. Ground is z = 0."""
    rng = SeedTree(seed).child("street").generator()
    low, high = [], []
    for side in (-1.0, 1.0):
        x = -80.0
        while x < 100.0:  # facades with set-backs; one gap a side is a side street
            length, setback, height = rng.uniform(8, 18), rng.uniform(8.0, 10.5), rng.uniform(6, 16)
            if not (20.0 < x + length / 2 < 32.0):
                a, b = sorted((side * setback, side * (setback + 12.0)))
                low.append((x, a, 0.0))
                high.append((x + length, b, height))
            x += length
        for x in np.arange(-60.0, 70.0, 7.0):  # parked cars: a body and a cabin
            if rng.random() < 0.65:
                x0, y = x + rng.uniform(0, 2), side * rng.uniform(5.0, 5.6)
                low += [(x0, y - 0.9, 0.25), (x0 + 1.0, y - 0.75, 0.9)]
                high += [(x0 + 4.3, y + 0.9, 0.9), (x0 + 3.4, y + 0.75, 1.5)]
    x = np.arange(-70.0, 80.0, 14.0)
    poles = [(v, side * 6.8, r, 8.0) for side in (-1.0, 1.0) for v, r in zip(x, rng.uniform(0.08, 0.25, len(x)))]
    return np.array(low), np.array(high), np.array(poles)


def street(scans: int = 10, *, seed: int = 4) -> Scene:
    """A drive of 1 m a scan along the street."""
    low, high, poles = _street_shapes(seed)
    elevation = np.radians(np.linspace(2.0, -24.8, RINGS))
    azimuth = np.linspace(-np.pi, np.pi, AZIMUTHS, endpoint=False)
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    beams = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)  # (rings, azimuths, 3)
    rng = SeedTree(seed).child("street", "noise").generator()
    poses, clouds = [], []
    for k in range(scans):
        heading = 0.03 * np.sin(0.4 * k)
        pose = np.array([1.0 * k, 0.3 * np.sin(0.3 * k), MAST, 0, 0, np.sin(heading / 2), np.cos(heading / 2)])
        true = street_ranges(pose[:3], quat_rotate(pose[3:], beams), low, high, poles)
        noisy = true + rng.normal(scale=STREET_SIGMA, size=true.shape)
        measured = np.where(true < STREET_RANGE, noisy, true)
        poses.append(pose)
        clouds.append((measured[..., None] * beams).reshape(-1, 3))
    return Scene("street", 0.2, STREET_RANGE, np.array(poses), clouds, 10.0)


def street_ranges(origin: Array, directions: Array, low: Array, high: Array, poles: Array) -> Array:
    """Ranges ``(rings, azimuths)`` along unit directions from one origin; 60 m where nothing is nearer than that.

    Beams of one azimuth lie in one vertical plane, so a shape concerns only the azimuths that meet its footprint.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / directions
        best = np.where(directions[..., 2] < 0, -origin[2] * inverse[..., 2], 60.0)
        best = np.minimum(best, 60.0)
        for a, b in zip(low, high):  # slabs
            t0, t1 = (a[:2] - origin[:2]) * inverse[0, :, :2], (b[:2] - origin[:2]) * inverse[0, :, :2]
            near, far = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
            hit = np.flatnonzero((near < far) & (far > 0) & (near < 60.0))
            u0, u1 = (a - origin) * inverse[:, hit], (b - origin) * inverse[:, hit]
            near, far = np.minimum(u0, u1).max(axis=-1), np.maximum(u0, u1).min(axis=-1)
            best[:, hit] = np.where((near < far) & (near > 0) & (near < best[:, hit]), near, best[:, hit])
        for x, y, r, height in poles:
            o = np.array([x, y]) - origin[:2]
            hit = np.flatnonzero(
                directions[0, :, :2] @ o > np.linalg.norm(directions[0, :, :2], axis=1) * (o @ o - r * r) ** 0.5
            )
            d = directions[:, hit]
            along, flat = d[..., :2] @ o, np.sum(d[..., :2] ** 2, axis=-1)
            t = (along - np.sqrt(np.maximum(along**2 - flat * (o @ o - r * r), 0.0))) / flat
            z = origin[2] + t * d[..., 2]
            best[:, hit] = np.where((t > 0) & (t < best[:, hit]) & (z < height), t, best[:, hit])
    return best


# --- recordings ------------------------------------------------------------------------------------------------------


def kitti(scans: int = 20) -> Scene | None:
    """The first scans of the drive; None without GRAPHSLAM_DATA, or without KISS-ICP and kept poses."""
    log = _recorded("lidar3d-kitti-0005")
    if log is None:
        return None
    clouds = [log["clouds"].cloud(k) for k in range(scans)]
    kept = Path(tempfile.gettempdir()) / f"graphslam-bench-kitti-0005-{scans}.npy"
    if kept.is_file():
        poses = np.load(kept, allow_pickle=False)
    else:
        poses = _matched(clouds, 50.0)
        if poses is None:
            return None
        np.save(kept, poses)
    return Scene("kitti", 0.2, 50.0, poses, clouds, 10.0)


def hall(scans: int = 40) -> Scene | None:
    """The first scans of the hall; None without GRAPHSLAM_DATA."""
    log = _recorded("lidar3d-balm-hall")
    if log is None:
        return None
    clouds = [log["clouds"].cloud(k) for k in range(scans)]
    return Scene("hall", 0.1, 50.0, log["reference"].poses[:scans], clouds, 2.0)


def _recorded(card: str):  # type: ignore[no-untyped-def]
    from graphslam.core.errors import MissingDataError
    from graphslam.io.catalog import load_recording

    if not os.environ.get("GRAPHSLAM_DATA"):
        return None
    try:
        return load_recording(card)
    except MissingDataError as error:
        _log.warning("%s", error)
        return None


def _matched(clouds: list[Array], max_range: float) -> Array | None:
    """Poses ``(n, 7)`` of consecutive scans by KISS-ICP, first scan at the origin."""
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        return None
    from graphslam.core.se3 import matrix_to_quat

    config = KISSConfig()
    config.data.max_range, config.data.deskew = max_range, False
    config.mapping.voxel_size = 0.5
    odometry = KissICP(config)
    out = []
    for points in clouds:
        odometry.register_frame(points, np.zeros(len(points)))
        T = np.array(odometry.last_pose)
        out.append(np.concatenate([T[:3, 3], matrix_to_quat(T[:3, :3])]))
    return np.array(out)
