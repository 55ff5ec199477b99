"""Read the files of a run folder. Each must have its expected shape; otherwise it is refused.

Nothing here imports, runs or opens a file that is named in another one.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.app.folders.generations import check_same, current_outputs, read_consistently
from graphslam.core.atomic import read_json, read_npz
from graphslam.core.config import read_toml
from graphslam.core.errors import DataError, FormatError, RunFolderError
from graphslam.core.gaussian import first_no_covariance
from graphslam.core.geometry import Array
from graphslam.core.json_file import check_json, parse_json, read_json_lines
from graphslam.core.npz import Field, floats, ints, read_arrays, texts
from graphslam.core.reading import LARGEST, read_text
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import GpsResiduals
from graphslam.loops.ledger import EVENT, LoopDecision, LoopLedger, ledger_of_events
from graphslam.maps.global_map import GlobalMap

GENERATION_EVENT = "generation"
"""First line of ``events.jsonl``: id of the state of the folder that the file belongs to."""
RUN_FORMAT = "graphslam.run/1"
MERGE_FORMAT = "graphslam.merge/1"
MAP_FORMAT = "graphslam.map/1"
GPS_FORMAT = "graphslam.gps-residuals/1"
FIXES_FORMAT = "graphslam.fixes/1"
ASSOCIATION_FORMAT = "graphslam.association/1"

MERGED_FORMAT = "graphslam.merged-map/1"
MERGED_DENSE_FORMAT = "graphslam.merged-submaps/1"

MAP: dict[str, Field] = {
    "trajectory_times": floats("n"),
    "trajectory_poses": floats("n", "p"),
    "trajectory_covariances": floats("n", "d", "d"),
    "node_times": floats("m"),
    "node_poses": floats("m", "p"),
    "node_covariances": floats("m", "d", "d"),
    "landmark_ids": ints("l"),
    "landmarks": floats("l", "c"),
    "landmark_covariances": floats("l", "e", "e"),
    "landmark_hits": ints("l"),
    "T_gps_world": floats("p", optional=True),
    "base_nodes": ints("k", optional=True),
}
GPS: dict[str, Field] = {
    "times": floats("n"),
    "residuals": floats("n", "c"),
    "points": floats("n", "c"),
    "T_gps_map": floats("p"),
    "lever": floats("c"),
    "fitted": ints(),
    "outside": ints(),
    "in_gap": ints(),
}
FIXES: dict[str, Field] = {
    "times": floats("n"),
    "positions": floats("n", "c"),
    "sigma": floats("n"),
    "lever": floats("c"),
}
ASSOCIATION: dict[str, Field] = {"keys": ints("n"), "offsets": ints("n+1"), "ids": ints("q")}

MERGED_DENSE: dict[str, Field] = {
    "sessions": texts("s"),
    "session_of_submap": ints("m"),
    "keys": ints("m"),
    "bases": floats("b", "p"),
    "base_covariances": floats("b", "d", "d"),
    "nodes": floats("n", "p"),
}

_PART: dict[Any, Any] = {str: object}
RUN: dict[str, Any] = {
    "source": str,
    "frontend?": str,
    "solver?": str,
    "seed?": int,
    "identities?": str,
    "covariance_scale?": float,
    "T_world_base?": [float],
    "source_meta?": _PART,
    "records_read?": {str: int},
    "records_dropped?": {str: int},
    "flagged_submaps?": _PART,
    "versions?": {str: str},
    "seconds?": _PART,
    "graph?": _PART,
    "backend?": _PART,
    "gps?": _PART,
    "imu?": _PART,
    "calibrate?": _PART,
    "verdict?": _PART,
    "two_maps?": {
        "loops": ([int], [int]),
        **{"apart_max": float, "apart_median": float, "apart_max_node": int, "apart_max_time": float},
        "places": [{"loops": ([int], [int]), "nodes": ((int, int), (int, int)), "times": ((float, float),) * 2}],
    },
    "nees_chart?": str,
    "gps_innovations?": {"times": [float], "innovations": [[float]], "sigmas": [[float]], "nis": [float]},
    "refine?": {
        "rounds?": [
            {
                **{"distance": float, "range_sigma": float, "surface_sigma": float},
                **{"pairs": int, "passes": int, "spread": float, "moved": float},
            }
        ],
        "agreement?": [float],
        "constants?": {str: {"value": float, "sigma": float}},
        "yaw_bias?": [(float, float)],
        "left_apart?": [(float, float)],
        "motion_chi2_per_dof?": float,
    },
}
MERGE: dict[str, Any] = {"sessions?": [_PART], "graph?": _PART}
METRIC: dict[str, Any] = {"key": str, "value?": float, "unit?": str, "direction?": str}
_TABLE = [[float]]
EVENTS: dict[str, dict[str, Any]] = {
    EVENT: {
        "loop": int,
        "verdict": str,
        "why": str,
        "i": int,
        "j": int,
        "submap_i?": int,
        "submap_j?": int,
        "source?": str,
        "score?": float,
        "gain?": float,
        "gates?": {"entries?": [(int, int)], "fitness?": float},
        "chi2?": float,
        "weight?": float,
        "effect_predicted?": float,
        "effect?": float,
        "effect_earlier?": float,
        "factor_id?": int,
        "T_ij?": [float],
        "covariance?": _TABLE,
    },
    "between": {
        "i": int,
        "j": int,
        "group?": str,
        "factor_id?": int,
        "target?": int,
        "submap?": int,
        "support?": float,
        "fitness?": float,
    },
    "match-not-used": {"i?": int, "j?": int, "target?": int, "submap?": int, "support?": float, "fitness?": float},
    "removed": {"factor_id?": int, "reason?": str},
    "split": {"new": int},
}
"""Fields of events that are used when a folder is read; in other events only ``event`` must be text."""
VERDICTS = ("accepted", "rejected", "switched-off", "undone")
LEDGER: dict[str, type] = {
    **{"factor_id": int, "factor": str, "stream": str, "t_start": float, "t_end": float, "kind": str, "note": str}
}


def read_report(root: Path) -> dict[str, Any]:
    """``run.json`` of a finished run."""
    return read_json(root / "run.json", fmt=RUN_FORMAT, shape=RUN)


def read_merge_report(root: Path) -> dict[str, Any]:
    """``merge.json`` of a merged map."""
    return read_json(root / "merge.json", fmt=MERGE_FORMAT, shape=MERGE)


def read_options(root: Path) -> dict[str, Any]:
    """``config.toml`` of a run: tables of options by name; empty if there is no file."""
    file = root / "config.toml"
    if not file.exists():
        return {}
    values = read_toml(file)
    shape = {f"{k}?": _PART for k in values}
    if "run" in values:
        shape["run?"] = {"source?": str, "frontend?": object, "solver?": str, "seed?": int}
    return dict(check_json(values, shape, str(file)))


def read_map(root: Path) -> GlobalMap:
    """``map.npz``."""
    file = root / "map.npz"
    where = str(file)
    a = read_npz(file, fmt=MAP_FORMAT, fields=MAP)
    m, d = len(a["node_times"]), a["node_covariances"].shape[1]
    bases = a.get("base_nodes")
    if bases is not None and len(bases) and (bases.min() < 0 or bases.max() >= m or np.any(np.diff(bases) <= 0)):
        raise FormatError("array 'base_nodes' refers to missing nodes", where=where, wanted=f"rising, 0 … {m - 1}")
    if d != {3: 3, 7: 6}.get(a["node_poses"].shape[1]):
        raise FormatError("poses and covariances do not fit", where=where, got=(a["node_poses"].shape, d))
    try:
        path = Trajectory(a["trajectory_times"], a["trajectory_poses"], a["trajectory_covariances"])
        Trajectory(a["node_times"], a["node_poses"])
    except DataError as error:
        raise FormatError(error.what, where=where, got=error.got, wanted=error.wanted) from None
    for name in ("trajectory_covariances", "node_covariances", "landmark_covariances"):
        _check_covariances(a[name], name, where)
    return GlobalMap(
        trajectory=path,
        node_times=a["node_times"],
        node_poses=a["node_poses"],
        node_covariances=a["node_covariances"],
        landmark_ids=a["landmark_ids"],
        landmarks=a["landmarks"],
        landmark_covariances=a["landmark_covariances"],
        landmark_hits=a["landmark_hits"],
        T_gps_world=a.get("T_gps_world"),
        base_nodes=bases,
    )


def _check_covariances(covariances: Array, what: str, where: str) -> None:
    """Refuse covariances that are not symmetric, or have a negative variance that rounding does not explain."""
    bad = first_no_covariance(covariances)
    if bad is not None:
        raise FormatError(f"{what}: number {bad} is no covariance", where=where, got=covariances[bad].tolist())


def read_association(root: Path) -> dict[int, npt.NDArray[np.int64]]:
    """Landmark identities assigned by a run's back end, by submap key."""
    file = root / "association.npz"
    a = read_npz(file, fmt=ASSOCIATION_FORMAT, fields=ASSOCIATION)
    o = a["offsets"]
    if o[0] != 0 or np.any(np.diff(o) < 0) or o[-1] != len(a["ids"]) or len(np.unique(a["keys"])) != len(a["keys"]):
        raise FormatError("offsets do not partition the identities, or a key is repeated", where=str(file))
    return {int(k): a["ids"][o[i] : o[i + 1]] for i, k in enumerate(a["keys"])}


