"""Wrong loops in recorded pose networks: what GNC leaves of them, and what it does to the right ones.

    GRAPHSLAM_DATA=... python tests/benchmarks/bench_robust.py [--files M3500,sphere] [--kinds random,aliased]
        [--shares 0.3,0.5] [--seeds 2] [--first 100] [--gtsam] [--quick]

A row says: the objective over the true inliers at the answer, divided by their optimum (the clean file's); precision
and recall of "this edge is wrong"; CPU seconds. ``--gtsam`` adds GTSAM's own GNC from dead reckoning, odometry known
to be right, with the same limits, on the same file. Exit code 1 if a row with a share of 0.3 and random wrong loops is
above 1.01. ``--quick``: one draw of random wrong loops in one file; without recorded data it says so and does nothing.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import gtsam
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from graphslam.core.network import PoseNetwork
from graphslam.core.random import SeedTree
from graphslam.graph.gtsam_values import from_gtsam
from graphslam.graph.network import network_values
from graphslam.io.network_file import read_network
from graphslam.solve.network.solve import solve_network
from graphslam.solve.network.start import odometry_start
from tests.reference.gtsam_network import to_graph
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.plain_network import edge_costs
from tests.reference.wrong_loops import WrongLoops, add_wrong_loops, is_odometry

FILES = ("input_M3500_g2o", "parking-garage", "sphere2500")


def row(label: str, mixed: WrongLoops, poses: np.ndarray, out: np.ndarray, best: float, seconds: float) -> float:
    ratio = float(edge_costs(mixed.network, poses)[~mixed.wrong].sum()) / best
    hit = int((out & mixed.wrong).sum())
    print(
        f"{label:48} {ratio:12.6g}  precision {hit / max(int(out.sum()), 1):.4f}  recall "
        f"{hit / max(int(mixed.wrong.sum()), 1):.4f}  wrong {int(mixed.wrong.sum()):5d}  kept "
        f"{int(mixed.wrong.sum()) - hit:4d}  right ones dropped {int(out.sum()) - hit:4d}  CPU {seconds:6.1f} s",
        flush=True,
    )
    return ratio


def gtsam_gnc(network: PoseNetwork, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """GTSAM's GncLMOptimizer from dead reckoning, odometry known to be right."""
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    a = len(network.anchors)
    params.setKnownInliers([*range(a), *(a + np.flatnonzero(is_odometry(network.edges))).tolist()])
    start = network_values(network, odometry_start(network))
    optimizer = gtsam.GncLMOptimizer(to_graph(network), to_gtsam(start, held=True), params)
    optimizer.setInlierCostThresholds(0.5 * limit)
    found = optimizer.optimize()
    return from_gtsam(found, start).poses, np.asarray(optimizer.getWeights())[a:] < 0.5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", default=",".join(FILES), help="comma-separated words in file names")
    parser.add_argument("--kinds", default="random,aliased")
    parser.add_argument("--shares", default="0.3")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--gtsam", action="store_true")
    parser.add_argument("--quick", action="store_true", help="one draw in M3500")
    args = parser.parse_args()
    root = os.environ.get("GRAPHSLAM_DATA")
    if args.quick:
        args.files, args.kinds, args.shares, args.seeds = "M3500", "random", "0.3", 1
        if not root:
            print("no recorded data here (GRAPHSLAM_DATA): nothing to do")
            return 0
    if not root:
        parser.error("set GRAPHSLAM_DATA to the folder of recorded data")
    failed = 0
    for name in (f for f in FILES if any(word in f for word in args.files.split(","))):
        clean = read_network(Path(root) / "posegraphs" / f"{name}.g2o.xz")
        solved = solve_network(clean, starts=("chordal",))
        for kind in args.kinds.split(","):
            for share in map(float, args.shares.split(",")):
                for seed in range(args.first, args.first + args.seeds):
                    rng = SeedTree(seed).child("wrong loops", kind).generator()
                    mixed = add_wrong_loops(clean, share, rng, kind=kind, reference=solved.poses)
                    label = f"{name} {kind} {share:.0%} seed {seed}"
                    begin = time.process_time()
                    answer = solve_network(mixed.network, "gnc")
                    seconds = time.process_time() - begin
                    ratio = row(label, mixed, answer.poses, ~answer.inliers, solved.objective, seconds)
                    failed += kind == "random" and share <= 0.3 and ratio > 1.01
                    if args.gtsam:
                        begin = time.process_time()
                        limit = float(answer.details["edge_limit"])
                        poses, out = gtsam_gnc(mixed.network, limit)
                        row("   GTSAM's GNC", mixed, poses, out, solved.objective, time.process_time() - begin)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
