"""Skeleton networks of growing size, from dead reckoning to the optimum, in CPU seconds and peak memory; beside GTSAM.

    python -m tests.benchmarks.bench_scale [--quick] [--poses 10000,100000,1000000] [--threads 1] [--gtsam 10000]

The laps world (:mod:`graphslam_studies.sim.laps`): twelve laps of one route, 100 measurements a pose, so 10⁴, 10⁵ and
10⁶ poses have 10⁶, 10⁷ and 10⁸ measurements. Each size is a process of its own that first runs a small world, so that
nothing is compiled while the clock runs. Printed of each: time by stage; when χ²/dof was within 1 % of its end value,
and when a step gained less than one unit of χ²; the largest move of the last step; distances to the truth; how far the
softest modes still move (approximate); costs per measurement, and their growth from size to size (the exponent).

``--gtsam N`` solves the same network of N poses with GTSAM's Gauss-Newton, by MULTIFRONTAL_CHOLESKY and
MULTIFRONTAL_SOLVER, each ordered by COLAMD and METIS, from dead reckoning with the landmarks at their best places, and
from our forward pass. Each is a process with a limit on time and memory (``--seconds``, ``--gigabytes``), and ends when
an iteration gains less than 10⁻⁵ of the objective. Its factors measure bearing and range instead of a point, so
objectives are compared as ours, at its poses.

``--chain 100000,1000000`` relaxes plain pose graphs: odometry, and loops at one pose in a hundred, the links between
loops joined, beside GTSAM in the same four ways from the same start. GTSAM's residual of a link differs from ours in
how it turns the way; its objective is therefore also computed at our poses.

``--tiles FOLDER`` writes each world to disk and relaxes it from there, one tile of 2·10⁴ poses in memory at a time;
chains as tasks of ``--workers`` processes, or of the workers of a Dask scheduler (``--cluster``).

``--quick``: 1,200 and 4,800 poses, GTSAM's Cholesky at 600 from dead reckoning. Exit code 1 if we end above the
optimum: if χ²/dof is above that of the truth, or the objective above GTSAM's.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SOLVERS = ("MULTIFRONTAL_CHOLESKY", "MULTIFRONTAL_SOLVER")
ORDERINGS = ("COLAMD", "METIS")


def peak() -> float:
    """Largest memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


def ours(poses: int, threads: int) -> dict[str, Any]:
    """Draw, collapse, relax, then the unit costs."""
    from graphslam.skeleton.collapse import Collapse
    from graphslam.skeleton.preconditioner import Preconditioner, PreconditionerLevels
    from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
    from graphslam.skeleton.schur import Network, Workers, WorkRanges
    from graphslam_studies.sim.laps import LapsConfig, draw_laps

    config = RelaxConfig(threads=threads)
    for levels in (PreconditionerLevels(0, 20), PreconditionerLevels(10, 80)):
        relax_skeleton(draw_laps(LapsConfig(poses=600)).problem(), RelaxConfig(levels=levels, threads=threads))
    world = draw_laps(LapsConfig(poses=poses))
    collapse = Collapse(int(world.first[-1]))
    seconds = 0.0
    for a, b in world.correspondences():  # drawing them is not the collapse
        begin = time.process_time()
        collapse.add(a, b)
        seconds += time.process_time() - begin
    begin = time.process_time()
    landmark, count = collapse.landmarks()
    seconds += time.process_time() - begin
    problem = world.problem(landmark)
    wall = time.perf_counter()
    found = relax_skeleton(problem, config)
    wall = time.perf_counter() - wall
    total = sum(found.seconds.values())
    history = [(h.seconds, h.objective, h.chi2, h.products, h.predicted, h.largest_move) for h in found.history]
    end = found.chi2
    within = next(h[0] for h in history if h[2] <= 1.01 * end)
    converged = next((h[0] for h in history if h[4] < 1.0), None)
    reckoned, truth = problem.dead_reckoning(), world.truth
    top = peak()

    workers = Workers(threads)
    layout = WorkRanges(problem, workers)
    costs = {"collapse": seconds}
    begin = time.process_time()
    network = Network(layout, found.poses)
    costs["linearise"] = time.process_time() - begin
    network.chain_blocks()
    v = network.gradient + 1.0
    begin = time.process_time()
    for _ in range(3):
        network.product(v)
    costs["product"] = (time.process_time() - begin) / 3
    begin = time.process_time()
    M = Preconditioner(network, PreconditionerLevels(10, 80))
    costs["preconditioner"] = time.process_time() - begin
    begin = time.process_time()
    M(v)
    costs["apply"] = time.process_time() - begin
    at_truth = Network(layout, truth).objective
    return {
        "poses": poses,
        "measurements": problem.measurements,
        "landmarks": count,
        "seconds": total,
        "wall": wall,
        "stages": found.seconds,
        "within": within,
        "settled": converged,
        "history": history,
        "converged": found.converged,
        "objective": found.objective,
        "chi2": end,
        "chi2_truth": at_truth / problem.freedom,
        "largest_move": found.largest_move,
        "predicted": found.predicted,
        "reckoned": rms(reckoned.position, truth.position),
        "rms": rms(found.poses.position, truth.position),
        "soft": [(m.rms, m.largest, m.pose) for m in found.soft],
        "costs": {k: v / problem.measurements * 1e9 for k, v in costs.items()},
        "peak": top,
        "peak_all": peak(),
        "products": found.products,
    }