def read_metrics(root: Path, name: str = "metrics.json") -> list[dict[str, Any]]:
    """Rows of ``metrics.json`` or ``timings.json``: key, value, unit, direction; a missing value is NaN."""
    file = root / name
    rows = check_json(parse_json(read_text(file), str(file)), [METRIC], str(file))
    value = [np.nan if r.get("value") is None else float(r["value"]) for r in rows]
    text = [{c: r.get(c) or "" for c in ("unit", "direction")} for r in rows]
    return [{"key": r["key"], "value": v, **t} for r, v, t in zip(rows, value, text)]


def read_events(root: str | Path, *, home: str | Path | None = None) -> list[dict[str, Any]]:
    """``events.jsonl`` of the files of a run; ``home`` is the folder that errors name."""
    file = Path(root) / "events.jsonl"
    if not file.is_file():
        raise RunFolderError(f"{home or root}: has no events.jsonl; give a folder of a finished run")
    events = read_json_lines(file)
    for number, event in enumerate(events, start=1):
        where = f"{file}, line {number}"
        check_json(event, {"event": str}, where)
        check_json(event, EVENTS.get(event["event"], {}), where)
        if event["event"] == EVENT:
            _check_decision(event, where)
    return events[1:] if events and events[0]["event"] == GENERATION_EVENT else events


