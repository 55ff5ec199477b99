"""Recorded planar logs of strangers: error, verdict, CPU time and memory of default runs, seed by seed.

``python -m tests.benchmarks.bench_planar [NAME …] [--seeds 5] [--first 0] [--set KEY=VALUE] [--quick]``

Each run is a process of its own over the file as it was published: no preset of a data set, no option. Errors are
against the corrected path of the same scans (another SLAM's output, not surveyed): relations of neighbouring scans and
of 5,000 pairs at random [m], and the ATE after rigid alignment. Orebro and Belgioioso are published with corrected
poses only, which the run gets as its odometry. A verdict is right if it is ``wrong`` for maps with an ATE above
0.5 m, and only for them. ``--quick``: one seed of the first scans of two logs.

``--drawn 4 --first 100``: instead, simulated planar logs whose odometry states no noise, once as accurate as corrected
poses and once as wheels, with and without the limit on the noise of the heading that calibration finds in the log.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

import graphslam as gs
from graphslam.calibrate import scans as scans_calibration
from graphslam.core.errors import MissingDataError
from graphslam.core.geometry import se2_between
from graphslam.core.log import SensorLog
from graphslam.core.poses import compose_increments
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.io.carmen import read_carmen
from graphslam.io.catalog import locate
from graphslam.io.odometry_noise import DEFAULT_NOISE
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_studies.evaluate.relations import consecutive_pairs, covered_part, random_pairs, relation_error

LOGS = {
    "orebro": ("carmen-corrected-extra", "orebro-corrected.log.gz"),
    "belgioioso": ("carmen-corrected-extra", "belgioioso-corrected.log.gz"),
    "csail": ("radish-mit-csail", "mit-csail.clf.bz2"),
    "fr079": ("radish-fr079", "fr079.clf.bz2"),
    "intel": ("radish-intel", "intel.clf.bz2"),
}
QUICK, QUICK_SCANS = ("belgioioso", "csail"), 120
WRONG = 0.5
"""A map with a larger ATE is wrong [m]."""


def read_log(name: str, scans: int | None) -> tuple[SensorLog, Trajectory]:
    """The log of a file, as a run reads it, and its corrected path."""
    data, file = LOGS[name]
    path = locate(data) / file
    log = gs.load(path)
    alone = "corrected" in path.name
    reference: Any = chain_odometry(log["odometry"]) if alone else read_carmen(path.parent)["reference"]
    if scans is not None:
        times = log["laser"].times
        log = log.slice(times[0], times[min(scans, len(times)) - 1])
    return log, reference


def run_once(name: str, seed: int, scans: int | None, options: dict[str, Any]) -> dict[str, Any]:
    """One run in this process, and its figures."""
    log, reference = read_log(name, scans)
    begin = time.process_time()
    run = gs.run(log, seed=seed, config=options, progress=False)
    spent = time.process_time() - begin
    path = run.map.trajectory
    part = covered_part(reference, path)
    pairs = random_pairs(len(part), 5000, np.random.default_rng(0))
    aligned = ate(Trajectory(part.times, path.interpolate(part.times)), part).statistics
    word = run.headline.text.partition(":")[0].lower()
    shares = [r["share"] for r in run.report.get("map_attempts", [])]
    return {
        "neighbours": float(relation_error(path, part, consecutive_pairs(len(part))).translation.mean()),
        "random": float(relation_error(path, part, pairs).translation.mean()),
        "ate": float(aligned.rmse),
        "submaps": len(run.submaps),
        "candidates": len(shares) or 1,
        "word": word,
        "right": (word == "wrong") == (aligned.rmse > WRONG),
        "headline": run.headline.text,
        "cpu": spent,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def drawn_log(number: int, sigmas: tuple[float, float]) -> SensorLog:
    """A drive around a building with scans and odometry of these errors [m, rad], and default noise."""
    log = gs.simulate("mixed", preset="full", seed=number)
    assert log.truth is not None
    laser, rng = log["laser"], np.random.default_rng(number)
    x = log.truth.trajectory.interpolate(laser.times)
    steps = se2_between(x[:-1], x[1:])
    steps = steps + rng.normal(size=steps.shape) * [sigmas[0], sigmas[0] / 3, sigmas[1]]
    odometry = DEFAULT_NOISE.odometry(laser.times, compose_increments(steps))
    return replace(log, name="drawn", streams={"laser": laser, "odometry": odometry})


def compare_drawn(first: int, count: int) -> None:
    """Print errors and NEES of runs with and without the limit."""
    limit = scans_calibration.heading_cover
    print("log odometry | ATE [m]: limit, none, ratio | NEES/dof: limit, none", flush=True)
    for number in range(first, first + count):
        for kind, sigmas in (("accurate", (0.002, 0.0005)), ("wheels", (0.03, 0.01))):
            log, errors, nees = drawn_log(number, sigmas), [], []
            assert log.truth is not None
            for used in (limit, lambda *_: None):
                scans_calibration.heading_cover = used
                found = gs.run(log, seed=0, progress=False)
                errors.append(float(ate(found.map.trajectory, log.truth.trajectory).statistics.rmse))
                nees.append(float(found.metric("nees_per_dof")))
            scans_calibration.heading_cover = limit
            a, b = errors
            print(f"{number} {kind:8s} | {a:.4f} {b:.4f} {a / b:.2f} | {nees[0]:.3f} {nees[1]:.3f}", flush=True)


def row(name: str, seed: int, f: dict[str, Any]) -> str:
    """A line of the table."""
    return (
        f"{name:11s} {seed:4d} | {f['neighbours']:7.3f} {f['random']:7.3f} {f['ate']:7.3f} | {f['submaps']:4d} "
        f"{f['candidates']:4d} | {f['word']:14s} {'yes' if f['right'] else 'NO':5s} | {f['cpu']:6.0f} "
        f"{f['memory']:5.2f}"
    )


HEAD = (
    "log         seed | relations [m]      ATE | sub- maps | verdict        right |    CPU   GB\n"
    "                 |  next    random     [m] | maps tried|                      |      s     "
)


def main() -> None:
    """See the module's docstring."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("names", nargs="*", choices=[*LOGS, []])
    p.add_argument("--seeds", type=int, default=5)
    p.add_argument("--first", type=int, default=0)
    p.add_argument("--set", default="{}", help="options of the run, JSON")
    p.add_argument("--scans", type=int)
    p.add_argument("--quick", action="store_true")
    p.add_argument("--one", action="store_true", help="one run in this process, as JSON")
    p.add_argument("--drawn", type=int, default=0, help="number of simulated logs")
    a = p.parse_args()
    if a.drawn:
        compare_drawn(a.first, a.drawn)
        return
    if a.one:
        print(json.dumps(run_once(a.names[0], a.first, a.scans, json.loads(a.set))))
        return
    scans = QUICK_SCANS if a.quick else a.scans
    print(HEAD, flush=True)
    for name in a.names or (QUICK if a.quick else LOGS):
        try:
            locate(LOGS[name][0])
        except MissingDataError:
            print(f"{name} left out: no recording (set GRAPHSLAM_DATA)")
            continue
        rows = []
        for seed in range(a.first, a.first + (1 if a.quick else a.seeds)):
            command = [sys.executable, "-m", "tests.benchmarks.bench_planar", name, "--one", "--first", str(seed)]
            command += ["--set", a.set, *(["--scans", str(scans)] if scans else [])]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE)
            rows.append(json.loads(done.stdout.splitlines()[-1]))
            print(row(name, seed, rows[-1]), flush=True)
        errors = [r["ate"] for r in rows]
        right = sum(r["right"] for r in rows)
        ratio = max(errors) / min(errors)
        print(f"{name}: ATE worst {max(errors):.3f} m, {ratio:.2f} × best; verdict right in {right} of {len(rows)}")


if __name__ == "__main__":
    main()
