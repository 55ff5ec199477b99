"""Scan-to-window odometry in simulated garages: how far off, how honest, how fast; and SegSLAM with it inside.

``python -m tests.benchmarks.bench_scan_window [--seeds 10] [--first 9801] [--layouts B,D] [--runs 0] [--quick]``

First table: the path of ``scan-window`` alone, without any loop, over logs drawn anew. ``--runs N``: N of them through
the whole of a run (graph and loops, no refinement) with ``segslam`` as in the paper, with ``segslam`` following scans
inside its segments, and with ``scan-window``. CPU time on one thread. Errors of position after rigid alignment in 3-D.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import graphslam as gs
from graphslam.app.run.front_ends import recommended_options
from graphslam.core.config import build_config
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, heading_of
from graphslam.core.se3 import align_se3, se3_transform
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.front_end import ScanWindowFrontEndConfig
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_frontends.scan_window.tracker import track_steps

LENGTH = 30.0
"""Way of the pieces whose exits are judged [m]."""
INSIDE = {"frontend": {"segslam": {"inside": "scan-window"}}}


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def aligned_error(poses: Array, truth: Array) -> tuple[float, float]:
    """RMS of position [m] after rigid alignment, and of heading [rad] without its mean."""
    T, _ = align_se3(poses[:, :3], truth[:, :3])
    turn = np.unwrap(heading_of(poses) - heading_of(truth))
    e = np.linalg.norm(se3_transform(T, poses[:, :3]) - truth[:, :3], axis=1)
    return rms(e), rms(turn - turn.mean())


def odometry(steps: Steps, config: ScanWindowFrontEndConfig) -> list[float]:
    """Errors [m], [rad]; of exits of pieces NEES per degree of freedom, [rad], [m]; CPU a step [s]; scans lost."""
    assert steps.truth is not None
    truth = steps.truth.interpolate(steps.times)
    piece = np.floor(steps.path_length / LENGTH)
    starts = [0, *(np.flatnonzero(np.diff(piece) > 0) + 1).tolist()]
    begin = time.process_time()
    made = track_steps(steps, config.window, starts)
    cpu = (time.process_time() - begin) / len(steps)
    g, errors, nees = group_of(truth), [], []
    for a, b in zip(starts, [*starts[1:], len(steps) - 1]):
        if a == b:
            continue
        pair = made.poses[a], made.poses[b]
        e = g.log(g.between(g.between(*pair), g.between(truth[a], truth[b])))
        errors.append(e)
        nees.append(e @ np.linalg.solve(relative_covariance(pair, pair, made.joints[b]), e) / g.dof)
    e = np.array(errors)
    lost = sum(bool(f.lost) and f.lost != "start" for f in made.found)
    return [*aligned_error(made.poses, truth), float(np.mean(nees)), rms(e[:, 2]), rms(e[:, 3:5]), cpu, float(lost)]


def run(log: gs.SensorLog, frontend: str, options: dict[str, object], seed: int) -> list[float]:
    """Aligned error [m], heading RMS [°], NEES per degree of freedom of the nodes, CPU [s]."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        config = {**options, "refine": {"use": False}}
        made = gs.run(log, frontend=frontend, seed=seed, out=Path(folder) / "run", config=config, progress=False)
        cpu = time.process_time() - begin
        found = dict(zip(made.metrics["key"], made.metrics["value"]))
    return [float(found[key]) for key in ("path_rmse_aligned", "heading_rmse", "nees_per_dof")] + [cpu]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=9801)
    parser.add_argument("--layouts", default="B,D")
    parser.add_argument("--runs", type=int, default=0, help="seeds that go through graph and loops, too")
    parser.add_argument("--quick", action="store_true", help="one seed in one layout")
    args = parser.parse_args()
    layouts, seeds = args.layouts.split(","), range(args.first, args.first + args.seeds)
    if args.quick:
        layouts, seeds = layouts[:1], seeds[:1]
    for layout in layouts:
        rows: list[list[float]] = []
        runs: dict[str, list[list[float]]] = {}
        for seed in seeds:
            log = gs.simulate("garage", seed=seed, layout=layout)
            options = recommended_options(log, "scan-window").get("frontend", {})
            config: ScanWindowFrontEndConfig = build_config(ScanWindowFrontEndConfig, options, "frontend")
            rows.append(odometry(make_steps(log, config.steps), config))
            print(f"  {layout} {seed}: {rows[-1][0]:.3f} m, {1e3 * rows[-1][1]:.1f} mrad", flush=True)
            if seed - args.first < args.runs:
                for name, frontend, more in (
                    ("segslam", "segslam", {}), ("segslam, scan-window inside", "segslam", INSIDE),
                    ("scan-window", "scan-window", {}),
                ):  # fmt: skip
                    runs.setdefault(name, []).append(run(log, frontend, more, seed))
        m, worst = np.mean(rows, axis=0), np.max(rows, axis=0)
        print(
            f"garage {layout}, {len(rows)} logs, no loops: aligned {m[0]:.3f} m (worst {worst[0]:.3f}), heading "
            f"{1e3 * m[1]:.1f} mrad; exits of {LENGTH:.0f} m: NEES/dof {m[2]:.2f}, {1e3 * m[3]:.1f} mrad, "
            f"{1e3 * m[4]:.0f} mm; {1e3 * m[5]:.1f} ms a step (worst {1e3 * worst[5]:.1f}); {m[6]:.1f} scans lost"
        )
        for name, values in runs.items():
            m, worst = np.mean(values, axis=0), np.max(values, axis=0)
            print(
                f"garage {layout}, {len(values)} runs with graph and loops, {name}: aligned {m[0]:.3f} m (worst "
                f"{worst[0]:.3f}), heading {m[1]:.2f}°, NEES/dof {m[2]:.2f}, CPU {m[3]:.0f} s"
            )


if __name__ == "__main__":
    main()
