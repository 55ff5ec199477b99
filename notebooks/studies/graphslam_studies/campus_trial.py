"""One run over the campus: effect of outdoor fixes on the indoor map.

``odometry``: chained submaps of scan-to-window odometry; ``odometry-fixes``: the same with fixes.
``alone``: odometry with loop closures; ``joint-white`` and ``joint``: the same graph and loop closures with fixes.
Fixes have independent errors in ``joint-white``; in ``joint`` and ``odometry-fixes`` their errors are modelled by
:attr:`CampusTrialConfig.gps`, with time correlation. The graphs of a pair (:data:`PAIRS`) differ in the fixes only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.backend.back_end import BackEnd
from graphslam.backend.config import BackEndConfig, GpsOptions
from graphslam.backend.streams import split_fixes
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3, remove_roll_pitch
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import fit_alignment
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.gps import GpsRecord, level_datum_pose
from graphslam.solve.solution import Solution
from graphslam_frontends.odometry.dead_reckoning import DeadReckoningNoise
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.scan_window.front_end import LIFT, ScanWindow, ScanWindowFrontEndConfig, WindowSubmapConfig
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.campus import simulate_campus
from graphslam_studies.sim.campus_config import CampusConfig

KINDS = ("odometry", "odometry-fixes", "alone", "joint-white", "joint")
PAIRS = {"odometry-fixes": "odometry", "joint-white": "alone", "joint": "alone"}
"""The same graph with fixes, and without."""
BLOCKS = {"position": slice(3, 6), "plan": slice(3, 5), "heading": slice(2, 3), "level": slice(0, 2)}


@dataclass(frozen=True, kw_only=True)
class CampusTrialConfig:
    """A campus, and the settings to make a graph from its log."""

    campus: CampusConfig
    front_end: ScanWindowFrontEndConfig = field(
        default_factory=lambda: ScanWindowFrontEndConfig(
            steps=StepConfig(
                period=1.0,
                max_range=25.0,
                most_points=3000,
                level_floors=True,
                noise=DeadReckoningNoise(wheel=0.2, vertical=0.02, lateral=0.005, wheel_scale=0.01),
            )
        )
    )
    back_end: BackEndConfig = field(default_factory=lambda: BackEndConfig(loops=True, level_sigma=0.006, look_every=0))
    gps: GpsOptions = field(default_factory=lambda: GpsOptions(use="all", every=20.0, bias_sigma=0.8, bias_time=300.0))
    """Multipath errors are correlated over 10 s, so one fix per 20 s is used; orbit errors over minutes."""


def run_campus_trial(config: CampusTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        return list(campus_figures(config, seed))


def campus_figures(config: CampusTrialConfig, seed: int) -> Iterator[Measurement]:
    """Simulate, run the front end, build the graph, and solve it with and without fixes."""
    begin = process_time()
    log = simulate_campus(config.campus, seed)
    made = process_time()
    front = ScanWindow(config.front_end)
    submaps = list(front.submaps(log, seed=SeedTree(seed)))
    followed = process_time()
    judge = Judge(log, float(submaps[0].interval[0]), submap_lift(config.front_end.submap))
    end = BackEnd(config.back_end, "batch")
    for s in submaps:
        end.append(s)
    end.solver.solve_to_optimum()
    yield from judge.figures("odometry", end.solver.solution())
    gps: Gps = log["gps"]
    yield from judge.figures("odometry-fixes", *with_fixes(end, gps, config.gps))
    without_fixes(end)
    yield from judge.figures("alone", end.finish())
    joined = process_time()
    for kind, how in (("joint-white", GpsOptions(use="all")), ("joint", config.gps)):
        yield from judge.figures(kind, *with_fixes(end, gps, how))
    lost = sum(int(s.report.get("scans_lost", 0)) for s in submaps)
    steps = sum(int(s.report.get("steps", 0)) for s in submaps)
    loops = [r for r in end.graph.records.values() if isinstance(r, BetweenRecord) and r.group != "dense-submap"]
    yield Measurement("alone", "loops", float(len(loops)))
    yield Measurement("odometry", "scans_lost", lost / max(steps, 1))
    yield Measurement("odometry", "length", float(log.meta["length"]))
    yield Measurement("joint", "fixes", float(len(gps.times)))
    for name, seconds in (("simulate", made - begin), ("follow", followed - made), ("graph", joined - followed)):
        yield Measurement("odometry", f"seconds_{name}", seconds, timing=True)


def with_fixes(end: BackEnd, gps: Gps, how: GpsOptions) -> tuple[Solution, Array]:
    """Solve the graph with these fixes only; returns the solution, and the map frame in the frame of the fixes."""
    without_fixes(end)
    end.add_gps(split_fixes(gps, how)[0], how)
    end.graph.finish_sensors()
    end.solver.solve_to_optimum()
    values, origin = end.graph.values, end.graph.gps_origin
    assert values.datum is not None
    assert origin is not None
    frame = level_datum_pose(values.datum, values.tilt)
    frame[:3] += origin
    return end.solver.solution(), frame


def without_fixes(end: BackEnd) -> None:
    """Remove all fixes from the graph, and solve it."""
    graph = end.graph
    for fid in [k for k, r in graph.records.items() if isinstance(r, GpsRecord)]:
        graph.remove(fid, reason="the graph is solved without fixes")
    end.solver.solve_to_optimum()


def submap_lift(config: WindowSubmapConfig) -> float:
    """Height of the first body of a submap above the submap frame [m]."""
    return LIFT * config.voxel_size


class Judge:
    """Scores a solved path against ground truth.

    Parameters
    ----------
    log : SensorLog
        Log of the campus.
    begin : float
        Time of the first node [s].
    lift : float
        Height of the first body above the map frame [m].
    """

    def __init__(self, log: SensorLog, begin: float, lift: float) -> None:
        assert log.truth is not None
        self.meta: Mapping[str, Any] = log.meta
        self.truth = log.truth.trajectory
        base = remove_roll_pitch(self.truth.interpolate(np.array([begin]))[0])
        base[2] -= lift
        self.base = base
        self.T_world_base = SE3.compose(np.asarray(log.meta["T_world_frame"], dtype=np.float64), base)
        """The map frame in the campus frame."""

    def true_at(self, times: Array) -> Array:
        """True poses in the frame of the map ``(n, 7)``."""
        poses = self.truth.interpolate(times)
        return SE3.between(np.broadcast_to(self.base, poses.shape), poses)

    def inside(self, times: Array) -> np.ndarray:
        """Mask of the times that are indoors."""
        out = np.zeros(len(times), dtype=bool)
        for a, b in self.meta["indoor"]:
            out |= (times >= a) & (times <= b)
        return out

    def figures(self, kind: str, solution: Solution, T_world_map: Array | None = None) -> Iterator[Measurement]:
        """Errors and NEES of one graph; with ``T_world_map`` (from fixes) also the error in the campus frame."""
        path = solution.trajectory()
        true = self.true_at(path.times)
        inside = self.inside(path.times)
        away = off_as_a_whole(path.poses, true)
        yield Measurement(kind, "ate", rms(away))
        yield Measurement(kind, "ate_indoor", rms(away[inside]))
        yield Measurement(kind, "ate_outdoor", rms(away[~inside]))
        yield Measurement(kind, "ate_indoor_own", rms(off_as_a_whole(path.poses[inside], true[inside])))
        raw = np.linalg.norm(path.poses[:, :3] - true[:, :3], axis=1)
        yield Measurement(kind, "ate_indoor_anchored", rms(raw[inside]))
        yield Measurement(kind, "end_error", float(raw[-1]))
        if T_world_map is not None:
            there = SE3.compose(np.broadcast_to(T_world_map, path.poses.shape), path.poses)[:, :3]
            where = SE3.compose(np.broadcast_to(self.T_world_base, true.shape), true)[:, :3]
            yield Measurement(kind, "ate_indoor_world", rms(np.linalg.norm(there - where, axis=1)[inside]))
        angles = [a for c in self.meta["corridors"] for a in angle_errors(c["legs"], path, true)]
        if angles:
            yield Measurement(kind, "angle_error", float(np.rad2deg(np.mean(np.abs(angles)))))
            yield Measurement(kind, "angle_error_max", float(np.rad2deg(np.max(np.abs(angles)))))
        yield from self.consistency(kind, path, true, inside)
        yield Measurement(kind, "failed", 0.0)

    def consistency(self, kind: str, path: Trajectory, true: Array, inside: np.ndarray) -> Iterator[Measurement]:
        """NEES per degree of freedom, first base fixed: mid-path, indoors, at the end, and mean over the path."""
        assert path.covariances is not None
        e = SE3.log(SE3.between(path.poses, true))
        n = len(e)
        rows = {"middle": n // 2, "end": n - 1}
        if inside.any():
            rows["indoor"] = int(np.flatnonzero(inside)[inside.sum() // 2])
        for name, block in BLOCKS.items():
            x = e[:, block]
            z = np.einsum("ki,ki->k", x, np.linalg.solve(path.covariances[:, block, block], x[..., None])[..., 0])
            z = z / x.shape[1]
            for where, k in rows.items():
                yield Measurement(kind, f"nees_{name}_{where}", float(z[k]))
            yield Measurement(kind, f"nees_{name}", float(np.mean(z[n // 20 :])))


def rms(x: Array) -> float:
    """Root mean square; NaN if empty."""
    return float(np.sqrt(np.mean(x**2))) if len(x) else float("nan")


def off_as_a_whole(poses: Array, true: Array) -> Array:
    """Position errors ``(n,)`` [m] after rigid alignment of all poses ``(n, 7)``."""
    T, _ = fit_alignment(true, poses, "se")
    return np.asarray(np.linalg.norm(SE3.compose(np.broadcast_to(T, poses.shape), poses)[:, :3] - true[:, :3], axis=1))


def angle_errors(legs: list[list[list[float]]], path: Trajectory, true: Array) -> list[float]:
    """Errors of the angle between the two legs of a corridor [rad], one per traversal."""
    turned: list[list[tuple[float, float]]] = []
    for leg in legs:
        turned.append([])
        for a, b in leg:
            k = np.flatnonzero((path.times >= a) & (path.times <= b))
            if len(k) >= 5:
                p, q = path.poses[k, :2] - path.poses[k, :2].mean(axis=0), true[k, :2] - true[k, :2].mean(axis=0)
                turn = np.arctan2(np.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0]), np.sum(p * q))
                turned[-1].append((0.5 * (a + b), float(turn)))
    # the two legs of one traversal are those closest in time
    return [float(wrap_angle(min(turned[1], key=lambda y: abs(y[0] - x[0]))[1] - x[1])) for x in turned[0] if turned[1]]
