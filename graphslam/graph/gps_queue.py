"""Where GPS fixes wait: for the submap that holds them, then for enough of them to start the datum."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.graph.gps import Fix, TiedFix, lever_arm, spread, start_datum
from graphslam.graph.submap_node import SubmapNode


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

    def tie(self, submap: SubmapNode, *, closed: bool = False) -> list[tuple[int, str]]:
        """Move the fixes of one submap to its nodes; returns (factor_id, reason) of those that have no place.

        Parameters
        ----------
        submap : SubmapNode
        closed : bool
            Take ``t == t_end`` as well.
        """
        t0, t1 = submap.interval
        times = np.array([f.time for f in self.waiting])
        inside = (times >= t0) & ((times <= t1) if closed else (times < t1))
        mine = [f for f, m in zip(self.waiting, inside) if m]
        self.waiting = [f for f, m in zip(self.waiting, inside) if not m]
        dropped = []
        if mine and submap.trajectory is None:
            return [(f.factor_id, "submap has no trajectory") for f in mine]
        for f in mine:
            t = np.array([f.time])
            at = submap.nearest(t)
            try:
                arm, cov = lever_arm(*submap.local(t, at), f.lever)
            except DataError:
                dropped.append((f.factor_id, "outside the submap's trajectory"))
                continue
            sigma = f.sigma if f.config.sigma is None else f.config.sigma
            covariance = sigma**2 * np.eye(len(f.lever)) + cov[0]
            self.tied.append(TiedFix(f, submap.nodes[int(at[0])], arm[0], covariance))
        return dropped

    def datum_if_ready(self, poses: Array, origin: Array, baseline: float) -> Array | None:
        """First ``T_gps_world`` from the tied fixes, once they span ``baseline`` on the ground and in the map."""
        if len(self.tied) < 2:
            return None
        group = group_of(poses)
        world = group.transform(poses[[t.node for t in self.tied]], np.array([t.arm for t in self.tied]))
        fixes = np.array([t.fix.position for t in self.tied]) - origin
        if min(spread(world[:, :2]), spread(fixes[:, :2])) < baseline:  # only a level way says where north is
            return None
        sigma = np.array([np.sqrt(t.covariance[0, 0]) for t in self.tied])
        level = start_datum(world[:, :2], fixes[:, :2], sigma)
        if group.dim == 2:
            return level
        return np.array([*level[:2], np.median(fixes[:, 2] - world[:, 2]), level[2]])
