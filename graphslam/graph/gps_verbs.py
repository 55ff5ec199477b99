"""GPS verbs of a graph: taking fixes, tying them to nodes, starting the datum."""

from __future__ import annotations

import numpy as np

from graphslam.core.errors import GeometryError
from graphslam.core.records import Gps
from graphslam.graph.factors.gps import BiasPriorRecord, GpsRecord
from graphslam.graph.gps import Fix, GpsConfig
from graphslam.graph.graph_record import GraphRecord
from graphslam.graph.noise import whitener
from graphslam.graph.submap_node import SubmapNode


class GpsVerbs(GraphRecord):
    """The part of a :class:`~graphslam.graph.pose_graph.PoseGraph` that takes position fixes."""

    def __init__(self, dim: int = 2) -> None:
        super().__init__(dim)
        self._gps_config = GpsConfig()

    def add_gps(self, gps: Gps, *, stream: str = "gps", config: GpsConfig | None = None) -> list[int]:
        """Give the graph position fixes, at any time and in any portion; each finds its own submap.

        Fixes wait until their submap is there, and until :attr:`GpsConfig.baseline` is spanned; then the datum starts
        by rigid alignment and all of them become factors. The map stays where it is then, however late that be: its
        first base is fixed and the datum is solved for. Fixes that no submap covers are dropped and counted
        (:attr:`events`, kind ``gps-dropped``). Each hangs on the node nearest in time, the base or an inner one.

        Returns
        -------
        list of int
            Factor ids, one a fix.

        Raises
        ------
        EvidenceReusedError
            A submap that holds the fix already used ``stream``, or the fix was given before. No fix is taken then.
        """
        if gps.positions.shape[1] != self.dim:
            raise GeometryError(
                "GPS fixes have the wrong dimension", got=gps.positions.shape, wanted=f"(n, {self.dim})"
            )
        cfg = config or self._gps_config
        self._gps_config = cfg
        for t in gps.times:
            self.ledger.check(f"GPS fix at {t:.3f} s", [stream], (float(t), float(t)))
        fixes = []
        for t, p, s in zip(gps.times.tolist(), gps.positions, gps.sigma.tolist()):
            fixes.append(Fix(self._next_factor, t, p, s, gps.lever, cfg))
            self.ledger.spend(self._next_factor, f"GPS fix at {t:.3f} s", [stream], (t, t))
            self._next_factor += 1
        self.gps.add(fixes)
        for s in self.submaps:
            self._tie_fixes(s, more=s is not self.submaps[-1])
        return [f.factor_id for f in fixes]

    def finish_gps(self) -> None:
        """No more submaps will come: the last instant belongs to the last submap, later fixes are dropped."""
        if self.submaps:
            self._tie_fixes(self.submaps[-1], closed=True)
        self._drop_fixes([(f.factor_id, "after the last submap") for f in self.gps.waiting])
        self.gps.waiting = []

    def _tie_fixes(self, s: SubmapNode, *, closed: bool = False, more: bool = False) -> None:
        """Give a submap its waiting fixes; with ``more`` to follow, do not start the datum yet."""
        dropped = self.gps.tie(s, closed=closed)
        late = [f for f in self.gps.waiting if f.time < s.interval[0] and not more and s is self.submaps[-1]]
        self.gps.waiting = [f for f in self.gps.waiting if f not in late]
        self._drop_fixes([*dropped, *((f.factor_id, "no submap covers it") for f in late)])
        if more or not self.gps.tied:
            return
        if self.gps_origin is None:
            self.gps_origin = self.gps.tied[0].fix.position.copy()
        if not self.structure.count("datum"):
            start = self.gps.datum_if_ready(self.values.poses, self.gps_origin, self.gps.tied[0].fix.config.baseline)
            if start is None:
                return
            self.values.datum = start
            self._event("datum", fixes=len(self.gps.tied), T_gps_world=start.tolist())
        for t in sorted(self.gps.tied, key=lambda t: t.fix.time):
            bias = self._bias_of(t.fix)
            W = whitener(t.covariance, what=f"covariance of the GPS fix at {t.fix.time:.3f} s")
            z = t.fix.position - self.gps_origin
            tilt = self.structure.count("tilt") > 0
            self.insert(
                GpsRecord(t.fix.factor_id, t.node, t.fix.time, t.arm, z, W, t.fix.config.robust, bias, tilt=tilt)
            )
        self.gps.tied = []

    def _bias_of(self, fix: Fix) -> int | None:
        cfg, previous = fix.config, self.gps.last_time
        self.gps.last_time = fix.time
        if cfg.bias_sigma is None:
            return None
        if self.structure.count("bias") == 0 or fix.time - previous > cfg.segment_gap:
            s = self.structure.append("bias", np.zeros(self.dim))
            record = BiasPriorRecord(self._next_factor, s, cfg.bias_sigma, dim=self.dim)
            self.ledger.spend(record.factor_id, record.label(), ["-"], (fix.time, fix.time), "prior")
            self.insert(record)
        return self.structure.count("bias") - 1