def draw_tiles(poses: int, folder: str) -> dict[str, Any]:
    """Write a world to disk."""
    from graphslam_studies.sim.laps import LapsConfig, draw_laps

    begin = time.process_time()
    tiles = draw_laps(LapsConfig(poses=poses)).to_tiles(folder)
    return {"seconds": time.process_time() - begin, "measurements": tiles.measurements, "peak": peak()}


def from_tiles(poses: int, folder: str, iterations: int, start: str, threads: int) -> dict[str, Any]:
    """Relax a network whose measurements stay on disk."""
    from graphslam.skeleton.preconditioner import PreconditionerLevels
    from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
    from graphslam.skeleton.schur import step_poses
    from graphslam.skeleton.tile_store import Tiles
    from graphslam_studies.sim.laps import LapsConfig, draw_laps

    for levels in (PreconditionerLevels(0, 20), PreconditionerLevels(10, 80)):
        relax_skeleton(draw_laps(LapsConfig(poses=600)).problem(), RelaxConfig(levels=levels))
    world = draw_laps(LapsConfig(poses=poses))
    problem = world.problem(tiles=Tiles(folder))
    truth, given = world.truth.position, None
    if start == "truth":
        drift, at = np.zeros((poses, 6)), 2 * np.pi * np.arange(poses) / poses
        drift[:, 3:] = 0.3 * np.sin(np.outer(at, [7, 5, 3]))
        given = step_poses(world.truth, drift)
        del drift, at
    del world
    wall = time.perf_counter()
    found = relax_skeleton(problem, RelaxConfig(split=False, soft=0, iterations=iterations, threads=threads), given)
    wall = time.perf_counter() - wall
    return {
        "seconds": sum(found.seconds.values()),
        "wall": wall,
        "stages": found.seconds,
        "history": [(h.seconds, h.objective, h.chi2, h.products, h.predicted, h.largest_move) for h in found.history],
        "chi2": found.chi2,
        "rms": rms(found.poses.position, truth),
        "peak": peak(),
    }


