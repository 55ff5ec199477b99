"""A skeleton network from scans (urban GraphSLAM, C1-C5): patches of surfaces are landmarks seen from several steps.

Scan points of one step in one patch of a surface are one measurement: their mean, and the distance along the normal of
the patch. A patch has the first points of its place as origin; later points within its side, on a surface with the same
normal, correspond to it. Odometry, gravity and fixes are those of the run, as white noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import frame_between, group_of, rotation_matrices
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.refine.config import DISTANCES, MOST_BEAMS, RefineConfig
from graphslam.refine.motion import MotionModel
from graphslam.refine.nodes import find_nodes, scans_at, thin_beams
from graphslam.refine.problem import LEAST_SPREAD
from graphslam.refine.refine import CHUNK_LENGTH, CHUNK_TIME, CHUNK_TURN, KEPT, MOST_ROUNDS, STILL
from graphslam.refine.scans import Scans
from graphslam.refine.surfaces import SAME_SIDE, ScanReturns, Surfaces, find_surfaces, rotate_by_step
from graphslam.registration.surfaces import SURFACE
from graphslam.skeleton.collapse import number_by_first_observation
from graphslam.skeleton.landmark_kernels import Poses
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.relax import RelaxationResult, RelaxConfig, relax_skeleton

Index = npt.NDArray[np.int64]

PATCH = 0.3
"""Side of a patch, and largest distance along the surface from its origin [m]."""
OUTLIER = 3.0
"""From the second round on, measurements beyond this number of σ are not used."""
FEWEST = 6
"""Minimum mean number of measurements of a pose, of patches that other poses observed, too."""
GAUGE, FREE = 0.1, 1.0
"""σ of the first pose of a round [rad, m]; and in directions that gravity or fixes measure [rad], [100 m]. It is loose,
because a held first pose would bend the path: correspondences follow only slowly. The path is moved back at the end."""
OUT_OF_PLANE = 1e-3
"""σ of a planar increment out of the plane [m, rad]; nothing moves a pose there."""


class PatchObservations(NamedTuple):
    """Measurements in the order of their steps, of patches that at least two steps observed."""

    points: Array
    """(M, d) body frame [m]."""
    normals: Array
    """(M, d) body frame; of the patch."""
    patch: npt.NDArray[np.int32]
    """(M,), numbered by first observation."""
    step: Index
    """(M,)"""
    sigma: float
    """σ along the normal, from the residuals [m]."""
    dropped: int
    """Number of outliers."""


def find_patches(
    cloud: ScanReturns, surfaces: Surfaces, poses: Array, distance: float, *, outliers: bool
) -> PatchObservations:
    """Patches of the surfaces at a path, and their measurements.

    Parameters
    ----------
    distance : float
        Largest distance along the normal between a point and the origin of its patch [m].
    outliers : bool
        Remove measurements beyond :data:`OUTLIER` σ.
    """
    W = cloud.world(poses)
    N = rotate_by_step(rotation_matrices(poses), cloud.step, surfaces.normals)[surfaces.stands]
    rows = np.flatnonzero(surfaces.flat[surfaces.stands])
    W, N, step, d = W[rows], N[rows], cloud.step[rows], W.shape[1]
    patch, origins, axes = np.zeros(len(rows), np.int64), np.zeros((0, d)), np.zeros((0, d))
    sums = np.zeros((len(rows), d))
    ends = np.searchsorted(cloud.chunk[step], np.arange(cloud.chunks + 1))
    for a, b in zip(ends[:-1].tolist(), ends[1:].tolist()):
        if a == b:
            continue
        place, x, n = _places(W[a:b], N[a:b])
        own = _nearest_patch(x, n, origins, axes, distance)
        new = own < 0
        own[new] = len(origins) + np.arange(np.count_nonzero(new))
        origins, axes = np.concatenate([origins, x[new]]), np.concatenate([axes, n[new]])
        np.add.at(sums, own, n)
        patch[a:b] = own[place]
    sums = sums[: len(origins)] / np.linalg.norm(sums[: len(origins)], axis=1, keepdims=True)
    key, at, count = np.unique(step * max(len(origins), 1) + patch, return_inverse=True, return_counts=True)
    step, patch = key // max(len(origins), 1), key % max(len(origins), 1)
    body, world = np.zeros((len(key), d)), np.zeros((len(key), d))
    np.add.at(body, at, cloud.points[rows])
    np.add.at(world, at, W)
    off = np.einsum("ki,ki->k", world / count[:, None] - origins[patch], sums[patch])
    good = _shared(patch)
    r = _residuals(off, patch, good)
    sigma = max(LEAST_SPREAD, 1.4826 * float(np.median(np.abs(r[good])))) if good.any() else LEAST_SPREAD
    before = np.count_nonzero(good)
    if outliers:
        good &= np.abs(r) < OUTLIER * sigma
        good[good] = _shared(patch[good])
    back = np.swapaxes(rotation_matrices(poses), 1, 2)
    normals = rotate_by_step(back, step[good], sums[patch[good]])
    label = np.zeros(0, np.int32)
    if good.any():
        label = number_by_first_observation(np.unique(patch[good], return_inverse=True)[1])[0]
    return PatchObservations(
        (body / count[:, None])[good],
        normals,
        label,
        step[good],
        sigma,
        int(before - np.count_nonzero(good)),
    )


def _places(W: Array, N: Array) -> tuple[Index, Array, Array]:
    """Place of each point of a chunk, and mean and normal of each place: cells of a grid, by side of the surface."""
    axis = np.argmax(np.abs(N), axis=1)
    side = 2 * axis + (np.take_along_axis(N, axis[:, None], 1)[:, 0] > 0)
    cell = np.column_stack([np.floor(W / PATCH).astype(np.int64), side])
    cell -= cell.min(axis=0)
    key = cell[:, 0]
    for k in range(1, cell.shape[1]):
        key = key * (int(cell[:, k].max()) + 1) + cell[:, k]
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    x, n = np.zeros((len(count), W.shape[1])), np.zeros((len(count), W.shape[1]))
    np.add.at(x, place, W)
    np.add.at(n, place, N)
    return place, x / count[:, None], n / np.linalg.norm(n, axis=1, keepdims=True)


def _nearest_patch(x: Array, n: Array, origins: Array, axes: Array, distance: float) -> Index:
    """The nearest patch of each place ``(k,)``, -1 without one."""
    out = np.full(len(x), -1, np.int64)
    reach = float(np.hypot(distance, PATCH))
    near = np.flatnonzero(np.all((origins > x.min(axis=0) - reach) & (origins < x.max(axis=0) + reach), axis=1))
    if not len(near):
        return out
    k = min(6, len(near))
    far, at = (a.reshape(len(x), k) for a in cKDTree(origins[near]).query(x, k=k, distance_upper_bound=reach))
    q = np.append(near, 0)[at]
    off = np.abs(np.einsum("kmi,ki->km", origins[q] - x[:, None], n))
    good = np.isfinite(far) & (off <= distance) & (np.einsum("kmi,ki->km", axes[q], n) > SAME_SIDE)
    good &= np.where(good, far, np.inf) ** 2 - off**2 <= PATCH**2
    some = good.any(axis=1)
    out[some] = q[some, np.argmax(good[some], axis=1)]
    return out


def _shared(patch: Index) -> npt.NDArray[np.bool_]:
    """Is the patch of each measurement observed at least twice?"""
    return np.asarray(np.bincount(patch)[patch] > 1) if len(patch) else np.zeros(0, bool)


def _residuals(off: Array, patch: Index, good: npt.NDArray[np.bool_]) -> Array:
    """Distances along the normal from the mean of their patch, scaled to the variance of one measurement."""
    count = np.maximum(np.bincount(patch), 1)
    mean = np.bincount(patch, weights=off) / count
    return np.where(good, (off - mean[patch]) / np.sqrt(np.maximum(1.0 - 1.0 / count, 0.5))[patch], 0.0)


@dataclass(frozen=True)
class ScanSkeleton:
    """A path relaxed with its scans as a skeleton network.

    Parameters
    ----------
    path : Trajectory
        At the nodes, in the frame of the initial path; in the plane ``(n, 3)``.
    cloud : ScanReturns
        Points of the nodes.
    problem : SkeletonProblem
        Of the last round, in a frame of its own; in the plane with z = 0.
    sigma : float
        σ of a measurement along its normal, from the residuals [m].
    outliers, fixes, fixes_left : int
        Number of measurements that were not used; of used fixes, and of others.
    moved : tuple of float
        RMS by which the positions moved in each round [m].
    """

    path: Trajectory
    cloud: ScanReturns
    problem: SkeletonProblem
    relaxation: RelaxationResult
    sigma: float
    outliers: int
    fixes: int
    fixes_left: int
    moved: tuple[float, ...]


def relax_scans(
    steps: Scans,
    start: Array,
    config: RefineConfig | None = None,
    *,
    gps: tuple[Gps, Array] | None = None,
    progress: Callable[[str], Any] | None = None,
) -> ScanSkeleton:
    """Relax a path with its scans: correspondences, landmarks, skeleton network; repeated until the path is stationary.

    Parameters
    ----------
    start : (n, 7) or (n, 3)
        Poses of the base at the stamps of the steps; in 3-D in a level frame.
    gps : (Gps, T_gps_world), optional
        Fixes, and the pose of the frame of the path in theirs; the first pose is then not held.
    progress : callable, optional
        Called with a text after each round.

    Raises
    ------
    DataError
        Too few correspondences.
    """
    c = config or RefineConfig()
    g = group_of(start)
    if start.shape != (len(steps), steps.group.size) or not np.all(np.isfinite(start)):
        raise GeometryError("the start does not fit the steps", got=start.shape, wanted=(len(steps), steps.group.size))
    nodes = find_nodes(steps, c.spacing, c.turn)
    some, poses = thin_beams(scans_at(steps, nodes) if len(nodes) < len(steps) else steps, MOST_BEAMS), start[nodes]
    turn = CHUNK_TURN if g.dim == 2 else np.inf
    raw = cloud = ScanReturns.of(some, chunk_length=CHUNK_LENGTH, chunk_time=CHUNK_TIME, chunk_turn=turn)
    motion, length, moves = MotionModel(some), float(some.path_length[-1]), list[float]()
    for k in range(MOST_ROUNDS):
        distance = DISTANCES[min(k, len(DISTANCES) - 1)]
        if k < KEPT:
            cloud = raw.corrected(motion.corrections(poses))
            surfaces = find_surfaces(cloud, poses, SURFACE)
        seen = find_patches(cloud, surfaces, poses, distance, outliers=k > 0)
        if len(seen.patch) < FEWEST * len(poses):
            raise DataError(
                "too few correspondences to relax",
                where=steps.name,
                got=f"{len(seen.patch)} measurements of surfaces that several of {len(poses)} poses observed",
                wanted=f"≥ {FEWEST * len(poses)}, {FEWEST} a pose",
            )
        fixes = _fixes(gps, some, poses)
        problem = _problem(some, poses, seen, fixes)
        q = _in_space(poses)
        found = relax_skeleton(problem, RelaxConfig(split=False, soft=0), Poses(rotation_matrices(q), q[:, :3].copy()))
        before, poses = poses, _from_space(found.poses, g.dim)
        moves.append(float(np.sqrt(np.mean(np.sum((poses - before)[:, : g.dim] ** 2, axis=1)))))
        if progress is not None:
            text = f"round {k + 1}: {problem.measurements} measurements, {problem.landmarks} landmarks"
            progress(f"{text}, σ {1e3 * seen.sigma:.0f} mm, moved {moves[-1]:.3f} m")
        if k >= len(DISTANCES) - 1 and moves[-1] < max(STILL[0], STILL[1] * length):
            break
    left = 0 if gps is None else len(gps[0].times) - len(fixes[0])
    if gps is None:
        poses = g.compose(frame_between(start[nodes[0]], poses[0], gravity=some.tilt is not None), poses)
    path = Trajectory(some.times, poses)
    return ScanSkeleton(path, cloud, problem, found, seen.sigma, seen.dropped, len(fixes[0]), left, tuple(moves))


def patch_spread(cloud: ScanReturns, poses: Array) -> float:
    """Spread of the measurements of a path across their patches [m]: 1.48 × the median distance along the normal."""
    return find_patches(cloud, find_surfaces(cloud, poses, SURFACE), poses, DISTANCES[-1], outliers=False).sigma


def _in_space(poses: Array) -> Array:
    """Poses ``(n, 7)``; those of the plane with z = 0."""
    if poses.shape[1] == 7:
        return poses
    out = np.zeros((len(poses), 7))
    out[:, :2], out[:, 5], out[:, 6] = poses[:, :2], np.sin(0.5 * poses[:, 2]), np.cos(0.5 * poses[:, 2])
    return out


def _from_space(poses: Poses, dim: int) -> Array:
    """Poses ``(n, 7)`` or in the plane ``(n, 3)``."""
    if dim == 3:
        return np.column_stack([poses.position, se3.matrix_to_quat(poses.rotation)])
    heading = np.arctan2(poses.rotation[:, 1, 0], poses.rotation[:, 0, 0])
    return np.column_stack([poses.position[:, :2], np.unwrap(heading)])


Fixes = tuple[Index, Array, Array]


def _fixes(gps: tuple[Gps, Array] | None, steps: Scans, poses: Array) -> Fixes:
    """Nodes, positions of the body origin in the frame of the path, and covariances of the fixes.

    The antenna's lever and the motion between fix and node are those of the current path. Fixes beyond the 99.9 %
    quantile, and outside the path, are not used.
    """
    if gps is None:
        return np.zeros(0, np.int64), np.zeros((0, 3)), np.eye(3)[None]
    (z, T), g, path = gps, group_of(poses), Trajectory(steps.times, poses)
    inside = np.flatnonzero((z.times >= path.times[0]) & (z.times <= path.times[-1]))
    antenna = g.transform(path.interpolate(z.times[inside]), np.broadcast_to(z.lever, (len(inside), g.dim)))
    k = np.clip(np.searchsorted(path.times, z.times[inside]), 1, len(poses) - 1)
    k -= z.times[inside] - path.times[k - 1] < path.times[k] - z.times[inside]
    off = g.transform(g.inverse(T), z.positions[inside]) - antenna
    C = z.sigma[inside, None, None] ** 2 * np.eye(g.dim)
    if z.covariances is not None:
        R = rotation_matrices(np.asarray(T)[None])[0]
        C = R.T @ z.covariances[inside] @ R
    good = np.einsum("ki,ki->k", off, np.linalg.solve(C, off[:, :, None])[:, :, 0]) < chi2_quantile(0.999, g.dim)
    position, wide = np.zeros((int(good.sum()), 3)), np.tile(np.eye(3), (int(good.sum()), 1, 1))
    position[:, : g.dim] = (poses[k, : g.dim] + off)[good]
    wide[:, : g.dim, : g.dim] = C[good]
    return k[good], position, wide


def _problem(steps: Scans, poses: Array, seen: PatchObservations, fixes: Fixes) -> SkeletonProblem:
    """The network of one round."""
    n, d, u = len(poses), steps.group.dim, _in_space(steps.odometry.increments[1:])
    rows = np.arange(6) if d == 3 else np.array([3, 4, 2])
    C = np.zeros((n - 1, 6, 6)) + OUT_OF_PLANE**2 * np.eye(6)
    C[:, rows[:, None], rows] = steps.odometry.covariances[1:]
    # errors that persist have their σ in each step
    dt, b, t = np.diff(steps.times), steps.biases, np.arange(3, 6)
    C[:, 2, 2] += (b.yaw_bias * dt) ** 2
    C[:, t, t] += (max(b.scale, b.direction) * np.linalg.norm(u[:, :3], axis=1))[:, None] ** 2
    up, up_sigma = None, np.inf
    if d == 3 and steps.tilt is not None:
        # errors with correlation time τ: differences of readings, and readings of which 2 τ / dt together count as one
        roll, pitch = steps.tilt.T
        up = np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
        sigma, tau = max(steps.tilt_sigma, 1e-5), max(steps.tilt_time, 1e-6)
        up_sigma = sigma * float(np.sqrt(max(2.0 * tau / np.median(dt), 1.0)))
        C[:, :2], C[:, :, :2] = 0.0, 0.0
        C[:, [0, 1], [0, 1]] = (sigma**2 * (1.0 - np.exp(-2.0 * dt / tau)))[:, None] + 1e-12
    first = np.full(6, GAUGE)
    if up is not None:
        first[:2] = FREE
    if len(fixes[0]):
        first[2:] = FREE * np.array([1.0, 100.0, 100.0, 100.0])
    points, normals = np.zeros((2, len(seen.patch), 3))
    points[:, :d], normals[:, :d] = seen.points, seen.normals
    start = _in_space(poses[:1])
    return SkeletonProblem(
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
        landmark=seen.patch,
        first=np.searchsorted(seen.step, np.arange(n + 1)).astype(np.int64),
        odometry_rotation=rotation_matrices(u),
        odometry_translation=u[:, :3],
        odometry_covariance=C,
        range_sigma=seen.sigma,
        bearing_sigma=PATCH,
        start_rotation=rotation_matrices(start)[0],
        start_position=start[0, :3],
        start_covariance=np.diag(first**2),
        up=up,
        up_sigma=up_sigma,
        gps_pose=fixes[0],
        gps_position=fixes[1],
        gps_covariance=fixes[2],
    )
