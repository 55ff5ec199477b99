"""3-D landmark submaps: the joint Gaussian of end pose and landmarks in the base frame (SE₁₊ₙ(3) or Cartesian)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gtsam
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array
from graphslam.core.se3 import quat_to_matrix
from graphslam.core.submap import LandmarkMap, turned_covariance
from graphslam.graph.factors.batch import FactorBatch, Fixed, block_offsets, pose_array, safe_factor
from graphslam.graph.noise import whitener
from graphslam.graph.variables import Values, VariableLayout, gtsam_key
from graphslam.linear.space_maps import PlacedMap, SpaceMap

Index = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class SpaceSubmapRecord:
    """A 3-D landmark submap; its residual is that of :mod:`graphslam.linear.space_maps`.

    Parameters
    ----------
    start : int
        Node at its base; its end is the next one.
    landmark_ids : (n,) int64
        Graph landmark of every entry; an id may be repeated.
    map : SpaceMap
        End pose and landmarks in the frame of the base.
    """

    factor_id: int
    submap_key: int
    start: int
    landmark_ids: Index
    map: SpaceMap
    group: str = "submap"
    placed: PlacedMap = field(init=False, repr=False)

    def __post_init__(self) -> None:
        placed = PlacedMap(self.map, 0, np.array([1]), np.arange(len(self.landmark_ids)))
        object.__setattr__(self, "placed", placed)

    @classmethod
    def of_map(
        cls, factor_id: int, key: int, start: int, ids: Index, landmarks: LandmarkMap, scale: float = 1.0
    ) -> SpaceSubmapRecord:
        """From the Gaussian of a submap, its covariance multiplied by ``scale``."""
        W = whitener(
            landmarks.dense_covariance(), what=f"covariance of submap {key}", dim=6 + 3 * len(ids), scale=scale
        )
        information = sp.csr_matrix(W.T @ W) if landmarks.information is None else landmarks.information / scale
        anchors = np.zeros(len(ids), dtype=np.int64)
        exit_pose, positions = landmarks.exit_pose[None], landmarks.positions
        joint = SpaceMap(exit_pose, positions, anchors, sp.csr_matrix(information), landmarks.chart)
        return cls(factor_id, key, start, ids, joint)

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 6 + 3 * len(self.landmark_ids)

    def variables(self) -> list[str]:
        """Names of the free and fixed variables, each once."""
        entries = [f"l{i}" for i in self.landmark_ids.tolist()]
        return [f"x{self.start}", f"x{self.start + 1}", *dict.fromkeys(entries)]

    def label(self) -> str:
        """Name for messages."""
        return f"submap {self.submap_key} (factor {self.factor_id})"

    def exit_covariance(self) -> Array:
        """Marginal covariance ``(6, 6)`` of the end pose in its right tangent."""
        P = np.linalg.inv(self.map.information.toarray())[:6, :6]
        return turned_covariance(quat_to_matrix(self.map.poses[0, 3:]).T, P)

    def landmark_positions(self) -> Array:
        """Positions ``(n, 3)`` of the entries in the frame of the base."""
        return self.map.points

    def terms(self, poses: Array, points: Array) -> tuple[Array, Array]:
        """Residual ``(r,)`` and Jacobian ``(r, 12 + 3 n)`` on the right tangents of base and end, then the points.

        Parameters
        ----------
        poses : (2, 7)
        points : (n, 3)
            Of the entries.
        """
        u, sparse = self.placed.linearise(poses, points)
        J = sparse.toarray()
        for k in range(2):  # rotations and translations along the axes of the body
            R = quat_to_matrix(poses[k, 3:])
            J[:, 6 * k : 6 * k + 6] = J[:, 6 * k : 6 * k + 6] @ np.kron(np.eye(2), R)
        return u, J


class SpaceSubmapBatch(FactorBatch):
    """3-D landmark submaps."""

    record: ClassVar[type] = SpaceSubmapRecord
    relative = True

    def __init__(self, records: Sequence[SpaceSubmapRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._entries = [np.array([layout.row_of[i] for i in r.landmark_ids.tolist()], np.int64) for r in records]
        count = np.array([len(e) for e in self._entries], dtype=np.int64)
        self.arity = 2 + count
        starts = np.array([r.start for r in records], dtype=np.int64)
        heads = np.repeat(block_offsets(count)[:-1], 2)
        poses = layout.first("x", np.stack([starts, starts + 1], axis=1)).ravel()
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *self._entries])
        self.first = np.insert(layout.first("l", rows), heads, poses)
        self.width = np.insert(np.full(len(rows), 3), heads, 6)

    def _of(self, k: int, values: Values) -> tuple[Array, Array]:
        start = self.records[k].start
        return values.poses[start : start + 2], values.landmarks[self._entries[k]]

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        u = [r.placed.residual(*self._of(k, values)) for k, r in enumerate(self.records)]
        return np.array([float(e @ (r.map.information @ e)) for e, r in zip(u, self.records)])

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`~graphslam.graph.factors.batch.FactorBatch.blocks`."""
        if not hessian:
            return self.squared(values)
        loss = np.zeros(len(self))
        for k, r in enumerate(self.records):
            u, J = r.terms(*self._of(k, values))
            weighted = r.map.information @ J
            H[H_offset[k] : H_offset[k + 1]] = (J.T @ weighted).ravel()
            g[g_offset[k] : g_offset[k + 1]] = weighted.T @ u
            loss[k] = u @ (r.map.information @ u)
        return loss

    @classmethod
    def gtsam(cls, record: Any, fixed: Fixed) -> gtsam.NonlinearFactor:
        """A custom factor, whitened, with its analytic Jacobian."""
        ids = record.landmark_ids
        marks = list(dict.fromkeys(ids.tolist()))
        entry = np.array([marks.index(i) for i in ids.tolist()], dtype=np.int64)
        nodes = [k for k in (record.start, record.start + 1) if f"x{k}" not in fixed]
        names = [*(f"x{k}" for k in nodes), *(f"l{i}" for i in marks)]
        keys = [gtsam_key(n) for n in names]
        W = np.linalg.cholesky(record.map.information.toarray()).T

        def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
            free = [pose_array(values.atPose3(k)) for k in keys[: len(nodes)]]
            poses = np.stack([fixed["x0"], *free] if len(nodes) < 2 else free)
            points = np.array([values.atPoint3(k) for k in keys[len(nodes) :]]).reshape(-1, 3)[entry]
            u, J = record.terms(poses, points)
            if H is not None:
                J = W @ J
                for i in range(len(nodes)):
                    first = 6 * (2 - len(nodes) + i)
                    H[i] = np.asfortranarray(J[:, first : first + 6])
                for i in range(len(marks)):
                    mine = np.flatnonzero(entry == i)
                    H[len(nodes) + i] = np.asfortranarray(sum(J[:, 12 + 3 * e : 15 + 3 * e] for e in mine))
            return np.asarray(W @ u)

        widths = [6] * len(nodes) + [3] * len(marks)
        return safe_factor(gtsam.noiseModel.Unit.Create(record.rows), names, widths, record.rows, terms)
