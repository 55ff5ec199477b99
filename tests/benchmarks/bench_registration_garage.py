"""Registration in the simulated garage, as a filter would meet it: maps of dead reckoning, windows of 4 s.

    python -m tests.benchmarks.bench_registration_garage [LAYOUT [SEED]] [--quick: every fourth window]    half a minute

Every stretch of 110 steps (about 33 m) becomes an evidence grid at dead-reckoned poses. Windows of 10 steps of another
time, at the same place or anywhere within 25 m, are searched for from a disturbed start and matched from every mode.
The true place of a window in a map is where the map has the nearest pose that was driven, and from there on the truth.
"""

from __future__ import annotations

import sys

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.evidence.grid import EvidenceGrid
from graphslam.registration.register import Registration, register_starts
from graphslam.registration.search import correlative_search, offset_pose
from graphslam.registration.search_field import SearchField
from graphslam.registration.target import Target
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.garage import garage
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.steps import Steps

NAMES = ("fitness", "fitness_upright", "fitness_known", "degeneracy", "tilt")


def upright(T: Array) -> Array:
    """The pose without its roll and pitch."""
    x = se3.quat_rotate(T[3:], [1.0, 0.0, 0.0])
    a = np.arctan2(x[1], x[0])
    return np.concatenate([T[:3], [0.0, 0.0, np.sin(a / 2), np.cos(a / 2)]])


def chain(steps: Steps) -> Array:
    """Dead-reckoned poses ``(n, 7)``."""
    poses = [upright(np.array([0.0, 0, 0, 0, 0, 0, 1]))]
    for motion in steps.odometry.increments[1:]:
        poses.append(se3.se3_compose(poses[-1], motion))
    return np.array(poses)


def grid_of(steps: Steps, a: int, b: int, poses: Array) -> EvidenceGrid:
    grid = EvidenceGrid(0.2)
    for k in range(a, b):
        points, origins, returns = steps.scan(k)
        pose = se3.se3_between(upright(poses[a]), poses[k])
        grid.insert_scan(points, pose=pose, origin=origins, returns=returns, max_range=steps.max_range)
    return grid


def window_of(steps: Steps, k: int, poses: Array) -> Array:
    scans = [(j, *steps.scan(j)) for j in range(k, k + 10)]
    return np.concatenate([se3.se3_transform(se3.se3_between(poses[k], poses[j]), p[r]) for j, p, _, r in scans])


def main(layout: str = "A", seed: int = 3, *, quick: bool = False) -> None:
    steps = make_steps(simulate_crawler(garage(layout, seed=seed), seed))
    assert steps.truth is not None
    true = steps.truth.poses[np.searchsorted(steps.truth.times, steps.times).clip(0, len(steps.truth.times) - 1)]
    poses, rng = chain(steps), np.random.default_rng(0)
    right: list[Registration] = []
    wrong: list[Registration] = []
    errors, asked, fittest = [], 0, 0
    for a in range(0, len(steps) - 40, 100):
        b = min(a + 110, len(steps))
        grid = grid_of(steps, a, b, poses)
        target, field = Target(grid.occupied_cloud(), voxel=0.3), SearchField(grid.occupied_cloud(), cell=0.2)
        for k in range(0, len(steps) - 12, 48 if quick else 12):
            apart = np.linalg.norm(true[a:b, :3] - true[k, :3], axis=1)
            here = apart.min() < 2.0
            level = np.linalg.norm(true[a:b, :2] - true[k, :2], axis=1).min()
            if a - 20 <= k < b or not (here or (level < 25.0 and rng.random() < 0.12)):
                continue
            j = a + int(np.argmin(apart))
            place = se3.se3_compose(se3.se3_between(upright(poses[a]), poses[j]), se3.se3_between(true[j], true[k]))
            source = Target(window_of(steps, k, poses), voxel=0.3)
            start = offset_pose(place, rng.standard_normal(4) * [3.0, 3.0, 0.3, 0.08])
            starts = correlative_search(source.points, field, start, (8.0, 8.0, 0.8, 0.25), (0.4, 0.4, 0.4, 0.0))
            results = register_starts(source, target, [s.T for s in starts], known=grid.known_at)
            for i, r in enumerate(results):
                e = se3.se3_log(se3.se3_between(r.T_target_source, place))
                good = bool(np.linalg.norm(e[3:]) < 0.6 and np.linalg.norm(e[:3]) < 0.06)
                (right if good else wrong).append(r)
                fittest += here and i == 0 and good
                if good and r.fitness >= 0.75:
                    errors.append((e, r.covariance))
            asked += here
    print(
        f"{asked} windows at the place of a map, fittest match right {fittest}; right {len(right)} wrong {len(wrong)}"
    )
    for name in NAMES:
        g, w = (np.array([getattr(r, name) for r in rs]) for rs in (right, wrong))
        print(f"{name}: right 25 % {np.quantile(g, 0.25):.3f} median {np.median(g):.3f}; ", end="")
        print(f"wrong median {np.median(w):.3f} p90 {np.quantile(w, 0.9):.3f} max {w.max():.3f}")
    for fitness, steep in ((0.85, 0.0), (0.75, 0.0), (0.75, 0.7), (0.75, 0.75), (0.7, 0.65), (0.6, 0.65)):
        passed = [
            sum(r.fitness >= fitness and r.fitness_upright >= steep and r.degeneracy >= 0.003 for r in rs)
            for rs in (right, wrong)
        ]
        print(
            f"fitness ≥ {fitness:g}, upright ≥ {steep:g}: right {passed[0]}/{len(right)} wrong {passed[1]}/{len(wrong)}"
        )
    e, P = np.array([x for x, _ in errors]), np.array([x for _, x in errors])
    rms = np.sqrt(np.mean(e**2, axis=0))
    print(f"rms {1e3 * np.linalg.norm(rms[:3]):.1f} mrad {100 * np.linalg.norm(rms[3:]):.1f} cm of {len(e)}")
    for metres, radians in ((0.01, 0.001), (0.03, 0.003), (0.05, 0.005), (0.07, 0.007)):
        Q = P + np.diag([radians**2 - 1e-6] * 3 + [metres**2 - 1e-4] * 3)
        nees = np.einsum("ni,ni->n", e, np.linalg.solve(Q, e[..., None])[..., 0]) / 6
        print(f"floor {metres:g} m, {radians:g} rad: NEES mean {nees.mean():.2f} median {np.median(nees):.2f}")


if __name__ == "__main__":
    words = [a for a in sys.argv[1:] if a != "--quick"]
    main(*words[:1], *[int(s) for s in words[1:2]], quick="--quick" in sys.argv)
