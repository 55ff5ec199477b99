"""SegSLAM, its RBPF and urban GraphSLAM with the default settings against the equations of the papers (presets
``paper``), on the same random worlds.

``python -m tests.benchmarks.bench_paper_preset [--worlds N] [--particles N] [--variants NAME ...]``: the small court,
with other clutter, robot errors and seed in each world. Printed: means over the worlds with 95 % intervals of Student's
t, and paired differences from the default. ``skeleton`` and ``skeleton-paper``: four laps of 2,400 poses with other
noise and seed in each world; objective: χ²; path: RMS position error. Others: path: RMS position error of a map sample
after alignment. NEES: of the ends of all segments, a degree of freedom; of ``rbpf`` and ``rbpf-paper``, of the end of
the path. CPU: of the filter.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from scipy.stats import t as student

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.config import preset
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.config import merge_options
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3, remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from graphslam.skeleton.collapse import Collapse
from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
from graphslam_frontends.segslam.front_end import SegSlam, submaps_of_best_particle
from graphslam_studies.sim.laps import LapsConfig, draw_laps

COURT = preset("court.segslam")["frontend"]
PAPER = preset("paper.segslam")["frontend"]
CAST = {k: PAPER["filter"][k] for k in ("likelihood", "weight_beams")}
ALPHA = PAPER["segslam"]["segmentation"]
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": PAPER,
    "cast": {"filter": CAST},
    "no-walk": {"filter": {"walk_scale": 0.0}},
    "motion-error": {"segslam": {"segmentation": {k: ALPHA[k] for k in ALPHA if "motion" in k}}},
    "per-particle": {"segslam": {"segmentation": {"decide": "particle"}}},
    "moments": {"segslam": {"handover": {"matched_only": True}}},
    "localisation": {"segslam": {"choice": {"method": "localisation"}}},
}
RBPF: dict[str, dict[str, Any]] = {
    "rbpf": {"steps": COURT["steps"], "filter": {**COURT["filter"], "walk_scale": 1.0}},
    "rbpf-paper": {"steps": COURT["steps"], **preset("paper.rbpf-grid")["frontend"]},
}


SKELETON = {"skeleton": RelaxConfig(), "skeleton-paper": RelaxConfig.paper()}


def trial_skeleton(seed: int, config: RelaxConfig) -> dict[str, float]:
    """Figures of a relaxation from dead reckoning."""
    wheel, scanner, gps = 2.0 ** SeedTree(seed).child("noise").generator().uniform(-1.0, 1.0, 3)
    noise: dict[str, Any] = {"odometry": (5e-4 * wheel, 0.01 * wheel), "gps_sigma": 0.5 * gps}
    noise |= {"range_sigma": 0.05 * scanner, "bearing_sigma": 5e-3 * scanner}
    world = draw_laps(LapsConfig(poses=2_400, laps=4, **noise), seed)
    collapse = Collapse(int(world.first[-1]))
    for a, b in world.correspondences():
        collapse.add(a, b)
    problem = world.problem(collapse.landmarks()[0])
    begin = time.process_time()
    found = relax_skeleton(problem, config)
    error = np.linalg.norm(found.poses.position - world.truth.position, axis=1)
    path = float(np.sqrt(np.mean(error**2)))
    return {"path": path, "objective": found.objective, "products": found.products, "cpu": time.process_time() - begin}


def trial_rbpf(log: SensorLog, seed: int, particles: int, options: dict[str, Any]) -> dict[str, float]:
    """Figures of the RBPF, which makes one submap of the whole log."""
    front = make_front_end("rbpf-grid", merge_options(options, {"filter": {"particles": particles}}))
    assert log.truth is not None
    begin = time.process_time()
    (submap,) = front.submaps(log, seed=SeedTree(seed))
    cpu = time.process_time() - begin
    assert submap.trajectory is not None
    path = ate(submap.trajectory, log.truth.trajectory, max_diff=0.02).translation
    return {
        "path [m]": float(np.sqrt(np.mean(path**2))),
        "NEES/dof": nees(submap, log.truth.trajectory) / 6,
        "CPU [s]": cpu,
    }


def nees(submap: Submap, truth: Trajectory) -> float:
    """NEES of the end of a submap, 6 degrees of freedom."""
    a, b = remove_roll_pitch(truth.interpolate(np.array(submap.interval)))
    e = SE3.log(SE3.between(submap.exit_pose, SE3.between(a, b)))
    return float(e @ np.linalg.solve(submap.exit_covariance, e))


def trial(log: SensorLog, seed: int, particles: int, options: dict[str, Any]) -> dict[str, float]:
    """Figures of one filter."""
    asked = merge_options(merge_options(COURT, {"filter": {"particles": particles}}), options)
    front = make_front_end("segslam", asked)
    assert isinstance(front, SegSlam)
    assert log.truth is not None
    begin = time.process_time()
    result = front.result(log, seed=SeedTree(seed))
    cpu = time.process_time() - begin
    truth = log.truth.trajectory
    ends = [nees(s, truth) / 6 for s in submaps_of_best_particle(result, front.config.drift, front.config.segslam)]
    report = result.report()
    return {
        "path [m]": float(np.sqrt(np.mean(ate(result.trajectory(), truth, max_diff=0.02).translation ** 2))),
        "NEES/dof": float(np.mean(ends)),
        "entries": report["matches"],
        "segments": report["intervals"],
        "CPU [s]": cpu,
    }


def interval(x: np.ndarray) -> str:
    """Mean with its 95 % interval."""
    half = float(student.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))) if len(x) > 1 else np.nan
    return f"{x.mean():.3g} [{x.mean() - half:.3g}, {x.mean() + half:.3g}]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--particles", type=int, default=20)
    parser.add_argument("--first", type=int, default=100, help="seed of the first world")
    parser.add_argument("--variants", nargs="*", default=[*VARIANTS, *RBPF, *SKELETON])
    parser.add_argument("--quick", action="store_true", help="two worlds, four particles, two variants")
    a = parser.parse_args()
    if a.quick:
        a.worlds, a.particles, a.variants = 2, 4, ["default", "paper", "skeleton", "skeleton-paper"]
    rows: dict[str, list[dict[str, float]]] = {v: [] for v in a.variants}
    with one_blas_thread():
        for seed in range(a.first, a.first + a.worlds):
            log = simulate_crawler(ring_hall(seed=seed), seed, CrawlerConfig(drift=0.02, max_range=8.0))
            for v in a.variants:
                if v in SKELETON:
                    rows[v].append(trial_skeleton(seed, SKELETON[v]))
                else:
                    run = trial_rbpf if v in RBPF else trial
                    rows[v].append(run(log, seed, a.particles, (VARIANTS | RBPF)[v]))
                print(f"seed {seed}, {v}:", {k: round(x, 4) for k, x in rows[v][-1].items()}, flush=True)
    for v in a.variants:
        print(v)
        for k in rows[v][0]:
            x = np.array([r[k] for r in rows[v]])
            base = v.removesuffix("-paper") if v in RBPF | SKELETON else a.variants[0]
            first = np.array([r.get(k, np.nan) for r in rows.get(base, rows[v])])
            print(f"    {k:9} {interval(x):32} difference from {base} {interval(x - first)}")


if __name__ == "__main__":
    main()
