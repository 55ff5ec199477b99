"""How much faster than the recording the particle filter on grids runs, in the simulated mine tunnel.

``python -m tests.benchmarks.bench_rbpf_grid [--scans 1500] [--particles 40]``

Steps of 0.4 s (15 scans of 181 beams of the spun fan, deskewed with the truth), voxels of 0.2 m, odometry with noise
and a bias of the yaw rate. All 2,715 beams of a step go into the maps, or 300 of them; 180 are weighed. CPU time of the
whole run, and wall time of the filter, part by part: on a busy machine the first is the one to believe.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from graphslam.core.random import SeedTree
from graphslam.core.records import Odometry
from graphslam.core.se3 import (
    quat_multiply,
    quat_normalize,
    se3_between,
    se3_compose,
    se3_exp,
    se3_inverse,
    se3_transform,
)
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.odometry.steps import Steps
from graphslam_studies.frontends.rbpf_grid import run_rbpf
from tests.benchmarks.evidence_scenes import SPIN_RATE, tunnel

PER_STEP = 15
SIGMA = np.array([5e-4, 5e-4, 1e-3, 4e-3, 4e-3, 2e-3])
YAW_BIAS = 6e-4
"""Of each step [rad]; in no covariance."""


def tunnel_steps(scans: int, *, seed: int = 0) -> Steps:
    """The way round the block as steps; the base stands where the fan does, without its spin."""
    scene, n = tunnel(scans), scans // PER_STEP
    angle = -2 * np.pi * SPIN_RATE * np.arange(scans) / scene.rate
    unspin = np.zeros((scans, 4))
    unspin[:, 0], unspin[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
    base = scene.poses.copy()
    base[:, 3:] = quat_normalize(quat_multiply(scene.poses[:, 3:], unspin))
    ends = base[PER_STEP - 1 :: PER_STEP][:n]
    noise = SeedTree(seed).child("odometry").generator().normal(size=(n - 1, 6)) * SIGMA
    noise[:, 2] += YAW_BIAS
    increments = np.concatenate(
        [[[0, 0, 0, 0, 0, 0, 1.0]], se3_compose(se3_between(ends[:-1], ends[1:]), se3_exp(noise))]
    )
    points, origins, returns, offsets = [], [], [], [0]
    for k in range(n):
        for j in range(k * PER_STEP, (k + 1) * PER_STEP):
            T, cloud = se3_between(ends[k], scene.poses[j]), scene.clouds[j]
            r = np.linalg.norm(cloud, axis=1, keepdims=True)
            met = r < scene.max_range
            points.append(se3_transform(T, np.where(met, cloud, cloud / r * scene.max_range)))
            origins.append(np.tile(T[:3], (len(cloud), 1)))
            returns.append(met[:, 0])
        offsets.append(offsets[-1] + sum(map(len, points[-PER_STEP:])))
    times = (np.arange(n) + 1) * PER_STEP / scene.rate
    return Steps(
        times=times,
        odometry=Odometry(times=times, increments=increments, covariances=np.tile(np.diag(SIGMA**2), (n, 1, 1))),
        offsets=np.array(offsets),
        points=np.concatenate(points),
        origins=np.concatenate(origins),
        returns=np.concatenate(returns),
        max_range=scene.max_range,
        range_sigma=0.02,
        tilt=np.zeros((n, 2)),
        tilt_sigma=0.002,
        name="tunnel",
        truth=Trajectory(times, se3_compose(se3_inverse(ends[0]), ends)),
    )


def main() -> None:
    """Print one line for each number of beams and of threads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=1500)
    parser.add_argument("--particles", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="300 scans")
    args = parser.parse_args()
    steps = tunnel_steps(300 if args.quick else args.scans)
    assert steps.truth is not None
    seconds, length = steps.times[-1] - steps.times[0], steps.path_length[-1]
    print(f"{len(steps)} steps, {seconds:.0f} s, {length:.0f} m, {args.particles} particles, 0.2 m")
    for beams in (0, 300):
        for threads in (1, 2):
            config = GridFilterConfig(particles=args.particles, map_beams=beams, threads=threads)
            if beams == 0 and threads == 1:
                run_rbpf(steps, config, SeedTree(0))  # compiled and warm
            begin = time.process_time()
            result = run_rbpf(steps, config, SeedTree(1))
            cpu = time.process_time() - begin
            parts = ", ".join(f"{k} {1e3 * v / len(steps):.2f}" for k, v in result.tally.seconds.items())
            off = np.linalg.norm(result.final_pose[:3] - steps.truth.poses[-1, :3])
            print(
                f"  {beams or 'all'} beams, {threads} thread{'s' * (threads > 1)}: CPU {cpu:.2f} s, "
                f"{seconds / cpu:.1f} × real time; wall {result.seconds:.2f} s, {seconds / result.seconds:.1f} × "
                f"({parts} ms a step); resampled "
                f"{result.tally.resamplings} times, end off by {off:.2f} m, {result.used_bytes / 1e6:.1f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
