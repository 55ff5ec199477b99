"""Every recorded pose network by every solver, against the best-known objectives.

    GRAPHSLAM_DATA=... python tests/benchmarks/bench_posegraphs.py [--quick] [--solvers lm,isam2] [--files word]

Exit code 1 if a file is not at its best-known objective to 1e-6 (GNC minimises something else and is only shown).
CPU seconds are of this process; wall seconds depend on who else uses the machine.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from graphslam.app.solve_file import solve_file
from graphslam.core.errors import GraphSlamError
from tests.reference.best_known import BEST_KNOWN, SMALL


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small files, lm and isam2 only")
    parser.add_argument("--solvers", default="", help="comma-separated (default: lm,isam2,pcg,gnc)")
    parser.add_argument("--files", default="", help="only files whose name contains this")
    args = parser.parse_args()
    root = os.environ.get("GRAPHSLAM_DATA")
    if not root:
        parser.error("set GRAPHSLAM_DATA to the folder of recorded data")
    solvers = (args.solvers or ("lm,isam2" if args.quick else "lm,isam2,pcg,gnc")).split(",")
    print(
        f"{'file':32} {'solver':6} {'initial':>12} {'objective':>14} {'/best - 1':>10} {'gap':>9} {'gap iSAM2':>10} "
        f"{'it':>4} {'CPU s':>7} {'wall s':>7} {'start':11} others"
    )
    failed = 0
    for name, best in BEST_KNOWN.items():
        if args.files not in name or (args.quick and name not in SMALL):
            continue
        for solver in solvers:
            cpu = time.process_time()
            try:
                r = solve_file(Path(root) / name, solver)
            except GraphSlamError as error:
                print(f"{Path(name).name:32} {solver:6} {error}")
                failed += 1
                continue
            cpu = time.process_time() - cpu
            off = r["objective"] / best - 1.0
            bad = solver != "gnc" and (abs(off) > 1e-6 or not r["converged"])
            failed += bad
            others = ", ".join(f"{s['name']} {s['objective'] or float('nan'):.6g} ({s['status']})" for s in r["starts"])
            gap = float("nan") if r["gap"] is None else r["gap"]
            print(
                f"{Path(name).name:32} {solver:6} {r['objective_initial']:12.6g} {r['objective']:14.9g} {off:10.1e} "
                f"{gap:9.2g} {r.get('gap_incremental', float('nan')):10.3g} {r['iterations']:4d} {cpu:7.2f} "
                f"{r['seconds']:7.2f} {r['start']:11} {others}"
                + (f"; {r['outliers']} outliers" if solver == "gnc" else "")
                + ("  <-- NOT at the best known" if bad else ""),
                flush=True,
            )
    print("all at the best known objective" if not failed else f"{failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