def theirs(poses: int, solver: str, ordering: str, start: str, gigabytes: float) -> dict[str, Any]:
    """The same network with GTSAM's factors and its Gauss-Newton."""
    import gtsam

    from graphslam.core.se3 import matrix_to_quat
    from graphslam.skeleton.landmark_kernels import Poses
    from graphslam.skeleton.schur import Network, Workers, WorkRanges
    from graphslam.skeleton.start import chain_start, forward_pass
    from graphslam_studies.sim.laps import LapsConfig, draw_laps

    problem = (world := draw_laps(LapsConfig(poses=poses))).problem()
    at = problem.dead_reckoning() if start == "odometry" else forward_pass(problem, chain_start(problem)).poses
    layout = WorkRanges(problem, Workers(1))
    landmarks = Network(layout, at).landmarks
    limit = int(gigabytes * 1e9)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    begin = time.process_time()
    N, L = problem.poses, problem.landmarks
    noise = gtsam.noiseModel
    z = problem.points.astype(np.float64)
    sight = noise.Diagonal.Sigmas(np.array([problem.bearing_sigma] * 2 + [problem.range_sigma]))
    graph = gtsam.NonlinearFactorGraph()
    ranges = np.linalg.norm(z, axis=1)
    for i in range(N):
        for m in range(problem.first[i], problem.first[i + 1]):
            key = N + int(problem.landmark[m])
            graph.add(gtsam.BearingRangeFactor3D(i, key, gtsam.Unit3(z[m]), float(ranges[m]), sight))
    step = noise.Gaussian.Covariance(problem.odometry_covariance[0])
    turns = matrix_to_quat(problem.odometry_rotation)
    for k in range(N - 1):
        x, y, q, w = turns[k]
        turn = gtsam.Rot3.Quaternion(w, x, y, q)
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(turn, problem.odometry_translation[k]), step))
    assert problem.up is not None
    tilt = noise.Isotropic.Sigma(2, float(problem.up_sigma))
    for i in range(N):
        up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
        graph.add(gtsam.AttitudeFactorPose3(i, up, tilt, gtsam.Unit3(problem.up[i])))
    fix = noise.Gaussian.Covariance(problem.gps_covariance[0])
    for g in range(problem.fixes):
        graph.add(gtsam.GPSFactor(int(problem.gps_pose[g]), problem.gps_position[g], fix))
    first = gtsam.Pose3(gtsam.Rot3(problem.start_rotation), problem.start_position)
    graph.add(gtsam.PriorFactorPose3(0, first, noise.Gaussian.Covariance(problem.start_covariance)))
    values = gtsam.Values()
    for i in range(N):
        values.insert(i, gtsam.Pose3(gtsam.Rot3(at.rotation[i]), at.position[i]))
    for j in range(L):
        values.insert(N + j, landmarks[j])
    built = time.process_time() - begin

    parameters = gtsam.GaussNewtonParams()
    parameters.setLinearSolverType(solver)
    parameters.setOrderingType(ordering)
    parameters.setRelativeErrorTol(1e-5)
    begin = time.process_time()
    optimizer = gtsam.GaussNewtonOptimizer(graph, values, parameters)
    last, times = optimizer.error(), []
    for _ in range(20):
        optimizer.iterate()
        times.append(time.process_time() - begin)
        now = optimizer.error()
        if not last - now > 1e-5 * now:
            break
        last = now
    seconds = time.process_time() - begin
    result = optimizer.values()
    R = np.array([result.atPose3(i).rotation().matrix() for i in range(N)])
    p = np.array([result.atPose3(i).translation() for i in range(N)])
    top = peak()
    objective = Network(layout, Poses(R, p)).objective
    return {
        "solver": solver,
        "ordering": ordering,
        "start": start,
        "build": built,
        "seconds": seconds,
        "iterations": times,
        "objective": objective,
        "error": 2.0 * now,
        "rms": rms(p, world.truth.position),
        "peak": top,
    }


