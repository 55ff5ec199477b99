"""True motion of a robot along its route through a world, at any time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from graphslam.core.config import check_options
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.se3 import quat_multiply, quat_normalize
from graphslam.core.trajectory import Trajectory
from graphslam.sim.route import Route

if TYPE_CHECKING:
    from graphslam.sim.raycast import RayCaster
    from graphslam.sim.world import World

_STEP = 0.02  # m between the samples of a route
_FLOOR_ABOVE = 0.5  # m: height above the route at which rays down to the floor start
_FLOOR_OFF = 0.2  # m: a hit farther from the route's height is not the floor under a wheel


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveConfig:
    """Parameters of the robot's drive."""

    rate: float = 100.0
    """Poses per second of the trajectory [Hz]."""
    wheelbase: float = 0.6
    """Length over which changes of slope and curvature are smoothed [m]."""
    track: float = 0.5
    """Distance of left and right wheels [m]: the roll follows from the floor under them."""
    ramp: float = 2.0
    """Time from rest to cruise, and back at the end [s]."""
    most_turn_rate: float = 0.6
    """Fastest yaw rate [rad/s]; tighter corners are driven more slowly."""
    stand: float = 0.0
    """Time at rest before it starts [s]."""

    def __post_init__(self) -> None:
        check_options(self, "drive: ", {"≥ 0": "wheelbase stand", "> 0": "*"})


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledRoute:
    """A route over the floor, sampled evenly along its length.

    Parameters
    ----------
    step : float
        Between samples [m].
    positions : (n, 3)
        Of the base, on the floor [m].
    yaw, pitch, roll : (n,)
        Attitude, ``R_z(yaw) R_y(pitch) R_x(roll)`` [rad]; the yaw is not wrapped.
    """

    step: float
    positions: Array
    yaw: Array
    pitch: Array
    roll: Array


def sample_route(route: Route) -> SampledRoute:
    """Samples of a route; pitch is its slope, roll is 0."""
    s = route.every(min(_STEP, route.length / 16.0))  # a spline needs enough samples of a short route, too
    positions = route.positions(s)
    rise = np.gradient(positions[:, 2], s)  # central: a slope that jumps at a sample would be half a sample late
    return SampledRoute(
        step=float(s[1]),
        positions=positions,
        yaw=np.unwrap(route.headings(s)),
        pitch=-np.arcsin(np.clip(rise, -1.0, 1.0)),
        roll=np.zeros(len(s)),
    )


def smooth_route(route: SampledRoute, width: float) -> SampledRoute:
    """The same route without discontinuities of slope or curvature: everything is averaged over ``width`` metres.

    The pitch of a robot with a wheelbase changes gradually where the slope changes. The average is a triangle (two
    running means), so that pitch and yaw have a continuous rate.
    """
    half = round(0.5 * width / route.step) // 2 * 2 + 1  # samples of one running mean, odd
    if half < 3:
        return route
    pad = 2 * half

    def smooth(a: Array, *, straight: bool = False) -> Array:
        first, last = np.repeat(a[:1], pad, axis=0), np.repeat(a[-1:], pad, axis=0)
        if straight:  # extrapolate linearly, or the mean would shorten the route
            k = np.arange(1, pad + 1)[:, None]
            first, last = first - (k * (a[1] - a[0]))[::-1], last + k * (a[-1] - a[-2])
        wide = np.concatenate([first, a, last])
        for _ in range(2):
            wide = uniform_filter1d(wide, half, axis=0, mode="nearest")
        return np.asarray(wide[pad:-pad], dtype=np.float64)

    return SampledRoute(
        step=route.step,
        positions=smooth(route.positions, straight=True),
        yaw=smooth(route.yaw),
        pitch=smooth(route.pitch),
        roll=smooth(route.roll),
    )


