"""SegSLAM on odometry and scans in the simulated court; an IMU that it did not use in the graph, or not.

``python -m tests.benchmarks.bench_imu_segslam [SEEDS] [--quick]``

``level``: odometry whose roll and pitch follow gravity within 3 mrad; ``walk``: they walk, and nothing tells the drift
model of the front end so.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from graphslam.app.run import pipeline
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3
from graphslam.core.records import Odometry
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall

PERIOD, TILT, TILT_TIME = 0.1, 0.003, 10.0


def court_log(seed: int, kind: str) -> SensorLog:
    """The court's log with recorded odometry in place of the wheels."""
    log = simulate_crawler(ring_hall(seed=seed), seed, CrawlerConfig(drift=0.08, max_range=8.0))
    assert log.truth is not None
    rng, path = np.random.default_rng(seed), log.truth.trajectory
    t = np.arange(path.times[0], path.times[-1], PERIOD)
    T, n = path.interpolate(t), len(t)
    step = np.array([2e-3, 2e-3, 4e-3, 0.008, 0.008, 0.008])
    if kind == "level":
        keep, white = np.exp(-PERIOD / TILT_TIME), TILT * rng.standard_normal((n, 2))
        white[1:] *= np.sqrt(1 - keep**2)
        tilt = lfilter([1.0], [1.0, -keep], white, axis=0)
        T = SE3.compose(T, SE3.exp(np.column_stack([tilt - tilt[0], np.zeros((n, 4))])))
        step[:2] = 1e-4
    moves = SE3.compose(SE3.between(T[:-1], T[1:]), SE3.exp(step * rng.standard_normal((n - 1, 6))))
    odometry = Odometry(
        times=t,
        increments=np.concatenate([SE3.identity[None], moves]),
        covariances=np.tile(np.diag(step**2), (n, 1, 1)),
    )
    streams = {k: v for k, v in log.streams.items() if k != "wheels"}
    return replace(log, streams={**streams, "odometry": odometry})


def main(seeds: int) -> None:
    """Print a line a run."""
    for kind, sigma in (("level", 0.005), ("walk", 0.0)):
        for seed in range(9, 9 + seeds):
            log = court_log(seed, kind)
            for use in ("none", "auto"):
                config: dict[str, Any] = {
                    "frontend": {
                        "filter": {"particles": 5},
                        "steps": {"motion": ["odometry"], "level_floors": False, "odometry_tilt_sigma": sigma},
                    },
                    "backend": {"level_sigma": 0.006 if sigma else 0.0},
                    "imu": {"use": use, "longest": 60.0},
                    "map": {"fuse": False},
                    "refine": {"use": False},  # its path holds no IMU factors
                }
                r = pipeline.run(log, frontend="segslam", seed=2, config=config, progress=False)
                figures = {k: float(v) for k, v in zip(r.metrics["key"], r.metrics["value"])}
                names = ("path_rmse", "path_rmse_aligned", "consistency_imu_chi2_per_dof")
                words = ", ".join(f"{n} {figures[n]:.3f}" for n in names if n in figures)
                print(f"{kind} {seed} imu {use}: {len(r.submaps)} submaps, {words}", flush=True)


def command() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", nargs="?", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one seed")
    return parser.parse_args()


if __name__ == "__main__":
    args = command()
    main(1 if args.quick else args.seeds)
