"""Sensor streams as arrays with their calibration.

Every record has ``times`` ``(n,)`` [s], strictly increasing in one clock per log. Constructors validate; readers drop
bad records with :meth:`graphslam.core.log.DropCounter.drop` *before* they make a stream. Extrinsics are
``T_base_sensor``: ``(3,)`` in 2-D, ``(7,)`` in 3-D.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask

IDENTITY2 = np.zeros(3)
IDENTITY3 = np.array([0.0, 0, 0, 0, 0, 0, 1])


@runtime_checkable
class Stream(Protocol):
    """Interface of a stream in a :class:`~graphslam.core.log.SensorLog`."""

    @property
    def times(self) -> Array: ...

    def take(self, index: Any) -> Self:
        """The records ``index`` (slice, mask or integer array) as a stream of the same kind."""
        ...


class RowStream:
    """A stream whose fields :attr:`ROWS` have one row for each stamp, or are None."""

    __slots__ = ()
    ROWS: ClassVar[tuple[str, ...]]

    def take(self, index: Any) -> Self:
        """See :class:`Stream`."""
        columns = {name: getattr(self, name) for name in self.ROWS}
        stream: Any = self
        return replace(stream, **{name: a if a is None else a[index] for name, a in columns.items()})


class RaggedStream:
    """A stream with several rows for each stamp: those of scan k begin at ``offsets[k]`` (n + 1,).

    The fields :attr:`ROWS` have these rows, or are None.
    """

    __slots__ = ()
    ROWS: ClassVar[tuple[str, ...]]
    times: Array
    offsets: npt.NDArray[np.int64]

    def _check_offsets(self, rows: int) -> None:
        object.__setattr__(self, "times", check_times(self.times))
        n = len(self.times)
        if len(self.offsets) != n + 1:
            raise DataError("offsets do not partition the observations", got=len(self.offsets), wanted=n + 1)
        offsets = np.ascontiguousarray(self.offsets, dtype=np.int64)
        object.__setattr__(self, "offsets", check_offsets(offsets, rows))

    def scan(self, k: int) -> slice:
        """Rows of scan k."""
        return slice(int(self.offsets[k]), int(self.offsets[k + 1]))

    def take(self, index: Any) -> Self:
        """See :class:`Stream`."""
        keep = np.arange(len(self.times))[index]
        parts = [np.arange(self.offsets[k], self.offsets[k + 1]) for k in keep]
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *parts])
        offsets = np.cumsum([0, *(len(part) for part in parts)], dtype=np.int64)
        columns = {name: getattr(self, name) for name in self.ROWS}
        stream: Any = self
        kept = {name: a if a is None else a[rows] for name, a in columns.items()}
        return replace(stream, times=self.times[keep], offsets=offsets, **kept)


PLAIN: dict[str, type[Any]] = {}
"""Record types whose fields are all numbers ``(n,)``, by type name in a stored log."""


def plain_record(kind: str) -> Any:
    """Register such a record type: logs and run folders store it."""

    def enter(cls: type[Any]) -> type[Any]:
        PLAIN[kind] = cls
        return cls

    return enter


def check_times(times: Any, n: int | None = None, *, where: str | None = None) -> Array:
    """Validate stamps ``(n,)``: finite, strictly increasing."""
    t = np.ascontiguousarray(times, dtype=np.float64)
    if t.ndim != 1 or (n is not None and len(t) != n):
        raise DataError("stamps have the wrong shape", where=where, got=t.shape, wanted=f"({n},)" if n else "(n,)")
    if not np.all(finite_mask(t)):
        k = int(np.flatnonzero(~finite_mask(t))[0])
        raise DataError(
            f"stamp of record {k} is not finite", where=where, got=t[k], wanted="seconds, with a decimal point"
        )
    bad = np.flatnonzero(np.diff(t) <= 0)
    if len(bad):
        k = int(bad[0]) + 1
        raise DataError(
            f"time does not increase at record {k}",
            where=where,
            got=f"{t[k]:.6f} after {t[k - 1]:.6f}",
            wanted="strictly increasing stamps: sort the records, or leave repeated ones out",
        )
    return t


def check_offsets(offsets: Any, total: int, *, where: str | None = None) -> npt.NDArray[np.int64]:
    """Validate ``(n + 1,)`` offsets that partition ``total`` rows: from 0, not decreasing, to ``total``."""
    a = np.asarray(offsets)
    if a.ndim != 1 or len(a) < 1 or a.dtype.kind not in "iu":
        raise DataError(
            "offsets have the wrong shape or type", where=where, got=f"{a.dtype} {a.shape}", wanted="(n+1,)"
        )
    a = np.ascontiguousarray(a, dtype=np.int64)
    if a[0] != 0 or np.any(np.diff(a) < 0):
        k = 0 if a[0] != 0 else int(np.flatnonzero(np.diff(a) < 0)[0]) + 1
        raise DataError(
            f"offset {k} is impossible", where=where, got=int(a[k]), wanted="offsets that begin with 0 and never fall"
        )
    if a[-1] != total:
        raise DataError(
            "offsets do not match the points",
            where=where,
            got=int(a[-1]),
            wanted=f"{total}, the last one of a partition",
        )
    return a


def array_of(x: Any, shape: tuple[int, ...], name: str) -> Array:
    """A float array of a shape; -1: any length."""
    a = np.ascontiguousarray(x, dtype=np.float64)
    if len(a.shape) != len(shape) or any(w not in (-1, g) for g, w in zip(a.shape, shape)):
        raise GeometryError(f"{name} has the wrong shape", got=a.shape, wanted=shape)
    return a


def finite(a: Array, name: str, what: str = "record") -> Array:
    """The array, if it is finite."""
    if not np.all(finite_mask(a)):
        k = int(np.argwhere(~finite_mask(a))[0][0])
        raise DataError(f"{name} of {what} {k} is not finite", got=a[k], wanted="finite numbers")
    return a


def positive(sigma: Any, n: int, what: str, unit: str) -> Array:
    """Standard deviations ``(n,)``, if they are positive."""
    a = finite(array_of(sigma, (n,), "sigma"), "sigma")
    if np.any(a <= 0):
        k = int(np.flatnonzero(a <= 0)[0])
        raise DataError(f"sigma of {what} {k} is not positive", got=a[k], wanted=f"> 0 {unit}")
    return a


def _covariances(covariances: Any, n: int, dim: int, what: str) -> Array:
    P = finite(array_of(covariances, (n, dim, dim), "covariances"), "covariance")
    skew, size = (np.abs(A).max(axis=(1, 2), initial=0.0) for A in (P - np.swapaxes(P, 1, 2), P))
    bad = (skew > 1e-6 * size) | (np.linalg.eigvalsh(P)[:, 0] <= 0)
    if np.any(bad):
        k = int(bad.argmax())
        raise DataError(f"covariance of {what} {k} is not symmetric and positive definite", got=P[k].tolist())
    return P


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserScans(RowStream):
    """Planar laser scans.

    Parameters
    ----------
    times : (n,) [s]
    ranges : (n, m)
        Metres, float32 or float64; ``nan`` or ≥ ``max_range`` means no return.
    bearings : (m,)
        Beam directions in the sensor frame, radians, counter-clockwise, strictly increasing.
    max_range : float
        Ranges at or above it are "no return".
    T_base_sensor : (3,) [m, m, rad]

    Examples
    --------
    >>> scans = gs.LaserScans(
    ...     times=np.array([0.0]), ranges=np.full((1, 181), 4.0), bearings=np.radians(np.arange(-90, 91)),
    ...     max_range=30.0,
    ... )
    >>> scans.ranges.shape
    (1, 181)
    """

    ROWS = ("times", "ranges")
    times: Array
    ranges: npt.NDArray[np.floating[Any]]
    bearings: Array
    max_range: float
    T_base_sensor: Array = field(default_factory=lambda: IDENTITY2.copy())

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_times(self.times, len(self.ranges)))
        object.__setattr__(self, "bearings", check_times(self.bearings, self.ranges.shape[1], where="beam bearings"))
        object.__setattr__(self, "T_base_sensor", array_of(self.T_base_sensor, (3,), "T_base_sensor"))


@dataclass(frozen=True, slots=True, kw_only=True)
class AckermannGeometry:
    """Car-like vehicle; base = centre of the rear axle.

    Parameters
    ----------
    wheelbase : float
        L, rear to front axle [m].
    encoder_offset : float
        H, rear-axle centre to the wheel whose speed is measured, positive left [m]; 0 if speed is that of the centre.
    model : {"rear-axle", "front-steer"}
        ``rear-axle``: v is the speed of the rear axle, φ̇ = v tan(α)/L. ``front-steer``: v is the speed of the front
        wheel and the base moves along it, x' = x + v dt cos(α + φ), φ' = φ + v dt sin(α)/L (the classic steering-model
        simulator of Combined SLAM, section B).
    """

    wheelbase: float
    encoder_offset: float = 0.0
    model: str = "rear-axle"

    def __post_init__(self) -> None:
        if not (finite_mask(self.wheelbase) and self.wheelbase > 0):
            raise GeometryError("wheelbase is impossible", got=self.wheelbase, wanted="> 0 m")
        if not finite_mask(self.encoder_offset):
            raise GeometryError("encoder offset is not finite", got=self.encoder_offset)
        if self.model not in ("rear-axle", "front-steer"):
            raise GeometryError("unknown steering model", got=self.model, wanted="rear-axle or front-steer")


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringControls(RowStream):
    """Speed and steering of a car-like vehicle, held constant from each stamp to the next (zero-order hold).

    Parameters
    ----------
    times : (n,) [s]
    speed : (n,)
        Wheel speed [m/s].
    steering : (n,)
        Steering angle [rad], positive left.
    geometry : AckermannGeometry

    Examples
    --------
    >>> from graphslam.core.records import AckermannGeometry
    >>> car = gs.SteeringControls(
    ...     times=np.array([0.0, 0.1]), speed=np.array([2.0, 2.0]), steering=np.array([0.0, 0.05]),
    ...     geometry=AckermannGeometry(wheelbase=2.8),
    ... )
    >>> car.speed
    array([2., 2.])
    """

    ROWS = ("times", "speed", "steering")
    times: Array
    speed: Array
    steering: Array
    geometry: AckermannGeometry

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_times(self.times))
        n = len(self.times)
        for name in ("speed", "steering"):
            object.__setattr__(self, name, finite(array_of(getattr(self, name), (n,), name), name))


@plain_record("velocity-controls")
@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityControls(RowStream):
    """Speed and yaw rate of a base that moves along its own x axis, held from each stamp to the next (zero-order hold).

    Commanded or measured; without a covariance, as :class:`SteeringControls`: the noise is part of the front end's
    motion model.

    Parameters
    ----------
    times : (n,) [s]
    speed : (n,)
        Along x of the base [m/s], negative backwards.
    yaw_rate : (n,)
        [rad/s], positive counter-clockwise.

    Examples
    --------
    >>> drive = gs.VelocityControls(times=np.arange(3.0), speed=np.ones(3), yaw_rate=np.zeros(3))
    >>> drive.take(np.array([1])).speed
    array([1.])
    """

    ROWS = ("times", "speed", "yaw_rate")
    times: Array
    speed: Array
    yaw_rate: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_times(self.times))
        n = len(self.times)
        for name in ("speed", "yaw_rate"):
            object.__setattr__(self, name, finite(array_of(getattr(self, name), (n,), name), name))


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry(RowStream):
    """Motion between stamps: record k is ``T_body(k-1)_body(k)``; record 0 is identity.

    Parameters
    ----------
    times : (n,) [s]
    increments : (n, 3) [m, m, rad] or (n, 7), position [m] and quaternion (x, y, z, w)
    covariances : (n, d, d)
        Right tangent at the later pose. Required.

    Examples
    --------
    >>> steps = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1]])
    >>> sure = np.tile(0.01 * np.eye(3), (2, 1, 1))
    >>> wheels = gs.Odometry(times=np.array([0.0, 1.0]), increments=steps, covariances=sure)
    >>> wheels.increments[1]
    array([0.5, 0. , 0.1])
    """

    ROWS = ("times", "increments", "covariances")
    times: Array
    increments: Array
    covariances: Array

    def __post_init__(self) -> None:
        n = len(self.times)
        object.__setattr__(self, "times", check_times(self.times))
        object.__setattr__(self, "increments", finite(array_of(self.increments, (n, -1), "increments"), "increment"))
        d = 3 if self.increments.shape[1] == 3 else 6
        object.__setattr__(
            self, "covariances", finite(array_of(self.covariances, (n, d, d), "covariances"), "covariance")
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Gps(RowStream):
    """Position fixes in a local metric frame (x east, y north[, z up]).

    Parameters
    ----------
    times : (n,) [s]
    positions : (n, 2) or (n, 3) [m]
    sigma : (n,)
        Standard deviation of each coordinate [m].
    lever : (2,) or (3,)
        Antenna in the base frame [m].
    covariances : (n, c, c) or None
        Covariances in the frame of the positions [m²]; they replace ``sigma``.

    Examples
    --------
    >>> fixes = gs.Gps(times=np.arange(3.0), positions=np.zeros((3, 2)), sigma=np.full(3, 0.5), lever=np.zeros(2))
    >>> fixes.take(np.array([0, 2])).times
    array([0., 2.])
    """

    ROWS = ("times", "positions", "sigma", "covariances")
    times: Array
    positions: Array
    sigma: Array
    lever: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.times)
        object.__setattr__(self, "times", check_times(self.times))
        object.__setattr__(self, "positions", finite(array_of(self.positions, (n, -1), "positions"), "position"))
        object.__setattr__(self, "sigma", positive(self.sigma, n, "GPS record", "m"))
        object.__setattr__(self, "lever", array_of(self.lever, (self.positions.shape[1],), "lever"))
        if self.covariances is not None:
            P = _covariances(self.covariances, n, self.positions.shape[1], "GPS record")
            object.__setattr__(self, "covariances", P)

    @classmethod
    def upright(
        cls, *, times: Array, positions: Array, horizontal: npt.ArrayLike, vertical: npt.ArrayLike, lever: Array
    ) -> Gps:
        """3-D fixes with separate horizontal and vertical σ.

        Parameters
        ----------
        times, positions, lever
            As in the class, 3-D.
        horizontal, vertical : float or (n,)
            Standard deviations of x and y, and of z [m].
        """
        h, v = (np.broadcast_to(np.asarray(s, dtype=np.float64), len(times)) for s in (horizontal, vertical))
        P = np.stack([h, h, v], axis=-1)[:, :, None] ** 2 * np.eye(3)
        return cls(times=times, positions=positions, sigma=h.copy(), lever=lever, covariances=P)

    def with_sigma(self, sigma: float | None) -> Gps:
        """The same fixes with one standard deviation for all coordinates [m]; None: unchanged."""
        return self if sigma is None else replace(self, sigma=np.full(len(self.times), sigma), covariances=None)

    @property
    def noise(self) -> Array:
        """Covariances ``(n, c, c)`` of the fixes [m²]."""
        if self.covariances is not None:
            return self.covariances
        return np.asarray(self.sigma[:, None, None] ** 2 * np.eye(self.positions.shape[1]))


@plain_record("compass")
@dataclass(frozen=True, slots=True, kw_only=True)
class Compass(RowStream):
    """Headings of a magnetic compass.

    Parameters
    ----------
    times : (n,) [s]
    headings : (n,)
        Of the body's x axis [rad], counter-clockwise from magnetic east. For a compass that counts clockwise from north
        it is ``π/2`` minus its reading.
    sigma : (n,)
        Standard deviation [rad].
    """

    ROWS = ("times", "headings", "sigma")
    times: Array
    headings: Array
    sigma: Array

    def __post_init__(self) -> None:
        n = len(self.times)
        object.__setattr__(self, "times", check_times(self.times))
        object.__setattr__(self, "headings", finite(array_of(self.headings, (n,), "headings"), "heading"))
        object.__setattr__(self, "sigma", positive(self.sigma, n, "compass reading", "rad"))


@plain_record("barometer")
@dataclass(frozen=True, slots=True, kw_only=True)
class Barometer(RowStream):
    """Barometric heights of the body, relative to an unknown level.

    Parameters
    ----------
    times : (n,) [s]
    heights : (n,)
        [m], upwards.
    sigma : (n,)
        Standard deviation [m]; the level is constant in a log, so σ includes changes of the weather.
    """

    ROWS = ("times", "heights", "sigma")
    times: Array
    heights: Array
    sigma: Array

    def __post_init__(self) -> None:
        n = len(self.times)
        object.__setattr__(self, "times", check_times(self.times))
        object.__setattr__(self, "heights", finite(array_of(self.heights, (n,), "heights"), "height"))
        object.__setattr__(self, "sigma", positive(self.sigma, n, "barometer reading", "m"))


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkObservations(RaggedStream):
    """Range-bearing or range-only observations of point landmarks, several per scan (ragged).

    Parameters
    ----------
    times : (n,)
        Scan stamps; a scan can be empty.
    offsets : (n + 1,) int64
        Observations of scan k are rows ``offsets[k]:offsets[k + 1]``.
    ranges, bearings : (q,)
        Metres, radians in the sensor frame; the bearing of a range-only observation is 0.
    sigmas : (q, 2)
        Standard deviations of range [m] and bearing [rad]; a bearing σ of ``inf`` means no bearing (:meth:`range_only`
        builds such a stream).
    ids : (q,) int64 or None
        Known identity; -1 if unknown; None if the sensor gives none.
    max_range : float [m]
    field_of_view : (2,)
        Least and largest bearing [rad].
    T_base_sensor : (3,) [m, m, rad]

    Examples
    --------
    >>> seen = gs.LandmarkObservations(
    ...     times=np.array([0.0, 0.2]), offsets=np.array([0, 2, 3]), ranges=np.array([5.0, 8.0, 7.9]),
    ...     bearings=np.array([0.1, -0.4, -0.38]), sigmas=np.tile([0.1, 0.02], (3, 1)),
    ... )
    >>> seen.offsets[-1]
    np.int64(3)
    """

    ROWS = ("ranges", "bearings", "sigmas", "ids")
    times: Array
    offsets: npt.NDArray[np.int64]
    ranges: Array
    bearings: Array
    sigmas: Array
    ids: npt.NDArray[np.int64] | None = None
    max_range: float = np.inf
    field_of_view: tuple[float, float] = (-np.pi, np.pi)
    T_base_sensor: Array = field(default_factory=lambda: IDENTITY2.copy())

    def __post_init__(self) -> None:
        q = len(self.ranges)
        self._check_offsets(q)
        for name, shape in (("ranges", (q,)), ("bearings", (q,)), ("sigmas", (q, 2))):
            object.__setattr__(self, name, array_of(getattr(self, name), shape, name))
        blind = np.isposinf(self.sigmas[:, 1])
        finite(self.ranges, "ranges")
        finite(self.bearings, "bearings")
        finite(np.where(blind[:, None], self.sigmas[:, :1], self.sigmas), "sigmas")
        if np.any(blind & (self.bearings != 0.0)):
            k = int(np.flatnonzero(blind & (self.bearings != 0.0))[0])
            raise DataError(
                f"observation {k} has a bearing and infinite σ of it", got=self.bearings[k], wanted="0 where σ is inf"
            )
        if q and np.any(self.sigmas <= 0):
            k = int(np.argwhere(self.sigmas <= 0)[0][0])
            raise DataError(f"sigma of observation {k} is not positive", got=self.sigmas[k], wanted="> 0")
        if self.ids is not None:
            object.__setattr__(self, "ids", np.ascontiguousarray(self.ids, dtype=np.int64))
            if self.ids.shape != (q,):
                raise DataError("ids and observations differ in number", got=self.ids.shape, wanted=f"({q},)")
        object.__setattr__(self, "T_base_sensor", array_of(self.T_base_sensor, (3,), "T_base_sensor"))

    @classmethod
    def range_only(
        cls,
        *,
        times: Array,
        offsets: npt.NDArray[np.int64],
        ranges: Array,
        range_sigma: npt.ArrayLike,
        ids: npt.NDArray[np.int64] | None = None,
        **rest: Any,
    ) -> LandmarkObservations:
        """Observations without bearings: bearing 0 with infinite σ.

        Parameters
        ----------
        times, offsets, ranges, ids
            As in the class.
        range_sigma : float or (q,)
            σ of each range [m].
        **rest
            Other fields of the class.
        """
        q = len(ranges)
        sigmas = np.column_stack([np.broadcast_to(np.asarray(range_sigma, dtype=np.float64), q), np.full(q, np.inf)])
        return cls(times=times, offsets=offsets, ranges=ranges, bearings=np.zeros(q), sigmas=sigmas, ids=ids, **rest)

    @property
    def has_bearing(self) -> npt.NDArray[np.bool_]:
        """Mask of the observations with a bearing ``(q,)``."""
        return np.asarray(np.isfinite(self.sigmas[:, 1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointObservations(RaggedStream):
    """Observations of identified 3-D points, several per scan (ragged), e.g. from a stereo or depth camera.

    Parameters
    ----------
    times : (n,)
        Scan stamps; a scan can be empty.
    offsets : (n + 1,) int64
        Observations of scan k are rows ``offsets[k]:offsets[k + 1]``.
    points : (q, 3)
        In the sensor frame [m].
    covariances : (q, 3, 3) [m²]
    ids : (q,) int64
        Identity of each, not negative; unique in a scan.
    T_base_sensor : (7,), position [m] and quaternion (x, y, z, w)

    Examples
    --------
    >>> seen = gs.PointObservations(
    ...     times=np.array([0.0, 0.2]), offsets=np.array([0, 2, 3]), points=np.ones((3, 3)),
    ...     covariances=np.tile(0.01 * np.eye(3), (3, 1, 1)), ids=np.array([4, 7, 4]),
    ... )
    >>> seen.take(slice(1, 2)).ids
    array([4])
    """

    ROWS = ("points", "covariances", "ids")
    times: Array
    offsets: npt.NDArray[np.int64]
    points: Array
    covariances: Array
    ids: npt.NDArray[np.int64]
    T_base_sensor: Array = field(default_factory=lambda: IDENTITY3.copy())

    def __post_init__(self) -> None:
        q = len(self.points)
        self._check_offsets(q)
        object.__setattr__(self, "points", finite(array_of(self.points, (q, 3), "points"), "points"))
        object.__setattr__(self, "covariances", _covariances(self.covariances, q, 3, "observation"))
        ids = np.ascontiguousarray(self.ids, dtype=np.int64)
        if ids.shape != (q,) or np.any(ids < 0):
            raise DataError("ids of points are missing or negative", got=ids.shape, wanted=f"({q},), each ≥ 0")
        scan = np.repeat(np.arange(len(self.times)), np.diff(self.offsets))
        if len(np.unique(np.column_stack([scan, ids]), axis=0)) < q:
            raise DataError("an id is repeated in one scan", wanted="each once")
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "T_base_sensor", array_of(self.T_base_sensor, (7,), "T_base_sensor"))
