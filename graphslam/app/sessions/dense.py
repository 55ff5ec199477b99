"""A run of dense submaps as a session of a larger graph: chain, loop closures and fixes, read from its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import read_consistently
from graphslam.app.run.files import read_options, read_report
from graphslam.app.run.outputs import refined_submaps_of
from graphslam.app.run.run import Run
from graphslam.backend.config import MATCH_KERNEL, BackEndConfig, GpsOptions
from graphslam.backend.sessions import DenseSession, IntraSessionLoop, loops_of_graph, loops_of_network
from graphslam.core.config import build_config
from graphslam.core.errors import DataError
from graphslam.core.network import PoseNetwork
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.spilled_grid import load_spilled
from graphslam.evidence.views import has_dense_view
from graphslam.io.g2o import read_g2o
from graphslam.io.submap_store import read_submaps
from graphslam.loops.inter_session_loops import SessionMap
from graphslam.maps.moving import static_submaps
from graphslam.maps.refined import base_frames

SPACING = 3.0
"""Node spacing if a run has no nodes inside its submaps [m]; loop closures need them."""


def run_is_dense(run: Run) -> bool:
    """Are all submaps of a run without landmarks?"""
    return bool(run.submaps) and all(s.landmarks is None for s in run.submaps)


def submaps_with_maps(run: Run) -> list[Submap]:
    """The submaps of a run with their dense maps, without moving objects, along its refined path if it has one."""
    refined = refined_submaps_of(run)
    submaps = refined or list(run.submaps)
    if run.folder is not None and any(s.grid is None for s in submaps):
        submaps = read_submaps(run.folder, load_grid=load_spilled)
    without = [s.key for s in submaps if not has_dense_view(s)]
    if without:
        raise DataError(f"submaps {without} have no map", where=run.name, wanted="evidence grids or clouds")
    return static_submaps(submaps, (base_frames(run.map) if refined else run.map.base_poses)[:-1])[0]


def back_end_config(run: Run) -> BackEndConfig:
    """The back-end options of a run, from its report or configuration."""
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
    return build_config(kind, {k: v for k, v in values.items() if v is not None}, part)


def session_of(run: Run, name: str, *, first_key: int = 0, after: float = -np.inf) -> DenseSession:
    """A run as a session of a common graph: its keys start at ``first_key``, its times are after ``after`` [s].

    For a refined run it has the chain of its refined submaps only: re-entries and loops were measured with the scans
    that the refinement used, and must not be used twice.
    """
    config = back_end_config(run)
    begin = run.submaps[0].interval[0]
    shift = 0.0 if begin > after else float(np.ceil(after - begin) + 1000.0)
    keys = {s.key: first_key + k for k, s in enumerate(run.submaps)}
    found = submaps_with_maps(run)
    refined = all(s.report.get("refined") is True for s in found)
    submaps = [_in_common(s, keys, name, shift) for s in found]
    inner = [] if refined else _inner(run, config)
    if refined:  # the refined end poses include gravity with its own σ
        config = replace(config, level_sigma=0.0)
    fixes = None if run.fixes is None else replace(run.fixes, times=run.fixes.times + shift)
    return DenseSession(
        name, submaps, config, SessionMap(submaps, config.node_spacing), inner, shift, fixes,
        _options(run, "gps", GpsOptions), run.map.T_gps_world, refined,
    )  # fmt: skip


def _in_common(s: Submap, keys: dict[int, int], name: str, shift: float) -> Submap:
    """A submap with key, times and streams of the common graph; its matches come from the run's graph."""
    path = s.trajectory
    moved = None if path is None else Trajectory(path.times + shift, path.poses, path.covariances)
    a, b = s.interval
    return replace(s.of_session(name), key=keys[s.key], interval=(a + shift, b + shift), trajectory=moved, matches=())


def _inner(run: Run, config: BackEndConfig) -> list[IntraSessionLoop]:
    """Factors of a run's graph that are not in the chain, from the graph or from its file."""
    if _options(run, "backend", BackEndConfig).node_spacing != config.node_spacing:
        raise DataError(
            "a run whose submaps have no inner nodes cannot be tied", where=run.name, wanted="backend.node_spacing > 0"
        )
    if run.holds("graph") and run.graph is not None:
        return loops_of_graph(run.graph)
    net = None if run.folder is None else read_consistently(run.folder, lambda root: _graph_of(run, root))
    if net is None:
        raise DataError("a run does not say how its submaps hang together", where=run.name, wanted="its graph.g2o")
    return loops_of_network(net, MATCH_KERNEL)


def _graph_of(run: Run, root: Path) -> PoseNetwork | None:
    """The graph file of the state in which the run was read."""
    if not (root / "graph.g2o").is_file():
        return None
    now, then = read_report(root).get("generation"), run.report.get("generation")
    if now != then:
        raise DataError("the run was changed since it was read", where=str(run.folder), got=now, wanted=then)
    return read_g2o(root / "graph.g2o")
