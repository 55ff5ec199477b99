"""The ties of a run of dense submaps, put back from what its folder holds: what its joiners are given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from graphslam.app.run.files import read_events, read_options
from graphslam.app.run.run import Run
from graphslam.backend.config import BackEndConfig
from graphslam.backend.sessions import IntraSessionLoop, loops_of_network
from graphslam.core.config import build_config
from graphslam.core.errors import DataError
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.io.g2o import read_g2o
from graphslam.join.pose_problem import PoseProblem
from graphslam.loops.graph_loops import GROUP
from graphslam.loops.rules import LoopConfig


def pose_problem_of_run(run: Run) -> PoseProblem:
    """The submaps and ties of a run that has its graph in memory."""
    assert run.graph is not None
    return PoseProblem.of_graph(run.graph)


def load_pose_problem(root: Path, files: Path, submaps: list[Submap]) -> PoseProblem:
    """The same of a run folder: chains from its submaps, ties from ``graph.g2o``, kernels from its options.

    Parameters
    ----------
    root : Path
        Of the run.
    files : Path
        Where its outputs lie.
    """
    stated: dict[str, Any] = read_options(root).get("backend", {})
    config: BackEndConfig = build_config(BackEndConfig, {k: v for k, v in stated.items() if v is not None}, "backend")
    network = read_g2o(files / "graph.g2o")
    graph = FactorGraph(submaps[0].dim)
    for s in submaps:
        graph.add_submap(
            s,
            covariance_scale=config.covariance_scale,
            spacing=config.node_spacing if config.node_spacing > 0 else None,
            level_sigma=config.level_sigma if s.dim == 3 and config.level_sigma > 0 else None,
        )
    if len(network) != graph.structure.count("x") or network.dim != graph.dim:
        raise DataError(
            "the graph of the run does not belong to its submaps",
            where=str(files / "graph.g2o"),
            got=f"{len(network)} poses",
            wanted=f"{graph.structure.count('x')}",
        )
    match = NO_KERNEL if config.match_robust == "none" else RobustKernel(config.match_robust, config.match_width)
    loop = LoopConfig().robust(graph.structure.group.dof)
    loops = _loops(files)
    for t in loops_of_network(network, match):
        _tie(graph, t, loop if (t.i, t.j) in loops else t.robust)
    values = graph.values.copy()
    values.poses = network.poses  # ties count with the weight that they have where the run ended
    graph.set_values(values)
    return PoseProblem.of_graph(graph)


def _tie(graph: FactorGraph, tie: IntraSessionLoop, kernel: RobustKernel) -> None:
    graph.add_between(
        tie.i, tie.j, tie.T_ij, tie.covariance, streams=["match"], interval=(0.0, 0.0), evidence="shared-scan",
        robust=kernel,
    )  # fmt: skip


def _loops(files: Path) -> set[tuple[int, int]]:
    """Nodes of the ties that were decided on as loops."""
    if not (files / "events.jsonl").is_file():
        return set()
    events = read_events(files)
    return {(int(e["i"]), int(e["j"])) for e in events if e.get("event") == "between" and e.get("group") == GROUP}
