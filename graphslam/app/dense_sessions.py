"""Sessions of dense submaps in one graph: a saved run put back into a graph, and a session tied to what is there."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from graphslam.app import config as cfg
from graphslam.app.config import BackEndConfig, GpsConfig
from graphslam.app.run import Run
from graphslam.core.errors import DataError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.formats import load_npz
from graphslam.graph.gps import GpsConfig as GpsFactorConfig
from graphslam.graph.graph_relative import GraphRelative
from graphslam.graph.loop_candidates import CandidateConfig, proximity_candidates
from graphslam.graph.loop_measure import Loop
from graphslam.graph.loop_places import Ints
from graphslam.graph.noise import NO_KERNEL, Robust
from graphslam.graph.pose_graph import PoseGraph
from graphslam.graph.records import BetweenRecord
from graphslam.graph.session_ties import SessionMap, TieConfig, Ties, TwoSessions, start_of
from graphslam.io.g2o import read_g2o
from graphslam.io.submap_store import read_submaps
from graphslam.solve.registry import Solver

logger = logging.getLogger(__name__)
SPACING = 3.0
"""Of the nodes of a run that has none inside its submaps [m]: places to be tied are needed."""
SESSION = "session"
"""Class of the factors between sessions."""


@dataclass(frozen=True)
class InnerTie:
    """A factor between two nodes of one run that are no neighbours: a re-entry or a loop."""

    i: int
    j: int
    T_ij: Array
    covariance: Array
    robust: Robust


@dataclass(frozen=True)
class DenseSession:
    """A run of dense submaps, ready to be put into a graph.

    Parameters
    ----------
    name : str
    submaps : list of Submap
        Keys and clock of the common graph.
    config : BackEndConfig
    map : SessionMap
    inner : list of InnerTie
        Nodes counted from the session's first base.
    shift : float
        Seconds that were added to its clock.
    fixes : Gps or None
        On the common clock.
    gps : GpsConfig
    T_gps_base : (7,) or (3,) or None
        First base in the GPS frame by the run's own graph.
    """

    name: str
    submaps: list[Submap]
    config: BackEndConfig
    map: SessionMap
    inner: list[InnerTie]
    shift: float = 0.0
    fixes: Gps | None = None
    gps: GpsConfig = field(default_factory=GpsConfig)
    T_gps_base: Array | None = None

    @property
    def chain(self) -> Array:
        """Its nodes by its own exits and paths alone, in the frame of its first base ``(m + 1, 7|3)``."""
        T = self.map.increments
        g = group_of(T)
        out = [g.identity]
        for step in T:
            out.append(g.compose(out[-1], step))
        return np.stack(out)


@dataclass(frozen=True)
class Attached:
    """A session that was tied to another one in a graph.

    Parameters
    ----------
    first_node : int
    known : DenseSession
        What it was tied to.
    ties : Ties or None
        By appearance; None where GPS said where the session lies.
    used : list of Loop
        Ties in the graph at the end, those by proximity included; nodes of the graph.
    dropped : int
        Ties that the solved graph contradicted.
    """

    first_node: int
    known: DenseSession
    ties: Ties | None
    used: list[Loop]
    dropped: int


def is_dense(run: Run) -> bool:
    """Whether the submaps of a run are without landmarks."""
    return bool(run.submaps) and all(s.landmarks is None for s in run.submaps)


def with_grids(run: Run) -> list[Submap]:
    """The submaps of a run with their grids, read from its folder where they are not there.

    Raises
    ------
    DataError
        A submap whose grid is nowhere.
    """
    submaps = list(run.submaps)
    if run.folder is not None and any(s.grid is None for s in submaps):
        submaps = read_submaps(run.folder, load_grid=load_npz)
    without = [s.key for s in submaps if s.grid is None]
    if without:
        raise DataError(f"submaps {without} have no grid", where=run.name, wanted="evidence grids beside the submaps")
    return submaps


def back_end_config(run: Run) -> BackEndConfig:
    """The back end's options of a run, as it says them itself."""
    made: BackEndConfig = _options(run, "backend", BackEndConfig)
    return made if made.node_spacing > 0 else replace(made, node_spacing=SPACING)


def _options(run: Run, part: str, kind: Any) -> Any:
    """One part of the effective configuration of a run, from its report or its folder."""
    file = None if run.folder is None else Path(run.folder) / "config.toml"
    values = run.report.get(part)
    if values is None and file is not None and file.is_file():
        values = cfg.read_toml(file).get(part)
    if values is None:
        raise DataError(f"a run does not say its {part} options", where=run.name, wanted="a finished run")
    return cfg.build(kind, {k: v for k, v in values.items() if v is not None}, part)


