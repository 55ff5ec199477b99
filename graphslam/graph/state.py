"""Names, values and columns of the variables of a graph, in the plane or in space.

Variables are named by short strings that also stand in messages: ``x3`` (pose of node 3), ``l17`` (landmark 17),
``datum`` (``T_gps_world``), ``bias2`` (position bias of GPS segment 2), ``tilt`` (where up is in the frame of the first
base, in space only), ``velocity4`` and ``imubias4`` (of an IMU, in the order in which its nodes were tied). The first
base ``x0`` is fixed at the origin and is no variable at all: no prior has to hold it, and nothing is lost to a badly
scaled one.

Poses are SE(2) ``(3,)`` or SE(3) ``(7,)`` and move by right tangents in GTSAM's order: x, y, θ in the plane, rotation
before translation in space. The datum is SE(2) in the plane. In space it is ``[x, y, z, heading]``: the GPS frame and
the frame of the first base are both level, so four numbers lie between them, and they move by plain addition.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import SolverError
from graphslam.core.geometry import Array, rotation2, se2_compose, se2_exp
from graphslam.core.poses import Group, group_of

_WORDS = ("bias", "velocity", "imubias")


def gtsam_key(name: str) -> int:
    """GTSAM's 64-bit symbol of a variable name (letter in the top byte)."""
    if name == "datum":
        return ord("g") << 56
    if name == "tilt":
        return ord("t") << 56
    for word in _WORDS:
        if name.startswith(word):
            return (ord(name[0]) << 56) | int(name[len(word) :])
    return (ord(name[0]) << 56) | int(name[1:])


def key_name(key: int) -> str:
    """Inverse of :func:`gtsam_key`."""
    letter, index = chr(key >> 56), key & ((1 << 56) - 1)
    whole = {"g": "datum", "t": "tilt"}
    words = {word[0]: word for word in _WORDS}
    return whole.get(letter) or f"{words.get(letter, letter)}{index}"


@dataclass(slots=True)
class Values:
    """Values of all variables of a graph.

    Parameters
    ----------
    poses : (m + 1, 3) or (m + 1, 7)
        ``T_world_node`` of every submap's base, of its inner nodes and of the last exit; row 0 is the fixed first base.
    landmark_ids : (n,) int64
    landmarks : (n, dim)
        World positions [m]; none in space.
    datum : (3,) or (4,) or None
        ``T_gps_world``, GPS positions counted from the first fix: x, y, heading, or x, y, z, heading.
    biases : (s, dim)
        GPS biases of the segments in the GPS frame [m].
    tilt : (2,) or None
        Rotation vector about x and y [rad] that takes the z axis of the first base to where up is.
    velocities : (v, 3)
        Of an IMU in the frame of the first base [m/s]; which nodes they are of, the factors say.
    imu_biases : (b, 6)
        Of its gyro [rad/s] and its accelerometer [m/s²].
    """

    poses: Array
    landmark_ids: npt.NDArray[np.int64]
    landmarks: Array
    datum: Array | None = None
    biases: Array = field(default_factory=lambda: np.zeros((0, 2)))
    tilt: Array | None = None
    velocities: Array = field(default_factory=lambda: np.zeros((0, 3)))
    imu_biases: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @classmethod
    def empty(cls, dim: int) -> Values:
        """The first base at the origin and nothing else."""
        start = np.zeros((1, 3)) if dim == 2 else np.array([[0.0, 0, 0, 0, 0, 0, 1]])
        return cls(start, np.zeros(0, dtype=np.int64), np.zeros((0, dim)), None, np.zeros((0, dim)))

    @property
    def group(self) -> Group:
        """SE(2) or SE(3)."""
        return group_of(self.poses)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return 2 if self.poses.shape[1] == 3 else 3

    def copy(self) -> Values:
        """Independent copy."""
        return Values(
            self.poses.copy(),
            self.landmark_ids.copy(),
            self.landmarks.copy(),
            None if self.datum is None else self.datum.copy(),
            self.biases.copy(),
            None if self.tilt is None else self.tilt.copy(),
            self.velocities.copy(),
            self.imu_biases.copy(),
        )

    def layout(self) -> Layout:
        """Columns of these variables."""
        return Layout(
            len(self.poses),
            tuple(self.landmark_ids.tolist()),
            self.datum is not None,
            len(self.biases),
            self.dim,
            self.tilt is not None,
            len(self.velocities),
            len(self.imu_biases),
        )

    def retract(self, step: Array) -> Values:
        """Values after a step ``(layout.size,)``: poses (and the datum of the plane) ``T ∘ Exp(ξ)``, all else plus."""
        g, dim = self.group, self.dim
        m, n = len(self.poses) - 1, len(self.landmarks)
        poses = self.poses.copy()
        poses[1:] = g.compose(poses[1:], g.exp(step[: g.dof * m].reshape(-1, g.dof)))
        c = g.dof * m + dim * n
        landmarks = self.landmarks + step[g.dof * m : c].reshape(-1, dim)
        datum, tilt = self.datum, self.tilt
        if datum is not None:
            k = len(datum)
            datum = se2_compose(datum, se2_exp(step[c : c + k])) if dim == 2 else datum + step[c : c + k]
            c += k
        biases = self.biases + step[c : c + self.biases.size].reshape(-1, dim)
        c += self.biases.size
        if tilt is not None:
            tilt = tilt + step[c : c + 2]
            c += 2
        velocities = self.velocities + step[c : c + self.velocities.size].reshape(-1, 3)
        imu_biases = self.imu_biases + step[c + self.velocities.size :].reshape(-1, 6)
        return Values(poses, self.landmark_ids, landmarks, datum, biases, tilt, velocities, imu_biases)

    def is_finite(self) -> bool:
        """Every number finite."""
        arrays: tuple[Array | None, ...] = (self.poses, self.landmarks, self.datum, self.biases, self.tilt)
        arrays += (self.velocities, self.imu_biases)
        return all(a is None or bool(np.all(np.isfinite(a))) for a in arrays)


