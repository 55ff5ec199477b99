"""One trial of the calibration study on a recorded log of scans, with random errors added to its odometry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

import numpy as np

from graphslam.app.run.calibration import calibrate_log, without_noise
from graphslam.app.run.config import preset
from graphslam.app.run.pipeline import run
from graphslam.app.run.source import load
from graphslam.calibrate.estimate import Calibration
from graphslam.core.findings import findings_of_json
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.core.random import SeedTree
from graphslam.core.records import Odometry, VelocityControls
from graphslam.core.se3 import se3_inverse, se3_transform
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_studies.evaluate.relations import covered_part, random_pairs, relation_error
from graphslam_studies.montecarlo.trials import Measurement

UNKNOWN = "unknown"
"""Name given to recorded logs, so that no preset applies."""
YAW_BIAS_SIGMA = float(np.deg2rad(0.05))
"""Largest σ of a yaw bias that counts as estimated [rad/s]."""
PAIRS = 5000
"""Number of pairs of poses whose relative pose is scored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Added:
    """Errors that are added to the motion of a recorded log."""

    bias: float = 0.0
    """Bias of the yaw rate during motion [rad/s]."""
    scale: float = 1.0
    """Factor on distances."""
    along: float = 0.0
    """σ of each position axis after one metre [m/√m]."""
    heading: float = 0.0
    """σ of the heading after one metre [rad/√m]."""

    @classmethod
    def drawn(cls, seed: int) -> Added:
        """Random bias and scale error of either sign; log-uniform noise over a decade."""
        rng = SeedTree(seed).child("calibration", "added").generator()
        return cls(
            bias=float(np.deg2rad(rng.uniform(0.1, 0.6)) * rng.choice([-1, 1])),
            scale=float(1.0 + rng.uniform(0.01, 0.08) * rng.choice([-1, 1])),
            along=float(np.exp(rng.uniform(np.log(0.01), np.log(0.1)))),
            heading=float(np.exp(rng.uniform(np.log(0.003), np.log(0.03)))),
        )


def faulty(log: SensorLog, added: Added, seed: int = 0) -> SensorLog:
    """The log with errors added to its motion, under a name without a preset."""
    streams = dict(log.streams)
    for name, s in log.streams.items():
        if isinstance(s, VelocityControls):
            moving = (s.speed != 0.0) | (s.yaw_rate != 0.0)
            streams[name] = replace(s, speed=s.speed * added.scale, yaw_rate=s.yaw_rate + added.bias * moving)
        elif isinstance(s, Odometry):
            streams[name] = _worse(s, added, SeedTree(seed).child("calibration", "noise", name).generator())
    return replace(log, name=UNKNOWN, streams=streams)


def _worse(odometry: Odometry, added: Added, rng: np.random.Generator) -> Odometry:
    """Odometry with errors added; heading errors are rotations about the vertical of the first pose, without tilt."""
    g = group_of(odometry.increments)
    xi = g.log(odometry.increments)
    dt = np.concatenate([[0.0], np.diff(odometry.times)])
    metres = np.linalg.norm(xi[:, g.position], axis=1)
    moving = (metres > 1e-6) | (np.abs(xi[:, g.heading]) > 1e-6)
    xi[:, g.position] *= added.scale
    xi[:, g.position] += added.along * np.sqrt(metres)[:, None] * rng.standard_normal((len(xi), g.dim))
    turn = added.bias * dt * moving + added.heading * np.sqrt(metres) * rng.standard_normal(len(xi))
    if g.dim == 2:
        xi[:, g.heading] += turn
        increments = g.exp(xi)
    else:
        attitude = chain_odometry(odometry).poses
        attitude[:, :3] = 0.0
        level = se3_transform(se3_inverse(attitude), np.broadcast_to([0.0, 0.0, 1.0], (len(xi), 3)))
        extra = np.zeros_like(xi)
        extra[:, :3] = turn[:, None] * level
        increments = g.compose(g.exp(xi), g.exp(extra))
    increments[0] = odometry.increments[0]
    return replace(odometry, increments=increments)


