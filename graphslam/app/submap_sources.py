"""Submaps to join, from wherever a user has them: a run, a folder, a card, a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.folders.generations import consistent
from graphslam.app.run.files import read_options
from graphslam.app.run.outputs import identified_submaps
from graphslam.app.run.run import Run
from graphslam.core.errors import MissingDataError
from graphslam.core.json_file import check_json
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import Submap
from graphslam.io.catalog import load
from graphslam.io.submap_store import read_truth


@dataclass(frozen=True, slots=True)
class SubmapSource:
    """Submaps with what is known beside them.

    Parameters
    ----------
    submaps : list of Submap
    truth : MapTruth or None
        Landmarks only where the submaps' identities are the truth's.
    covariance_scale : float
        Factor that the run used in its own join; 1 elsewhere.
    """

    submaps: list[Submap]
    truth: MapTruth | None = None
    covariance_scale: float = 1.0

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


def submap_source(source: Run | SubmapSource | str | Path | Sequence[Submap]) -> SubmapSource:
    """Submaps from a run, a run folder, a submap store, a card, or a sequence.

    Raises
    ------
    UnknownNameError, MissingDataError, FormatError
    """
    if isinstance(source, SubmapSource):
        return source
    if isinstance(source, Run):
        truth = source.truth if source.report.get("identities") == "truth" else poses_only(source.truth)
        return SubmapSource(list(source.submaps), truth, float(source.report.get("covariance_scale", 1.0)))
    if not isinstance(source, (str, Path)):
        return SubmapSource(list(source))
    path = Path(source)
    if (path / "submaps").is_dir() or (path / "index.json").is_file():
        root = path if (path / "submaps").is_dir() else path.parent

        def read(files: Path) -> tuple[float, str, MapTruth | None, list[Submap]]:
            submaps = identified_submaps(root if (files / "association.npz").is_file() else path)
            return *_run_facts(root), read_truth(files), submaps

        scale, identities, truth, submaps = consistent(root, read)
        return SubmapSource(submaps, truth if identities != "run" else poses_only(truth), scale)
    loaded: Any = load(source)
    if not (isinstance(loaded, list) and loaded and isinstance(loaded[0], Submap)):
        raise MissingDataError(
            f"{source} holds no submaps", got=type(loaded).__name__, wanted="a store, a run or a card of them"
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
