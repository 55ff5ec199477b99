"""Victoria Park: speed against the recording, cost per scan, and the GPS-free evidence for every noise figure.

    python tests/benchmarks/bench_victoria_park.py            speed (second run of two: compilation apart), one core
    python tests/benchmarks/bench_victoria_park.py --noise    evidence: χ²/dof and landmark splits against the noise
    python tests/benchmarks/bench_victoria_park.py --gps      honest use of GPS: what is withheld, and the laser χ²
    python tests/benchmarks/bench_victoria_park.py --paper    EKF, local maps in sequence, by tree, ours: map, time
                                                              (--seeds N; --figures DIR)
    python tests/benchmarks/bench_victoria_park.py --quick    the first 160 s only; alone: speed, and the paper's ways

The noise figures are chosen from the columns left of the bar alone. What stands right of it (published identities, GPS)
is printed to show what the choice is worth, and was not used for it.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.pipeline import load, run
from graphslam.app.run.run import Run
from graphslam.core.errors import MissingDataError
from graphslam.core.log import SensorLog

sys.path.insert(0, str(Path(__file__).parent))
from victoria_park_paper import paper


def speed(log: SensorLog) -> None:
    """Two runs; the second has everything compiled."""
    for label in ("first run (compiles what is not cached)", "second run"):
        r = run(log, progress=False)
        print(
            f"{label}: {r.metric('times_real_time'):.0f} x real time, total {r.metric('seconds_total'):.1f} s of "
            f"{log.duration:.0f} s; front end {r.metric('seconds_frontend'):.2f} s "
            f"({r.metric('frontend_ms_per_scan'):.2f} ms a scan, last quarter / first quarter "
            f"{r.metric('frontend_last_to_first_quarter'):.2f}), back end {r.metric('seconds_backend'):.2f} s"
        )


def noise(log: SensorLog, quick: bool) -> None:
    """One line per setting; GPS-free evidence left of the bar."""
    left = "setting                      | local χ²/dof  range bearing odometry | join χ²/dof  landmarks merged"
    print(f"{left} || recall  GPS rmse")
    for lateral in (0.01, 0.1) if quick else (0.003, 0.01, 0.03, 0.1, 0.3):
        line(f"lateral {lateral:g} m/m", run_with(log, frontend={"motion": {"lateral": lateral}}))
    for scale in (1.0, 5.5) if quick else (1.0, 3.0, 5.5, 8.0):
        line(f"covariance scale {scale:g}", run_with(log, backend={"covariance_scale": scale}))
    for factor in (0.7, 1.0) if quick else (0.5, 0.7, 1.0, 1.4):
        smoothing = {"range_sigma": 0.06 * factor, "range_slope": 0.001 * factor, "bearing_sigma": 0.0061 * factor}
        line(f"observation noise x {factor:g}", run_with(log, frontend={"smoothing_noise": smoothing}))


def run_with(log: SensorLog, **options: Any) -> Run:
    """The preset with some options changed."""
    return run(log, config=options, progress=False)


def line(label: str, r: Run) -> None:
    """Print one setting."""
    merged = sum(e["event"] == "merged" for e in r.events)
    gps = r.gps["all"].statistics.rmse if r.gps else float("nan")
    print(
        f"{label:28} | {r.metric('submap_chi2_per_dof'):12.3f} {r.metric('submap_chi2_range'):6.2f} "
        f"{r.metric('submap_chi2_bearing'):7.2f} {r.metric('submap_chi2_odometry'):8.3f} | "
        f"{r.metric('join_chi2_per_dof'):11.3f}  {merged:16d} || {r.metric('association_pair_recall'):6.4f}  {gps:8.3f}"
    )


def gps(log: SensorLog) -> None:
    """The laser χ² may rise by what honest fixes cost, a percent; more means that GPS bends the map."""
    base = run_with(log).metric("join_chi2")
    print(
        "fixes used     σ [m]  kernel  | withheld rmse  median  | laser χ² against none | NIS/2 of the withheld: ",
        end="",
    )
    print("each (autocorrelation, bounds), joint")
    for use, sigma, kernel in (
        ("every-second", 1.0, "cauchy"),
        ("every-second", 0.5, "cauchy"),
        ("even-segments", 1.0, "cauchy"),
        ("odd-segments", 1.0, "cauchy"),
        ("every-second", 0.05, "none"),
    ):
        r = run_with(log, gps={"use": use, "sigma": sigma, "robust": kernel})
        rmse, median = r.metric("gps_withheld_rmse"), r.metric("gps_withheld_median")
        rise = r.metric("join_chi2") / base - 1
        each, low, high = (r.metric(f"gps_nis_each_{k}") for k in ("value", "low", "high"))
        nis = f"{each:.2f} ({r.metric('gps_nis_each_autocorrelation'):.2f}, {low:.2f} … {high:.2f}), "
        print(
            f"{use:14} {sigma:5.2f}  {kernel:7} | {rmse:13.3f}  {median:6.3f}  | {rise:+21.2%} | "
            f"{nis}{r.metric('gps_nis_joint_value'):.2f}"
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--gps", action="store_true")
    parser.add_argument("--paper", action="store_true")
    parser.add_argument("--seeds", type=int, default=5, help="runs of the particle filter in --paper")
    parser.add_argument("--figures", type=Path, help="folder for the figures of --paper")
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    try:
        log = load("victoria-park")
    except MissingDataError as error:
        sys.exit(f"cannot run: {error}" if os.environ.get("CI") else print(f"not run: {error}"))
    if args.quick:
        start = log.interval[0]
        log = log.slice(start, start + 160.0)
    if args.noise:
        noise(log, args.quick)
    elif args.gps:
        gps(log)
    if not (args.noise or args.gps or args.paper):
        speed(log)
    if args.paper or (args.quick and not (args.noise or args.gps)):
        with one_blas_thread():
            paper(log, seeds=1 if args.quick else args.seeds, figures=args.figures)


if __name__ == "__main__":
    main()
