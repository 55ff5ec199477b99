"""Maps that follow the graph: what re-posing a fused map costs, beside rebuilding it, as ratios of one run.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m tests.benchmarks.bench_maps [NAME …] [--quick] [--turns 3]

Names: ``court``, a small world; ``garage``, two levels, 308 m, 61 beams at 12.5 Hz; ``garage-full``, the same with 181
beams at 37.5 Hz; ``lidar3d-hku1``, recorded (GRAPHSLAM_DATA), all points of all scans. SegSLAM with one particle makes
the submaps; all beams of all steps are in their maps. Pieces are of about 3 m of path.

A loop is closed: the error at the end of the way (3° and 1.5 m) is spread over the last third of the nodes, or over all
of them. CPU seconds of one core, the least of some turns of everything:

* ``log``: from the log, which is in memory: beams moved to where the body was (`make_steps`), and inserted;
* ``scans``: from beams that are kept ready in the frames of the steps, inserted at the new poses;
* ``pieces``: all pieces fused from scratch;
* ``third``, ``all``: the fused map re-posed after the loop. That the map is the same as from scratch is checked.

``--quick``: the court alone, one turn; a missed target is printed, not an error.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from graphslam.app.run.front_ends import recommended_options
from graphslam.core.config import build_config
from graphslam.core.errors import MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.evidence.compact import grid_pieces
from graphslam.evidence.grid import EvidenceGrid
from graphslam.io.catalog import load_recording
from graphslam.maps.fuse import FusedMap, fuse_pieces
from graphslam.maps.pieces import DivisionConfig, PieceId
from graphslam.maps.submaps import divide_submaps
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import crawler_preset
from graphslam.sim.garage import garage
from graphslam.sim.ring_hall import ring_hall
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.front_end import SegSlamFrontEndConfig, submaps_of_best_particle
from graphslam_frontends.segslam.segslam import run_segslam

ALL_POINTS = 1_000_000
NODE_EVERY = 3.0
TARGET = 0.1
"""Re-posing after a loop over rebuilding: no more than this."""


class Scene(NamedTuple):
    """A log, and how its front end is set."""

    name: str
    log: SensorLog
    config: SegSlamFrontEndConfig


def scene(name: str, points: int = ALL_POINTS) -> Scene:
    """A scene by name, with so many beams of a step at most."""
    if name not in ("court", "garage", "garage-full"):
        log = load_recording(name)
        config: Any = build_config(SegSlamFrontEndConfig, recommended_options(log, "segslam")["frontend"])
        config = dataclasses.replace(config, filter=dataclasses.replace(config.filter, map_beams=0))
    else:
        crawler = crawler_preset("full" if name == "garage-full" else "light")
        log = simulate_crawler(ring_hall(seed=9) if name == "court" else garage("A"), seed=9, config=crawler)
        reach = 8.0 if name == "court" else 25.0
        config = SegSlamFrontEndConfig(
            steps=StepConfig(max_range=reach, level_floors=True), filter=GridFilterConfig(walk_scale=0.5)
        )
    steps = dataclasses.replace(config.steps, most_points=points)
    return Scene(name, log, dataclasses.replace(config, steps=steps))


def submaps_of(s: Scene, steps: Steps) -> list[Submap]:
    """The settled chain of one particle."""
    filter = dataclasses.replace(s.config.filter, particles=1)
    result = run_segslam(steps, filter, s.config.segslam, SeedTree(9))
    return submaps_of_best_particle(result, s.config.drift, s.config.segslam)


def bodies_of(submaps: Sequence[Submap], steps: Steps) -> Any:
    """Poses of the body at the steps, along the chain."""
    group = group_of(submaps[0].exit_pose)
    bodies = np.tile(group.identity, (len(steps), 1))
    base = group.identity
    for m in submaps:
        assert m.trajectory is not None
        at = np.searchsorted(steps.times, m.trajectory.times)
        bodies[at] = group.compose(np.broadcast_to(base, m.trajectory.poses.shape), m.trajectory.poses)
        base = group.compose(base, m.exit_pose)
    return bodies


def insert(steps: Steps, bodies: Any, size: float, model: Any) -> EvidenceGrid:
    """A map of all beams, from scratch."""
    grid = EvidenceGrid(size, model=model, dim=steps.dim)
    for k in range(len(steps)):
        points, origins, returns = steps.scan(k)
        if len(points):
            grid.insert_scan(points, origins, pose=bodies[k], max_range=steps.max_range, returns=returns)
    return grid


def corrected(poses: dict[PieceId, Any], share: float) -> dict[PieceId, Any]:
    """Poses after a loop was closed: what was off at the end spread over the last ``share`` of the nodes."""
    names = list(poses)
    group = group_of(poses[names[0]])
    xi = np.zeros(group.dof)
    xi[group.heading] = np.radians(3.0)
    xi[group.position] = 1.5 * np.array([0.8, 0.59, 0.1])[: group.dim]
    n = len(names)
    off = np.clip((np.arange(n) + 1.0 - n * (1.0 - share)) / (n * share), 0.0, 1.0)
    return {name: group.compose(group.exp(o * xi), poses[name]) for name, o in zip(names, off.tolist()) if o > 0}


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of something, and what it gave."""
    begin = time.process_time()
    out = work()
    return time.process_time() - begin, out


