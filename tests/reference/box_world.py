"""Halls made of boxes, and a range finder in them: exact ranges by slabs, one ray and one box at a time in numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array

LEVEL = np.array([0.0, 0, 0, 0, 0, 0, 1])


@dataclass(frozen=True)
class BoxWorld:
    """Solid boxes ``(b, 2, 3)``: lower and upper corners [m]."""

    boxes: Array

    def ranges(self, origin: Array, directions: Array) -> Array:
        """Distance to the first box along rays ``(n, 3)`` of unit length from one origin; inf where there is none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (self.boxes[:, 0] - origin)[None] / directions[:, None]
            b = (self.boxes[:, 1] - origin)[None] / directions[:, None]
        # a ray in the plane of a face gives 0/0: it passes
        near, far = np.fmax.reduce(np.fmin(a, b), axis=2), np.fmin.reduce(np.fmax(a, b), axis=2)
        hit = (near <= far) & (near > 1e-9)
        return np.where(hit, near, np.inf).min(axis=1)

    def scan(self, T_world_sensor: Array, directions: Array, sigma: float, reach: float, rng: np.random.Generator):
        """Noisy points ``(m, 3)`` in the sensor's frame of what is nearer than ``reach``."""
        world = se3.quat_rotate(T_world_sensor[3:], directions)
        r = self.ranges(T_world_sensor[:3], world)
        met = r < reach
        return directions[met] * (r[met] + sigma * rng.standard_normal(int(met.sum())))[:, None]


def heading(x: float, y: float, z: float, yaw: float, pitch: float = 0.0) -> Array:
    """Pose ``(7,)`` of a heading and a pitch."""
    turn, nod = (
        np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]),
        np.array([0, np.sin(pitch / 2), 0, np.cos(pitch / 2)]),
    )
    return np.concatenate([[x, y, z], se3.quat_multiply(turn, nod)])


def around(rng: np.random.Generator, n: int, low: float = -0.5, high: float = 0.5) -> Array:
    """Unit directions ``(n, 3)``, all headings, elevations between ``low`` and ``high`` [rad]."""
    a, e = rng.uniform(-np.pi, np.pi, n), rng.uniform(low, high, n)
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)


def _box(x0: float, x1: float, y0: float, y1: float, z0: float = 0.0, z1: float = 3.0) -> list[list[float]]:
    return [[x0, y0, z0], [x1, y1, z1]]


def hall(
    length: float = 60.0, width: float = 18.0, height: float = 3.0, period: float = 8.0, cars: int = 0
) -> BoxWorld:
    """A hall with two rows of pillars every ``period`` metres; x along it, the first pillars half a period from 0.

    Its end walls stand at x = 0 and ``length``. A kiosk and two crates stand nowhere twice, nor do
    the ``cars``.
    """
    t = 0.3
    boxes = [
        _box(-t, 0, -t, width + t),
        _box(length, length + t, -t, width + t),
        _box(-t, length + t, -t, 0),
        _box(-t, length + t, width, width + t),
        _box(-t, length + t, -t, width + t, -t, 0.0),
        _box(-t, length + t, -t, width + t, height, height + t),
        _box(27.2, 28.9, 1.0, 2.4, 0.0, 2.0),
        _box(34.0, 34.8, 11.1, 12.0, 0.0, 1.0),
        _box(21.5, 22.3, 15.8, 17.3, 0.0, 1.6),
    ]
    for x in np.arange(period / 2, length, period):
        for y in (width / 3, 2 * width / 3):
            boxes.append(_box(x - 0.3, x + 0.3, y - 0.3, y + 0.3, 0.0, height))
    draw = np.random.default_rng(cars)  # parked along the side walls, always the same ones
    for k in range(cars):
        x, y = draw.uniform(1, length - 3), (0.3 if k % 2 else width - 4.8) + draw.uniform(0, 0.5)
        boxes.append(_box(x, x + draw.uniform(1.6, 2.0), y, y + draw.uniform(3.8, 4.5), 0.2, draw.uniform(0.9, 1.7)))
    return BoxWorld(np.array(boxes, dtype=float))


def corridor(length: float = 400.0, width: float = 3.0, height: float = 2.6) -> BoxWorld:
    """Two walls, a floor, a ceiling; ends too far to be seen from its middle, x = 0."""
    a, t = length / 2, 0.3
    boxes = [
        _box(-a, a, -width / 2 - t, -width / 2, 0, height),
        _box(-a, a, width / 2, width / 2 + t, 0, height),
        _box(-a, a, -width, width, -t, 0),
        _box(-a, a, -width, width, height, height + t),
    ]
    return BoxWorld(np.array(boxes, dtype=float))


def survey(
    world: BoxWorld, poses: Array, rays: int, sigma: float, reach: float, rng: np.random.Generator, **band
) -> Array:
    """Points of scans from several poses, in the world's frame."""
    return np.concatenate(
        [se3.se3_transform(T, world.scan(T, around(rng, rays, **band), sigma, reach, rng)) for T in poses]
    )
