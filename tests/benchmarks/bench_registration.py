"""Figures of docs/notes/registration.md: capture, calibration, what the gates tell apart, time. About three minutes.

python -m tests.benchmarks.bench_registration [capture|calibration|gates|time|recorded] [--quick: time only]
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import numpy as np

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.io.lidar_pack import read_lidar_pack
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.register import Registration, register, register_starts
from graphslam.registration.search import SearchConfig, correlative_search, offset_pose
from graphslam.registration.search_field import SearchField
from graphslam.registration.target import Target
from tests.reference.box_world import BoxWorld, around, corridor, hall, heading, survey

ANY_SHIFT = RegistrationConfig(max_shift=20.0, max_turn=3.0)


def along(rng: np.random.Generator, step: float) -> list[Array]:
    return [heading(x, rng.uniform(7, 11), 1.2, rng.uniform(-0.3, 0.3)) for x in np.arange(2.0, 59.0, step)]


def build(world: BoxWorld, sigma: float, jitter: float, rng: np.random.Generator) -> Array:
    """Points of a map of which every scan is wrong by ``jitter`` metres and a tenth of that in radians, per axis."""
    scans = []
    for pose in along(rng, 3.0):
        wrong = se3.se3_compose(pose, se3.se3_exp(jitter * rng.standard_normal(6) * [*[0.1] * 3, *[1.0] * 3]))
        scans.append(se3.se3_transform(wrong, world.scan(pose, around(rng, 3000), sigma, 25.0, rng)))
    return np.concatenate(scans)


def build_flat(world: BoxWorld, sigma: float, jitter: float, rng: np.random.Generator) -> Array:
    scans = []
    for x in np.arange(2.0, 59.0):
        pose = np.array([x, rng.uniform(7, 11), rng.uniform(-3, 3)])
        wrong = se2.se2_compose(pose, jitter * rng.standard_normal(3) * [1.0, 1.0, 0.1])
        scans.append(se2.se2_transform(wrong, flat_scan(world, pose, 361, sigma, rng)))
    return np.concatenate(scans)


def flat_scan(world: BoxWorld, pose: Array, n: int, sigma: float, rng: np.random.Generator) -> Array:
    a = rng.uniform(-np.pi, np.pi, n)
    rays = np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    return world.scan(heading(pose[0], pose[1], 0.5, pose[2]), rays, sigma, 25.0, rng)[:, :2]


def somewhere(rng: np.random.Generator) -> Array:
    return heading(rng.uniform(8, 52), rng.uniform(7, 11), 1.2, rng.uniform(-3, 3))


def error(r: Registration, T: Array) -> Array:
    if len(T) == 3:
        return se2.se2_log(se2.se2_between(r.T_target_source, T))
    return se3.se3_log(se3.se3_between(r.T_target_source, T))


def lengths(e: Array) -> tuple[float, float]:
    """Translation [m] and rotation [rad] of a tangent vector."""
    if len(e) == 3:
        return float(np.hypot(e[0], e[1])), float(abs(e[2]))
    return float(np.linalg.norm(e[3:])), float(np.linalg.norm(e[:3]))


def capture(trials: int = 20) -> None:
    """Share of starts that end within 0.3 m and 2°, by direction and distance; those accepted though they do not."""
    print("hall | direction | off | 3-D | false accepted | 2-D | false accepted")
    for cars in (0, 24):
        world, rng = hall(cars=cars), np.random.default_rng(3)
        target = Target(build(world, 0.025, 0.0, rng), voxel=0.3)
        flat = Target(build_flat(world, 0.025, 0.0, rng), voxel=0.1)
        for name, axis in (("along", 0), ("across", 1)):
            for distance, degrees in ((0.5, 5), (1.0, 10), (1.5, 10), (2.0, 10), (3.0, 10), (4.0, 10)):
                right, false = np.zeros(2, int), np.zeros(2, int)
                for _ in range(trials):
                    T, sign = somewhere(rng), rng.choice([-1.0, 1.0], 2)
                    offset = np.zeros(4)
                    offset[axis], offset[3] = sign[0] * distance, sign[1] * np.radians(degrees)
                    P = np.array([T[0], T[1], 2.0 * np.arctan2(T[5], T[6])])
                    cases = (
                        (Target(world.scan(T, around(rng, 1500), 0.025, 25.0, rng), voxel=0.3), target, T),
                        (Target(flat_scan(world, P, 361, 0.025, rng)), flat, P),
                    )
                    for i, (source, to, truth) in enumerate(cases):
                        r = register(source, to, offset_pose(truth, offset), ANY_SHIFT)
                        shift, turn = lengths(error(r, truth))
                        good = shift < 0.3 and turn < np.radians(2)
                        right[i] += good
                        false[i] += r.accepted and not good
                shown = " | ".join(f"{n / trials:.2f} | {f}" for n, f in zip(right, false))
                print(f"{'cars' if cars else 'bare'} | {name} | {distance:g} m {degrees}° | {shown}", flush=True)


def calibration(trials: int = 60) -> None:
    """Mean NEES per degree of freedom, with and without the floor, of accepted matches."""
    print("dim | hall | σ | bins | rays | map wrong by | accepted | error cm | NEES | without floor")
    three = [(24, 0.025, 0.3, 1500, 0.0), (24, 0.025, 0.2, 1500, 0.0), (24, 0.01, 0.3, 1500, 0.0)]
    three += [(24, 0.05, 0.3, 1500, 0.0), (0, 0.025, 0.3, 1500, 0.0), (24, 0.025, 0.3, 400, 0.0)]
    three += [(24, 0.025, 0.3, 1500, 0.01), (24, 0.025, 0.3, 1500, 0.02), (24, 0.025, 0.3, 1500, 0.05)]
    two = [(c, s, 0.1, 181 if n == 1500 else 61, j) for c, s, v, n, j in three if v == 0.3]
    for dim, rows in ((3, three), (2, two)):
        for cars, sigma, voxel, rays, jitter in rows:
            world, rng, kept, nees, bare = hall(cars=cars), np.random.default_rng(0), [], [], []
            for k in range(trials):
                if k % (5 if jitter else 15) == 0:
                    make = build if dim == 3 else build_flat
                    target = Target(make(world, sigma, jitter, rng), voxel=voxel)
                T = somewhere(rng)
                if dim == 3:
                    source = Target(world.scan(T, around(rng, rays), sigma, 25.0, rng), voxel=voxel)
                else:
                    T = np.array([T[0], T[1], 2.0 * np.arctan2(T[5], T[6])])
                    source = Target(flat_scan(world, T, rays, sigma, rng))
                r = register(source, target, offset_pose(T, rng.standard_normal(4) * [0.1, 0.1, 0.05, 0.02]))
                if not r.accepted:
                    continue
                e = error(r, T)
                floor = np.diag([1e-4, 1e-4, 1e-6] if dim == 2 else [1e-6] * 3 + [1e-4] * 3)
                kept.append(lengths(e)[0])
                nees.append(e @ np.linalg.solve(r.covariance, e) / len(e))
                bare.append(e @ np.linalg.solve(r.covariance - floor + 1e-12 * np.eye(len(e)), e) / len(e))
            rms = 100 * np.sqrt(np.mean(np.square(kept)))
            print(
                f"{dim} | {'cars' if cars else 'bare'} | {100 * sigma:g} cm | {voxel:g} m | {rays} "
                f"| {100 * jitter:g} cm | {len(kept)}/{trials} | {rms:.1f} | {np.mean(nees):.2f} | {np.mean(bare):.2f}",
                flush=True,
            )


def gates(trials: int = 25) -> None:
    """Matches of every mode of a search 8 m off: what right and wrong ones look like; corridors."""
    for cars in (0, 24):
        world, rng = hall(cars=cars), np.random.default_rng(0)
        points = build(world, 0.025, 0.0, rng)
        target, field = Target(points, voxel=0.3), SearchField(points)
        right, wrong, first, best, passed, false = [], [], 0, 0, 0, 0
        for _ in range(trials):
            T = somewhere(rng)
            source = Target(world.scan(T, around(rng, 1500), 0.025, 25.0, rng), voxel=0.3)
            start = offset_pose(T, (rng.choice([-8.0, 8.0]), rng.uniform(-3, 3), 0.3, 0.15))
            starts = correlative_search(source.points, field, start, (12.0, 12.0, 0.8, 0.3), (0.4, 0.4, 0.4, 0.0))
            first += np.linalg.norm(starts[0].T[:3] - T[:3]) < 0.6
            results = register_starts(source, target, [s.T for s in starts])
            for k, r in enumerate(results):
                good = lengths(error(r, T))[0] < 0.2
                (right if good else wrong).append((r.fitness, r.fitness_upright, r.degeneracy, r.rmse))
                best += good and k == 0
                passed += good and r.accepted
                false += r.accepted and not good
        print(f"{'cars' if cars else 'bare'}: first mode right {first}, best match right {best}, of {trials}")
        print(f"  right accepted {passed} of {len(right)}, wrong accepted {false} of {len(wrong)}")
        for name, column in (("fitness", 0), ("fitness_upright", 1), ("degeneracy", 2), ("rmse", 3)):
            a, b = np.array(right)[:, column], np.array(wrong)[:, column]
            print(f"  {name}: right min {a.min():.4f} median {np.median(a):.4f}; wrong ", end="")
            print(f"median {np.median(b):.4f} p90 {np.quantile(b, 0.9):.4f} max {b.max():.4f}", flush=True)
    world = corridor()
    for sigma, voxel in ((0.01, 0.2), (0.025, 0.2), (0.025, 0.1), (0.05, 0.3), (0.05, 0.1)):
        ratios = []
        for k in range(8):
            rng = np.random.default_rng(k)
            poses = [
                heading(x, rng.uniform(-0.5, 0.5), 1.2, rng.uniform(-0.3, 0.3)) for x in np.arange(-20.0, 20.0, 3.0)
            ]
            target = Target(survey(world, np.array(poses), 2000, sigma, 25.0, rng, low=-1.0, high=1.0), voxel=voxel)
            T = heading(rng.uniform(-5, 5), 0.0, 1.2, 0.1)
            source = Target(world.scan(T, around(rng, 1500, -1.0, 1.0), sigma, 25.0, rng), voxel=voxel)
            ratios.append(register(source, target, offset_pose(T, (0.5, 0.1, 0.0, 0.03))).degeneracy)
        print(f"corridor σ {100 * sigma:g} cm bins {voxel:g} m: median {np.median(ratios):.4f} max {max(ratios):.4f}")


def seconds(work: Callable[[], object], repeat: int = 15) -> str:
    spent = []
    for _ in range(repeat):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return f"{1e3 * min(spent):.1f} ms (median {1e3 * np.median(spent):.1f})"


def times() -> None:
    """Processor time of one core."""
    world, rng = hall(cars=24), np.random.default_rng(1)
    points = build(world, 0.025, 0.0, rng)
    T = heading(30.0, 8.0, 1.2, 0.3)
    scan = world.scan(T, around(rng, 3000), 0.025, 25.0, rng)
    field = SearchField(points)
    print(f"map {len(points)} points; field {field.values.shape} cells {field.values.nbytes / 1e6:.1f} MB")
    print("field:", seconds(lambda: SearchField(points), 5))
    start, half, steps = offset_pose(T, (5.0, -3.0, 0.3, 0.15)), (12.0, 12.0, 0.8, 0.3), (0.4, 0.4, 0.4, 0.0)
    print("search:", seconds(lambda: correlative_search(scan, field, start, half, steps)))
    plain = SearchConfig(refine=False)
    print("search, not refined:", seconds(lambda: correlative_search(scan, field, start, half, steps, config=plain)))
    turn = (*half[:3], np.pi)
    wide, rough = (30.0, 30.0, 2.4, 0.8), (0.8, 0.8, 0.8, 0.1)
    coarse = SearchField(points, cell=0.4, sigma=0.6)
    print("search, ± 30 m, coarse and fine:", seconds(
        lambda: correlative_search(scan, field, start, wide, rough, coarse=coarse)))  # fmt: skip
    print("search, whole turn:", seconds(lambda: correlative_search(scan, field, start, turn, steps), 3))

    def prepare() -> Target:
        t = Target(points, voxel=0.3)
        _ = t.cloud, t.tree
        return t

    target = prepare()
    print(f"target of {len(target)} points:", seconds(prepare, 5))
    source = Target(scan, voxel=0.3)
    near = offset_pose(T, (0.2, -0.1, 0.05, 0.02))
    register(source, target, near)
    print(f"register {len(source)} points, prepared:", seconds(lambda: register(source, target, near)))
    print("register, from the scan:", seconds(lambda: register(Target(scan, voxel=0.3), target, near)))
    flat = Target(build_flat(world, 0.025, 0.0, rng), voxel=0.1)
    P = np.array([30.0, 8.0, 0.3])
    line = flat_scan(world, P, 181, 0.025, rng)
    register(line, flat, P)
    print(f"register {len(line)} points, 2-D:", seconds(lambda: register(line, flat, P + [0.2, -0.1, 0.03])))


def recorded() -> None:
    """Consecutive scans from a start disturbed by 0.1 m and 0.02 rad an axis, against the odometry."""
    config = RegistrationConfig(gates=RegistrationGates(tilt=np.pi, fitness=0.0, fitness_upright=0.0))
    for name, step, every in (
        ("lidar3d_balm_hall", 0.002, 4),
        ("lidar3d_hku1", 0.005, 3),
        ("lidar3d_hku_mb", 0.005, 4),
    ):
        log = read_lidar_pack(f"{os.environ['GRAPHSLAM_DATA']}/{name}", step=step)
        clouds, motions = log.streams["clouds"], log.streams["odometry"].increments
        rng, rows, refused = np.random.default_rng(0), [], 0
        for k in range(1, len(clouds), every):
            disturbed = se3.se3_exp(np.concatenate([rng.normal(0, 0.02, 3), rng.normal(0, 0.1, 3)]))
            source, target = (Target(clouds.cloud(i), voxel=0.3) for i in (k, k - 1))
            r = register(source, target, se3.se3_compose(motions[k], disturbed), config)
            if not r.accepted:
                refused += 1
                continue
            e = error(r, motions[k])
            rows.append([*lengths(e), e @ np.linalg.solve(r.covariance, e) / 6, r.fitness, r.degeneracy])
        q = np.quantile(np.array(rows), [0.1, 0.5, 0.9], axis=0)
        print(f"{name}: {len(rows)} pairs, {refused} refused (10 %, median, 90 %)")
        for label, column in zip(("shift m", "turn rad", "NEES/6", "fitness", "degeneracy"), q.T):
            print(f"  {label}: " + ", ".join(f"{v:.4f}" for v in column), flush=True)


if __name__ == "__main__":
    parts = {"capture": capture, "calibration": calibration, "gates": gates, "time": times, "recorded": recorded}
    asked = ["time"] if "--quick" in sys.argv else sys.argv[1:]
    for part in asked or parts:
        print(f"== {part}")
        parts[part]()
