"""Public functions that have no module of their own (``compare``, ``join_submaps`` …), and lists of names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphslam.app import compare as comparing
from graphslam.app.machine import one_blas_thread
from graphslam.app.option_table import option_rows
from graphslam.app.run.front_ends import front_end_names, recommended_options
from graphslam.app.run.outputs import read_run_folder as read_run
from graphslam.app.run.remake_map import map_of_folder
from graphslam.app.run.reopened import resolve_from_folder
from graphslam.app.run.run import DeferredPart, Run
from graphslam.app.run.source import load
from graphslam.app.submap_sources import submap_source
from graphslam.app.worlds import GROUP, MESH_WORLDS, WORLDS
from graphslam.core.config import build_config
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.map_truth import MapTruth
from graphslam.core.plugins import plugins
from graphslam.core.submap import Submap
from graphslam.core.tables import data_frame
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.join import registry as joining
from graphslam.refine.config import RefineConfig
from graphslam.refine.refine import refine_by_scans
from graphslam.refine.result import Refinement
from graphslam.refine.scans import Scans
from graphslam.solve import registry
from graphslam.solve.solution import Solution
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.recorded import chain_odometry
from graphslam_frontends.odometry.step_config import StepConfig

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["compare", "front_ends", "join_submaps", "joiners", "open_run", "options", "refine_path"]
__all__ += ["solve_graph", "solvers", "worlds"]


def front_ends() -> list[str]:
    """Names of the installed front ends, for ``frontend=`` of :func:`run`.

    Examples
    --------
    >>> "segslam" in gs.front_ends()
    True
    """
    return front_end_names()


def solvers() -> list[str]:
    """Names of the solvers of a graph, for ``solver=`` of :func:`run`.

    Examples
    --------
    >>> "isam2" in gs.solvers()
    True
    """
    return sorted(registry.SOLVERS)


def joiners() -> list[str]:
    """Names of the methods to join submaps, for :func:`join_submaps` and :func:`compare`.

    Examples
    --------
    >>> "eif-tree" in gs.joiners()
    True
    """
    return sorted({**joining.JOINERS, **joining.SOLVERS})


def worlds() -> list[str]:
    """Names of the simulated worlds, for :func:`simulate`.

    Examples
    --------
    >>> "garage" in gs.worlds()
    True
    """
    return sorted({*WORLDS, *MESH_WORLDS, *plugins(GROUP)})


def options(frontend: str | None = None) -> pd.DataFrame:
    """Options of a front end, or of every run (None): a table of ``option``, ``type``, ``default`` and ``meaning``.

    Set them by ``config={"frontend": {"particles": 40}}`` of :func:`run`, or by ``--set frontend.particles=40``.

    Returns
    -------
    DataFrame

    Raises
    ------
    UnknownNameError
        There is no such front end.

    Examples
    --------
    >>> table = gs.options("rbpf-ekf").set_index("option")
    >>> table.loc["frontend.particles", "default"]
    '40'
    """
    return data_frame([asdict(row) for row in option_rows(frontend)])


def open_run(path: str | Path) -> Run:
    """Read a finished run folder; all files are of the same state.

    Its ``graph`` and ``solution`` are solved again, and its fused map (``fused``) is made again, once, at their first
    use; the log is not read for any of them.

    Parameters
    ----------
    path : path

    Returns
    -------
    Run

    Raises
    ------
    RunFolderError
        Not a finished run.
    FormatError
        A file is damaged, or not of the same state as the others.

    Examples
    --------
    >>> opened = gs.open_run("runs/field")
    >>> opened.metric("submaps")
    7.0
    >>> opened.solution.covariance(3).shape
    (3, 3)
    """
    run = read_run(path)

    @cache
    def solved() -> tuple[Any, Any]:
        return resolve_from_folder(path) if (run.folder / "inputs.npz").is_file() else (None, None)  # type: ignore[operator]

    def fused() -> Any:
        try:
            return map_of_folder(path)[1]
        except MissingDataError:  # a front end without dense maps
            return None

    parts: dict[str, Any] = {"graph": DeferredPart(lambda: solved()[0]), "solution": DeferredPart(lambda: solved()[1])}
    parts["fused"] = DeferredPart(fused)
    return replace(run, **parts)


def refine_path(
    source: SensorLog | str | Path,
    path: Trajectory | None = None,
    *,
    steps: StepConfig | Mapping[str, Any] | None = None,
    config: RefineConfig | None = None,
) -> Refinement:
    """Refine a path with the scans of a log, without a front end: for clouds with poses, or a path from elsewhere.

    Parameters
    ----------
    source : SensorLog, data set name or folder
        With scans or clouds, and motion.
    path : Trajectory, optional
        Initial path of the base; gravity-aligned in 3-D. Default: the odometry of the log.
    steps : StepConfig or mapping, optional
        How the log is divided into steps. Default: as in the preset of the log for ``segslam``, or else
        :class:`~graphslam_frontends.odometry.step_config.StepConfig`.
    config : RefineConfig, optional

    Returns
    -------
    Refinement
        ``times``, ``poses``, ``covariances``, and the agreement of scans before and after (``agreement``).

    Raises
    ------
    MissingDataError, DataError, ConfigError
        No scanner, no motion, or a path that does not cover it.

    Examples
    --------
    >>> court = gs.simulate("court", preset="light", seed=1, progress=False)
    >>> before, after = gs.refine_path(court).agreement
    >>> before < after
    True
    """
    log = source if isinstance(source, SensorLog) else load(source)
    if steps is None:
        steps = recommended_options(log, "segslam").get("frontend", {}).get("steps", {})
    cut = make_steps(log, steps if isinstance(steps, StepConfig) else build_config(StepConfig, dict(steps), "steps"))
    start = chain_odometry(cut.odometry) if path is None else path
    if start.times[0] > cut.times[0] or start.times[-1] < cut.times[-1]:
        raise DataError(
            "the path does not cover the scans",
            where=log.name,
            got=f"{start.times[0]:.3f} to {start.times[-1]:.3f} s",
            wanted=f"{cut.times[0]:.3f} to {cut.times[-1]:.3f} s",
        )
    with one_blas_thread():
        return refine_by_scans(Scans.of(cut), start.interpolate(cut.times), config)


def compare(
    source: Run | FactorGraph | str | Path | Sequence[Submap],
    methods: Sequence[str] | None = None,
    *,
    truth: MapTruth | None = None,
    submap_poses: int | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Solve the same graph by several methods: objective, time, memory, non-zeros, and NEES with ground truth.

    Every row uses all factors of the run or graph (column ``factors``).

    Parameters
    ----------
    source : Run, run folder, FactorGraph, submap store, data set of submaps, pose-graph file, or sequence of Submap
    methods : sequence of str
        By default ``isam2``, ``batch``, ``eif-tree``, ``eif-sequential``, ``ekf``.
    truth : MapTruth, optional
        Used instead of the source's own.
    submap_poses : int, optional
        Cut a pose-graph file into submaps with this number of poses.
    **options
        See :func:`graphslam.app.compare.compare_methods`.

    Returns
    -------
    DataFrame
        One row per method.

    Raises
    ------
    UnknownNameError
        There is no such method, or no such source.
    MissingDataError, FormatError, DataError
        A source without submaps, or a damaged one.

    Examples
    --------
    >>> table = gs.compare(run, ["isam2", "eif-tree"])
    >>> list(table["method"])
    ['isam2', 'eif-tree']
    """
    s = submap_source(source, submap_poses=submap_poses)
    options.setdefault("covariance_scale", s.covariance_scale)
    methods = comparing.default_methods(s.material) if methods is None else methods
    with one_blas_thread():
        return comparing.compare_methods(s.material, methods=methods, truth=truth or s.truth, **options)


