"""Positions of nodes in the frame of the first base, for example from GPS in a pose-graph file: ``t_i - z``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.graph.factors.batch import (
    Fixed,
    Index,
    UniformBatch,
    WhitenedRecord,
    custom_factor,
    register_factor,
    with_kernel,
)
from graphslam.graph.factors.range import antennas
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableLayout, gtsam_key


@dataclass(frozen=True, slots=True, eq=False)
class PositionRecord(WhitenedRecord):
    """Position of a node, without its rotation.

    Parameters
    ----------
    z : (dim,)
        In the world [m].
    whitener : (dim, dim)
        Along the axes of the world; zero in a direction that was not measured.
    """

    factor_id: int
    node: int
    z: Array
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "position"

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} of x{self.node} (factor {self.factor_id})"


class PositionBatch(UniformBatch):
    """Positions."""

    record = PositionRecord
    slots = ("x",)
    prior = True

    def __init__(self, records: Sequence[PositionRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._z = np.array([r.z for r in records]).reshape(-1, layout.dim)

    @classmethod
    def of_arrays(cls, nodes: Index, z: Array, whiteners: Array, layout: VariableLayout) -> PositionBatch:
        """A batch from arrays, without an object per factor: rows ``(k,)``, ``(k, dim)`` and ``(k, dim, dim)``."""

        def record(k: int) -> PositionRecord:
            return PositionRecord(k, int(nodes[k]), z[k], whiteners[k])

        out = cls._bare(np.asarray(nodes)[:, None], whiteners, layout, "position", record)
        out._z = z
        return out

    @staticmethod
    def keys(record: PositionRecord) -> Sequence[int | None]:
        """Node."""
        return (record.node,)

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        p, J = antennas(blocks[0], np.zeros_like(self._z))
        return p - self._z, J

    @classmethod
    def gtsam(cls, record: Any, fixed: Fixed) -> gtsam.NonlinearFactor:
        """GTSAM's own, unless a direction was not measured or the node is fixed."""
        information = record.whitener.T @ record.whitener
        if record.node == 0 or np.linalg.matrix_rank(information) < len(information):
            return custom_factor(cls, record, fixed)
        noise = with_kernel(gtsam.noiseModel.Gaussian.Information(information), record.robust)
        prior = gtsam.PoseTranslationPrior2D if len(record.z) == 2 else gtsam.PoseTranslationPrior3D
        return prior(gtsam_key(f"x{record.node}"), record.z, noise)


register_factor(PositionBatch)
