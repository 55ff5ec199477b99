"""CPU seconds of SegSLAM and RBPF SLAM in the simulated building of the study ``segslam-building``.

``python -m tests.benchmarks.bench_building_time [segslam-40 rbpf-200] [--seed 2]``

One run each, one thread, after a run in the small court that compiles everything. The paper reports 693 s for
SegSLAM with 40 particles and just under three hours for an RBPF with 200.
"""

from __future__ import annotations

import argparse

from graphslam.app.machine import one_blas_thread
from graphslam_studies.segslam_building import QUICK_WORLDS, WORLDS
from graphslam_studies.segslam_trial import GridTrial


def main() -> None:
    """Print one line per algorithm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithms", nargs="*", default=["segslam-40", "rbpf-200"], help="segslam-N or rbpf-N")
    parser.add_argument("--seed", type=int, default=2)
    args = parser.parse_args()
    with one_blas_thread():
        court = GridTrial(QUICK_WORLDS["court-quick"], args.seed)
        for name in args.algorithms:
            court.outcome(f"{name.partition('-')[0]}-5")
        trial = GridTrial(WORLDS["building"], args.seed)
        seconds = float(trial.steps.times[-1] - trial.steps.times[0])
        print(f"building, seed {args.seed}: {len(trial.steps)} steps, {seconds:.0f} s recorded", flush=True)
        for name in args.algorithms:
            cpu = trial.outcome(name).seconds["cpu"]
            print(f"{name:12} {cpu:7.1f} CPU s, {seconds / cpu:.1f} times real time", flush=True)


if __name__ == "__main__":
    main()
