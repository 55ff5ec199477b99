"""Distances between two nodes, or between a node and a beacon of unknown position.

With antennas at ``arm`` in the frames of their nodes, ``r = |x_i a_i - x_j a_j| - z``, or ``r = |x_i a_i - p| - z`` for
a beacon at p in the frame of the first base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, rotation2
from graphslam.core.poses import SE2, SE3
from graphslam.core.se3 import quat_to_matrix, skew
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableKind, register_variable

register_variable(
    VariableKind(
        "beacon", "p", {2: "mm", 3: "mmm"}, classes=("beacon",),
        remedy="the distances do not determine a beacon: measure them from places that do not lie on one line.",
    )
)  # fmt: skip

TOUCHING = 1e-9
"""Distances are clipped to at least this in the Jacobian [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeRecord:
    """A distance between two nodes.

    Parameters
    ----------
    arm_i, arm_j : (dim,)
        Antennas in the frames of the nodes.
    distance, sigma : float
        [m]
    """

    factor_id: int
    i: int
    j: int
    arm_i: Array
    arm_j: Array
    distance: float
    sigma: float
    robust: RobustKernel = NO_KERNEL
    group: str = "range"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.i}", f"x{self.j}"]

    def label(self) -> str:
        """Name for messages."""
        return f"distance x{self.i} – x{self.j} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class BeaconRangeRecord:
    """A distance from a node to a beacon.

    Parameters
    ----------
    node, beacon : int
        Number of the node; row of the beacon.
    arm : (dim,)
    distance, sigma : float
        [m]
    """

    factor_id: int
    node: int
    beacon: int
    time: float
    arm: Array
    distance: float
    sigma: float
    robust: RobustKernel = NO_KERNEL
    group: str = "beacon"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}", f"beacon{self.beacon}"]

    def label(self) -> str:
        """Name for messages."""
        return f"distance x{self.node} – beacon{self.beacon} at {self.time:.3f} s (factor {self.factor_id})"


def antennas(poses: Array, arms: Array) -> tuple[Array, Array]:
    """Antennas ``(k, dim)`` in the frame of the first base, and their Jacobians ``(k, dim, dof)`` by right tangents."""
    if poses.shape[1] == 3:
        R = rotation2(poses[:, 2])
        turned = (R @ np.stack([-arms[:, 1], arms[:, 0]], -1)[..., None])[..., 0]
        return SE2.transform(poses, arms), np.concatenate([R, turned[..., None]], axis=2)
    R = quat_to_matrix(poses[:, 3:])
    return SE3.transform(poses, arms), np.concatenate([-R @ skew(arms), R], axis=2)


def _along(a: Array, b: Array) -> tuple[Array, Array]:
    """Distances ``(k,)`` and unit vectors ``(k, dim)`` from b to a."""
    d = a - b
    length = np.linalg.norm(d, axis=1)
    return length, d / np.maximum(length, TOUCHING)[:, None]


class RangeBatch(UniformBatch):
    """Distances between nodes."""

    record = RangeRecord
    slots = ("x", "x")

    def __init__(self, records: Sequence[RangeRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._arm_i = np.array([r.arm_i for r in records]).reshape(-1, layout.dim)
        self._arm_j = np.array([r.arm_j for r in records]).reshape(-1, layout.dim)
        self._z = np.array([r.distance for r in records])

    @staticmethod
    def keys(record: RangeRecord) -> Sequence[int | None]:
        """Both nodes."""
        return record.i, record.j

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        (a, J_a), (b, J_b) = antennas(blocks[0], self._arm_i), antennas(blocks[1], self._arm_j)
        length, n = _along(a, b)
        n = n[:, None]
        return (length - self._z)[:, None], np.concatenate([n @ J_a, -n @ J_b], axis=2)


class BeaconRangeBatch(UniformBatch):
    """Distances to beacons."""

    record = BeaconRangeRecord
    slots = ("x", "beacon")

    def __init__(self, records: Sequence[BeaconRangeRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._arm = np.array([r.arm for r in records]).reshape(-1, layout.dim)
        self._z = np.array([r.distance for r in records])

    @staticmethod
    def keys(record: BeaconRangeRecord) -> Sequence[int | None]:
        """Node, beacon."""
        return record.node, record.beacon

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        a, J_a = antennas(blocks[0], self._arm)
        length, n = _along(a, blocks[1])
        n = n[:, None]
        return (length - self._z)[:, None], np.concatenate([n @ J_a, -n], axis=2)
