"""One trial of the surface study: scans along a part of a simulated world, and surfaces by several methods."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.core.point_clouds import PointClouds
from graphslam.core.random import SeedTree
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.maps.surface.layer import SurfaceLayer
from graphslam.maps.surface.mesh import Mesh, zero_set
from graphslam.maps.surface.piece import Scan, SurfaceConfig, normals_of
from graphslam.sim.garage import garage
from graphslam.sim.raycast import RayCaster
from graphslam.sim.world import World
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.campus_config import CampusConfig
from graphslam_studies.sim.campus_world import campus
from graphslam_studies.sim.lidar import LidarConfig, simulate_lidar

SAMPLES = 60_000
"""Number of sample points per surface."""
SEEN = 0.1
"""A point of the true surface is observed if three true beam end points are within this distance [m]."""


@dataclass(frozen=True, kw_only=True)
class SurfaceTrialConfig:
    """World, lidar, and settings of the surfaces."""

    world: str = "garage"
    """``garage`` (with a random layout) or ``campus``."""
    voxel: float = 0.05
    """[m]"""
    seconds: float = 10.0
    """Duration of the drive [s]."""
    per_piece: int = 4
    """Scans per piece."""
    smoothings: tuple[float, ...] = (0.0, 0.1, 0.3)
    """λ of the level sets; 0.1 is the default of the package."""
    beside: bool = True
    """Also compute the other methods."""
    pose_sigma: tuple[float, float] = (0.005, math.radians(0.1))
    """σ of position [m] and rotation [rad] of each scan, per axis."""
    lidar: LidarConfig = field(
        default_factory=lambda: LidarConfig(rate=4.0, points=32_000, lines=64, elevation=(-45.0, 45.0))
    )
    surface: SurfaceConfig = field(default_factory=lambda: SurfaceConfig(most_range=8.0))

    def __post_init__(self) -> None:
        if self.world not in ("garage", "campus"):
            raise ConfigError(f"surface study: world = {self.world!r}; known: garage, campus")


@dataclass(frozen=True)
class Seen:
    """Noisy scans of a drive, and the points of the true surface that they observed."""

    world: World
    scans: list[Scan]
    poses: Array
    places: Array
    area: float
    """Area of the observed part of the true surface [m²]."""


def look(c: SurfaceTrialConfig, seed: int) -> Seen:
    """Simulate the lidar along the first part of the world."""
    tree = SeedTree(int(seed)).child("surface study", c.world)
    r = tree.generator()
    world = garage("ABC"[int(r.integers(3))], seed=seed) if c.world == "garage" else campus(CampusConfig(), seed=seed)
    log = simulate_lidar(world, seed, c.lidar, most=c.seconds)
    true = simulate_lidar(world, seed, replace(c.lidar, range_sigma=0.0), most=c.seconds)
    assert log.truth is not None
    assert log.truth.trajectory is not None
    clouds, exact = log.streams["clouds"], true.streams["clouds"]
    assert isinstance(clouds, PointClouds)
    assert isinstance(exact, PointClouds)
    path = log.truth.trajectory
    scans, poses, ends = [], [], []
    for k, t in enumerate(clouds.times):
        age = clouds.ages(k)
        assert age is not None
        at = path.interpolate(t - age)  # pose at the time of each point: the scan has no motion distortion
        T = path.interpolate(np.array([t]))[0]
        error = se3.se3_exp(r.normal(0.0, [c.pose_sigma[1]] * 3 + [c.pose_sigma[0]] * 3))
        noisy = se3.se3_compose(T, error)
        world_points = se3.se3_transform(at, np.asarray(clouds.cloud(k), dtype=np.float64))
        local = se3.se3_transform(np.broadcast_to(se3.se3_inverse(T), at.shape), world_points)
        scans.append((se3.se3_transform(np.broadcast_to(noisy, at.shape), local), noisy[:3]))
        poses.append(noisy)
        hit = np.asarray(exact.cloud(k), dtype=np.float64)
        near = np.linalg.norm(hit, axis=1) < c.surface.most_range
        ends.append(se3.se3_transform(at, hit)[near])
    whole = Mesh(world.vertices, world.triangles.astype(np.int64))
    places = _near_samples(whole, np.array(poses)[:, :3], c.surface.most_range, r)
    reach = cKDTree(np.concatenate(ends)).query(places[0], k=3, distance_upper_bound=SEEN)[0]
    seen = np.isfinite(reach[:, 2])
    return Seen(world, scans, np.array(poses), places[0][seen], places[1] * float(seen.mean()))


def _near_samples(mesh: Mesh, places: Array, reach: float, r: np.random.Generator) -> tuple[Array, float]:
    """Samples of the part of a mesh within the bounding box of places plus ``reach``, and the area of this part."""
    low, high = places.min(axis=0) - reach, places.max(axis=0) + reach
    corners = mesh.vertices[mesh.triangles]
    inside = np.all((corners.max(axis=1) > low) & (corners.min(axis=1) < high), axis=1)
    part = Mesh(mesh.vertices, mesh.triangles[inside])
    area = part.area()
    return part.samples(8 * SAMPLES, r), area


def surface_of(scans: list[Scan], poses: Array, c: SurfaceConfig, per_piece: int) -> SurfaceLayer:
    """A surface layer of scans, with ``per_piece`` scans per piece."""
    layer = SurfaceLayer(c)
    for k in range(0, len(scans), per_piece):
        layer.read(k // per_piece, scans[k : k + per_piece], poses[k])
    return layer


def run_surface_trial(config: SurfaceTrialConfig, seed: int) -> Iterator[Measurement]:
    """Reconstruct surfaces and compare them with ground truth.

    Yields
    ------
    Measurement
        ``f_2cm``, ``f_5cm``, ``mean_mm``, ``area_ratio`` of every method; its CPU time; memory and bricks per m²;
        ``follow_same`` and ``follow_over_rebuild`` of a move of a tenth of the pieces.
    """
    c = config
    seen = look(c, seed)
    judge = Judge(seen, SeedTree(int(seed)).child("surface judge").generator())
    base = replace(c.surface, voxel=c.voxel)
    variants = {f"level-set {s:g}": replace(base, smoothing=s) for s in c.smoothings}
    if c.beside:
        variants["planes, no carving"] = replace(base, smoothing=0.0, carving=False, steps=0, redistance_steps=0)
        variants["ray tsdf"] = replace(variants["planes, no carving"], data="rays")
    for name, made in variants.items():
        begin = process_time()
        layer = surface_of(seen.scans, seen.poses, made, c.per_piece)
        pieces_s = process_time() - begin
        mesh = zero_set(layer.bricks(), c.voxel)
        seconds = process_time() - begin
        yield Measurement(name, "seconds", seconds, timing=True)
        yield Measurement(name, "evolve_and_mesh_s", seconds - pieces_s, timing=True)
        yield Measurement(name, "us_per_point", 1e6 * seconds / sum(len(p) for p, _ in seen.scans), timing=True)
        yield Measurement(name, "us_per_m2", 1e6 * (seconds - pieces_s) / seen.area, timing=True)
        yield Measurement(name, "bricks_per_m2", len(layer) / seen.area)
        yield Measurement(name, "kb_per_m2", layer.nbytes / seen.area / 1e3)
        yield from judge.of(name, mesh)
        if made.smoothing == SurfaceConfig().smoothing and made.carving:
            yield from _follow(name, layer, c, seconds)
    if not c.beside:
        return
    begin = process_time()
    mesh = log_odds_mesh(seen.scans, c.voxel, c.surface.most_range)
    yield Measurement("log-odds", "seconds", process_time() - begin, timing=True)
    yield from judge.of("log-odds", mesh)
    begin = process_time()
    mesh = poisson_mesh(seen.scans, base)
    yield Measurement("poisson", "seconds", process_time() - begin, timing=True)
    yield from judge.of("poisson", mesh)


def _follow(name: str, layer: SurfaceLayer, c: SurfaceTrialConfig, rebuild_s: float) -> Iterator[Measurement]:
    """Move a tenth of the pieces, as after a loop closure; time of the update relative to the reconstruction."""
    from graphslam.maps.surface.mesh import Mesher

    mesher = Mesher(c.voxel)
    mesher.update(*layer.bricks())
    count = max(len(layer.pieces) // 10, 1)
    shift = se3.se3_exp(np.array([0.0, 0.0, 0.01, 0.08, -0.05, 0.03]))
    moved = {k: se3.se3_compose(shift, layer.poses[k]) for k in list(layer.pieces)[:count]}
    begin = process_time()
    layer.move(moved)
    changed = layer.update()
    mesher.update(*layer.bricks(), changed)
    followed = mesher.mesh()
    spent = process_time() - begin
    again = SurfaceLayer(layer.config)
    for k, piece in layer.pieces.items():
        again.add(k, piece, layer.poses[k])
    fresh = zero_set(again.bricks(), c.voxel)
    same = np.array_equal(fresh.vertices, followed.vertices) and np.array_equal(fresh.triangles, followed.triangles)
    yield Measurement(name, "follow_same", float(same))
    yield Measurement(name, "moved_share", count / len(layer.pieces))
    yield Measurement(name, "follow_over_rebuild", spent / rebuild_s, timing=True)


class Judge:
    """Compares surfaces with ground truth in both directions (precision and recall)."""

    def __init__(self, seen: Seen, r: np.random.Generator) -> None:
        self.seen, self.r = seen, r
        self.truth = RayCaster.of(seen.world).distances

    def of(self, name: str, mesh: Mesh) -> Iterator[Measurement]:
        """Metrics of one surface."""
        if not len(mesh.triangles):
            return
        to_truth = self.truth(mesh.samples(SAMPLES, self.r))
        places = self.seen.places[self.r.permutation(len(self.seen.places))[:SAMPLES]]
        to_mesh = RayCaster(mesh.vertices, mesh.triangles).distances(places)
        for d, what in ((0.02, "f_2cm"), (0.05, "f_5cm")):
            precision, recall = float(np.mean(to_truth < d)), float(np.mean(to_mesh < d))
            yield Measurement(name, what, 2.0 * precision * recall / max(precision + recall, 1e-12))
            if d == 0.05:
                yield Measurement(name, "precision_5cm", precision)
                yield Measurement(name, "recall_5cm", recall)
        yield Measurement(name, "mean_mm", 1e3 * float(np.mean(np.minimum(to_truth, 0.5))))
        yield Measurement(name, "area_ratio", mesh.area() / self.seen.area)
        yield Measurement(name, "seen_m2", self.seen.area)


def log_odds_mesh(scans: list[Scan], voxel: float, most_range: float) -> Mesh:
    """Marching cubes on the log-odds of an evidence grid: surface where the probability is 0.5."""
    grid = EvidenceGrid(voxel)
    for points, origin in scans:
        grid.insert_scan(points[np.linalg.norm(points - origin, axis=1) < most_range], origin=origin)
    values = grid.brick_values()
    return zero_set((grid.brick_coordinates(), -values / 2048.0, values != UNKNOWN), voxel)


def poisson_mesh(scans: list[Scan], c: SurfaceConfig) -> Mesh:
    """Screened Poisson surface of Open3D from the same points and normals, with cells not larger than voxels, without
    parts farther than three voxels from every point."""
    o3d = import_extra("open3d", "a Poisson surface")
    points = np.concatenate([p[np.linalg.norm(p - o, axis=1) < c.most_range] for p, o in scans])
    origins = np.concatenate(
        [np.broadcast_to(o, (int(np.sum(np.linalg.norm(p - o, axis=1) < c.most_range)), 3)) for p, o in scans]
    )
    normals = normals_of(points, origins, c)
    flat = np.isfinite(normals[:, 0])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[flat]))
    cloud.normals = o3d.utility.Vector3dVector(normals[flat])
    extent = float(np.max(np.ptp(points, axis=0))) * 1.1
    depth = math.ceil(math.log2(extent / c.voxel))
    made, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    vertices, triangles = np.asarray(made.vertices), np.asarray(made.triangles).astype(np.int64)
    near = cKDTree(points).query(vertices, distance_upper_bound=3.0 * c.voxel)[0] < 3.0 * c.voxel
    return Mesh(vertices, triangles[near[triangles].all(axis=1)])
