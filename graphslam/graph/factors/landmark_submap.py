"""A landmark submap: one n-ary factor with its full joint covariance (Combined SLAM eq. 15).

All submaps together are one compiled loop. A single one is a GTSAM factor in Python with the same kernel: it never
raises, fills every requested Jacobian, and whitens its residual itself, with unit noise in GTSAM: whitening some twenty
small blocks one by one in GTSAM takes longer than the whole linearisation here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.graph.factors.batch import FactorBatch, Fixed, Index, WhitenedRecord, block_offsets, safe_factor
from graphslam.graph.variables import Values, VariableLayout, gtsam_key

CONSTANT = ("wheels", "sensor", "mount")
"""Kinds of variables with the constant errors of a robot, two values each."""


class _BetweenBases(WhitenedRecord):
    """Base of the records of a submap between x_start and x_{start + 1}."""

    __slots__ = ()
    start: int
    landmark_ids: npt.NDArray[np.int64]
    points: npt.NDArray[np.int64]
    robot: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "information", (self.whitener.T @ self.whitener).ravel())

    def entries(self) -> list[str]:
        """Names of the variables after the two poses, in the order of z."""
        names = [*(f"l{i}" for i in self.landmark_ids.tolist()), *(f"point{k}" for k in self.points.tolist())]
        return names if self.robot < 0 else [*names, *(f"{word}{self.robot}" for word in CONSTANT)]

    def variables(self) -> list[str]:
        """Names of the free and fixed variables, each once."""
        return [f"x{self.start}", f"x{self.start + 1}", *dict.fromkeys(self.entries())]


@dataclass(frozen=True, slots=True, eq=False)
class SubmapRecord(_BetweenBases):
    """A landmark submap between x_start and x_{start + 1} (Combined SLAM eq. 15).

    Parameters
    ----------
    landmark_ids : (n,) int64
        Graph landmark of every entry; an id may be repeated.
    z : (3 + 2n,)
        ``[exit x, y, θ, l1x, l1y, …]`` in the base frame; with constant errors followed by six zeros.
    whitener : (3 + 2n, 3 + 2n)
        ``W`` with ``Wᵀ W`` = information; with constant errors six more columns ``-W S``, S being their response.
    information : ((3 + 2n)²,)
        Row major; computed here.
    chart : str
        Parametrisation of the residual (:mod:`graphslam.core.charts`).
    robot : int
        Row of its constant errors (:mod:`graphslam.core.sensor_biases`); -1: none.
    """

    factor_id: int
    submap_key: int
    start: int
    landmark_ids: npt.NDArray[np.int64]
    z: Array
    whitener: Array
    group: str = "submap"
    chart: str = "cartesian"
    robot: int = -1
    information: Array = field(init=False)

    @property
    def points(self) -> npt.NDArray[np.int64]:  # type: ignore[override]
        """Rows of points of the path: empty here."""
        return np.zeros(0, dtype=np.int64)

    @property
    def own(self) -> tuple[Array, Array]:
        """Measurement and whitener of end pose and landmarks alone, without constant errors."""
        m = 3 + 2 * len(self.landmark_ids)
        return self.z[:m], self.whitener[:, :m]

    def landmark_positions(self) -> Array:
        """Positions ``(n, 2)`` of the landmarks in the frame of the base."""
        return self.z[3 : 3 + 2 * len(self.landmark_ids)].reshape(-1, 2)

    def label(self) -> str:
        """Name for messages."""
        return f"submap {self.submap_key} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class PathRecord(_BetweenBases):
    """Points of the path inside a landmark submap, conditioned on its end pose and landmarks.

    The joint Gaussian of end pose, landmarks and points is the product of that of end pose and landmarks (the submap's
    own factor) and this conditional: ``u_p - K u_o ~ N(0, S)`` for the residuals u in the submap's parametrisation,
    ``K = P_po P_oo⁻¹``, ``S = P_pp - K P_op``. So a point without a measurement adds no information.

    Parameters
    ----------
    factor_id, submap_key, start, landmark_ids, chart, robot
        See :class:`SubmapRecord`.
    points : (p,) int64
        Rows of the points among the graph's.
    z : (3 + 2n + 2p,)
        End pose, landmarks and points in the base frame.
    whitener : (2p, 3 + 2n + 2p)
        ``S^{-1/2} [-K, I]``.
    """

    factor_id: int
    submap_key: int
    start: int
    landmark_ids: npt.NDArray[np.int64]
    points: npt.NDArray[np.int64]
    z: Array
    whitener: Array
    chart: str = "cartesian"
    group: str = "path"
    robot: int = -1
    information: Array = field(init=False)

    def label(self) -> str:
        """Name for messages."""
        return f"path of submap {self.submap_key} at its fixes (factor {self.factor_id})"


class SubmapBatch(FactorBatch):
    """Landmark submaps (Combined SLAM eq. 15), by a compiled kernel."""

    record: ClassVar[type] = SubmapRecord
    relative = True

    def __init__(self, records: Sequence[SubmapRecord | PathRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        row, marks, robots = layout.row_of, layout.count("l"), layout.count("wheels")
        self._start = np.array([r.start for r in records], dtype=np.int64)
        self._constant = marks + layout.count("point")
        # points come after the landmarks, and constant errors after the points
        rows = [[*(row[i] for i in r.landmark_ids.tolist()), *(marks + r.points).tolist()] for r in records]
        rows = [
            x if r.robot < 0 else [*x, *(self._constant + k * robots + r.robot for k in range(len(CONSTANT)))]
            for x, r in zip(rows, records)
        ]
        self._entry_offset = block_offsets([len(x) for x in rows])
        self._entry_row = np.array([i for some in rows for i in some], dtype=np.int64)
        self._z = np.concatenate([np.zeros(0), *(r.z for r in records)])
        self._z_offset = block_offsets([len(r.z) for r in records])
        self._info = np.concatenate([np.zeros(0), *(r.information for r in records)])
        self._info_offset = block_offsets([len(r.z) ** 2 for r in records])
        self._bent = np.array([r.chart == "group" for r in records], dtype=bool)
        entries = np.diff(self._entry_offset)
        self.arity = 2 + entries
        # every submap: two poses, then its entries
        heads = np.repeat(self._entry_offset[:-1], 2)
        poses = layout.first("x", np.stack([self._start, self._start + 1], axis=1)).ravel()
        columns = np.full(len(self._entry_row), -1, dtype=np.int64)
        kinds = [("l", 0), ("point", marks)]
        kinds += [(word, self._constant + k * robots) for k, word in enumerate(CONSTANT)]
        for word, before in kinds:
            mine = (self._entry_row >= before) & (self._entry_row < before + layout.count(word))
            columns[mine] = layout.first(word, self._entry_row[mine] - before)
        self.first = np.insert(columns, heads, poses)
        self.width = np.insert(np.full(len(self._entry_row), 2), heads, 3)

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        none, no_offset = np.zeros(0), np.zeros(len(self) + 1, dtype=np.int64)
        return self.blocks(values, False, none, no_offset, none, no_offset)

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`FactorBatch.blocks`."""
        from graphslam.graph.normal_kernels import (
            SubmapBlocks,
            SubmapFactorArrays,
            submap_blocks,
        )  # numba takes a third of a second to load

        chi2 = np.zeros(len(self))
        if len(self) == 0:
            return chi2
        submaps = SubmapFactorArrays(
            self._start, self._entry_offset, self._entry_row, self._z, self._z_offset, self._info, self._info_offset,
            self._bent, self._constant,
        )  # fmt: skip
        others = [values[w] for w in ("point", *CONSTANT) if values.count(w)]
        places = np.concatenate([values.landmarks, *others]) if others else values.landmarks
        submap_blocks(
            np.ascontiguousarray(values.poses), np.ascontiguousarray(places), submaps, hessian,
            SubmapBlocks(H, H_offset, g, g_offset, chi2),
        )  # fmt: skip
        return chi2

    @classmethod
    def gtsam(cls, record: SubmapRecord | PathRecord, constants: Fixed) -> gtsam.NonlinearFactor:
        """A custom factor by the same kernel; a repeated landmark has one key, with the sum of its Jacobians."""
        entries = record.entries()
        unique = {name: k for k, name in enumerate(dict.fromkeys(entries))}
        entry_of = np.array([unique[name] for name in entries], dtype=np.intp)
        origin = constants.get(f"x{record.start}")
        names = [] if origin is not None else [f"x{record.start}"]
        names += [f"x{record.start + 1}", *unique]
        widths = [3 if n[0] == "x" else 2 for n in names]
        terms = _terms([gtsam_key(n) for n in names], entry_of, record, origin)
        return safe_factor(gtsam.noiseModel.Unit.Create(record.rows), names, widths, record.rows, terms)


