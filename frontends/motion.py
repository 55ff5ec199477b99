"""Dead reckoning between stamps from speed and steering, with an honest covariance.

Noise of real vehicles is not white per control step (side slip and steering offsets last for seconds), so the noise
model has a part that is constant over one increment and a part that grows with the distance driven.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frontends.motion_kernels import FRONT_STEER, REAR_AXLE, steering_increments_kernel
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.records import Odometry, SteeringControls, check_times


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionNoise:
    """Noise of one dead-reckoning increment (right tangent at its end)."""

    speed: float = 0.3
    """σ of the measured speed [m/s]."""
    speed_fraction: float = 0.0
    """Part of σ proportional to speed: σ² = speed² + (speed_fraction · v)²."""
    steering: float = float(np.deg2rad(3.0))
    """σ of the measured steering angle [rad]."""
    per_increment: bool = False
    """True: speed and steering errors are constant over an increment; False: independent per control step."""
    lateral: float = 0.0
    """σ of side slip per metre driven [m/m], drawn per increment."""
    heading: float = 0.0
    """σ of heading drift per metre driven [rad/m], drawn per increment."""
    floor_position: float = 1e-4
    """σ added to x and y of every increment [m]: keeps a standing vehicle's covariance invertible."""
    floor_heading: float = 1e-5
    """σ added to the heading of every increment [rad]."""

    def __post_init__(self) -> None:
        for name in ("speed", "speed_fraction", "steering", "lateral", "heading"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"motion noise {name} = {getattr(self, name)}; wanted ≥ 0")
        if not (self.floor_position > 0 and self.floor_heading > 0):
            raise ConfigError("motion noise floors must be > 0: an increment needs an invertible covariance")

    def as_array(self) -> Array:
        """The order the kernel expects."""
        return np.array(
            [
                self.speed,
                self.speed_fraction,
                self.steering,
                float(self.per_increment),
                self.lateral,
                self.heading,
                self.floor_position,
                self.floor_heading,
            ]
        )


def steering_odometry(controls: SteeringControls, times: Array, noise: MotionNoise) -> Odometry:
    """Increments between consecutive ``times`` from zero-order-hold controls.

    Parameters
    ----------
    controls : SteeringControls
        Held constant from each stamp to the next; the last one is held to the end.
    times : (n,)
        Stamps of the poses, strictly increasing, none before the first control.
    noise : MotionNoise

    Returns
    -------
    Odometry
        Record 0 is the identity with the floor covariance; record k takes ``times[k - 1]`` to ``times[k]``.

    Raises
    ------
    DataError
        If a stamp lies before the first control.
    """
    t = check_times(times)
    if t[0] < controls.times[0]:
        raise DataError(
            "pose stamp before the first control", got=f"{t[0]:.3f} s", wanted=f"≥ {controls.times[0]:.3f} s"
        )
    # fine steps: the union of control stamps and pose stamps, so controls are constant inside every step
    inside = controls.times[(controls.times > t[0]) & (controls.times < t[-1])]
    knots = np.union1d(inside, t)
    active = np.searchsorted(controls.times, knots[:-1], side="right") - 1
    first = np.searchsorted(knots, t).astype(np.int64)
    n = len(t)
    increments, covs = np.zeros((n, 3)), np.zeros((n, 3, 3))
    covs[0] = np.diag([noise.floor_position**2, noise.floor_position**2, noise.floor_heading**2])
    g = controls.geometry
    models = {"rear-axle": REAR_AXLE, "front-steer": FRONT_STEER}
    if g.model not in models:
        raise ConfigError(f"unknown steering model {g.model!r}; known: {', '.join(models)}")
    if n > 1:
        steering_increments_kernel(
            np.diff(knots),
            controls.speed[active],
            controls.steering[active],
            first,
            models[g.model],
            g.wheelbase,
            g.encoder_offset,
            noise.as_array(),
            increments[1:],
            covs[1:],
        )
    return Odometry(times=t, increments=increments, covariances=covs)
