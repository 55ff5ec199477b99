"""What the width of the kernel on GPS fixes costs and saves: simulated rings in the plane and in space.

    python tests/benchmarks/bench_gps_width.py [--rings 8] [--quick]

Ten submaps of twenty steps, a fix of σ = 0.5 m at every step. Clean, or with a fifth of the fixes off by 30 m or 2 m in
bursts of five that agree with each other. Error at the ends of the submaps, against no kernel and clean fixes.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from graphslam.core.poses import SE2, SE3, group_of
from graphslam.core.records import Gps
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import level_datum_pose
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.solve.batch import BatchSolver

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.reference.space_chain import DenseChain, dense_chain

DATUM = {2: np.array([120.0, -40.0, 2.3]), 3: level_datum_pose(np.array([120.0, -40.0, 310.0, 2.3]))}
LEVER = np.array([0.4, -0.2, 1.5])
KERNELS = (NO_KERNEL, *(RobustKernel("cauchy", k) for k in (1.0, 1.5, 2.385)), RobustKernel("huber", 1.345))
JUMPS = {"clean": 0.0, "30 m": 30.0, "2 m": 2.0}


def fixes(chain: DenseChain, rng: np.random.Generator, dim: int, sigma: float = 0.5) -> Gps:
    """One at every step of the true path."""
    poses = np.concatenate([p[:-1] for p in chain.path])
    group = SE2 if dim == 2 else SE3
    arm = np.zeros((len(poses), group.size))
    arm[:, :dim] = LEVER[:dim]
    if dim == 3:
        arm[:, 6] = 1.0
    at = group.compose(np.broadcast_to(DATUM[dim], poses.shape), group.compose(poses, arm))[:, :dim]
    times = np.concatenate([t[:-1] for t in chain.times])
    z = at + sigma * rng.standard_normal(at.shape)
    return Gps(times=times, positions=z, sigma=np.full(len(z), sigma), lever=LEVER[:dim])


def spoilt(gps: Gps, rng: np.random.Generator, jump: float) -> Gps:
    """Eight bursts of five fixes off by ``jump`` [m]."""
    p = gps.positions.copy()
    for start in rng.choice(np.arange(10, len(p) - 10, 10), 8, replace=False):
        u = rng.normal(size=p.shape[1])
        p[start : start + 5] += jump * u / np.linalg.norm(u)
    return Gps(times=gps.times, positions=p, sigma=gps.sigma, lever=gps.lever)


def error(chain: DenseChain, gps: Gps, kernel: RobustKernel) -> float:
    """Mean squared error at the ends of the submaps [m²]."""
    dim = group_of(chain.poses).dim
    g = FactorGraph(dim)
    g.add_sensor(gps, config=GpsConfig(robust=kernel))
    for s in chain.submaps:
        g.add_submap(s, spacing=4.0)
    g.finish_sensors()
    BatchSolver(g).solve_to_optimum()
    ends = [s.exit_node for s in g.submaps]
    return float(np.mean(np.sum((g.values.poses[ends] - chain.poses[1:])[:, :dim] ** 2, axis=1)))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rings", type=int, default=8)
    parser.add_argument("--quick", action="store_true", help="one ring")
    args = parser.parse_args()
    rings = 1 if args.quick else args.rings
    for dim in (2, 3):
        rng = np.random.default_rng(4 + dim)
        found: dict[tuple[str, RobustKernel], list[float]] = {}
        for _ in range(rings):
            chain = dense_chain(rng, dim, m=10, steps=20, noise=1.0)
            clean = fixes(chain, rng, dim)
            for name, jump in JUMPS.items():
                stream = spoilt(clean, rng, jump)
                for kernel in KERNELS:
                    found.setdefault((name, kernel), []).append(error(chain, stream, kernel))
        reference = float(np.sqrt(np.mean(found["clean", NO_KERNEL])))
        for (name, kernel), squares in found.items():
            rms = float(np.sqrt(np.mean(squares)))
            width = "" if kernel.kind == "none" else f"{kernel.k:g}"
            print(f"{dim}-D  {name:6} {kernel.kind:7} {width:6} {rms:6.3f} m  x {rms / reference:.2f}")


if __name__ == "__main__":
    main()