def check_state(root: Path) -> None:
    """Check that plain files of a run have the same generation id; files of older versions have none."""
    known = read_report(root).get("generation")
    for file in (root / n for n in ("map.npz", "association.npz", "fixes.npz", "inputs.npz")):
        if file.is_file():
            check_same((root / "run.json", known), (file, generation_of(read_arrays(file))))
    for file in sorted(root.glob("gps_*.npz")):
        check_same((root / "run.json", known), (file, generation_of(read_arrays(file))))
    if (root / "events.jsonl").is_file():
        first = next(iter(read_json_lines(root / "events.jsonl")), {})
        found = first.get("generation") if first.get("event") == GENERATION_EVENT else None
        check_same((root / "run.json", known), (root / "events.jsonl", found))


def generation_of(arrays: Mapping[str, Any]) -> str | None:
    """Id of the generation in a file's arrays; None in files of older versions."""
    return str(arrays["generation"]) if "generation" in arrays else None


def _check_decision(event: Mapping[str, Any], where: str) -> None:
    if event["verdict"] not in VERDICTS:
        raise FormatError("unknown verdict of a loop", where=where, got=event["verdict"][:40], wanted=VERDICTS)
    T, P = event.get("T_ij") or [], event.get("covariance") or []
    d = {0: 0, 3: 3, 7: 6}.get(len(T))
    if d is None or len(P) != d or any(len(row) != d for row in P):
        raise FormatError("measurement and covariance of a loop do not fit", where=where, got=(len(T), len(P)))
    if d:
        _check_covariances(np.array([P], dtype=np.float64), "covariance of a loop", where)


