"""Localise submaps, or a part of a log, in a saved map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import current_outputs
from graphslam.app.machine import one_blas_thread
from graphslam.app.run.files import read_options
from graphslam.app.run.front_ends import make_front_end
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.run import Run
from graphslam.app.run.source import load
from graphslam.app.sessions.dense import back_end_config, run_is_dense, session_of, submaps_with_maps
from graphslam.backend.sessions import DenseSession, add_session, connect_session
from graphslam.core.errors import DataError, MissingDataError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.inter_session_loops import InterSessionConfig, InterSessionLoops, SessionMap, TwoSessions
from graphslam.loops.measure import Loop
from graphslam.solve.registry import make_solver


@dataclass(frozen=True, slots=True)
class LocalisationResult:
    """Pose in a saved map, or the reason why none was found.

    Parameters
    ----------
    why : str
        Reason why no pose was found; empty if one was found.
    candidates : InterSessionLoops
        All tested candidates with their results.
    used : list of Loop
        Loop closures that determine the pose.
    T_map_base, covariance : (7,) or (3,), (d, d); or None
        Pose of the first base of the source in the frame of the map's first base, and its covariance (right tangent),
        which includes the uncertainty of the map there.
    T_map_end, end_covariance : same
        Pose of the body at the end of the source.
    """

    why: str
    candidates: InterSessionLoops
    used: list[Loop]
    T_map_base: Array | None = None
    covariance: Array | None = None
    T_map_end: Array | None = None
    end_covariance: Array | None = None

    @property
    def found(self) -> bool:
        """Was a pose found?"""
        return not self.why

    def rows(self) -> list[dict[str, Any]]:
        """One row per candidate, with the reason for its acceptance or rejection."""
        return self.candidates.rows()

    def __repr__(self) -> str:
        if self.T_map_base is None or self.covariance is None:
            return f"Localisation(not found: {self.why})"
        sigma = np.sqrt(np.diag(self.covariance))
        at = self.T_map_base[: 2 if len(self.T_map_base) == 3 else 3]
        return f"Localisation(base at {np.round(at, 2)}, σ {np.round(sigma, 3)}, {len(self.used)} ties)"


def localise(
    run: Run | str | Path,
    source: Submap | Sequence[Submap] | SensorLog,
    *,
    config: InterSessionConfig | None = None,
    solver: str = "batch",
    progress: bool = False,
) -> LocalisationResult:
    """Find a submap, a chain of them, or a stretch of a log in the map of a finished run.

    No initial pose is needed. Similar places of source and map are registered. The result is accepted if enough of them
    are consistent with each other; then the pose is solved for in the graph of the run.

    Parameters
    ----------
    run : Run or run folder
        Of dense submaps.
    source : Submap, sequence of Submap, or SensorLog
        A log is processed by the front end of the run, with its options; slice the log to the part to localise.
    config : InterSessionConfig, optional
    solver : str
    progress : bool
        Show progress bars on stderr.

    Returns
    -------
    LocalisationResult
        ``T_map_base`` ``(3,)`` or ``(7,)`` in the frame of the run's map, its covariance (right tangent), and ``why``
        if no pose was found.

    Raises
    ------
    DataError
        Unusable run or submaps. If no pose is found, no error is raised.

    Examples
    --------
    >>> court = gs.simulate("court", preset="light", seed=1, progress=False)
    >>> hall = gs.run(court, frontend="scan-window", out="runs/hall", progress=False)
    >>> found = gs.localise("runs/hall", court.slice(10.0, 30.0))
    >>> found.T_map_base is None or found.T_map_base.shape == (7,)  # found.why says what was missing
    True
    """
    opened = run if isinstance(run, Run) else read_run_folder(run)
    if not run_is_dense(opened):
        raise DataError("only maps of dense submaps are localised in", where=opened.name, wanted="dense submaps")
    with one_blas_thread():
        if isinstance(source, SensorLog):
            submaps = submaps_of_stretch(opened, source)
        else:
            submaps = [source] if isinstance(source, Submap) else list(source)
        return _localise(opened, submaps, config or InterSessionConfig(), solver, progress)


def source_of(
    source: str | Path,
    keys: Sequence[int] = (),
    begin: float | None = None,
    end: float | None = None,
    *,
    reader: str | None = None,
    reader_options: Mapping[str, Any] | None = None,
) -> Sequence[Submap] | SensorLog:
    """Source of a localisation: submaps of a run folder, or a part of a log.

    Parameters
    ----------
    source : path or data set name
    keys : sequence of int
        Of a run folder, only these consecutive submaps.
    begin, end : float, optional
        Of a log [s].
    """
    path = Path(source)
    if (current_outputs(path) / "run.json").is_file():
        run = read_run_folder(path)
        known = [s.key for s in run.submaps]
        rows = [known.index(k) for k in keys if k in known]
        if len(rows) != len(keys) or any(b != a + 1 for a, b in pairwise(rows)):
            raise DataError(
                "submaps do not follow one another in this run", where=str(path), got=list(keys), wanted=known
            )
        submaps = submaps_with_maps(run)
        return submaps if not rows else [submaps[k] for k in rows]
    log = load(source, reader=reader, **(reader_options or {}))
    a, b = log.interval
    part = log.slice(a if begin is None else begin, b if end is None else end)
    if not any(len(s.times) for s in part.streams.values()):
        raise DataError("no records in this stretch", where=log.name, got=(begin, end), wanted=log.interval)
    return part


def submaps_of_stretch(run: Run, log: SensorLog) -> list[Submap]:
    """Submaps of a log made by the front end of a run with the options of the run."""
    folder = None if run.folder is None else Path(run.folder) / "config.toml"
    if folder is None or not folder.is_file():
        raise DataError("a run without a folder does not say its front end's options", where=run.name)
    options = read_options(folder.parent)
    name = options.get("run", {}).get("frontend", run.report["frontend"])
    front: Any = make_front_end(name, options.get("frontend", {}))
    seed = SeedTree(int(run.report["seed"])).child("localise")
    submaps = list(front.submaps(log, seed=seed, after=None, drops=DropCounter()))
    if not submaps:
        raise MissingDataError("the log gave no submap", where=log.name)
    return submaps


def _localise(
    run: Run, submaps: list[Submap], config: InterSessionConfig, solver_name: str, progress: bool
) -> LocalisationResult:
    known = session_of(run, "map")
    new = _query(run, known, submaps)
    two = TwoSessions(known.map, new.map)
    loops = two.find(config, progress=progress)
    if loops.why:
        return LocalisationResult(loops.why, loops, [])
    graph = FactorGraph(known.submaps[0].dim)
    solver = make_solver(solver_name, graph)
    add_session(graph, known)
    solver.solve_to_optimum()
    try:
        at = connect_session(graph, solver, known, 0, new, config=config, found=(two, loops), progress=progress)
    except SolverError as error:
        return LocalisationResult(str(error), loops, [])
    end = graph.submaps[-1].exit_node
    P = graph.covariance()
    poses = graph.values.poses
    return LocalisationResult(
        "", loops, at.used, poses[at.first_node].copy(), P.marginal(f"x{at.first_node}"),
        poses[end].copy(), P.marginal(f"x{end}"),
    )  # fmt: skip


def _query(run: Run, known: DenseSession, submaps: list[Submap]) -> DenseSession:
    """The source as a session of the run's graph: keys and times follow those of the map."""
    config = back_end_config(run)
    last = known.submaps[-1]
    shift = max(0.0, last.interval[1] + 1000.0 - submaps[0].interval[0]) if submaps else 0.0
    out = []
    for k, s in enumerate(submaps):
        a, b = s.interval
        path = s.trajectory
        moved = None if path is None else replace(path, times=path.times + shift)
        here = s.of_session("here")
        out.append(replace(here, key=last.key + 1 + k, interval=(a + shift, b + shift), trajectory=moved, matches=()))
    return DenseSession("here", out, config, SessionMap(out, config.node_spacing), [], shift)