class RouteMotion:
    """Position, attitude and their derivatives along a route of ``length`` [m], at any time from 0 to ``duration`` [s].

    Parameters
    ----------
    way : SampledRoute
        Smooth (:func:`smooth_route`).
    speed : float
        Cruise [m/s].
    """

    def __init__(self, route: SampledRoute, speed: float, config: DriveConfig) -> None:
        if not (np.isfinite(speed) and speed > 0):
            raise DataError("speed is impossible", got=speed, wanted="> 0 m/s")
        self.config = config
        self.length = float(np.sum(np.linalg.norm(np.diff(route.positions, axis=0), axis=1)))
        u = np.arange(len(route.yaw)) * route.step
        columns = np.column_stack([route.positions, route.yaw, route.pitch, route.roll])
        self._path: BSpline = make_interp_spline(u, columns, k=5)
        self._path1, self._path2 = self._path.derivative(1), self._path.derivative(2)

        # cruise time τ(u) = ∫ du / pace, the pace less than the speed where the route turns fast
        turning = np.abs(self._path1(u)[:, 3])
        pace = np.minimum(speed, config.most_turn_rate / np.maximum(turning, 1e-9))
        window = max(round(1.0 / route.step), 1)
        pace = minimum_filter1d(pace, window, mode="nearest")
        for _ in range(2):  # the running means stay within the widened minimum: never faster than allowed
            pace = uniform_filter1d(pace, max(window // 2, 1), mode="nearest")
        slowness = 1.0 / pace
        tau = np.concatenate([[0.0], np.cumsum(0.5 * (slowness[1:] + slowness[:-1]) * route.step)])
        self._cruise = float(tau[-1])
        self._along: BSpline = make_interp_spline(tau, u, k=3)
        self._along1, self._along2 = self._along.derivative(1), self._along.derivative(2)
        self._end = float(u[-1])
        self._ramp = min(config.ramp, self._cruise)
        self.duration = config.stand + self._cruise + self._ramp

    def _clock(self, t: Array) -> tuple[Array, Array, Array]:
        """Cruise time, and its two derivatives, at times: a smooth start and a smooth end of ``ramp`` seconds."""
        if not np.all((t >= -1e-9) & (t <= self.duration + 1e-9)):
            raise DataError(
                "time outside the drive", got=f"{t.min():.3f} … {t.max():.3f}", wanted=f"0 … {self.duration:.3f}"
            )
        r = self._ramp
        s = np.clip(t - self.config.stand, 0.0, self._cruise + r)
        a, b = np.clip(s / r, 0.0, 1.0), np.clip((self._cruise + r - s) / r, 0.0, 1.0)  # shares of the two ramps
        # rate of the clock: smoothstep 3x² - 2x³ of either share; its integral is x³ - x⁴/2, which ends at 1/2
        fa, fb = (3.0 - 2.0 * a) * a**2, (3.0 - 2.0 * b) * b**2
        rate = fa + fb - 1.0
        acceleration = (6.0 * a * (1.0 - a) - 6.0 * b * (1.0 - b)) / r
        before = r * (a**3 - 0.5 * a**4) + np.maximum(s - r, 0.0)
        lost = r * ((1.0 - b) - (0.5 - (b**3 - 0.5 * b**4)))  # distance lost to the cruise by the ramp at the end
        return before - lost, rate, acceleration

    def _progress(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Length driven and its derivatives by time."""
        tau, d1, d2 = self._clock(np.asarray(t, dtype=np.float64))
        tau = np.clip(tau, 0.0, self._cruise)
        e1 = self._along1(tau)
        return np.clip(self._along(tau), 0.0, self._end), e1 * d1, self._along2(tau) * d1**2 + e1 * d2

    def poses(self, t: ArrayLike) -> Array:
        """``T_world_base`` ``(n, 7)`` at times ``(n,)`` [s]."""
        angles = self._angles(np.asarray(t, dtype=np.float64))[0]
        position = self._path(self._progress(t)[0])[..., :3]
        return np.concatenate([position, euler_to_quat(angles[..., 0], angles[..., 1], angles[..., 2])], -1)

    def velocities(self, t: ArrayLike) -> Array:
        """World velocities of the base ``(n, 3)`` [m/s]."""
        u, du, _ = self._progress(t)
        return self._path1(u)[..., :3] * du[..., None]

    def accelerations(self, t: ArrayLike) -> Array:
        """World accelerations of the base ``(n, 3)`` [m/s²]."""
        u, du, ddu = self._progress(t)
        return self._path2(u)[..., :3] * du[..., None] ** 2 + self._path1(u)[..., :3] * ddu[..., None]

    def rotation(self, t: ArrayLike) -> tuple[Array, Array]:
        """Angular rates [rad/s] and angular accelerations [rad/s²] in the base frame, each ``(n, 3)``."""
        w, d1, d2 = self._angles(np.asarray(t, dtype=np.float64))
        pitch, roll = w[..., 1], w[..., 2]
        (yaw1, pitch1, roll1), (yaw2, pitch2, roll2) = np.moveaxis(d1, -1, 0), np.moveaxis(d2, -1, 0)
        sp, cp, sr, cr = np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll)
        # ω = (φ' - ψ' sin θ, θ' cos φ + ψ' sin φ cos θ, -θ' sin φ + ψ' cos φ cos θ), and its derivative
        rate = np.stack([roll1 - yaw1 * sp, pitch1 * cr + yaw1 * sr * cp, -pitch1 * sr + yaw1 * cr * cp], -1)
        change = np.stack(
            [
                roll2 - yaw2 * sp - yaw1 * pitch1 * cp,
                pitch2 * cr - pitch1 * roll1 * sr + yaw2 * sr * cp + yaw1 * (roll1 * cr * cp - pitch1 * sr * sp),
                -pitch2 * sr - pitch1 * roll1 * cr + yaw2 * cr * cp - yaw1 * (roll1 * sr * cp + pitch1 * cr * sp),
            ],
            -1,
        )
        return rate, change

    def _angles(self, t: Array) -> tuple[Array, Array, Array]:
        """Yaw, pitch and roll ``(n, 3)`` [rad], and their first two derivatives by time."""
        u, du, ddu = self._progress(t)
        w1 = self._path1(u)[..., 3:]
        d1 = w1 * du[..., None]
        return self._path(u)[..., 3:], d1, self._path2(u)[..., 3:] * du[..., None] ** 2 + w1 * ddu[..., None]

    def trajectory(self) -> Trajectory:
        """The drive at ``config.rate``, from 0 up to the last whole period."""
        n = int(np.floor(self.duration * self.config.rate + 1e-9)) + 1
        times = np.arange(n) / self.config.rate
        return Trajectory(times, self.poses(times))


def euler_to_quat(yaw: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> Array:
    """Quaternions ``(..., 4)`` (xyzw) of ``R_z(yaw) R_y(pitch) R_x(roll)``."""
    parts = []
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        half = 0.5 * np.asarray(angle, dtype=np.float64)
        q = np.zeros((*half.shape, 4))
        q[..., axis], q[..., 3] = np.sin(half), np.cos(half)
        parts.append(q)
    return quat_normalize(quat_multiply(quat_multiply(parts[0], parts[1]), parts[2]))


def roll_by_floor(route: SampledRoute, caster: RayCaster, track: float) -> SampledRoute:
    """The route with the roll of the floor under the wheels of a robot ``track`` metres wide.

    Rays are cast downwards on either side of the route. Where one of them hits no floor near the height of the route,
    the roll is unchanged.
    """
    left = np.column_stack([-np.sin(route.yaw), np.cos(route.yaw), np.zeros_like(route.yaw)])
    heights = []
    for side in (0.5, -0.5):
        begin = route.positions + side * track * left + [0.0, 0.0, _FLOOR_ABOVE]
        rays = np.hstack([begin, np.broadcast_to([0.0, 0.0, -1.0], begin.shape)])
        heights.append(begin[:, 2] - caster.ranges(rays))
    off = np.abs(np.array(heights) - route.positions[:, 2])
    seen = np.all(off < _FLOOR_OFF, axis=0)  # NaN, where no ray hit, is not less
    with np.errstate(invalid="ignore"):
        roll = np.where(seen, np.arctan2(heights[0] - heights[1], track), route.roll)
    return replace(route, roll=roll)


def drive_motion(world: World, config: DriveConfig = DriveConfig(), caster: RayCaster | None = None) -> RouteMotion:
    """The motion of a robot that drives through a world along its route; with a caster the roll follows the floor."""
    route = sample_route(world.route())
    if caster is not None:
        route = roll_by_floor(route, caster, config.track)
    return RouteMotion(smooth_route(route, config.wheelbase), world.speed, config)