def read_ledger(root: Path) -> list[dict[str, Any]]:
    """Rows of ``ledger.csv``: which factor used which stream in which time interval."""
    file = root / "ledger.csv"
    try:
        lines = list(csv.reader(io.StringIO(read_text(file)), strict=True))
    except csv.Error as error:
        raise FormatError(f"not a table ({error})", where=str(file)) from None
    head = lines[0] if lines else []
    if lacking := [c for c in LEDGER if head.count(c) != 1]:
        raise FormatError(f"table lacks columns {lacking}, or has them twice", where=str(file), wanted=[*LEDGER])
    rows = []
    for number, row in enumerate(lines[1:], start=2):
        if len(row) != len(head):
            raise FormatError(
                "row of another length", where=f"{file}, line {number}", got=len(row), wanted=f"{len(head)} columns"
            )
        where = f"{file}, line {number}, column"
        rows.append({c: _cell(row[head.index(c)], kind, f"{where} {c}") for c, kind in LEDGER.items()})
    return rows


def _cell(text: str, kind: type, where: str) -> Any:
    if kind is str:
        return text
    try:
        value = kind(text)
    except (ValueError, OverflowError):
        raise FormatError("not a number", where=where, got=repr(text[:40])) from None
    if not abs(value) <= (2**62 if kind is int else LARGEST):
        raise FormatError("not a finite number", where=where, got=text[:40], wanted="finite numbers")
    return value


def read_merged_dense(root: Path) -> dict[str, npt.NDArray[Any]]:
    """``merged.npz`` of merged dense submaps."""
    return read_npz(root / "merged.npz", fmt=MERGED_DENSE_FORMAT, fields=MERGED_DENSE)


def read_gps_residuals(file: Path) -> GpsResiduals:
    """``gps_NAME.npz``."""
    a: Any = read_npz(file, fmt=GPS_FORMAT, fields=GPS)
    a |= {name: int(a[name]) for name in ("fitted", "outside", "in_gap")}
    return GpsResiduals(**a)


def read_fixes(root: Path) -> Gps | None:
    """``fixes.npz``; None if there is no file."""
    file = root / "fixes.npz"
    if not file.is_file():
        return None
    a: Any = read_npz(file, fmt=FIXES_FORMAT, fields=FIXES)
    try:
        return Gps(**a)
    except DataError as error:
        raise FormatError(error.what, where=str(file), got=error.got, wanted=error.wanted) from None


def loops_of_run(folder: str | Path) -> LoopLedger:
    """Ledger of all loops of a run: first those with a decision, then the front end's matches without one."""
    events = read_consistently(folder, lambda root: read_events(root, home=folder))
    return ledger_of_events(events, where=str(Path(folder) / "events.jsonl"))


def removed_loops_of_run(folder: str | Path) -> list[LoopDecision]:
    """Loops that were removed from a finished run by hand; empty if the run is not finished."""
    if not (current_outputs(folder) / "events.jsonl").is_file():
        return []
    return [d for d in loops_of_run(folder).current() if d.verdict == "undone"]


RESUMED = "resumed_submaps"
