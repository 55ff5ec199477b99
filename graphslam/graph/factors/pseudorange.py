"""Pseudoranges, the receiver's clock, and biases of satellites: positions by satellites without a receiver's own fixes.

An antenna at ``arm`` in its node's frame stands at ``y = T_gps_world x arm`` in the GPS frame, where the satellite is
at s. With the clock's offset c (times the speed of light), a bias b of the satellite (what buildings and atmosphere
leave) and one of its system::

    r = |y - s| + c + b + b_system - z

The clock drifts: ``c' = c + (d + d')/2 Δt``, ``d' = d``, with walks of both. A satellite's bias is a Gauss–Markov
process, ``b' = b exp(-Δt/τ) + w``. Both are factors of their own, so that every solver of the graph solves for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.factors.gps import antenna_terms
from graphslam.graph.factors.range import TOUCHING
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.variables import VariableKind, register_variable

register_variable(
    VariableKind(
        "clock", "k", {3: "mm"}, classes=("pseudorange",),
        remedy="the clock of a receiver is unconstrained: it needs pseudoranges of its epoch, or a clock before it.",
    )
)  # fmt: skip
register_variable(
    VariableKind(
        "satbias", "s", {3: "m"}, classes=("satellite-bias", "pseudorange"),
        remedy="the bias of a satellite needs a prior: set bias_sigma.",
    )
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PseudorangeRecord:
    """One pseudorange at a node.

    Parameters
    ----------
    arm : (3,)
        Antenna in the node's frame [m].
    satellite : (3,)
        In the GPS frame, whose origin is that of the fixes [m].
    distance, sigma : float
        [m]
    number : int
        Of the satellite, for messages.
    clock : int
        Row of the receiver's clock at the epoch.
    bias, system : int or None
        Rows of ``satbias``: the satellite's own, and its system's.
    tilt : bool
        The graph knows where up is.
    """

    factor_id: int
    node: int
    time: float
    arm: Array
    satellite: Array
    distance: float
    sigma: float
    number: int
    clock: int
    bias: int | None = None
    system: int | None = None
    tilt: bool = False
    robust: RobustKernel = NO_KERNEL
    group: str = "pseudorange"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        biases = [f"satbias{b}" for b in (self.bias, self.system) if b is not None]
        return [f"x{self.node}", "datum", f"clock{self.clock}", *biases, *(["tilt"] if self.tilt else [])]

    def label(self) -> str:
        """Name for messages."""
        return f"pseudorange of satellite {self.number} at {self.time:.3f} s on x{self.node} (factor {self.factor_id})"


class PseudorangeBatch(UniformBatch):
    """Pseudoranges."""

    record = PseudorangeRecord
    slots = ("x", "datum", "clock", "satbias", "satbias", "tilt")

    def __init__(self, records: Sequence[PseudorangeRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._arm = np.array([r.arm for r in records]).reshape(-1, 3)
        self._satellite = np.array([r.satellite for r in records]).reshape(-1, 3)
        self._z = np.array([r.distance for r in records])

    @staticmethod
    def keys(record: PseudorangeRecord) -> Sequence[int | None]:
        """Node, datum, clock, biases of the satellite and of its system if there are any, tilt if it is known."""
        return record.node, 0, record.clock, record.bias, record.system, 0 if record.tilt else None

    @staticmethod
    def whitener(record: PseudorangeRecord) -> Array:
        """Of σ."""
        return np.array([[1.0 / record.sigma]])

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        x, datum, clock, bias, system, tilt = blocks
        k = len(x)
        J = np.zeros((k, 1, 6 + 4 + 2 + 1 + 1 + 2))
        if not k:
            return np.zeros((0, 1)), J
        known = self._rows[:, 5] >= 0
        y, by = antenna_terms(x, datum[0], tilt[np.argmax(known)], self._arm, ~known)
        d = y - self._satellite
        length = np.linalg.norm(d, axis=1)
        n = (d / np.maximum(length, TOUCHING)[:, None])[:, None]
        by = n @ by
        J[:, :, :10], J[:, :, 14:] = by[:, :, :10], by[:, :, 10:]
        J[:, :, 10] = 1.0
        J[:, 0, 12:14] = self._rows[:, 3:5] >= 0
        return (length + clock[:, 0] + bias[:, 0] + system[:, 0] - self._z)[:, None], J


@dataclass(frozen=True, slots=True, eq=False)
class ClockRecord:
    """How the receiver's clock goes from one epoch to the next.

    Parameters
    ----------
    before, after : int
        Rows of ``clock``.
    offset_walk : float
        Of the offset [m/√s].
    drift_walk : float
        Of the drift [m/s/√s].
    """

    factor_id: int
    before: int
    after: int
    seconds: float
    offset_walk: float
    drift_walk: float
    group: str = "clock"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 2

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [f"clock{self.before}", f"clock{self.after}"]

    def label(self) -> str:
        """Name for messages."""
        return f"clock {self.before} → {self.after} (factor {self.factor_id})"


class ClockBatch(UniformBatch):
    """Receiver clocks over time."""

    record = ClockRecord
    slots = ("clock", "clock")

    def __init__(self, records: Sequence[ClockRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._seconds = np.array([r.seconds for r in records])

    @staticmethod
    def keys(record: ClockRecord) -> Sequence[int | None]:
        """Before, after."""
        return record.before, record.after

    @staticmethod
    def whitener(record: ClockRecord) -> Array:
        """Of the walks."""
        return np.diag([1.0 / record.offset_walk, 1.0 / record.drift_walk]) / np.sqrt(record.seconds)

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        a, b = blocks
        half = 0.5 * self._seconds
        r = np.stack([b[:, 0] - a[:, 0] - half * (a[:, 1] + b[:, 1]), b[:, 1] - a[:, 1]], axis=1)
        J = np.zeros((len(r), 2, 4))
        J[:, 0, 0], J[:, 0, 2], J[:, 0, 1], J[:, 0, 3] = -1.0, 1.0, -half, -half
        J[:, 1, 1], J[:, 1, 3] = -1.0, 1.0
        return r, J


@dataclass(frozen=True, slots=True, eq=False)
class SatelliteBiasRecord:
    """A bias, by the one before it or by nothing: ``b' = keep b + w``.

    Parameters
    ----------
    before : int or None
        Row of ``satbias``; None: the first one.
    keep : float
        ``exp(-Δt/τ)``.
    sigma : float
        Of w [m].
    """

    factor_id: int
    before: int | None
    bias: int
    keep: float
    sigma: float
    group: str = "satellite-bias"

    @property
    def rows(self) -> int:
        """Dimension of the residual."""
        return 1

    def variables(self) -> list[str]:
        """Names of the variables."""
        return [*([] if self.before is None else [f"satbias{self.before}"]), f"satbias{self.bias}"]

    def label(self) -> str:
        """Name for messages."""
        return f"bias {self.bias} of a satellite (factor {self.factor_id})"


class SatelliteBiasBatch(UniformBatch):
    """Gauss–Markov processes of satellites' biases."""

    record = SatelliteBiasRecord
    slots = ("satbias", "satbias")
    prior = True

    def __init__(self, records: Sequence[SatelliteBiasRecord], layout: Any) -> None:
        super().__init__(records, layout)
        self._keep = np.array([0.0 if r.before is None else r.keep for r in records])

    @staticmethod
    def keys(record: SatelliteBiasRecord) -> Sequence[int | None]:
        """Before, now."""
        return record.before, record.bias

    @staticmethod
    def whitener(record: SatelliteBiasRecord) -> Array:
        """Of σ."""
        return np.array([[1.0 / record.sigma]])

    def terms(self, *blocks: Array) -> tuple[Array, Array]:
        """See :meth:`~graphslam.graph.factors.batch.UniformBatch.terms`."""
        before, now = blocks
        J = np.stack([-self._keep, np.ones(len(now))], axis=1)[:, None]
        return now - self._keep[:, None] * before, J
