"""Records of what an IMU says: preintegrated ways, biases, specific forces (residuals: ``batch.py``)."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam.core.geometry import Array
from graphslam.graph.noise import NO_KERNEL, RobustKernel


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecord:
    """The way from node i to node j, preintegrated.

    Parameters
    ----------
    i, j : int
        Nodes.
    interval : (t_i, t_j)
    velocities : (a, b)
        Velocities of the unit at i and at j: rows of :attr:`~graphslam.graph.variables.Values.velocities`.
    biases : (a, b)
        Rows of :attr:`~graphslam.graph.variables.Values.imu_biases`.
    T_i_imu, T_j_imu : (7,)
        The unit seen from the nodes.
    R, p, v : (3, 3), (3,), (3,)
        ΔR, Δp, Δv.
    J : (9, 6)
        Of ``[φ, p, v]`` by the biases.
    bias : (6,)
        About which they were preintegrated.
    whitener : (15, 15)
        Of ``[φ, p, v, b_g, b_a]``; in the plane (8, 8), of what these have in the plane.
    local : (2, 6, 6)
        Covariances of ``T_i_imu`` and ``T_j_imu`` (right tangents) that the whitener holds.
    planar : bool
        In a graph of the plane: all else is embedded in space (:mod:`graphslam.graph.factors.imu.plane`).
    """

    factor_id: int
    stream: str
    i: int
    j: int
    interval: tuple[float, float]
    velocities: tuple[int, int]
    biases: tuple[int, int]
    T_i_imu: Array
    T_j_imu: Array
    R: Array
    p: Array
    v: Array
    J: Array
    bias: Array
    whitener: Array
    local: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "imu"
    planar: bool = False

    @property
    def seconds(self) -> float:
        """T."""
        return self.interval[1] - self.interval[0]

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return len(self.whitener)

    def variables(self) -> list[str]:
        """Names of the variables."""
        (va, vb), (ba, bb) = self.velocities, self.biases
        names = [f"x{self.i}", f"velocity{va}", f"imubias{ba}", f"x{self.j}", f"velocity{vb}", f"imubias{bb}"]
        return names if self.planar else [*names, "tilt"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.stream} x{self.i} → x{self.j} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class GyroRecord(ImuRecord):
    """The same by the gyro alone: ``whitener`` (9, 9) of ``[φ, b_g, b_a]``, or (4, 4); no velocity, no gravity."""

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.i}", f"imubias{self.biases[0]}", f"x{self.j}", f"imubias{self.biases[1]}"]


@dataclass(frozen=True, slots=True, eq=False)
class ImuBiasRecord:
    """A bias at its start, or how far it walks where no preintegrated way ties it to the one before.

    Parameters
    ----------
    before : int or None
        Row of the bias before; None at the start, where the bias is zero within ``sigma``.
    bias : int
        Row.
    sigma : (6,) or (3,)
    """

    factor_id: int
    stream: str
    before: int | None
    bias: int
    sigma: Array
    group: str = "imu-bias"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return len(self.sigma)

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [*([] if self.before is None else [f"imubias{self.before}"]), f"imubias{self.bias}"]

    def label(self) -> str:
        """Name for messages."""
        return f"bias {self.bias} of {self.stream} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class ForceRecord:
    """The mean specific force about a node, where the unit hardly accelerates: gravity and the bias.

    Parameters
    ----------
    bias : int
        Row of :attr:`~graphslam.graph.variables.Values.imu_biases`.
    T_node_imu : (7,)
    force : (3,)
        In the axes of the unit [m/s²].
    whitener : (3, 3)
    """

    factor_id: int
    stream: str
    node: int
    time: float
    bias: int
    T_node_imu: Array
    force: Array
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "imu-gravity"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 3

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}", f"imubias{self.bias}", "tilt"]

    def label(self) -> str:
        """Name for messages."""
        return f"gravity seen by {self.stream} at x{self.node} (factor {self.factor_id})"
