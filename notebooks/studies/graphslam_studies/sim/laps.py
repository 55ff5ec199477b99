"""The laps world: a dozen laps of one hilly route past landmarks, of any size, for skeleton networks.

Each landmark is in view for ten consecutive poses of a pass, and ten come into view at every pose: 100 measurements a
pose. A share of them can be recognised on other laps. Half of every lap has GPS, the other half is indoors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.core.se3 import quat_multiply, quat_to_matrix, so3_exp
from graphslam.skeleton.collapse import Collapse
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.tile_store import Tiles, write_tiles
from graphslam_studies.sim import laps_kernels as kernels

_BLOCK = 20_000
"""Poses drawn at a time; part of what a seed means."""


@dataclass(frozen=True)
class LapsConfig:
    """What the world is like.

    Parameters
    ----------
    spacing : float
        Way between poses [m].
    begin, reach : int
        Landmarks that come into view at each pose, and for how many poses.
    shared, recognised : float
        Share of the landmarks that can be recognised on another lap, and share of the laps on which each of them is.
    odometry : (float, float)
        σ of each step: turn [rad], way [m].
    range_sigma, bearing_sigma : float
        [m], [rad]
    up_sigma : float
        Of the direction up at every pose [rad].
    gps_sigma, gps_every : float, int
        [m]; a fix at each so many poses of the first half of a lap.
    gps_laps : int
        Laps that have GPS at all.
    """

    poses: int = 10_000
    laps: int = 12
    spacing: float = 0.25
    begin: int = 10
    reach: int = 10
    shared: float = 0.3
    recognised: float = 0.8
    odometry: tuple[float, float] = (5e-4, 0.01)
    range_sigma: float = 0.05
    bearing_sigma: float = 5e-3
    up_sigma: float = 0.02
    gps_sigma: float = 0.5
    gps_every: int = 100
    gps_laps: int = 1_000_000

    def __post_init__(self) -> None:
        if self.poses < 2 * self.laps or self.laps < 1 or not 1 <= self.begin <= 64 or self.reach < 1:
            raise ConfigError(
                f"a laps world of {self.poses} poses in {self.laps} laps with {self.begin} landmarks a pose in "
                f"view for {self.reach}; wanted at least 2 poses a lap, 1 … 64 landmarks, 1 pose in view"
            )


@dataclass(frozen=True, eq=False)
class Laps:
    """A drawn world: measurements as a sensor gives them, and the truth.

    Parameters
    ----------
    first : (N + 1,)
    shared : (S, begin) bool
    met : (laps + 1, S) uint64
    """

    config: LapsConfig
    seed: int
    truth: Poses
    first: npt.NDArray[np.int64]
    places: Array
    shared: npt.NDArray[np.bool_]
    met: npt.NDArray[np.uint64]

    def correspondences(self, block: int = 2_000) -> Iterator[tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]]:
        """Pairs of measurements that correspond, in blocks of ``block`` poses, as scan matching would find them."""
        c = self.config
        last = np.full(self.shared.shape, -1, dtype=np.int64)
        a, b = (np.empty(block * c.begin * c.reach, dtype=np.int32) for _ in range(2))
        for k in range(0, c.poses, block):
            rules = (k, min(k + block, c.poses), c.reach)
            n = kernels.correspond(rules, self.shared, self.met, last, self.first, a, b)
            yield a[:n], b[:n]

    def collapsed(self) -> tuple[npt.NDArray[np.int32], int]:
        """Landmark of every measurement, and how many there are."""
        collapse = Collapse(int(self.first[-1]))
        for a, b in self.correspondences():
            collapse.add(a, b)
        return collapse.landmarks()

    def points(self) -> npt.NDArray[np.float32]:
        """Measured points ``(M, 3)`` in the body frame [m]."""
        out = np.empty((int(self.first[-1]), 3), dtype=np.float32)
        for k in range(0, self.config.poses, _BLOCK):
            self._see(k, out[self.first[k] : self.first[min(k + _BLOCK, self.config.poses)]])
        return out

    def _see(self, k: int, out: npt.NDArray[np.float32]) -> None:
        """Points of the block of poses that begins with ``k``."""
        c = self.config
        e = min(k + _BLOCK, c.poses)
        noise = SeedTree(self.seed).child("laps", "points", k).generator().standard_normal(out.shape, dtype=np.float32)
        rules = (k, c.reach, c.range_sigma, c.bearing_sigma)
        R, p = self.truth.rotation[k:e], self.truth.position[k:e]
        kernels.see(R, p, self.places, rules, self.first[k : e + 1] - self.first[k], noise, out)

    def to_tiles(self, folder: str | Path) -> Tiles:
        """Write the measurements to disk, a tile of 2·10⁴ poses at a time."""
        landmark, _ = self.collapsed()

        def blocks() -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.float32], npt.NDArray[np.int32]]]:
            for k in range(0, self.config.poses, _BLOCK):
                at = self.first[k : k + _BLOCK + 1]
                points = np.empty((int(at[-1] - at[0]), 3), dtype=np.float32)
                self._see(k, points)
                yield np.diff(at), points, landmark[at[0] : at[-1]]

        return write_tiles(folder, blocks())

    def problem(
        self,
        landmark: npt.NDArray[np.int32] | None = None,
        points: npt.NDArray[np.float32] | None = None,
        tiles: Tiles | None = None,
    ) -> SkeletonProblem:
        """The skeleton network of this world.

        Parameters
        ----------
        landmark : (M,), optional
            Default: those of :meth:`collapsed`.
        points : (M, 3), optional
            Default: :meth:`points`.
        tiles : Tiles, optional
            Of :meth:`to_tiles`, in place of both.
        """
        if tiles is not None:
            landmark, points = np.empty(0, np.int32), np.empty((0, 3), np.float32)
        c, R, p = self.config, self.truth.rotation, self.truth.position
        rng = SeedTree(self.seed).child("laps", "motion").generator()
        N = c.poses
        turn, shift = c.odometry
        Q = quat_to_matrix(so3_exp(turn * rng.standard_normal((N - 1, 3))))
        dR = np.matmul(np.matmul(R[:-1].swapaxes(1, 2), R[1:]), Q)
        dp = np.einsum("nji,nj->ni", R[:-1], np.diff(p, axis=0)) + shift * rng.standard_normal((N - 1, 3))
        up = R[:, 2, :] + c.up_sigma * rng.standard_normal((N, 3))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        per = self.shared.shape[0]
        at = np.arange(0, N, c.gps_every)
        at = at[(at % per < per // 2) & (at // per < c.gps_laps)]
        cov = np.diag([turn**2] * 3 + [shift**2] * 3)
        return SkeletonProblem(
            points=self.points() if points is None else points,
            landmark=self.collapsed()[0] if landmark is None else landmark,
            first=self.first,
            odometry_rotation=dR,
            odometry_translation=dp,
            odometry_covariance=cov,
            range_sigma=c.range_sigma,
            bearing_sigma=c.bearing_sigma,
            start_rotation=R[0],
            start_position=p[0],
            start_covariance=np.diag([1e-6] * 3 + [1e-4] * 3),
            up=up,
            up_sigma=c.up_sigma,
            gps_pose=at,
            gps_position=p[at] + c.gps_sigma * rng.standard_normal((len(at), 3)),
            gps_covariance=c.gps_sigma**2 * np.eye(3),
            tiles=tiles,
        )


def draw_laps(config: LapsConfig | None = None, seed: int = 0) -> Laps:
    """Draw route, landmarks and which of them are recognised when."""
    c = config or LapsConfig()
    rng = SeedTree(seed).child("laps", "world").generator()
    S = -(-c.poses // c.laps)
    length = S * c.spacing
    k = np.arange(c.poses)
    s, lap = 2 * np.pi * (k % S) / S, k // S
    radius = length / (2 * np.pi)
    wave = rng.uniform(0, 2 * np.pi, 4)
    # the route; every lap wanders a metre to the sides, without a jump where it ends
    t = 2 * np.pi * k / S
    wander = np.minimum(1.0, 0.05 * radius) * np.sin(t * (3 + 0.37) + wave[3])
    r = radius * (1 + 0.15 * np.sin(3 * s + wave[0])) + wander
    high = np.minimum(8.0, 0.08 * radius)
    z = high * np.sin(2 * s + wave[1]) + 0.3 * high * np.sin(7 * s + wave[2])
    p = np.column_stack([r * np.cos(s), r * np.sin(s), z])
    ahead = np.gradient(p, axis=0)
    yaw, pitch = np.arctan2(ahead[:, 1], ahead[:, 0]), -np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
    zero = np.zeros(c.poses)
    roll = 0.02 * np.sin(0.05 * k)
    q = quat_multiply(
        so3_exp(np.column_stack([zero, zero, yaw])),
        quat_multiply(so3_exp(np.column_stack([zero, pitch, zero])), so3_exp(np.column_stack([roll, zero, zero]))),
    )
    # landmarks beside the route, a little ahead of where they come into view
    e = 2 * np.pi * ((np.arange(S) + 0.5 * c.reach) % S) / S
    place_r = radius * (1 + 0.15 * np.sin(3 * e + wave[0]))
    base = np.column_stack([place_r * np.cos(e), place_r * np.sin(e), high * np.sin(2 * e + wave[1])])
    side = rng.uniform(2.0, 15.0, (S, c.begin)) * rng.choice([-1.0, 1.0], (S, c.begin))
    along, height = rng.normal(0.0, 3.0, (S, c.begin)), rng.uniform(-1.0, 5.0, (S, c.begin))
    out = np.column_stack([np.cos(e), np.sin(e), np.zeros(S)])
    tangent = np.column_stack([-np.sin(e), np.cos(e), np.zeros(S)])
    places = base[:, None] + side[..., None] * out[:, None] + along[..., None] * tangent[:, None]
    places[..., 2] += height
    shared = rng.random((S, c.begin)) < c.shared
    met = np.zeros((int(lap[-1]) + 1, S), dtype=np.uint64)
    for j in range(c.begin):
        met |= (rng.random(met.shape) < c.recognised).astype(np.uint64) << np.uint64(j)
    counts = np.minimum(k + 1, c.reach) * c.begin
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Laps(c, seed, Poses(quat_to_matrix(q), p), first, places, shared, met)
