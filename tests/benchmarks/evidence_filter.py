"""Many grids at once: a particle filter's step, its memory over a long way, and the time to start.

The filter of both measurements: each particle has a pose and a grid; every scan it is moved by the true motion with
noise of its own (a random walk), weighted, and its grid updated.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.core.se3 import se3_between, se3_compose, se3_exp
from graphslam.evidence.batch import update_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.likelihood import CastLikelihood, EndpointLikelihood, log_weights
from tests.benchmarks.evidence_scenes import FAN_RATE, Scene, tunnel

# σ of a particle's motion per scan: rotation [rad], translation [m]; at 1 m/s that is 0.1° and 2 cm after a metre
WALK = np.repeat([3e-4, 3e-3], 3)
CASTING = CastLikelihood(exponent=0.02)  # 181 beams count as 3.6


@dataclass
class Cloud:
    """Particles: their poses, grids and log weights."""

    number: int
    seed: int
    threads: int = 1
    voxel_size: float = 0.1
    grids: list[EvidenceGrid] = field(init=False)
    resampled: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self.rng = SeedTree(self.seed).child("particles").generator()
        self.poses = np.zeros((self.number, 7))
        self.truth: Array | None = None
        first = EvidenceGrid(self.voxel_size)
        self.grids = [first, *(first.empty() for _ in range(self.number - 1))]
        self.log_weights = np.zeros(self.number)

    def move(self, truth: Array) -> None:
        """Go on to the next scan, which was taken at ``truth`` ``(7,)``; the first one is where they all begin."""
        if self.truth is None:
            self.poses[:] = truth
        else:
            noise = se3_exp(self.rng.normal(scale=WALK, size=(self.number, 6)))
            self.poses = se3_compose(self.poses, se3_compose(se3_between(self.truth, truth), noise))
        self.truth = truth

    @property
    def effective(self) -> float:
        """1 / Σ w²."""
        w = np.exp(self.log_weights - self.log_weights.max())
        return float(w.sum() ** 2 / np.sum(w * w))

    def resample(self) -> None:
        """Systematic resampling; grids are copied, dead ones released."""
        w = np.exp(self.log_weights - self.log_weights.max())
        edges = np.cumsum(w) / w.sum()
        index = np.searchsorted(edges, (self.rng.random() + np.arange(self.number)) / self.number)
        index = np.minimum(index, self.number - 1)
        self.grids = [self.grids[k].copy() for k in index]
        self.poses = self.poses[index]
        self.log_weights = np.zeros(self.number)
        self.resampled += 1


def filter_step(scans: int, *, particles: int = 40) -> float:
    """Print the parts of a filter step, with one thread and with two; real time over the step's, with one.

    Weight by ray casting, resample when N_eff falls below half, update; 181 beams in the tunnel at 0.1 m, after
    the first quarter of the scans. Moving the particles is no work of the grids: printed, not counted. One thread:
    process CPU time. Two: wall time, so it needs an idle machine.
    """
    print(f"filter step, {particles} particles, 181 beams, 0.1 m (ms a scan)")
    scene = tunnel(scans)
    ratio = 0.0
    for threads in (1, 2):
        parts, resampled = _run(
            scene, Cloud(particles, 5, threads), time.process_time if threads == 1 else time.perf_counter
        )
        typical = np.median(parts, axis=0) * 1e3
        mean = parts.mean(axis=0) * 1e3
        speed = 1e3 / FAN_RATE / mean[1:].sum()
        ratio = speed if threads == 1 else ratio
        clock = "CPU" if threads == 1 else "wall"
        print(
            f"  {threads} thread{'s' * (threads > 1)} ({clock}): cast and weight {mean[1]:.2f}, "
            f"resample {mean[2]:.3f} ({resampled} times), update {mean[3]:.2f}; sum {mean[1:].sum():.2f}, "
            f"of medians {typical[1:].sum():.2f}: {speed:.2f} × real time (and moving them {mean[0]:.2f})",
            flush=True,
        )
    return ratio


def _run(scene: Scene, cloud: Cloud, clock) -> tuple[Array, int]:  # type: ignore[no-untyped-def]
    parts = np.zeros((len(scene), 4))
    before = 0
    for k, (pose, points, _) in enumerate(scene):
        if k == len(scene) // 4:
            before = cloud.resampled
        t0 = clock()
        cloud.move(pose)
        t1 = clock()
        if k:
            cloud.log_weights += log_weights(
                cloud.grids, cloud.poses, points, CASTING, max_range=scene.max_range, threads=cloud.threads
            )
        t2 = clock()
        if cloud.effective < cloud.number / 2:
            cloud.resample()
        t3 = clock()
        update_grids(cloud.grids, cloud.poses, points, max_range=scene.max_range, threads=cloud.threads)
        parts[k] = t1 - t0, t2 - t1, t3 - t2, clock() - t3
    return parts[len(scene) // 4 :], cloud.resampled - before


def particle_memory(*, scans: int, particles: int, every: int = 0, png: Path | None = None) -> tuple[float, float]:
    """Memory of many particles over a long way, at its end and at its peak, over that of one map at the end.

    End-point weights of 18 effective beams, systematic resampling where N_eff falls below half (``every``: after so
    many scans), and at the end. Memory is that of living nodes and bricks, taken after every update, that is at its
    most just before resampling, and at the end after it.
    """
    likelihood = EndpointLikelihood(exponent=0.1, interpolation="nearest")
    scene = tunnel(scans)
    single = EvidenceGrid(0.1)
    cloud = Cloud(particles, 6)
    used, one, room = np.zeros(scans), np.zeros(scans), 0
    effective, after = [], 0
    for k, (pose, points, _) in enumerate(
        tqdm(scene, total=scans, desc=f"{particles} particles", leave=False, disable=None)
    ):
        cloud.move(pose)
        if k:
            cloud.log_weights += log_weights(cloud.grids, cloud.poses, points, likelihood, max_range=scene.max_range)
        update_grids(cloud.grids, cloud.poses, points, max_range=scene.max_range)
        single.insert_scan(points, pose=pose, max_range=scene.max_range)
        used[k], one[k] = cloud.grids[0].pool.used_bytes, single.pool.used_bytes
        room = max(room, cloud.grids[0].pool.nbytes)
        if k == scans - 1 or (k % every == every - 1 if every else cloud.effective < particles / 2):
            effective.append(cloud.effective)
            cloud.resample()
            after = cloud.grids[0].pool.used_bytes
    end, peak = after / one[-1], used.max() / one[-1]
    rule = f"after every {every}th scan" if every else "where N_eff < half"
    print(
        f"memory of {particles} particles, {scans} scans, {cloud.resampled} times resampled ({rule}; then "
        f"{np.median(effective):.0f} effective): end {after / 1e6:.1f} MB ({end:.2f} ×; before the last resampling "
        f"{used[-1] / 1e6:.1f} MB), median {np.median(used / one):.2f} × the map so far, "
        f"peak {used.max() / 1e6:.1f} MB ({peak:.2f} ×, {room / 1e6:.1f} MB allocated); one map {one[-1] / 1e6:.1f} MB",
        flush=True,
    )
    if png is not None:
        _draw(png, used / 1e6, one / 1e6, particles)
    return float(end), float(peak)


def _draw(png: Path, used: Array, one: Array, particles: int) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    metres = np.arange(len(used)) / FAN_RATE
    axes.plot(metres, used, label=f"{particles} particles", lw=1)
    axes.plot(metres, one, label="one map", lw=1)
    axes.plot(metres, particles * one, label=f"{particles} maps that share nothing", lw=1, ls=":")
    axes.set(xlabel="way [m]", ylabel="memory [MB]", yscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(png, dpi=150)


_START = """
import time
import numpy as np
begin = time.perf_counter(), time.process_time()
from graphslam.evidence.grid import EvidenceGrid
grid = EvidenceGrid(0.1)
grid.insert_scan(np.array([[3.0, 0.0, 0.0], [3.0, 1.0, 0.0]]), max_range=30.0)
assert abs(grid.cast(None, np.array([[1.0, 0.0, 0.0]]), 30.0).ranges[0] - 3.0) < 0.11
print(time.perf_counter() - begin[0], time.process_time() - begin[1])
"""


def start_up(compiled: int) -> tuple[float, float]:
    """Wall seconds from NumPy imported to a grid made, a scan inserted and a beam cast, in a process that compiles
    what that needs; CPU seconds in a process that finds it compiled. The least of
    ``compiled`` repetitions; of none, kernels are those that this machine has compiled before, and the first is NaN.
    """
    if not compiled:
        warm = min(_child(_START, os.environ.get("NUMBA_CACHE_DIR", ""))[1] for _ in range(3))
        print(f"start: compiled before {warm:.2f} s", flush=True)
        return float("nan"), warm
    with tempfile.TemporaryDirectory() as folder:
        cold = []
        for k in range(compiled):
            cold.append(_child(_START, f"{folder}/{k}"))
        warm = min(_child(_START, f"{folder}/0")[1] for _ in range(compiled + 2))
        megabytes = sum(p.stat().st_size for p in Path(folder, "0").rglob("*") if p.is_file()) / 1e6
    wall = min(w for w, _ in cold)
    print(f"start: compiling {wall:.2f} s, {megabytes:.1f} MB kept; compiled before {warm:.2f} s", flush=True)
    return wall, warm


def _child(code: str, cache: str) -> tuple[float, float]:
    """What a fresh process prints: wall and CPU seconds."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache} if cache else dict(os.environ)
    done = subprocess.run([sys.executable, "-c", code], check=True, env=environment, stdout=subprocess.PIPE, text=True)
    wall, cpu = map(float, done.stdout.split())
    return wall, cpu
