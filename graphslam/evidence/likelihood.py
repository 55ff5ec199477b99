"""Likelihood of a scan given an evidence grid: the weights of particles.

There are two likelihoods. *End points*: the occupancy of the map where beams ended; it is broad and fast. *Casting*:
the measured range against the expected range; it is much sharper and needs stronger tempering. Beams of one scan are
not independent (neighbouring beams hit the same wall, with the same map error), so the sum of log-likelihoods is
scaled by an exponent. The exponent has no default; choose it by the *effective* number of beams per resampling step,
exponent × beams: some tens for end points and a few for casting keep about half of the particles effective.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.evidence.cast_kernels import HIT, INSIDE, UNKNOWN_SPACE, UNUSABLE
from graphslam.evidence.queries import cast_grids, endpoint_probability
from graphslam.evidence.scan import scan_rows

if TYPE_CHECKING:
    from graphslam.evidence.grid import EvidenceGrid


@dataclass(frozen=True, slots=True)
class EndpointLikelihood:
    """Log-likelihood ``log(floor + (1 - floor) p)`` of a beam whose end point has occupancy probability p in the map.

    Beams without a return within the maximum range are not used.

    Parameters
    ----------
    exponent : float
        Scale of the sum over beams; exponent × beams is the effective number of beams.
    floor : float
        Probability that a beam is an outlier, independent of the map.
    interpolation : {"trilinear", "nearest"}
    unknown : float
        Occupancy probability of unknown voxels.
    """

    exponent: float
    floor: float = 0.05
    interpolation: Literal["trilinear", "nearest"] = "trilinear"
    unknown: float = 0.5

    def __post_init__(self) -> None:
        ranges = {"> 0": "exponent", "in (0, 1)": "floor", "in [0, 1]": "unknown"}
        check_options(self, "end-point likelihood: ", ranges)

    def beams(self, probability: Any) -> Array:
        """Log-likelihood of each beam; 0 for NaN (points that are not finite)."""
        p = np.asarray(probability, dtype=np.float64)
        return np.nan_to_num(np.log(self.floor + (1.0 - self.floor) * p), nan=0.0)


@dataclass(frozen=True, slots=True)
class CastLikelihood:
    """Log-likelihood ``-½ min(z², clip²)``, ``z = (measured - expected range) / sigma``, of each beam.

    The Gaussian constant is the same for all particles and is omitted, so 0 means perfect agreement. A beam without a
    return is measured at the maximum range; a beam that hits nothing in the map within the maximum range is expected
    there.

    Parameters
    ----------
    exponent : float
        Scale of the sum over beams; exponent × beams is the effective number of beams.
    sigma : float
        Standard deviation of measured minus expected range [m]: sensor, voxel size, pose and map together.
    clip : float
        Upper bound of abs(z), because of moving objects and holes in the map.
    ignore_unknown : bool
        True: unknown voxels are treated as free. False: a beam that reaches an unknown voxel before an occupied one
        gets abs(z) = ``unknown``, or more if it was measured shorter than the range of that voxel.
    unknown : float, optional
        See ``ignore_unknown``; default ``clip``, so that maps with much unknown space are not preferred.
    """

    exponent: float
    sigma: float = 0.2
    clip: float = 3.0
    ignore_unknown: bool = True
    unknown: float | None = None

    def __post_init__(self) -> None:
        check_options(self, "cast likelihood: ", {"> 0": "exponent sigma clip"})
        if self.unknown is not None and not 0.0 <= self.unknown <= self.clip:
            raise ConfigError(f"cast likelihood: unknown = {self.unknown}; wanted 0 … clip ({self.clip})")

    def beams(self, expected: Any, status: Any, measured: Any, max_range: float) -> Array:
        """Log-likelihood of each beam.

        Parameters
        ----------
        expected, status : (..., n)
            Of a `CastResult` [m].
        measured : (n,)
            Ranges [m]; `max_range` or more for beams without a return, NaN for beams to ignore, which give 0.
        """
        status = np.asarray(status)
        m = np.minimum(np.asarray(measured, dtype=np.float64), max_range)
        met = (status == HIT) | (status == INSIDE)
        r = np.where(met, np.asarray(expected, dtype=np.float64), max_range)
        z = np.minimum(np.abs(m - r) / self.sigma, self.clip)
        if not self.ignore_unknown:
            # space before the unknown voxel is known to be free: only a beam that ended there contradicts the map
            short = np.minimum(np.maximum(np.asarray(expected) - m, 0.0) / self.sigma, self.clip)
            z = np.where(status == UNKNOWN_SPACE, np.maximum(short, self._unknown), z)
        z = np.where(status == UNUSABLE, self.clip, z)
        return np.where(np.isnan(m), 0.0, -0.5 * z * z)

    @property
    def _unknown(self) -> float:
        return self.clip if self.unknown is None else self.unknown


def log_weights(
    grids: Sequence[EvidenceGrid],
    poses: Any,
    points: Any,
    likelihood: EndpointLikelihood | CastLikelihood,
    *,
    origin: Any = None,
    max_range: float | None = None,
    returns: Any = None,
    threads: int = 1,
) -> Array:
    """Log-likelihoods of one scan in many grids, each with its own pose.

    Parameters
    ----------
    grids, poses, threads
        As in `cast_grids`.
    points, origin, max_range, returns
        The scan, as in `update_grids`. Beams that are not finite or have length 0 are ignored. Casting needs
        the maximum range.

    Returns
    -------
    (P,) float64
        Sums over the beams, times the exponent; independent of the number of threads.
    """
    if not len(grids):
        return np.zeros(0)
    first = grids[0]
    p, o, r, limit = scan_rows(points, origin, returns, max_range, first.dim, first.voxel_size)
    rays = (p - o)[:, : first.dim]
    with np.errstate(invalid="ignore", over="ignore"):
        measured = np.linalg.norm(rays, axis=1)
    no_beam = ~np.isfinite(rays).all(axis=1) | (measured == 0.0)
    if len(r):
        measured[r == 0] = np.inf
    measured[no_beam] = np.nan
    if isinstance(likelihood, EndpointLikelihood):
        ends = measured <= limit
        found = endpoint_probability(
            grids,
            poses,
            p[ends, : first.dim],
            interpolation=likelihood.interpolation,
            unknown=likelihood.unknown,
            threads=threads,
        )
        return likelihood.exponent * likelihood.beams(found).sum(axis=1)
    if math.isinf(limit):
        raise ConfigError("weighting by casting needs the maximum range: beams without a hit are compared with it")
    c = cast_grids(
        grids,
        poses,
        o[:, : first.dim],
        rays,
        limit,
        ignore_unknown=likelihood.ignore_unknown,
        threads=threads,
    )
    return likelihood.exponent * likelihood.beams(c.ranges, c.status, measured, limit).sum(axis=1)
