"""MRCLAM 7: five robots alone and in one map, against Vicon; and the truth-free evidence for every noise figure.

    python tests/benchmarks/bench_mrclam.py              known and unknown association, and the merged map
    python tests/benchmarks/bench_mrclam.py --noise      evidence: χ²/dof inside maps and of the join, by setting
    python tests/benchmarks/bench_mrclam.py --quick      robot 2 only, known association
    python tests/benchmarks/bench_mrclam.py --out DIR    keep the run folders and pictures

Errors are root mean squares after a rigid alignment (no scale): landmarks by themselves, the path at every scan by
itself. NEES/n and CI are up to a rigid motion, too: the Vicon heading of one base is not trusted for a whole map. In
the evidence tables, what stands right of the bar was not used to choose anything.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from graphslam.app.run.pipeline import load, run
from graphslam.app.run.run import Run
from graphslam.app.sessions.merge import merge
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.geometry import se2_between, se2_inverse, se2_transform
from graphslam.core.log import Truth
from graphslam.evaluate.trajectory_error import ate
from graphslam.plots.map import plot_map
from graphslam.plots.save import save_figure

UNKNOWN: Mapping[str, Any] = {
    "frontend": {
        "association": "likelihood",
        "particles": 40,
        "confirm_hits": 3,
        "drop_misses": 30,
        "drop_scans": 300,
        "outlier_gate": 0.0,
    },
    "backend": {"associate": True, "merge_every": 20},
}
HEADER = (
    "robot assoc.   | join χ²/dof  split maps landmarks | landmark  path   max [m] | NEES/n pose  lm    all  |"
    "  CI pose    lm | precision recall |    s"
)


def figure(r: Run, key: str) -> float:
    """A metric, nan where the run has none."""
    try:
        return r.metric(key)
    except KeyError:
        return float("nan")


def line(robot: str, association: str, r: Run, seconds: float) -> None:
    """One run."""
    split = sum(e["event"] == "split" for e in r.events)
    print(
        f"{robot:5} {association:8} | {r.metric('join_chi2_per_dof'):11.2f} {split:6d} {len(r.submaps):4d} "
        f"{len(r.map.landmarks):9d} | {figure(r, 'landmark_rmse_aligned'):8.3f} {r.metric('path_rmse_aligned'):6.3f} "
        f"{r.metric('path_max_aligned'):6.2f}     | {figure(r, 'nees_aligned_poses_per_dof'):10.2f} "
        f"{figure(r, 'nees_aligned_landmarks_per_dof'):5.2f} {figure(r, 'nees_aligned_per_dof'):5.2f} | "
        f"{figure(r, 'ci_aligned_poses'):8.2f} {figure(r, 'ci_aligned_landmarks'):5.2f} | "
        f"{figure(r, 'association_pair_precision'):9.3f} {figure(r, 'association_pair_recall'):6.3f} | {seconds:4.0f}",
        flush=True,
    )


def robots(which: Sequence[int], options: Mapping[str, Any], association: str, out: Path | None) -> list[Run]:
    """A run and a line a robot."""
    runs = []
    for k in which:
        start = time.perf_counter()
        folder = None if out is None else out / f"robot{k}-{association}"
        r = run(f"mrclam-dataset7/robot{k}", config=options, out=folder, progress=False)
        line(str(k), association, r, time.perf_counter() - start)
        if out is not None:
            picture(r, out / f"robot{k}-{association}.png")
        runs.append(r)
    return runs


def picture(r: Run, path: Path) -> None:
    """The map with the truth moved onto it by its path."""
    assert r.truth is not None
    assert r.truth_path is not None
    fit = ate(r.map.trajectory, r.truth_path, alignment="se")
    T = se2_inverse(fit.T_ref_est)
    truth = Truth(r.truth_path.transformed(T), r.truth.landmark_ids, se2_transform(T, r.truth.landmarks))
    title = f"{r.name}: path RMSE {fit.statistics.rmse:.3f} m; truth aligned"
    ax = plot_map(trajectory=r.map.trajectory, landmarks=r.map.landmarks, truth=truth)
    ax.set_title(title)
    save_figure(ax, path)


def together(runs: Sequence[Run], by: Any, out: Path | None) -> None:
    """All runs in one map."""
    try:
        m = merge(runs, by=by, tolerance=0.5 if by == "identity" else 0.25, out=None if out is None else out / by)
    except DataError as error:
        print(f"merged by {by}: refused, {error}")
        return
    shared = int(np.sum(m.landmark_sessions > 1))
    print(
        f"merged by {by}: {len(m.sessions)} robots, {int(m.metric('submaps'))} maps, {shared} shared landmarks, "
        f"join χ²/dof {m.metric('join_chi2_per_dof'):.2f}, {m.report['observations_split']} detections split off, "
        f"{m.report['seconds']:.1f} s"
    )
    if by == "identity":
        alone = [r.metric("landmark_rmse_aligned") for r in runs]
        paths = [m.metric(f"{s.name}_path_rmse") for s in m.sessions]
        print(
            f"  landmarks {m.metric('landmark_rmse_aligned'):.3f} m, alone {min(alone):.3f} … {max(alone):.3f} m "
            f"(root mean square {np.sqrt(np.mean(np.square(alone))):.3f}); paths in that one alignment "
            + ", ".join(f"{p:.3f}" for p in paths)
            + f" m; landmarks' NEES/n {m.metric('nees_aligned_landmarks_per_dof'):.2f}, "
            f"CI {m.metric('ci_aligned_landmarks'):.2f}"
        )
        true = [
            r.log.truth.trajectory.interpolate([r.submaps[0].interval[0]])[0] for r in runs if r.log and r.log.truth
        ]
        for s, base in list(zip(m.sessions, true))[1:]:
            error = se2_between(s.map.node_poses[0], se2_between(true[0], base))
            d2 = float(error @ np.linalg.solve(s.map.node_covariances[0], error))
            print(f"  first base of {s.name}: NEES {d2:.2f} of 3")


def noise(which: Sequence[int]) -> None:
    """Settings by what they do inside the maps and to the join."""
    print("robot setting                | inside: χ²/dof  range bearing odometry | join χ²/dof || landmark   path [m]")
    plain: dict[str, Any] = {"backend": {"identity_gate": 0.0}}
    settings: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
        ("preset, nothing split", {}, {}),
        ("delay 0 s", {"control_delay": 0.0}, {}),
        ("delay 0.1 s", {"control_delay": 0.1}, {}),
        ("delay 0.3 s", {"control_delay": 0.3}, {}),
        ("range sigma 0.15 m", {}, sensor(0.15, 0.015)),
        ("range sigma 0.3 m", {}, sensor(0.3, 0.015)),
        ("range sigma 0.6 m", {}, sensor(0.6, 0.015)),
        ("bearing sigma 0.03", {}, sensor(0.45, 0.03)),
        ("walks / 2", {}, {"frontend": {"motion": {"speed_walk": 0.01, "yaw_walk": 0.03}}}),
        ("walks x 2", {}, {"frontend": {"motion": {"speed_walk": 0.04, "yaw_walk": 0.12}}}),
        ("split at 40", {}, {"backend": {"identity_gate": 40.0}}),
    ]
    for k in which:
        for label, reader, options in settings:
            log = load(f"mrclam-dataset7/robot{k}", **reader)
            merged = {part: {**plain.get(part, {}), **options.get(part, {})} for part in ("frontend", "backend")}
            r = run(log, config=merged, progress=False)
            print(
                f"{k:5} {label:22} | {r.metric('submap_chi2_per_dof'):14.3f} {r.metric('submap_chi2_range'):6.3f} "
                f"{r.metric('submap_chi2_bearing'):7.3f} {r.metric('submap_chi2_odometry'):8.3f} | "
                f"{r.metric('join_chi2_per_dof'):11.2f} || {figure(r, 'landmark_rmse_aligned'):8.3f} "
                f"{r.metric('path_rmse_aligned'):10.3f}",
                flush=True,
            )


def sensor(range_sigma: float, bearing_sigma: float) -> dict[str, Any]:
    """Both noise tables of the front end."""
    n = {"range_sigma": range_sigma, "bearing_sigma": bearing_sigma}
    return {"frontend": {"noise": n, "smoothing_noise": n}}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    try:
        load("mrclam-dataset7/robot2")
    except MissingDataError as error:
        sys.exit(f"cannot run: {error}" if os.environ.get("CI") else print(f"not run: {error}"))
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
    which = [2] if args.quick else [1, 2, 3, 4, 5]
    if args.noise:
        noise(which)
        return
    print(HEADER)
    known = robots(which, {}, "known", args.out)
    if not args.quick:
        unknown = robots(which, UNKNOWN, "unknown", args.out)
        together(known, "identity", args.out)
        together(known, "constellation", None)
        together(unknown, "constellation", args.out)


if __name__ == "__main__":
    main()
