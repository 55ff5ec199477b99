"""OctoMap's side of the evidence-grid benchmark, through its Python binding, with the binding's own cost taken out.

The binding copies the points of a scan one by one, and a Python call per ray costs as much as a short ray. Both are
measured on the spot with calls that have nothing else to do, and subtracted:

* insertion: as many points, all in the voxel of the origin, so that no ray is walked (each still enters a hash set,
  which is subtracted with the rest: in OctoMap's favour);
* casting: as many rays from an origin in an occupied voxel, where ``castRay`` returns at once.

One core: OMP_NUM_THREADS=1 must be set before OctoMap is loaded.
"""

from __future__ import annotations

import gc
import time

import numpy as np
import octomap

from graphslam.core.geometry import Array
from graphslam.evidence.beams import BeamModel
from tests.benchmarks.evidence_scenes import Scene

World = list[tuple[Array, Array]]


def new_tree(voxel_size: float, model: BeamModel) -> octomap.OcTree:
    """An empty tree with the figures of ``model``."""
    tree = octomap.OcTree(voxel_size)
    tree.setProbHit(model.hit)
    tree.setProbMiss(model.miss)
    tree.setClampingThresMin(model.clamp[0])
    tree.setClampingThresMax(model.clamp[1])
    tree.setOccupancyThres(model.threshold)
    return tree


def insert(scene: Scene, world: World, model: BeamModel, *, lazy: bool) -> tuple[float, octomap.OcTree]:
    """CPU seconds of inserting all scans into a new tree, and the tree."""
    tree = new_tree(scene.voxel_size, model)
    gc.collect()
    start = time.process_time()
    for origin, points in world:
        tree.insertPointCloud(points, origin, scene.max_range, lazy)
    return time.process_time() - start, tree


def conversion(scene: Scene, world: World, model: BeamModel) -> float:
    """CPU seconds the binding spends on the points of those scans, whatever OctoMap does with them."""
    tree = new_tree(scene.voxel_size, model)
    still = [(origin, np.tile(origin, (len(points), 1))) for origin, points in world]
    start = time.process_time()
    for origin, points in still:
        tree.insertPointCloud(points, origin, scene.max_range, True)
    return time.process_time() - start


def classes(tree: octomap.OcTree) -> tuple[Array, Array]:
    """Centres ``(n, 3)`` of the occupied and of the free voxels it knows, pruned leaves as single voxels."""
    tree.updateInnerOccupancy()
    occupied, free = tree.extractPointCloud()
    return np.asarray(occupied, dtype=np.float64).reshape(-1, 3), np.asarray(free, dtype=np.float64).reshape(-1, 3)


def cast(tree: octomap.OcTree, origins: Array, directions: Array, max_range: float) -> tuple[float, np.ndarray, Array]:
    """Cast rays ``(n, 3)`` one by one, through unknown space.

    Returns
    -------
    seconds : float
        CPU time of the loop, calls included.
    hit : (n,) bool
    ends : (n, 3)
        Centre of the voxel where each stopped.
    """
    n = len(directions)
    hit, ends = np.zeros(n, dtype=bool), np.zeros((n, 3))
    rows = list(zip(origins, directions, ends))
    call = tree.castRay
    start = time.process_time()
    for k, (o, d, e) in enumerate(rows):
        hit[k] = call(o, d, e, True, max_range)
    return time.process_time() - start, hit, ends


def call_overhead(tree: octomap.OcTree, origins: Array, directions: Array, max_range: float) -> float:
    """CPU seconds of as many calls that return at once."""
    inside, _ = classes_of_one(tree)
    return cast(tree, np.broadcast_to(inside, origins.shape).copy(), directions, max_range)[0]


def classes_of_one(tree: octomap.OcTree) -> tuple[Array, float]:
    """Centre and edge of some occupied leaf."""
    for leaf in tree.begin_leafs():
        if leaf.getOccupancy() >= tree.getOccupancyThres():
            return np.array(leaf.getCoordinate(), dtype=np.float64), float(leaf.getSize())
    raise ValueError("the tree holds no occupied voxel")
