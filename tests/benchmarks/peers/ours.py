"""Works of this project: ``python -m tests.benchmarks.peers.ours WORK FOLDER FIGURES``; see ``child.py``."""

from __future__ import annotations

import itertools
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.peers.child import Work, main

Measured = Callable[[], dict[str, Any]]


def sensor_log(folder: Path) -> Any:
    """Scans that are read when they are needed, as the peers read them, and the IMU if there is one."""
    from graphslam.core.imu import Imu, ImuNoise
    from graphslam.core.log import SensorLog
    from graphslam.core.point_clouds import PointClouds

    class Mapped:
        """Source of points: arrays on disk."""

        def __init__(self) -> None:
            self.points = np.load(folder / "points.npy", mmap_mode="r")
            self.offsets = np.load(folder / "offsets.npy")
            ages = folder / "ages.npy"
            self.before = np.load(ages, mmap_mode="r") if ages.exists() else None

        @property
        def counts(self) -> np.ndarray:
            return np.diff(self.offsets)

        def cloud(self, k: int) -> np.ndarray:
            return np.asarray(self.points[self.offsets[k] : self.offsets[k + 1]], dtype=np.float64)

        def ages(self, k: int) -> np.ndarray | None:
            some = slice(self.offsets[k], self.offsets[k + 1])
            return None if self.before is None else np.asarray(self.before[some], dtype=np.float64)

        def packed(self) -> bytes:
            return self.points.tobytes()

    streams: dict[str, Any] = {"clouds": PointClouds(times=np.load(folder / "times.npy"), source=Mapped())}
    if (folder / "imu.npz").exists():
        a = np.load(folder / "imu.npz")
        noise = ImuNoise(**json.loads(str(a["noise"])))
        streams["imu"] = Imu(
            times=a["times"], angular_rate=a["rate"], specific_force=a["force"], noise=noise, T_base_imu=a["mount"]
        )
    return SensorLog(name=folder.name, streams=streams)


def run_of(folder: Path, config: dict[str, Any]) -> Measured:
    """A whole run without the IMU."""
    import graphslam as gs

    gs.run  # noqa: B018  # names are imported at their first use; the time is without imports
    log = sensor_log(folder)
    log = type(log)(name=log.name, streams={"clouds": log["clouds"]})

    def call() -> dict[str, Any]:
        run = gs.run(log, config=config, progress=False)
        return {"path": run.map.trajectory.interpolate(log["clouds"].times)}

    return call


def lidar_map(folder: Path) -> Measured:
    """From scans to the map, with default options."""
    return run_of(folder, {})


def lidar_path(folder: Path) -> Measured:
    """Without refinement and fused map."""
    return run_of(folder, {"refine": {"use": False}, "map": {"fuse": False}})


def odometry(folder: Path, with_imu: bool = True) -> Measured:
    """Scan after scan."""
    from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
    from tests.reference.lidar_start import start_odometry

    log = sensor_log(folder)
    clouds = log["clouds"]

    def call() -> dict[str, Any]:
        follower = start_odometry(clouds, LidarOdometryConfig(), log.streams.get("imu") if with_imu else None)
        poses = []
        for k, t in enumerate(clouds.times):
            follower.step(clouds.cloud(k), float(t), clouds.ages(k))
            poses.append(follower.pose)
        return {"path": np.array(poses)}

    return call


def compiled_run(folder: Path) -> Measured:
    """A run whose kernels are in a folder beside the inputs."""
    os.environ["NUMBA_CACHE_DIR"] = str(folder / "compiled")
    return lidar_map(folder)


def first_run(folder: Path) -> Measured:
    """The same with no compiled kernel."""
    import shutil

    shutil.rmtree(folder / "compiled", ignore_errors=True)
    return compiled_run(folder)


def planar(folder: Path, share: float) -> Measured:
    """The first part of a planar log."""
    import graphslam as gs

    name = json.loads((folder / "case.json").read_text())[0]
    if name == "simulated":  # eight laps through a building and a park
        log = gs.simulate("mixed", seed=1, laps=8)
        log = type(log)(name=log.name, streams={n: log[n] for n in ("laser", "wheels")}, truth=log.truth)
    else:
        log = gs.load(name)
    begin, end = log.interval
    log = log.slice(begin, begin + share * (end - begin))
    return lambda: (gs.run(log, progress=False), {})[1]


