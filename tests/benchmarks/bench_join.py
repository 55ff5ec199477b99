"""Joiners and the batch solver side by side on the first 50, 100 and 200 published local maps of Victoria Park.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m tests.benchmarks.bench_join [--quick]

Needs GRAPHSLAM_DATA. Times are process CPU seconds, the least of several repetitions; ratios are within one run, so a
busy machine blurs them little. "join" includes evaluating the joined map's objective; "polish" is the Gauss–Newton that
follows.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graphslam.graph.submap_solver import solve_submaps
from graphslam.io.slsjf import read_slsjf_local_maps
from graphslam.join.association import Association
from graphslam.join.ekf import join_ekf
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.polish import polish


def least(call: Callable[[], Any], repetitions: int) -> tuple[float, Any]:
    """Least CPU time of several calls, and the last result."""
    best, result = float("inf"), None
    for _ in range(repetitions):
        start = time.process_time()
        result = call()
        best = min(best, time.process_time() - start)
    return best, result


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="two repetitions, without association")
    options = parser.parse_args(arguments)
    root = os.environ.get("GRAPHSLAM_DATA")
    if not root:
        print("set GRAPHSLAM_DATA to the folder that holds victoria_park_processed/", file=sys.stderr)
        return 1
    maps = read_slsjf_local_maps(Path(root) / "victoria_park_processed")
    repetitions = 2 if options.quick else 5
    joiners = {"eif-tree": join_tree, "eif-sequential": join_sequential, "ekf": join_ekf}
    solve_submaps(maps[:20])
    print(
        f"{'maps':>4} {'method':<16} {'join s':>8} {'polish s':>8} {'its':>3} {'objective':>12} {'polished':>12}",
        end="",
    )
    print(f" {'nnz':>8} {'join / batch':>12}")
    times: dict[tuple[int, str], float] = {}
    for m in (50, 100, 200):
        batch, best = least(lambda m=m: solve_submaps(maps[:m]), repetitions)  # type: ignore[misc]
        times[m, "batch"] = batch
        print(f"{m:>4} {'batch':<16} {batch:>8.3f} {'':>8} {best.iterations:>3} {best.objective:>12.4f}", end="")
        print(f" {best.objective:>12.4f} {best.nnz:>8} {1.0:>12.2f}")
        for name, join in joiners.items():
            seconds, joined = least(lambda m=m, join=join: join(maps[:m]), repetitions)  # type: ignore[misc]
            extra, polished = least(lambda m=m, j=joined: polish(maps[:m], j), repetitions)  # type: ignore[misc]
            times[m, name] = seconds
            print(f"{m:>4} {name:<16} {seconds:>8.3f} {extra:>8.3f} {polished.iterations:>3}", end="")
            print(f" {joined.objective:>12.4f} {polished.objective_polished:>12.4f} {joined.nnz:>8}", end="")
            print(f" {seconds / batch:>12.2f}")
    print("ratios")
    for m in (50, 100, 200):
        tree, chain, dense = (times[m, k] for k in joiners)
        print(f"{m:>4} sequential / tree {chain / tree:.2f}, ekf / tree {dense / tree:.2f}, ", end="")
        print(f"ekf / sequential {dense / chain:.2f}")
    for name in (*joiners, "batch"):
        print(f"     {name:<16} growth 50→100 {times[100, name] / times[50, name]:.2f}", end="")
        print(f", 100→200 {times[200, name] / times[100, name]:.2f}")
    if not options.quick:
        print("with association (landmarks recognised, 200 maps)")
        for rule in ("nearest", "joint"):
            for name, join in joiners.items():
                association = Association(rule=rule)  # type: ignore[arg-type]
                joined = join(maps, association=association)
                parts = ", ".join(f"{k} {v:.2f} s" for k, v in joined.times.items())
                print(f"     {rule:<8} {name:<16} {len(joined.landmark_ids)} landmarks, {parts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
