"""Map samples of SegSLAM and particles of the RBPF as samples of the posterior of the path, on random halls.

``python -m tests.benchmarks.bench_map_samples [--worlds N] [--particles N] [--laps N]``: the halls of
`bench_long_operation`, without persons. As many map samples as particles, their last segments drawn by weight. Scored
are relations: the pose at one time relative to that at another, at random times more than 10 s apart (``far``), and at
returns to a place (``return``: within 2 m of it, more than 15 m of driving later).

``energy``: energy score of the position [m], ``E|X - y| - E|X - X'|/2``; ``CRPS``: of the heading [mrad]; ``log score``
is -log density of the true position under a Gaussian with mean and covariance of the samples, plus 0.05 m for each axis
[nat]; ``inside``: share of the true x, y, headings between the 5 % and the 95 % quantile of the samples, 90 % if they
are samples of the posterior; ``spread``: standard deviation of the samples over the RMS error of their mean, 1 if
consistent. Means over worlds with 95 % intervals of Student's t, and paired differences.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.config import merge_options
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.poses import SE3, heading_of
from graphslam.core.random import SeedTree
from graphslam_frontends.grid.particles import systematic_resample
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_studies.frontends.rbpf_grid import run_rbpf
from tests.benchmarks.bench_long_operation import COURT, draw_hall, drive
from tests.benchmarks.bench_paper_preset import RBPF, interval

FLOOR = 0.05
PAIRS = 60


def segslam_paths(steps: Steps, particles: int, seed: int) -> Array:
    """Paths ``(n, N, 7)`` of N map samples."""
    front: Any = make_front_end("segslam", merge_options(COURT, {"filter": {"particles": particles}}))
    result = run_segslam(steps, front.config.filter, front.config.segslam, SeedTree(seed))
    roots = systematic_resample(result.weights, 0.5)
    begin = time.process_time()
    for n in range(100):
        result.sample(n)
    print(f"a map sample of {len(result.segmap.intervals())} intervals: {10 * (time.process_time() - begin):.2f} ms")
    return np.stack([result.trajectory(n, int(p)).poses for n, p in enumerate(roots)], axis=1)


def rbpf_paths(steps: Steps, particles: int, seed: int) -> Array:
    """Paths ``(n, N, 7)`` of N particles, drawn by weight."""
    front: Any = make_front_end("rbpf-grid", merge_options(RBPF["rbpf"], {"filter": {"particles": particles}}))
    result = run_rbpf(steps, front.config.filter, SeedTree(seed))
    return result.ancestry.paths()[:, systematic_resample(result.particles.weights, 0.5)]


def pairs_of(steps: Steps, truth: Array, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Pairs of steps ``(k, 2)``."""
    a, b = np.triu_indices(len(steps), 1)
    far = steps.times[b] - steps.times[a] > 10.0
    back = (steps.path_length[b] - steps.path_length[a] > 15.0) & (
        np.linalg.norm(truth[a, :2] - truth[b, :2], axis=1) < 2.0
    )
    out = {}
    for name, asked in (("far", far), ("return", back)):
        rows = rng.choice(np.flatnonzero(asked), PAIRS, replace=False)
        out[name] = np.stack([a[rows], b[rows]], axis=1)
    return out


def figures(paths: Array, truth: Array, pairs: np.ndarray) -> dict[str, float]:
    """Mean scores of relations."""
    n = paths.shape[1]
    X = SE3.between(paths[pairs[:, 0]], paths[pairs[:, 1]])  # (k, N, 7)
    y = SE3.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    e = np.concatenate([X[..., :2] - y[:, None, :2], wrap_angle(heading_of(X) - heading_of(y)[:, None])[..., None]], -1)
    between = np.abs(e[:, :, None] - e[:, None])
    apart = np.linalg.norm(between[..., :2], axis=-1).mean(axis=(1, 2))
    mean = e.mean(axis=1)
    P = np.einsum("kna,knb->kab", e[..., :2] - mean[:, None, :2], e[..., :2] - mean[:, None, :2]) / n
    P = P + FLOOR**2 * np.eye(2)
    d2 = np.einsum("ka,kab,kb->k", mean[:, :2], np.linalg.inv(P), mean[:, :2])
    below = np.mean(e < 0.0, axis=1) + 0.5 * np.mean(e == 0.0, axis=1)
    variance, square = e[..., :2].var(axis=1).sum(axis=1).mean(), np.mean(np.sum(mean[:, :2] ** 2, axis=1))
    return {
        "energy": float(np.mean(np.linalg.norm(e[..., :2], axis=-1).mean(axis=1) - 0.5 * apart)),
        "CRPS": float(1e3 * np.mean(np.abs(e[..., 2]).mean(axis=1) - 0.5 * between[..., 2].mean(axis=(1, 2)))),
        "log score": float(np.mean(0.5 * d2 + 0.5 * np.linalg.slogdet(2.0 * np.pi * P)[1])),
        "inside": float(np.mean((below >= 0.05) & (below <= 0.95))),
        "spread": float(np.sqrt(variance / square)),
        "error": float(np.sqrt(square)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--particles", type=int, default=20)
    parser.add_argument("--laps", type=int, default=3)
    parser.add_argument("--first", type=int, default=700, help="seed of the first world")
    parser.add_argument("--quick", action="store_true", help="two worlds, two laps, five particles")
    a = parser.parse_args()
    if a.quick:
        a.worlds, a.laps, a.particles = 2, 2, 5
    rows: dict[str, dict[str, list[dict[str, float]]]] = {}
    with one_blas_thread():
        for seed in range(a.first, a.first + a.worlds):
            log = drive(draw_hall(seed, a.laps)[0], seed, 0)
            front: Any = make_front_end("segslam", COURT)
            steps = make_steps(log, front.config.steps)
            assert steps.truth is not None
            truth = steps.truth.interpolate(steps.times)
            pairs = pairs_of(steps, truth, SeedTree(seed).child("pairs").generator())
            for name, run in (("map samples", segslam_paths), ("RBPF", rbpf_paths)):
                paths = run(steps, a.particles, seed)
                for kind, asked in pairs.items():
                    row = figures(paths, truth, asked)
                    rows.setdefault(kind, {}).setdefault(name, []).append(row)
                    print(f"seed {seed}, {kind}, {name}:", {k: round(x, 3) for k, x in row.items()}, flush=True)
    for kind, found in rows.items():
        print(kind)
        for k in found["RBPF"][0]:
            x, y = (np.array([r[k] for r in found[name]]) for name in ("map samples", "RBPF"))
            less = int(np.sum(x < y))
            print(f"    {k:10} {interval(x):28} RBPF {interval(y):28} difference {interval(x - y)}, less in {less}")


if __name__ == "__main__":
    main()
