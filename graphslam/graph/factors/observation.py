"""Observation of one landmark from one pose in 2-D: bearing and range, or its position in the pose's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array, rotation2, wrap_angle
from graphslam.graph.factors.batch import Fixed, Index, UniformBatch, custom_factor, with_kernel
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableLayout, gtsam_key


@dataclass(frozen=True, slots=True, eq=False)
class ObservationRecord:
    """Landmark ``landmark_id`` observed from a node.

    Parameters
    ----------
    z : (2,)
        Bearing [rad] and range [m], or x forward and y left [m].
    polar : bool
        ``z`` is bearing and range.
    whitener : (2, 2)
        In the order of ``z``.
    """

    factor_id: int
    node: int
    landmark_id: int
    z: Array
    polar: bool
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "observation"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 2

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}", f"l{self.landmark_id}"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} of l{self.landmark_id} from x{self.node} (factor {self.factor_id})"


class ObservationBatch(UniformBatch):
    """Observations: predicted minus measured, bearings wrapped."""

    record = ObservationRecord
    relative = True
    slots = ("x", "l")

    def __init__(self, records: Sequence[ObservationRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._z = np.array([r.z for r in records]).reshape(-1, 2)
        self._polar = np.array([r.polar for r in records], dtype=bool)

    @classmethod
    def of_arrays(
        cls, seen: Index, z: Array, polar: bool, whiteners: Array, layout: VariableLayout
    ) -> ObservationBatch:
        """A batch from arrays, without an object per factor.

        Parameters
        ----------
        seen : (k, 2) int
            Rows of nodes and of landmarks.
        z, whiteners : (k, 2), (k, 2, 2)
        """

        def record(k: int) -> ObservationRecord:
            node, row = seen[k].tolist()
            return ObservationRecord(k, node, int(layout.landmark_ids[row]), z[k], polar, whiteners[k])

        out = cls._bare(seen, whiteners, layout, "observation", record)
        out._z, out._polar = z, np.full(len(seen), polar)
        return out

    @staticmethod
    def keys(record: ObservationRecord) -> Sequence[int | None]:
        """Node, landmark."""
        return record.node, record.landmark_id

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x, l = blocks
        Rt = np.swapaxes(rotation2(x[:, 2]), 1, 2)
        local = np.einsum("kij,kj->ki", Rt, l - x[:, :2])
        J = np.zeros((len(x), 2, 5))
        J[:, 0, 0] = J[:, 1, 1] = -1.0
        J[:, 0, 2], J[:, 1, 2] = local[:, 1], -local[:, 0]
        J[:, :, 3:] = Rt
        r = local - self._z
        k = np.flatnonzero(self._polar)
        if len(k):
            seen = local[k]
            square = np.maximum(np.sum(seen**2, axis=1), 1e-12)
            distance = np.sqrt(square)
            r[k, 0] = wrap_angle(np.arctan2(seen[:, 1], seen[:, 0]) - self._z[k, 0])
            r[k, 1] = np.hypot(seen[:, 0], seen[:, 1]) - self._z[k, 1]
            P = np.empty((len(k), 2, 2))  # d(bearing, range) / d(x, y)
            P[:, 0, 0], P[:, 0, 1] = -seen[:, 1] / square, seen[:, 0] / square
            P[:, 1, 0], P[:, 1, 1] = seen[:, 0] / distance, seen[:, 1] / distance
            J[k] = P @ J[k]
        return r, J

    @classmethod
    def gtsam(cls, record: Any, fixed: Fixed) -> gtsam.NonlinearFactor:
        """GTSAM's own for bearing and range from a free node; otherwise a custom factor."""
        if not record.polar or f"x{record.node}" in fixed:
            return custom_factor(cls, record, fixed)
        noise = with_kernel(gtsam.noiseModel.Gaussian.Information(record.whitener.T @ record.whitener), record.robust)
        x, l = (gtsam_key(n) for n in record.variables())
        return gtsam.BearingRangeFactor2D(x, l, gtsam.Rot2(record.z[0]), record.z[1], noise)
