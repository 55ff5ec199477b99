"""Control points and measured distances: coordinates of a place in a survey frame, or the distance of two places.

A place p is a point of the body at a node, ``x a``, a landmark, or a point of the path of a landmark submap. Its
coordinates give ``r = T_survey_world p - z``, where ``T_survey_world`` is the datum of the graph, in 3-D rotated by
the tilt as for GPS fixes (:mod:`graphslam.graph.factors.gps`). A distance gives ``r = |p - q| - d``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import SE2, SE3
from graphslam.graph.factors.batch import Index, UniformBatch, register_factor
from graphslam.graph.factors.gps import AntennaRecord, antenna_terms
from graphslam.graph.factors.range import TOUCHING, antennas
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableLayout


@dataclass(frozen=True, slots=True, eq=False)
class ControlRecord(AntennaRecord):
    """Coordinates of a place; exactly one of ``node``, ``landmark`` and ``point`` is given.

    Parameters
    ----------
    time : float
        [s]; for a landmark that of the first base.
    z : (dim,)
        Relative to the origin of the datum [m].
    whitener : (dim, dim)
        In the frame of z, of coordinates and lever arm combined.
    arm : (dim,)
        The measured point in the frame of the node.
    tilt : bool
        The graph has the variable ``tilt``.
    """

    factor_id: int
    time: float
    z: Array
    whitener: Array
    arm: Array
    node: int | None = None
    landmark: int | None = None
    point: int | None = None
    robust: RobustKernel = NO_KERNEL
    tilt: bool = False
    group: str = "control"

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [*_names(self.node, self.landmark, self.point), "datum", *(["tilt"] if self.tilt else [])]

    def label(self) -> str:
        """Name for messages."""
        return f"control point on {self.variables()[0]} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class DistanceRecord:
    """A distance between two different places, each given as in :class:`ControlRecord`.

    Parameters
    ----------
    distance, sigma : float
        [m]
    """

    factor_id: int
    time: float
    distance: float
    sigma: float
    arm: Array
    arm_to: Array
    node: int | None = None
    landmark: int | None = None
    point: int | None = None
    node_to: int | None = None
    landmark_to: int | None = None
    point_to: int | None = None
    robust: RobustKernel = NO_KERNEL
    group: str = "distance"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        first = _names(self.node, self.landmark, self.point)
        return first + _names(self.node_to, self.landmark_to, self.point_to)

    def label(self) -> str:
        """Name for messages."""
        return f"distance {' – '.join(self.variables())} (factor {self.factor_id})"


def _names(*rows: int | None) -> list[str]:
    return [f"{word}{k}" for word, k in zip(("x", "l", "point"), rows) if k is not None]


class _Places:
    """Position of one place per record.

    Parameters
    ----------
    keys : sequence of (node, landmark, point)
    arms : (k, dim)
    """

    def __init__(self, keys: Sequence[Sequence[int | None]], arms: Array) -> None:
        self.arms = arms
        self.of: list[Index] = [np.array([i for i, k in enumerate(keys) if k[s] is not None], int) for s in range(3)]

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """Positions ``(k, dim)``, and their Jacobians ``(k, dim, c)`` on (pose, landmark, point)."""
        k, dim = self.arms.shape
        p, J = np.zeros((k, dim)), np.zeros((k, dim, 7 if dim == 2 else 9))
        node, *points = self.of
        if len(node):
            pose = 3 * (dim - 1)
            p[node], J[node, :, :pose] = antennas(blocks[0][node], self.arms[node])
        for c, (rows, block) in zip((3 * (dim - 1), 5), zip(points, blocks[1:])):
            if len(rows):
                p[rows] = block[rows]
                J[rows, :, c : c + dim] = np.eye(dim)
        return p, J


class ControlBatch(UniformBatch):
    """Coordinates of places."""

    record = ControlRecord
    relative = True
    slots = ("x", "l", "point", "datum", "tilt")

    def __init__(self, records: Sequence[ControlRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        arms = np.array([r.arm for r in records]).reshape(-1, layout.dim)
        self._places = _Places([self.keys(r) for r in records], arms)
        self._z = np.array([r.z for r in records]).reshape(-1, layout.dim)

    @staticmethod
    def keys(record: ControlRecord) -> Sequence[int | None]:
        """Node, landmark, point of a path, datum, tilt."""
        return record.node, record.landmark, record.point, 0, 0 if record.tilt else None

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        p, J = self._places.terms(*blocks[:3])
        datum, tilt = blocks[3:]
        known = self._rows[:, 4] >= 0
        up = tilt[np.argmax(known)] if self.dim == 3 else None
        y, turn, by = survey_terms(p, datum[0], up, ~known)
        return y - self._z, np.concatenate([turn @ J, by], axis=2)


def survey_terms(points: Array, datum: Array, tilt: Array | None, level: Any = None) -> tuple[Array, Array, Array]:
    """Points ``(k, dim)`` of the map in the frame of the datum, and their Jacobians.

    Returns
    -------
    positions : (k, dim)
    turn : (k, dim, dim)
        On the points.
    by : (k, dim, c)
        On the datum, in 3-D also on the tilt.
    """
    group = SE2 if points.shape[1] == 2 else SE3
    still = np.tile(group.identity, (len(points), 1))
    y, J = antenna_terms(still, datum, tilt, points, level)
    return y, J[:, :, group.position], J[:, :, group.dof :]


class DistanceBatch(UniformBatch):
    """Distances between places."""

    record = DistanceRecord
    relative = True
    slots = ("x", "l", "point", "x", "l", "point")

    def __init__(self, records: Sequence[DistanceRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        keys = [self.keys(r) for r in records]
        arms = [np.array([getattr(r, a) for r in records]).reshape(-1, layout.dim) for a in ("arm", "arm_to")]
        self._ends = _Places([k[:3] for k in keys], arms[0]), _Places([k[3:] for k in keys], arms[1])
        self._distance = np.array([r.distance for r in records])

    @staticmethod
    def keys(record: DistanceRecord) -> Sequence[int | None]:
        """Node, landmark and point of both ends."""
        r = record
        return r.node, r.landmark, r.point, r.node_to, r.landmark_to, r.point_to

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        (p, J_p), (q, J_q) = self._ends[0].terms(*blocks[:3]), self._ends[1].terms(*blocks[3:])
        d = p - q
        length = np.linalg.norm(d, axis=1)
        n = (d / np.maximum(length, TOUCHING)[:, None])[:, None]
        return (length - self._distance)[:, None], np.concatenate([n @ J_p, -n @ J_q], axis=2)


register_factor(ControlBatch)
register_factor(DistanceBatch)
