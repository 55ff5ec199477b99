"""Vectorised factors of one kind: columns, whitened residuals and Jacobians, Gauss–Newton blocks, GTSAM's factors.

A kind of factor is one file of this package: a *record* (the data of one factor, with the names of its variables) and
a *batch* (a vectorised residual and Jacobian of all factors of the kind). Only the batch must be registered
(:func:`register_factor`): batch solving, covariances, diagnosis, scores and the incremental solver find it by the type
of the record. GTSAM gets a native factor if the kind has one (:meth:`FactorBatch.gtsam`), otherwise a custom factor
that calls the batch on one row. A record of an unregistered kind is refused at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, Protocol, Self

import gtsam
import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, quat_normalize
from graphslam.graph.noise import NO_KERNEL, RobustKernel, robust_terms
from graphslam.graph.variables import KINDS, Values, VariableLayout, gtsam_key, split_name

Index = npt.NDArray[np.int64]


class FactorRecord(Protocol):
    """The data of one factor: plain arrays, from which it can be made again.

    A solver never has the only copy of anything: GTSAM's incremental solver is unusable after a failed update, and is
    then rebuilt from the records.
    """

    @property
    def factor_id(self) -> int:
        """Id of the factor in its graph."""
        ...

    @property
    def group(self) -> str:
        """Factor class of the reported χ²."""
        ...

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        ...

    def variables(self) -> list[str]:
        """Names of the free and fixed variables, each once, in the order of the batch's columns."""
        ...

    def label(self) -> str:
        """Name for messages and plots."""
        ...


class WhitenedRecord:
    """Base of records with a ``whitener``: one row per component of the residual."""

    __slots__ = ()
    whitener: Array

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return len(self.whitener)


def block_offsets(lengths: Sequence[int] | Index) -> Index:
    """``[0, l_0, l_0 + l_1, …]``."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


class LazyRecords(Sequence[Any]):
    """Records of factors that are stored in arrays; each is made on request."""

    def __init__(self, count: int, make: Callable[[int], Any]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [self._make(i) for i in range(*k.indices(self._count))]
        if not -self._count <= k < self._count:
            raise IndexError(k)
        return self._make(int(k) % self._count)


class FactorBatch(ABC):
    """All factors of one kind.

    Parameters
    ----------
    records : sequence of records
        Of :attr:`record`, possibly none.

    Attributes
    ----------
    arity : (k,) int
        Number of variables of each factor, with fixed and absent ones.
    first, width : (Σ arity,) int
        First column of each of these in the layout (-1: fixed, -2: absent), and its degrees of freedom.
    code, k : (k,)
        Robust kernel of each (:func:`~graphslam.graph.noise.robust_terms`).
    """

    record: ClassVar[type]
    prior: ClassVar[bool] = False
    """A factor of this kind constrains its variables alone, without any other factor."""
    relative: ClassVar[bool] = False
    """It depends on poses and places only relative to each other, or to the datum and the vertical."""
    group: str | None = None
    """Class of all factors, if they were made from arrays."""
    arity: Index
    first: Index
    width: Index

    def __init__(self, records: Sequence[Any], layout: VariableLayout) -> None:
        self.records = records
        self.layout = layout
        kernels = [getattr(r, "robust", NO_KERNEL) for r in records]
        self.code = np.array([r.code for r in kernels], dtype=np.int64)
        self.k = np.array([r.k for r in kernels])

    def __len__(self) -> int:
        return len(self.records)

    @property
    def columns(self) -> Index:
        """Columns of the scalars of all variables, factor by factor; -1 if there is none."""
        within = np.arange(self.width.sum()) - np.repeat(np.cumsum(self.width) - self.width, self.width)
        first = np.repeat(self.first, self.width)
        return np.where(first < 0, -1, first + within)

    @cached_property
    def rows(self) -> Index:
        """Dimension of the residual of each ``(k,)``."""
        return np.array([r.rows for r in self.records], dtype=np.int64)

    def classes(self) -> Iterator[tuple[str, Index]]:
        """Factor classes in this batch, with the indices of their factors."""
        if self.group is not None:
            yield self.group, np.arange(len(self))
            return
        members: dict[str, list[int]] = {}
        for k, r in enumerate(self.records):
            members.setdefault(r.group, []).append(k)
        for name, numbers in members.items():
            yield name, np.array(numbers, dtype=np.int64)

    @abstractmethod
    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``, without robust kernels."""

    @abstractmethod
    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """Fill this batch's part of the flat blocks; return its losses ``(k,)`` (``2 ρ`` with a robust kernel).

        Parameters
        ----------
        H : flat
            Row-major ``w Jᵀ Λ J`` of the factors, one after the other, at the offsets ``H_offset`` ``(k + 1,)``.
        g : flat
            ``w Jᵀ Λ r``, at the offsets ``g_offset`` ``(k + 1,)``.
        """

    @classmethod
    @abstractmethod
    def gtsam(cls, record: Any, fixed: Fixed) -> gtsam.NonlinearFactor:
        """See :func:`gtsam_factor`."""


