"""SegSLAM with a worse and worse scanner, until it fails, on the same random worlds.

``python -m tests.benchmarks.bench_poor_sensor [--worlds N] [--first SEED] [--particles N]``: the small court, with
other clutter, robot errors and seed in each world. Levels: white noise is added to all ranges (the log states it); a
share of the beams is lost, others in each scan; of each scan only the middle beams remain. Printed: means over the
worlds with 95 % intervals of Student's t, and in how many worlds the path is better than dead reckoning.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from tests.benchmarks.bench_paper_preset import interval, trial

LEVELS: dict[str, list[float]] = {
    "as it is": [0.0],
    "more noise [m]": [0.1, 0.3, 1.0],
    "lost beams": [0.5, 0.8, 0.95],
    "lost field of view": [0.5, 0.75, 0.9],
}


def degraded(log: SensorLog, kind: str, level: float, seed: int) -> SensorLog:
    """The log with a worse scanner."""
    scans, rng = log["scanner"], SeedTree(seed).child("poor", kind).generator()
    ranges = np.array(scans.ranges, dtype=np.float64)
    if kind == "more noise [m]":
        returned = ranges < scans.max_range
        noisy = np.maximum(ranges + level * rng.standard_normal(ranges.shape), 0.05)
        ranges[returned] = noisy[returned]
    elif kind == "lost beams":
        ranges[rng.random(ranges.shape) < level] = np.nan
    elif kind == "lost field of view":
        n = ranges.shape[1]
        ranges[:, np.abs(np.arange(n) - (n - 1) / 2) > (1 - level) * n / 2] = np.nan
    sigma = float(np.hypot(scans.sigma, level if "noise" in kind else 0.0))
    return replace(log, streams={**log.streams, "scanner": replace(scans, ranges=ranges, sigma=sigma)})


def dead_reckoning(log: SensorLog) -> float:
    """RMS position error of dead reckoning after alignment [m]."""
    steps = make_steps(log, StepConfig(max_range=8.0))
    assert log.truth is not None
    poses = [SE3.identity]
    for T in steps.odometry.increments[1:]:
        poses.append(SE3.compose(poses[-1], T))
    path = Trajectory(steps.times, np.stack(poses))
    return float(np.sqrt(np.mean(ate(path, log.truth.trajectory, max_diff=0.02).translation ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=6)
    parser.add_argument("--particles", type=int, default=20)
    parser.add_argument("--first", type=int, default=200, help="seed of the first world")
    parser.add_argument("--quick", action="store_true", help="one world, four particles, two levels")
    a = parser.parse_args()
    if a.quick:
        a.worlds, a.particles = 1, 4
    levels = [(k, x) for k in LEVELS for x in (LEVELS[k][-1:] if a.quick else LEVELS[k])]
    rows: dict[tuple[str, float], list[dict[str, float]]] = {level: [] for level in levels}
    with one_blas_thread():
        for seed in range(a.first, a.first + a.worlds):
            log = simulate_crawler(ring_hall(seed=seed), seed, CrawlerConfig(drift=0.02, max_range=8.0))
            reckoned = dead_reckoning(log)
            for (kind, level), found in rows.items():
                row = trial(degraded(log, kind, level, seed), seed, a.particles, {})
                found.append({**row, "better": float(row["path [m]"] < reckoned), "dead reckoning [m]": reckoned})
                print(f"seed {seed}, {kind} {level}:", {k: round(x, 3) for k, x in found[-1].items()}, flush=True)
    for (kind, level), found in rows.items():
        x = {k: np.array([r[k] for r in found]) for k in ("path [m]", "NEES/dof", "entries", "dead reckoning [m]")}
        better = int(sum(r["better"] for r in found))
        print(f"{kind} {level}: better in {better} of {len(found)};", *(f"{k} {interval(v)};" for k, v in x.items()))


if __name__ == "__main__":
    main()
