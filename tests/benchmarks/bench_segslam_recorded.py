"""SegSLAM on recorded robots and lidars: relation errors beside those of odometry and of one filter, and the maps.

``python -m tests.benchmarks.bench_segslam_recorded [NAME …] [--quick] [--seeds 1] [--particles N] [--out DIR]``

Settings come from the presets of the front end ``segslam`` alone; RBPF SLAM gets the same steps, particles and seed.
``mended`` is the odometry as both get it, where presets have it fused with matches of neighbouring scans.
With ``--quick`` half a minute of two logs, cut before anything is done. References are outputs of other programs, not
surveyed. Of a log that ends where it began, the distance from the end of the path to its start is given too.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.run.front_ends import recommended_options
from graphslam.core.config import build_config
from graphslam.core.errors import MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.io.catalog import load_recording
from graphslam.plots.evidence import plot_heights, plot_section
from graphslam.plots.save import save_figure
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.front_end import SegSlamFrontEndConfig
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_studies.evaluate.relations import consecutive_pairs, covered_part, random_pairs, relation_error
from graphslam_studies.frontends.rbpf_grid import run_rbpf

NAMES = (
    "radish-intel", "radish-fr079", "radish-mit-csail", "lidar3d-hku1", "lidar3d-balm-hall", "lidar3d-hku-mb",
)  # fmt: skip
CLOSED = {"lidar3d-hku1"}
QUICK, QUICK_SECONDS = ("radish-intel", "lidar3d-hku1"), 30.0
"""Logs that end where they began."""
RANDOM_PAIRS = 5000


def settings(log: SensorLog, particles: int | None = None) -> SegSlamFrontEndConfig:
    """The preset of a log for the front end ``segslam``."""
    c: SegSlamFrontEndConfig = build_config(SegSlamFrontEndConfig, recommended_options(log, "segslam")["frontend"])
    return c if particles is None else dataclasses.replace(c, filter=dataclasses.replace(c.filter, particles=particles))


def relations(path: Trajectory, reference: Trajectory) -> dict[str, float]:
    """Relation errors of neighbours and of pairs at random, the same pairs for every path of one log."""
    part = covered_part(reference, path)
    out: dict[str, float] = {}
    for what, pairs in (
        ("consecutive", consecutive_pairs(len(part))),
        ("random", random_pairs(len(part), RANDOM_PAIRS, np.random.default_rng(0))),
    ):
        out |= {f"{what}_{k}": v for k, v in relation_error(path, part, pairs).as_row().items()}
    return out


def path_map(steps: Steps, path: Trajectory, voxel_size: float) -> EvidenceGrid:
    """All beams along a path in one grid: what the path makes of the recording."""
    grid = EvidenceGrid(voxel_size, dim=steps.dim)
    for k, pose in zip(np.searchsorted(steps.times, path.times).tolist(), path.poses):
        points, origins, returns = steps.scan(k)
        if len(points):
            grid.insert_scan(points, origins, pose=pose, returns=returns)
    return grid


@dataclass(frozen=True, slots=True)
class Row:
    """One path of one log."""

    log: str
    method: str
    seed: int
    figures: dict[str, float]
    seconds: float
    recorded: float

    def text(self) -> str:
        """A line of the table."""
        f = self.figures
        end = f"{f['end_to_start']:6.2f}" if "end_to_start" in f else "     –"
        return (
            f"{self.log:18s} {self.method:9s} {self.seed:4d} | {f['consecutive_translation_mean']:6.3f} "
            f"{f['consecutive_rotation_mean_deg']:6.2f} | {f['random_translation_mean']:7.2f} "
            f"{f['random_translation_median']:7.2f} {f['random_translation_p95']:7.2f} "
            f"{f['random_rotation_mean_deg']:7.2f} | {end} | {self.seconds:7.1f} "
            + (f"{self.recorded / self.seconds:6.1f}" if self.seconds else "     –")
        )


HEAD = (
    "log                method    seed | consecutive   | random pairs                    | end to |     CPU  times\n"
    "                                  |     m    deg |  mean m  median     p95     deg |  start |       s  real"
)


def figures_of(path: Trajectory, reference: Trajectory, closed: bool) -> dict[str, float]:
    """Relation errors, and where the path ends if that is where it began."""
    out = relations(path, reference)
    if closed:
        dim = path.dim
        out["end_to_start"] = float(np.linalg.norm(path.poses[-1, :dim] - path.poses[0, :dim]))
    return out


def run(name: str, seed: int, *, particles: int | None, quick: bool, out: Path | None) -> list[Row]:
    """All methods on one log; maps are drawn for the seed 0."""
    log = load_recording(name)
    if quick:  # before anything is prepared, or most of the time goes into what is cut off
        begins = float(log["reference"].times[0])
        log = log.slice(begins, begins + QUICK_SECONDS)
    config = settings(log, particles)
    steps = make_steps(log, config.steps)
    reference: Any = log["reference"]
    recorded = float(steps.times[-1] - steps.times[0])
    closed = name in CLOSED and not quick
    raw = make_steps(log, dataclasses.replace(config.steps, match_scans=False, yaw_per_metre=0.0))
    paths: dict[str, tuple[Trajectory, float]] = {"odometry": (chain_odometry(raw.odometry), 0.0)}
    if config.steps.match_scans:
        paths["mended"] = (chain_odometry(steps.odometry), 0.0)
    begin = time.process_time()
    rbpf = run_rbpf(steps, config.filter, SeedTree(seed))
    paths["rbpf-grid"] = (rbpf.trajectory(), time.process_time() - begin)
    begin = time.process_time()
    result = run_segslam(steps, config.filter, config.segslam, SeedTree(seed))
    paths["segslam"] = (result.trajectory(), time.process_time() - begin)
    rows = [
        Row(name, method, seed, figures_of(path, reference, closed), seconds, recorded)
        for method, (path, seconds) in paths.items()
    ]
    print("\n".join(r.text() for r in rows), flush=True)
    print(f"  {describe(result)}", flush=True)
    if out is not None and seed == 0:
        for method, (path, _) in reversed(paths.items()):
            grid = path_map(steps, path, config.filter.voxel_size)
            draw = plot_section if grid.dim == 2 else plot_heights
            print(f"  {save_figure(draw(grid, title=f'{name}, {method}'), out / f'{name}.{method}.png')}")
    return rows


def describe(result: SegSlamResult) -> str:
    """How the run segmented and matched."""
    r = result.report()
    matched = sum(a.matched > 0 for a in result.attempts)
    return (
        f"{r['steps']} steps, {r['path_length']:.0f} m, {r['particles']} particles; {r['intervals']} intervals, "
        f"{r['segments']} segments; {len(result.attempts)} attempts with candidates, {matched} with a match; "
        f"N_eff/N {r['effective_median']:.2f} (5 %: {r['effective_p05']:.2f}); maps {r['maps_megabytes']:.0f} MB"
    )


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """The table on the terminal, maps in a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=[])
    parser.add_argument("--quick", action="store_true", help="the first half minute of two logs")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--particles", type=int, default=None)
    parser.add_argument("--out", type=Path, default=None, help="folder for the maps")
    options = parser.parse_args(arguments)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    print(HEAD)
    rows: list[Row] = []
    for name in options.names or (QUICK if options.quick else NAMES):
        try:
            load_recording(name)
        except MissingDataError:
            print(f"{name} left out: no recording (set GRAPHSLAM_DATA)")
            continue
        for seed in range(options.seeds):
            rows += run(name, seed, particles=options.particles, quick=options.quick, out=options.out)
    return rows


if __name__ == "__main__":
    main()