def same(a: FusedMap, b: FusedMap) -> bool:
    """Whether two maps are the same to the last bit."""
    x, y = grid_pieces(a.grid), grid_pieces(b.grid)
    return all(np.array_equal(getattr(x, n), getattr(y, n)) for n in ("bricks", "values", "cubes", "cube_values"))


def measure(s: Scene, turns: int) -> dict[str, float]:
    """The table of a scene, printed; ratios by name."""
    steps = make_steps(s.log, s.config.steps)
    submaps = submaps_of(s, steps)
    first: Any = submaps[0].grid
    size, model = first.voxel_size, first.model
    reach = DivisionConfig(reach=1.0 + (steps.max_range or np.inf))
    divided = divide_submaps(submaps, every=NODE_EVERY, config=reach)
    pieces, poses, bodies = divided.pieces, divided.poses, bodies_of(submaps, steps)
    loops = {"third": corrected(poses, 1 / 3), "all": corrected(poses, 1.0)}
    work = fuse_pieces(pieces, poses, model=model)
    work.move(loops["all"])  # compiled and warm
    found: dict[str, list[float]] = {}
    for _ in range(turns):
        made, fresh = seconds(partial(make_steps, s.log, s.config.steps))
        inserted, _ = seconds(partial(insert, fresh, bodies, size, model))
        fused, scratch = seconds(partial(fuse_pieces, pieces, poses, model=model))
        turn = {"log": made + inserted, "scans": inserted, "pieces": fused}
        for name, loop in loops.items():
            work.move(poses, tolerance=0.0)
            turn[name], change = seconds(partial(work.move, loop))
            turn[f"{name} moved"] = change.moved
            turn[f"{name} summed"] = change.summed
            again = fuse_pieces(pieces, work.poses, model=model)
            if not same(work, again) or work.entropy() != again.entropy():
                raise AssertionError(f"{s.name}: the map re-posed ({name}) is not the map from scratch")
        for name, value in turn.items():
            found.setdefault(name, []).append(float(value))
    best = {name: min(values) for name, values in found.items()}
    beams = sum(len(steps.scan(k)[0]) for k in range(len(steps)))
    print(
        f"{s.name}: {len(steps)} steps, {beams / 1e6:.2f} M beams, {len(submaps)} submaps, {len(pieces)} pieces of "
        f"{sum(p.known for p in pieces.values()) / 1e6:.2f} M known voxels, map {scratch.known_volume():.0f} "
        f"m{'³' if scratch.dim == 3 else '²'}, {scratch.nbytes / 1e6:.0f} MB with its pieces"
    )
    print("  CPU ms: " + ", ".join(f"{k} {1e3 * best[k]:.1f}" for k in ("log", "scans", "pieces", "third", "all")))
    ratios = {}
    for loop in loops:
        moved = f"{int(best[f'{loop} moved'])} pieces, {int(best[f'{loop} summed'])} bricks"
        for over in ("log", "scans", "pieces"):
            # both of one turn: what slows the machine for a while slows both
            r = float(np.median(np.array(found[loop]) / np.array(found[over])))
            ratios[f"{loop} / {over}"] = r
            print(f"  {loop:>5} ({moved}) / {over:<6} {r:8.3f}  {'met' if r <= TARGET else 'not met'} (<= {TARGET:g})")
    return ratios


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    """All scenes asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=[])
    parser.add_argument("--quick", action="store_true", help="the small world, one turn")
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args(arguments)
    names = options.names or (["court"] if options.quick else ["garage", "garage-full", "lidar3d-hku1"])
    out = {}
    for name in names:
        try:
            s = scene(name)
        except MissingDataError:
            print(f"{name} left out: no recording (set GRAPHSLAM_DATA)")
            continue
        out[name] = measure(s, 1 if options.quick else options.turns)
    return out


if __name__ == "__main__":
    main()
