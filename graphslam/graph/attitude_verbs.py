"""Verbs of a graph in space that say where gravity points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.graph.factors.attitude import DOWN, AttitudeRecord
from graphslam.graph.factors.gps import GpsRecord
from graphslam.graph.gps_verbs import GpsVerbs
from graphslam.graph.ledger import EXCLUSIVE
from graphslam.graph.noise import NO_KERNEL, Robust

LEVELLED = "levelled"
"""Ledger kind and class of the attitudes of levelled bases."""

GIVEN_UP = 1.0
"""Standard deviation [rad] of relative roll and pitch where a submap gave them up for absolute ones."""


class AttitudeVerbs(GpsVerbs):
    """The part of a :class:`~graphslam.graph.pose_graph.PoseGraph` that takes directions of gravity."""

    def add_attitude(
        self,
        node: int,
        direction: ArrayLike,
        sigma: float,
        *,
        streams: Iterable[str] = (),
        interval: tuple[float, float] | None = None,
        evidence: str = EXCLUSIVE,
        robust: Robust = NO_KERNEL,
        group: str = "attitude",
    ) -> int:
        """Where gravity points, seen from a node: roll and pitch, and nothing of the heading.

        The first one brings in the variable ``tilt``, where up is in the frame of the first base
        (:mod:`graphslam.graph.factors.attitude`); what the first base itself saw of gravity goes to node 0.

        Parameters
        ----------
        node : int
        direction : (3,)
            Of gravity (down) in the node's frame; any length but zero. ``(0, 0, -1)`` if the node is level.
        sigma : float
            Standard deviation of roll and of pitch [rad].
        streams, interval
            What it spends; an exclusive measurement must say both.
        evidence : str
            ``"measurement"``, or a kind declared in the ledger.
        robust : Robust
        group : str
            Class under which :meth:`objective` reports it.

        Returns
        -------
        int
            Factor id.

        Raises
        ------
        GeometryError
            In the plane, or a direction without length.
        ConfigError, DataError, EvidenceReusedError
        """
        if self.dim != 3:
            raise GeometryError("gravity says nothing of poses in the plane", wanted="a graph in space")
        if not 0 <= node < self.structure.count("x"):
            raise DataError(
                "attitude of a node that is not there", got=node, wanted=f"x0 … x{self.structure.count('x') - 1}"
            )
        d = np.asarray(direction, dtype=np.float64)
        length = float(np.linalg.norm(d)) if d.shape == (3,) else float("nan")
        if not (np.isfinite(length) and length > 0):
            raise GeometryError(f"direction of gravity at x{node} is not usable", got=direction, wanted="three numbers")
        if not (np.isfinite(sigma) and sigma > 0):
            raise ConfigError(f"attitude of x{node} needs a positive sigma, got {sigma}")
        names = list(streams)
        if evidence == EXCLUSIVE and (not names or interval is None):
            raise ConfigError(f"attitude of x{node} must name the streams and the interval that it spends")
        record = AttitudeRecord(self._next_factor, node, d / length, np.eye(2) / sigma, robust, group)
        self.ledger.spend(record.factor_id, record.label(), names or ["-"], interval or (0.0, 0.0), evidence)
        self._start_tilt()
        self.insert(record)
        self._event("attitude", factor_id=record.factor_id, node=node, sigma=sigma, evidence=evidence, group=group)
        return record.factor_id

    def _start_tilt(self) -> None:
        """Bring in the variable ``tilt``; fixes that took the z axis of the first base for up are turned by it."""
        if not self.structure.count("tilt"):
            self.structure.append("tilt", np.zeros(2))
            for fid, r in self.records.items():
                if isinstance(r, GpsRecord) and self.dim == 3:
                    self.records[fid] = replace(r, tilt=True)  # a new object: solvers see that it changed
            self.revision += 1

    def _level(self, node: int, sigma: float, time: float) -> int:
        """A base that was levelled: a declared exception of the ledger, see :meth:`PoseGraph.add_submap`."""
        return self.add_attitude(
            node, DOWN, sigma, streams=["gravity"], interval=(time, time), evidence=LEVELLED, group=LEVELLED
        )


def without_tilt(covariance: Array) -> Array:
    """An exit's covariance ``(6, 6)`` that knows nothing of roll and pitch any more.

    Adding a large variance to two components leaves the marginal of the others as it was: only what the exit said of
    relative roll and pitch is gone.
    """
    out = covariance.copy()
    out[[0, 1], [0, 1]] += GIVEN_UP**2
    return out
