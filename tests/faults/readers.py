"""Every reader of the package with a small valid input, and what may be not finite in what it gives.

A reader that is not here is not fuzzed: add it when it is written.
"""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse as sp

from graphslam.app.folders.generations import current_outputs
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.report.folder import read_folder
from graphslam.app.report.report import make_report
from graphslam.app.run.files import loops_of_run, read_merged_dense
from graphslam.app.run.outputs import read_run_folder, refined_submaps_of
from graphslam.app.submap_sources import submap_source
from graphslam.core.atomic import write_json, write_npz
from graphslam.core.config import read_toml
from graphslam.core.geometry import se2_between
from graphslam.core.gnss import Pseudoranges
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog, Truth
from graphslam.core.map_truth import MapTruth
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import (
    AckermannGeometry,
    Gps,
    LandmarkObservations,
    LaserScans,
    Odometry,
    SteeringControls,
    VelocityControls,
)
from graphslam.core.submap import LandmarkMap, Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.formats import load_npz
from graphslam.evidence.octomap import read_octomap, write_octomap
from graphslam.io.bags import read_bag
from graphslam.io.cards import read_card
from graphslam.io.carmen import read_carmen
from graphslam.io.catalog import load_recording
from graphslam.io.cloud_logs import read_clouds
from graphslam.io.euroc import read_euroc
from graphslam.io.g2o import read_g2o
from graphslam.io.kitti import read_kitti
from graphslam.io.landmark_tables import read_landmark_tables
from graphslam.io.log_store import load_log, save_log
from graphslam.io.network_file import read_network
from graphslam.io.submap_store import SubmapStore, read_submaps, read_truth, write_truth
from graphslam.io.tum import read_tum, read_tum_log, write_tum
from graphslam.maps.refined import base_frames
from graphslam.refine.scans import Scans
from graphslam_frontends.odometry.motion_prior import LEAST
from graphslam_studies.io.kitti_gps import read_kitti_gps
from graphslam_studies.io.lidar_pack import read_lidar_pack
from graphslam_studies.io.mrclam import read_mrclam
from graphslam_studies.io.plaza import read_plaza
from graphslam_studies.io.slsjf import read_slsjf_local_maps
from graphslam_studies.io.smartloc import read_smartloc
from graphslam_studies.io.tuc import read_tuc
from graphslam_studies.io.victoria_park import read_victoria_park
from graphslam_studies.io.victoria_park_published import (
    read_slsjf_network,
    read_slsjf_observations,
    read_ufastslam_detections,
)
from graphslam_studies.montecarlo.folder import StudyFolder
from graphslam_studies.montecarlo.study import open_study
from graphslam_studies.montecarlo.trials import Measurement
from tests.io import small_sources as small
from tests.io.bag_worlds import Messages, write_mcap, write_ros1, write_ros2


