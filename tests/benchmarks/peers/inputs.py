"""Inputs of the rows: a folder per case below ``build/peers/inputs``, made once, and what scores the answers."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core import se3

PACKS = ("lidar3d-hku1", "lidar3d-hku-mb", "lidar3d-balm-hall", "lidar3d-kitti-0005")


class MissingDataError(Exception):
    """The case needs recorded data that are not here."""


def dump(folder: Path, **arrays: Any) -> None:
    """Arrays, each in a file."""
    for name, a in arrays.items():
        if a is not None:
            np.save(folder / f"{name}.npy", a)


def recorded(name: str) -> Any:
    """A log of the data sets."""
    import graphslam as gs
    from graphslam.core.errors import GraphSlamError

    try:
        return gs.load(name)
    except GraphSlamError as error:
        raise MissingDataError(str(error).splitlines()[0]) from error


def scans(folder: Path, case: str) -> None:
    """A recorded pack (poses of other programs as truth, if any), or ``sim-hand`` and ``sim-wheels``."""
    imu, ages = None, None
    if case.startswith("sim"):
        from graphslam.app.worlds import mesh_world
        from graphslam_studies.sim.lidar import drawn_imu, drawn_lidar, simulate_lidar

        seed = {"sim-hand": 105, "sim-wheels": 101, "sim-quick": 101}[case]
        config = replace(drawn_lidar(seed), imu=drawn_imu(seed), rate=10.0, sway=0.3 if case == "sim-hand" else 0.0)
        world = mesh_world("building" if case == "sim-hand" else "garage", seed=seed)
        log = simulate_lidar(world, seed, config, most=2.0 if case == "sim-quick" else 20.0)
        imu, clouds = log["imu"], log["clouds"]
        truth = log.truth.trajectory.interpolate(clouds.times)
    else:
        from graphslam_frontends.odometry.recorded import chain_odometry

        log = recorded(case)
        clouds = log["clouds"]
        truth = chain_odometry(log["odometry"]).poses if "odometry" in log.streams else None
    points = [clouds.cloud(k) for k in range(len(clouds))]
    if clouds.ages(0) is not None:
        ages = np.concatenate([clouds.ages(k) for k in range(len(clouds))])
    offsets = np.concatenate([[0], np.cumsum([len(p) for p in points])])
    all_points = np.concatenate(points).astype(np.float32)
    dump(folder, points=all_points, offsets=offsets, times=clouds.times, ages=ages, truth=truth)
    if imu is not None:
        noise = json.dumps(asdict(imu.noise))
        arrays = {"times": imu.times, "rate": imu.angular_rate, "force": imu.specific_force, "mount": imu.T_base_imu}
        np.savez(folder / "imu.npz", noise=noise, **arrays)


def scene(folder: Path, case: str) -> None:
    """Scans at known poses for evidence grids."""
    from tests.benchmarks import evidence_scenes

    count = {"tunnel": 300, "tunnel-quick": 20, "street": 10, "hall": 20}[case]
    made = getattr(evidence_scenes, case.removesuffix("-quick"))(count)
    if made is None:
        raise MissingDataError("recorded scans are not here")
    offsets = np.concatenate([[0], np.cumsum([len(c) for c in made.clouds])])
    world = np.concatenate([points for _, points in made.world()])
    dump(folder, poses=made.poses, points=np.concatenate(made.clouds), world=world, offsets=offsets)
    (folder / "case.json").write_text(json.dumps([made.voxel_size, made.max_range]))


def network(folder: Path, case: str) -> None:
    """A recorded pose network: the path of its file, and its arrays for g2o."""
    from graphslam.io.network_file import read_network
    from graphslam.solve.network.start import odometry_start
    from tests.reference.best_known import BEST_KNOWN

    name, best = next((n, b) for n, b in BEST_KNOWN.items() if n.split("/")[-1].startswith(case + "."))
    path = Path(os.environ.get("GRAPHSLAM_DATA", "")) / name
    if not path.is_file():
        raise MissingDataError(f"{name} is not below GRAPHSLAM_DATA")
    (folder / "case.json").write_text(json.dumps([str(path), best]))
    net = read_network(path)
    order = [3, 4, 5, 0, 1, 2] if net.dim == 3 else [0, 1, 2]  # g2o: translation first
    np.savez(
        folder / "network.npz",
        poses=odometry_start(net),
        edges=net.edges,
        measurements=net.measurements,
        information=net.information[:, order][:, :, order],
    )


def pairs(folder: Path, case: str) -> None:
    """Consecutive scans from a start that is 0.1 m and 0.02 rad off, per axis."""
    from graphslam_frontends.odometry.recorded import chain_odometry

    log = recorded(case)
    poses, clouds, rng = chain_odometry(log["odometry"]).poses, log["clouds"], np.random.default_rng(0)
    some = np.linspace(1, len(clouds) - 1, 20).astype(int)
    motions = se3.se3_between(poses[some - 1], poses[some])
    off = np.concatenate([rng.normal(0, 0.02, (20, 3)), rng.normal(0, 0.1, (20, 3))], axis=1)
    points = [clouds.cloud(k) for i in some for k in (i - 1, i)]
    dump(
        folder,
        points=np.concatenate(points).astype(np.float32),
        offsets=np.concatenate([[0], np.cumsum([len(p) for p in points])]),
        starts=se3.se3_compose(motions, se3.se3_exp(off)),
        relative=motions,
    )


def paths(folder: Path, case: str) -> None:
    """A path and a noisy copy of it."""
    n, rng = int(case), np.random.default_rng(0)
    steps = se3.se3_exp(rng.normal(size=(n, 6)) * 0.02 + [0, 0, 0.02, 0.5, 0, 0])
    poses = [np.array([0.0, 0, 0, 0, 0, 0, 1])]
    for step in steps[1:]:
        poses.append(se3.se3_compose(poses[-1], step))
    reference = np.array(poses)
    dump(
        folder,
        reference=reference,
        estimate=se3.se3_compose(reference, se3.se3_exp(rng.normal(size=(n, 6)) * 0.05)),
        times=0.1 * np.arange(n),
    )


def numbers(folder: Path, case: str) -> None:
    """Numbers and names, separated by spaces."""
    words = [float(w) if "." in w else int(w) if w.isdigit() else w for w in case.split()]
    if isinstance(words[-1], str):
        recorded(words[-1])
    (folder / "case.json").write_text(json.dumps(words))


def name(folder: Path, case: str) -> None:
    """The case by its name."""
    (folder / "case.json").write_text(json.dumps([case]))


def nothing(folder: Path, case: str) -> None:
    """No input."""


def ate(folder: Path, arrays: dict[str, Path]) -> float | None:
    """RMS of position after rigid alignment to the truth [m]; None without truth."""
    truth = folder / "truth.npy"
    if not truth.exists():
        return None
    a, b = np.load(arrays["path"])[:, :3], np.load(truth)[:, :3]
    T, _ = se3.align_se3(a, b[: len(a)])
    return float(np.sqrt(np.mean(np.sum((se3.se3_transform(T, a) - b[: len(a)]) ** 2, axis=1))))


def relative(folder: Path, arrays: dict[str, Path]) -> float:
    """RMS of the distance to the relative positions of the recording [m]."""
    off = np.load(arrays["path"])[:, :3] - np.load(folder / "relative.npy")[:, :3]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def nodes(folder: Path, arrays: dict[str, Path]) -> float:
    """RMS of position after rigid alignment to the true chain [m]."""
    from tests.benchmarks.bench_incremental import problem

    n = json.loads((folder / "case.json").read_text())[0]
    np.save(folder / "truth.npy", problem(n, np.random.default_rng(0))[0])
    return ate(folder, arrays) or 0.0


def objective(folder: Path, arrays: dict[str, Path]) -> float:
    """g2o's objective of the poses, computed here for both."""
    from graphslam.graph.network import network_values
    from graphslam.io.network_file import read_network
    from graphslam.solve.network.solve import g2o_objective

    net = read_network(json.loads((folder / "case.json").read_text())[0])
    return g2o_objective(net, network_values(net, np.load(arrays["poses"])))


Make = Callable[[Path, str], None]
Score = Callable[[Path, dict[str, Path]], "float | None"]
