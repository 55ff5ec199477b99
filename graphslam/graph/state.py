"""Names, values and columns of the variables of a graph.

Variables are named by short strings that also stand in messages: ``x3`` (pose of the base of submap 3), ``l17``
(landmark 17), ``datum`` (``T_gps_world``), ``bias2`` (position bias of GPS segment 2). The first base ``x0`` is fixed
at the origin and is no variable at all: no prior has to hold it, and nothing is lost to a badly scaled one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import SolverError
from graphslam.core.geometry import Array, rotation2, se2_compose, se2_exp


def gtsam_key(name: str) -> int:
    """GTSAM's 64-bit symbol of a variable name (letter in the top byte)."""
    if name == "datum":
        return ord("g") << 56
    if name.startswith("bias"):
        return (ord("b") << 56) | int(name[4:])
    return (ord(name[0]) << 56) | int(name[1:])


def key_name(key: int) -> str:
    """Inverse of :func:`gtsam_key`."""
    letter, index = chr(key >> 56), key & ((1 << 56) - 1)
    return "datum" if letter == "g" else f"bias{index}" if letter == "b" else f"{letter}{index}"


@dataclass(slots=True)
class Values:
    """Values of all variables of a 2-D graph.

    Parameters
    ----------
    poses : (m + 1, 3)
        ``T_world_base`` of every submap's base and of the last exit; row 0 is the fixed first base.
    landmark_ids : (n,) int64
    landmarks : (n, 2)
        World positions [m].
    datum : (3,) or None
        ``T_gps_world``, GPS positions counted from the first fix.
    biases : (s, 2)
        GPS biases of the segments in the GPS frame [m].
    """

    poses: Array
    landmark_ids: npt.NDArray[np.int64]
    landmarks: Array
    datum: Array | None = None
    biases: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def copy(self) -> Values:
        """Independent copy."""
        return Values(
            self.poses.copy(),
            self.landmark_ids.copy(),
            self.landmarks.copy(),
            None if self.datum is None else self.datum.copy(),
            self.biases.copy(),
        )

    def layout(self) -> Layout:
        """Columns of these variables."""
        return Layout(len(self.poses), tuple(self.landmark_ids.tolist()), self.datum is not None, len(self.biases))

    def retract(self, step: Array) -> Values:
        """Values after a step ``(layout.size,)``: poses and datum ``T ∘ Exp(ξ)``, points plus."""
        m, n = len(self.poses) - 1, len(self.landmarks)
        poses = self.poses.copy()
        poses[1:] = se2_compose(poses[1:], se2_exp(step[: 3 * m].reshape(-1, 3)))
        c = 3 * m + 2 * n
        landmarks = self.landmarks + step[3 * m : c].reshape(-1, 2)
        datum = self.datum
        if datum is not None:
            datum = se2_compose(datum, se2_exp(step[c : c + 3]))
            c += 3
        return replace(
            self, poses=poses, landmarks=landmarks, datum=datum, biases=self.biases + step[c:].reshape(-1, 2)
        )

    def is_finite(self) -> bool:
        """Every number finite."""
        return bool(
            np.all(np.isfinite(self.poses))
            and np.all(np.isfinite(self.landmarks))
            and (self.datum is None or np.all(np.isfinite(self.datum)))
            and np.all(np.isfinite(self.biases))
        )


@dataclass(frozen=True)
class Layout:
    """Columns: ``[x_1 … x_m (3 each), landmarks (2 each), datum (3), biases (2 each)]``; x_0 has none.

    Parameters
    ----------
    nodes : int
        m + 1.
    landmark_ids : tuple of int
        In row order.
    datum : bool
    biases : int
    """

    nodes: int
    landmark_ids: tuple[int, ...]
    datum: bool
    biases: int

    @property
    def landmark_start(self) -> int:
        """First column of the landmarks."""
        return 3 * (self.nodes - 1)

    @property
    def datum_start(self) -> int:
        """First column of the datum (or of what follows the landmarks)."""
        return self.landmark_start + 2 * len(self.landmark_ids)

    @property
    def bias_start(self) -> int:
        """First column of the biases."""
        return self.datum_start + (3 if self.datum else 0)

    @property
    def size(self) -> int:
        """Number of free scalars (``states``)."""
        return self.bias_start + 2 * self.biases

    @cached_property
    def row_of(self) -> dict[int, int]:
        """Landmark id → row."""
        return {i: r for r, i in enumerate(self.landmark_ids)}

    def names(self) -> list[str]:
        """Names of the variables in column order."""
        out = [f"x{k}" for k in range(1, self.nodes)] + [f"l{i}" for i in self.landmark_ids]
        return out + (["datum"] if self.datum else []) + [f"bias{s}" for s in range(self.biases)]

    def owner_of_columns(self) -> list[str]:
        """Name of the variable that each column belongs to."""
        return [name for name in self.names() for _ in range(3 if name[0] in "xd" else 2)]

    def columns(self, name: str) -> npt.NDArray[np.intp]:
        """Columns of one variable; none for the fixed ``x0``.

        Raises
        ------
        SolverError
            Unknown variable.
        """
        try:
            if name == "datum":
                start, d = (self.datum_start, 3) if self.datum else (-1, 3)
            elif name.startswith("bias"):
                s = int(name[4:])
                start, d = (self.bias_start + 2 * s, 2) if 0 <= s < self.biases else (-1, 2)
            elif name[0] == "x":
                k = int(name[1:])
                if k == 0:
                    return np.zeros(0, dtype=np.intp)
                start, d = (3 * (k - 1), 3) if 0 < k < self.nodes else (-1, 3)
            else:
                start, d = (self.landmark_start + 2 * self.row_of[int(name[1:])], 2) if name[0] == "l" else (-1, 2)
        except (ValueError, KeyError, IndexError):
            start, d = -1, 0
        if start < 0:
            raise SolverError(f"no variable {name!r}; names are x1 … x{self.nodes - 1}, l<id>, datum, bias<segment>")
        return np.arange(start, start + d)

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
