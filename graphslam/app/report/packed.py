"""Arrays inside a page: base64 of float32, little-endian."""

from __future__ import annotations

import base64

import numpy as np

from graphslam.core.geometry import Array


def base64_floats(values: Array) -> str:
    """Base64 of an array in row-major order."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def space(points: Array) -> Array:
    """Points ``(n, 3)``; planar points get z = 0."""
    return points if points.shape[1] == 3 else np.hstack([points, np.zeros((len(points), 1))])


def packed_points(points: Array) -> str:
    """Points ``(n, 2)`` or ``(n, ≥ 3)`` as ``(n, 3)``."""
    return base64_floats(space(np.asarray(points)[:, :3]))