@dataclass(frozen=True)
class Reader:
    """One reader.

    Parameters
    ----------
    make : callable
        Writes a valid input into a folder that is there and empty.
    read : callable
        Reads it, and uses what it read as far as a reader's promise goes.
    open_fields : frozenset of str
        Names of fields in which NaN or infinity has a meaning.
    slow : int
        Of that many cases one is done: what takes long is not asked as often.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    open_fields: frozenset[str] = frozenset()
    slow: int = 1


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


TIMES = 10.0 + 0.5 * np.arange(6)


def a_log() -> SensorLog:
    """One stream of every kind."""
    r, t, n = rng(), TIMES, len(TIMES)
    q = np.tile([0.0, 0, 0, 0, 0, 0, 1], (n, 1))
    path = np.column_stack([r.normal(size=(n, 2)), np.zeros(n)])
    unit = np.eye(3)
    streams: dict[str, Any] = {
        "laser": LaserScans(times=t, ranges=r.uniform(1, 9, (n, 5)), bearings=np.linspace(-1, 1, 5), max_range=10.0),
        "rays": RangeScans(
            times=t, ranges=r.uniform(1, 9, (n, 3)), directions=unit, beam_times=np.zeros(3), max_range=10.0, sigma=0.1
        ),
        "clouds": PointClouds.from_arrays(t, r.normal(size=(12, 3)), np.arange(0, 13, 2)),
        "imu": Imu(
            times=t,
            angular_rate=r.normal(size=(n, 3)),
            specific_force=r.normal(size=(n, 3)),
            noise=ImuNoise(
                gyro=1e-3, gyro_bias=1e-3, gyro_walk=1e-4, accelerometer=1e-2, accelerometer_bias=0.1,
                accelerometer_walk=1e-3,
            ),
            attitude=np.zeros((n, 2)),
        ),
        "steering": SteeringControls(
            times=t, speed=np.ones(n), steering=np.zeros(n), geometry=AckermannGeometry(wheelbase=2.8)
        ),
        "wheels": VelocityControls(times=t, speed=np.ones(n), yaw_rate=np.zeros(n)),
        "odometry": Odometry(times=t, increments=q, covariances=np.tile(0.01 * np.eye(6), (n, 1, 1))),
        "gps": Gps(times=t, positions=r.normal(size=(n, 2)), sigma=np.ones(n), lever=np.zeros(2)),
        "uneven": Gps.upright(
            times=t, positions=r.normal(size=(n, 3)), horizontal=1.0, vertical=2.0, lever=np.zeros(3)
        ),
        "satellites": Pseudoranges(
            times=t, offsets=np.arange(7), ranges=np.full(6, 2e7), sigmas=np.ones(6), satellites=2e7 * np.ones((6, 3)),
            ids=np.arange(6), systems=np.ones(6, np.int64), elevation=np.full(6, 0.5), density=np.full(6, 45.0),
        ),
        "marks": LandmarkObservations(
            times=t, offsets=np.arange(7), ranges=np.ones(6), bearings=np.zeros(6), sigmas=np.full((6, 2), 0.1),
            ids=np.arange(6), max_range=30.0,
        ),
        "path": Trajectory(t, path, np.tile(0.01 * np.eye(3), (n, 1, 1))),
    }  # fmt: skip
    truth = Truth(Trajectory(t, path), landmark_ids=np.arange(2), landmarks=r.normal(size=(2, 2)))
    return SensorLog(name="log", streams=streams, truth=truth, read={"gps": 6}, dropped={"gps: bad": 1}, meta={"a": 1})


def a_log_folder(root: Path) -> None:
    save_log(a_log(), root)


def read_a_log(root: Path) -> Any:
    log = load_log(root)
    log._repr_html_()
    return log, [list(s) for s in log.streams.values() if isinstance(s, PointClouds)]


def some_submaps() -> list[Submap]:
    """A map with landmarks and a covariance, one with an information matrix and a match, one without landmarks."""
    r = rng()
    out = []
    for key in range(3):
        n = 3 if key < 2 else 0
        root = r.normal(size=(3 + 2 * n, 3 + 2 * n))
        P = 0.01 * (root @ root.T + np.eye(3 + 2 * n))
        t = 10.0 * key + np.arange(4.0)
        common: dict[str, Any] = {
            "interval": (t[0], t[-1]),
            "trajectory": Trajectory(
                t, np.column_stack([np.arange(4.0), np.zeros((4, 2))]), np.tile(P[:3, :3], (4, 1, 1))
            ),
            "uses": frozenset({"laser"}),
            "report": {"scans": 4, "flag": ["moment"]},
        }
        pose = np.array([3.0, 0, 0])
        if key == 2:
            match = Match(target=0, T_target_here=np.zeros(3), covariance=0.01 * np.eye(3), fitness=0.9, support=0.8)
            common |= {"matches": (match,), "cloud": r.normal(size=(5, 2))}
            out.append(Submap(key=key, exit_pose=pose, exit_covariance=0.01 * np.eye(3), **common))
            continue
        whole = {"covariance": P} if key == 0 else {"information": sp.csc_matrix(np.linalg.inv(P))}
        detections = np.array([[0, 0], [1, 1], [2, 2]])
        marks = LandmarkMap(
            ids=np.arange(n), exit_pose=pose, positions=r.normal(size=(n, 2)), detections=detections, **whole
        )
        out.append(Submap.from_landmarks(key, marks, **common))
    return out


def submap_store(root: Path) -> None:
    store = SubmapStore(root / "submaps")
    for s in some_submaps():
        store.append(s)
    truth = MapTruth(
        keys=np.arange(3), exit_poses=np.zeros((3, 3)), landmark_ids=np.arange(2), landmarks=np.zeros((2, 2))
    )
    write_truth(root, truth)


def read_store(root: Path) -> Any:
    found = read_submaps(root)
    for s in found:
        s._repr_html_()
    return found, read_truth(root), SubmapStore(root / "submaps").complete_prefix()


@cache
def finished_run() -> Path:
    """A landmark run, made once; of its pictures and its page nothing is read again."""
    import tempfile

    from graphslam.app.report import report
    from graphslam.app.run import figures
    from graphslam.app.run.pipeline import run
    from graphslam.app.worlds import simulate

    out = Path(tempfile.mkdtemp(prefix="fuzz-run-")) / "run"
    log = simulate("landmark-field", preset="quick", seed=1, laps=0.5)
    gps = Gps(times=log.interval[0] + np.arange(8.0), positions=np.zeros((8, 2)), sigma=np.ones(8), lever=np.zeros(2))
    import pytest

    with pytest.MonkeyPatch.context() as patch:  # pictures take longer than the run
        patch.setattr(figures, "save_figures", lambda *_: None)
        patch.setattr(report, "add_report", lambda *_: None)
        run(log, frontend="rbpf-ekf", out=out, progress=False, config={"frontend": {"particles": 5}})
    arrays = {"times": gps.times, "positions": gps.positions, "sigma": gps.sigma, "lever": gps.lever}
    write_npz(out / "fixes.npz", {"format": "graphslam.fixes/1", **arrays})
    residuals = {
        "times": gps.times, "residuals": gps.positions, "points": gps.positions, "T_gps_map": np.zeros(3),
        "lever": gps.lever, "fitted": np.int64(3), "outside": np.int64(0), "in_gap": np.int64(0),
    }  # fmt: skip
    write_npz(out / "gps_all.npz", {"format": "graphslam.gps-residuals/1", **residuals})
    from graphslam.loops.ledger import LoopDecision

    loop = LoopDecision(
        loop=0, verdict="accepted", why="because", i=0, j=1, submap_i=0, submap_j=1, source="proximity", factor_id=9,
        T_ij=[1.0, 0.0, 0.0], covariance=np.eye(3).tolist(), gates={"fitness": 0.5, "entries": [[0, 1]]}, chi2=1.0,
        score=0.5, gain=1.0, effect=0.1, effect_predicted=0.1, effect_earlier=0.0,
    )  # fmt: skip
    match = {"event": "between", "group": "match", "factor_id": 3, "i": 0, "j": 1, "target": 0, "submap": 1,
             "support": 0.5, "fitness": None}  # fmt: skip
    with open(out / "events.jsonl", "a") as stream:
        for event in (
            loop.event(),
            match,
            {"event": "removed", "factor_id": 3, "reason": "x"},
            {"event": "split", "new": 4},
        ):
            stream.write(json.dumps(event) + "\n")
    return out


def run_folder(root: Path) -> None:
    shutil.copytree(finished_run(), root, dirs_exist_ok=True, symlinks=True)


def read_run(root: Path) -> Any:
    run = read_run_folder(root)
    run._repr_html_()
    source = submap_source(run)
    return run, loops_of_run(root).decisions, source


def refined_run(root: Path) -> None:
    """The same run as if its path had been refined by scans."""
    run_folder(root)
    at = current_outputs(root)
    run = read_run_folder(root)
    frames = base_frames(run.map)
    store = SubmapStore(at / "refined")
    for s, a, b in zip(run.submaps, frames, frames[1:]):
        t = np.array(s.interval)
        pose = se2_between(a, b)
        path = Trajectory(t, np.array([np.zeros(3), pose]), np.tile(0.01 * np.eye(3), (2, 1, 1)))
        store.append(
            Submap(
                key=s.key, interval=s.interval, exit_pose=pose, exit_covariance=0.01 * np.eye(3), trajectory=path,
                cloud=np.ones((4, 2)), uses=s.uses, report={"refined": True},
            )
        )  # fmt: skip
    write_tum(at / "trajectory_graph.tum", run.map.trajectory)
    facts = json.loads((at / "run.json").read_text())
    turn = {
        "distance": 0.3,
        "range_sigma": 0.03,
        "surface_sigma": 0.01,
        "pairs": 9,
        "passes": 4,
        "spread": 0.02,
        "moved": 0.01,
    }
    facts["refine"] = {
        "rounds": [turn], "agreement": [0.7, 0.9], "constants": {"scale": {"value": 0.01, "sigma": 0.001}},
        "yaw_bias": [[0.0, 1e-3], [30.0, 2e-3]], "left_apart": [[1.0, 9.0]], "motion_chi2_per_dof": 0.5,
    }  # fmt: skip
    write_json(at / "run.json", facts)
    some_scans(at)


def some_scans(root: Path) -> None:
    """Beams of three steps in space."""
    r, n = rng(), 3
    q = np.tile([0.3, 0, 0, 0, 0, 0, 1.0], (n, 1))
    Scans(
        times=TIMES[:n],
        odometry=Odometry(times=TIMES[:n], increments=q, covariances=np.tile(1e-4 * np.eye(6), (n, 1, 1))),
        offsets=np.array([0, 4, 8, 12]),
        points=r.normal(size=(12, 3)).astype(np.float32),
        origins=np.zeros((12, 3), np.float32),
        returns=np.ones(12, np.bool_),
        ages=np.zeros(12, np.float32),
        max_range=8.0,
        biases=LEAST,
        tilt=np.zeros((n, 2)),
        tilt_sigma=1e-3,
        tilt_time=5.0,
    ).save(root / "scans.npz")


def read_scans(root: Path) -> Any:
    """With all that a refinement asks of them."""
    scans = Scans.load(root / "scans.npz")
    return scans, [scans.scan(k) for k in range(len(scans))], scans.path_length, scans.group


def read_refined(root: Path) -> Any:
    run = read_run_folder(root)
    return run, run.verdict, refined_submaps_of(run), Scans.load(current_outputs(root) / "scans.npz")


def report_of_run(root: Path) -> Any:
    return make_report(root)


def read_config(root: Path) -> Any:
    """What a resumed run does first."""
    from graphslam.app.run.files import read_options
    from graphslam.backend.config import BackEndConfig, GpsOptions
    from graphslam.core.config import build_config

    values = read_options(root)
    for part, kind in (("backend", BackEndConfig), ("gps", GpsOptions)):
        build_config(kind, values.get(part, {}), part)
    return read_toml(root / "config.toml")


def just_config(root: Path) -> None:
    shutil.copy(finished_run() / "config.toml", root)


def merged_folder(root: Path) -> None:
    folder = OutputFiles(root)
    path = np.column_stack([np.arange(5.0), np.zeros((5, 2))])
    write_tum(root / "trajectory_a.tum", Trajectory(TIMES[:5], path))
    arrays = {
        "format": "graphslam.merged-submaps/1", "sessions": np.array(["a", "b"]), "keys": np.arange(4),
        "session_of_submap": np.array([0, 0, 1, 1]), "bases": path, "nodes": path,
        "base_covariances": np.tile(np.eye(3), (5, 1, 1)),
    }  # fmt: skip
    write_npz(root / "merged.npz", arrays)
    folder.write_lines("events.jsonl", [{"event": "between", "group": "session", "i": 0, "j": 3, "factor_id": 2}])
    folder.write_json("metrics.json", [{"key": "sessions", "value": 2.0, "unit": "", "direction": "none"}])
    folder.write_text("ledger.csv", "factor_id,factor,stream,t_start,t_end,kind,note\n0,submap 0,laser,0.0,1.0,m,\n")
    session = {"name": "a", "source": "x", "submaps": 2, "common_landmarks": 3, "rejected": 0}
    merge = {
        "format": "graphslam.merge/1",
        "by": "place",
        "solver": "batch",
        "sessions": [session],
        "graph": {"nodes": 5},
    }
    folder.write_json("merge.json", merge)


def read_merged(root: Path) -> Any:
    found = read_folder(root, root)
    return found.values(), read_merged_dense(root), read_tum(root / "trajectory_a.tum")


def study_folder(root: Path) -> None:
    names = {"name": "combined-slam", "seed": 1, "quick": True, "worlds": {"A": "ab12"}, "versions": {"numpy": "2"}}
    write_json(root / "study.json", {"format": "graphslam.study/1", **names})
    folder = StudyFolder(root)
    for k in range(3):
        values = [Measurement("EIF", q, 1.0 + k, submap=j) for q in ("pose_nees", "rms") for j in range(2)]
        folder.write_trial("A", k, k, [*values, Measurement("EIF", "seconds", 0.1, timing=True)], source="abc")
    folder.write_trial("A", 9, 9, error="broke", details="here")


def network(lines: str, name: str, pack: Callable[[bytes], bytes] | None = None) -> Callable[[Path], None]:
    def make(root: Path) -> None:
        data = lines.encode()
        (root / name).write_bytes(data if pack is None else pack(data))

    return make


I3, I6 = "1 0 0 1 0 1", " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
G2O_2D = (
    "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(5))
    + "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 {I3}\n" for k in range(4))
    + "FIX 0\nVERTEX_XY 10 1 2\nEDGE_SE2_XY 0 10 1 2 1 0 1\nEDGE_SE2_XY 2 10 -1 2 1 0 1\n"
)
G2O_POLAR = "".join(f"VERTEX_SE2 {k} {k} 0 0\n" for k in range(3)) + (
    f"EDGE_SE2 0 1 1 0 0 {I3}\nEDGE_SE2 1 2 1 0 0 {I3}\nBR 0 9 0.1 2 0.1 0.2\nBR 1 9 0.2 1 0.1 0.2\n"
)
G2O_3D = "".join(f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1\n" for k in range(4)) + "".join(
    f"EDGE_SE3:QUAT {k} {k + 1} 1 0 0 0 0 0 1 {I6}\n" for k in range(3)
)
TORO = "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nVERTEX2 2 2 0 0\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\nEDGE2 1 2 1 0 0 1 0 1 1 0 0\n"


def tum(root: Path) -> None:
    write_tum(
        root / "path.tum",
        Trajectory(TIMES, np.column_stack([rng().normal(size=(6, 3)), np.tile([0.0, 0, 0, 1], (6, 1))])),
    )


def carmen(root: Path) -> None:
    r = rng()
    out = ["# message formats"]
    for k in range(8):
        ranges = " ".join(f"{x:.2f}" for x in r.uniform(1, 20, 180))
        out.append(f"ODOM {0.1 * k} 0 0 0 0 0 {100 + 0.2 * k} host {0.2 * k}")
        out.append(f"FLASER 180 {ranges} {0.1 * k} 0 0 {0.1 * k} 0 0 {100 + 0.2 * k:.6f} host {0.2 * k:.6f}")
    (root / "house.clf.bz2").write_bytes(bz2.compress(("\n".join(out) + "\n").encode()))


def npy(a: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, a)
    return out.getvalue()


def lidar_pack(root: Path) -> None:
    counts = [5, 0, 7, 3, 6]
    units = rng().integers(-3000, 3000, size=(3, sum(counts))).astype(np.int16)
    (root / "xyz_i16_planar.npy.xz").write_bytes(lzma.compress(npy(units)))
    (root / "scan_offsets.npy").write_bytes(npy(np.cumsum([0, *counts])))
    rows = np.tile(np.eye(4)[:3].ravel(), (5, 1))
    np.savetxt(root / "odom_poses.txt", rows)
    np.savetxt(root / "optimized_poses.txt", rows)
    np.savetxt(root / "times.txt", 100.0 + 0.5 * np.arange(5))


def read_pack(root: Path) -> Any:
    log = read_lidar_pack(root, step=0.004)
    return log, list(log["clouds"])


def mrclam(root: Path) -> None:
    for name, text in {
        "Barcodes.dat": "# Subject # Barcode #\n 1 5\n 2 14\n 6 63\n 7 81\n",
        "Landmark_Groundtruth.dat": "# subject x y sx sy\n 6 1.0 2.0 1e-4 1e-4\n 7 3.0 -1.0 1e-4 1e-4\n",
        "Robot2_Odometry.dat": "# t v w\n"
        + "".join(f"{100 + 0.1 * k:.3f}\t 0.1 \t {0.01 * k:.3f}\n" for k in range(41)),
        "Robot2_Measurement.dat": "# t s r b\n101.0 63 2.5 0.10\n101.0 81 3.5 -0.2\n101.2 63 2.4 0.1\n103.0 14 1.0 0\n",
        "Robot2_Groundtruth.dat": "# t x y th\n"
        + "".join(f"{99 + 0.1 * k:.3f} {0.01 * k:.4f} 0.0 0.0\n" for k in range(60)),
    }.items():
        (root / name).write_text(text)


def plaza(root: Path) -> None:
    t = 10.0 + 0.2 * np.arange(1, 31)
    np.savetxt(root / "Plaza1_DR.txt", np.column_stack([t, np.full(30, 0.2), np.zeros(30)]))
    rows = [(11.0, 2, 5, 20.0), (11.5, 2, 0, 30.0), (11.5, 2, 1, 12.0), (11.2, 2, 6, 8.0), (15.5, 2, 1, 9.0)]
    np.savetxt(root / "Plaza1_TD.txt", rows)
    gt = np.column_stack([np.concatenate([[9.99], t]), np.zeros((31, 3))])
    scipy.io.savemat(root / "Plaza1_.mat", {"GT": gt, "TL": np.array([[6, 1.0, 2.0], [0, 3.0, 4.0]])})


def euroc(root: Path) -> None:
    t = (1.4e9 + 0.005 * np.arange(40)) * 1e9
    unit = np.column_stack([t, np.tile([0.1, 0, 0, 9.1, 0.1, -3.3], (40, 1))])
    np.savetxt(
        root / "imu0_data.csv",
        unit,
        delimiter=",",
        fmt=["%d", *["%.6g"] * 6],
        header="timestamp [ns],w_RS_S_x [rad s^-1],y,z,a,b,c",
        comments="#",
    )
    prism = np.column_stack([t[::10], rng().normal(size=(4, 3))])
    head = "timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]"
    np.savetxt(root / "leica0_data.csv", prism, "%.17g", ",", header=head, comments="#")
    densities = "gyroscope_noise_density: 1.7e-4", "gyroscope_random_walk: 2e-5 # [rad]"
    densities += "accelerometer_noise_density: 2e-3", "accelerometer_random_walk: 3e-3"
    (root / "imu0_sensor.yaml").write_text("\n".join(densities) + "\n")
    rows = "1.0, 0.0, 0.0, 0.07,\n 0.0, 1.0, 0.0, -0.02,\n 0.0, 0.0, 1.0, -0.12,\n 0.0, 0.0, 0.0, 1.0"
    (root / "leica0_sensor.yaml").write_text(f"T_BS:\n  cols: 4\n  data: [{rows}]\n")


def kitti_gps(root: Path) -> None:
    names = "BodyPtx BodyPty BodyPtz BodyPrx BodyPry BodyPrz AccelerometerSigma GyroscopeSigma IntegrationSigma"
    names += " AccelerometerBiasSigma GyroscopeBiasSigma AverageDeltaT\n"
    (root / "KittiEquivBiasedImu_metadata.txt").write_text(
        names + "0 0 0 0 0 0 0.01 0.000175 0 0.000167 2.9e-006 0.01\n"
    )
    rows = "".join(f"{46534 + k}.25,{k}.5,{2 * k}.25,0.1\n" for k in range(20))
    (root / "KittiGps_converted.txt").write_text("Time,X,Y,Z\n" + rows)
    rows = "".join(f"{46534 + 0.1 * k:.2f} 0.1 0.0 0.1 9.8 0.001 0.0 0.002\n" for k in range(20))
    head = "Time dt accelX accelY accelZ omegaX omegaY omegaZ\n"
    (root / "KittiEquivBiasedImu.txt").write_text(head + rows)


def smartloc(root: Path) -> None:
    lines, truth = [], []
    for k in range(20):
        t = 0.2 * k
        lines.append(f"odom3 {t:.1f} 5.8 0 0 0 0 -0.006 0.0025 0.0009 0.0009 4e-06 4e-06 4e-06")
        for j, (x, y, z) in enumerate([(14.5e6, 2.8e6, 21.8e6), (18.1e6, 11.5e6, 13.7e6), (-5.9e6, -9.5e6, 22.9e6)]):
            lines.append(f"pseudorange3 {t:.1f} {2e7 + j} 25 {x} {y} {z} {12 + 100 * j} {1 + 3 * (j > 1)} 8.5 49")
        truth.append(f"point3 {t:.1f} 3785108.1 {899901.5 + k} 5037234.4 0 0 0 0 0 0 0 0 0")
    (root / "Berlin_Potsdamer_Platz_Input.txt").write_text("\n".join(lines) + "\n")
    (root / "Berlin_Potsdamer_Platz_GT.txt").write_text("\n".join(truth) + "\n")


def slsjf(root: Path) -> None:
    for k in (1, 2):
        r = np.random.default_rng(k)
        root7 = r.normal(size=(7, 7))
        state = np.column_stack([[0, 0, 0, 5, 5, 6, 6], r.normal(size=7)])
        content = {"localmap_st": state, "localmap_P": root7 @ root7.T + np.eye(7)}
        scipy.io.savemat(root / f"localmap_{k}.mat", content, do_compression=k == 1)


def slsjf_published(root: Path) -> None:
    rows = np.column_stack([21819.0 + 213.0 * np.arange(9), np.full((9, 2), 5.0), np.zeros((9, 2)), np.arange(9)])
    scipy.io.savemat(root / "slsjf_data_sensor_clean_clean.mat", {"data_sensor_clean_clean": rows})
    net = np.array(
        [[1.0, k, k + 1, 1, 0, 0, 1, 0, 0, 1, 0, 1] for k in range(3)] + [[0.0, 1, 7, 2, 1, 0.1, 0, 0.1, 0, 0, 0, 0]]
    )
    scipy.io.savemat(root / "slsjf_VicPark_clean_data.mat", {"VicPark_clean_data": net})


def ufastslam(root: Path) -> None:
    r = rng()
    distance = np.zeros((30, 18))
    distance[:, :3] = r.uniform(2, 40, (30, 3))
    angle = np.where(distance > 0, 0.5, 0.0)
    stamp = 21819.0 + 213.0 * np.arange(30)[:, None]
    for name, table in (
        ("ufastslam_ObservationDistance", distance),
        ("ufastslam_ObservationAngle_90", angle),
        ("ufastslam_lasersampling", stamp),
    ):
        text = "\n".join(" ".join(f"{v:.6e}" for v in row) for row in table)
        (root / f"{name}.txt.gz").write_bytes(gzip.compress(text.encode(), mtime=0))


def tuc(root: Path) -> None:
    drive = [f"odom2 {0.1 * k:.1f} 1.0 0.0 0.5 0.0025 0.0025 0.0001" for k in range(51)]
    (root / "Lecture_Hall_Input.txt").write_text("\n".join([*drive, "loop 4.25 1.13 0.75"]) + "\n")
    truth = "\n".join(f"point2 {0.5 * k:.1f} {0.5 * k:.2f} 0.0 0 0 0 0" for k in range(11)) + "\n"
    (root / "Lecture_Hall_GT.txt.gz").write_bytes(gzip.compress(truth.encode(), mtime=0))


def read_lecture_hall(root: Path) -> Any:
    log = read_tuc(root)
    return log, log.to_network(spacing=1.0)


def victoria_park(root: Path) -> None:
    r = rng()
    laser = np.column_stack([0.852 + 0.213 * np.arange(4), r.uniform(1, 81.9, (4, 361))])
    drs = np.column_stack([0.973 + 0.025 * np.arange(40), r.uniform(0, 3, 40), np.zeros(40)])
    gps = np.column_stack([0.2 * np.arange(10), r.normal(size=(10, 2))])
    (root / "LASER.txt").write_text("\t".join(f"{v:.3f}" for v in laser.ravel()) + "\t")
    text = "".join(f"{a:.3f}\t{b:6.3f}\t{c:.4f}\r\n" for a, b, c in drs)
    (root / "DRS.txt.gz").write_bytes(gzip.compress(text.encode(), mtime=0))
    (root / "GPS.txt").write_text("".join(f"{a:.3f}\t{b:.2f}\t{c:.2f}\r\n" for a, b, c in gps))


CARD = """format = "graphslam.card/1"
name = "toy"
title = "t"
kind = "sensor-log"
folder = "toy"
records = "r"
source = "https://example.org"
obtained_from = "o"
citation = "c"
licence = "l"
terms = "t"
caveats = ["c"]
files = [ { path = "a.txt.gz", bytes = 3, sha256 = "HASH", content_bytes = 9, content_sha256 = "HASH" } ]
""".replace("HASH", "0" * 64)


def a_card(root: Path) -> None:
    (root / "toy.toml").write_text(CARD)


def a_grid() -> Any:
    from tests.reference.evidence_maps import cube, grid_of_map

    return grid_of_map(cube((0, 0, 0), 16, 9) | cube((24, 24, 24), 8, -3) | {(-1, 0, 0): 2})


def evidence(root: Path) -> None:
    a_grid().save(root / "map.grid.npz")


def read_evidence(root: Path) -> Any:
    grid = load_npz(root / "map.grid.npz")
    return grid.voxel_size, np.array(grid.bounding_box() or np.zeros(0))


def octomap(ending: str) -> Callable[[Path], None]:
    def make(root: Path) -> None:
        write_octomap(a_grid(), root / f"map.{ending}")

    return make


def read_octree(ending: str) -> Callable[[Path], Any]:
    def read(root: Path) -> Any:
        grid = read_octomap(root / f"map.{ending}")
        return grid.voxel_size, np.array(grid.bounding_box() or np.zeros(0))

    return read


def clouds_of(ending: str, table: str) -> Callable[[Path], None]:
    """A folder of a few clouds of one format."""

    def make(root: Path) -> None:
        small.cloud_folder(root, ending, table=table, n=5, spacing=1.0)

    return make


def with_points(read: Callable[[Path], SensorLog]) -> Callable[[Path], Any]:
    """A log, and all its points and their times."""

    def used(root: Path) -> Any:
        log = read(root)
        clouds = [s for s in log.streams.values() if isinstance(s, PointClouds)]
        return log, [(s.cloud(k), s.ages(k)) for s in clouds for k in range(len(s))]

    return used


def bag(form: str) -> Callable[[Path], None]:
    """Laser or clouds, odometry, IMU, fixes and transforms."""

    def make(root: Path) -> None:
        m = Messages(ros1=form == "ros1")
        place = np.array([0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
        pairs = [("base_link", f, place) for f in ("lidar", "laser", "imu")]
        messages = [("/tf_static", "tf2_msgs/msg/TFMessage", small.T0, m.transforms(small.T0, pairs))]
        for k, (t, pose) in enumerate(zip(small.stamps(6), small.poses(6))):
            messages += [
                ("/odom", "nav_msgs/msg/Odometry", t, m.odometry(t, pose)),
                ("/imu", "sensor_msgs/msg/Imu", t, m.imu(t, [0, 0, 0.2], [0, 0, 9.8])),
                ("/fix", "sensor_msgs/msg/NavSatFix", t, m.fix(t, (50 + 1e-5 * k, 8.0, 100.0))),
            ]
            if form == "ros2":
                messages.append(("/scan", "sensor_msgs/msg/LaserScan", t, m.scan(t, np.full(20, 3.0), -1.0, 0.1)))
            else:
                xyz = rng().uniform(-9, 9, (30, 3))
                messages.append(("/points", "sensor_msgs/msg/PointCloud2", t, m.cloud(t, xyz, frame="lidar")))
        write = {"ros1": write_ros1, "ros2": write_ros2, "mcap": write_mcap}[form]
        write(root / {"ros1": "a.bag", "ros2": "a", "mcap": "a.mcap"}[form], messages)

    return make


def csv_tables(root: Path) -> None:
    small.tables(root, seconds=12.0)


NO_FIGURE = frozenset({"value", "metrics", "gates"})  # a metric or a figure of a loop may be no number, which is said
LOOPS = frozenset(
    {"score", "gain", "chi2", "weight", "effect", "effect_predicted", "effect_earlier", "fitness", "support"}
)
RANGES = frozenset({"ranges", "sigmas", "max_range"})

READERS: dict[str, Reader] = {
    "log-store": Reader(a_log_folder, read_a_log, RANGES),
    "submap-store": Reader(submap_store, read_store),
    "run": Reader(run_folder, read_run, NO_FIGURE | LOOPS),
    "refined-run": Reader(refined_run, read_refined, NO_FIGURE | LOOPS, slow=3),
    "refined-report": Reader(refined_run, report_of_run, frozenset(), slow=100),
    "scans": Reader(some_scans, read_scans),
    "run-report": Reader(run_folder, report_of_run, frozenset(), slow=100),
    "run-config": Reader(just_config, read_config, frozenset({"*"})),
    "merged": Reader(merged_folder, read_merged),
    "study": Reader(study_folder, open_study, frozenset({"value", "table", "timings"}), slow=1),
    "g2o-2d": Reader(network(G2O_2D, "a.g2o"), lambda p: read_network(p / "a.g2o")),
    "g2o-polar": Reader(network(G2O_POLAR, "a.g2o"), lambda p: read_g2o(p / "a.g2o", repair=True)),
    "g2o-3d": Reader(network(G2O_3D, "a.g2o.xz", lzma.compress), lambda p: read_network(p / "a.g2o.xz")),
    "toro": Reader(network(TORO, "a.graph"), lambda p: read_network(p / "a.graph")),
    "tum": Reader(tum, lambda p: read_tum(p / "path.tum")),
    "carmen": Reader(carmen, read_carmen, RANGES),
    "lidar-pack": Reader(lidar_pack, read_pack),
    "mrclam": Reader(mrclam, lambda p: read_mrclam(p, robot=2), RANGES),
    "plaza": Reader(plaza, read_plaza, RANGES),
    "euroc": Reader(euroc, read_euroc),
    "kitti-gps": Reader(kitti_gps, read_kitti_gps),
    "smartloc": Reader(smartloc, read_smartloc),
    "slsjf-maps": Reader(slsjf, read_slsjf_local_maps),
    "slsjf-data": Reader(
        slsjf_published, lambda p: (read_slsjf_network(p), read_slsjf_observations(p)), frozenset({"max_range"})
    ),
    "ufastslam": Reader(ufastslam, read_ufastslam_detections, frozenset({"max_range"})),
    "tuc": Reader(tuc, read_lecture_hall),
    "victoria-park": Reader(victoria_park, read_victoria_park, RANGES),
    "card": Reader(a_card, lambda p: read_card(p / "toy.toml")),
    "evidence": Reader(evidence, read_evidence),
    "octomap-bt": Reader(octomap("bt"), read_octree("bt")),
    "octomap-ot": Reader(octomap("ot"), read_octree("ot")),
    "tum-log": Reader(tum, read_tum_log),
    "carmen-robotlaser": Reader(lambda p: small.carmen(p / "a.log", mixed=True) and None, read_carmen, RANGES),
    "carmen-rawlaser": Reader(lambda p: small.carmen(p / "a.log", "RAWLASER1") and None, read_carmen, RANGES),
    "euroc-folder": Reader(lambda p: small.euroc(p) and None, read_euroc),
    "landmark-tables": Reader(csv_tables, read_landmark_tables, RANGES),
    "clouds-bin": Reader(clouds_of("bin", "tum"), with_points(read_clouds)),
    "clouds-ply": Reader(clouds_of("ply-times", "kitti"), with_points(read_clouds)),
    "clouds-ply-text": Reader(clouds_of("ply-ascii", ""), with_points(read_clouds)),
    "clouds-pcd": Reader(clouds_of("pcd-lzf", ""), with_points(read_clouds)),
    "clouds-las": Reader(clouds_of("las", ""), with_points(read_clouds), slow=3),
    "clouds-laz": Reader(clouds_of("laz", ""), with_points(read_clouds), slow=3),
    "kitti-odometry": Reader(lambda p: small.kitti_odometry(p, 5) and None, with_points(read_kitti)),
    "kitti-raw": Reader(lambda p: small.kitti_raw(p, 5) and None, with_points(read_kitti)),
    "bag-ros1": Reader(bag("ros1"), with_points(read_bag), RANGES, slow=3),
    "bag-ros2": Reader(bag("ros2"), with_points(read_bag), RANGES, slow=3),
    "bag-mcap": Reader(bag("mcap"), with_points(read_bag), RANGES, slow=3),
    "recognised": Reader(clouds_of("bin", "tum"), with_points(lambda p: load_recording(p))),
}