def chain_graph(poses: int, share: float) -> Any:
    """The laps' odometry, and a loop to the lap before at a share of the poses."""
    from graphslam.core.se3 import quat_to_matrix, so3_exp
    from graphslam.skeleton.chain_graph import ChainGraph
    from graphslam_studies.sim.laps import LapsConfig, draw_laps

    world = draw_laps(LapsConfig(poses=poses))
    per, rng = world.shared.shape[0], np.random.default_rng(0)
    j = np.sort(rng.choice(np.arange(per, poses), int(share * poses), replace=False))
    R, p = world.truth
    R, p = R[0].T @ R, (p - p[0]) @ R[0]

    def measured(i: Any, j: Any, turn: float, shift: float) -> Any:
        Q = quat_to_matrix(so3_exp(turn * rng.standard_normal((len(i), 3))))
        d = np.einsum("nji,nj->ni", R[i], p[j] - p[i]) + shift * rng.standard_normal((len(i), 3))
        return R[i].swapaxes(1, 2) @ R[j] @ Q, d

    k, ends = np.arange(poses - 1), np.column_stack([j - per, j])
    step, loop = np.diag([5e-4**2] * 3 + [0.01**2] * 3), np.diag([2e-3**2] * 3 + [0.02**2] * 3)
    return ChainGraph(*measured(k, k + 1, 5e-4, 0.01), step, ends, *measured(j - per, j, 2e-3, 0.02), loop)


def our_chain(poses: int, share: float, file: str) -> dict[str, Any]:
    """A chain with loops, links between them joined."""
    from graphslam.skeleton.chain_graph import relax_chain

    relax_chain(chain_graph(2000, share))
    graph = chain_graph(poses, share)
    begin = time.process_time()
    found = relax_chain(graph)
    seconds = time.process_time() - begin
    np.savez(file, R=found.poses.rotation, p=found.poses.position)
    return {
        "seconds": seconds,
        "history": found.history,
        "move": found.largest_move,
        "predicted": found.predicted,
        "peak": peak(),
    }


def draw_chain(poses: int, share: float, folder: str) -> dict[str, Any]:
    """Write a chain with loops to disk, in tiles of 2·10⁴ poses."""
    from graphslam.skeleton.chain_tiles import chain_to_disk
    from tests.reference.chain_pieces import cut_chain

    graph = chain_graph(poses, share)
    begin = time.process_time()
    chain_to_disk(folder, cut_chain(graph, 20_000))
    return {"seconds": time.process_time() - begin}


def chain_from_tiles(folder: str, workers: int, cluster: str) -> dict[str, Any]:
    """Relax a chain with loops from disk."""
    from graphslam.skeleton.chain_graph import relax_chain
    from graphslam.skeleton.chain_tiles import relax_tiles

    relax_chain(chain_graph(2000, 0.01))
    begin, wall = time.process_time(), time.perf_counter()
    found = relax_tiles(folder, workers=workers or None, cluster=cluster or None)
    theirs = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "seconds": time.process_time() - begin,
        "wall": time.perf_counter() - wall,
        "workers": theirs.ru_utime + theirs.ru_stime,
        "history": found.history,
        "separator": found.separator,
        "tiles": len(found.names),
        "tasks": len(found.tasks),
        "shortest": min(found.tasks),
        "peak": peak(),
        "peak_workers": theirs.ru_maxrss / 1e6,
    }


def their_chain(poses: int, share: float, file: str, solver: str, ordering: str, gigabytes: float) -> dict[str, Any]:
    """The same with GTSAM's Gauss-Newton; and GTSAM's objective at our poses."""
    import gtsam

    from graphslam.core.se3 import matrix_to_quat

    graph = chain_graph(poses, share)
    start = graph.dead_reckoning()
    resource.setrlimit(resource.RLIMIT_AS, (int(gigabytes * 1e9),) * 2)
    begin = time.process_time()
    factors, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Gaussian.Covariance
    k = np.arange(poses - 1)
    for ends, Z, d, cov in (
        (np.column_stack([k, k + 1]), graph.rotation, graph.translation, graph.covariance[0]),
        (graph.ends, graph.loop_rotation, graph.loop_translation, graph.loop_covariance[0]),
    ):
        model, turns = noise(cov), matrix_to_quat(Z)
        for n, (i, j) in enumerate(ends.tolist()):
            x, y, z, w = turns[n]
            factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), d[n]), model))
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))

    def values(R: np.ndarray, p: np.ndarray) -> Any:
        out = gtsam.Values()
        for i in range(poses):
            out.insert(i, gtsam.Pose3(gtsam.Rot3(R[i]), p[i]))
        return out

    initial = values(start.rotation, start.position)
    built = time.process_time() - begin
    parameters = gtsam.GaussNewtonParams()
    parameters.setLinearSolverType(solver)
    parameters.setOrderingType(ordering)
    parameters.setRelativeErrorTol(1e-6)
    begin = time.process_time()
    optimizer = gtsam.GaussNewtonOptimizer(factors, initial, parameters)
    result = optimizer.optimize()
    seconds = time.process_time() - begin
    top = peak()
    with np.load(file) as ours:
        mine = 2.0 * factors.error(values(ours["R"], ours["p"]))
    return {
        "build": built,
        "seconds": seconds,
        "iterations": optimizer.iterations(),
        "objective": 2.0 * factors.error(result),
        "ours": mine,
        "peak": top,
    }