def scanned(
    source: str, presets: str, frontend: str, added: Added | None, first: float | None, maps: Sequence[str], seed: int
) -> Iterator[Measurement]:
    """Calibrate a log of scans before and after errors are added to its odometry, and map it.

    Parameters
    ----------
    added : Added or None
        None: random, from the seed.
    first : float or None
        Duration of the part of the log that is used [s]; None: all.
    maps : sequence of str
        Maps to make. Without added errors: with the preset (``preset``), or calibrated (``recorded``). With added
        errors: calibrated (``calibrated``), or with the preset (``stated``).
    """
    recorded = load(source)
    begin = float(recorded["reference"].times[0])
    if first is not None:
        recorded = recorded.slice(begin, begin + first)
    own, added = preset(presets), added or Added.drawn(seed)
    worse = faulty(recorded, added, seed)
    planar = any(isinstance(s, Odometry) and s.increments.shape[1] == 3 for s in recorded.streams.values())
    for quick in (True, False) if planar else (True,):  # 3-D scan matching takes minutes
        found, spent = [], []
        for log in (replace(recorded, name=UNKNOWN), worse):
            clock = process_time()
            found.append(calibrate_log(log, frontend=frontend, config=without_noise(own), seed=seed, quick=quick))
            spent.append(process_time() - clock)
        if quick:
            yield Measurement("calibrated", "cpu_seconds", max(spent), timing=True)
        yield from _measurements("quick" if quick else "full", found[0], found[1], added, _speed(recorded))
    unknown, known = without_noise(own), {**own, "calibrate": {"use": "none"}}
    log = replace(recorded, name=UNKNOWN)
    made = {
        "preset": (log, known),
        "recorded": (log, unknown),
        "calibrated": (worse, unknown),
        "stated": (worse, known),
    }
    for kind in maps:
        yield from _mapped(kind, *made[kind], frontend, seed)


def _measurements(
    name: str, before: Calibration, after: Calibration, added: Added, speed: float
) -> Iterator[Measurement]:
    """Errors of the estimated additions: difference between the two calibrations minus the true addition.

    The yaw bias is scored only if both calibrations estimate it separately, with a combined σ below `YAW_BIAS_SIGMA`.
    The joint effect of bias and turn per metre at the mean speed (``turning``) is always scored.
    """
    a, b = ({e.name: e for e in found.estimates} for found in (before, after))
    scale = float(np.exp(b["distance_scale"].value - a["distance_scale"].value))
    yield Measurement(name, "distance_scale_error", scale / added.scale - 1.0)
    sigma = math.hypot(a["distance_scale"].sigma, b["distance_scale"].sigma)
    yield Measurement(name, "distance_scale_sigma_reported", sigma)
    yield Measurement(name, "distance_scale_applied", float(b["distance_scale"].applied))
    both = [x["yaw_bias"] for x in (a, b) if "yaw_bias" in x]
    estimated = len(both) == 2 and math.hypot(both[0].sigma, both[1].sigma) < YAW_BIAS_SIGMA
    yield Measurement(name, "yaw_bias_reported", float(estimated))
    if estimated:
        yield Measurement(name, "yaw_bias_error", both[1].value - both[0].value - added.bias)
    rates = {"yaw_bias": 1.0, "turn_per_metre": speed}
    turning = [sum(rate * x[n].value for n, rate in rates.items() if n in x) for x in (a, b)]
    yield Measurement(name, "turning_error", turning[1] - turning[0] - added.bias)
    if added.along:
        new = max(after.noise["along_metre"] ** 2 - before.noise["along_metre"] ** 2, 0.0)
        yield Measurement(name, "along_ratio", float(np.sqrt(new)) / added.along)
    yield Measurement(name, "refused", float(after.prediction is not None and after.prediction.supported != "all"))


def _speed(log: SensorLog) -> float:
    """Mean odometry speed during motion [m/s]."""
    s = next(s for s in log.streams.values() if isinstance(s, Odometry))
    g = group_of(s.increments)
    metres = np.linalg.norm(g.log(s.increments[1:])[:, g.position], axis=1)
    dt = np.diff(s.times)
    moving = metres > 0.005 * dt
    return float(metres[moving].sum() / max(dt[moving].sum(), 1e-9))


def _mapped(name: str, log: SensorLog, options: Mapping[str, Any], frontend: str, seed: int) -> Iterator[Measurement]:
    """Errors of the map of a log and of its odometry, and whether the verdict reports a better input."""
    result = run(log, frontend=frontend, solver="batch", config=options, seed=seed, progress=False)
    codes = {f.code for f in findings_of_json(result.report["verdict"])}
    path = result.map.trajectory
    input_path = chain_odometry(next(s for s in log.streams.values() if isinstance(s, Odometry)))
    of_run, of_input = (path_errors(p, log["reference"]) for p in (path, input_path))
    for key, value in of_run.items():
        yield Measurement(name, key, value)
        yield Measurement(name, f"{key}_input", of_input[key])
    yield Measurement(name, "input_reported", float("input-better" in codes))
    yield Measurement(name, "calibration_refused", float("calibration-refused" in codes))
    yield Measurement(
        name, "worse_unreported", float(of_run["path"] > 1.1 * of_input["path"] and "input-better" not in codes)
    )


def path_errors(path: Trajectory, reference: Any) -> dict[str, float]:
    """Relative-pose errors of random pairs [m, deg], and ATE after alignment [m]."""
    part = covered_part(Trajectory(reference.times, reference.poses), path)
    pairs = random_pairs(len(part), PAIRS, np.random.default_rng(0))
    row = relation_error(path, part, pairs).as_row()
    at = Trajectory(part.times, path.interpolate(part.times))
    errors = {"relations": row["translation_mean"], "relations_median": row["translation_median"]}
    return errors | {"turns": row["rotation_mean_deg"], "path": ate(at, part).statistics.rmse}