def session_of(run: Run, name: str, *, first_key: int = 0, after: float = -np.inf) -> DenseSession:
    """A run as a session of a common graph: its keys follow ``first_key``, its clock goes on ``after`` [s].

    Raises
    ------
    DataError
        Submaps that cannot be placed, or a run that does not say how its submaps hang together.
    """
    config = back_end_config(run)
    begin = run.submaps[0].interval[0]
    shift = 0.0 if begin > after else float(np.ceil(after - begin) + 1000.0)
    keys = {s.key: first_key + k for k, s in enumerate(run.submaps)}
    submaps = [_in_common(s, keys, name, shift) for s in with_grids(run)]
    fixes = None if run.fixes is None else replace(run.fixes, times=run.fixes.times + shift)
    return DenseSession(
        name, submaps, config, SessionMap(submaps, config.node_spacing), _inner(run, config), shift, fixes,
        _options(run, "gps", GpsConfig), run.map.T_gps_world,
    )  # fmt: skip


def _in_common(s: Submap, keys: dict[int, int], name: str, shift: float) -> Submap:
    """A submap with key, clock and streams of the common graph; its matches come from the run's graph."""
    path = s.trajectory
    moved = None if path is None else Trajectory(path.times + shift, path.poses, path.covariances)
    a, b = s.interval
    return replace(
        s, key=keys[s.key], interval=(a + shift, b + shift), trajectory=moved, matches=(),
        uses=frozenset(f"{name}/{u}" for u in s.uses),
    )  # fmt: skip


def _inner(run: Run, config: BackEndConfig) -> list[InnerTie]:
    """Factors of a run's graph beside the chain: of the graph itself, or of its file."""
    if _options(run, "backend", BackEndConfig).node_spacing != config.node_spacing:
        raise DataError(
            "a run whose submaps have no inner nodes cannot be tied", where=run.name, wanted="backend.node_spacing > 0"
        )
    if run.graph is not None:
        rows = [r for r in run.graph.records.values() if isinstance(r, BetweenRecord) and r.group != "dense-submap"]
        return [InnerTie(r.i, r.j, r.T_ij, _inverse(r.whitener.T @ r.whitener), r.robust) for r in rows]
    file = None if run.folder is None else Path(run.folder) / "graph.g2o"
    if file is None or not file.is_file():
        raise DataError("a run does not say how its submaps hang together", where=run.name, wanted="its graph.g2o")
    net = read_g2o(file)
    kernel = NO_KERNEL if config.match_robust == "none" else Robust(config.match_robust, config.match_width)
    out, chained = [], set()
    for (i, j), T, info in zip(net.edges.tolist(), net.measurements, net.information):
        if j == i + 1 and i not in chained:  # the chain itself is made again from the submaps
            chained.add(i)
            continue
        out.append(InnerTie(i, j, T, _inverse(info), kernel))
    return out


def _inverse(information: Array) -> Array:
    P = np.linalg.inv(information)
    return 0.5 * (P + P.T)