def show_chain(poses: int, share: float, seconds: float, gigabytes: float) -> int:
    """A chain with loops, ours beside GTSAM; how many of ours end above GTSAM's objective by 1e-6 of it."""
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "ours.npz")
        mine, why = child("chain", str(poses), str(share), file)
        if mine is None:
            print(f"chain of {poses}: failed: {why}")
            return 1
        print(
            f"\nchain of {poses:,} poses with {int(share * poses):,} loops, from dead reckoning: {mine['seconds']:.2f} "
            f"CPU s, {len(mine['history']) - 1} steps, {mine['peak']:.2f} GB, last step moved {mine['move']:.1e} m, "
            f"predicted {mine['predicted']:.1e}; objective " + " → ".join(f"{J:.7g}" for J in mine["history"]),
            flush=True,
        )
        best: float | None = None
        for solver in SOLVERS:
            for ordering in ORDERINGS:
                g, why = child(
                    "their_chain", str(poses), str(share), file, solver, ordering, str(gigabytes), timeout=seconds
                )
                if g is None:
                    print(f"  GTSAM {solver} {ordering}: {why}", flush=True)
                    continue
                above = g["ours"] / g["objective"] - 1.0
                failed += above > 1e-6
                best = g["seconds"] if best is None else min(best, g["seconds"])
                print(
                    f"  GTSAM {solver} {ordering}: build {g['build']:.1f} s, {g['seconds']:.1f} s in {g['iterations']} "
                    f"iterations, {g['peak']:.2f} GB, {g['seconds'] / mine['seconds']:.1f} × ours; its objective "
                    f"{g['objective']:.7g}, ours by its residuals {above:+.1e}",
                    flush=True,
                )
        if best is not None:
            print(f"  best of GTSAM: {best:.1f} s, {best / mine['seconds']:.1f} × ours")
    return failed


def child(kind: str, *arguments: str, timeout: float | None = None) -> tuple[dict[str, Any] | None, str]:
    """One run in a fresh process; None and the reason where it does not end."""
    command = [sys.executable, "-m", "tests.benchmarks.bench_scale", "--child", kind, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, cwd=ROOT)
    except subprocess.TimeoutExpired:
        return None, f"not done after {timeout:.0f} s of wall time"
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
        return None, last[:200]
    return json.loads(done.stdout.splitlines()[-1]), ""


