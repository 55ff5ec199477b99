"""Peak memory and CPU seconds of a whole run, stage by stage.

    python -m tests.benchmarks.bench_memory [--quick] [--length 2400] [--source LOG] [--frontend NAME] [--limit 1.5]

Without a source: a lidar of 16 lines is driven through the streets of a simulated campus at 3 m/s, five scans a second,
and what a user would have is written to a folder, ``velodyne/*.bin`` and ``times.txt``. This process then runs a front
end over it with everything a run does: loops, refinement, fused map, files and pictures. Of each stage: memory before
and after, its peak [MB], CPU seconds; last what the shelf of submaps and pieces wrote to disk. Stages may lie in each
other. Memory is what the kernel counts as resident (Linux only), the interpreter and its packages with 0.3 GB in it.

``--no-refine`` leaves the refinement out, ``--looks`` looks for loops whatever the map says. ``--quick``: 60 m.
Exit code 1 if the peak is above ``--limit`` [GB].
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import graphslam as gs
from graphslam.app.run import outputs, pipeline, submap_slam
from graphslam.backend import refining
from graphslam.backend.back_end import BackEnd
from graphslam.core.spill_cache import SPILL_CACHE
from graphslam.maps import run_map
from graphslam_studies.sim.campus_config import campus_preset
from graphslam_studies.sim.campus_world import campus
from graphslam_studies.sim.lidar import LidarConfig, simulate_lidar

STAGES: list[tuple[Any, str, str]] = [
    (pipeline, "load", "log opened"),
    (submap_slam.SubmapSlam, "step", "front end, back end"),
    (submap_slam.SubmapSlam, "release_memory", "scans for the refinement"),
    (BackEnd, "finish", "loops, solved"),
    (refining, "refine_by_scans", "refinement"),
    (refining, "refined_submaps", "submaps drawn anew"),
    (run_map, "static_submaps", "things that moved"),
    (run_map, "divide_submaps", "pieces"),
    (run_map, "fuse_pieces", "fused, open chain"),
    (run_map.FusedMap, "move", "moved"),
    (run_map, "fused_points", "points"),
    (run_map, "find_contradictions", "passes compared"),
    (outputs, "write_run_map", "map files"),
    (outputs, "draw_run_map", "map pictures"),
    (pipeline, "write_outputs", "all files"),
]
"""Where a stage is called from, its name there, and what it is called here."""
SPEED, RATE = 3.0, 5.0
"""Of the drive [m/s], of the lidar [Hz]."""


def resident() -> tuple[float, float]:
    """Memory now, and its peak since the last :func:`begin` [MB]."""
    rows = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    now, peak = (int(rows[k].split()[0]) * 1024 / 1e6 for k in ("VmRSS", "VmHWM"))
    return now, peak


def begin() -> None:
    """Forget the peak so far."""
    Path("/proc/self/clear_refs").write_text("5")


class Peaks:
    """Watches the stages of a run."""

    def __init__(self) -> None:
        self.peak = 0.0

    def watched(self, stage: Callable[..., Any], name: str) -> Callable[..., Any]:
        """The same function, with a line for each call."""

        @functools.wraps(stage)
        def call(*a: Any, **k: Any) -> Any:
            before, peak = resident()
            self.peak = max(self.peak, peak)
            begin()
            start = time.process_time()
            try:
                return stage(*a, **k)
            finally:
                after, peak = resident()
                self.peak = max(self.peak, peak)
                spent = time.process_time() - start
                print(f"{name:26s} {before:8.0f} {after:8.0f} {peak:8.0f} {spent:9.1f}", flush=True)

        return call


def drive(folder: Path, length: float, seed: int) -> None:
    """Write a drive through the campus as a folder of scans."""
    world = replace(campus(campus_preset("full"), seed=seed), speed=SPEED)
    lidar = LidarConfig(rate=RATE, sweep=1e-3, lines=16, elevation=(-15.0, 15.0), points=6000, height=1.5)
    log = simulate_lidar(world, seed, lidar, most=1.02 * length / SPEED)
    clouds = log["clouds"]
    (folder / "velodyne").mkdir(parents=True)
    for k in range(len(clouds)):
        rows = np.column_stack([clouds.cloud(k), np.ones(len(clouds.cloud(k)))])
        rows.astype(np.float32).tofile(folder / "velodyne" / f"{k:06d}.bin")
    np.savetxt(folder / "times.txt", clouds.times, fmt="%.6f")
    driven = np.linalg.norm(np.diff(log.truth.trajectory.positions, axis=0), axis=1).sum()
    print(f"{len(clouds)} scans along {driven:.0f} m")


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--quick", action="store_true")
    p.add_argument("--length", type=float, default=2400.0)
    p.add_argument("--source")
    p.add_argument("--frontend", default="lidar-odometry")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--limit", type=float, default=1.5)
    p.add_argument("--no-refine", action="store_true")
    p.add_argument("--looks", action="store_true")
    a = p.parse_args()
    config: dict[str, Any] = {"refine": {"use": not a.no_refine}} | ({"backend": {"loops": True}} if a.looks else {})
    with tempfile.TemporaryDirectory() as folder:
        source = a.source
        if source is None:
            source = Path(folder) / "drive"
            drive(source, 60.0 if a.quick else a.length, a.seed)
        peaks = Peaks()
        print(f"{'':26s} {'before':>8s} {'after':>8s} {'peak MB':>8s} {'CPU s':>9s}")
        for place, name, stage in STAGES:
            setattr(place, name, peaks.watched(getattr(place, name), stage))
        begin()
        start = time.process_time()
        run = gs.run(source, frontend=a.frontend, out=Path(folder) / "run", config=config, progress=False)
        spent, peak = time.process_time() - start, max(peaks.peak, resident()[1])
        length = run.map.trajectory.length()
        facts = f"{len(run.submaps)} submaps, {length:.0f} m: peak {peak / 1e3:.2f} GB, {spent:.0f} CPU s"
        print(f"{facts}; {SPILL_CACHE.filed / 1e6:.0f} MB on disk")
        print(run.headline.text)
    raise SystemExit(peak > 1e3 * a.limit)


if __name__ == "__main__":
    main()
