"""Works of peers, run by the Python of the peer's environment: ``python theirs.py WORK FOLDER FIGURES``.

Defaults of the peers, one thread. Nothing of this project is imported but ``child.py``.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from child import Work, cpu, main

Measured = Callable[[], dict[str, Any]]


def matrix(pose: np.ndarray) -> np.ndarray:
    """``(4, 4)`` of position and quaternion x, y, z, w."""
    x, y, z, w = pose[3:]
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = pose[:3]
    return T


def positions(poses: Any) -> np.ndarray:
    """Poses ``(n, 7)`` of matrices; the rotation is not used and left out."""
    return np.array([[*T[:3, 3], 0.0, 0.0, 0.0, 1.0] for T in poses])


def load_libusb() -> None:
    """The system library that Open3D needs, where a package of the registry brought it."""
    import ctypes
    import importlib.util

    found = importlib.util.find_spec("libusb_package")
    if found is not None and found.origin is not None:
        for library in Path(found.origin).parent.glob("libusb-1.0.so*"):
            ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


class Scans:
    """Scans that are read when they are needed: points, and times of the points within the scan from 0 to 1."""

    def __init__(self, folder: Path) -> None:
        self.points = np.load(folder / "points.npy", mmap_mode="r")
        self.offsets = np.load(folder / "offsets.npy")
        self.times = np.load(folder / "times.npy")
        ages = folder / "ages.npy"
        self.ages = np.load(ages, mmap_mode="r") if ages.exists() else None

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        some = slice(self.offsets[k], self.offsets[k + 1])
        points = np.ascontiguousarray(self.points[some], dtype=np.float64)
        if self.ages is None:
            return points, np.zeros(0)
        age = np.asarray(self.ages[some], dtype=np.float64)
        return points, (age.max() - age) / max(float(np.ptp(age)), 1e-9)


def kiss_slam(folder: Path) -> Measured:
    """The steps of kiss-slam's pipeline, without writing files."""
    from kiss_slam.config.config import load_config
    from kiss_slam.slam import KissSLAM

    scans, config = Scans(folder), load_config(None)
    config.odometry.registration.max_num_threads = 1
    config.odometry.preprocessing.deskew = scans.ages is not None

    def call() -> dict[str, Any]:
        slam = KissSLAM(config)
        for k in range(len(scans)):
            slam.process_scan(*scans[k])
        slam.generate_new_node()
        slam.local_map_graph.erase_last_local_map()
        return {"path": positions(slam.fine_grained_optimization()[0]), "loops": len(slam.closures)}

    return call


def followed(scans: Scans, odometry: Any) -> dict[str, Any]:
    """Path of an odometry with ``register_frame`` and ``last_pose``."""
    poses = []
    for k in range(len(scans)):
        odometry.register_frame(*scans[k])
        poses.append(np.array(odometry.last_pose))
    return {"path": positions(poses)}


