"""Kinds of variables of a graph in one table: names, degrees of freedom, and how they are updated.

A kind is a row of :data:`KINDS`. Values, columns, GTSAM's keys, relinearisation thresholds, degrees of freedom and the
texts of a diagnosis are all made from that table, so that a new kind of variable is one row.

Variables have short names, which messages use too: ``x3`` (pose of node 3), ``l17`` (landmark 17),
``point3`` (antenna position at a fix inside a landmark submap), ``datum`` (``T_gps_world``), ``bias2`` (position
bias of GPS segment 2), ``tilt`` (up direction in the frame of the first base, 3-D only), ``velocity4`` and
``imubias4`` (of an IMU, in the order in which its nodes were added), ``compass0`` (zero and deviation of a compass),
``beacon7`` (position of beacon 7), ``wheels0``, ``sensor0`` and ``mount0`` (constant errors of a robot).
The first base ``x0`` is fixed at the origin and is not a variable, so it needs no prior, and a badly scaled prior
cannot cause errors.

Poses are SE(2) ``(3,)`` or SE(3) ``(7,)`` and updated in right tangents in GTSAM's order: x, y, θ in 2-D, rotation
before translation in 3-D. The datum is SE(2) in 2-D. In 3-D it is ``[x, y, z, heading]``: the GPS frame and the level
frame of the first base differ by four numbers, which are updated by addition.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import SolverError
from graphslam.core.geometry import Array, rotation2
from graphslam.core.poses import SE2, SE3, Group, group_of

Index = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class VariableKind:
    """One row of the table.

    Parameters
    ----------
    word : str
        Prefix of its names, followed by the number of the variable.
    letter : str
        Of its GTSAM symbols.
    units : mapping of int to str
        By dimension of the graph, one letter for each degree of freedom: ``m`` a length or a speed [m, m/s], ``r`` an
        angle or a rate [rad, rad/s]. A missing dimension has no such variables.
    group : bool
        A pose, updated in right tangents. All others are updated by addition.
    single : bool
        There is at most one, and its name has no number.
    classes : tuple of str
        Factor classes that introduce such variables; the first one in a graph gets their degrees of freedom.
    remedy : str
        Advice if nothing constrains such a variable.
    """

    word: str
    letter: str
    units: Mapping[int, str]
    group: bool = False
    single: bool = False
    classes: tuple[str, ...] = ()
    remedy: str = ""

    def dof(self, dim: int) -> int:
        """Degrees of freedom, and columns, in a graph of that dimension; 0 if it has no such variables."""
        return len(self.units.get(dim, ""))

    def size(self, dim: int) -> int:
        """Number of values of a variable."""
        return 7 if self.group and self.dof(dim) == 6 else self.dof(dim)

    def pose_group(self, dim: int) -> Group | None:
        """SE(2) or SE(3) for a pose; None for variables updated by addition."""
        return {3: SE2, 6: SE3}.get(self.dof(dim)) if self.group else None


KINDS: dict[str, VariableKind] = {}
"""By word, in the order of their columns."""


def register_variable(kind: VariableKind) -> VariableKind:
    """Add a kind of variable to the table."""
    if kind.word in KINDS or any(kind.letter == k.letter for k in KINDS.values()):
        raise ValueError(f"a kind of variable called {kind.word!r} or with the letter {kind.letter!r} is there already")
    KINDS[kind.word] = kind
    return kind


for _kind in (
    VariableKind("x", "x", {2: "mmr", 3: "rrrmmm"}, group=True, classes=("submap", "dense-submap", "*")),
    VariableKind("l", "l", {2: "mm", 3: "mmm"}, classes=("submap", "dense-submap", "*")),
    VariableKind(
        "point", "y", {2: "mm"}, classes=("path",),
        remedy="a point of a submap's path has no submap: remove the GPS fixes of this point.",
    ),
    # Constant errors of a robot (graphslam.core.sensor_biases): turn and log distance of its wheels; ranges and
    # bearings of its sensor, and the sensor's position.
    VariableKind(
        "wheels", "w", {2: "rr"}, classes=("biases",),
        remedy="constant errors of the wheels need a prior.",
    ),
    VariableKind(
        "sensor", "e", {2: "mr"}, classes=("biases",),
        remedy="constant errors of the sensor need a prior.",
    ),
    VariableKind(
        "mount", "m", {2: "mm"}, classes=("biases",),
        remedy="the sensor position needs a prior.",
    ),
    # In 3-D the datum's heading is last, and it is updated by addition.
    VariableKind("datum", "g", {2: "mmr", 3: "mmmr"}, group=True, single=True, classes=("gps", "control")),
    VariableKind(
        "bias", "b", {2: "mm", 3: "mmm"}, classes=("gps-bias",),
        remedy="a GPS bias has neither a prior nor a fix of its own: set bias_sigma.",
    ),
    VariableKind(
        "tilt", "t", {3: "rr"}, single=True, classes=("attitude", "levelled", "imu", "imu-gravity"),
        remedy="the vertical is unconstrained: add the attitude of a node that is connected to x0.",
    ),
    VariableKind(
        "velocity", "v", {2: "mm", 3: "mmm"}, classes=("imu",),
        remedy="the velocity or the bias of an IMU is unconstrained: add readings, or remove its factors.",
    ),
    VariableKind(
        "imubias", "i", {2: "rmm", 3: "rrrmmm"}, classes=("imu-bias", "imu"),
        remedy="the velocity or the bias of an IMU is unconstrained: add readings, or remove its factors.",
    ),
):  # fmt: skip
    register_variable(_kind)


@lru_cache(maxsize=4096)
def split_name(name: str) -> tuple[VariableKind, int]:
    """Kind and number (0 of a single one) of a variable's name."""
    if name in KINDS and KINDS[name].single:
        return KINDS[name], 0
    word = name.rstrip("0123456789")
    kind = KINDS.get(word)
    if kind is None or kind.single or word == name:
        raise SolverError(f"no variable {name!r}: names are {_names_in_words()}")
    return kind, int(name[len(word) :])


