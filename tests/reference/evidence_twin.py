"""An evidence grid that anyone can check by eye: a dictionary of voxels and exact rational rays.

Nothing here is shared with the library but the numbers of its beam model. A ray is not walked: the parameters at which
it crosses the planes of the lattice are collected axis by axis and sorted, and the midpoint of every piece between two
crossings names the voxel it runs through. All of that is done in fractions, so that it is right to the last bit for the
two end points given; only the end points themselves are rounded.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

Voxel = tuple[int, int, int]
LIMIT = 32767
STEP = 1.0 / 2048.0


def _floor3(p: Any) -> Voxel:
    i, j, k = (math.floor(x) for x in p)
    return i, j, k


def crossings(origin: Any, end: Any) -> list[Fraction]:
    """Sorted distinct parameters in (0, 1) at which the segment crosses a plane of the unit lattice."""
    found: set[Fraction] = set()
    for o, e in zip(origin, end):
        a, b = Fraction(float(o)), Fraction(float(e))
        for plane in range(math.ceil(min(a, b)), math.floor(max(a, b)) + 1) if a != b else ():
            t = (plane - a) / (b - a)
            if 0 < t < 1:
                found.add(t)
    return sorted(found)


def pieces(origin: Any, end: Any) -> list[tuple[Fraction, Voxel]]:
    """Voxels the open segment runs through, each with the parameter where it enters. Coordinates in voxels."""
    o = [Fraction(float(x)) for x in origin]
    d = [Fraction(float(e)) - a for e, a in zip(end, o)]
    times = [Fraction(0), *crossings(origin, end), Fraction(1)]
    out = []
    for t0, t1 in itertools.pairwise(times):
        middle = (t0 + t1) / 2
        out.append((t0, _floor3(a + middle * b for a, b in zip(o, d))))
    return out


def ray_voxels(origin: Any, end: Any) -> list[Voxel]:
    """Voxels of a segment in order, from the voxel of its origin to the voxel of its end, both included.

    A ray through an edge or corner of the lattice steps diagonally here: it has no length in the voxels beside it.
    """
    path = [_floor3(origin), *(v for _, v in pieces(origin, end)), _floor3(end)]
    return [v for v, _ in itertools.groupby(path)]


def brute_ray_voxels(origin: Any, end: Any, samples: int = 20001) -> set[Voxel]:
    """Voxels met by points along the segment: a subset of :func:`ray_voxels`, all of it but the shortest pieces."""
    o, e = np.asarray(origin, float), np.asarray(end, float)
    points = o + np.linspace(0.0, 1.0, samples)[:, None] * (e - o)
    return {_floor3(p) for p in np.unique(np.floor(points), axis=0)}


def pose_matrix(pose: Any, dim: int = 3) -> np.ndarray:
    """(4, 4) of ``None``, (3,) x y θ, (7,) x y z qx qy qz qw, or (4, 4)."""
    T = np.eye(4)
    if pose is None:
        return T
    pose = np.asarray(pose, float)
    if pose.shape == (4, 4):
        return pose
    if pose.shape == (3,):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        T[:2, :2] = [[c, -s], [s, c]]
        T[:2, 3] = pose[:2]
        return T
    T[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    T[:3, 3] = pose[:3]
    return T


@dataclass
class TwinReport:
    """What became of the beams of a scan."""

    rays: int = 0
    not_finite: int = 0
    zero_length: int = 0
    outside: int = 0
    cut: int = 0
    touched: int = 0


@dataclass
class EvidenceTwin:
    """The twin of ``EvidenceGrid``: ``values[(i, j, k)]`` in steps of 1/2048 log-odds; a missing key is unknown.

    ``half`` is half the edge of the addressable cube in voxels, as the pool of the grid has it.
    """

    voxel_size: float
    model: Any
    half: int
    dim: int = 3
    values: dict[Voxel, int] = field(default_factory=dict)

    def copy(self) -> EvidenceTwin:
        """A map of its own."""
        return EvidenceTwin(self.voxel_size, self.model, self.half, self.dim, dict(self.values))

    def empty(self) -> EvidenceTwin:
        """A map of the same kind with nothing in it."""
        return EvidenceTwin(self.voxel_size, self.model, self.half, self.dim)

    # -- geometry -----------------------------------------------------------------------------------------------

    def lift(self, points: Any) -> np.ndarray:
        """(n, 3) metres; 2-D points lie in the plane z = 0 of the scan, and so do 3-D points of a 3-D map."""
        points = np.asarray(points, float)
        if points.shape[-1] == 2:
            points = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
        return points

    def to_voxels(self, points: Any, pose: Any = None) -> np.ndarray:
        """Voxel coordinates (n, 3) of points given in the frame whose pose in the grid is ``pose``."""
        T = pose_matrix(pose, self.dim)
        x = (self.lift(points) @ T[:3, :3].T + T[:3, 3]) / self.voxel_size
        if self.dim == 2:
            x[..., 2] = 0.5  # the one layer, half-way up
        return x

    def inside(self, p: Any) -> bool:
        """Whether voxel coordinates are addressable."""
        axes = p[: self.dim]
        return all(-self.half <= math.floor(float(x)) < self.half for x in axes)

    def occupied(self, voxel: Voxel) -> bool:
        """Known and at or above the threshold."""
        return voxel in self.values and self.values[voxel] >= self.model.threshold_step

    # -- writing ------------------------------------------------------------------------------------------------

    def clamp(self, value: int) -> int:
        """Into the clamps of the beam model."""
        low, high = self.model.clamp_steps
        return min(max(value, low), high)

    def insert_scan(
        self,
        points: Any,
        origin: Any = (0.0, 0.0, 0.0),
        *,
        pose: Any = None,
        max_range: Any = None,
        returns: Any = None,
    ) -> TwinReport:
        """One scan: every voxel that any beam hit is updated as hit once, every other crossed one as free once."""
        report = TwinReport()
        points = self.lift(points)
        origin = np.broadcast_to(self.lift(origin), points.shape)
        returned = np.ones(len(points), bool) if returns is None else np.asarray(returns, bool)
        free: set[Voxel] = set()
        hit: set[Voxel] = set()
        for o, e, back in zip(origin, points, returned):
            if not (np.isfinite(o).all() and np.isfinite(e).all()):
                report.not_finite += 1
                continue
            length = float(np.linalg.norm(e - o))
            if (o == e).all():
                report.zero_length += 1
                continue
            cut = max_range is not None and length > max_range
            if cut:
                e = o + (e - o) * (max_range / length)
            a, b = self.to_voxels([o, e], pose)
            if not (self.inside(a) and self.inside(b)):
                report.outside += 1
                continue
            report.rays += 1
            report.cut += cut
            path = ray_voxels(a, b)
            free.update(path[:-1])
            if back and not cut:
                hit.add(path[-1])
        for voxel in free | hit:
            step = self.model.hit_step if voxel in hit else self.model.miss_step
            self.values[voxel] = self.clamp(self.values.get(voxel, 0) + step)
        report.touched = len(free | hit)
        return report

    def merge(self, other: EvidenceTwin, pose: Any = None) -> None:
        """Add the log-odds of another map, ``pose`` its pose in this one.

        Every voxel of this map takes the value of the other's voxel that holds its centre; unknown adds nothing.
        """
        T = pose_matrix(pose, self.dim)
        back = np.linalg.inv(T)
        source_values = dict(other.values)  # the other may be this very map
        candidates: set[Voxel] = set()
        reach = np.ones(3) if self.dim == 3 else np.array([1.0, 1.0, 0.0])
        for voxel in source_values:
            corners = np.array(list(itertools.product(*((i, i + 1) for i in voxel)))) * other.voxel_size
            image = (corners @ T[:3, :3].T + T[:3, 3]) / self.voxel_size
            if self.dim == 2:
                image[:, 2] = 0.5
            low = np.floor(image.min(0) - reach).astype(int)
            high = np.floor(image.max(0) + reach).astype(int)
            candidates.update(itertools.product(*(range(a, b + 1) for a, b in zip(low.tolist(), high.tolist()))))
        for voxel in candidates:
            if not self.inside(voxel):
                continue
            centre = (np.array(voxel) + 0.5) * self.voxel_size
            source = (back[:3, :3] @ centre + back[:3, 3]) / other.voxel_size
            if self.dim == 2:
                source[2] = 0.5
            value = source_values.get(_floor3(source))
            if value is not None:
                self.values[voxel] = self.clamp(self.values.get(voxel, 0) + value)

    def write_bricks(self, coordinates: Any, values: Any) -> None:
        """Replace whole bricks of 8³ voxels (x fastest); -32768 makes a voxel unknown."""
        for (bx, by, bz), brick in zip(np.asarray(coordinates).tolist(), np.asarray(values).tolist()):
            for n, value in enumerate(brick):
                voxel = (8 * bx + n % 8, 8 * by + n // 8 % 8, 8 * bz + n // 64)
                if value == -LIMIT - 1:
                    self.values.pop(voxel, None)
                else:
                    self.values[voxel] = value

    # -- reading ------------------------------------------------------------------------------------------------

    def value_at(self, point: Any) -> int | None:
        """Value of the voxel that holds a point [m]; None where unknown."""
        return self.values.get(_floor3(self.to_voxels([point])[0]))

    def bricks(self) -> dict[Voxel, list[int]]:
        """Bricks that hold a known voxel: coordinate -> 512 values, x fastest."""
        out: dict[Voxel, list[int]] = {}
        for (i, j, k), value in self.values.items():
            brick = out.setdefault((i // 8, j // 8, k // 8), [-LIMIT - 1] * 512)
            brick[(k % 8) * 64 + (j % 8) * 8 + i % 8] = value
        return out

    def cast(
        self, origin: Any, direction: Any, max_range: float, *, pose: Any = None, ignore_unknown: bool = True
    ) -> tuple[str, float, Voxel | None]:
        """(what, range [m], voxel) of the first occupied voxel along a ray.

        ``what`` is "hit" (range to the middle of the chord in that voxel, at most the maximum), "inside" (origin in an
        occupied voxel), "unknown" (stopped there), "left" (the cube), "max" or "outside" (origin not in the cube).
        """
        o = np.asarray(self.lift([origin])[0], float)
        d = np.asarray(self.lift([direction])[0], float)
        d /= np.linalg.norm(d)
        a, b = self.to_voxels([o, o + d * max_range], pose)
        if not self.inside(a):
            return "outside", math.nan, None
        if self.occupied(_floor3(a)):
            return "inside", 0.0, _floor3(a)
        for t, voxel in [(Fraction(0), _floor3(a)), *pieces(a, b)]:
            if not self.inside(voxel):
                return "left", float(t) * max_range, None
            if self.occupied(voxel):
                exits = [
                    (v + (y > x) - x) / (y - x) for x, y, v in zip(a.tolist(), b.tolist(), voxel) if x != y
                ]  # parameters at which the ray passes the far face on each axis, also beyond its end
                return "hit", min(max_range, 0.5 * (float(t) + min(exits)) * max_range), voxel
            if voxel not in self.values and not ignore_unknown:
                return "unknown", float(t) * max_range, voxel
        return "max", max_range, None

    def entropy(self) -> float:
        """Natural-log entropy of the observed voxels times their volume (area in 2-D) (A11, eq. 20-22)."""
        terms = []
        for value in self.values.values():
            x = abs(value) * STEP  # the entropy is even in the log-odds
            q = 1.0 / (1.0 + math.exp(x))  # the smaller probability, without cancellation
            terms.append(-q * math.log(q) - (1.0 - q) * math.log1p(-q))
        return math.fsum(terms) * self.voxel_size**self.dim

    def occupied_cloud(self) -> np.ndarray:
        """Centres of the occupied voxels (n, dim), in no order but a fixed one."""
        centres = [[(i + 0.5) * self.voxel_size for i in v] for v in sorted(self.values) if self.occupied(v)]
        return np.array(centres, float).reshape(-1, 3)[:, : self.dim]

    def binned_cloud(self, level: int, minimum: int = 1) -> dict[Voxel, tuple[np.ndarray, int]]:
        """Cells of 2^level voxels -> (centroid of the occupied voxels in it, their number)."""
        cells: dict[Voxel, list[Voxel]] = {}
        for v in sorted(self.values):
            if self.occupied(v):
                cells.setdefault(tuple(i >> level for i in v), []).append(v)  # type: ignore[arg-type]
        return {
            cell: ((np.mean(members, axis=0) + 0.5)[: self.dim] * self.voxel_size, len(members))
            for cell, members in cells.items()
            if len(members) >= minimum
        }

    def box(self, lower: Voxel, upper: Voxel) -> Counter[str]:
        """Voxels from ``lower`` up to but not including ``upper``, counted as "occupied", "known" and "all"."""
        count: Counter[str] = Counter(occupied=0, known=0, all=0)
        for voxel in itertools.product(*(range(a, b) for a, b in zip(lower, upper))):
            count["all"] += 1
            count["known"] += voxel in self.values
            count["occupied"] += self.occupied(voxel)  # type: ignore[arg-type]
        return count

    def bounds(self) -> tuple[Voxel, Voxel] | None:
        """First known voxel and the one after the last, per axis; None of an empty map."""
        if not self.values:
            return None
        v = np.array(list(self.values))
        return tuple(v.min(0).tolist()), tuple((v.max(0) + 1).tolist())  # type: ignore[return-value]
