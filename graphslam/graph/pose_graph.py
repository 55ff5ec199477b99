"""The graph: nodes, landmarks, datum, and its own record of every factor.

Node ``x_k`` is the base of submap k, ``x_0`` is fixed at the origin, the last node is the end of the last submap. The
graph knows no solver: it holds records, values and the ledger; solvers read them and write values back.

Examples
--------
The path of a pipeline, once per finished submap, and the end of a run::

    graph = PoseGraph()
    solver = make_solver("isam2", graph)                     # graphslam.solve.registry; "batch" has the same verbs
    config = AssociationConfig(covariance_scale=5.0)         # graphslam.graph.landmark_association
    graph.add_gps(log["gps"], config=GpsConfig(robust=Robust("cauchy", 1.0)))  # fixes wait for their submap
    for submap in submaps:
        ids = associate(graph, submap, config)               # -1 = new
        graph.add_submap(submap, landmark_ids=ids, covariance_scale=5.0)
        solver.update()
    graph.finish_gps()
    for keep, drop in euclidean_merges(graph, 0.7):          # graphslam.graph.landmark_merging
        graph.merge_landmarks(keep, drop)
    solver.solve_to_optimum()
    solution = solver.solution()
    print(solution.score["submap"].chi2_per_dof)             # χ²/dof of the join
    path = solution.trajectory()
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import ArrayLike, se2_compose, se2_transform
from graphslam.core.records import Gps
from graphslam.core.submap import Match, Submap
from graphslam.graph.gps import Fix, GpsConfig
from graphslam.graph.graph_record import GraphRecord, SubmapNode
from graphslam.graph.ledger import EXCLUSIVE
from graphslam.graph.noise import NO_KERNEL, Robust, whitener
from graphslam.graph.records import BetweenRecord, BiasPriorRecord, GpsRecord, Record, SubmapRecord

__all__ = ["PoseGraph", "SubmapNode"]


class PoseGraph(GraphRecord):
    """A 2-D graph of submaps, landmarks and GPS: the verbs that add factors.

    The first base is fixed at the origin. What it holds and what can be asked of it is in
    :class:`~graphslam.graph.graph_record.GraphRecord`.

    Parameters
    ----------
    dim : int
        2.
    """

    def __init__(self, dim: int = 2) -> None:
        super().__init__(dim)
        self._gps_config = GpsConfig()

    def add_submap(
        self, submap: Submap, landmark_ids: npt.ArrayLike | None = None, *, covariance_scale: float = 1.0
    ) -> int:
        """Append a submap: a new node, new landmarks, and one factor with the full joint covariance.

        Parameters
        ----------
        submap : Submap
            Starts where the last one ended, or where :meth:`start_session` put its base. Without landmarks it becomes
            a between-factor.
        landmark_ids : (n,) int, optional
            Graph landmark of every entry, -1 = new; by default the submap's own ids. An id may stand twice.
        covariance_scale : float
            Factor on the covariance.

        Returns
        -------
        int
            Factor id.

        Raises
        ------
        EvidenceReusedError
            Its streams were already spent over an overlapping interval (nothing is changed then).
        CovarianceError, GeometryError, DataError
        """
        if submap.dim != 2:
            raise GeometryError(f"submap {submap.key} has the wrong dimension", got=submap.dim, wanted=2)
        if any(s.key == submap.key for s in self.submaps):
            raise DataError(f"submap {submap.key} is already in the graph", wanted="each submap once")
        lm = submap.landmarks
        n = 0 if lm is None else len(lm)
        ids = np.array(landmark_ids if landmark_ids is not None else ([] if lm is None else lm.ids), dtype=np.int64)
        if ids.shape != (n,):
            raise GeometryError(f"landmark ids of submap {submap.key} do not fit", got=ids.shape, wanted=(n,))
        gone = [int(i) for i in ids if int(i) in self._retired]
        if np.any(ids < -1) or gone:
            raise DataError(
                f"landmark ids of submap {submap.key} are not usable",
                got=f"merged-away ids {gone}" if gone else int(ids.min()),
                wanted="-1 for new, or an id of the graph or a fresh one",
            )
        what = f"covariance of submap {submap.key}"
        if lm is None:
            W = whitener(submap.exit_covariance, what=what, dim=3, scale=covariance_scale)
        else:
            W = whitener(lm.dense_covariance(), what=what, dim=3 + 2 * n, scale=covariance_scale)
        node, fid = len(self.values.poses) - 1, self._next_factor
        self.ledger.spend(fid, f"submap {submap.key}", submap.uses, submap.interval)
        # from here on nothing fails
        fresh = np.flatnonzero(ids < 0)
        top = max(self._next_landmark, int(ids.max(initial=-1)) + 1)
        ids[fresh] = top + np.arange(len(fresh))
        self._next_landmark = max(self._next_landmark, int(ids.max(initial=-1)) + 1)
        record: Record
        if lm is None:
            record = BetweenRecord(fid, node, node + 1, submap.exit_pose, W, group="dense-submap")
        else:
            record = SubmapRecord(fid, submap.key, node, ids, lm.mean, W)
            self._start_landmarks(ids, se2_transform(self.values.poses[-1], lm.positions))
        self.values.poses = np.vstack([self.values.poses, se2_compose(self.values.poses[-1], submap.exit_pose)])
        self.submaps.append(SubmapNode(submap.key, node, submap.interval, submap.trajectory, fid))
        self._insert(record)
        self._event("submap", factor_id=fid, submap=submap.key, landmarks=n, new=len(fresh), scale=covariance_scale)
        self._tie_fixes(self.submaps[-1])
        return fid

    def start_session(self, T_world_base: ArrayLike) -> int:
        """Begin another chain of submaps whose first base is free: another robot, or another day.

        Nothing but landmarks that both chains see ties it to what is there, so it needs at least two of them.

        Parameters
        ----------
        T_world_base : (3,)
            Where the chain is thought to begin; only a start value.

        Returns
        -------
        int
            Node of the new first base; the next submap begins there.
        """
        T = np.asarray(T_world_base, dtype=np.float64)
        if T.shape != (3,) or not np.all(np.isfinite(T)):
            raise GeometryError("start of a session is not usable", got=T_world_base, wanted="three finite numbers")
        if not self.submaps:
            raise DataError("the first session needs no start", wanted="submaps before another session begins")
        self.values.poses = np.vstack([self.values.poses, T])
        self.revision += 1
        node = len(self.values.poses) - 1
        self._event("session", node=node, T_world_base=T.tolist())
        return node

    def add_between(
        self,
        i: int,
        j: int,
        T_ij: ArrayLike,
        covariance: ArrayLike,
        *,
        streams: Iterable[str] = (),
        interval: tuple[float, float] | None = None,
        evidence: str = EXCLUSIVE,
        robust: Robust = NO_KERNEL,
        group: str = "between",
    ) -> int:
        """A relative pose between nodes i and j; ``covariance`` (3, 3) in the right tangent.

        Parameters
        ----------
        streams, interval
            What it spends; an exclusive measurement must say both.
        evidence : str
            ``"measurement"``, or a kind declared in the ledger (``"shared-scan"``).
        robust : Robust
        group : str
            Class under which :meth:`objective` reports it.
        """
        last = len(self.values.poses) - 1
        if i == j or not (0 <= i <= last and 0 <= j <= last):
            raise DataError("between-factor joins nodes that are not there", got=(i, j), wanted=f"two of x0 … x{last}")
        T = np.asarray(T_ij, dtype=np.float64)
        if T.shape != (3,) or not np.all(np.isfinite(T)):
            raise GeometryError(f"relative pose x{i} → x{j} is not usable", got=T_ij, wanted="three finite numbers")
        names = list(streams)
        if evidence == EXCLUSIVE and (not names or interval is None):
            raise ConfigError(f"between-factor x{i} → x{j} must name the streams and the interval that it spends")
        W = whitener(covariance, what=f"covariance of x{i} → x{j}", dim=3)
        record = BetweenRecord(self._next_factor, i, j, T, W, robust, group)
        self.ledger.spend(record.factor_id, record.label(), names or ["-"], interval or (0.0, 0.0), evidence)
        self._insert(record)
        self._event("between", factor_id=record.factor_id, i=i, j=j, evidence=evidence, group=group)
        return record.factor_id

    def add_match(self, submap_key: int, match: Match, *, robust: Robust = NO_KERNEL) -> int:
        """A front end's re-entry into an earlier submap, as declared ``shared-scan`` evidence."""
        here, target = self.node_of(submap_key), self.node_of(match.target)
        interval = next(s.interval for s in self.submaps if s.key == submap_key)
        return self.add_between(
            target,
            here,
            match.T_target_here,
            match.covariance,
            streams=["match"],
            interval=interval,
            evidence="shared-scan",
            robust=robust,
            group="match",
        )

    def add_gps(self, gps: Gps, *, stream: str = "gps", config: GpsConfig | None = None) -> list[int]:
        """Give the graph position fixes, at any time and in any portion; each finds its own submap.

        Fixes wait until their submap is there, and until :attr:`GpsConfig.baseline` is spanned; then the datum starts
        by rigid alignment and all of them become factors. Fixes that no submap covers are dropped and counted
        (:attr:`events`, kind ``gps-dropped``).

        Returns
        -------
        list of int
            Factor ids, one a fix.

        Raises
        ------
        EvidenceReusedError
            A submap that holds the fix already used ``stream``, or the fix was given before. No fix is taken then.
        """
        if gps.positions.shape[1] != 2:
            raise GeometryError("GPS fixes have the wrong dimension", got=gps.positions.shape, wanted="(n, 2)")
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

    # ---------------------------------------------------------------- GPS

    def _tie_fixes(self, s: SubmapNode, *, closed: bool = False, more: bool = False) -> None:
        """Give a submap its waiting fixes; with ``more`` to follow, do not start the datum yet."""
        dropped = self.gps.tie(s.node, s.interval, s.trajectory, closed=closed)
        late = [f for f in self.gps.waiting if f.time < s.interval[0] and not more and s is self.submaps[-1]]
        self.gps.waiting = [f for f in self.gps.waiting if f not in late]
        self._drop_fixes([*dropped, *((f.factor_id, "no submap covers it") for f in late)])
        if more or not self.gps.tied:
            return
        if self.gps_origin is None:
            self.gps_origin = self.gps.tied[0].fix.position.copy()
        if self.values.datum is None:
            start = self.gps.datum_if_ready(self.values.poses, self.gps_origin, self.gps.tied[0].fix.config.baseline)
            if start is None:
                return
            self.values.datum = start
            self._event("datum", fixes=len(self.gps.tied), T_gps_world=start.tolist())
        for t in sorted(self.gps.tied, key=lambda t: t.fix.time):
            bias = self._bias_of(t.fix)
            W = whitener(t.covariance, what=f"covariance of the GPS fix at {t.fix.time:.3f} s")
            z = t.fix.position - self.gps_origin
            self._insert(GpsRecord(t.fix.factor_id, t.node, t.fix.time, t.arm, z, W, t.fix.config.robust, bias))
        self.gps.tied = []

    def _bias_of(self, fix: Fix) -> int | None:
        cfg, previous = fix.config, self.gps.last_time
        self.gps.last_time = fix.time
        if cfg.bias_sigma is None:
            return None
        if len(self.values.biases) == 0 or fix.time - previous > cfg.segment_gap:
            self.values.biases = np.vstack([self.values.biases, np.zeros(2)])
            s = len(self.values.biases) - 1
            record = BiasPriorRecord(self._next_factor, s, cfg.bias_sigma)
            self.ledger.spend(record.factor_id, record.label(), ["-"], (fix.time, fix.time), "prior")
            self._insert(record)
        return len(self.values.biases) - 1
