"""Is the map honest? Monte Carlo over simulated logs: front end → submaps → every joiner, scored against the truth.

Prints, per world: honesty of the submaps, NEES/n of the polished map with its two-sided bounds over the runs, NEES/n of
every method before polishing, and how far the polished maps of all methods lie apart.

    python tests/benchmarks/bench_consistency.py --worlds A C --trials 12
    python tests/benchmarks/bench_consistency.py --quick
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm import tqdm

from graphslam.app.compare import compare_methods
from graphslam.app.run.pipeline import run
from graphslam.app.submap_sources import submap_source
from graphslam.app.worlds import simulate
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam_studies.evaluate.submap_consistency import submap_nees


def trial(world: str, seed: int) -> tuple[pd.DataFrame, dict[str, float]]:
    """One simulated log through the whole pipeline and all joiners."""
    log = simulate("landmark-field", seed=seed, preset=world, layout_seed=1)
    result = run(log, seed=seed, progress=False)
    source = submap_source(result)
    table = compare_methods(source.submaps, truth=source.truth, memory=False)
    local = [submap_nees(s, log.truth) for s in result.submaps]
    spread = table["objective_polished"]
    facts = {
        "submaps": len(local),
        "local_joint": sum(r.joint for r in local),
        "local_dof": sum(r.joint_dof for r in local),
        "local_exit": sum(r.exit for r in local),
        "objective": float(spread.iloc[0]),
        "objective_spread": float((spread.max() - spread.min()) / spread.min()),
        "join_dof": result.metric("join_dof"),
    }
    return table.assign(run=seed), facts


def report(world: str, trials: int) -> dict[str, object]:
    """Run the trials of one world and print the table."""
    tables, facts = zip(*(trial(world, s) for s in tqdm(range(trials), desc=world, leave=False)))
    t, f = pd.concat(tables), pd.DataFrame(facts)
    dof = t["nees_dof"].groupby(t["run"]).first().to_numpy()
    low, high = chi2_mean_bounds(float(dof.sum()), 1)  # sum of all runs is one chi-square
    low, high = low / dof.sum(), high / dof.sum()
    polished = t[t["method"] == "batch"]
    nees = float(polished["nees"].sum() / dof.sum())
    lj, hj = (b / f["local_dof"].sum() for b in chi2_mean_bounds(float(f["local_dof"].sum()), 1))
    n_exit = 3 * f["submaps"].sum()
    le, he = (b / n_exit for b in chi2_mean_bounds(float(n_exit), 1))
    print(f"\nworld {world}, {trials} runs, gauge: first base fixed, 95 % two-sided bounds")
    joint, exits = f["local_joint"].sum() / f["local_dof"].sum(), f["local_exit"].sum() / n_exit
    print(f"  {f['submaps'].sum():.0f} submaps: joint NEES/n {joint:.3f} [{lj:.3f}, {hj:.3f}],")
    print(f"  exit NEES/3 {exits:.3f} [{le:.3f}, {he:.3f}]")
    print(f"  join χ²/dof at the optimum {f['objective'].sum() / f['join_dof'].sum():.3f}")
    verdict = "inside" if low <= nees <= high else f"OUTSIDE by {max(low - nees, nees - high):.3f}"
    print(f"  polished map: NEES/n {nees:.3f} [{low:.3f}, {high:.3f}] {verdict}; n = {dof.mean():.0f} a run")
    per_run = (polished["nees"] / polished["nees_dof"]).to_numpy()
    print(f"  per run: median {np.median(per_run):.3f}, least {per_run.min():.3f}, greatest {per_run.max():.3f}")
    for method, rows in t.groupby("method", sort=False):
        own = rows["nees_unpolished"].fillna(rows["nees"])
        mean, median = own.sum() / rows["nees_dof"].sum(), np.median(own / rows["nees_dof"])
        rmse = rows["rmse_landmarks"].mean()
        print(f"    {method:15} before polish NEES/n mean {mean:8.3f} median {median:8.3f}, landmark RMSE {rmse:.2f} m")
    print(f"  polished objectives of all methods agree to {f['objective_spread'].max():.2g} (relative)")
    return {"world": world, "trials": trials, "nees_per_dof": nees, "bounds": [low, high],
            "objective_spread": float(f["objective_spread"].max())}  # fmt: skip


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=["demo", "A", "C"])
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--quick", action="store_true", help="a small world and four runs")
    parser.add_argument("--json", type=Path, help="write the figures here")
    args = parser.parse_args()
    worlds, trials = (["quick"], 4) if args.quick else (args.worlds, args.trials)
    figures = [report(w, trials) for w in worlds]
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))
    if max(float(f["objective_spread"]) for f in figures) > 1e-6:
        sys.exit("the methods do not reach the same optimum")


if __name__ == "__main__":
    main()
