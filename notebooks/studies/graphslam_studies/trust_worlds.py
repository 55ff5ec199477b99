"""Random worlds of the study ``trust``: robot, assumed noise, unmodelled errors, and GPS receiver.

The estimator gets only the σ of odometry, landmark observations and fixes, as from a data sheet. The true errors may
differ: wrong σ, wheel scale, outliers, time-correlated odometry errors, time-correlated GPS errors or multipath.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from graphslam.core.geometry import Array, se2_between, se2_compose, se2_exp, se2_transform, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps, LandmarkObservations, Odometry, Stream
from graphslam_studies.charts import RATE, ChartConfig, draw_log

GPS_KINDS = ("none", "white", "rtk", "correlated", "correlated-white", "multipath")
FRONT_ENDS = ("rbpf-ekf", "ekf")


@dataclass(frozen=True, kw_only=True)
class TrustWorld:
    """Parameters of a random world.

    Parameters
    ----------
    robot : ChartConfig
        Robot, with the noise as stated in the log.
    understated : float
        Ratio of true to stated σ of odometry and landmark observations.
    scale : float
        Ratio of measured to true wheel distances.
    tails : float
        Share of outlier observations; they have additional noise of eight times the stated σ.
    correlated_odometry : tuple of float
        σ of the time-correlated odometry error per 0.1 s over the stated white σ, and its time constant [s].
    gps : str
        One of :data:`GPS_KINDS`.
    gps_sigma : float
        Stated σ; the true errors, white or time-correlated, have this σ as well [m].
    gps_time : float
        Time constant of time-correlated GPS errors [s].
    number : int
        World number; worlds with one seed differ by it in routes and errors.
    """

    robot: ChartConfig = field(default_factory=ChartConfig)
    front_end: str = "rbpf-ekf"
    understated: float = 1.0
    scale: float = 1.0
    tails: float = 0.0
    correlated_odometry: tuple[float, float] = (0.0, 1.0)
    gps: str = "none"
    gps_sigma: float = 1.0
    gps_time: float = 60.0
    number: int = 0

    @property
    def clean(self) -> bool:
        """Whether all errors agree with the noise model in the log."""
        right = (
            self.understated == 1.0 and self.scale == 1.0 and self.tails == 0.0 and self.correlated_odometry[0] == 0.0
        )
        return right and self.gps in ("none", "white", "rtk")

    @property
    def wrong(self) -> str:
        """Description of the unmodelled errors."""
        out = []
        if self.understated != 1.0:
            out.append(f"noise ×{self.understated:.1f}")
        if self.scale != 1.0:
            out.append(f"wheels {100 * (self.scale - 1):+.1f} %")
        if self.tails:
            out.append(f"{100 * self.tails:.0f} % outlier observations")
        if self.correlated_odometry[0]:
            out.append(
                f"time-correlated odometry ×{self.correlated_odometry[0]:.1f}, {self.correlated_odometry[1]:.0f} s"
            )
        if self.gps in ("correlated", "correlated-white", "multipath"):
            out.append(f"GPS {self.gps}" + (f", {self.gps_time:.0f} s" if self.gps != "multipath" else ""))
        return "; ".join(out) or "nothing"


def draw_world(number: int, *, seconds: float = 250.0) -> TrustWorld:
    """World ``number``: even numbers are clean; the others have one or two unmodelled errors."""
    rng = SeedTree(7_000).child("trust-world", number).generator()

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    slow = rng.random() < 0.25
    heading = between(0.15, 1.0)
    if slow:
        robot = ChartConfig(
            odometry=(between(0.003, 0.01), between(0.001, 0.003), heading), speed=0.6, seconds=seconds,
            max_range=10.0, rows=True, submap=20.0,
        )  # fmt: skip
    else:
        robot = ChartConfig(
            odometry=(between(0.01, 0.05), between(0.005, 0.03), heading), speed=between(1.2, 3.0), seconds=seconds,
            submap=35.0, landmarks=int(rng.integers(80, 160)),
        )  # fmt: skip
    robot = replace(robot, sensor=(between(0.05, 0.5), between(0.5, 4.0)))
    front_end = FRONT_ENDS[int(rng.integers(2))]
    clean = number % 2 == 0
    gps = GPS_KINDS[int(rng.integers(3 if clean else 6))]
    sigma = between(0.03, 0.08) if gps == "rtk" else between(0.5, 2.0)
    world = TrustWorld(
        robot=robot, front_end=front_end, gps=gps, gps_sigma=sigma, gps_time=between(20.0, 90.0), number=number
    )
    if clean:
        return world
    wrong = rng.permutation(5)[: int(rng.integers(1, 3))].tolist()
    if gps in GPS_KINDS[3:]:
        wrong = wrong[: int(rng.integers(2))]  # about half of them have GPS errors only
    drawn = (between(1.3, 3.0), 1.0 + rng.choice([-1.0, 1.0]) * between(0.01, 0.05), between(0.02, 0.1),
             (between(0.3, 1.5), between(5.0, 60.0)), between(0.4, 0.7))  # fmt: skip
    for k in wrong:
        if k == 0:
            world = replace(world, understated=drawn[0])
        elif k == 1:
            world = replace(world, scale=float(drawn[1]))
        elif k == 2:
            world = replace(world, tails=drawn[2])
        elif k == 3:
            world = replace(world, correlated_odometry=drawn[3])
        elif world.understated == 1.0:
            world = replace(world, understated=drawn[4])  # the noise model is conservative
    return world


def correlated(rng: np.random.Generator, n: int, dt: float, time: float, width: int) -> Array:
    """Stationary Gauss–Markov process ``(n, width)`` with unit variance."""
    keep = np.exp(-dt / time)
    out = rng.standard_normal((n, width))
    for k in range(1, n):
        out[k] = keep * out[k - 1] + np.sqrt(1.0 - keep**2) * out[k]
    return out


def world_log(w: TrustWorld, seed: SeedTree) -> SensorLog:
    """A log of a world with its ground truth; it states the σ of the data sheets."""
    true, seed = w.understated, seed.child("world", w.number)
    c = w.robot
    (x, y, heading), (ranges, bearings) = c.odometry, c.sensor
    noisy = replace(c, odometry=(true * x, true * y, true * heading), sensor=(true * ranges, true * bearings))
    log = draw_log(noisy, seed)
    assert log.truth is not None
    path = log.truth.trajectory
    rng = seed.child("wrong").generator()
    stated = np.array([c.odometry[0], c.odometry[1], np.deg2rad(c.odometry[2])])
    odometry: Odometry = log["odometry"]
    u = odometry.increments.copy()
    size, time = w.correlated_odometry
    if size:
        add = size * stated * correlated(rng, len(u) - 1, 1.0 / RATE, time, 3)
        u[1:] = se2_compose(u[1:], se2_exp(add))
    u[:, :2] *= w.scale
    streams: dict[str, Stream] = {
        "odometry": replace(odometry, increments=u, covariances=np.tile(np.diag(stated**2), (len(u), 1, 1)))
    }
    detections: LandmarkObservations = log["landmarks"]
    r, b = detections.ranges.copy(), detections.bearings.copy()
    sigmas = np.array([c.sensor[0], np.deg2rad(c.sensor[1])])
    if w.tails:
        wild = rng.random(len(r)) < w.tails
        more = 8.0 * sigmas * rng.standard_normal((len(r), 2))
        r = np.maximum(np.where(wild, r + more[:, 0], r), 0.05)
        b = np.where(wild, wrap_angle(b + more[:, 1]), b)
    streams["landmarks"] = replace(
        detections, ranges=r, bearings=b, sigmas=np.broadcast_to(sigmas, detections.sigmas.shape).copy()
    )
    if w.gps != "none":
        streams["gps"] = fixes_of(w, path.times, path.poses, seed.child("gps").generator())
    return SensorLog(name="trust", streams=streams, truth=log.truth)


GPS_FRAME = np.array([120.0, -40.0, 0.7])
"""``T_gps_world`` (x, y [m], heading [rad]); unknown to the estimator."""


def fixes_of(w: TrustWorld, times: Array, poses: Array, rng: np.random.Generator) -> Gps:
    """One fix per second, with the errors of :attr:`TrustWorld.gps`."""
    at = np.arange(round(0.5 * RATE), len(times), round(RATE))
    n = len(at)
    exact = se2_transform(GPS_FRAME, poses[at, :2])
    s = w.gps_sigma
    noise = s * rng.standard_normal((n, 2))
    if w.gps == "correlated":
        noise = s * correlated(rng, n, 1.0, w.gps_time, 2)
    elif w.gps == "correlated-white":
        noise = s * correlated(rng, n, 1.0, w.gps_time, 2) + 0.3 * noise
    elif w.gps == "multipath":
        k = 0
        while k < n:
            k += int(rng.integers(15, 40))
            long = int(rng.integers(5, 15))
            noise[k : k + long] += 8.0 * s * rng.standard_normal(2)
            k += long
    return Gps(times=times[at], positions=exact + noise, sigma=np.full(n, s), lever=np.zeros(2))


def true_in_frame(log: SensorLog, times: Array, *, gps: bool) -> Array:
    """True poses ``(k, 3)`` at ``times``, in the frame of the fixes, or relative to the first of these poses."""
    assert log.truth is not None
    poses = log.truth.trajectory.interpolate(times)
    return se2_compose(np.broadcast_to(GPS_FRAME, poses.shape), poses) if gps else se2_between(poses[0], poses)
