"""Inertial measurements with their noise model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask
from graphslam.core.records import RowStream, check_times

GRAVITY = 9.80665


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise:
    """Continuous noise model: densities, and random walks of the biases."""

    gyro: float
    """Noise density of the angular rate [rad/s/√Hz]."""
    gyro_bias: float
    """σ of the angular rate's constant bias at the start [rad/s]."""
    gyro_walk: float
    """Random walk of that bias [rad/s/√s]."""
    accelerometer: float
    """Noise density of the specific force [m/s²/√Hz]."""
    accelerometer_bias: float
    """σ of its constant bias [m/s²]."""
    accelerometer_walk: float
    """Random walk of that bias [m/s²/√s]."""
    attitude: float = 0.0
    """σ of the unit's roll and pitch [rad]; 0 if it has none."""
    attitude_time: float = 1.0
    """Correlation time of the roll and pitch errors [s]."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (finite_mask(value) and value >= 0):
                raise DataError(f"IMU noise {name} is impossible", got=value, wanted="≥ 0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu(RowStream):
    """Angular rates and specific forces.

    A planar IMU (yaw rate and two accelerations without gravity) has zero rates about x and y and zero forces along z
    in every record. 2-D graphs use it, and also a three-axis unit on a level body.

    Parameters
    ----------
    times : (n,) [s]
    angular_rate : (n, 3)
        [rad/s], frame of the unit.
    specific_force : (n, 3)
        [m/s²], frame of the unit; (0, 0, +g) at rest and level, (0, 0, 0) for a planar unit.
    noise : ImuNoise
    attitude : (n, 2) or None
        Roll and pitch estimated by the unit [rad].
    T_base_imu : (7,), position [m] and quaternion (x, y, z, w)

    Examples
    --------
    >>> from graphslam.core.imu import ImuNoise
    >>> at_rest = np.tile([0.0, 0.0, 9.81], (100, 1))
    >>> noise = ImuNoise(
    ...     gyro=1e-3, gyro_bias=1e-3, gyro_walk=1e-5,
    ...     accelerometer=1e-2, accelerometer_bias=1e-2, accelerometer_walk=1e-4,
    ... )
    >>> imu = gs.Imu(times=np.arange(100) / 100, angular_rate=np.zeros((100, 3)), specific_force=at_rest, noise=noise)
    >>> len(imu.times)
    100
    """

    ROWS = ("times", "angular_rate", "specific_force", "attitude")
    times: Array
    angular_rate: Array
    specific_force: Array
    noise: ImuNoise
    attitude: Array | None = None
    T_base_imu: Array = field(default_factory=lambda: np.array([0.0, 0, 0, 0, 0, 0, 1]))

    def __post_init__(self) -> None:
        n = len(self.times)
        object.__setattr__(self, "times", check_times(self.times))
        shapes: list[tuple[str, tuple[int, ...]]] = [("angular_rate", (n, 3)), ("specific_force", (n, 3))]
        if self.attitude is not None:
            shapes.append(("attitude", (n, 2)))
        for name, shape in [*shapes, ("T_base_imu", (7,))]:
            a = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if a.shape != shape:
                raise GeometryError(f"IMU {name} has the wrong shape", got=a.shape, wanted=shape)
            if not np.all(finite_mask(a)):
                k = int(np.argwhere(~finite_mask(a))[0][0])
                raise DataError(f"IMU {name} of record {k} is not finite", got=a[k], wanted="finite numbers")
            object.__setattr__(self, name, a)

    @property
    def planar(self) -> bool:
        """Whether it is a planar IMU (yaw rate, two accelerations without gravity)."""
        return not (np.any(self.angular_rate[:, :2]) or np.any(self.specific_force[:, 2]))