def on_threads(folder: Path, threads: int) -> Measured:
    """SegSLAM with 40 particles over 300 s, collapse or relaxation of a skeleton of 10⁵ poses, or a refinement.

    One thread: the process has one core (``bench_peers``), because the refinement uses all of them.
    """
    import graphslam as gs
    from graphslam.backend import refining
    from graphslam.skeleton.collapse import Collapse
    from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
    from graphslam_studies.sim.laps import LapsConfig, draw_laps

    def collapsed(world: Any, pairs: Any) -> Any:
        collapse = Collapse(int(world.first[-1]))
        for a, b in pairs:
            collapse.add(a, b)
        return collapse.landmarks()[0]

    def skeleton(poses: int) -> Any:
        world = draw_laps(LapsConfig(poses=poses))
        return world.problem(collapsed(world, world.correspondences()))

    case = json.loads((folder / "case.json").read_text())[0]
    if case == "collapse":
        world = draw_laps(LapsConfig(poses=100_000))
        pairs = [(a.copy(), b.copy()) for a, b in world.correspondences()]
        return lambda: {"landmarks": 1 + int(collapsed(world, pairs).max())}
    if case == "refinement":
        from tests.benchmarks.peers import inputs

        inputs.scans(folder, "sim-wheels")
        log, given, refine = sensor_log(folder), [], refining.refine_by_scans
        refining.refine_by_scans = lambda *a, **k: given.append(a) or refine(*a, **k)
        # once with kernels: the scans and the path that the run gives to the refinement
        gs.run(log, config={"refine": {"use": "always"}, "map": {"fuse": False}}, progress=False)
        return lambda: {"rounds": len(refine(*given[0]).rounds)}
    if case == "relaxation":
        config = RelaxConfig(threads=threads)
        relax_skeleton(skeleton(600), config)  # kernels
        problem = skeleton(100_000)
        return lambda: {"steps": len(relax_skeleton(problem, config).history)}
    log = gs.simulate("mine", seed=2)
    begin = log.interval[0]

    def run(seconds: float) -> Any:
        config = {"frontend": {"filter": {"particles": 40, "threads": threads}}}
        return gs.run(log.slice(begin, begin + seconds), frontend="segslam", config=config, progress=False)

    run(20.0)  # kernels
    return lambda: {"submaps": len(run(300.0).submaps)}


def chain(folder: Path) -> tuple[int, tuple[np.ndarray, ...]]:
    """Number of nodes, and the arrays of an open chain with fixes."""
    from tests.benchmarks import bench_incremental
    from tests.benchmarks.bench_incremental import problem

    bench_incremental.clock = time.thread_time  # means by the clock on the wall hold what else ran
    n = json.loads((folder / "case.json").read_text())[0]
    return n, problem(n, np.random.default_rng(0))


def updates(seconds: np.ndarray, add: np.ndarray | None = None) -> dict[str, Any]:
    """Figures of single updates [ms]."""
    every = seconds if add is None else seconds + add
    return {
        "update": 1e3 * float(seconds.mean()),
        "median": 1e3 * float(np.median(seconds)),
        "with factors": 1e3 * float(every.mean()),
        "last 1,000": 1e3 * float(seconds[-1000:].mean()),
    }


def isam2(folder: Path) -> Measured:
    """Single updates with a fix on every tenth node."""
    from tests.benchmarks.bench_incremental import ours

    n, data = chain(folder)

    def call() -> dict[str, Any]:
        update, add, _, graph = ours(n, data, False)
        poses = np.asarray(graph.values.poses)
        return updates(update, add) | {"path": poses}

    return call


def isam2_gtsam(folder: Path) -> Measured:
    """The same by GTSAM with native factors, made outside the time."""
    import gtsam

    from graphslam.graph.factors.batch import pose_array
    from tests.benchmarks.bench_incremental import bare

    n, data = chain(folder)

    def call() -> dict[str, Any]:
        update, _, isam = bare(n, data, False)
        values = isam.calculateEstimate()
        return updates(update) | {
            "path": np.array([pose_array(values.atPose3(gtsam.symbol("x", k))) for k in range(n + 1)])
        }

    return call


def joined(folder: Path, method: str) -> Measured:
    """Local maps of the simulated world, joined."""
    from graphslam.join.registry import join_by_method
    from graphslam_studies.sim.local_maps import simulate_local_maps

    maps, _ = simulate_local_maps(json.loads((folder / "case.json").read_text())[0], 0, scans=20)
    join_by_method(maps[:8], method)  # kernels
    return lambda: {"error": float(join_by_method(maps, method).objective)}


def solve_file(folder: Path) -> Measured:
    """A pose-graph file with default options."""
    from tests.benchmarks.bench_solve import ours

    path, best = json.loads((folder / "case.json").read_text())
    ours(path)  # kernels

    def call() -> dict[str, Any]:
        found = ours(path)
        return {"work": found["work"], "error": found["objective"] / best - 1.0}

    return call


