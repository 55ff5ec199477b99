"""Selection of the beams that did not hit a horizontal surface (floor, ramp, ceiling, roof of a car)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array
from graphslam.registration.plane_kernels import fit_surfaces

if TYPE_CHECKING:
    from graphslam_frontends.odometry.steps import Steps

Flags = npt.NDArray[np.bool_]

NEIGHBOURS = 8
"""Number of points of the same step to fit a surface, the beam's own included."""
NORMAL_SIGMA = 0.1
"""Largest σ of a known normal [rad]; σ of a plane through n points with variance λ₀ across and λ₁ along its shorter
axis is ``sqrt(λ₀ / (n λ₁))``. For points on a line or in random positions it is 0.3."""
STEEP = float(np.sqrt(0.5))
"""A surface is horizontal if its normal is less than 45° from the vertical; drivable ramps are far below that."""
_APART = 1e4
"""Distance between the steps in the search tree [m], so that neighbours are from the same step."""


def upright_beams(steps: Steps) -> Flags:
    """Beams ``(q,)`` of all steps with a return that is not known to be on a horizontal surface.

    Objects with too few beams for a normal, such as a pole or the edge of a wall, also constrain the horizontal
    position; floors too far away for a normal are rare.

    Parameters
    ----------
    steps : Steps
        3-D, with roll and pitch by gravity.
    """
    assert steps.tilt is not None
    out = np.array(steps.returns)
    rows = np.flatnonzero(steps.returns)
    if len(rows) < NEIGHBOURS:
        return out
    step = np.repeat(np.arange(len(steps)), np.diff(steps.offsets))[rows]
    points = steps.points[rows]
    tree = cKDTree(np.column_stack([points, _APART * step]))
    near = tree.query(tree.data, NEIGHBOURS, distance_upper_bound=0.5 * _APART)[1]
    near = np.where(near < len(rows), near, -1).astype(np.int64)
    normals, spread = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
    fit_surfaces(points, near, NEIGHBOURS, normals, spread, np.empty((len(rows), 2, 3)))
    with np.errstate(invalid="ignore", divide="ignore"):
        known = spread[:, 0] <= NEIGHBOURS * NORMAL_SIGMA**2 * spread[:, 1]
    up = up_directions(steps.tilt)[step]
    out[rows] = ~known | (np.abs(np.einsum("ki,ki->k", normals, up)) < STEEP)
    return out


def up_directions(tilt: Array) -> Array:
    """Up vectors ``(n, 3)`` in the frames of bodies with roll and pitch ``(n, 2)`` [rad]."""
    (sr, sp), (cr, cp) = np.sin(tilt).T, np.cos(tilt).T
    return np.column_stack([-sp, sr * cp, cr * cp])
