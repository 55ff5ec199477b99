"""The graph's own record of every factor: plain arrays, enough to build it again.

Solvers never keep the only copy of anything: GTSAM's incremental solver is lost after a failed update, so whatever
it held is made again from here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.graph.factors.imu.records import MotionRecord
from graphslam.graph.noise import NO_KERNEL, Robust


@dataclass(frozen=True, slots=True, eq=False)
class SubmapRecord:
    """A landmark submap between x_start and x_{start + 1} (Combined SLAM eq. 15).

    Parameters
    ----------
    factor_id, submap_key, start : int
    landmark_ids : (n,) int64
        Graph landmark of every entry; an id may stand twice.
    z : (3 + 2n,)
        ``[exit x, y, θ, l1x, l1y, …]`` in the base frame.
    whitener : (3 + 2n, 3 + 2n)
        ``W`` with ``Wᵀ W`` = information.
    information : ((3 + 2n)²,)
        Row major; made here.
    """

    factor_id: int
    submap_key: int
    start: int
    landmark_ids: npt.NDArray[np.int64]
    z: Array
    whitener: Array
    group: str = "submap"
    information: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "information", (self.whitener.T @ self.whitener).ravel())

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return len(self.z)

    def variables(self) -> list[str]:
        """Names of the free and fixed variables, each once."""
        return [f"x{self.start}", f"x{self.start + 1}", *(f"l{i}" for i in dict.fromkeys(self.landmark_ids.tolist()))]

    def label(self) -> str:
        """Name for messages."""
        return f"submap {self.submap_key} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class BetweenRecord:
    """``T_ij`` between two nodes, right-tangent noise, residual ``Log(T_ij⁻¹ x_i⁻¹ x_j)`` as GTSAM's BetweenFactor.

    Parameters
    ----------
    T_ij : (3,) or (7,)
    whitener : (3, 3) or (6, 6)
        Tangents in GTSAM's order: x, y, θ, or rotation before translation.
    """

    factor_id: int
    i: int
    j: int
    T_ij: Array
    whitener: Array
    robust: Robust = NO_KERNEL
    group: str = "between"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return len(self.whitener)

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.i}", f"x{self.j}"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} x{self.i} → x{self.j} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class GpsRecord:
    """One position fix inside a submap; see :mod:`graphslam.graph.gps` for the residual.

    Parameters
    ----------
    node : int
        Node that the fix hangs on: the base of the submap that holds it, or the nearest inner node.
    arm : (dim,)
        Antenna in the node's frame, ``T_node_body(t) · lever``.
    z : (dim,)
        Fix in the GPS frame, counted from the first fix.
    whitener : (dim, dim)
        Of fix and arm together, in the node's frame.
    bias : int or None
        GPS segment whose bias it carries.
    tilt : bool
        The graph knows where up is, and the level datum is turned by it.
    """

    factor_id: int
    node: int
    time: float
    arm: Array
    z: Array
    whitener: Array
    robust: Robust = NO_KERNEL
    bias: int | None = None
    group: str = "gps"
    tilt: bool = False

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return len(self.z)

    def variables(self) -> list[str]:
        """Names of the variables."""
        bias = [] if self.bias is None else [f"bias{self.bias}"]
        return [f"x{self.node}", "datum", *bias, *(["tilt"] if self.tilt else [])]

    def label(self) -> str:
        """Name for messages."""
        return f"GPS fix at {self.time:.3f} s on x{self.node} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class BiasPriorRecord:
    """Prior ``N(0, sigma² I)`` on the bias of one GPS segment."""

    factor_id: int
    bias: int
    sigma: float
    group: str = "gps-bias"
    dim: int = 2

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return self.dim

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"bias{self.bias}"]

    def label(self) -> str:
        """Name for messages."""
        return f"prior on bias{self.bias} (factor {self.factor_id})"


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeRecord:
    """Where gravity points, seen from a node; see :mod:`graphslam.graph.attitude` for the residual.

    Parameters
    ----------
    node : int
    direction : (3,)
        Unit vector of gravity (down) in the node's frame.
    whitener : (2, 2)
        Of the two components across ``direction`` [1/rad].
    """

    factor_id: int
    node: int
    direction: Array
    whitener: Array
    robust: Robust = NO_KERNEL
    group: str = "attitude"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 2

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"x{self.node}", "tilt"]

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} of x{self.node} (factor {self.factor_id})"


Record = SubmapRecord | BetweenRecord | GpsRecord | BiasPriorRecord | AttitudeRecord | MotionRecord