class PathBatch(SubmapBatch):
    """Points of the paths of landmark submaps, by the same kernel."""

    record = PathRecord


def submap_jacobian(
    ends: tuple[Array, Array], points: Array, z: Array, chart: str, places: int | None = None
) -> tuple[Array, Array]:
    """Residual ``H(X) - z`` ``(3 + 2n,)`` (Combined SLAM eq. 15) and its Jacobian ``(3 + 2n, 6 + 2n)``.

    By the right tangents of the start and the end, then by the points ``(n, 2)``, which are pairs of constant errors
    from ``places`` on.
    """
    from graphslam.graph.normal_kernels import whiten_submap  # numba takes a third of a second to load

    n = len(points)
    every = np.arange(n, dtype=np.int64)
    return whiten_submap(ends, points, every, z, n if places is None else places, chart == "group", np.eye(3 + 2 * n))


def _terms(
    keys: list[int], entry_of: npt.NDArray[np.intp], record: SubmapRecord | PathRecord, origin: Array | None
) -> Callable[..., Array]:
    from graphslam.graph.normal_kernels import whiten_submap  # numba takes a third of a second to load

    constants = len(CONSTANT) if record.robot >= 0 else 0  # these keys are last
    first, last = 2 if origin is None else 1, len(keys) - constants
    rows, places = entry_of.astype(np.int64), len(entry_of) - constants
    W, z, group = np.ascontiguousarray(record.whitener), record.z, record.chart == "group"
    columns = [6 + 2 * np.flatnonzero(rows == i) for i in range(len(keys) - first)]

    def pose(values: gtsam.Values, key: int) -> Array:
        at = values.atPose2(key)
        return np.array([at.x(), at.y(), at.theta()])

    def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
        points = np.empty((len(keys) - first, 2))
        for i, key in enumerate(keys[first:]):
            points[i] = values.atPoint2(key) if first + i < last else values.atVector(key)
        ends = pose(values, keys[0]) if origin is None else origin, pose(values, keys[first - 1])
        r, J = whiten_submap(ends, points, rows, z, places, group, W)
        if H is not None:
            if origin is None:
                H[0] = J[:, :3]
            H[first - 1] = J[:, 3:6]
            for i, some in enumerate(columns):
                H[first + i] = sum((J[:, c : c + 2] for c in some[1:]), J[:, some[0] : some[0] + 2])
        return np.asarray(r)

    return terms
