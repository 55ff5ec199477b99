"""LiDAR odometry: recorded packs against their poses, drawn simulated lidars against truth, and the cached neighbour.

``python -m tests.benchmarks.bench_lidar [--scans N] [--draws 12] [--first 101] [--simulated | --runs] [--quick]``

CPU time on one thread, without compilation. Recorded: ATE after rigid alignment to the poses that come with the packs,
which are results of other programs (KITTI 0005 has none: see bench_kiss_icp). NEES of pieces of 3 m.
Simulated lidars are followed without and with the IMU beside them; with ``--runs`` by whole runs.
Neighbours: nanoseconds a point for one scan against the map, asked for the first time (cold), again (warm), and of k-d
trees of scipy and small_gicp over the same cells.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

import graphslam as gs
from graphslam.app.worlds import mesh_world
from graphslam.core import se3
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu
from graphslam.core.point_clouds import PointClouds
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.odometry import LidarOdometry
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_studies.sim.lidar import drawn_imu, drawn_lidar, simulate_lidar
from tests.reference.lidar_start import start_odometry

PACKS = ("lidar3d-hku1", "lidar3d-hku-mb", "lidar3d-balm-hall", "lidar3d-kitti-0005")
PIECE = 3.0
"""Way of the pieces whose covariances are judged [m]."""


def followed(
    clouds: PointClouds,
    truth: Array | None,
    scans: int,
    imu: Imu | None = None,
    odometry: LidarOdometry | None = None,
) -> tuple[Array, list[float], str]:
    """Path ``(n, 7)``, NEES/6 of its pieces, and a line of figures."""
    clouds.cloud(0)  # decoded
    odometry = odometry or start_odometry(clouds, LidarOdometryConfig(), imu)
    poses, states, nees, begin, length, spent = [], Counter[str](), [], 0, 0.0, 0.0
    for k in range(min(len(clouds), scans)):
        cloud, ages = clouds.cloud(k), clouds.ages(k)
        if k == 5:
            spent = -time.process_time()
        states[odometry.step(cloud, float(clouds.times[k]), ages).state] += 1
        poses.append(odometry.pose)
        if k == 0:
            odometry.errors.begin()
        if truth is not None and odometry.length - length >= PIECE:
            a, b = poses[begin], poses[k]
            C = relative_covariance((a, b), (a, b), odometry.errors.joint)
            e = se3.se3_log(se3.se3_between(se3.se3_between(a, b), se3.se3_between(truth[begin], truth[k])))
            nees.append(float(e @ np.linalg.solve(C, e)) / 6.0)
            odometry.errors.begin()
            begin, length = k, odometry.length
    spent += time.process_time()
    path = np.array(poses)
    rate = float(np.median(np.diff(clouds.times)))
    cpu = spent / max(len(path) - 5, 1)
    bad = {s: n for s, n in states.items() if s not in ("first", "matched")}
    line = f"{len(path):5d} scans {odometry.length:6.1f} m  {1e3 * cpu:6.1f} ms a scan ({rate / cpu:4.1f} × real time)"
    if nees:
        inside = np.mean(np.array(nees) < 12.6 / 6.0)
        line += f"  NEES/6 {np.mean(nees):5.2f} (median {np.median(nees):4.2f}, {inside:.0%} inside 95 %)"
    return path, nees, line + (f"  {bad}" if bad else "")


def ate(path: Array, truth: Array) -> float:
    """RMS of position after rigid alignment [m]."""
    T, _ = se3.align_se3(path[:, :3], truth[:, :3])
    return float(np.sqrt(np.mean(np.sum((se3.se3_transform(T, path[:, :3]) - truth[:, :3]) ** 2, axis=1))))


def recorded(scans: int) -> None:
    """The packs."""
    for name in PACKS:
        try:
            log = gs.load(name)
        except GraphSlamError as error:
            print(f"{name}: not here ({error})")
            continue
        clouds = log["clouds"]
        truth = chain_odometry(log["odometry"]).poses if "odometry" in log.streams else None
        path, _, line = followed(clouds, truth, scans)
        errors = []
        if truth is not None:
            errors.append(f"odometry's {ate(path, truth[: len(path)]):.3f}")
        if "reference" in log.streams:
            errors.append(f"reference {ate(path, log['reference'].poses[: len(path)]):.3f}")
        if truth is None:
            errors.append("no reference (bench_kiss_icp: to KISS-ICP)")
        print(f"{name:20s} ATE [m] {', '.join(errors)}  end to start {np.linalg.norm(path[-1, :3]):.3f} m\n   {line}")


def simulated(draws: int, first: int, seconds: float) -> None:
    """Lidars and carriers that are drawn."""
    rows: dict[str, list[tuple[float, ...]]] = {}
    every: dict[str, list[float]] = {}
    for k in range(draws):
        seed, world = first + k, ("garage", "building", "mine")[k % 3]
        config = replace(drawn_lidar(seed), imu=drawn_imu(seed))
        layout = {"layout": "B"} if world == "garage" else {}
        log = simulate_lidar(mesh_world(world, seed=seed, **layout), seed, config, most=seconds)
        truth = log.truth.trajectory.interpolate(log["clouds"].times)
        carried = "hand" if config.sway else "wheels"
        for what, imu in (("alone", None), ("IMU", log["imu"])):
            path, nees, line = followed(log["clouds"], truth, 10**9, imu)
            every.setdefault(what, []).extend(nees)
            off = se3.se3_log(
                se3.se3_between(se3.se3_between(path[:-1], path[1:]), se3.se3_between(truth[:-1], truth[1:]))
            )
            step = tuple(float(np.sqrt(np.mean(np.sum(off[:, c] ** 2, axis=1)))) for c in (slice(3, 6), slice(0, 3)))
            rows.setdefault(what, []).append((ate(path, truth), *step))
            print(
                f"{world:9s}{seed:5d} {config.pattern:9s}{carried:7s}{what:6s} ATE {rows[what][-1][0]:.4f} m "
                f"scan to scan {1e3 * step[0]:.1f} mm, {1e3 * step[1]:.2f} mrad {line}"
            )
    for what, nees in every.items():
        a, mm, mrad = np.array(rows[what]).mean(axis=0)
        print(f"{what}: mean ATE {a:.4f} m, scan to scan {1e3 * mm:.1f} mm, {1e3 * mrad:.2f} mrad", end="")
        inside = np.mean(np.array(nees) < 12.6 / 6.0)
        print(
            f"; {len(nees)} pieces: NEES/6 {np.mean(nees):.2f}, median {np.median(nees):.2f}, {inside:.0%} inside 95 %"
        )
    better = sum(b[0] < a[0] for a, b in zip(rows["alone"], rows["IMU"]))
    print(f"ATE better with the IMU: {better} of {draws}")


RUNS: dict[str, dict[str, Any]] = {
    "alone": {"frontend": {"imu": "none"}, "refine": {"use": False}},
    "front end": {"refine": {"use": False}},
    "and graph": {"imu": {"use": "auto"}, "refine": {"use": False}},
    "refined, alone": {"frontend": {"imu": "none"}},
    "refined": {},
}
"""What a run does with the IMU."""


def runs(draws: int, first: int, seconds: float) -> None:
    """Whole runs over drawn lidars: what an IMU does to path, up, and honesty."""
    table: dict[str, list[tuple[float, ...]]] = {}
    for k in range(draws):
        seed, world = first + k, ("garage", "building", "mine")[k % 3]
        config = replace(drawn_lidar(seed), imu=drawn_imu(seed), points=5000)
        layout = {"layout": "B"} if world == "garage" else {}
        log = simulate_lidar(mesh_world(world, seed=seed, **layout), seed, config, most=seconds)
        for what, options in RUNS.items():
            options = {**options, "map": {"fuse": False}}
            run = gs.run(log, frontend="lidar-odometry", config=options, progress=False)
            value = run.metrics.set_index("key")["value"]
            path = run.map.trajectory
            truth = log.truth.trajectory.interpolate(path.times)
            up = [se3.quat_to_matrix(T[:, 3:])[:, 2] for T in (path.poses, truth)]
            row = (
                value["path_rmse_aligned"],
                value["path_rmse"],
                1e3 * float(np.mean(np.linalg.norm(up[0] - up[1], axis=1))),
                value["nees_per_dof"],
                value.get("consistency_imu_chi2_per_dof", np.nan),
            )
            table.setdefault(what, []).append(tuple(float(x) for x in row))
            form = "aligned {:.4f} m, first base held {:.4f} m, up off {:.1f} mrad, NEES/n {:.2f}, ways {:.2f}"
            print(f"{world:9s}{seed:5d} {what:15s}", form.format(*table[what][-1]), flush=True)
    for what, rows in table.items():
        mean, middle = np.mean(rows, axis=0), np.median(rows, axis=0)
        print(f"{what:15s} mean {np.array2string(mean, precision=4)}, middle {np.array2string(middle, precision=4)}")


def neighbours(scans: int) -> None:
    """Time of one scan's neighbours in the map of the scans before it."""
    for name in ("lidar3d-hku1", "lidar3d-kitti-0005"):
        try:
            clouds = gs.load(name)["clouds"]
        except GraphSlamError:
            continue
        odometry = LidarOdometry(LidarOdometryConfig())
        n = min(scans, len(clouds) - 1)
        for k in range(n):
            odometry.step(clouds.cloud(k), float(clouds.times[k]))
        level = odometry.levels[-1]
        centres = level.centres
        clouds_points = se3.se3_transform(odometry.pose, clouds.cloud(n))
        query = np.ascontiguousarray(clouds_points[np.linalg.norm(clouds.cloud(n), axis=1) < 80.0])
        tree, other = cKDTree(centres), small_gicp.KdTree(small_gicp.PointCloud(centres))
        figures = {}
        for what, ask in (
            ("cold", level.nearest),
            ("warm", level.nearest),
            ("after 3 cm", level.nearest),
            ("cKDTree", tree.query),
            ("small_gicp", other.batch_nearest_neighbor_search),
        ):
            asked = query + 0.03 if what == "after 3 cm" else query
            begin = time.perf_counter()
            ask(asked)
            figures[what] = 1e9 * (time.perf_counter() - begin) / len(query)
        times = ", ".join(f"{what} {value:.0f}" for what, value in figures.items())
        print(f"{name}: {len(centres)} cells, {len(query)} points, ns a point: {times}")
        print(f"   warm against cKDTree {figures['cKDTree'] / figures['warm']:.1f} ×")


def main() -> None:
    """See the module's docstring."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--scans", type=int, default=10**6)
    p.add_argument("--draws", type=int, default=12)
    p.add_argument("--first", type=int, default=101)
    p.add_argument("--seconds", type=float, default=25.0)
    p.add_argument("--simulated", action="store_true", help="simulated lidars only")
    p.add_argument("--runs", action="store_true", help="whole runs over simulated lidars, without and with their IMU")
    p.add_argument("--quick", action="store_true")
    a = p.parse_args()
    if a.quick:
        a.scans, a.draws, a.seconds = 30, 2, 8.0
    if not (a.simulated or a.runs):
        recorded(a.scans)
    if a.runs:
        runs(a.draws, a.first, a.seconds)
        return
    simulated(a.draws, a.first, a.seconds)
    if not a.simulated:
        neighbours(min(a.scans, 60))


if __name__ == "__main__":
    main()
