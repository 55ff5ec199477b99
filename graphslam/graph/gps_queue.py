"""Where GPS fixes wait: for the submap that holds them, then for enough of them to start the datum."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_transform
from graphslam.core.trajectory import Trajectory
from graphslam.graph.gps import Fix, TiedFix, arm_of, spread, start_datum


@dataclass(slots=True)
class GpsQueue:
    """Fixes that are not factors yet.

    A fix at ``t`` belongs to the submap with ``t_start <= t < t_end``: exactly on a boundary it belongs to the later
    one. The very last instant of a finished graph belongs to the last submap (:meth:`tie` with ``closed``).
    """

    waiting: list[Fix] = field(default_factory=list)
    tied: list[TiedFix] = field(default_factory=list)
    last_time: float = -np.inf

    def add(self, fixes: Iterable[Fix]) -> None:
        """Queue fixes, keeping the order of time."""
        self.waiting = sorted([*self.waiting, *fixes], key=lambda f: f.time)

    def tie(
        self, node: int, interval: tuple[float, float], trajectory: Trajectory | None, *, closed: bool = False
    ) -> list[tuple[int, str]]:
        """Move the fixes of one submap to its base; returns (factor_id, reason) of those that have no place.

        Parameters
        ----------
        node : int
        interval : (t_start, t_end)
        trajectory : Trajectory or None
            ``T_start_body(t)``.
        closed : bool
            Take ``t == t_end`` as well.
        """
        t0, t1 = interval
        times = np.array([f.time for f in self.waiting])
        inside = (times >= t0) & ((times <= t1) if closed else (times < t1))
        mine = [f for f, m in zip(self.waiting, inside) if m]
        self.waiting = [f for f, m in zip(self.waiting, inside) if not m]
        dropped = []
        if mine and trajectory is None:
            return [(f.factor_id, "submap has no trajectory") for f in mine]
        for f in mine:
            assert trajectory is not None
            try:
                arm, cov = arm_of(trajectory, np.array([f.time]), f.lever)
            except DataError:
                dropped.append((f.factor_id, "outside the submap's trajectory"))
                continue
            sigma = f.sigma if f.config.sigma is None else f.config.sigma
            self.tied.append(TiedFix(f, node, arm[0], sigma**2 * np.eye(2) + cov[0]))
        return dropped

    def datum_if_ready(self, poses: Array, origin: Array, baseline: float) -> Array | None:
        """First ``T_gps_world`` from the tied fixes, once they span ``baseline`` on the ground and in the map."""
        if len(self.tied) < 2:
            return None
        world = se2_transform(poses[[t.node for t in self.tied]], np.array([t.arm for t in self.tied]))
        fixes = np.array([t.fix.position for t in self.tied]) - origin
        if min(spread(world), spread(fixes)) < baseline:
            return None
        return start_datum(world, fixes, np.array([np.sqrt(t.covariance[0, 0]) for t in self.tied]))