def put(graph: PoseGraph, session: DenseSession, start: Array | None = None, *, use_gps: bool = True) -> int:
    """Add the chain of a session and its own ties to a graph; where it hangs is another matter.

    Parameters
    ----------
    graph : PoseGraph
    session : DenseSession
    start : (7,) or (3,), optional
        Where it is thought to begin; None for the first session, which begins at the origin.
    use_gps : bool
        With its fixes, if it has any.

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
            node + t.i, node + t.j, t.T_ij, t.covariance, streams=[f"{session.name}/scan"], evidence="shared-scan",
            robust=t.robust, group="match",
        )  # fmt: skip
    if use_gps and session.fixes is not None:
        o = session.gps
        kernel = NO_KERNEL if o.robust == "none" else Robust(o.robust, o.robust_width)
        gps = GpsFactorConfig(robust=kernel, sigma=o.sigma, bias_sigma=o.bias_sigma, segment_gap=o.segment_gap)
        graph.add_gps(session.fixes, config=gps)
        graph.finish_gps()
    return node


def attach(
    graph: PoseGraph,
    solver: Solver,
    known: DenseSession,
    known_node: int,
    new: DenseSession,
    *,
    config: TieConfig | None = None,
    found: tuple[TwoSessions, Ties] | None = None,
    use_gps: bool = True,
    progress: bool = False,
) -> Attached:
    """Tie a session to one that is in the graph, and solve.

    First by places that look alike and agree; then, when it is known where it lies, by places that are near each other,
    each of which the graph has to expect.

    Parameters
    ----------
    graph : PoseGraph
    solver : Solver
        Of the graph, which is at its optimum.
    known : DenseSession
        One that is in the graph.
    known_node : int
        Node of its first base.
    new : DenseSession
    config : TieConfig, optional
    found : (TwoSessions, Ties), optional
        What was found already.
    use_gps : bool
        With the new session's fixes, if it has any.
    progress : bool

    Raises
    ------
    DataError
        The two do not overlap as far as can be seen. The graph is as it was.
    SolverError
        The graph contradicts what ties them; it holds the session all the same, and is of no use any more.
    """
    c = TieConfig() if config is None else config
    if found is None:
        two = TwoSessions(known.map, new.map)
        found = two, two.find(c, progress=progress)
    two, ties = found
    if ties.why:
        raise DataError(f"no tie to {known.name}: {ties.why}", where=new.name)
    start = start_of(ties.chosen, graph.values.poses[known_node:], new.chain)
    node = put(graph, new, start, use_gps=use_gps)
    apart = two.thinned(ties.chosen, CandidateConfig().stretch)
    here = [replace(x, i=known_node + x.i, j=node + x.j) for x in apart]
    factors = {_add(graph, x, known, new): x for x in here}
    solver.solve_to_optimum()
    dropped = _winnow(graph, solver, factors)
    if 2 * len(factors) < len(here):
        raise SolverError(
            f"{new.name}: of {len(here)} ties to {known.name} that agree with each other the graph bears "
            f"{len(factors)}, wanted half of them"
        )
    for x in _near(graph, two, known_node, node, here, progress):
        factors[_add(graph, x, known, new)] = x
    solver.solve_to_optimum()
    dropped += _winnow(graph, solver, factors)
    logger.info("%s hangs on %s by %d ties", new.name, known.name, len(factors))
    return Attached(node, known, ties, list(factors.values()), dropped)


def attach_by_gps(
    graph: PoseGraph,
    solver: Solver,
    known: DenseSession,
    known_node: int,
    new: DenseSession,
    *,
    places: bool = True,
    progress: bool = False,
) -> Attached:
    """Tie a session to one that is in the graph by the fixes that both have, and solve.

    Parameters
    ----------
    places : bool
        Then also by places that are near each other.

    Raises
    ------
    DataError
        One of them has no GPS in its graph.
    """
    ends = []
    for s in (known, new):
        if s.fixes is None or s.T_gps_base is None:
            raise DataError("no GPS in the graph of this run", where=s.name, wanted="gps.use other than none")
        ends.append(s.T_gps_base)
    g = group_of(known.map.increments)
    T_known_new = g.between(ends[0], ends[1])
    node = put(graph, new, g.compose(graph.values.poses[known_node], T_known_new))
    solver.solve_to_optimum()
    factors: dict[int, Loop] = {}
    dropped = 0
    if places:
        two = TwoSessions(known.map, new.map)
        factors = {_add(graph, x, known, new): x for x in _near(graph, two, known_node, node, [], progress)}
        solver.solve_to_optimum()
        dropped = _winnow(graph, solver, factors)
    logger.info("%s hangs on %s by GPS and %d ties", new.name, known.name, len(factors))
    return Attached(node, known, None, list(factors.values()), dropped)


def _add(graph: PoseGraph, x: Loop, known: DenseSession, new: DenseSession) -> int:
    return graph.add_between(
        x.i, x.j, x.T_ij, x.covariance, streams=[f"{known.name}/scan", f"{new.name}/scan"], evidence="shared-scan",
        robust=Robust("huber", float(np.sqrt(stats.chi2.ppf(0.95, graph.values.group.dof)))), group=SESSION,
    )  # fmt: skip


def _winnow(graph: PoseGraph, solver: Solver, factors: dict[int, Loop]) -> int:
    """Take out, worst first, ties that the solved graph contradicts; how many."""
    g = graph.values.group
    limit, taken = float(stats.chi2.ppf(0.9999, g.dof)), 0
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
        taken += 1
        solver.solve_to_optimum()
    return taken


def _near(
    graph: PoseGraph, two: TwoSessions, known_node: int, node: int, tied: Sequence[Loop], progress: bool
) -> list[Loop]:
    """More ties, where places of the two sessions are near each other by now; nodes of the graph."""
    shift = np.where(np.arange(len(two.places)) < len(two.known.places), known_node, node - two.offset)
    places = replace(two.places, node=(two.places.node + shift).astype(np.int64))
    row: dict[int, int] = {int(n): k for k, n in enumerate(places.node)}
    before = [(row[x.i], row[x.j]) for x in tied if x.i in row and x.j in row]
    config = CandidateConfig(least_gain=0.0, keep=40)
    found = proximity_candidates(places, GraphRelative(graph), config, exclude=two.within, tried=before)
    measured = [x for x in two.measurer.measure(found, progress=progress) if not x.why]
    nodes: Ints = places.node
    return [replace(x, i=int(nodes[x.i]), j=int(nodes[x.j])) for x in measured]
