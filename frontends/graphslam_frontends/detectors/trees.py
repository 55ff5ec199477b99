"""Tree trunks in planar laser scans: range and bearing of the trunk *centre*, with a covariance.

A scan is cut into clusters where the range jumps or beams are missing; a cluster is a trunk if it is narrow, shallow,
isolated, not hidden by something nearer and not cut by the edge of the scan. These rules follow from what the
published detections of the Victoria Park log do and do not contain.

Geometry. A trunk of radius R at range ρ and bearing β shows the beams between the edges β ± α, sin α = R/ρ. Beams are
δ apart, so an edge lies somewhere in the δ beyond the outermost beam that hit: u and v, the angles from a beam φ to
the left and right edge, are uniform in intervals of length δ (flat prior over β and α). For small angles the range of
that beam is

    r = ρ cos(φ - β) - √(R² - ρ² sin²(φ - β)) ≈ ρ (1 - g),    g = √(α² - (φ - β)²) = √(u v),

so the centre lies at ρ = r / (1 - g). Mean and variance of g follow from those of √u and √v, which are independent;
for one beam E g = (4/9) δ and Var g = (1/4 - 16/81) δ². The covariance is then

    σ²_range = σ_beam² / (k (1 - g)²) + r² cos²g / (1 - sin g)⁴ · Var g        (k = 1 or 2 middle beams)
    σ²_bearing = δ² / 24                                                       (mean of two uniform edges)

which grows with range, and most for few beams. From :data:`FIT_BEAMS` beams on, (ρ, β, R) is the weighted least-squares
fit to both edges (σ = δ/√12) and to the ranges of the beams that do not graze the trunk, and the covariance is that of
the fit; for a cluster that is no circle (χ² > 9 per beam) the closed form is used.

Bark, branches, lean and undergrowth are not in this model: it describes the sensor. ``noise="fixed"`` therefore uses
σ_range = range_sigma + range_slope · ρ and σ_bearing = bearing_sigma instead, and is the default.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.config import check_options
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.records import LandmarkObservations, LaserScans
from graphslam_frontends.detectors import kernels

Ints = npt.NDArray[np.int64]
BREAK_DISTANCE = 1.5
"""Neighbouring returns with a larger range difference are of different objects [m]."""
MAX_MISSING = 5
"""A cluster is split at a gap of more missing beams than this."""
MAX_DEPTH = 0.5
"""Largest range difference within a trunk [m]."""
ISOLATION = 3.0
"""Least distance from the first and last return of a trunk to those of any other cluster [m]."""
OCCLUSION = 0.3
"""A neighbouring beam nearer by more than this hides part of the trunk: rejected [m]."""
MIN_BEAMS = 1
"""Least number of beams of a trunk. One is right for a park: two would lose 40 % of the trees."""
FIT_BEAMS = 5
"""Least number of beams for a circle fit."""
BEAM_SIGMA = 0.03
"""σ of the range of one beam on bark [m], for the noise model of the geometry."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TreeDetectorConfig:
    """Rules and noise model of the tree detector."""

    max_range: float = 75.0
    """Returns at or beyond this range are ignored [m]."""
    max_width: float = 1.0
    """Upper bound of the least width that the beams allow, (n - 1) δ r [m]."""
    noise: Literal["fixed", "fit"] = "fixed"
    """Sigmas of observations: fixed (the parameters below), or from the geometry and the circle fit."""
    range_sigma: float = 0.08
    """Fixed noise: constant part of σ_range [m]."""
    range_slope: float = 0.001
    """Fixed noise: part of σ_range proportional to range [m/m]."""
    bearing_sigma: float = float(np.deg2rad(0.5))
    """Fixed noise: σ_bearing [rad]."""

    def __post_init__(self) -> None:
        ranges = {"> 0 or inf": "max_range max_width range_sigma bearing_sigma", "≥ 0 or inf": "range_slope"}
        check_options(self, "tree detector: ", ranges)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trunks:
    """Detected trunks, with sigmas from the geometry.

    Parameters
    ----------
    scan : (q,) int64
        Index of the scan; in scan order, and from right to left within a scan.
    ranges, bearings : (q,)
        Trunk centre in the sensor frame [m, rad].
    radii : (q,)
        [m]
    sigmas : (q, 2)
        Of range and bearing, from the geometry [m, rad].
    beams : (q,) int64
        Beams from the first to the last return.
    fitted : (q,) bool
        Whether the values are from the circle fit.
    """

    scan: Ints
    ranges: Array
    bearings: Array
    radii: Array
    sigmas: Array
    beams: Ints
    fitted: npt.NDArray[np.bool_]