def join_submaps(
    source: Run | FactorGraph | str | Path | Sequence[Submap],
    method: str = "eif-tree",
    *,
    polish: bool = True,
    submap_poses: int | None = None,
    **options: Any,
) -> Any:
    """Join submaps into one map by one method.

    Parameters
    ----------
    source : Run, run folder, FactorGraph, submap store, data set of submaps, pose-graph file, or sequence of Submap
    method : str
        One of :func:`joiners`.
    polish : bool
        Refine the joined map to the least-squares optimum; ``objective`` stays that of the joined map.
    submap_poses : int, optional
        Cut a pose-graph file into submaps with this number of poses.
    **options
        See :func:`graphslam.join.registry.join_by_method`.

    Returns
    -------
    SubmapEstimate
        Poses ``(m + 1, 3)``, landmarks ``(n, 2)`` and their joint information, in the frame of the first base; of
        any other graph a :class:`~graphslam.join.graph_join.GraphEstimate`.

    Raises
    ------
    UnknownNameError
        There is no such method.
    SolverError, IndeterminateError
        The submaps are not connected.
    MissingDataError, FormatError, DataError
        A source without submaps, or a damaged one.

    Examples
    --------
    >>> joined = gs.join_submaps(run, "eif-tree")
    >>> joined.poses.shape  # the bases and the last end
    (8, 3)
    """
    s = submap_source(source, submap_poses=submap_poses)
    options.setdefault("covariance_scale", s.covariance_scale)
    with one_blas_thread():
        return joining.join_by_method(s.material, method, polish=polish, **options)


def solve_graph(graph: FactorGraph, solver: str = "lm", **options: Any) -> Solution:
    """Solve a graph to its optimum; its values become those of the solution.

    Parameters
    ----------
    graph : FactorGraph
        Of a run (``run.graph``), :meth:`FactorGraph.from_submaps`, or made factor by factor.
    solver : str
        One of :func:`solvers`.
    **options
        Of the class of the solver in :mod:`graphslam.solve`.

    Returns
    -------
    Solution
        Values, covariances, and whether they are the optimum.

    Raises
    ------
    UnknownNameError
        There is no such solver.
    IndeterminateError
        Some variables are not constrained; the message names them.
    SolverError
        A factor is not finite.

    Examples
    --------
    >>> graph = gs.FactorGraph.from_submaps(gs.local_maps(log)[:3])
    >>> solution = gs.solve_graph(graph)
    >>> solution.converged, solution.covariance(1, 2).shape
    (True, (3, 3))
    """
    if not isinstance(graph, FactorGraph):
        raise DataError("no factor graph", got=type(graph).__name__, wanted="FactorGraph; gs.solve_file solves a file")
    made = registry.make_solver(solver, graph, **options)
    with one_blas_thread():
        made.solve_to_optimum()
        return made.solution()
