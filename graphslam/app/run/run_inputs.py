"""Inputs of a run besides its submaps, from which its graph, metrics and files can be made again without the log.

Fixes, used and withheld, IMUs, motion and ground truth are kept unchanged; of streams that only the front end reads,
only the time stamps. In a run folder: ``inputs/`` (a log, :mod:`graphslam.io.log_store`) and ``inputs.npz``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.app.run.files import generation_of
from graphslam.core.atomic import read_npz, write_npz
from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.records import (
    PLAIN,
    Gps,
    LandmarkObservations,
    Odometry,
    SteeringControls,
    check_times,
)
from graphslam.evaluate.stream_checks import StreamFinding
from graphslam.io.log_store import INDEX_NAME, load_log, save_log
from graphslam.refine.scans import Scans

INPUTS_FORMAT = "graphslam.graph-inputs/1"
INPUTS = "inputs"
SCANS = "scans.npz"
KEPT = (Gps, Imu, LandmarkObservations, Odometry, SteeringControls)


def _is_kept(stream: Any) -> bool:
    """Are all data of the stream kept, not only its time stamps?"""
    return isinstance(stream, (*KEPT, *PLAIN.values()))


@dataclass(frozen=True, slots=True)
class TimestampsOnly:
    """A stream reduced to its time stamps.

    Parameters
    ----------
    times : (n,)
    """

    times: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_times(self.times))

    def take(self, index: Any) -> TimestampsOnly:
        """See :class:`graphslam.core.records.Stream`."""
        return replace(self, times=self.times[index])


@dataclass(frozen=True)
class RunInputs:
    """Inputs of the back end and of the metrics of a run, besides its submaps.

    Parameters
    ----------
    log : SensorLog
        Its ``read`` counts every stream, its ``dropped`` the records dropped by the reader and the front end.
    identities : (q,) int64 or None
        Reference identities of the log's landmark observations, not used by the run (−1 = none).
    noticed : tuple of StreamFinding
        Findings on its streams before the run.
    scans : Scans or None
        Scans for a refinement of the path; None if there is no refinement.
    """

    log: SensorLog
    identities: npt.NDArray[np.int64] | None = None
    noticed: tuple[StreamFinding, ...] = ()
    scans: Scans | None = None


def collect_inputs(
    log: SensorLog,
    dropped: Mapping[str, int],
    identities: npt.NDArray[np.int64] | None,
    noticed: Sequence[StreamFinding] = (),
    scans: Scans | None = None,
) -> RunInputs:
    """Inputs to keep from a log; ``dropped`` counts the records dropped by its front end."""
    streams: dict[str, Any] = {n: s if _is_kept(s) else TimestampsOnly(s.times) for n, s in log.streams.items()}
    read = dict(log.read) or {k: len(s.times) for k, s in log.streams.items()}
    return RunInputs(
        replace(log, streams=streams, read=read, dropped={**log.dropped, **dropped}), identities, tuple(noticed), scans
    )


def write_inputs(folder: Path, inputs: RunInputs, generation: str) -> None:
    """Write the inputs into the folder of a run's files."""
    log = inputs.log
    save_log(replace(log, streams={n: s for n, s in log.streams.items() if _is_kept(s)}), folder / INPUTS)
    arrays: dict[str, Any] = {"format": INPUTS_FORMAT, "generation": generation, "names": np.array([*log.streams], "U")}
    for k, stream in enumerate(log.streams.values()):
        if not _is_kept(stream):
            arrays[f"times_{k}"] = stream.times
    rows = [(n.stream, n.finding.level, n.finding.code, n.finding.text) for n in inputs.noticed]
    arrays["noticed"] = np.array(rows, "U").reshape(-1, 4)
    if inputs.identities is not None:
        arrays["identities"] = inputs.identities
    write_npz(folder / "inputs.npz", arrays)
    if inputs.scans is not None:
        inputs.scans.save(folder / SCANS)


def read_inputs(folder: Path) -> tuple[RunInputs, str | None]:
    """Read the inputs, and the id of their generation."""
    if not (folder / "inputs.npz").is_file() or not (folder / INPUTS / INDEX_NAME).is_file():
        raise MissingDataError(
            "the run folder has no inputs of its graph (inputs.npz, inputs/)",
            where=str(folder),
            wanted="a run of this version; run it again with --resume, finished submaps are reused",
        )
    log, a = load_log(folder / INPUTS), read_npz(folder / "inputs.npz", fmt=INPUTS_FORMAT)
    try:
        streams: dict[str, Any] = {
            str(n): TimestampsOnly(a[f"times_{k}"]) if f"times_{k}" in a else log.streams[str(n)]
            for k, n in enumerate(a["names"])
        }
        rows = [(str(s), Finding.from_row(dict(zip(("level", "code", "text"), map(str, r))))) for s, *r in a["noticed"]]
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"stream or array {error} is missing", where=str(folder / "inputs.npz")) from None
    noticed = tuple(StreamFinding(stream, finding) for stream, finding in rows if finding is not None)
    scans = Scans.load(folder / SCANS, log.name) if (folder / SCANS).is_file() else None
    return RunInputs(replace(log, streams=streams), a.get("identities"), noticed, scans), generation_of(a)
