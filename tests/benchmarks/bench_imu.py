"""NEES by block and errors of graphs with and without an IMU, on simulated rings in space.

``python -m tests.benchmarks.bench_imu [RUNS] [--quick]`` prints the table of the page on the IMU.
"""

from __future__ import annotations

import argparse

import numpy as np

from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.graph.factors.imu.config import ImuConfig
from tests.reference.imu_ring import STEP
from tests.reference.imu_study import trial


def main(runs: int) -> None:
    """Print the table."""
    near, far = ImuConfig(), ImuConfig(longest=0.1, window=0.5)
    gyro = ImuConfig(accelerometer=False)
    for label, step in (("step as stated", STEP), ("five times as unsure", 5 * STEP)):
        for name, imu, gps in (
            ("nothing", None, False),
            ("IMU", near, False),
            ("gyro alone", gyro, False),
            ("gravity alone", far, False),
            ("GPS", None, True),
            ("GPS and IMU", near, True),
        ):
            trials = [trial(np.random.default_rng([7, k]), imu, gps=gps, step=step) for k in range(runs)]
            keys = trials[0].nees.keys()
            words = ", ".join(f"{k} {np.mean([t.nees[k] for t in trials]):.2f}" for k in keys)
            rms = [np.sqrt(np.mean([getattr(t, n) ** 2 for t in trials])) for n in ("ate", "heading", "level")]
            chi2 = {
                k: sum(t.chi2[k][0] for t in trials) / max(sum(t.chi2[k][1] for t in trials), 1e-9)
                for k in trials[0].chi2
            }
            print(
                f"{label:22s} {name:14s} ATE {rms[0]:.3f} m, heading {1e3 * rms[1]:.1f} mrad, "
                f"level {1e3 * rms[2]:.1f} mrad"
                f" | NEES/n {words} | χ²/dof " + ", ".join(f"{k} {v:.2f}" for k, v in chi2.items())
            )
    for n in (1, 2, 3):
        print(f"bounds of the mean over {runs} runs, {n} dof: {np.array(chi2_mean_bounds(n, runs, 0.99)) / n}")


def command() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="?", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="one run")
    return parser.parse_args()


if __name__ == "__main__":
    args = command()
    main(1 if args.quick else args.runs)
