"""Evidence grids against OctoMap and against their own limits: same scans, same run, one core, as ratios.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m tests.benchmarks.bench_evidence [--quick | --full] [--png FILE]

Times are process CPU seconds of three turns or more of both programs, ratios the medians of the turns' ratios. OctoMap
(lazy insertion, points already in the frame of the map) is called through its Python binding, whose own cost is
measured and taken out; ours is all in, transformation of the points and checks of the input included. Scenes: see
:mod:`tests.benchmarks.evidence_scenes`; the recorded ones need GRAPHSLAM_DATA.

Without options: everything but the 200 m loop. ``--full``: that too, 100 particles (minutes). ``--quick``: two scenes
of fewer scans, nothing compiled anew, no loop, and a missed target is printed, not an error.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before OctoMap is loaded, which may have been built with threads

import argparse
import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from graphslam.core.random import SeedTree
from graphslam.core.se3 import quat_rotate, se3_compose, se3_exp, se3_transform
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.evidence.queries import HIT, INSIDE, cast_beams
from tests.benchmarks import evidence_filter, evidence_octomap, evidence_scenes
from tests.benchmarks.evidence_scenes import Scene

MODEL = BeamModel()
SCENES: dict[str, tuple[Callable[..., Scene | None], tuple[int, int]]] = {  # scans: all, quick
    "tunnel": (evidence_scenes.tunnel, (1000, 100)),
    "street": (evidence_scenes.street, (10, 1)),
    "kitti": (evidence_scenes.kitti, (10, 1)),
    "hall": (evidence_scenes.hall, (10, 1)),
}
QUICK = ("tunnel", "kitti")
"""Scenes of a quick run: one of many small scans, one of a large one."""


class Targets:
    """The stated limits and what was measured."""

    def __init__(self) -> None:
        self.missed = 0

    def most(self, name: str, value: float, limit: float) -> None:
        """A figure that must not be above its limit."""
        self._report(name, value, limit, value <= limit, "<=")

    def least(self, name: str, value: float, limit: float) -> None:
        """A figure that must not be below its limit."""
        self._report(name, value, limit, value >= limit, ">=")

    def _report(self, name: str, value: float, limit: float, good: bool, sign: str) -> None:
        self.missed += not good
        print(f"{'pass' if good else 'MISS':<5} {name:<62} {value:9.3f} {sign} {limit:g}", flush=True)


def insert(scene: Scene) -> tuple[float, EvidenceGrid]:
    """CPU seconds of inserting all scans into a new grid in a new pool, and the grid."""
    grid = EvidenceGrid(scene.voxel_size, model=MODEL)
    gc.collect()
    start = time.process_time()
    for pose, points in zip(scene.poses, scene.clouds):
        grid.insert_scan(points, pose=pose, max_range=scene.max_range)
    return time.process_time() - start, grid


def visits(scene: Scene) -> int:
    """Voxels that the beams pass, end voxels included: steps along the axes plus one."""
    total = 0
    for pose, points in zip(scene.poses, scene.clouds):
        far = np.linalg.norm(points, axis=1, keepdims=True)
        ends = np.floor(se3_transform(pose, points * np.minimum(1.0, scene.max_range / far)) / scene.voxel_size)
        total += int(np.abs(ends - np.floor(pose[:3] / scene.voxel_size)).sum()) + len(points)
    return total


class Maps(NamedTuple):
    """Our map of a scene; OctoMap's, pruned as it went; OctoMap's by lazy insertion, where a leaf is a voxel."""

    grid: EvidenceGrid
    pruned: Any
    lazy: Any


def insertion(scenes: list[Scene], repetitions: int) -> tuple[float, dict[str, Maps]]:
    """Geometric mean of OctoMap's time over ours, and the maps of both."""
    print("insertion: OctoMap lazy insertPointCloud / ours")
    print(
        f"  {'scene':<8} {'rays':>9} {'OctoMap':>9} {'binding':>8} {'ours':>8} {'ratio':>7} {'ns/visit':>9}"
        f" {'rays/s':>9}"
    )
    maps, ratios = {}, []
    for scene in scenes:
        world = scene.world()
        rays = sum(len(c) for c in scene.clouds)
        theirs, own, ours = [], [], []
        for _ in range(repetitions):
            seconds, grid = insert(scene)
            ours.append(seconds)
            seconds, lazy = evidence_octomap.insert(scene, world, MODEL, lazy=True)
            theirs.append(seconds)
            own.append(evidence_octomap.conversion(scene, world, MODEL))
        t, b, o = (float(np.median(v)) for v in (theirs, own, ours))
        ratios.append(median_ratio(theirs, own, ours))
        line = f"  {scene.name:<8} {rays:>9} {t:8.3f}s {b:7.3f}s {o:7.4f}s {ratios[-1]:7.1f}"
        print(f"{line} {1e9 * o / visits(scene):9.2f} {rays / o / 1e6:7.2f} M", flush=True)
        maps[scene.name] = Maps(grid, evidence_octomap.insert(scene, world, MODEL, lazy=False)[1], lazy)
    return float(np.exp(np.mean(np.log(ratios)))), maps


