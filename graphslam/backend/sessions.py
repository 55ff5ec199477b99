"""Attach a session of dense submaps to one in the graph: by places that look alike and agree, or by GPS."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graphslam.backend.config import BackEndConfig, GpsOptions
from graphslam.core.errors import CovarianceError, DataError, SolverError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.noise import RobustKernel
from graphslam.loops.candidates import CandidateConfig, proximity_candidates
from graphslam.loops.graph_loops import GraphRelativePoses
from graphslam.loops.inter_session_loops import (
    InterSessionConfig,
    InterSessionLoops,
    SessionMap,
    TwoSessions,
    session_start,
)
from graphslam.loops.measure import Loop
from graphslam.loops.places import Ints
from graphslam.solve.registry import Solver


@dataclass(frozen=True)
class IntraSessionLoop:
    """A factor between two non-adjacent nodes of one run: a re-entry or a loop."""

    i: int
    j: int
    T_ij: Array
    covariance: Array
    robust: RobustKernel


@dataclass(frozen=True)
class DenseSession:
    """A run of dense submaps, prepared for a graph.

    Parameters
    ----------
    submaps : list of Submap
        With keys and times of the common graph.
    inner : list of IntraSessionLoop
        Nodes are numbered from the session's first base.
    shift : float
        Time offset that was added [s].
    fixes : Gps or None
        With the times of the common graph.
    T_gps_base : (7,) or (3,) or None
        First base in the GPS frame, from the run's own graph.
    refined : bool
        Its submaps are along a path refined with scans, which used every scan: it has no loop closures of its own.
    """

    name: str
    submaps: list[Submap]
    config: BackEndConfig
    map: SessionMap
    inner: list[IntraSessionLoop]
    shift: float = 0.0
    fixes: Gps | None = None
    gps: GpsOptions = field(default_factory=GpsOptions)
    T_gps_base: Array | None = None
    refined: bool = False

    @property
    def chain(self) -> Array:
        """Poses from its end poses and paths alone, in the frame of its first base ``(m + 1, 7|3)``."""
        T = self.map.increments
        g = group_of(T)
        out = [g.identity]
        for step in T:
            out.append(g.compose(out[-1], step))
        return np.stack(out)


def loops_of_graph(graph: FactorGraph) -> list[IntraSessionLoop]:
    """Factors of the graph of a run that are not in its chain."""
    rows = [r for r in graph.records.values() if isinstance(r, BetweenRecord) and r.group != "dense-submap"]
    return [IntraSessionLoop(r.i, r.j, r.T_ij, _inverse(r.whitener.T @ r.whitener), r.robust) for r in rows]


def loops_of_network(net: PoseNetwork, kernel: RobustKernel) -> list[IntraSessionLoop]:
    """The same from the file of a graph, which has no robust kernels."""
    out, chained = [], set()
    for (i, j), T, info in zip(net.edges.tolist(), net.measurements, net.information):
        if j == i + 1 and i not in chained:  # the chain is built from the submaps
            chained.add(i)
            continue
        out.append(IntraSessionLoop(i, j, T, _inverse(info), kernel))
    return out


def _inverse(information: Array) -> Array:
    try:
        P = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        raise CovarianceError(
            "a loop closure does not constrain one direction", wanted="information of full rank"
        ) from None
    return 0.5 * (P + P.T)


def add_session(graph: FactorGraph, session: DenseSession, start: Array | None = None) -> int:
    """Add the chain of a session, its own loop closures and its fixes to a graph, without attaching it.

    Parameters
    ----------
    start : (7,) or (3,), optional
        Initial pose of its first base; None for the first session, which starts at the origin.

    Returns
    -------
    int
        Node of its first base.
    """
    c = session.config
    node = 0 if start is None else graph.start_session(start)
    for s in session.submaps:
        graph.add_submap(
            s,
            covariance_scale=c.covariance_scale,
            spacing=c.node_spacing,
            level_sigma=c.level_sigma if s.dim == 3 and c.level_sigma > 0 else None,
        )
    for t in session.inner:
        graph.add_between(
            node + t.i, node + t.j, t.T_ij, t.covariance, robust=t.robust, group="match",
            evidence=EvidenceUse([f"{session.name}/scan"], (0.0, 0.0), "shared-scan"),
        )  # fmt: skip
    if session.fixes is not None:
        graph.add_sensor(session.fixes, config=session.gps)
        graph.finish_sensors()
    return node


logger = logging.getLogger(__name__)
SESSION = "session"
"""Class of the factors between sessions."""


@dataclass(frozen=True)
class ConnectedSession:
    """A session that was attached to another one in a graph.

    Parameters
    ----------
    known : DenseSession
        The session that it is attached to.
    candidates : InterSessionLoops or None
        Candidates by appearance; None if GPS gave the alignment.
    used : list of Loop
        Loop closures in the final graph, with those by proximity; nodes of the graph.
    dropped : int
        Loop closures that the solved graph contradicted.
    """

    first_node: int
    known: DenseSession
    candidates: InterSessionLoops | None
    used: list[Loop]
    dropped: int


def connect_session(
    graph: FactorGraph,
    solver: Solver,
    known: DenseSession,
    known_node: int,
    new: DenseSession,
    *,
    found: tuple[TwoSessions, InterSessionLoops] | None = None,
    config: InterSessionConfig | None = None,
    progress: bool = False,
) -> ConnectedSession:
    """Attach a session to one in the graph, and solve; with its fixes, if it has any.

    First by places that look alike and agree. Then, with this alignment, by places that are near each other in
    the graph.

    Parameters
    ----------
    solver : Solver
        Of the graph, which is at its optimum.
    known : DenseSession
        One that is in the graph.
    known_node : int
        Node of its first base.
    found : (TwoSessions, InterSessionLoops), optional
        Result of an earlier search.
    """
    c = InterSessionConfig() if config is None else config
    if found is None:
        two = TwoSessions(known.map, new.map)
        found = two, two.find(c, progress=progress)
    two, loops = found
    if loops.why:
        raise DataError(f"no link to {known.name}: {loops.why}", where=new.name)
    start = session_start(loops.chosen, graph.values.poses[known_node:], new.chain)
    node = add_session(graph, new, start)
    apart = two.thinned(loops.chosen, CandidateConfig().stretch)
    here = [replace(x, i=known_node + x.i, j=node + x.j) for x in apart]
    factors = {_add(graph, x, known, new): x for x in here}
    solver.solve_to_optimum()
    dropped = _winnow(graph, solver, factors)
    if 2 * len(factors) < len(here):
        raise SolverError(
            f"{new.name}: of {len(here)} loop closures with {known.name} that agree with each other the graph accepts "
            f"{len(factors)}, wanted half of them"
        )
    near, tried = _near(graph, two, known_node, node, here, progress)
    if tried >= c.heard and len(near) < c.borne * tried:
        raise SolverError(
            f"{new.name}: {len(here)} loop closures with {known.name} agree with each other, but of {tried} more "
            f"places that they bring together {len(near)} match, wanted {c.borne:.0%}: another place looks alike"
        )
    for x in near:
        factors[_add(graph, x, known, new)] = x
    solver.solve_to_optimum()
    dropped += _winnow(graph, solver, factors)
    logger.info("%s is attached to %s by %d loop closures", new.name, known.name, len(factors))
    return ConnectedSession(node, known, loops, list(factors.values()), dropped)


def connect_by_gps(
    graph: FactorGraph,
    solver: Solver,
    known: DenseSession,
    known_node: int,
    new: DenseSession,
    *,
    places: bool = True,
) -> ConnectedSession:
    """Attach a session to one in the graph by the fixes of both, and solve.

    Parameters
    ----------
    places : bool
        Then also by places that are near each other.
    """
    ends = []
    for s in (known, new):
        if s.fixes is None or s.T_gps_base is None:
            raise DataError("no GPS in the graph of this run", where=s.name, wanted="gps.use other than none")
        ends.append(s.T_gps_base)
    g = group_of(known.map.increments)
    T_known_new = g.between(ends[0], ends[1])
    node = add_session(graph, new, g.compose(graph.values.poses[known_node], T_known_new))
    solver.solve_to_optimum()
    factors: dict[int, Loop] = {}
    dropped = 0
    if places:
        two = TwoSessions(known.map, new.map)
        factors = {_add(graph, x, known, new): x for x in _near(graph, two, known_node, node, [], False)[0]}
        solver.solve_to_optimum()
        dropped = _winnow(graph, solver, factors)
    logger.info("%s is attached to %s by GPS and %d loop closures", new.name, known.name, len(factors))
    return ConnectedSession(node, known, None, list(factors.values()), dropped)


def _add(graph: FactorGraph, x: Loop, known: DenseSession, new: DenseSession) -> int:
    return graph.add_between(
        x.i, x.j, x.T_ij, x.covariance,
        evidence=EvidenceUse([f"{known.name}/scan", f"{new.name}/scan"], (0.0, 0.0), "shared-scan"),
        robust=RobustKernel("huber", float(np.sqrt(chi2_quantile(0.95, graph.values.group.dof)))), group=SESSION,
    )  # fmt: skip


def _winnow(graph: FactorGraph, solver: Solver, factors: dict[int, Loop]) -> int:
    """Remove loop closures that contradict the solved graph, worst first; returns their number."""
    g = graph.values.group
    limit, removed = chi2_quantile(0.9999, g.dof), 0
    while factors:
        chi2 = {}
        for fid in factors:
            r = graph.records[fid]
            assert isinstance(r, BetweenRecord)
            e = g.log(g.between(r.T_ij, g.between(graph.values.poses[r.i], graph.values.poses[r.j])))
            chi2[fid] = float(np.sum((r.whitener @ e) ** 2))
        worst = max(chi2, key=lambda k: chi2[k])
        if chi2[worst] <= limit:
            break
        graph.remove(worst, reason=f"contradicted by the graph: χ² {chi2[worst]:.1f} > {limit:.1f}")
        del factors[worst]
        removed += 1
        solver.solve_to_optimum()
    return removed


def _near(
    graph: FactorGraph, two: TwoSessions, known_node: int, node: int, known: Sequence[Loop], progress: bool
) -> tuple[list[Loop], int]:
    """Loop closures between places of the two sessions that are near each other now, and the number of candidates.

    Nodes are those of the graph.
    """
    shift = np.where(np.arange(len(two.places)) < len(two.known.places), known_node, node - two.offset)
    places = replace(two.places, node=(two.places.node + shift).astype(np.int64))
    row: dict[int, int] = {int(n): k for k, n in enumerate(places.node)}
    before = [(row[x.i], row[x.j]) for x in known if x.i in row and x.j in row]
    config = CandidateConfig(least_gain=0.0, keep=40)
    found = proximity_candidates(places, GraphRelativePoses(graph), config, exclude=two.within, tried=before)
    measured = [x for x in two.measurer.measure(found, progress=progress) if not x.why]
    nodes: Ints = places.node
    return [replace(x, i=int(nodes[x.i]), j=int(nodes[x.j])) for x in measured], len(found)