def kiss_icp(folder: Path) -> Measured:
    """KISS-ICP, as its pipeline calls it."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    scans, config = Scans(folder), KISSConfig()
    config.registration.max_num_threads = 1
    config.data.deskew = scans.ages is not None
    config.mapping.voxel_size = config.data.max_range / 100.0  # its default
    return lambda: followed(scans, KissICP(config))


def genz_icp(folder: Path) -> Measured:
    """GenZ-ICP, as its pipeline calls it."""
    from genz_icp.config import GenZConfig
    from genz_icp.genz_icp import GenZICP

    scans, config = Scans(folder), GenZConfig()
    config.data.deskew = scans.ages is not None
    return lambda: followed(scans, GenZICP(config))


def rko_lio(folder: Path) -> Measured:
    """Scans and IMU readings in the order of their stamps."""
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    scans, imu = Scans(folder), np.load(folder / "imu.npz")
    assert scans.ages is not None
    mount, begin = matrix(imu["mount"]), 1_000_000_000  # [ns]; a stamp of zero is not a stamp to it

    def stamps(t: np.ndarray) -> np.ndarray:
        return begin + np.round(1e9 * t).astype(np.int64)

    def call() -> dict[str, Any]:
        lio, done, poses = LIO(LIOConfig(max_num_threads=1)), 0, []
        at = stamps(imu["times"])
        for k in range(len(scans)):
            some = slice(scans.offsets[k], scans.offsets[k + 1])
            of_points = stamps(scans.times[k] - np.asarray(scans.ages[some], dtype=np.float64))
            while done < len(at) and at[done] <= of_points.max():
                lio.add_imu_measurement(imu["force"][done], imu["rate"][done], at[done], mount)
                done += 1
            lio.register_scan(scans[k][0], of_points, np.eye(4))
            poses.append(lio.pose())
        return {"path": positions(poses)}

    return call


def g2o(folder: Path) -> Measured:
    """Initial guess along the edges, then Gauss-Newton and Levenberg-Marquardt to the end; the lower one."""
    import g2o

    a = np.load(folder / "network.npz")
    kind = "SE2" if a["measurements"].shape[1] == 3 else "SE3"

    def pose(p: np.ndarray) -> Any:
        if kind == "SE2":
            return g2o.SE2(*map(float, p))
        return g2o.Isometry3d(g2o.Quaternion(*map(float, (p[6], p[3], p[4], p[5]))), p[:3])

    def solved(algorithm: str) -> tuple[float, float, np.ndarray]:
        optimizer = g2o.SparseOptimizer()
        linear = getattr(g2o, f"LinearSolverEigen{kind}")()
        blocks = getattr(g2o, f"BlockSolver{kind}")(linear)
        method = getattr(g2o, f"OptimizationAlgorithm{algorithm}")(blocks)
        optimizer.set_algorithm(method)
        for k, p in enumerate(a["poses"]):
            v = getattr(g2o, f"Vertex{kind}")()
            v.set_id(k)
            v.set_estimate(pose(p))
            v.set_fixed(k == 0)
            optimizer.add_vertex(v)
        for (i, j), z, information in zip(a["edges"].tolist(), a["measurements"], a["information"]):
            e = getattr(g2o, f"Edge{kind}")()
            e.set_vertex(0, optimizer.vertex(i))
            e.set_vertex(1, optimizer.vertex(j))
            e.set_measurement(pose(z))
            e.set_information(information)
            optimizer.add_edge(e)
        begin = cpu()
        optimizer.initialize_optimization()
        optimizer.compute_initial_guess()
        optimizer.compute_active_errors()
        last = float("inf")
        for _ in range(40):
            optimizer.optimize(5)
            now = optimizer.active_chi2()
            if not now < last * (1.0 - 1e-6):
                break
            last = now
        spent = cpu() - begin
        ends = [optimizer.vertex(k).estimate() for k in range(len(a["poses"]))]
        if kind == "SE2":
            return now, spent, np.array([e.vector() for e in ends])
        turns = [e.rotation() for e in ends]
        return now, spent, np.array([[*e.translation(), q.x(), q.y(), q.z(), q.w()] for e, q in zip(ends, turns)])

    def call() -> dict[str, Any]:
        ends = [solved(method) for method in ("GaussNewton", "Levenberg")]
        if abs(ends[0][0] / ends[1][0] - 1.0) < 1e-3:  # both converge: the cheaper one
            ends.sort(key=lambda end: end[1])
        _, work, poses = ends[0] if ends[0][0] <= ends[1][0] * 1.001 else ends[1]
        return {"work": work, "poses": poses}

    return call


def octomap(folder: Path) -> Measured:
    """Lazy insertion. The binding copies point by point: its time, measured with nothing to walk, is taken out."""
    import octomap

    size, reach = json.loads((folder / "case.json").read_text())
    poses, world, offsets = (np.load(folder / f"{n}.npy") for n in ("poses", "world", "offsets"))
    clouds = [world[a:b] for a, b in itertools.pairwise(offsets)]

    def inserted(scans: list[np.ndarray]) -> float:
        tree = octomap.OcTree(size)
        begin = cpu()
        for pose, points in zip(poses, scans):
            tree.insertPointCloud(points, pose[:3].copy(), reach, True)
        return cpu() - begin

    def call() -> dict[str, Any]:
        still = [np.tile(pose[:3], (len(c), 1)) for pose, c in zip(poses, clouds)]
        return {"work": inserted(clouds) - inserted(still)}

    return call


def bonxai(folder: Path) -> Measured:
    """The occupancy mapper of kiss-slam, all points."""
    from kiss_slam.kiss_slam_pybind import kiss_slam_pybind as native

    size, reach = json.loads((folder / "case.json").read_text())
    poses, points, offsets = (np.load(folder / f"{n}.npy") for n in ("poses", "points", "offsets"))

    def call() -> dict[str, Any]:
        mapper = native._OccupancyMapper(size, reach)
        for k, pose in enumerate(poses):
            some = points[offsets[k] : offsets[k + 1]].astype(np.float32)
            mapper._integrate_frame(native._Vector3fVector(some), matrix(pose))
        return {}

    return call


def evo(folder: Path) -> Measured:
    """ATE after alignment, and RPE over 10 m with all pairs."""
    import copy

    from evo.core import metrics, units
    from evo.core.trajectory import PoseTrajectory3D

    a, b, t = (np.load(folder / f"{n}.npy") for n in ("estimate", "reference", "times"))

    def call() -> dict[str, Any]:
        estimate, reference = (PoseTrajectory3D(p[:, :3], p[:, [6, 3, 4, 5]], t) for p in (a, b))
        aligned = copy.deepcopy(estimate)
        aligned.align(reference)
        whole = metrics.APE(metrics.PoseRelation.translation_part)
        whole.process_data((reference, aligned))
        pieces = metrics.RPE(metrics.PoseRelation.translation_part, 10.0, units.Unit.meters, 0.1, True, True)
        pieces.process_data((reference, estimate))
        return {
            f"{n} [m]": float(m.get_statistic(metrics.StatisticsType.rmse))
            for n, m in (("ATE", whole), ("RPE", pieces))
        }

    return call


def open3d(folder: Path) -> Measured:
    """Generalised ICP in two radii, from points to the relative poses."""
    import open3d as o3d

    points, offsets, starts = (np.load(folder / f"{n}.npy") for n in ("points", "offsets", "starts"))
    icp = o3d.pipelines.registration

    def cloud(i: int) -> Any:
        raw = o3d.geometry.PointCloud(
            o3d.utility.Vector3dVector(points[offsets[i] : offsets[i + 1]].astype(np.float64))
        )
        return raw.voxel_down_sample(0.3)

    def call() -> dict[str, Any]:
        found = []
        for k, start in enumerate(starts):
            T, target, source = matrix(start), cloud(2 * k), cloud(2 * k + 1)
            for radius in (2.0, 0.5):
                T = icp.registration_generalized_icp(source, target, radius, T).transformation
            found.append(T)
        return {"path": positions(found)}

    return call


def kiss_slam_import(folder: Path) -> Measured:
    """What a first line costs."""

    def call() -> dict[str, Any]:
        import kiss_slam.pipeline  # noqa: F401

        return {}

    return call


WORKS: dict[str, Work] = {
    "kiss-slam": kiss_slam,
    "kiss-icp": kiss_icp,
    "genz-icp": genz_icp,
    "rko-lio": rko_lio,
    "g2o": g2o,
    "octomap": octomap,
    "bonxai": bonxai,
    "evo": evo,
    "open3d": open3d,
    "kiss-slam-import": kiss_slam_import,
}

if __name__ == "__main__":
    load_libusb()
    main(WORKS)
