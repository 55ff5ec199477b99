"""A run of dense submaps as a session of a larger graph: its chain, ties and fixes, put back from what it saved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import consistent
from graphslam.app.run.files import read_options, read_report
from graphslam.app.run.run import Run
from graphslam.backend.config import BackEndConfig, GpsOptions
from graphslam.core.config import build
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.formats import load_npz
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.noise import NO_KERNEL, Robust
from graphslam.graph.pose_graph import PoseGraph
from graphslam.io.g2o import read_g2o
from graphslam.io.submap_store import read_submaps
from graphslam.loops.session_ties import SessionMap

SPACING = 3.0
"""Of the nodes of a run that has none inside its submaps [m]: places to be tied are needed."""


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
    gps : GpsOptions
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
    gps: GpsOptions = field(default_factory=GpsOptions)
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
        values = read_options(file.parent).get(part)
    if values is None:
        raise DataError(f"a run does not say its {part} options", where=run.name, wanted="a finished run")
    return build(kind, {k: v for k, v in values.items() if v is not None}, part)


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
        _options(run, "gps", GpsOptions), run.map.T_gps_world,
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
    net = None if run.folder is None else consistent(run.folder, lambda root: _graph_of(run, root))
    if net is None:
        raise DataError("a run does not say how its submaps hang together", where=run.name, wanted="its graph.g2o")
    kernel = NO_KERNEL if config.match_robust == "none" else Robust(config.match_robust, config.match_width)
    out, chained = [], set()
    for (i, j), T, info in zip(net.edges.tolist(), net.measurements, net.information):
        if j == i + 1 and i not in chained:  # the chain itself is made again from the submaps
            chained.add(i)
            continue
        out.append(InnerTie(i, j, T, _inverse(info), kernel))
    return out


def _graph_of(run: Run, root: Path) -> PoseNetwork | None:
    """The graph of the state that a run was read in."""
    if not (root / "graph.g2o").is_file():
        return None
    now, then = read_report(root).get("generation"), run.report.get("generation")
    if now != then:
        raise DataError("the run was changed since it was read", where=str(run.folder), got=now, wanted=then)
    return read_g2o(root / "graph.g2o")


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
        graph.add_gps(session.fixes, config=session.gps)
        graph.finish_gps()
    return node