@dataclass(frozen=True)
class Layout:
    """Columns: ``[x_1 … x_m (3 | 6 each), landmarks, datum (3 | 4), biases, tilt (2), velocities (3 each),
    biases of an IMU (6 each)]``; x_0 has none.

    Parameters
    ----------
    nodes : int
        m + 1.
    landmark_ids : tuple of int
        In row order.
    datum : bool
    biases : int
    dim : int
        2 or 3: of points and biases.
    tilt : bool
    velocities, imu_biases : int
    """

    nodes: int
    landmark_ids: tuple[int, ...]
    datum: bool
    biases: int
    dim: int = 2
    tilt: bool = False
    velocities: int = 0
    imu_biases: int = 0

    @property
    def pose_dof(self) -> int:
        """Columns of a pose."""
        return 3 if self.dim == 2 else 6

    @property
    def datum_dof(self) -> int:
        """Columns of the datum, if there is one."""
        return 3 if self.dim == 2 else 4

    @property
    def landmark_start(self) -> int:
        """First column of the landmarks."""
        return self.pose_dof * (self.nodes - 1)

    @property
    def datum_start(self) -> int:
        """First column of the datum (or of what follows the landmarks)."""
        return self.landmark_start + self.dim * len(self.landmark_ids)

    @property
    def bias_start(self) -> int:
        """First column of the biases."""
        return self.datum_start + (self.datum_dof if self.datum else 0)

    @property
    def tilt_start(self) -> int:
        """First column of the tilt (or the end)."""
        return self.bias_start + self.dim * self.biases

    @property
    def velocity_start(self) -> int:
        """First column of the velocities."""
        return self.tilt_start + (2 if self.tilt else 0)

    @property
    def imu_bias_start(self) -> int:
        """First column of the biases of an IMU."""
        return self.velocity_start + 3 * self.velocities

    @property
    def size(self) -> int:
        """Number of free scalars (``states``)."""
        return self.imu_bias_start + 6 * self.imu_biases

    @cached_property
    def row_of(self) -> dict[int, int]:
        """Landmark id → row."""
        return {i: r for r, i in enumerate(self.landmark_ids)}

    def names(self) -> list[str]:
        """Names of the variables in column order."""
        out = [f"x{k}" for k in range(1, self.nodes)] + [f"l{i}" for i in self.landmark_ids]
        out += (["datum"] if self.datum else []) + [f"bias{s}" for s in range(self.biases)]
        out += ["tilt"] if self.tilt else []
        out += [f"velocity{k}" for k in range(self.velocities)]
        return out + [f"imubias{k}" for k in range(self.imu_biases)]

    def owner_of_columns(self) -> list[str]:
        """Name of the variable that each column belongs to."""
        width = {"x": self.pose_dof, "d": self.datum_dof, "t": 2, "v": 3, "i": 6}
        return [name for name in self.names() for _ in range(width.get(name[0], self.dim))]

    def columns(self, name: str) -> npt.NDArray[np.intp]:
        """Columns of one variable; none for the fixed ``x0``.

        Raises
        ------
        SolverError
            Unknown variable.
        """
        start, d = -1, self.dim
        try:
            if name == "datum":
                start, d = (self.datum_start if self.datum else -1), self.datum_dof
            elif name == "tilt":
                start, d = (self.tilt_start if self.tilt else -1), 2
            elif name.startswith("bias"):
                s = int(name[4:])
                start = self.bias_start + d * s if 0 <= s < self.biases else -1
            elif name.startswith("velocity"):
                s, d = int(name[8:]), 3
                start = self.velocity_start + d * s if 0 <= s < self.velocities else -1
            elif name.startswith("imubias"):
                s, d = int(name[7:]), 6
                start = self.imu_bias_start + d * s if 0 <= s < self.imu_biases else -1
            elif name[0] == "x":
                k, d = int(name[1:]), self.pose_dof
                if k == 0:
                    return np.zeros(0, dtype=np.intp)
                start = d * (k - 1) if 0 < k < self.nodes else -1
            elif name[0] == "l":
                start = self.landmark_start + d * self.row_of[int(name[1:])]
        except (ValueError, KeyError, IndexError):
            start = -1
        if start < 0:
            raise SolverError(f"no variable {name!r}; names are x1 … x{self.nodes - 1}, l<id>, datum, bias<segment>")
        return np.arange(start, start + d)

    def pose_columns(self, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Columns ``(k, dof)`` of nodes ``(k,)``; -1 for the fixed first base."""
        d = self.pose_dof
        c = d * (np.asarray(nodes)[..., None] - 1) + np.arange(d)
        return np.where(c < 0, -1, c)

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
