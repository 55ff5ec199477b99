"""What an update of the incremental solver costs, beside bare GTSAM: ``python -m tests.benchmarks.bench_incremental``.

An open chain in space with a fix of GPS on every tenth node, and loops back to nodes that were there long ago. Ours is
a :class:`FactorGraph` with the solver ``isam2``; bare GTSAM is an ``ISAM2`` object with native factors that are made
outside the time measured. Medians of single updates by the clock on the wall: reading the CPU time of a process costs
more than an update on some machines, and a median leaves out the updates in which something else ran. ``--quick`` for a
short chain.
"""

from __future__ import annotations

import argparse
import time

import gtsam
import numpy as np

from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_pose
from graphslam.solve.isam2 import Isam2Solver

STEP = np.array([0.0, 0.0, 0.01, 1.0, 0.0, 0.0])
COVARIANCE = np.diag(np.square([0.002, 0.002, 0.01, 0.05, 0.05, 0.05]))
FIX = 0.5
clock = time.perf_counter
EVERY = 10


def problem(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True poses, measured increments, fixes, and pairs of nodes that close a loop."""
    exact = SE3.exp(STEP)
    truth = [SE3.identity]
    for _ in range(n):
        truth.append(SE3.compose(truth[-1], exact))
    poses = np.array(truth)
    noise = rng.standard_normal((n, 6)) * np.sqrt(np.diag(COVARIANCE))
    measured = SE3.compose(np.broadcast_to(exact, (n, 7)), SE3.exp(noise))
    fixes = poses[EVERY::EVERY, :3] + FIX * rng.standard_normal((n // EVERY, 3))
    loops = np.array([(k - 628, k) for k in range(700, n + 1, 700)])  # one turn of the circle before
    return poses, measured, fixes, loops


def ours(n: int, data: tuple[np.ndarray, ...], close: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, FactorGraph]:
    """Seconds of every update, of every call of ``add_submap``, of every loop."""
    poses, measured, fixes, loops = data
    graph = FactorGraph(3)
    solver = Isam2Solver(graph)
    times = np.arange(n + 1, dtype=np.float64)
    gps = Gps(times=times[EVERY::EVERY], positions=fixes, sigma=np.full(len(fixes), FIX), lever=np.zeros(3))
    graph.add_sensor(gps)
    at = {int(j): int(i) for i, j in loops} if close else {}
    add, update, loop = np.zeros(n), np.zeros(n), []
    for k in range(n):
        path = Trajectory(
            times[k : k + 2], np.stack([SE3.identity, measured[k]]), np.stack([0 * COVARIANCE, COVARIANCE])
        )
        submap = Submap(
            key=k, interval=(times[k], times[k + 1]), exit_pose=measured[k], exit_covariance=COVARIANCE,
            trajectory=path, uses=frozenset({"odometry"}),
        )  # fmt: skip
        t0 = clock()
        graph.add_submap(submap)
        t1 = clock()
        solver.update()
        t2 = clock()
        add[k], update[k] = t1 - t0, t2 - t1
        if k + 1 in at:
            i = at[k + 1]
            T = SE3.between(poses[i], poses[k + 1])
            graph.add_between(i, k + 1, T, COVARIANCE, evidence="shared-scan")
            t0 = clock()
            solver.update()
            loop.append(clock() - t0)
    return update, add, np.array(loop), graph


def bare(n: int, data: tuple[np.ndarray, ...], close: bool) -> tuple[np.ndarray, np.ndarray, gtsam.ISAM2]:
    """The same by GTSAM alone, the frame of GPS being known to it."""
    poses, measured, fixes, loops = data
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.setRelinearizeThreshold(0.1)
    parameters.relinearizeSkip = 10
    isam = gtsam.ISAM2(parameters)
    noise = gtsam.noiseModel.Gaussian.Covariance(COVARIANCE)
    fix = gtsam.noiseModel.Isotropic.Sigma(3, FIX)
    at = {int(j): int(i) for i, j in loops} if close else {}
    update, loop = np.zeros(n), []
    X = gtsam.symbol_shorthand.X
    last = gtsam.Pose3()
    for k in range(n):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        T = gtsam_pose(measured[k])
        if k == 0:
            factors.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
            values.insert(X(0), gtsam.Pose3())
        factors.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), T, noise))
        values.insert(X(k + 1), last.compose(T))
        if (k + 1) % EVERY == 0:
            factors.add(gtsam.GPSFactor(X(k + 1), fixes[k // EVERY], fix))
        t0 = clock()
        isam.update(factors, values)
        last = isam.calculateEstimatePose3(X(k + 1))
        update[k] = clock() - t0
        if k + 1 in at:
            i = at[k + 1]
            between = gtsam.BetweenFactorPose3(X(i), X(k + 1), gtsam_pose(SE3.between(poses[i], poses[k + 1])), noise)
            more = gtsam.NonlinearFactorGraph()
            more.add(between)
            t0 = clock()
            isam.update(more, gtsam.Values())
            last = isam.calculateEstimatePose3(X(k + 1))
            loop.append(clock() - t0)
    return update, np.array(loop), isam


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--nodes", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    n = 1500 if args.quick else args.nodes
    data = problem(n, np.random.default_rng(args.seed))
    for close in (False, True):
        print(f"{n} nodes in space, a fix on every {EVERY}th" + (", a loop on every 700th" if close else ""))
        update, add, loop, graph = ours(n, data, close)
        theirs, their_loop, _ = bare(n, data, close)
        ms = 1e3
        first, last = ms * np.median(update[:1000]), ms * np.median(update[-100:])
        bare_first, bare_last = ms * np.median(theirs[:1000]), ms * np.median(theirs[-100:])
        print(f"  update, median of the first 1,000  ours {first:7.3f} ms   GTSAM {bare_first:7.3f}")
        print(f"  update, median of the last 100     ours {last:7.3f} ms   GTSAM {bare_last:7.3f}")
        print(
            f"    ratio {last / bare_last:.2f}; to the first {last / first:.2f}, GTSAM's {bare_last / bare_first:.2f}"
        )
        print(
            f"  update, mean                       ours {ms * update.mean():7.3f} ms   GTSAM {ms * theirs.mean():7.3f}"
        )
        some, end = ms * np.median(add[:1000]), ms * np.median(add[-100:])
        print(f"  add_submap, first 1,000 and last   ours {some:7.3f} ms, {end:.3f}; all {add.sum():.2f} s")
        if close and len(loop):
            ratio = loop.sum() / their_loop.sum()
            print(f"  {len(loop)} loops: ours {loop.sum():.3f} s   GTSAM {their_loop.sum():.3f}   ratio {ratio:.2f}")
        removed = sum(e["event"] == "removed" for e in graph.events)
        print(f"  factors removed: {removed}; objective {graph.objective().total:.4f}")


if __name__ == "__main__":
    main()
