"""Work of online SegSLAM for each step, over the mine: longest step, median, and growth with the map.

``python -m tests.benchmarks.bench_segslam_steps [--particles N] [--seconds S] [--world mine]``: CPU time of the steps
of the filter (0.4 s of driving) and of their slices, the work between two records; by quarters of the path;
memory of all maps along it. The mine
needs `graphslam-studies`.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import graphslam as gs
from graphslam.app.run.options import RunOptions
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam_frontends.segslam.front_end import SegSlam


def log_of(world: str, seed: int, seconds: float) -> SensorLog:
    log = gs.simulate(world, seed=seed)
    begin, end = log.interval
    return log.slice(begin, min(begin + seconds, end))


def table(name: str, seconds: np.ndarray) -> None:
    """Median, longest and their ratio; medians and means of the quarters [ms]."""
    ms = 1e3 * seconds
    quarters, median = np.array_split(ms, 4), np.median(ms)
    print(f"{name}: {len(ms)}, median {median:.1f} ms, 99 % {np.percentile(ms, 99):.1f} ms")
    print(f"    longest {ms.max():.1f} ms, {ms.max() / median:.1f} times the median")
    print("    medians of the quarters [ms]:", *(f"{np.median(q):.1f}" for q in quarters))
    print("    means of the quarters [ms]:  ", *(f"{q.mean():.1f}" for q in quarters))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=1e9, help="of the log")
    parser.add_argument("--world", default="mine")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="30 s of a small world")
    a = parser.parse_args()
    if a.quick:
        a.world, a.seconds, a.particles = "court", 30.0, 4
    log = log_of(a.world, a.seed, a.seconds)
    asked = {"filter": {"particles": a.particles}, "steps": {"level_floors": False}}
    front = RunOptions.for_log(log, "segslam", "isam2", a.seed, {"frontend": asked}).front
    assert isinstance(front, SegSlam)
    begin, steps, slices = time.process_time(), list[float](), list[float]()
    maps = [(0, 0.0)]
    for _ in front.follow(RecordSource(log), seed=SeedTree(a.seed)):
        run = front._live[0].run
        steps, slices = run.step_seconds, run.slice_seconds
        maps.append((len(steps), run.filter.pool.used_bytes / 1e6))
    print(f"{log.name}, {log.duration:.0f} s, {a.particles} particles: {time.process_time() - begin:.1f} CPU seconds")
    table("steps", np.array(steps))
    table("slices", np.array(slices))
    at = np.linspace(0.0, len(steps), 9)[1:]
    megabytes = np.interp(at, *np.array(maps).T)
    print("maps at the ends of the eighths [MB]:", *(f"{m:.1f}" for m in megabytes))


if __name__ == "__main__":
    main()