class UniformBatch(FactorBatch):
    """Factors that all have the same kinds of variables; a subclass mainly implements :meth:`terms`.

    Attributes
    ----------
    slots : tuple of str
        Words of the kinds of its variables (:data:`~graphslam.graph.variables.KINDS`), in the order of the columns. If
        a record lacks one, :meth:`keys` has None at its place.
    """

    slots: ClassVar[tuple[str, ...]]

    def __init__(self, records: Sequence[Any], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        keys = np.array([[-1 if k is None else k for k in self.keys(r)] for r in records], dtype=np.int64)
        rows = keys.reshape(-1, len(self.slots))
        for s, word in enumerate(self.slots):
            if word == "l":
                rows[:, s] = [layout.row_of.get(k, -1) for k in rows[:, s].tolist()]
        d = records[0].rows if records else 0
        self._fill(layout, rows, np.array([self.whitener(r) for r in records]).reshape(len(records), d, d))

    @classmethod
    def _bare(
        cls, rows: Index, whiteners: Array, layout: VariableLayout, group: str, record: Callable[[int], Any]
    ) -> Self:
        """A batch from arrays, without measurements; ``record`` makes a record for messages."""
        out = cls.__new__(cls)
        out.records, out.layout, out.group = LazyRecords(len(rows), record), layout, group
        out.code, out.k = np.zeros(len(rows), dtype=np.int64), np.full(len(rows), NO_KERNEL.k)
        out._fill(layout, np.asarray(rows, dtype=np.int64), whiteners)
        out.__dict__["rows"] = np.full(len(rows), whiteners.shape[-1], dtype=np.int64)
        return out

    def _fill(self, layout: VariableLayout, rows: Index, whiteners: Array) -> None:
        """Set columns and noise of factors with the variables in ``rows`` ``(k, slots)``."""
        self.dim, self._rows, self.whiteners = layout.dim, rows, whiteners
        widths = [KINDS[word].dof(layout.dim) for word in self.slots]
        self.arity = np.full(len(rows), len(widths), dtype=np.int64)
        self.width = np.tile(np.array(widths, dtype=np.int64), len(rows))

    @cached_property
    def first(self) -> Index:  # type: ignore[override]
        """See :class:`FactorBatch`."""
        columns = [self.layout.first(word, self._rows[:, s]) for s, word in enumerate(self.slots)]
        return np.stack(columns, axis=1).ravel()

    @staticmethod
    @abstractmethod
    def keys(record: Any) -> Sequence[int | None]:
        """Numbers of its variables, slot by slot; for landmarks their ids."""

    @staticmethod
    def whitener(record: Any) -> Array:
        """``W`` ``(d, d)`` with ``Wᵀ W`` = information: the record's ``whitener``, or ``I / sigma``."""
        W = getattr(record, "whitener", None)
        return np.eye(record.rows) / record.sigma if W is None else np.asarray(W)

    @abstractmethod
    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """Residuals ``(k, d)`` and Jacobians ``(k, d, c)``, not whitened.

        Parameters
        ----------
        blocks : (k, size) each
            Values of the variables, slot by slot; zeros if a record lacks one.
        """

    def gather(self, values: Values) -> list[Array]:
        """Values ``(k, size)`` of the variables of all factors, slot by slot."""
        out = []
        for s, word in enumerate(self.slots):
            rows, have = self._rows[:, s], values[word]
            absent = rows < 0
            block = have[np.maximum(rows, 0)] if len(have) else np.zeros((len(rows), KINDS[word].size(self.dim)))
            out.append(np.where(absent[:, None], 0.0, block) if np.any(absent) else block)
        return out

    def residuals(self, *blocks: Array) -> Array:
        """Only the residuals ``(k, d)`` of :meth:`terms`; subclasses may have a faster version."""
        return self.terms(*blocks)[0]

    def whitened(self, values: Values) -> tuple[Array, Array]:
        """Whitened residuals ``(k, d)`` and Jacobians ``(k, d, c)``."""
        r, J = self.terms(*self.gather(values))
        return np.einsum("kij,kj->ki", self.whiteners, r), self.whiteners @ J

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        if len(self) == 0:
            return np.zeros(0)
        return np.sum(np.einsum("kij,kj->ki", self.whiteners, self.residuals(*self.gather(values))) ** 2, axis=1)

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`FactorBatch.blocks`."""
        if len(self) == 0:
            return np.zeros(0)
        if not hessian:
            return robust_terms(self.squared(values), self.code, self.k)[0]
        r, J = self.whitened(values)
        loss, w = robust_terms(np.sum(r**2, axis=1), self.code, self.k)
        Jt = np.swapaxes(J, 1, 2)
        if np.any(self.code):
            Jt = Jt * w[:, None, None]
        np.matmul(Jt, J, out=H[H_offset[0] : H_offset[-1]].reshape(J.shape[0], J.shape[2], -1))
        g[g_offset[0] : g_offset[-1]] = (Jt @ r[..., None]).ravel()
        return loss

    @classmethod
    def gtsam(cls, record: Any, fixed: Fixed) -> gtsam.NonlinearFactor:
        """A custom factor that calls :meth:`terms` on one row: slow, but valid for every kind."""
        return custom_factor(cls, record, fixed)


# ------------------------------------------------------------------------------------------------ registry

_BATCHES: dict[type, type[FactorBatch]] = {}


def register_factor(batch: type[FactorBatch]) -> type[FactorBatch]:
    """Register a kind of factor, by the type of its record."""
    if batch.record in _BATCHES:
        raise ConfigError(f"factors of {batch.record.__name__} are registered twice")
    _BATCHES[batch.record] = batch
    return batch


def batch_of(record_type: type) -> type[FactorBatch]:
    """The batch of a type of record."""
    if record_type not in _BATCHES:
        known = ", ".join(t.__name__ for t in _BATCHES)
        raise ConfigError(f"no kind of factor is registered for {record_type.__name__}; known: {known}")
    return _BATCHES[record_type]


def factor_kinds() -> list[type[FactorBatch]]:
    """Every kind, in the order of registration."""
    return list(_BATCHES.values())


Fixed = Mapping[str, Array]
"""Variables that are constant, by name."""


def gtsam_factor(record: Any, fixed: Fixed) -> gtsam.NonlinearFactor:
    """The GTSAM factor of a record, without keys for constant variables.

    Parameters
    ----------
    fixed : mapping of str to (k,)
        Of the first base ``x0``; or datum and tilt at the identity: poses are in the GPS frame, the first base is free.
    """
    return batch_of(type(record)).gtsam(record, fixed)


# ------------------------------------------------------------------------------------------------ GTSAM


def gtsam_pose(pose: Array) -> Any:
    """``Pose2`` of ``(3,)``, ``Pose3`` of ``(7,)``; normalised, because GTSAM does not check quaternions."""
    if len(pose) == 3:
        return gtsam.Pose2(*pose)
    x, y, z, w = quat_normalize(pose[3:])
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), pose[:3])


def pose_array(pose: Any) -> Array:
    """Inverse of :func:`gtsam_pose`."""
    if isinstance(pose, gtsam.Pose2):
        return np.array([pose.x(), pose.y(), pose.theta()])
    return np.concatenate([pose.translation(), matrix_to_quat(pose.rotation().matrix())])


def gtsam_value(value: Array, name: str, dim: int) -> Any:
    """A variable's value in GTSAM's form: a pose, or a vector."""
    return gtsam_pose(value) if split_name(name)[0].pose_group(dim) is not None else np.ascontiguousarray(value)


def read_value(values: gtsam.Values, name: str, key: int, dim: int) -> Array:
    """Read a variable's value from GTSAM's values."""
    kind = split_name(name)[0]
    group = kind.pose_group(dim)
    if group is not None:
        return pose_array(values.atPose2(key) if group.dof == 3 else values.atPose3(key))
    return np.array(values.atVector(key))


def dim_of(fixed: Fixed) -> int:
    """2 or 3, from the size of a pose or datum."""
    return 2 if len(next(iter(fixed.values()))) == 3 else 3


def with_kernel(base: Any, robust: RobustKernel) -> Any:
    """GTSAM noise model with the same kernel as :class:`~graphslam.graph.noise.RobustKernel`."""
    if robust.kind == "none":
        return base
    estimator = getattr(gtsam.noiseModel.mEstimator, robust.kind.capitalize())
    return gtsam.noiseModel.Robust.Create(estimator.Create(robust.k), base)


def unit_noise(record: Any) -> Any:
    """Unit noise with the record's kernel, for factors that whiten their residuals."""
    return with_kernel(gtsam.noiseModel.Unit.Create(record.rows), getattr(record, "robust", NO_KERNEL))


def safe_factor(noise: Any, names: Sequence[str], widths: Sequence[int], rows: int, terms: Any) -> gtsam.CustomFactor:
    """A custom factor that never raises and fills every requested Jacobian.

    An exception inside a factor makes GTSAM's solver unusable, and a missing Jacobian crashes it. So an error gives a
    residual of nan, which the solver refuses by name.

    Parameters
    ----------
    names, widths : (v,)
        Free variables and their degrees of freedom.
    terms : callable
        ``(values, H) -> residual``, whitened; fills ``H`` unless it is None.
    """

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            return np.asarray(terms(values, H))
        except Exception:
            for k, width in enumerate(widths if H is not None else []):
                H[k] = np.zeros((rows, width))  # type: ignore[index]
            return np.full(rows, np.nan)

    return gtsam.CustomFactor(noise, [gtsam_key(n) for n in names], error)


def custom_factor(batch: type[UniformBatch], record: Any, fixed: Fixed) -> gtsam.CustomFactor:
    """A custom factor of any kind, from the terms of its batch on one row (the default of every kind)."""
    dim = dim_of(fixed)
    slots = list(zip(batch.slots, batch.keys(record)))
    one = _alone(batch, record, dim)
    names = [None if k is None else (w if KINDS[w].single else f"{w}{k}") for w, k in slots]
    widths = [KINDS[w].dof(dim) for w, _ in slots]
    first = block_offsets(widths)
    free = [s for s, n in enumerate(names) if n is not None and n not in fixed]
    reads = [(s, names[s], gtsam_key(str(names[s]))) for s in free]
    blocks = [np.zeros((1, KINDS[w].size(dim))) for w in batch.slots]
    for s, n in enumerate(names):
        if n is not None and n in fixed:
            blocks[s][0] = fixed[n]

    def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
        here = list(blocks)
        for s, name, key in reads:
            here[s] = read_value(values, str(name), key, dim)[None]
        r, J = one.terms(*here)
        if H is not None:
            J = one.whiteners[0] @ J[0]
            for h, s in enumerate(free):
                H[h] = np.asfortranarray(J[:, first[s] : first[s + 1]])
        return np.asarray(one.whiteners[0] @ r[0])

    return safe_factor(unit_noise(record), [str(names[s]) for s in free], [widths[s] for s in free], record.rows, terms)


def _alone(batch: type[UniformBatch], record: Any, dim: int) -> UniformBatch:
    """A batch of one factor, without columns."""
    return batch([record], VariableLayout(dim, tuple(0 for _ in KINDS), np.zeros(0, dtype=np.int64)))
