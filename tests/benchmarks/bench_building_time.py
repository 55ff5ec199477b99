"""CPU seconds of SegSLAM and RBPF SLAM in the simulated building of the study ``segslam-building``.

``python -m tests.benchmarks.bench_building_time [segslam-40 rbpf-200] [--seed 2] [--quick]``

One run each, one thread, after a run in the small court that compiles everything. The paper reports 693 s for
SegSLAM with 40 particles and just under three hours for an RBPF with 200. In quick mode five particles map the small
court.
"""

from __future__ import annotations

import argparse

from graphslam.app.machine import one_blas_thread
from graphslam_studies.segslam_building import QUICK_WORLDS, WORLDS
from graphslam_studies.segslam_trial import GridTrial


def main() -> None:
    """Print one line per algorithm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithms", nargs="*", help="segslam-N or rbpf-N; default: segslam-40 rbpf-200")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="small court, five particles")
    args = parser.parse_args()
    algorithms = args.algorithms or (["segslam-5", "rbpf-5"] if args.quick else ["segslam-40", "rbpf-200"])
    small = QUICK_WORLDS["court-quick"]
    name, world = ("court-quick", small) if args.quick else ("building", WORLDS["building"])
    with one_blas_thread():
        court = GridTrial(small, args.seed)
        for algorithm in algorithms:
            court.outcome(f"{algorithm.partition('-')[0]}-5")
        trial = GridTrial(world, args.seed)
        seconds = float(trial.steps.times[-1] - trial.steps.times[0])
        print(f"{name}, seed {args.seed}: {len(trial.steps)} steps, {seconds:.0f} s recorded", flush=True)
        for algorithm in algorithms:
            cpu = trial.outcome(algorithm).seconds["cpu"]
            print(f"{algorithm:12} {cpu:7.1f} CPU s, {seconds / cpu:.1f} times real time", flush=True)


if __name__ == "__main__":
    main()
