"""TU Chemnitz lecture hall: loop candidates with wrong ones among them, by plain, Huber, GNC and consistent sets.

    GRAPHSLAM_DATA=... python tests/benchmarks/bench_tuc.py [--similarity 0.5] [--picture FILE.png] [--quick]

Position RMSE against the truth at the nodes, after the best rigid alignment, and what was made of the candidates: a
candidate is counted as right if the true positions of its two moments are within two metres.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from graphslam.association.consistent_set import consistent_loops
from graphslam.core.geometry import align_se2, se2_transform
from graphslam.core.network import PoseNetwork
from graphslam.io.catalog import load_recording
from graphslam.solve.network.solve import solve_network
from tests.reference.huber import huber_least_squares

RIGHT = 2.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--similarity", type=float, default=0.5)
    parser.add_argument("--most-pairs", type=int, default=1500, help="no consistent set of more candidates than this")
    parser.add_argument("--odometry-variance", type=float, default=100.0, help="factor for a second consistent set")
    parser.add_argument("--picture", default="")
    parser.add_argument("--quick", action="store_true", help="plain and Huber alone")
    args = parser.parse_args()
    if args.quick and not os.environ.get("GRAPHSLAM_DATA"):
        print("no recorded data here (GRAPHSLAM_DATA): nothing to do")
        return
    log = load_recording("tuc-slam-lecture-hall")
    network, times = log.to_network(min_similarity=args.similarity)
    truth = log.truth_at(times)
    n = len(network)
    odometry = np.arange(len(network.edges)) < n - 1
    ends = network.edges[~odometry]
    right = np.linalg.norm(truth[ends[:, 0]] - truth[ends[:, 1]], axis=1) < RIGHT
    print(f"{n} nodes, {len(ends)} candidates, {right.mean():.1%} of them right")
    paths: dict[str, np.ndarray] = {}

    def show(name: str, poses: np.ndarray, begin: float, kept: np.ndarray | None = None) -> None:
        aligned = se2_transform(align_se2(poses[:, :2], truth), poses[:, :2])
        paths[name] = aligned
        error = np.linalg.norm(aligned - truth, axis=1)
        decided = ""
        if kept is not None:
            decided = (
                f"  kept {kept.sum()}: right {right[kept].mean():.3f} of them, {kept[right].mean():.3f} of the right"
            )
        print(
            f"{name:28} RMSE {np.sqrt(np.mean(error**2)):7.3f} m  median {np.median(error):6.3f}  max "
            f"{error.max():7.3f}  CPU {time.process_time() - begin:6.1f} s{decided}",
            flush=True,
        )

    show("odometry", network.poses, time.process_time())
    begin = time.process_time()
    plain = solve_network(network, "lm", starts=("chordal",))
    show("plain", plain.poses, begin)
    begin = time.process_time()
    huber = huber_least_squares(network, plain.poses, odometry)
    show("Huber", huber.poses, begin)
    if args.quick:
        return
    begin = time.process_time()
    gnc = solve_network(network, "gnc")
    show("GNC", gnc.poses, begin, gnc.inliers[~odometry])
    print(f"  noise scale {gnc.details['noise_scale']:.3g}, starts {gnc.details['robust_starts']}")
    begin = time.process_time()
    stated = solve_network(network, "gnc", noise_scale=1.0, inlier_probability=0.99)
    show("GNC, noise as stated", stated.poses, begin, stated.inliers[~odometry])
    cov = np.linalg.inv(network.information)
    for factor in (1.0, args.odometry_variance) if len(ends) <= args.most_pairs else ():
        begin = time.process_time()
        found = consistent_loops(
            network.measurements[odometry],
            factor * cov[odometry],
            (ends, network.measurements[~odometry], cov[~odometry]),
        )
        kept = np.concatenate([np.ones(n - 1, bool), found.accepted])
        part = replace(
            network,
            edges=network.edges[kept],
            measurements=network.measurements[kept],
            information=network.information[kept],
        )
        name = "consistent set" if factor == 1.0 else f"consistent, odometry × {factor:g}"
        show(name, solve_network(part, "lm", starts=("chordal",)).poses, begin, found.accepted)
        print(f"  clique of {found.clique.sum()}, no larger than {found.bound}")
    if args.picture:
        draw(args.picture, truth, paths, network)


def draw(path: str, truth: np.ndarray, paths: dict[str, np.ndarray], network: PoseNetwork) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 4, figsize=(18, 9), sharex=True, sharey=True)
    for axis, (name, xy) in zip(axes.ravel(), paths.items()):
        axis.plot(*truth.T, color="0.7", linewidth=2, label="truth")
        axis.plot(*xy.T, linewidth=0.8, label=name)
        axis.set_aspect("equal")
        axis.set_title(name)
    for axis in axes.ravel()[len(paths) :]:
        axis.set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=70)


if __name__ == "__main__":
    main()
