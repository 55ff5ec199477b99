"""One trial of the calibration study: a log with a wrong noise model, mapped with and without calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from time import process_time
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.calibration import calibrate_log, without_noise
from graphslam.app.run.config import preset
from graphslam.app.run.pipeline import run
from graphslam.app.run.source import load
from graphslam.calibrate.corrections import Corrections
from graphslam.calibrate.estimate import Calibration
from graphslam.core.config import options_dict
from graphslam.core.log import SensorLog
from graphslam_studies.calibration_robot import DrawnRobot, draw_robot, drive
from graphslam_studies.calibration_scanned import UNKNOWN, Added, faulty, scanned
from graphslam_studies.montecarlo.trials import Measurement

OPTIONS: dict[str, Any] = {
    "frontend": {"association": "known", "particles": 20, "stopping": {"max_distance": 20.0}},
    "backend": {"associate": False, "merge_every": 0},
}
FIGURES = {
    "join_chi2_per_dof": "join_chi2_per_dof",
    "path_rmse_aligned": "path",
    "landmark_rmse_aligned": "landmarks",
    "nees_aligned_poses_per_dof": "nees_poses",
    "nees_aligned_landmarks_per_dof": "nees_landmarks",
}


@dataclass(frozen=True, kw_only=True)
class CalibrationTrialConfig:
    """A world of the study."""

    source: str = ""
    """Recorded set; empty: a random robot."""
    seconds: float = 120.0
    """Duration of the drive of a random robot [s]."""
    correlated: bool = False
    """Whether its odometry has time-correlated errors."""
    planted: tuple[str, ...] = ()
    """Keys of ``PLANTED``: errors added one at a time to a random robot without constant errors; no maps are made."""
    added: Added | None = field(default_factory=Added)
    """Errors added to the motion of a recorded log; None: random in each run."""
    first: float | None = None
    """Duration of the used part of a log of scans [s]; None: all."""
    motions: tuple[str, ...] = ()
    """Maps to make of a log of scans."""
    presets: str = ""
    """Preset whose map is compared; its options except for the noise are used for the other maps too."""
    frontend: str = "rbpf-ekf"


def run_calibration_trial(config: CalibrationTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one trial."""
    with one_blas_thread():
        if config.planted:
            return list(_planted(config, seed))
        if not config.source:
            return list(_drawn(config, seed))
        if config.frontend == "rbpf-ekf":
            return list(_recorded(config, seed))
        return list(
            scanned(config.source, config.presets, config.frontend, config.added, config.first, config.motions, seed)
        )


def _drawn(config: CalibrationTrialConfig, seed: int) -> Iterator[Measurement]:
    robot = draw_robot(seed, correlated=config.correlated)
    log = drive(robot, seed, config.seconds)
    begin = process_time()
    found = calibrate_log(log, frontend="rbpf-ekf", quick=True, seed=seed)
    yield Measurement("calibrated", "cpu_seconds", process_time() - begin, timing=True)
    yield from _recovered(robot, log, found)
    variants = {"stated": {"use": "none"}, "calibrated": found.config()}
    variants["oracle"] = {"use": "none", "given": options_dict(true_figures(robot))}
    for name, calibrate in variants.items():
        yield from _mapped(name, log, {**OPTIONS, "calibrate": calibrate}, seed)


EXACT: dict[str, float] = {
    **dict.fromkeys(("yaw_bias", "range_offset", "sensor_yaw", "clock"), 0.0),
    **dict.fromkeys(("distance_scale", "range_scale"), 1.0),
}
PLANTED: dict[str, tuple[dict[str, float], str, float]] = {
    "none": ({}, "", 0.0),
    "clock 50 ms": ({"clock": 0.05}, "clock", 0.05),
    "distances 2 % long": ({"distance_scale": 1.02}, "distance_scale", float(np.log(1.02))),
    "yaw rate 0.3 deg/s": ({"yaw_bias": float(np.deg2rad(0.3))}, "yaw_bias", float(np.deg2rad(0.3))),
    "sensor turned 1 deg": ({"sensor_yaw": float(np.deg2rad(1.0))}, "sensor_yaw", float(np.deg2rad(1.0))),
    # only the ratio of the two scales is observable; it is estimated as the distance scale
    "ranges 5 % long": ({"range_scale": 1.05}, "distance_scale", -float(np.log(1.05))),
}
"""Changes of an exact robot, the constant that should be estimated, and its true value."""


