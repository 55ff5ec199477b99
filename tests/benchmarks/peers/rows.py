"""The rows of ``bench_peers``: work, peer, cases, figures and goals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from tests.benchmarks.peers import inputs


class Goal(NamedTuple):
    """A limit on the means of a figure: ``ratio`` ours / peer, ``value`` of ours, ``excess`` of ours over the peer."""

    figure: str
    limit: float
    kind: str = "ratio"

    def __str__(self) -> str:
        what = {"ratio": "", "value": "value ", "excess": "difference "}[self.kind]
        return f"{what}≤ {self.limit:g}"


@dataclass(frozen=True)
class Row:
    """One comparison.

    Parameters
    ----------
    packages : tuple of str
        What pip installs for this row's peer; empty: the peer runs in our environment (GTSAM is a dependency).
    environment : str
        Name of the environment.
    ours, theirs : str
        Works of ``ours.py`` and ``theirs.py``.
    quick : tuple of str
        Cases of ``--quick``.
    """

    name: str
    peer: str
    packages: tuple[str, ...]
    environment: str
    ours: str
    theirs: str
    cases: tuple[str, ...]
    make: inputs.Make
    goals: tuple[Goal, ...]
    score: inputs.Score | None = None
    shown: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()


CPU, MEMORY, ERROR = (lambda m: Goal("work", m)), (lambda m: Goal("peak", m)), Goal("error", 1.0)
LIDAR = (*inputs.PACKS, "sim-hand", "sim-wheels")
SLAM = (("kiss-slam", "libusb-package", "pillow"), "kiss-slam")  # its pipeline needs PIL, undeclared
CORES = ("segslam", "relaxation", "refinement", "collapse")
FILES = (
    "sphere_bignoise_vertex3", "sphere2500", "parking-garage", "smallGrid3D", "kitti_00", "kitti_02", "kitti_06",
    "kitti_07", "intel", "input_INTEL_g2o", "input_M3500_g2o", "manhattan",
)  # fmt: skip

ROWS = (
    Row("lidar-map", "kiss-slam", *SLAM, "lidar-map", "kiss-slam", LIDAR, inputs.scans,
        (CPU(1.5), MEMORY(1.5), ERROR), inputs.ate, ("whole",)),
    Row("lidar-path", "kiss-slam", *SLAM, "lidar-path", "kiss-slam", LIDAR, inputs.scans,
        (CPU(1.5), MEMORY(1.5), ERROR), inputs.ate, ("whole",)),
    Row("odometry", "kiss-icp", ("kiss-icp",), "kiss-icp", "odometry-scans", "kiss-icp", LIDAR, inputs.scans,
        (CPU(1.0), ERROR), inputs.ate, ("peak",), ("sim-quick",)),
    Row("odometry", "genz-icp", ("genz-icp",), "genz-icp", "odometry-scans", "genz-icp", LIDAR, inputs.scans,
        (CPU(1.0), ERROR), inputs.ate, ("peak",)),
    Row("odometry-imu", "rko-lio", ("rko-lio",), "rko-lio", "odometry", "rko-lio", LIDAR[4:], inputs.scans,
        (CPU(1.0), ERROR), inputs.ate, ("peak",)),
    Row("first-run", "second run", (), "", "first-run", "second-run", ("sim-wheels",), inputs.scans,
        (Goal("whole", 20.0, "excess"),)),
    Row("isam2", "GTSAM (QR)", (), "", "isam2", "isam2-gtsam", ("2000", "10000"), inputs.numbers,
        tuple(Goal(figure, 2.0) for figure in ("update", "last 1,000", "with factors")) + (ERROR,), inputs.nodes,
        ("median",), ("200",)),
    Row("join-isam2", "batch", (), "", "join-isam2", "join-batch", ("700",), inputs.numbers,
        (Goal("work", 5.0, "value"),), None, ("error",)),
    Row("join-isam2", "batch", (), "", "join-isam2", "join-batch", ("6898",), inputs.numbers,
        (Goal("work", 120.0, "value"),), None, ("error",)),
    Row("join-batch", "tree", (), "", "join-batch", "join-tree", ("700", "6898"), inputs.numbers,
        (ERROR,), None, ("work",)),
    Row("solve", "GTSAM", (), "", "solve", "solve-gtsam", FILES, inputs.network,
        (CPU(1.3),), None, ("error",), ("smallGrid3D",)),
    Row("solve", "g2o-python", ("g2o-python", "numpy<2"), "g2o", "solve-arrays", "g2o", FILES, inputs.network,
        (CPU(1.3),), inputs.objective, ("error",)),
    Row("grid", "OctoMap", ("octomap-python",), "octomap", "grid", "octomap", ("tunnel", "street", "hall"),
        inputs.scene, (CPU(1.0),), None, ("cold", "peak")),
    Row("grid", "Bonxai (in kiss-slam)", *SLAM, "grid", "bonxai", ("tunnel", "street", "hall"),
        inputs.scene, (CPU(1.0),), None, ("cold", "peak")),
    Row("planar", "its first half", (), "", "planar", "planar-half", ("radish-intel",), inputs.numbers,
        (CPU(2.144),), None, ("peak",)),  # 2^1.1: exponent of time
    Row("planar", "its first quarter", (), "", "planar", "planar-quarter", ("simulated",), inputs.name,
        (CPU(4.595),), None, ("peak",)),  # 4^1.1
    Row("two-cores", "one thread", (), "", "two-threads", "one-thread", CORES, inputs.name,
        (Goal("elapsed", 0.588),), None, ("work",)),  # 1 / 1.7, by the clock: it needs two free cores
    Row("import", "kiss-slam", *SLAM, "import", "kiss-slam-import", ("gs.simulate",), inputs.nothing,
        (Goal("whole", 1.0), MEMORY(1.0))),
    Row("ate", "evo", ("evo",), "evo", "ate", "evo", ("10000",), inputs.paths,
        (CPU(1.0),), None, ("cold", "ATE [m]", "RPE [m]"), ("500",)),
    Row("register", "Open3D", ("open3d", "libusb-package"), "open3d", "register", "open3d", inputs.PACKS[:3],
        inputs.pairs, (CPU(1.0), ERROR), inputs.relative, ("cold", "peak")),
)  # fmt: skip
