"""Records of IMU factors: preintegrated measurements, biases, specific forces (residuals: ``batch.py``)."""

from __future__ import annotations

from dataclasses import dataclass

from graphslam.core.geometry import Array
from graphslam.graph.factors.batch import WhitenedRecord
from graphslam.graph.noise import NO_KERNEL, RobustKernel


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecord(WhitenedRecord):
    """The preintegrated measurement from node i to node j.

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
        The unit relative to the nodes.
    R, p, v : (3, 3), (3,), (3,)
        ΔR, Δp, Δv.
    J : (9, 6)
        Of ``[φ, p, v]`` by the biases.
    bias : (6,)
        Bias that was subtracted in the preintegration.
    whitener : (15, 15)
        Of ``[φ, p, v, b_g, b_a]``; in 2-D (8, 8), of their planar components.
    local : (2, 6, 6)
        Covariances of ``T_i_imu`` and ``T_j_imu`` (right tangents), which the whitener includes.
    planar : bool
        In a 2-D graph: all other arrays are embedded in 3-D (:mod:`graphslam.graph.factors.imu.plane`).
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
    """The same with the gyro only: ``whitener`` (9, 9) of ``[φ, b_g, b_a]``, or (4, 4); no velocity, no gravity."""

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.i}", f"imubias{self.biases[0]}", f"x{self.j}", f"imubias{self.biases[1]}"]


@dataclass(frozen=True, slots=True, eq=False)
class ImuBiasRecord:
    """Prior of a bias, or its random walk if no preintegrated measurement connects it to the previous one.

    Parameters
    ----------
    before : int or None
        Row of the previous bias; None for a prior of mean zero with ``sigma``.
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
    """The mean specific force at a node with little acceleration: gravity and bias.

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
