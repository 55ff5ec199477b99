"""Sections through a mesh."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import Array
from graphslam.sim.world import Triangles


def mesh_section(vertices: Array, triangles: Triangles, height: float) -> Array:
    """Lines in which a level plane cuts a mesh.

    Parameters
    ----------
    vertices : (v, 3)
    triangles : (t, 3)
    height : float
        Of the plane [m]. A vertex on the plane counts as above it, so that a level face is cut nowhere.

    Returns
    -------
    (n, 2, 2)
        End points of n segments in the plan, in the order of the triangles.
    """
    above = vertices[:, 2] >= height
    up = above[triangles]
    cut = triangles[(up.sum(axis=1) % 3) != 0]
    up = above[cut]
    # the corner that stands alone on its side of the plane, and the other two
    alone = np.where(up.sum(axis=1) == 1, up.argmax(axis=1), (~up).argmax(axis=1))
    rows = np.arange(len(cut))
    a = vertices[cut[rows, alone]]
    ends = []
    for step in (1, 2):
        b = vertices[cut[rows, (alone + step) % 3]]
        share = (height - a[:, 2]) / (b[:, 2] - a[:, 2])
        ends.append(a[:, :2] + share[:, None] * (b[:, :2] - a[:, :2]))
    return np.stack(ends, axis=1)