@lru_cache(maxsize=8)
def half_chord_moments(beams: int) -> tuple[Array, Array]:
    """Mean and variance of g for trunks of 0 … ``beams`` beams, in units of the beam spacing; ``(beams + 1,)`` each.

    For an odd number the middle beam is used, for an even number the mean of the two in the middle. With the left edge
    k + U and the right edge k' + U' away from a beam, U, U' uniform in [0, 1]: E g = E√(k + U) E√(k' + U').
    """
    x, w = np.polynomial.legendre.leggauss(64)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    x, w = x**2, w * 2.0 * x  # √x has no derivative at 0: substitute
    mean, variance = np.zeros(beams + 1), np.zeros(beams + 1)
    for n in range(1, beams + 1):
        far = n // 2  # whole spacings to the farther edge; the nearer one has the same number (odd) or one less (even)
        near = far if n % 2 else far - 1
        root_far, root_near = w @ np.sqrt(far + x), w @ np.sqrt(near + x)
        mean[n] = root_far * root_near
        second = (far + 0.5) * (near + 0.5)
        if n % 2 == 0:
            both = float(w @ np.sqrt((far + x) * (near + x)))  # the two beams have the same edges
            second = 0.5 * second + 0.5 * both**2
        variance[n] = second - mean[n] ** 2
    mean.setflags(write=False)
    variance.setflags(write=False)
    return mean, variance


def find_trunks(scans: LaserScans, config: TreeDetectorConfig | None = None) -> Trunks:
    """Trunks in all scans, in one kernel call.

    NaN ranges count as no return.
    """
    c = config or TreeDetectorConfig()
    m = len(scans.bearings)
    steps = np.diff(scans.bearings)
    if m < 3 or np.ptp(steps) > 1e-6:
        raise DataError(
            "the tree detector needs evenly spaced beams",
            got=f"{m} beams" if m < 3 else f"spacings {steps.min():.6f} to {steps.max():.6f} rad",
            wanted="3 or more beams, one spacing",
        )
    parameters = np.array(
        [
            min(c.max_range, scans.max_range),
            BREAK_DISTANCE,
            MAX_MISSING,
            c.max_width,
            MAX_DEPTH,
            ISOLATION,
            OCCLUSION,
            MIN_BEAMS,
            FIT_BEAMS,
            BEAM_SIGMA,
        ]
    )
    ranges = np.ascontiguousarray(scans.ranges, dtype=np.float64)
    found = kernels.detect_kernel(ranges, scans.bearings, float(steps.mean()), parameters, *half_chord_moments(m))
    return Trunks(
        scan=found[:, kernels.SCAN].astype(np.int64),
        ranges=found[:, kernels.RANGE].copy(),
        bearings=found[:, kernels.BEARING].copy(),
        radii=found[:, kernels.RADIUS].copy(),
        sigmas=np.sqrt(found[:, [kernels.VAR_RANGE, kernels.VAR_BEARING]]),
        beams=found[:, kernels.BEAMS].astype(np.int64),
        fitted=found[:, kernels.FITTED] > 0.5,
    )


def detect_trees(scans: LaserScans, config: TreeDetectorConfig | None = None) -> LandmarkObservations:
    """Tree trunks as landmark observations, one entry per scan (a scan may be empty).

    The sigmas are those of ``config.noise``; see the module docstring for both formulas.
    """
    c = config or TreeDetectorConfig()
    found = find_trunks(scans, c)
    if c.noise == "fit":
        sigmas = found.sigmas
    else:
        sigmas = np.stack(
            [c.range_sigma + c.range_slope * found.ranges, np.full(len(found.ranges), c.bearing_sigma)], -1
        )
    offsets = np.searchsorted(found.scan, np.arange(len(scans.times) + 1)).astype(np.int64)
    return LandmarkObservations(
        times=scans.times,
        offsets=offsets,
        ranges=found.ranges,
        bearings=found.bearings,
        sigmas=sigmas,
        max_range=min(c.max_range, scans.max_range),
        field_of_view=(float(scans.bearings[0]), float(scans.bearings[-1])),
        T_base_sensor=scans.T_base_sensor,
    )
