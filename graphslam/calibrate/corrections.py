"""Corrections of systematic errors and of noise, their options, and their application to a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, se2_exp, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.poses import compose_increments, group_of
from graphslam.core.records import LandmarkObservations, Odometry, SteeringControls, Stream, VelocityControls
from graphslam_frontends.odometry.motion import (
    MotionNoise,
    dead_reckoned_increments,
    motion_stream,
    steering_odometry,
    velocity_odometry,
)

_LEAST = (1e-9, 1e-10)
_MOVING = 1e-9
CERTAIN = 3.3
"""Multiple of σ that the absolute value of a normal variable exceeds with probability 0.001."""
VISIT = 5.0
"""A landmark that is not observed for longer starts a new visit [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Corrections:
    """Systematic errors that are removed from a log, and the noise that is assigned to it.

    A value at its default changes nothing. The noise of the motion is a random walk: each variance grows with the
    distance driven, the angle turned, and the time in motion.
    """

    yaw_bias: float = 0.0
    """Bias of the yaw rate while the robot moves [rad/s]; it is subtracted."""
    distance_scale: float = 1.0
    """Distances of the motion are divided by this factor."""
    turn_per_metre: float = 0.0
    """Turn error of the motion per metre driven [rad/m]; it is subtracted."""
    turn_scale: float = 1.0
    """Turns of the motion are too large by this factor."""
    clock: float = 0.0
    """Delay of the time stamps of the motion relative to those of the observations [s]; it is subtracted."""
    range_scale: float = 1.0
    """Ranges of landmarks are divided by this factor, after the offset is subtracted."""
    range_offset: float = 0.0
    """Offset of the ranges [m]; it is subtracted."""
    sensor_yaw: float = 0.0
    """Rotation of the sensor to the left relative to the mounting in the log [rad]."""
    along_metre: float | None = None
    """σ of the distance after one metre [m/√m]; None: noise of the log or of the front end."""
    along_second: float = 0.0
    """σ of the distance after one second [m/√s]."""
    lateral_metre: float = 0.0
    """σ to the side after one metre [m/√m]."""
    heading_metre: float = 0.0
    """σ of the heading after one metre [rad/√m]."""
    heading_radian: float = 0.0
    """σ of the heading after one radian turned [rad/√rad]."""
    heading_second: float = 0.0
    """σ of the heading after one second in motion [rad/√s]."""
    widen_only: bool = False
    """The noise of the motion is at least that of the log or of the front end: scan matches over a metre or two do not
    observe rare or time-correlated errors of wheels."""
    heading_cover: float | None = None
    """With ``widen_only``: σ of the heading that is kept from the log is at most this multiple of the estimated one;
    None: no limit."""
    range_sigma: float | None = None
    """σ of a range [m]; None: σ of the log."""
    bearing_sigma: float | None = None
    """σ of a bearing [rad]; None: σ of the log."""

    range_visit: float = 0.0
    """σ of a range error that is common to all observations of one visit of a landmark [m]."""
    bearing_visit: float = 0.0
    """The same for bearings [rad]."""
    visit_observations: float = 1.0
    """Typical number of observations per visit, for logs without landmark identities."""
    slips: tuple[tuple[float, float], ...] = ()
    """Intervals of wheel slip, in the clock of the observations [s]: σ of the distance is the whole distance."""

    def __post_init__(self) -> None:
        ranges = {
            "> 0": "distance_scale turn_scale range_scale range_sigma bearing_sigma",
            "≥ 0": " ".join((*NOISE, "along_metre", "range_visit", "bearing_visit")),
            "≥ 1": "heading_cover",
            "finite": "*",
        }
        check_options(self, "calibration: ", ranges)
        if not np.all(np.isfinite(self.slips)):
            raise ConfigError(f"calibration: slips = {self.slips}; wanted finite numbers")

    @property
    def neutral(self) -> bool:
        """Does it change nothing?"""
        return self == Corrections()

    def without_motion_noise(self) -> Corrections:
        """Copy that does not change the noise of the motion."""
        off = dict.fromkeys(NOISE, 0.0)
        return replace(self, along_metre=None, widen_only=False, heading_cover=None, slips=(), **off)

    def without_constants(self) -> Corrections:
        """Copy without systematic errors: noise and slip only."""
        return replace(self, **{k: getattr(Corrections(), k) for k in CONSTANT})

    def without_sensor_noise(self) -> Corrections:
        """Copy that does not change the σ of the observations."""
        return replace(self, range_sigma=None, bearing_sigma=None, range_visit=0.0, bearing_visit=0.0)


CONSTANT = (
    *("yaw_bias", "distance_scale", "turn_per_metre", "turn_scale", "clock"),
    *("range_scale", "range_offset", "sensor_yaw"),
)
NOISE = ("along_second", "lateral_metre", "heading_metre", "heading_radian", "heading_second")


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateConfig:
    """Calibration of noise and systematic errors from the log itself, before a run."""

    use: Literal["auto", "always", "none"] = "auto"
    """``auto``: only if no preset was made for this data set; ``always``; ``none``. If ``given`` is set, its values are
    used and nothing is estimated."""
    given: Corrections | None = None
    """Corrections to apply, as ``graphslam calibrate`` writes them."""
    budget: float = 1.0
    """Computing effort of the calibration in a run, relative to the default; 1: a few seconds."""

    def __post_init__(self) -> None:
        check_options(self, "calibrate.", {"in (0, 100]": "budget"})


def apply_corrections(log: SensorLog, c: Corrections) -> SensorLog:
    """The log with corrected motion and observations and their noise; ground truth is unchanged."""
    if c.neutral:
        return log
    name, motion = motion_stream(log)
    streams: dict[str, Stream] = {
        name: corrected_motion(motion, c)
    }  # first: with two odometry streams, the first one is used
    for other, stream in log.streams.items():
        if other != name:
            streams[other] = corrected_observations(stream, c) if isinstance(stream, LandmarkObservations) else stream
    return replace(log, streams=streams)


def moved_end(log: SensorLog, corrected: SensorLog, noise: MotionNoise) -> tuple[float, float]:
    """Displacement of the end of the dead-reckoned path by the corrections, and its limit from the noise of both [m].

    Parameters
    ----------
    noise : MotionNoise
        Noise of controls; recorded odometry has its own covariances.
    """
    ends, covariances = [], []
    for each in (log, corrected):
        odometry = motion_stream(each)[1]
        if not isinstance(odometry, Odometry):
            odometry = dead_reckoned_increments(each, odometry.times, noise)[0]
        G = group_of(odometry.increments)
        poses = compose_increments(odometry.increments)[1:]
        after = G.inverse(G.between(poses, np.broadcast_to(poses[-1], poses.shape)))
        A = G.adjoint(after)  # T_i Exp(δ) T_i,end = T_end Exp(Ad(T_i,end⁻¹) δ)
        covariances.append(np.einsum("nij,njk,nlk->il", A, odometry.covariances, A)[G.position, G.position])
        ends.append(poses[-1])
    covariance = covariances[0] + covariances[1]
    moved = G.between(*ends)[: len(covariance)]
    d = float(np.linalg.norm(moved))
    along = moved / max(d, 1e-12)
    return d, CERTAIN * float(np.sqrt(along @ covariance @ along))


def corrected_observations(s: LandmarkObservations, c: Corrections) -> LandmarkObservations:
    """Observations with corrected ranges, mounting and σ."""
    if (c.range_scale, c.range_offset, c.sensor_yaw) == (1.0, 0.0, 0.0) and c.range_sigma is c.bearing_sigma is None:
        return s
    ranges = (s.ranges - c.range_offset) / c.range_scale
    sigmas = s.sigmas.copy()
    # mean of n observations with common error σ_v: variance σ² / n + σ_v², as with white noise of σ² + n σ_v²
    n = visit_counts(s) if s.ids is not None else np.full(len(ranges), c.visit_observations)
    if c.range_sigma is not None:
        sigmas[:, 0] = np.sqrt(c.range_sigma**2 + n * c.range_visit**2) / c.range_scale
    if c.bearing_sigma is not None:
        sigmas[s.has_bearing, 1] = np.sqrt(c.bearing_sigma**2 + n * c.bearing_visit**2)[s.has_bearing]
    return replace(s, ranges=ranges, sigmas=sigmas, T_base_sensor=s.T_base_sensor + np.array([0.0, 0.0, c.sensor_yaw]))


def visit_counts(s: LandmarkObservations) -> Array:
    """Number of observations ``(q,)`` in the visit of each observation, by the identities of the log."""
    assert s.ids is not None
    visit = visits_of(s.ids, np.repeat(s.times, np.diff(s.offsets)))
    return np.where(s.ids >= 0, np.bincount(visit)[visit] if len(visit) else 1, 1).astype(np.float64)


def visits_of(landmark: npt.NDArray[np.int64], times: Array) -> npt.NDArray[np.int64]:
    """Index of the visit of each observation ``(q,)``; a gap longer than :data:`VISIT` starts a new visit."""
    out = np.full(len(landmark), -1, dtype=np.int64)
    count = 0
    for l in np.unique(landmark):
        mine = np.flatnonzero(landmark == l)
        step = np.concatenate([[0], np.cumsum(np.diff(times[mine]) > VISIT)])
        out[mine] = count + step
        count += int(step[-1]) + 1
    return out


def corrected_motion(motion: Any, c: Corrections) -> Any:
    """Corrected motion; controls become odometry at the same stamps if the corrections set the motion noise."""
    if c.clock:
        motion = replace(motion, times=motion.times - c.clock)
    if isinstance(motion, Odometry):
        return _odometry(motion, c)
    if c.along_metre is not None:
        made = steering_odometry if isinstance(motion, SteeringControls) else velocity_odometry
        return _odometry(made(motion, motion.times, MotionNoise()), c)
    if isinstance(motion, VelocityControls):
        moving = (motion.speed != 0.0) | (motion.yaw_rate != 0.0)
        speed = motion.speed / c.distance_scale
        rate = motion.yaw_rate - moving * c.yaw_bias - np.abs(motion.speed) * c.turn_per_metre
        return replace(motion, speed=speed, yaw_rate=rate - (c.turn_scale - 1.0) * motion.yaw_rate)
    g = motion.geometry
    bend = np.tan(motion.steering) / g.wheelbase * (2.0 - c.turn_scale)
    with np.errstate(divide="ignore", invalid="ignore"):
        bias = np.where(motion.speed != 0.0, c.yaw_bias / motion.speed, 0.0)
    bend = bend - np.sign(motion.speed) * c.turn_per_metre - bias
    return replace(motion, speed=motion.speed / c.distance_scale, steering=np.arctan(bend * g.wheelbase))


def _odometry(odometry: Odometry, c: Corrections) -> Odometry:
    g = group_of(odometry.increments)
    planar = g.dof == 3
    xi = se2_log(odometry.increments) if planar else g.log(odometry.increments)
    place, heading = (slice(0, 2), 2) if planar else (g.position, g.heading)
    metres = np.linalg.norm(xi[:, place], axis=1)
    turned = np.abs(xi[:, heading]) if planar else np.linalg.norm(xi[:, :3], axis=1)
    seconds = np.concatenate([[0.0], np.diff(odometry.times)])[: len(metres)]
    seconds = seconds * ((metres > _MOVING) | (turned > _MOVING))
    changed = xi.copy()
    changed[:, heading] -= c.yaw_bias * seconds + c.turn_per_metre * metres + (c.turn_scale - 1.0) * xi[:, heading]
    changed[:, place] /= c.distance_scale
    increments = odometry.increments
    if not np.array_equal(changed, xi):
        increments = se2_exp(changed) if planar else g.exp(changed)
        increments[0] = odometry.increments[0]
    if c.along_metre is None and not c.slips:
        return replace(odometry, increments=increments)
    P = (
        odometry.covariances.copy()
        if c.along_metre is None
        else increment_covariances(c, metres, turned, seconds, g.dof)
    )
    if c.widen_only:
        k = np.arange(g.dof)
        stated = odometry.covariances[:, k, k]
        if c.heading_cover is not None:
            stated[:, heading] = np.minimum(stated[:, heading], c.heading_cover**2 * P[:, heading, heading])
        P[:, k, k] = np.maximum(P[:, k, k], stated)
    ahead = 0 if planar else 3
    P[:, ahead, ahead] += slip_noise(odometry.times[: len(metres)], metres, c.slips)
    return replace(odometry, increments=increments, covariances=P)


def slip_noise(times: Array, metres: Array, slips: Sequence[Sequence[float]]) -> Array:
    """Variance ``(n,)`` of the distances that end at ``times``: σ of a whole slip interval is its distance; else 0."""
    out, begin = np.zeros(len(times)), np.concatenate([times[:1], times[:-1]])
    for a, b in slips:
        inside = (times > a + 1e-6) & (begin < b - 1e-6)
        out[inside] = metres[inside] * metres[inside].sum()
    return out


def increment_covariances(c: Corrections, metres: Array, turned: Array, seconds: Array, dof: int) -> Array:
    """Covariances ``(n, dof, dof)`` of increments in the right tangent space."""
    along = (c.along_metre or 0.0) ** 2 * metres + c.along_second**2 * seconds + _LEAST[0]
    side = c.lateral_metre**2 * metres + _LEAST[0]
    heading = c.heading_metre**2 * metres + c.heading_radian**2 * turned + c.heading_second**2 * seconds + _LEAST[1]
    if dof == 3:
        P = np.zeros((len(metres), 3, 3))
        P[:, 0, 0], P[:, 1, 1], P[:, 2, 2] = along, side, heading
        return P
    P = np.zeros((len(metres), 6, 6))
    for k in range(3):
        P[:, k, k] = heading
        P[:, 3 + k, 3 + k] = np.maximum(along, side)
    return P