def solve_gtsam(folder: Path) -> Measured:
    """The cheaper of GTSAM's two descents that ends at the best-known objective, else the one that ends lower."""
    from tests.benchmarks.bench_solve import raw

    path, best = json.loads((folder / "case.json").read_text())

    def call() -> dict[str, Any]:
        tried = []
        for method in ("gauss-newton", "levenberg-marquardt"):
            try:
                found = raw(path, method)
            except (RuntimeError, ValueError):  # a singular system
                continue
            if found["objective"] == found["objective"]:
                tried.append((found["objective"] / best - 1.0, found["work"]))
            if tried and tried[-1][0] < 1e-5:
                break
        if not tried:
            raise RuntimeError("neither Gauss-Newton nor Levenberg-Marquardt of GTSAM converges")
        error, work = min(tried)
        return {"work": work, "error": error}

    return call


def solve_arrays(folder: Path) -> Measured:
    """A pose network from arrays, without reading."""
    from graphslam.io.network_file import read_network
    from graphslam.solve.network.solve import solve_network

    network = read_network(json.loads((folder / "case.json").read_text())[0])
    solve_network(network, "lm")  # kernels

    def call() -> dict[str, Any]:
        begin = time.process_time()
        found = solve_network(network, "lm")
        return {"work": time.process_time() - begin, "poses": np.asarray(found.poses)}

    return call


def grid(folder: Path) -> Measured:
    """All scans into a new evidence grid."""
    from graphslam.evidence.beams import BeamModel
    from graphslam.evidence.grid import EvidenceGrid

    size, reach = json.loads((folder / "case.json").read_text())
    poses, points, offsets = (np.load(folder / f"{n}.npy") for n in ("poses", "points", "offsets"))

    def call() -> dict[str, Any]:
        evidence = EvidenceGrid(size, model=BeamModel())
        for k, pose in enumerate(poses):
            evidence.insert_scan(points[offsets[k] : offsets[k + 1]], pose=pose, max_range=reach)
        return {}

    return call


def ate(folder: Path) -> Measured:
    """ATE and RPE of a path."""
    from graphslam.core.trajectory import Trajectory
    from graphslam.evaluate.trajectory_error import ate, rpe

    a, b, t = (np.load(folder / f"{n}.npy") for n in ("estimate", "reference", "times"))
    estimate, reference = Trajectory(t, a), Trajectory(t, b)

    def call() -> dict[str, Any]:
        whole = ate(estimate, reference).translation
        pieces = rpe(estimate, reference, delta=10.0).translation
        return {f"{n} [m]": float(np.sqrt(np.mean(e**2))) for n, e in (("ATE", whole), ("RPE", pieces))}

    return call


def register(folder: Path) -> Measured:
    """Pairs of scans, from points to the relative poses."""
    from graphslam.registration.register import register
    from graphslam.registration.target import Target

    points, offsets, starts = (np.load(folder / f"{n}.npy") for n in ("points", "offsets", "starts"))
    clouds = [points[a:b] for a, b in itertools.pairwise(offsets)]

    def call() -> dict[str, Any]:
        found = []
        for k, start in enumerate(starts):
            target, source = (Target(clouds[i].astype(np.float64), voxel=0.3) for i in (2 * k, 2 * k + 1))
            found.append(register(source, target, start).T_target_source)
        return {"path": np.array(found)}

    return call


def imported(folder: Path) -> Measured:
    """What a first line costs."""

    def call() -> dict[str, Any]:
        import graphslam as gs

        _ = gs.simulate
        return {}

    return call


WORKS: dict[str, Work] = {
    "lidar-map": lidar_map,
    "lidar-path": lidar_path,
    "odometry": odometry,
    "odometry-scans": lambda folder: odometry(folder, with_imu=False),
    "first-run": first_run,
    "second-run": compiled_run,
    "planar": lambda folder: planar(folder, 1.0),
    "planar-half": lambda folder: planar(folder, 0.5),
    "planar-quarter": lambda folder: planar(folder, 0.25),
    "two-threads": lambda folder: on_threads(folder, 2),
    "one-thread": lambda folder: on_threads(folder, 1),
    "isam2": isam2,
    "isam2-gtsam": isam2_gtsam,
    "join-isam2": lambda folder: joined(folder, "isam2"),
    "join-batch": lambda folder: joined(folder, "batch"),
    "join-tree": lambda folder: joined(folder, "eif-tree"),
    "solve": solve_file,
    "solve-gtsam": solve_gtsam,
    "solve-arrays": solve_arrays,
    "grid": grid,
    "ate": ate,
    "register": register,
    "import": imported,
}

if __name__ == "__main__":
    main(WORKS)
