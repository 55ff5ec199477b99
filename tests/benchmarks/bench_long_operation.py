"""Locked and merged submaps (SegSLAM, section 6): many laps of random halls with thin walls and walking persons.

``python -m tests.benchmarks.bench_long_operation [--worlds N] [--laps N] [--particles N] [--part lock|merge]``: the
robot circles a partition of 5 cm, which it sees from both sides. Hall, screens, clutter, persons, and errors of the
robot are random in each world. Printed: means over the worlds with 95 % intervals of Student's t, and paired
differences.

*Locking*: SegSLAM, where particles that enter a map with the scans of 1 or 3 visits do not update it, and without
locks, in the maps of the last lap; ``first``: in those of the first lap, without locks. *Merging*: maps of lap 1 and of
lap 2, each from its own filter; ``merged``: sum of both under their registration; ``one``: one filter over both laps.
Windows of lap 3 are localised in them.

``kept``: share of the known points of thin walls that are within 0.2 m of the centre of an occupied voxel; ``free``:
share of these points that are in a free voxel; ``false``: share of the occupied voxels farther than 0.3 m from any
surface; ``entropy``: nat per known voxel; ``pose``: RMS position error in the map; ``path``: RMS position error of a
map sample after alignment.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.config import preset
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.config import merge_options
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3, remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.core.se3 import se3_transform
from graphslam.evaluate.trajectory_error import ate
from graphslam.evidence.grid import EvidenceGrid
from graphslam.registration.config import RegistrationConfig
from graphslam.registration.register import register
from graphslam.registration.target import Target
from graphslam.sim.clutter import KeepClear, scatter_obstacles
from graphslam.sim.crawler import crawler_motion, simulate_crawler, start_frame
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.crawler_sensors import cast_scans
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.raycast import RayCaster
from graphslam.sim.route import plan_route
from graphslam.sim.world import World, describe_route
from graphslam_frontends.grid.filter import GridFilter
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.localisation import localise_in_map
from graphslam_frontends.segslam.segmap import MATCH, SAME
from graphslam_frontends.segslam.segslam import SegSlamFilter
from graphslam_frontends.segslam.submaps import common_ancestor_chain
from graphslam_frontends.segslam.window import gather_look_ahead
from graphslam_studies.sim.movers import MovingObjects, draw_movers
from tests.benchmarks.bench_paper_preset import interval

COURT = preset("court.segslam")["frontend"]
ROBOT = CrawlerConfig(drift=0.02, max_range=8.0)
HEIGHT, THIN = 2.7, 0.05
LOCKS = {"off": 0, "lock=1": 1, "lock=3": 3}


def draw_hall(seed: int, laps: int) -> tuple[World, Array]:
    """A hall with a partition in its middle and screens along its walls, and points on these thin walls ``(n, 3)``."""
    rng = SeedTree(seed).child("hall").generator()
    x1, y1 = rng.uniform(12.0, 16.0), rng.uniform(7.0, 9.0)
    mesh = MeshBuilder()
    mesh.slab((-0.3, -0.3, x1 + 0.3, y1 + 0.3), 0.0)
    mesh.slab((-0.3, -0.3, x1 + 0.3, y1 + 0.3), HEIGHT + 0.3)
    ring = [(-0.15, -0.15), (x1 + 0.15, -0.15), (x1 + 0.15, y1 + 0.15), (-0.15, y1 + 0.15)]
    for a, b in zip(ring, ring[1:] + ring[:1]):
        mesh.wall(a, b, 0.0, HEIGHT, thickness=0.3)
    # not in the middle: the two lanes must not look alike
    left, right = (3.0, 2.7 + rng.uniform(0.0, 0.3)), (x1 - 3.0, 3.1 + rng.uniform(0.0, 0.3))
    thin = [(left, right), (right, (right[0], right[1] + 1.2))]
    for x in rng.uniform(1.5, x1 - 1.5, 2):  # screens at right angles to one long wall
        thin.append(((x, y1 - 0.8), (x, y1)))
    mesh.box((0.45 * x1, 3.6, 0.0), (0.45 * x1 + rng.uniform(0.8, 2.0), 4.2, rng.uniform(0.8, HEIGHT)))
    points = []
    for a, b in thin:
        mesh.wall(a, b, 0.0, HEIGHT, thickness=THIN)
        u, z = np.meshgrid(np.arange(0.1, 0.95, 0.02), np.arange(0.3, HEIGHT - 0.2, 0.2))
        points.append(np.column_stack([np.outer(1.0 - u, a) + np.outer(u, b), z.ravel()]))
    corners = [(1.5, 1.5), (x1 - 1.5, 1.5), (x1 - 1.5, y1 - 1.5), (1.5, y1 - 1.5)]
    plan = [(2.5, 1.5), *(corners[1:] + corners[:1]) * laps, (x1 / 2, 1.5)]
    waypoints = np.array([(x, y, 0.0) for x, y in plan])
    route = plan_route(waypoints, 0.9, where="hall")
    clear = KeepClear(route, margin=0.62)
    scatter_obstacles(mesh, (0.0, 0.0, x1, 0.8), 0.0, 3, clear, rng)
    scatter_obstacles(mesh, (0.0, y1 - 0.8, x1, y1), 0.0, 3, clear, rng)
    vertices, triangles = mesh.build()
    meta = {"kind": "hall", "levels": [0.0], "size": [x1, y1], **describe_route(route)}
    world = World(
        name="hall", vertices=vertices, triangles=triangles, waypoints=waypoints, corner_radius=0.9, speed=0.75,
        meta=meta,
    )  # fmt: skip
    return world, np.concatenate(points)


def drive(world: World, seed: int, persons: int) -> SensorLog:
    """The log of a drive among persons, who walk beside the route."""
    log = simulate_crawler(world, seed, ROBOT)
    caster, motion = RayCaster.of(world), crawler_motion(world, ROBOT)
    x1, y1 = world.meta["size"]
    ends = np.array([[[1.0, y], [x1 - 1.0, y]] for y in (0.5, 2.4, y1 - 2.4, y1 - 0.5)])
    truth, seeds = motion.trajectory(), SeedTree(seed).child("persons")
    lines = [("person", a, b, 0.0) for a, b in ends]
    movers = draw_movers(lines, 2 * persons, truth.times, truth.positions, seeds.generator(), distance=0.3)
    scans: Any = log["scanner"]
    nearer = MovingObjects(movers, scans.ranges.shape, ROBOT.max_range)
    scans = cast_scans(scans, motion, caster, ROBOT, seeds.child("scanner"), nearer=nearer)
    return replace(log, streams={**log.streams, "scanner": scans})


class Judge:
    """Maps against the true surfaces."""

    def __init__(self, world: World, thin: Array, steps: Steps) -> None:
        assert steps.truth is not None
        self.caster, self.thin, self.truth = RayCaster.of(world), thin, steps.truth.interpolate(steps.times)
        self.T_world_frame = start_frame(crawler_motion(world, ROBOT))

    def frame(self, step: int, entry: Array) -> Array:
        """``T_truth_map`` of the map of a segment that begins with ``entry``, ``T_map_body``."""
        T = SE3.compose(remove_roll_pitch(self.truth[step]), SE3.inverse(remove_roll_pitch(entry)))
        return np.asarray(T)

    def figures(self, grid: EvidenceGrid, T_truth_map: Array) -> dict[str, float]:
        """Figures of a map."""
        T = SE3.compose(self.T_world_frame, T_truth_map)
        occupied = np.asarray(grid.occupied_cloud())
        points = se3_transform(SE3.inverse(T)[None], self.thin)
        odds = grid.log_odds_at(points)
        known = np.isfinite(odds)
        near = cKDTree(occupied).query(points[known])[0] <= 0.2
        volume = grid.known_volume()
        return {
            "kept": float(near.mean()),
            "free": float(np.mean(odds[known] < 0.0)),
            "false": float(np.mean(self.caster.distances(se3_transform(T[None], occupied)) > 0.3)),
            "entropy": grid.entropy() / volume,
        }


class LockingFilter(SegSlamFilter):
    """SegSLAM, where maps with the scans of ``lock`` visits are locked when they are entered again; 0: never."""

    lock = 0

    def _enter(self, k: int, chosen: Any, entries: Any) -> None:
        grids, t = self.filter.particles.grids, self.segmap.table
        held = {p: grids[p].locked for p in chosen.tolist()}
        super()._enter(k, chosen, entries)
        for p, e in zip(chosen.tolist(), entries):
            visits, source = 1, e.source
            while source >= 0:
                visits, source = visits + (t.kind[source] == MATCH), int(t.source[source])
            if (e.kind == SAME and held[p]) or (e.kind == MATCH and 0 < self.lock <= visits):
                grids[p].lock()


def lock_rows(
    steps: Steps, log: SensorLog, judge: Judge, seed: int, laps: int, particles: int
) -> Iterator[tuple[str, dict]]:
    """Figures of the maps of the first and of the last lap."""
    assert log.truth is not None
    for name, lock in LOCKS.items():
        front: Any = make_front_end("segslam", merge_options(COURT, {"filter": {"particles": particles}}))
        run = LockingFilter(steps, front.config.filter, front.config.segslam, SeedTree(seed).child(0), 32)
        run.lock = lock
        for k in range(len(steps)):
            run.step(k, last=k == len(steps) - 1)
        result = run.result(steps)
        m, t = result.segmap, result.segmap.table
        path = float(np.sqrt(np.mean(ate(result.trajectory(), log.truth.trajectory, max_diff=0.02).translation ** 2)))
        lap = m.path_length[-1] / laps
        rows: dict[str, list[dict[str, float]]] = {"first": [], name: []}
        for i in common_ancestor_chain(m, int(result.closed[result.best])).tolist():
            root = i
            while t.source[root] >= 0:
                root = int(t.source[root])
            a, b = int(t.start[i]), int(t.end[i])
            last = m.path_length[a] >= (laps - 1) * lap
            if not last and m.path_length[b] > 1.2 * lap:
                continue
            T = judge.frame(int(t.start[root]), t.entry[root])
            grid, segment = m.map_of(i), m[i]
            off = SE3.compose(np.broadcast_to(T, segment.path.shape), segment.path) - judge.truth[a : b + 1]
            row = judge.figures(grid, T) | {"pose": float(np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))))}
            rows[name if last else "first"].append(row)
        for case, found in rows.items():
            if found and (case != "first" or lock == 0):
                whole = {
                    "path": path,
                    "matches": float(result.report()["matches"]),
                    "CPU": float(result.step_seconds.sum()),
                }
                whole["segments"] = float(len(m.intervals()))
                yield case, {k: float(np.mean([r[k] for r in found])) for k in found[0]} | whole


def merge_rows(steps: Steps, judge: Judge, seed: int, laps: int, particles: int) -> Iterator[tuple[str, dict]]:
    """Figures of the maps of two laps, merged and not."""
    front: Any = make_front_end("segslam", merge_options(COURT, {"filter": {"particles": particles}}))
    lap = steps.path_length[-1] / laps
    a, b, c = (int(np.searchsorted(steps.path_length, k * lap)) for k in range(3))
    seeds, g = SeedTree(seed).child("merge"), SE3
    whole = GridFilter(steps, front.config.filter, seeds.child("whole"))

    def filtered(f: GridFilter, first: int, last: int) -> tuple[EvidenceGrid, Array]:
        for k in range(first, last + 1):
            f.step(k)
        best = f.particles.best
        return f.particles.grids[best].copy(), f.ancestry.recent(last - f.first + 1)[:, best]

    grids, frames = {}, {}
    grids["lap 1"], path = filtered(whole, a, b)
    own = GridFilter(steps, front.config.filter, seeds.child("second"), first=b, pool=whole.pool)
    grids["lap 2"], second = filtered(own, b, c)
    grids["one"], _ = filtered(whole, b + 1, c)
    frames["lap 1"], frames["lap 2"] = judge.frame(a, path[0]), judge.frame(b, second[0])
    rng = seeds.child("starts").generator()

    def shifted(T: Array) -> Array:
        move = np.concatenate([rng.normal(0.0, [0.0, 0.0, 0.03]), rng.normal(0.0, [0.3, 0.3, 0.05])])
        return np.asarray(g.compose(T, g.exp(move)))

    cloud, target = (Target(grids[k].binned_cloud(1).points) for k in ("lap 2", "lap 1"))
    T_1_2 = g.between(frames["lap 1"], frames["lap 2"])
    found = register(cloud, target, shifted(T_1_2), RegistrationConfig())
    grids["merged"] = grids["lap 1"].copy()
    grids["merged"].merge(grids["lap 2"], found.T_target_source)
    frames["one"] = frames["merged"] = frames["lap 1"]
    off = float(np.linalg.norm((g.log(g.between(T_1_2, found.T_target_source)))[3:]))
    windows = [(k, gather_look_ahead(steps, k, 2.0)) for k in np.linspace(c, c + (c - b) * 0.8, 20).astype(int)]
    starts = [shifted(judge.truth[k]) for k, _ in windows]
    one = grids["one"]
    for name in ("lap 1", "lap 2", "merged", "one"):
        grid, T = grids[name], frames[name]
        errors, scores, spreads = [], [], []
        for n, ((k, ahead), start) in enumerate(zip(windows, starts)):
            got = localise_in_map(
                grid, g.compose(g.inverse(T), start), ahead.window.thinned(300), steps.max_range,
                seeds.child("window", n).generator(),
            )  # fmt: skip
            errors.append(np.linalg.norm(g.compose(T, got.pose)[:2] - judge.truth[k][:2]))
            scores.append(got.error)
            spreads.append(got.spread)
        memory = grid.memory()
        row = judge.figures(grid, T) | {
            "localised": float(np.median(errors)), "score": float(np.mean(scores)),
            "MB": (memory.private + memory.shared) / 1e6,
        }  # fmt: skip
        if name == "merged":
            centres = np.asarray(one.occupied_cloud())
            both = grid.known_at(centres)
            row["agree occupied"] = float(grid.occupied_at(centres[both]).mean())
            mine = np.asarray(grid.occupied_cloud())
            row["agree back"] = float(one.occupied_at(mine[one.known_at(mine)]).mean())
            row["registration"] = off
        yield name, row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--laps", type=int, default=8)
    parser.add_argument("--particles", type=int, default=20)
    parser.add_argument("--persons", type=int, default=3)
    parser.add_argument("--first", type=int, default=500, help="seed of the first world")
    parser.add_argument("--part", choices=["lock", "merge"], nargs="*", default=["lock", "merge"])
    parser.add_argument("--quick", action="store_true", help="two worlds, three laps, four particles")
    a = parser.parse_args()
    if a.quick:
        a.worlds, a.laps, a.particles = 2, 3, 4
    rows: dict[str, list[dict[str, float]]] = {}
    with one_blas_thread():
        for seed in range(a.first, a.first + a.worlds):
            world, thin = draw_hall(seed, a.laps)
            log = drive(world, seed, a.persons)
            front: Any = make_front_end("segslam", COURT)
            steps = make_steps(log, front.config.steps)
            judge = Judge(world, thin, steps)
            jobs: dict[str, Any] = {"lock": partial(lock_rows, steps, log), "merge": partial(merge_rows, steps)}
            for part in a.part:
                for name, row in jobs[part](judge, seed, a.laps, a.particles):
                    rows.setdefault(name, []).append(row)
                    print(f"seed {seed}, {name}:", {k: round(x, 4) for k, x in row.items()}, flush=True)
    for name, found in rows.items():
        base = "off" if name in ("first", *LOCKS) else "one"
        print(name)
        for k in found[0]:
            x = np.array([r[k] for r in found])
            other = np.array([r.get(k, np.nan) for r in rows[base]])
            paired = interval(x - other) if len(x) == len(other) else "-"
            print(f"    {k:14} {interval(x):32} difference from {base} {paired}")


if __name__ == "__main__":
    main()
