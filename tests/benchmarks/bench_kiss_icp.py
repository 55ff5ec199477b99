"""The front end ``kiss-icp`` beside ``lidar-odometry``: error, CPU time, NEES of the end poses of submaps.

``python -m tests.benchmarks.bench_kiss_icp [--draws 6] [--first 1] [--seconds 9] [--simulated] [--quick]``

Recorded: whole runs of HKU 1 and KITTI 0005, without refinement. ATE after rigid alignment to the poses that come with
HKU 1, which are results of other programs; KITTI 0005 has none: distance of the two paths. NEES of the end pose of each
submap, by its covariance, against the same poses. Simulated: random lidars, spinning and rosette, on wheels and
hand-held, once with 24,000 points at 10 Hz and once with 4,000 at their own rate; ATE against the truth, NEES of pieces
of 3 m.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np

import graphslam as gs
from graphslam.app.worlds import mesh_world
from graphslam.core import se3
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array
from graphslam_frontends.kiss_icp.front_end import KissIcpConfig, KissIcpOdometry
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_studies.sim.lidar import drawn_lidar, simulate_lidar
from tests.benchmarks.bench_lidar import ate, followed

NAMES = ("lidar-odometry", "kiss-icp")
INSIDE = 12.6 / 6.0
"""NEES / 6 below it in 95 % of the cases."""


def summary(nees: list[float]) -> str:
    """Mean, median, and share inside the 95 % bound."""
    if not nees:
        return "no NEES"
    return f"{np.mean(nees):.2f} (median {np.median(nees):.2f}, {np.mean(np.array(nees) < INSIDE):.0%} inside 95 %)"


def exits(submaps: Any, times: Array, truth: Array) -> str:
    """NEES/6 of the end poses of submaps against a reference."""
    out = []
    for m in submaps:
        a, b = (truth[int(np.argmin(np.abs(times - t)))] for t in m.interval)
        e = se3.se3_log(se3.se3_between(m.exit_pose, se3.se3_between(a, b)))
        out.append(float(e @ np.linalg.solve(m.exit_covariance, e)) / 6.0)
    return f"NEES/6 of {len(out)} exits {summary(out)}"


def recorded(most: int) -> None:
    """Whole runs of the packs."""
    for pack in ("lidar3d-hku1", "lidar3d-kitti-0005"):
        try:
            log = gs.load(pack)
        except GraphSlamError as error:
            print(f"{pack}: not here ({error})")
            continue
        times = log["clouds"].times
        log = log.slice(times[0], times[min(most, len(times)) - 1])
        times, paths = log["clouds"].times, {}
        options = {"refine": {"use": False}, "map": {"fuse": False}}
        for name in NAMES:
            begin = time.process_time()
            run = gs.run(log, frontend=name, config=options, progress=False)
            spent = (time.process_time() - begin) / len(times)
            paths[name] = run.map.trajectory.interpolate(times)
            end = float(np.linalg.norm(paths[name][-1, :3] - paths[name][0, :3]))
            info = [f"end to start {end:.3f} m", f"run {1e3 * spent:.0f} ms CPU a scan"]
            if "odometry" in log.streams:
                truth = chain_odometry(log["odometry"]).poses
                info += [f"ATE {ate(paths[name], truth):.3f} m", exits(run.submaps, times, truth)]
            lost = sum(m.report["scans_lost"] for m in run.submaps)
            print(f"{pack:20s}{name:16s}{len(run.submaps):4d} submaps, {lost} scans lost;", "; ".join(info), flush=True)
        print(f"{pack:20s}distance of the two paths {ate(*(paths[n] for n in NAMES)):.3f} m")


def simulated(draws: int, first: int, seconds: float, points: int, rate: float | None) -> None:
    """Random lidars and carriers, with so many points a scan."""
    rows: dict[str, list[float]] = {name: [] for name in NAMES}
    every: dict[str, list[float]] = {name: [] for name in NAMES}
    for k in range(draws):
        seed, world = first + k, ("garage", "building", "mine")[k % 3]
        config = drawn_lidar(seed)
        config = replace(config, points=points, rate=rate or config.rate, sweep=min(config.sweep, 1.0 / (rate or 1e-9)))
        log = simulate_lidar(mesh_world(world, seed=seed), seed, config, most=seconds)
        truth = log.truth.trajectory.interpolate(log["clouds"].times)
        for name in NAMES:
            odometry = KissIcpOdometry(KissIcpConfig()) if name == "kiss-icp" else None
            path, nees, info = followed(log["clouds"], truth, 10**9, odometry=odometry)
            rows[name].append(ate(path, truth))
            every[name] += nees
            carried = "hand" if config.sway else "wheels"
            print(f"{world:9s}{seed:4d} {config.pattern:9s}{carried:7s}{name:15s} ATE {rows[name][-1]:.3f} m {info}")
    for name, nees in every.items():
        a = rows[name]
        print(f"{points} points: {name:15s} ATE mean {np.mean(a):.3f}, median {np.median(a):.3f} m; ", end="")
        print(f"{len(nees)} pieces: NEES/6 {summary(nees)}", flush=True)


def main() -> None:
    """See the module's docstring."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--draws", type=int, default=6)
    p.add_argument("--first", type=int, default=1)
    p.add_argument("--seconds", type=float, default=9.0)
    p.add_argument("--simulated", action="store_true", help="simulated lidars only")
    p.add_argument("--quick", action="store_true")
    a = p.parse_args()
    if a.quick:
        a.draws, a.seconds = 2, 5.0
    if not a.simulated:
        recorded(30 if a.quick else 10**6)
    for points, rate in ((24000, 10.0), (4000, None)):
        simulated(a.draws, a.first, a.seconds, points, rate)


if __name__ == "__main__":
    main()
