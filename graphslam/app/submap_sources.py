"""Submaps to join, from wherever a user has them: a run, a folder, a card, a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import read_consistently
from graphslam.app.pose_problem_files import load_pose_problem, pose_problem_of_run
from graphslam.app.run.files import read_options
from graphslam.app.run.outputs import identified_submaps
from graphslam.app.run.run import Run
from graphslam.core.errors import MissingDataError
from graphslam.core.json_file import check_json
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import Submap
from graphslam.io.catalog import load_recording
from graphslam.io.network_file import read_network
from graphslam.io.submap_store import read_truth
from graphslam.join.pose_problem import PoseProblem
from graphslam.join.registry import Material, are_dense


@dataclass(frozen=True, slots=True)
class SubmapSource:
    """Submaps with what is known beside them.

    Parameters
    ----------
    truth : MapTruth or None
        Landmarks only where the submaps' identities are the truth's.
    covariance_scale : float
        Factor that the run used in its own join; 1 elsewhere.
    problem : PoseProblem or None
        Dense submaps with all that ties them: a run's matches and loops, a pose-graph file that was cut.
    """

    submaps: list[Submap]
    truth: MapTruth | None = None
    covariance_scale: float = 1.0
    problem: PoseProblem | None = None

    @property
    def material(self) -> Material:
        """What is to be joined."""
        return self.submaps if self.problem is None else self.problem

    @property
    def times(self) -> list[float]:
        """Of the nodes of a joined map [s]."""
        if self.problem is not None:
            return self.problem.times.tolist()
        return [s.interval[0] for s in self.submaps] + [self.submaps[-1].interval[1]]

    @property
    def identified(self) -> bool:
        """Does every landmark have an identity?"""
        return all(s.landmarks is None or bool(np.all(s.landmarks.ids >= 0)) for s in self.submaps)


def poses_only(truth: MapTruth | None) -> MapTruth | None:
    """Truth without its landmarks, for maps whose landmarks have names of their own."""
    if truth is None:
        return None
    none = np.zeros(0, dtype=np.int64)
    return replace(truth, landmark_ids=none, landmarks=np.zeros((0, truth.landmarks.shape[1])))


def submap_source(
    source: Run | SubmapSource | PoseProblem | str | Path | Sequence[Submap], *, submap_poses: int | None = None
) -> SubmapSource:
    """Submaps from a run, a run folder, a submap store, a card, or a sequence.

    Parameters
    ----------
    source : Run, path, card, sequence of Submap, or PoseProblem
    submap_poses : int, optional
        A pose-graph file is cut into submaps of so many poses.
    """
    if isinstance(source, SubmapSource):
        return source
    if isinstance(source, PoseProblem):
        return SubmapSource([], problem=source)
    if isinstance(source, Run) and are_dense(source.submaps):
        if source.holds("graph"):
            return SubmapSource(list(source.submaps), poses_only(source.truth), problem=pose_problem_of_run(source))
        if source.folder is not None:
            return submap_source(source.folder)
    if isinstance(source, Run):
        truth = source.truth if source.report.get("identities") == "truth" else poses_only(source.truth)
        return SubmapSource(list(source.submaps), truth, float(source.report.get("covariance_scale", 1.0)))
    if not isinstance(source, (str, Path)):
        return SubmapSource(list(source))
    path = Path(source)
    if (path / "submaps").is_dir() or (path / "index.json").is_file():
        root = path if (path / "submaps").is_dir() else path.parent

        def read(files: Path) -> tuple[float, str, MapTruth | None, list[Submap], PoseProblem | None]:
            submaps = identified_submaps(root if (files / "association.npz").is_file() else path)
            tied = are_dense(submaps) and (files / "graph.g2o").is_file()
            problem = load_pose_problem(root, files, submaps) if tied else None
            return *_run_facts(root), read_truth(files), submaps, problem

        scale, identities, truth, submaps, problem = read_consistently(root, read)
        known = truth if identities != "run" and problem is None else poses_only(truth)
        return SubmapSource(submaps, known, scale if problem is None else 1.0, problem)
    loaded: Any = path if path.is_file() else load_recording(source)
    if isinstance(loaded, Path) and loaded.is_file():
        if submap_poses is None:
            raise MissingDataError(f"{source} holds no submaps; a pose-graph file is cut into some by --submap-poses")
        return SubmapSource([], problem=PoseProblem.of_network(read_network(loaded), submap_poses))
    if not (isinstance(loaded, list) and loaded and isinstance(loaded[0], Submap)):
        raise MissingDataError(
            f"{source} holds no submaps",
            got=type(loaded).__name__,
            wanted="a submap store, a run folder or a data set of submaps",
        )
    return SubmapSource(loaded)


def _run_facts(root: Path) -> tuple[float, str]:
    """Covariance scale and kind of identities of a run folder; of a bare store 1 and the truth's."""
    values = read_options(root)
    if not values:
        return 1.0, "truth"
    known = values.get("frontend", {}).get("association") == "known"
    backend = check_json(values.get("backend", {}), {"covariance_scale?": float}, str(root / "config.toml"))
    return float(backend.get("covariance_scale", 1.0)), "truth" if known else "run"