def show(r: dict[str, Any]) -> None:
    """One size."""
    print(
        f"\n{r['poses']:,} poses, {r['measurements']:,} measurements, {r['landmarks']:,} landmarks\n"
        f"  from dead reckoning ({r['reckoned']:.2f} m rms to the truth) to the end: {r['seconds']:.1f} CPU s "
        f"({r['wall']:.1f} s wall), peak {r['peak']:.2f} GB, {len(r['history'])} steps, {r['products']} products; "
        f"ends in {r['converged'] or 'nothing'}\n"
        f"  χ²/dof within 1 % of its end after {r['within']:.1f} s; a step gains less than 1 after "
        + (f"{r['settled']:.1f} s" if r["settled"] is not None else "-")
        + f"; last step: predicted {r['predicted']:.1e}, largest move {r['largest_move']:.1e} m\n"
        f"  χ²/dof {r['chi2']:.6f} (at the truth {r['chi2_truth']:.6f}); {r['rms']:.3f} m rms to the truth"
    )
    if r["soft"]:
        modes = ", ".join(f"{a:.3f} m rms and at most {b:.3f} m (pose {i})" for a, b, i in r["soft"])
        print(f"  softest modes, for one unit of χ² (approximate, lower bounds): {modes}")
    print("  stages [s]: " + ", ".join(f"{k} {v:.2f}" for k, v in r["stages"].items()))
    print("  step: CPU s, objective, χ²/dof, products, predicted gain, largest move")
    for k, (t, J, chi2, n, gain, far) in enumerate(r["history"], 1):
        print(f"  {k:3d}: {t:8.2f}  {J:.6e}  {chi2:.6f}  {n:3d}  {gain:.2e}  {far:.2e} m")
    print("  ns per measurement: " + ", ".join(f"{k} {v:.1f}" for k, v in r["costs"].items()), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--poses", default="10000,100000,1000000")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--gtsam", type=int, default=0, help="poses of the network that GTSAM solves as well")
    parser.add_argument("--starts", default="odometry,forward", help="from where GTSAM starts")
    parser.add_argument("--seconds", type=float, default=1800.0, help="wall time for one run of GTSAM")
    parser.add_argument("--gigabytes", type=float, default=10.0, help="address space for one run of GTSAM")
    parser.add_argument("--chain", default="", help="sizes of plain pose graphs: a chain with loops")
    parser.add_argument("--loops", type=float, default=0.01, help="loops of a chain, for each pose")
    parser.add_argument("--tiles", default="", help="folder for tiles: also relax each size from disk")
    parser.add_argument("--workers", type=int, default=0, help="processes that relax a chain from disk")
    parser.add_argument("--cluster", default="", help="Dask scheduler whose workers do so")
    parser.add_argument("--disk-only", action="store_true", help="not in memory: only from --tiles")
    parser.add_argument("--steps", type=int, default=30, help="most steps of a relaxation from disk")
    parser.add_argument(
        "--start",
        choices=["forward", "truth"],
        default="forward",
        help="of a relaxation from disk: truth is bent by 0.3 m",
    )
    parser.add_argument("--child", nargs="*", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        kind, n, *rest = args.child
        runs_of: dict[str, Any] = {
            "ours": lambda: ours(int(n), int(rest[0])),
            "theirs": lambda: theirs(int(n), rest[0], rest[1], rest[2], float(rest[3])),
            "draw": lambda: draw_tiles(int(n), rest[0]),
            "tiles": lambda: from_tiles(int(n), rest[0], int(rest[1]), rest[2], int(rest[3])),
            "draw_chain": lambda: draw_chain(int(n), float(rest[0]), rest[1]),
            "chain_tiles": lambda: chain_from_tiles(n, int(rest[0]), rest[1]),
            "chain": lambda: our_chain(int(n), float(rest[0]), rest[1]),
            "their_chain": lambda: their_chain(int(n), float(rest[0]), rest[1], rest[2], rest[3], float(rest[4])),
        }
        print(json.dumps(runs_of[kind]()))
        return 0
    sizes = [1200, 4800] if args.quick else [int(n) for n in args.poses.split(",") if n]
    beside = 600 if args.quick else args.gtsam
    starts, solvers = (args.starts.split(","), SOLVERS) if not args.quick else (["odometry"], SOLVERS[:1])
    failed, runs = 0, {}
    for n in [] if args.disk_only else sizes:
        r, why = child("ours", str(n), str(args.threads))
        if r is None:
            print(f"{n} poses: failed: {why}")
            failed += 1
            continue
        runs[n] = r
        show(r)
        failed += r["chi2"] > r["chi2_truth"]
    done = sorted(runs)
    for a, b in pairwise(done):
        larger = np.log(runs[b]["measurements"] / runs[a]["measurements"])
        costs = runs[a]["costs"], runs[b]["costs"]
        slopes = {k: 1.0 + np.log(costs[1][k] / costs[0][k]) / larger for k in costs[0]}
        print(
            f"\ngrowth from {a:,} to {b:,} poses (1 = linear): " + ", ".join(f"{k} {v:.2f}" for k, v in slopes.items())
        )
    if beside:
        mine = runs.get(beside)
        if mine is None:
            mine, why = child("ours", str(beside), "1")
            assert mine is not None, why
        print(
            f"\nGTSAM, {beside:,} poses (ours: {mine['seconds']:.2f} CPU s, {mine['peak']:.2f} GB, objective "
            f"{mine['objective']:.3f})"
        )
        best: float | None = None
        for start in starts:
            for solver in solvers:
                for ordering in ORDERINGS:
                    g, why = child(
                        "theirs", str(beside), solver, ordering, start, str(args.gigabytes), timeout=args.seconds
                    )
                    name = f"  {solver} {ordering:6} from {start}"
                    if g is None:
                        print(f"{name}: {why}", flush=True)
                        continue
                    if start == "odometry":
                        best = g["seconds"] if best is None else min(best, g["seconds"])
                    failed += mine["objective"] > g["objective"] * (1 + 1e-9)
                    print(
                        f"{name}: build {g['build']:.1f} s, {g['seconds']:.1f} s in {len(g['iterations'])} iterations "
                        f"({', '.join(f'{t:.1f}' for t in g['iterations'])}), peak {g['peak']:.2f} GB, our objective "
                        f"at its poses {g['objective']:.3f}, {g['rms']:.3f} m to the truth; "
                        f"{g['seconds'] / mine['seconds']:.1f} × ours",
                        flush=True,
                    )
        if best is not None:
            print(f"  best of GTSAM from dead reckoning: {best:.1f} s, {best / mine['seconds']:.1f} × ours")
    for n in [int(k) for k in ("2000" if args.quick else args.chain).split(",") if k]:
        failed += show_chain(n, args.loops, args.seconds, args.gigabytes)
        if args.tiles:
            folder = str(Path(args.tiles) / f"chain-{n}")
            drawn, why = child("draw_chain", str(n), str(args.loops), folder)
            t, why = child("chain_tiles", folder, str(args.workers), args.cluster) if drawn else (None, why)
            if drawn is None or t is None:
                print(f"chain of {n} poses from disk: failed: {why}")
                failed += 1
                continue
            print(
                f"  from disk: written in {drawn['seconds']:.1f} CPU s; {t['tiles']} tiles in {t['tasks']} tasks "
                f"(the shortest {t['shortest']:.2f} CPU s a step), separator of "
                f"{t['separator']:,} poses; relaxed in {t['seconds']:.1f} CPU s and {t['workers']:.1f} CPU s of "
                f"workers ({t['wall']:.1f} s wall), peak {t['peak']:.2f} GB, of a worker {t['peak_workers']:.2f} GB; "
                "objective " + " → ".join(f"{J:.7g}" for J in t["history"]),
                flush=True,
            )
    if args.tiles:
        for n in sizes:
            folder = str(Path(args.tiles) / str(n))
            drawn, why = child("draw", str(n), folder)
            t, why = (
                child("tiles", str(n), folder, str(args.steps), args.start, str(args.threads)) if drawn else (None, why)
            )
            if drawn is None or t is None:
                print(f"{n} poses from disk: failed: {why}")
                failed += 1
                continue
            print(
                f"\n{n:,} poses from disk: written in {drawn['seconds']:.1f} CPU s ({drawn['peak']:.2f} GB); "
                f"relaxed in {t['seconds']:.1f} CPU s ({t['wall']:.1f} s wall), peak {t['peak']:.2f} GB, "
                f"χ²/dof {t['chi2']:.6f}, {t['rms']:.3f} m rms to the truth"
            )
            print("  stages [s]: " + ", ".join(f"{k} {v:.2f}" for k, v in t["stages"].items()))
            for k, (at, J, chi2, m, gain, far) in enumerate(t["history"], 1):
                print(f"  {k:3d}: {at:8.2f}  {J:.6e}  {chi2:.6f}  {m:3d}  {gain:.2e}  {far:.2e} m")
    print("ok" if not failed else f"{failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