def variable_name(key: str | int) -> str:
    """Name of a variable: a name itself, a number k for the pose ``xk``, or GTSAM's 64-bit key."""
    if isinstance(key, str):
        return key
    if not hasattr(key, "__index__"):
        raise SolverError(f"no variable {key!r}: wanted a name, the number of a pose, or a key of GTSAM")
    return f"x{key:d}" if key < 1 << 56 else key_name(key)


def _names_in_words() -> str:
    return ", ".join(k.word if k.single else f"{k.word}<number>" for k in KINDS.values())


@lru_cache(maxsize=4096)
def gtsam_key(name: str) -> int:
    """GTSAM's 64-bit symbol of a variable name (letter in the top byte)."""
    kind, index = split_name(name)
    return (ord(kind.letter) << 56) | index


def key_name(key: int) -> str:
    """Inverse of :func:`gtsam_key`."""
    letter, index = chr(key >> 56), key & ((1 << 56) - 1)
    kind = next((k for k in KINDS.values() if k.letter == letter), None)
    if kind is None:
        return f"{letter}{index}"
    return kind.word if kind.single else f"{kind.word}{index}"


class _Rows:
    """Rows of one kind in a buffer with spare capacity; appending has a constant amortised cost per row."""

    __slots__ = ("_buffer", "count")

    def __init__(self, array: npt.NDArray[Any]) -> None:
        self._buffer = array
        self.count = len(array)

    @property
    def array(self) -> npt.NDArray[Any]:
        """The rows; a view."""
        return self._buffer[: self.count]

    def append(self, rows: npt.NDArray[Any]) -> None:
        need = self.count + len(rows)
        if need > len(self._buffer):
            grown = np.empty((max(need, 2 * len(self._buffer), 16), *self._buffer.shape[1:]), self._buffer.dtype)
            grown[: self.count] = self.array
            self._buffer = grown
        self._buffer[self.count : need] = rows
        self.count = need


