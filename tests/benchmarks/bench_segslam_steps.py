"""Work of online SegSLAM, record by record over the mine: longest, median, and growth with the map.

``python -m tests.benchmarks.bench_segslam_steps [--particles N] [--seconds S] [--world mine]``: all records go to
`gs.Slam`, which gives a pose after each scan. CPU time of its work between two scans and in the 0.4 s of a step (with
steps, estimates, ends of submaps and the graph), and of the slices of the filter; by quarters of the path; memory of
all maps along it. Loops of the back end are searched during the drive; ``--look-every 0``: at the end only. The mine
needs `graphslam-studies`.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

import graphslam as gs
from graphslam.backend.back_end import Observer
from graphslam.core.log import SensorLog
from graphslam_frontends.segslam.front_end import SegSlam

STEP = 0.4
"""Of the filter [s]."""


class Lags(Observer):
    """Wants a pose after each scan."""

    def __init__(self) -> None:
        self.lags: list[float] = []

    def pose_estimated(self, estimate: Any) -> None:
        self.lags.append(estimate.lag)


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
    parser.add_argument("--look-every", type=int, default=5, help="submaps between searches for loops")
    parser.add_argument("--quick", action="store_true", help="30 s of a small world")
    a = parser.parse_args()
    if a.quick:
        a.world, a.seconds, a.particles = "court", 30.0, 4
    log = log_of(a.world, a.seed, a.seconds)
    front_end = {"filter": {"particles": a.particles}, "steps": {"level_floors": False}}
    asked = {"preset": a.world, "frontend": front_end, "backend": {"look_every": a.look_every}}
    fed(log_of("court", 1, 20.0), a.seed, {"frontend": front_end})  # compiles
    begin = time.process_time()
    times, work, scans, lags, front, maps = fed(log, a.seed, asked)
    print(f"{log.name}, {log.duration:.0f} s, {a.particles} particles: {time.process_time() - begin:.1f} CPU seconds")
    table("between scans", np.add.reduceat(work, scans))
    table("steps of 0.4 s", np.bincount(((times - times[0]) / STEP).astype(int), work))
    table("slices of the filter", np.array(front._live[0].run.slice_seconds))
    print(f"lag: median {np.median(lags):.1f} s, longest {max(lags):.1f} s; {len(lags)} poses, {len(scans)} scans")
    at = np.linspace(times[0], times[-1], 9)[1:]
    megabytes = np.interp(at, *np.array(maps).T)
    print("maps at the ends of the eighths [MB]:", *(f"{m:.1f}" for m in megabytes))


def fed(log: SensorLog, seed: int, asked: dict[str, Any]) -> tuple[Any, ...]:
    """Feed all records: their stamps and work [s], the numbers of those of scans, lags, front end, map memory."""
    observer, work, times = Lags(), list[float](), list[float]()
    scans, maps = list[int](), [(log.interval[0], 0.0)]
    with gs.Slam("segslam", seed=seed, config=asked, observers=[observer]) as slam:
        assert slam._slam is not None
        front = slam._slam.options.front
        assert isinstance(front, SegSlam)
        for t, stream, k in log.events():
            record = log[stream].take(slice(k, k + 1))
            begin = time.process_time()
            slam.add(record, stream)
            work.append(time.process_time() - begin)
            times.append(t)
            if isinstance(log[stream], (gs.RangeScans, gs.PointClouds, gs.LaserScans)):
                scans.append(len(work) - 1)
                if front._live and len(scans) % 100 == 0:
                    maps.append((t, front._live[0].run.filter.pool.used_bytes / 1e6))
    return np.array(times), np.array(work), scans, observer.lags, front, maps


if __name__ == "__main__":
    main()
