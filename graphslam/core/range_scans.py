"""Scans of a range finder with an optionally spinning head: each beam has its own time and direction."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.reading import finite_mask
from graphslam.core.records import RowStream, check_times
from graphslam.core.se3 import quat_multiply, quat_rotate


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeScans(RowStream):
    """Scans of one scanner.

    Beam j of scan k is emitted at ``times[k] + beam_times[j]``, with the head at the angle
    ``spin[k] + spin_rate[k] · beam_times[j]`` about the x axis of its mount.

    Parameters
    ----------
    times : (n,)
        Stamps of the first beams [s].
    ranges : (n, m)
        Metres, float32 or float64; NaN: no reading; ≥ ``max_range``: no return.
    directions : (m, 3)
        Unit vectors, frame of the head.
    beam_times : (m,)
        Seconds after the stamp, not decreasing.
    max_range : float [m]
    sigma : float
        Standard deviation of a range [m].
    T_base_mount : (7,)
        Mount of the head in the base.
    spin, spin_rate : (n,)
        Angle at the stamp [rad] and its rate [rad/s]; zeros for a fixed head.

    Examples
    --------
    >>> ahead = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    >>> scans = gs.RangeScans(
    ...     times=np.array([0.0]), ranges=np.array([[3.0, 4.0]]), directions=ahead, beam_times=np.zeros(2),
    ...     max_range=30.0, sigma=0.02,
    ... )
    >>> scans.ranges.shape
    (1, 2)
    """

    ROWS = ("times", "ranges", "spin", "spin_rate")
    times: Array
    ranges: npt.NDArray[np.floating[Any]]
    directions: Array
    beam_times: Array
    max_range: float
    sigma: float
    T_base_mount: Array = field(default_factory=lambda: np.array([0.0, 0, 0, 0, 0, 0, 1]))
    spin: Array | None = None
    spin_rate: Array | None = None

    def __post_init__(self) -> None:
        ranges = np.ascontiguousarray(self.ranges)
        if ranges.ndim != 2 or ranges.dtype.kind != "f":
            raise DataError(
                "ranges have the wrong shape or type", got=f"{ranges.dtype} {ranges.shape}", wanted="(n, m)"
            )
        n, m = ranges.shape
        set_ = object.__setattr__
        set_(self, "ranges", ranges)
        set_(self, "times", check_times(self.times, n))
        for name, shape in (("directions", (m, 3)), ("beam_times", (m,)), ("T_base_mount", (7,))):
            set_(self, name, _finite(getattr(self, name), shape, name))
        for name in ("spin", "spin_rate"):
            value = getattr(self, name)
            set_(self, name, np.zeros(n) if value is None else _finite(value, (n,), name))
        length = np.linalg.norm(self.directions, axis=1)
        if np.any(np.abs(length - 1.0) > 1e-6):
            k = int(np.argmax(np.abs(length - 1.0)))
            raise GeometryError(f"direction of beam {k} is no unit vector", got=length[k], wanted="length 1")
        if np.any(np.diff(self.beam_times) < 0) or (m and self.beam_times[0] < 0):
            raise DataError("times of the beams fall, or are before the stamp", got=self.beam_times[:3], wanted="≥ 0")
        for name in ("max_range", "sigma"):
            if not (finite_mask(getattr(self, name)) and getattr(self, name) > 0):
                raise DataError(f"{name} is impossible", got=getattr(self, name), wanted="> 0 m")

    def beam_directions(self, record: Any, beam: Any) -> Array:
        """Unit directions ``(..., 3)`` of beams ``beam`` of scans ``record`` (broadcast), base frame at their own time.

        Vehicle motion between beams is not included.
        """
        assert self.spin is not None
        assert self.spin_rate is not None
        angle = self.spin[record] + self.spin_rate[record] * self.beam_times[beam]
        turn = np.zeros((*angle.shape, 4))
        turn[..., 0], turn[..., 3] = np.sin(0.5 * angle), np.cos(0.5 * angle)
        q = quat_multiply(np.broadcast_to(self.T_base_mount[3:], turn.shape), turn)
        return quat_rotate(q, np.broadcast_to(self.directions[beam], (*angle.shape, 3)))

    def head_rays(self, index: Any = slice(None)) -> tuple[Array, Array]:
        """Origin ``(3,)`` and unit directions ``(k, m, 3)`` of whole scans; see :meth:`beam_directions`."""
        record = np.arange(len(self.times))[index]
        return self.T_base_mount[:3].copy(), self.beam_directions(record[:, None], np.arange(len(self.beam_times)))


def _finite(value: Any, shape: tuple[int, ...], name: str) -> Array:
    a = np.ascontiguousarray(value, dtype=np.float64)
    if a.shape != shape:
        raise GeometryError(f"{name} has the wrong shape", got=a.shape, wanted=shape)
    if not np.all(finite_mask(a)):
        raise DataError(f"{name} is not finite", got=a[~finite_mask(a)][0], wanted="finite numbers")
    return a