def _planted(config: CalibrationTrialConfig, seed: int) -> Iterator[Measurement]:
    """For each planted error: whether it is within 3σ of its estimate, and which other constants were corrected."""
    exact = replace(draw_robot(seed, correlated=config.correlated), **EXACT)
    for name in config.planted:
        changes, constant, true = PLANTED[name]
        log = drive(replace(exact, **changes), seed, config.seconds)
        begin = process_time()
        found = calibrate_log(log, frontend="rbpf-ekf", quick=True, seed=seed)
        yield Measurement(name, "cpu_seconds", process_time() - begin, timing=True)
        estimates = {e.name: e for e in found.estimates}
        yield Measurement(name, "false", float(sum(e.applied for k, e in estimates.items() if k != constant)))
        false_clock = "clock" in estimates and constant != "clock" and estimates["clock"].applied
        yield Measurement(name, "false_clock", float(false_clock))
        if constant and constant in estimates:
            e = estimates[constant]
            yield Measurement(name, "normalised_error", (e.value - true) / e.sigma)
            yield Measurement(name, "within", float(abs(e.value - true) <= 3.0 * e.sigma))
            yield Measurement(name, "strength", abs(true) / e.sigma)
            yield Measurement(name, "corrected", float(e.applied))
        elif constant:
            yield Measurement(name, "within", 0.0)
            yield Measurement(name, "corrected", 0.0)


def true_figures(r: DrawnRobot) -> Corrections:
    """Perfect calibration; time-correlated errors are included as white noise with the same long-term variance."""
    long = float(np.sqrt(2.0 * r.memory))
    return Corrections(
        yaw_bias=r.yaw_bias,
        distance_scale=r.distance_scale,
        clock=r.clock,
        range_offset=r.range_offset,
        sensor_yaw=r.sensor_yaw,
        along_metre=r.along_metre,
        along_second=r.correlated_speed * long,
        lateral_metre=r.lateral_metre,
        heading_metre=r.heading_metre,
        heading_radian=r.heading_radian,
        heading_second=float(np.hypot(r.heading_second, r.correlated_rate * long)),
        range_sigma=r.range_sigma,
        bearing_sigma=r.bearing_sigma,
    )


def _recovered(robot: DrawnRobot, log: SensorLog, found: Calibration) -> Iterator[Measurement]:
    """Ratios of σ for one second of mean motion, and errors of the constants."""
    true, got = true_figures(robot), found.corrections
    xi = log["odometry"].increments
    seconds = float(log["odometry"].times[-1] - log["odometry"].times[0])
    metres = float(np.hypot(xi[:, 0], xi[:, 1]).sum()) / seconds
    turned = float(np.abs(xi[:, 2]).sum()) / seconds

    def along(c: Corrections) -> float:
        return float(np.sqrt((c.along_metre or 0.0) ** 2 * metres + c.along_second**2))

    def heading(c: Corrections) -> float:
        v = c.heading_metre**2 * metres + c.heading_radian**2 * turned + c.heading_second**2
        return float(np.sqrt(v))

    yield Measurement("calibrated", "along_ratio", along(got) / along(true))
    yield Measurement("calibrated", "heading_ratio", heading(got) / heading(true))
    for name in ("range_sigma", "bearing_sigma"):
        yield Measurement("calibrated", f"{name}_ratio", float(getattr(got, name) / getattr(true, name)))
    for name in ("yaw_bias", "distance_scale", "clock", "range_offset", "sensor_yaw"):
        yield Measurement("calibrated", f"{name}_error", float(getattr(got, name) - getattr(true, name)))


def _mapped(name: str, log: SensorLog, options: Mapping[str, Any], seed: int) -> Iterator[Measurement]:
    result = run(log, frontend="rbpf-ekf", solver="batch", config=options, seed=seed, progress=False)
    values = result.metrics.set_index("key")["value"]
    for key, short in FIGURES.items():
        if key in values:
            yield Measurement(name, short, float(values[key]))


def _recorded(config: CalibrationTrialConfig, seed: int) -> Iterator[Measurement]:
    """A log of landmarks with added errors, calibrated; and without them, with its preset."""
    recorded, added = load(config.source), config.added or Added.drawn(seed)
    log, own = faulty(recorded, added), preset(config.presets)
    begin = process_time()
    found = calibrate_log(log, frontend="rbpf-ekf", quick=True, seed=seed)
    yield Measurement("calibrated", "cpu_seconds", process_time() - begin, timing=True)
    bias = next((e.value for e in found.estimates if e.name == "yaw_bias"), np.nan)
    yield Measurement("calibrated", "yaw_bias_error", float(bias - added.bias))
    yield from _mapped("calibrated", log, {**without_noise(own), "calibrate": found.config()}, seed)
    yield from _mapped("preset", replace(recorded, name=UNKNOWN), {**own, "calibrate": {"use": "none"}}, seed)