class Values:
    """Values of all variables of a graph: rows by kind.

    Parameters
    ----------
    dim : int
        2 or 3.
    blocks : mapping of str to (n, size)
        By word of the kind; missing kinds have no rows. ``x`` includes row 0, the fixed first base.
    landmark_ids : (n,) int64, optional
        Of the rows of ``l``.

    Notes
    -----
    :attr:`poses`, :attr:`landmarks`, :attr:`datum`, :attr:`biases`, :attr:`tilt`, :attr:`velocities` and
    :attr:`imu_biases` are the blocks under the names that factors use.
    """

    __slots__ = ("_ids", "_rows", "dim")

    def __init__(self, dim: int, blocks: Mapping[str, Array], landmark_ids: Index | None = None) -> None:
        self.dim = dim
        self._rows = {w: _Rows(np.asarray(a, dtype=np.float64)) for w, a in blocks.items()}
        self._ids = _Rows(np.zeros(0, dtype=np.int64) if landmark_ids is None else np.asarray(landmark_ids, np.int64))

    @classmethod
    def empty(cls, dim: int) -> Values:
        """Only the first base, at the origin."""
        return cls(dim, {"x": np.zeros((1, 3)) if dim == 2 else np.array([[0.0, 0, 0, 0, 0, 0, 1]])})

    # ---------------------------------------------------------------- blocks

    def __getitem__(self, word: str) -> Array:
        """Rows ``(n, size)`` of a kind."""
        rows = self._rows.get(word)
        return np.zeros((0, KINDS[word].size(self.dim))) if rows is None else rows.array

    def __setitem__(self, word: str, rows: Array) -> None:
        self._rows[word] = _Rows(np.asarray(rows, dtype=np.float64))

    def append(self, word: str, rows: Array) -> int:
        """Append rows of a kind, at a constant cost per row; returns the number of the first."""
        rows = np.asarray(rows, dtype=np.float64).reshape(-1, KINDS[word].size(self.dim))
        if word not in self._rows:
            self._rows[word] = _Rows(rows.copy())
            return 0
        first = self._rows[word].count
        self._rows[word].append(rows)
        return first

    def count(self, word: str) -> int:
        """Number of variables of a kind (for poses with the fixed first one)."""
        rows = self._rows.get(word)
        return 0 if rows is None else rows.count

    @property
    def landmark_ids(self) -> Index:
        """``(n,)`` int64."""
        return self._ids.array

    @landmark_ids.setter
    def landmark_ids(self, ids: npt.ArrayLike) -> None:
        self._ids = _Rows(np.asarray(ids, dtype=np.int64))

    def append_landmarks(self, ids: npt.ArrayLike, positions: Array) -> None:
        """New landmarks ``(k,)`` at ``(k, dim)``."""
        self._ids.append(np.asarray(ids, dtype=np.int64))
        self.append("l", positions)

    poses = property(lambda self: self["x"], lambda self, a: self.__setitem__("x", a))
    """``(m + 1, 3|7)`` ``T_world_node``: bases, inner nodes, the last end; row 0 is the fixed first base."""
    landmarks = property(lambda self: self["l"], lambda self, a: self.__setitem__("l", a))
    """``(n, dim)`` world positions [m]."""
    biases = property(lambda self: self["bias"], lambda self, a: self.__setitem__("bias", a))
    """``(s, dim)`` GPS biases of the segments in the GPS frame [m]."""
    velocities = property(lambda self: self["velocity"], lambda self, a: self.__setitem__("velocity", a))
    """``(v, dim)`` of an IMU in the frame of the first base [m/s]; the factors have their nodes."""
    imu_biases = property(lambda self: self["imubias"], lambda self, a: self.__setitem__("imubias", a))
    """``(b, 6)`` of its gyro [rad/s] and its accelerometer [m/s²]; ``(b, 3)`` in 2-D: yaw rate, x and y."""
    datum = property(lambda self: self._one("datum"), lambda self, a: self._set_one("datum", a))
    """``(3,)``, ``(4,)`` or None: ``T_gps_world``, with positions relative to the first fix."""
    tilt = property(lambda self: self._one("tilt"), lambda self, a: self._set_one("tilt", a))
    """``(2,)`` or None: rotation vector about x and y [rad] from the z axis of the first base to the up direction."""

    def _one(self, word: str) -> Array | None:
        return self[word][0] if self.count(word) else None

    def _set_one(self, word: str, value: Array | None) -> None:
        if value is None:
            self._rows.pop(word, None)
        else:
            self[word] = np.asarray(value, dtype=np.float64)[None]

    # ---------------------------------------------------------------- all of them

    @property
    def group(self) -> Group:
        """SE(2) or SE(3)."""
        return group_of(self.poses)

    def copy(self) -> Values:
        """Independent copy."""
        return Values(self.dim, {w: r.array.copy() for w, r in self._rows.items()}, self.landmark_ids.copy())

    def layout(self) -> VariableLayout:
        """Columns of these variables."""
        return VariableLayout(self.dim, tuple(self.count(w) for w in KINDS), self.landmark_ids)

    def retract(self, step: Array) -> Values:
        """See :meth:`VariableLayout.retract`, with only the first pose fixed."""
        return self.layout().retract(self, step)

    def distance(self, other: Values) -> float:
        """Largest absolute difference of any value."""
        return max((float(np.abs(self[w] - other[w]).max(initial=0.0)) for w in KINDS), default=0.0)

    def is_finite(self) -> bool:
        """Is every value finite?"""
        return all(bool(np.all(np.isfinite(r.array))) for r in self._rows.values())


