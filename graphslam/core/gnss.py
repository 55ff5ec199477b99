"""Raw GNSS measurements: pseudoranges."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError
from graphslam.core.geodesy import geodetic_to_ecef, tangent_axes
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.records import RaggedStream, array_of, finite, positive

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s]"""
EARTH_RATE = 7.2921151467e-5
"""Rotation rate of the Earth as defined by GPS [rad/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pseudoranges(RaggedStream):
    """Pseudoranges of several satellites at each epoch (ragged).

    A pseudorange is the distance to the satellite plus the receiver clock offset times the speed of light, corrected
    for satellite clocks and the atmosphere as far as known.

    Parameters
    ----------
    times : (n,)
        Epochs [s].
    offsets : (n + 1,) int64
        Pseudoranges of epoch k are rows ``offsets[k]:offsets[k + 1]``; an epoch may be empty.
    ranges, sigmas : (q,)
        Pseudoranges and their standard deviations [m].
    satellites : (q, 3)
        Satellite position at transmission, in the Earth-fixed axes of that time [m].
    ids, systems : (q,) int64
        Number of the satellite, unique over all systems; system (one of several, each with its own time scale).
    elevation : (q,)
        Of the satellite above the horizon [rad].
    density : (q,)
        Carrier-to-noise density ratio C/N0 [dBHz].
    lever : (3,)
        Antenna in the base frame [m].
    """

    ROWS = ("ranges", "sigmas", "satellites", "ids", "systems", "elevation", "density")
    times: Array
    offsets: npt.NDArray[np.int64]
    ranges: Array
    sigmas: Array
    satellites: Array
    ids: npt.NDArray[np.int64]
    systems: npt.NDArray[np.int64]
    elevation: Array
    density: Array
    lever: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        q = len(self.ranges)
        self._check_offsets(q)
        shapes = {"satellites": (q, 3), "lever": (3,)}
        for name in ("ranges", "satellites", "elevation", "density", "lever"):
            a = array_of(getattr(self, name), shapes.get(name, (q,)), name)
            object.__setattr__(self, name, finite(a, name, "pseudorange"))
        object.__setattr__(self, "sigmas", positive(self.sigmas, q, "pseudorange", "m"))
        for name in ("ids", "systems"):
            w = np.ascontiguousarray(getattr(self, name), dtype=np.int64)
            if w.shape != (q,):
                raise GeometryError(f"{name} has the wrong shape", got=w.shape, wanted=(q,))
            object.__setattr__(self, name, w)

    @property
    def epochs(self) -> npt.NDArray[np.int64]:
        """Epoch of every pseudorange ``(q,)``."""
        return np.repeat(np.arange(len(self.times)), np.diff(self.offsets))


@dataclass(frozen=True, slots=True)
class TangentPlane:
    """Local frame (east, north, up) for GNSS positions.

    Parameters
    ----------
    latitude, longitude : float
        [deg]
    height : float
        Above the ellipsoid [m].
    """

    latitude: float
    longitude: float
    height: float = 0.0

    @property
    def origin(self) -> Array:
        """Earth-centred ``(3,)`` [m]."""
        return geodetic_to_ecef([self.latitude, self.longitude, self.height])

    def from_ecef(self, points: ArrayLike) -> Array:
        """East, north, up ``(..., 3)`` of Earth-centred points ``(..., 3)``."""
        axes = tangent_axes(self.latitude, self.longitude)
        return np.asarray((np.asarray(points, dtype=np.float64) - self.origin) @ axes.T)

    def satellites(self, sent: ArrayLike) -> Array:
        """Satellites ``(q, 3)`` in this frame at the reception time of their signals (east, north, up).

        The Earth rotates while a signal travels: in the axes at reception the satellite is 20 to 30 m farther west.
        Without this correction every position is too far east by as much.

        Parameters
        ----------
        sent : (q, 3)
            Earth-fixed axes at transmission [m].
        """
        s = np.asarray(sent, dtype=np.float64)
        a = EARTH_RATE / SPEED_OF_LIGHT * np.linalg.norm(s - self.origin, axis=-1)
        c, d = np.cos(a), np.sin(a)
        return self.from_ecef(np.stack([c * s[..., 0] + d * s[..., 1], c * s[..., 1] - d * s[..., 0], s[..., 2]], -1))