def median_ratio(theirs: list[float], overhead: list[float], ours: list[float]) -> float:
    """Median over the turns of OctoMap's time over ours: what slows the machine for a while slows both of one turn."""
    return float(np.median((np.array(theirs) - np.array(overhead)) / np.array(ours)))


def agreement(maps: Maps) -> tuple[float, int, int]:
    """Share of the voxels OctoMap knows that we know in the same class; voxels known to OctoMap and to us."""
    same, known = 0, 0
    for points, occupied in zip(evidence_octomap.classes(maps.lazy), (True, False)):
        values = maps.grid.values_at(points).astype(np.int64)
        same += int(np.sum((values != UNKNOWN) & ((values >= MODEL.threshold_step) == occupied)))
        known += len(points)
    return same / known, known, int(np.sum(maps.grid.brick_values() != UNKNOWN))


def probes(scene: Scene, number: int) -> list[tuple[Any, Any]]:
    """Poses and unit directions of about ``number`` beams: those of some scans, the pose 5 cm and half a degree off."""
    rng = SeedTree(7).child("probes", scene.name).generator()
    every = max(1, sum(len(c) for c in scene.clouds) // number)
    if len(scene) > 100:  # whole scans of few beams, else some beams of all scans
        scans, beams = range(0, len(scene), every), slice(None)
    else:
        scans, beams = range(len(scene)), slice(None, None, every)
    out = []
    for k in scans:
        points = scene.clouds[k][beams]
        off = np.concatenate([rng.normal(scale=np.radians(0.5), size=3), rng.normal(scale=0.05, size=3)])
        directions = points / np.linalg.norm(points, axis=1, keepdims=True)
        out.append((se3_compose(scene.poses[k], se3_exp(off)), directions))
    return out


def casting(scenes: list[Scene], maps: dict[str, Maps], repetitions: int, number: int) -> float:
    """Geometric mean of the time of ``castRay`` over that of ours.

    Of two passes in a row the second counts, for both: the other program's map has left the cache by then.
    """
    print("ray casting: OctoMap castRay(ignoreUnknown) / ours")
    print(
        f"  {'scene':<8} {'rays':>7} {'OctoMap':>9} {'calls':>8} {'ours':>8} {'ratio':>7} {'rays/s':>9} {'same end':>9}"
    )
    ratios = []
    for scene in scenes:
        grid, tree, _ = maps[scene.name]
        jobs = probes(scene, number)
        origins = np.concatenate([np.tile(p[:3], (len(d), 1)) for p, d in jobs])
        directions = np.concatenate([quat_rotate(p[3:], d) for p, d in jobs])
        theirs, calls, ours = [], [], []
        for _ in range(repetitions):
            for _ in range(2):
                start = time.process_time()
                for pose, beams in jobs:
                    cast_beams(grid, np.zeros(3), beams, scene.max_range, pose=pose)
                seconds = time.process_time() - start
            ours.append(seconds)
            for _ in range(2):
                seconds, hit, ends = evidence_octomap.cast(tree, origins, directions, scene.max_range)
            theirs.append(seconds)
            calls.append(evidence_octomap.call_overhead(tree, origins, directions, scene.max_range))
        t, c, o = (float(np.median(v)) for v in (theirs, calls, ours))
        ratios.append(median_ratio(theirs, calls, ours))
        found = [cast_beams(grid, np.zeros(3), b, scene.max_range, pose=p, voxels=True) for p, b in jobs]
        met = np.isin(np.concatenate([c.status for c in found]), (HIT, INSIDE))
        theirs_ends = np.floor(ends / scene.voxel_size).astype(np.int64)
        same = (met == hit) & (~hit | np.all(np.concatenate([c.voxels for c in found]) == theirs_ends, axis=1))
        line = f"  {scene.name:<8} {len(origins):>7} {t:8.3f}s {c:7.3f}s {o:7.4f}s {ratios[-1]:7.1f}"
        print(f"{line} {len(origins) / o / 1e6:7.2f} M {same.mean():8.2%}", flush=True)
    return float(np.exp(np.mean(np.log(ratios))))


def copying(grids: list[tuple[str, EvidenceGrid]]) -> float:
    """Largest time of a copy and its release [µs], over maps of all sizes."""
    worst = 0.0
    for name, grid in grids:
        best = np.inf
        for _ in range(7):
            start = time.process_time()
            for _ in range(5000):
                grid.copy()
            best = min(best, (time.process_time() - start) / 5000 * 1e6)
        worst = max(worst, best)
        print(f"  {name:<8} {grid.pool.used_bytes / 1e6:8.2f} MB, {best:6.3f} µs a copy", flush=True)
    return worst


def first_after_copy(scene: Scene, grid: EvidenceGrid, rounds: int) -> tuple[float, float]:
    """Median CPU time [s] of a scan into a map that a copy shares wholly, and of a scan into one that none shares.

    A walk along the path a second time, every other scan with a copy taken before; turns change from round to round.
    """
    work = grid.copy()
    first: list[float] = []
    warm: list[float] = []
    work.insert_scan(scene.clouds[0], pose=scene.poses[0], max_range=scene.max_range)
    for turn in range(rounds):
        for k, (pose, points, _) in enumerate(scene):
            shared = (k + turn) % 2 == 0
            held = work.copy() if shared else None
            start = time.perf_counter()
            work.insert_scan(points, pose=pose, max_range=scene.max_range)
            (first if shared else warm).append(time.perf_counter() - start)
            del held
    return float(np.median(first)), float(np.median(warm))


def single_map_memory(scene: Scene, grid: EvidenceGrid, tree: Any) -> tuple[float, float]:
    """Our used bytes and our pool's allocated bytes over OctoMap's memoryUsage()."""
    ours, room, theirs = grid.pool.used_bytes, grid.pool.nbytes, tree.memoryUsage()
    print(
        f"  {scene.name:<8} ours {ours / 1e6:7.2f} MB used, {room / 1e6:7.2f} MB allocated; OctoMap "
        f"{theirs / 1e6:7.2f} MB: {ours / theirs:.3f}, {room / theirs:.3f}",
        flush=True,
    )
    return ours / theirs, room / theirs


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="two scenes of fewer scans, no 200 m loop")
    size.add_argument("--full", action="store_true", help="100 particles on the 200 m loop too")
    parser.add_argument("--png", type=Path, help="draw the memory of the particles over the loop (with --full)")
    parser.add_argument("--scenes", nargs="+", choices=SCENES)
    options = parser.parse_args(arguments)
    compile_seconds, start_seconds = evidence_filter.start_up(compiled=0 if options.quick else 3)
    targets = Targets()
    scenes = []
    for name in options.scenes or (QUICK if options.quick else SCENES):
        make, counts = SCENES[name]
        scene = make(counts[options.quick])
        if scene is None:
            print(f"{name} left out: no recording (set GRAPHSLAM_DATA), or no scan matcher for its poses")
        else:
            scenes.append(scene)
    insert(scenes[0].first(2))  # compiled kernels are loaded on first use
    mean_insert, maps = insertion(scenes, 1 if options.quick else 5)
    mean_cast = casting(scenes, maps, 3 if options.quick else 7, 5_000 if options.quick else 20_000)
    print("classes of the voxels known to OctoMap")
    worst_agreement = 1.0
    for scene in scenes:
        share, theirs, ours = agreement(maps[scene.name])
        worst_agreement = min(worst_agreement, share)
        print(f"  {scene.name:<8} {share:.4%} the same; OctoMap knows {theirs}, we {ours}", flush=True)
    print("copies")
    small = insert(scenes[0].first(2))[1]
    worst_copy = copying([("2 scans", small), *((n, m.grid) for n, m in maps.items())])
    worst_first = 0.0
    for scene in scenes:
        first, warm = first_after_copy(
            scene, maps[scene.name].grid, max(2, 400 // len(scene) // (4 if options.quick else 1))
        )
        worst_first = max(worst_first, first / warm)
        print(
            f"  {scene.name:<8} first scan {1e3 * first:.3f} ms, warm {1e3 * warm:.3f} ms: {first / warm:.2f}",
            flush=True,
        )
    print("memory of a single map")
    memory = [single_map_memory(s, insert(s)[1], maps[s.name].pruned) for s in scenes]
    step = evidence_filter.filter_step(scans=120 if options.quick else 400)
    print("targets")
    targets.least("insertion, geometric mean", mean_insert, 15)
    targets.least("ray casting, geometric mean", mean_cast, 12)
    targets.least("voxels known to OctoMap in the same class, worst scene [%]", 100 * worst_agreement, 99.5)
    targets.most("copy, worst [µs]", worst_copy, 2.0)
    targets.most("first scan after a copy / warm one, worst scene", worst_first, 1.6)
    targets.most("single map / OctoMap, used memory, worst scene", max(m[0] for m in memory), 0.3)
    targets.least("filter step, 40 particles, one core [× real time]", step, 4)
    if not options.quick:
        targets.most("cold compilation [s]", compile_seconds, 10)
    targets.most("cached start [s]", start_seconds, 0.5)
    if options.full:
        end, peak = evidence_filter.particle_memory(scans=7500, particles=100, png=options.png)
        targets.most("100 particles, 200 m, end / one map", end, 3)
        targets.most("100 particles, 200 m, peak / one map", peak, 8)
        end, peak = evidence_filter.particle_memory(scans=7500, particles=100, every=10)
        targets.most("100 particles, resampled every 10 scans, end / one map", end, 3)
        targets.most("100 particles, resampled every 10 scans, peak / one map", peak, 8)
    return 1 if targets.missed and not options.quick else 0  # a quick run is too short, and CI's machine too busy


if __name__ == "__main__":
    sys.exit(main())
