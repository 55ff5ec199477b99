"""Which beams met a surface that lies: a floor, a ramp, a ceiling, a roof of a car."""

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
"""Points of the same step by which a surface is told, the beam's own among them."""
SURE = 0.1
"""Greatest σ of a normal that is known [rad]: of a plane through n points whose spread across it is λ₀ and along its
shorter axis λ₁, ``sqrt(λ₀ / (n λ₁))``. Of points on a line, and of points that lie anyhow, it is 0.3."""
STEEP = float(np.sqrt(0.5))
"""A surface lies whose normal is less than 45° off the vertical; ramps that can be driven are far below."""
_APART = 1e4
"""By which steps are moved apart [m], so that neighbours are looked for in the same step."""


def upright_beams(steps: Steps) -> Flags:
    """Beams ``(q,)`` of all steps that met something, and nothing of which it is known that it lies.

    What is met by too few beams to tell, as a pole or the edge of a wall, tells a place in the plan as well; floors too
    far off to be told from it are few.

    Parameters
    ----------
    steps : Steps
        In space, with roll and pitch by gravity.
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
        known = spread[:, 0] <= NEIGHBOURS * SURE**2 * spread[:, 1]
    up = up_directions(steps.tilt)[step]
    out[rows] = ~known | (np.abs(np.einsum("ki,ki->k", normals, up)) < STEEP)
    return out


def up_directions(tilt: Array) -> Array:
    """What is up ``(n, 3)``, seen from bodies with roll and pitch ``(n, 2)`` [rad]."""
    (sr, sp), (cr, cp) = np.sin(tilt).T, np.cos(tilt).T
    return np.column_stack([-sp, sr * cp, cr * cp])