class VariableLayout:
    """Columns of the free scalars: kinds in the order of :data:`KINDS`, rows in their order, unless ``order`` is given.

    Parameters
    ----------
    dim : int
        2 or 3.
    counts : tuple of int
        Rows of every kind, fixed poses included.
    landmark_ids : (n,) int64
        In row order.
    fixed : tuple of int
        Rows of ``x`` that are fixed: they have no columns. In a graph of submaps that is ``x0``.
    order : (v,) int, optional
        Variables, numbered through all kinds, in the order of their columns, for example an elimination order. Fixed
        ones are omitted.
    """

    def __init__(
        self,
        dim: int,
        counts: tuple[int, ...],
        landmark_ids: Index,
        fixed: tuple[int, ...] = (0,),
        order: Index | None = None,
    ) -> None:
        self.dim = dim
        self.counts = counts
        self.landmark_ids = landmark_ids
        self.fixed = fixed
        self._order = order
        self._start: dict[str, int] = {}
        c = 0
        for (word, kind), n in zip(KINDS.items(), counts):
            self._start[word] = c
            c += kind.dof(dim) * (n - min(len(fixed), n) if word == "x" else n)
        self.size: int = c
        """Number of free scalars (``states``)."""

    @cached_property
    def _first(self) -> dict[str, Index]:
        """By kind, the first column of every row; -1 for a fixed one."""
        width = np.repeat([k.dof(self.dim) for k in KINDS.values()], self.counts)
        free = np.ones(len(width), dtype=bool)
        free[list(self.fixed[: len(width)])] = False  # poses come first
        order = np.flatnonzero(free) if self._order is None else self._order
        first = np.full(len(width), -1, dtype=np.int64)
        first[order] = np.cumsum(width[order]) - width[order]
        return dict(zip(KINDS, np.split(first, np.cumsum(self.counts)[:-1])))

    def retract(self, values: Values, step: Array) -> Values:
        """Values after a step ``(size,)``: poses (and the 2-D datum) ``T ∘ Exp(ξ)``, all others by addition."""
        new = {}
        for word, kind in KINDS.items():
            rows = values[word]
            if not len(rows):
                continue
            first = self._first[word]
            free = first >= 0
            part = step[first[free, None] + np.arange(kind.dof(self.dim))]
            g = kind.pose_group(self.dim)
            new[word] = rows.copy()
            new[word][free] = rows[free] + part if g is None else g.compose(rows[free], g.exp(part))
        return Values(self.dim, new, values.landmark_ids)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, VariableLayout)
            and (self.dim, self.counts, self.fixed) == (other.dim, other.counts, other.fixed)
            and np.array_equal(self.landmark_ids, other.landmark_ids)
        )

    __hash__ = None  # type: ignore[assignment]

    def count(self, word: str) -> int:
        """Number of rows of a kind."""
        return self.counts[list(KINDS).index(word)]

    def start(self, word: str) -> int:
        """First column of a kind (of the next kind if it has no rows)."""
        return self._start[word]

    def stop(self, word: str) -> int:
        """Column after the last one of a kind."""
        rows = self.count(word) - (len(self.fixed) if word == "x" else 0)
        return self._start[word] + KINDS[word].dof(self.dim) * max(rows, 0)

    def first(self, word: str, rows: npt.ArrayLike) -> Index:
        """First column of rows ``(k,)`` of a kind; -1 for fixed poses, -2 for negative rows (an absent variable)."""
        r = np.asarray(rows, dtype=np.int64)
        have = self._first[word]
        return np.where(r < 0, -2, have[np.maximum(r, 0)] if len(have) else -2)

    def at(self, word: str, rows: npt.ArrayLike) -> Index:
        """Columns ``(k, dof)`` of rows ``(k,)`` of a kind; -1 for negative rows and for fixed poses."""
        first = self.first(word, rows)[..., None]
        return np.where(first < 0, -1, first + np.arange(KINDS[word].dof(self.dim)))

    @property
    def ordered(self) -> bool:
        """Are the columns in a given order?"""
        return self._order is not None

    @property
    def nodes(self) -> int:
        """Number of nodes with the fixed first base."""
        return self.count("x")

    @property
    def pose_dof(self) -> int:
        """Columns of a pose."""
        return KINDS["x"].dof(self.dim)

    @property
    def landmark_start(self) -> int:
        """First column of the landmarks."""
        return self._start["l"]

    @cached_property
    def row_of(self) -> dict[int, int]:
        """Landmark id → row."""
        return {i: r for r, i in enumerate(self.landmark_ids.tolist())}

    def names(self) -> list[str]:
        """Names of the free variables in the order of their columns."""
        out: list[str] = []
        for (word, kind), n in zip(KINDS.items(), self.counts):
            numbers = self.landmark_ids.tolist() if word == "l" else range(n)
            out += [word] * n if kind.single else [f"{word}{k}" for k in numbers]
        first = np.concatenate(list(self._first.values()))
        order = np.argsort(first, kind="stable")
        return [out[k] for k in order[first[order] >= 0].tolist()]

    def owner_of_columns(self) -> list[str]:
        """Name of the variable of each column."""
        return [name for name in self.names() for _ in range(split_name(name)[0].dof(self.dim))]

    def columns(self, name: str) -> npt.NDArray[np.intp]:
        """Columns of one variable; none for the fixed ``x0``."""
        kind, k = split_name(name)
        row = self.row_of.get(k, -1) if kind.word == "l" else k
        if not 0 <= row < self.count(kind.word):
            raise SolverError(f"no variable {name!r} in this graph; poses are x1 … x{self.nodes - 1}")
        c = self.at(kind.word, row)
        return c[c >= 0].astype(np.intp)

    def pose_columns(self, nodes: npt.ArrayLike) -> Index:
        """Columns ``(k, dof)`` of nodes ``(k,)``; -1 for fixed ones."""
        return self.at("x", nodes)

    def columns_of(self, names: Iterable[str]) -> npt.NDArray[np.intp]:
        """Columns of several variables in that order."""
        parts = [self.columns(n) for n in names]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.intp)


def vector_form(cov: Array, poses: Array, pose_columns: Sequence[int]) -> Array:
    """Covariance with pose blocks in the right tangent → the same with (x, y, θ) vectors in the world frame.

    Parameters
    ----------
    cov : (n, n)
    poses : (k, 3)
        Poses whose blocks start at ``pose_columns`` ``(k,)``.
    """
    out = cov.copy()
    for R, c in zip(rotation2(poses[:, 2]), pose_columns):
        out[c : c + 2] = R @ out[c : c + 2]
        out[:, c : c + 2] = out[:, c : c + 2] @ R.T
    return out


def thresholds(dim: int, metres: float, radians: float) -> dict[str, Any]:
    """By letter, the change of each degree of freedom above which it is relinearised ``(dof,)``."""
    return {
        k.letter: np.array([metres if u == "m" else radians for u in k.units[dim]])
        for k in KINDS.values()
        if k.dof(dim)
    }
