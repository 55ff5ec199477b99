"""Submaps to join, from a run, a folder, a data set, or a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from graphslam.app.folders.generations import read_consistently
from graphslam.app.run.files import read_options
from graphslam.app.run.outputs import GRAPH, identified_submaps
from graphslam.app.run.run import Run
from graphslam.core.errors import MissingDataError
from graphslam.core.json_file import check_json
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import Submap
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.io.catalog import load_recording
from graphslam.io.network_file import read_network
from graphslam.io.submap_store import read_truth
from graphslam.join.graph_problem import JoinProblem
from graphslam.join.registry import Material, are_landmark_submaps


@dataclass(frozen=True, slots=True)
class SubmapSource:
    """Input of a join, with ground truth if known.

    Parameters
    ----------
    submaps : list of Submap
        Empty for a pose-graph file or a graph without submaps.
    truth : MapTruth or None
        With landmarks only if the submaps use the identities of the ground truth.
    covariance_scale : float
        Factor that the run used in its own join; otherwise 1.
    problem : JoinProblem or None
        The graph of a run with all its factors, or a pose-graph file cut into submaps.
    """

    submaps: list[Submap]
    truth: MapTruth | None = None
    covariance_scale: float = 1.0
    problem: JoinProblem | None = None

    @property
    def material(self) -> Material:
        """The problem if there is one, otherwise the submaps."""
        return self.submaps if self.problem is None else self.problem

    @property
    def times(self) -> list[float]:
        """Times of the nodes of a joined map [s]."""
        if self.problem is not None:
            return self.problem.times.tolist()
        return [s.interval[0] for s in self.submaps] + [self.submaps[-1].interval[1]]

    @property
    def identified(self) -> bool:
        """Does every landmark have an identity?"""
        return all(s.landmarks is None or bool(np.all(s.landmarks.ids >= 0)) for s in self.submaps)


def source_of_graph(
    problem: JoinProblem, submaps: list[Submap], truth: MapTruth | None, covariance_scale: float
) -> SubmapSource:
    """A solved graph as input of a join: all its factors, or landmark submaps if it has no other factors."""
    plain = set(problem.factor_counts()) == {"submap"} and are_landmark_submaps(submaps)
    records = {r.submap_key: r for r in problem.factors if isinstance(r, SubmapRecord)} if plain else {}
    if not plain or any(r.robot >= 0 for r in records.values()) or [s.key for s in submaps] != list(records):
        return SubmapSource(submaps, truth, problem=problem)
    return SubmapSource([s.with_ids(records[s.key].landmark_ids) for s in submaps], truth, covariance_scale)


def poses_only(truth: MapTruth | None) -> MapTruth | None:
    """Ground truth without landmarks, for maps with other landmark ids."""
    if truth is None:
        return None
    none = np.zeros(0, dtype=np.int64)
    return replace(truth, landmark_ids=none, landmarks=np.zeros((0, truth.landmarks.shape[1])))


Source: TypeAlias = Run | SubmapSource | JoinProblem | FactorGraph | str | Path | Sequence[Submap]


def submap_source(source: Source, *, submap_poses: int | None = None) -> SubmapSource:
    """Submaps from a run, a run folder, a submap store, a data set, or a sequence.

    Parameters
    ----------
    source : Run, path, data set name, sequence of Submap, FactorGraph or JoinProblem
    submap_poses : int, optional
        Cut a pose-graph file into submaps with this number of poses.
    """
    if isinstance(source, SubmapSource):
        return source
    if isinstance(source, FactorGraph):
        source = JoinProblem.of_graph(source)
    if isinstance(source, JoinProblem):
        return SubmapSource([], problem=source)
    if isinstance(source, Run):
        if source.folder is not None and not source.holds("graph"):
            return submap_source(source.folder)
        truth = source.truth if source.report.get("identities") == "truth" else poses_only(source.truth)
        scale, graph = float(source.report.get("covariance_scale", 1.0)), source.graph
        if graph is None:
            return SubmapSource(list(source.submaps), truth, scale)
        return source_of_graph(JoinProblem.of_graph(graph), list(source.submaps), truth, scale)
    if not isinstance(source, (str, Path)):
        return SubmapSource(list(source))
    path = Path(source)
    if (path / "submaps").is_dir() or (path / "index.json").is_file():
        root = path if (path / "submaps").is_dir() else path.parent

        def read(files: Path) -> SubmapSource:
            submaps = identified_submaps(root if (files / "association.npz").is_file() else path)
            scale, identities = _run_facts(root)
            truth = read_truth(files)
            truth = truth if identities != "run" else poses_only(truth)
            if not (files / GRAPH).is_file():
                if (files / "graph.g2o").is_file():  # submaps alone would lack GPS, IMU and loop closures
                    raise MissingDataError(
                        f"the graph of the run is not in its folder: {root / GRAPH}", wanted="a run of this version"
                    )
                return SubmapSource(submaps, truth, scale)
            return source_of_graph(JoinProblem.load(files / GRAPH), submaps, truth, scale)

        return read_consistently(root, read)
    loaded: Any = path if path.is_file() else load_recording(source)
    if isinstance(loaded, Path) and loaded.is_file():
        if submap_poses is None:
            raise MissingDataError(f"{source} holds no submaps; a pose-graph file is cut into some by --submap-poses")
        return SubmapSource([], problem=JoinProblem.of_network(read_network(loaded), submap_poses))
    if not (isinstance(loaded, list) and loaded and isinstance(loaded[0], Submap)):
        raise MissingDataError(
            f"{source} holds no submaps",
            got=type(loaded).__name__,
            wanted="a submap store, a run folder or a data set of submaps",
        )
    return SubmapSource(loaded)


def _run_facts(root: Path) -> tuple[float, str]:
    """Covariance scale and kind of identities of a run folder; for a store without options 1 and ``truth``."""
    values = read_options(root)
    if not values:
        return 1.0, "truth"
    stated = values.get("frontend", {})
    sections = [stated, *(v for v in stated.values() if isinstance(v, dict))]  # of several front ends
    known = any(x.get("association") == "known" for x in sections)
    backend = check_json(values.get("backend", {}), {"covariance_scale?": float}, str(root / "config.toml"))
    return float(backend.get("covariance_scale", 1.0)), "truth" if known else "run"
