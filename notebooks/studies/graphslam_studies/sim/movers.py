"""Cars and people that go to and fro while a robot passes, and the beams that end on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array

Labels = npt.NDArray[np.int16]
TRIES = 200
"""How often a mover is drawn before it is given up: it must never come too near the robot."""
_BESIDE = 0.25  # s between the times at which its distance from the robot is looked at


@dataclass(frozen=True, slots=True, kw_only=True)
class Mover:
    """Something that goes to and fro between two places at a constant speed, turning round at once.

    Parameters
    ----------
    kind : str
        ``car`` or ``person``.
    start, end : (2,)
        Where it turns [m].
    floor : float
        Height under it [m].
    speed : float
        [m/s]
    phase : float
        Distance gone at time 0 [m].
    boxes : (b, 6)
        What it is made of, heading along x: low corner and high corner of each box [m].
    """

    kind: str
    start: Array
    end: Array
    floor: float
    speed: float
    phase: float
    boxes: Array

    @property
    def radius(self) -> float:
        """Of the circle round it in the plan [m]."""
        return float(np.hypot(np.abs(self.boxes[:, [0, 3]]).max(), np.abs(self.boxes[:, [1, 4]]).max()))

    def state(self, t: Array) -> tuple[Array, Array]:
        """Place in the plan ``(n, 2)`` and heading as a unit vector ``(n, 2)`` at times ``(n,)``."""
        leg = self.end - self.start
        length = float(np.linalg.norm(leg))
        travelled = np.mod(self.phase + self.speed * np.asarray(t, dtype=np.float64), 2.0 * length)
        back = travelled > length
        along = np.where(back, 2.0 * length - travelled, travelled)
        u = leg / length
        return self.start + along[:, None] * u, np.where(back, -1.0, 1.0)[:, None] * u

    def hits(self, rays: Array, t: Array) -> Array:
        """Distances ``(n,)`` along rays ``(n, 6)`` at times ``(n,)``; infinite where a ray passes it."""
        place, u = self.state(t)
        d = rays[:, :3] - np.column_stack([place, np.full(len(rays), self.floor)])
        o = np.column_stack([d[:, 0] * u[:, 0] + d[:, 1] * u[:, 1], d[:, 1] * u[:, 0] - d[:, 0] * u[:, 1], d[:, 2]])
        w = rays[:, 3:]
        v = np.column_stack([w[:, 0] * u[:, 0] + w[:, 1] * u[:, 1], w[:, 1] * u[:, 0] - w[:, 0] * u[:, 1], w[:, 2]])
        out = np.full(len(rays), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for box in self.boxes:
                near, far = (box[:3] - o) / v, (box[3:] - o) / v
                first = np.fmax.reduce(np.fmin(near, far), axis=1)
                last = np.fmin.reduce(np.fmax(near, far), axis=1)
                inside = np.all((v != 0.0) | ((o > box[:3]) & (o < box[3:])), axis=1)
                out = np.where(inside & (first <= last) & (first > 0.0), np.fmin(out, first), out)
        return out


def car(rng: np.random.Generator) -> Array:
    """Boxes of a car: body and cabin."""
    length, width, height = 3.8 + 0.9 * rng.random(), 1.65 + 0.15 * rng.random(), 1.4 + 0.3 * rng.random()
    a, b, c = length / 2, width / 2, 0.58 * height
    return np.array([[-a, -b, 0.2, a, b, c], [-0.3 * length, -0.9 * b, c, 0.2 * length, 0.9 * b, height]])


def person(rng: np.random.Generator) -> Array:
    """Boxes of a person: legs and body, head."""
    tall, wide = 1.55 + 0.35 * rng.random(), 0.22 + 0.05 * rng.random()
    return np.array([[-0.15, -wide, 0.0, 0.15, wide, tall - 0.25], [-0.1, -0.09, tall - 0.25, 0.1, 0.09, tall]])


def clear_of(mover: Mover, times: Array, positions: Array, distance: float) -> bool:
    """Does a mover keep its distance from a robot at ``positions`` ``(n, 3)``? Its boxes are taken, not its circle."""
    place, u = mover.state(times)
    d = positions[:, :2] - place
    o = np.abs(np.column_stack([d[:, 0] * u[:, 0] + d[:, 1] * u[:, 1], d[:, 1] * u[:, 0] - d[:, 0] * u[:, 1]]))
    half = np.maximum(np.abs(mover.boxes[:, :2]), np.abs(mover.boxes[:, 3:5])).max(axis=0)
    gap = np.maximum(o - half, 0.0)
    near = (np.hypot(gap[:, 0], gap[:, 1]) < distance) & (np.abs(positions[:, 2] - mover.floor) < 2.5)
    return not near.any()


def draw_movers(
    lines: Sequence[tuple[str, Array, Array, float]],
    count: int,
    times: Array,
    positions: Array,
    rng: np.random.Generator,
    *,
    distance: float = 0.6,
) -> list[Mover]:
    """Draw things that move near where a robot drives.

    Parameters
    ----------
    lines : sequence of (kind, start, end, floor)
        Lines along which cars or people may go.
    count : int
        Half of them cars, where there are lines for them.
    times, positions : (n,), (n, 3)
        Of the robot: all of it, and close together.
    distance : float
        None comes nearer to the robot's middle than this [m].
    """
    out: list[Mover] = []
    steps = max(round(_BESIDE / float(np.median(np.diff(times)))), 1)
    t, p = times[::steps], positions[::steps]
    for k in range(count):
        kind = "car" if k % 2 == 0 else "person"
        mine = [line for line in lines if line[0] == kind]
        for _ in range(TRIES if mine else 0):
            # a line near a place that the robot comes to, and a piece of it about that place
            near = p[int(rng.integers(len(p))), :2]
            away = [_away(near, a, b) for _, a, b, _ in mine]
            choice = np.flatnonzero(np.array(away) < 15.0)
            if not len(choice):
                continue
            _, a, b, floor = mine[int(rng.choice(choice))]
            length = float(np.linalg.norm(b - a))
            u = (b - a) / length
            middle = float(np.clip((near - a) @ u, 0.0, length))
            reach = float(rng.uniform(15.0, 60.0)) if kind == "car" else float(rng.uniform(5.0, 25.0))
            low, high = max(middle - reach, 0.0), min(middle + reach, length)
            speed = float(rng.uniform(2.0, 8.0)) if kind == "car" else float(rng.uniform(0.6, 1.6))
            mover = Mover(
                kind=kind, start=a + low * u, end=a + high * u, floor=floor, speed=speed,
                phase=float(rng.uniform(0.0, 2.0 * (high - low))), boxes=car(rng) if kind == "car" else person(rng),
            )  # fmt: skip
            if high - low > 4.0 and clear_of(mover, t, p, distance):
                out.append(mover)
                break
    return out


def _away(p: Array, a: Array, b: Array) -> float:
    """Distance of a point from a piece of a line [m]."""
    s = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return float(np.linalg.norm(p - a - s * (b - a)))


class MovingObjects:
    """Beams cut short by movers, and which mover each of them met.

    Parameters
    ----------
    shape : (int, int)
        Scans and beams.
    reach : float
        Greatest range [m].
    """

    def __init__(self, movers: Sequence[Mover], shape: tuple[int, int], reach: float) -> None:
        self.movers, self.reach = movers, reach
        self.labels: Labels = np.full(shape, -1, dtype=np.int16)
        """Number of the mover that each beam met ``(n, m)``; -1: none."""

    def __call__(self, first: int, rays: Array, times: Array, ranges: Array) -> Array:
        """See :data:`graphslam.sim.crawler_sensors.Nearer`."""
        out = ranges.copy()
        label = np.full(len(rays), -1, dtype=np.int16)
        m = self.labels.shape[1]
        lines = np.arange(0, len(rays), m)  # one distance a scan will do: it lasts some milliseconds
        for k, mover in enumerate(self.movers):
            place, _ = mover.state(times[lines])
            near = np.linalg.norm(rays[lines, :2] - place, axis=1) < self.reach + mover.radius
            rows = np.flatnonzero(np.repeat(near, m))
            if not len(rows):
                continue
            found = mover.hits(rays[rows], times[rows])
            before = np.where(np.isnan(out[rows]), np.inf, out[rows])
            hit = found < before
            out[rows[hit]], label[rows[hit]] = found[hit], k
        self.labels[first : first + len(lines)] = label.reshape(-1, m)
        return out
