"""Use of every stream of a log in a run: number of records, number of used records, and the reason for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.app.run.config import RunConfig
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.records import Compass, Gps
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import GpsRecord
from graphslam.graph.sensors import sensor_kinds
from graphslam.graph.sensors.base import SensorFactors


@dataclass(frozen=True, slots=True)
class StreamUse:
    """Use of one stream.

    Parameters
    ----------
    role : str
        ``input`` of the front end, the kind of a sensor of the graph, or ``unused``.
    offered : int
        Records in the log.
    used : int
        Records that a factor uses (from the ledger).
    asked : bool
        The configuration requests the stream.
    why : str
        Why records were not used; empty if all were.
    """

    name: str
    role: str
    offered: int
    used: int
    asked: bool
    why: str = ""

    def text(self) -> str:
        """``laser 7249 of 7249``."""
        return f"{self.name} {self.used} of {self.offered}"

    def as_row(self) -> dict[str, Any]:
        """JSON object for ``run.json``."""
        return {k: getattr(self, k) for k in ("name", "role", "offered", "used", "asked", "why")}


def stream_use(
    log: SensorLog, graph: FactorGraph, settings: RunConfig, dropped: Mapping[str, int], streams_used: frozenset[str]
) -> list[StreamUse]:
    """Use of every stream of a log.

    Parameters
    ----------
    graph : FactorGraph
        Finished; its ledger lists the records that were used.
    dropped : mapping of str to int
        Records dropped by the front end and the graph, per ``"stream: reason"``.
    streams_used : frozenset of str
        Streams that the submaps list as used.
    """
    spans: dict[str, list[tuple[float, float]]] = {}
    for e in graph.ledger.entries():
        spans.setdefault(e.stream.partition("/")[0], []).append((e.t_start, e.t_end))  # stream/beacon
    left_out = {e["stream"]: str(e["why"]) for e in graph.events if e.get("event") == "imu-not-used"}
    out = []
    for name, stream in log.streams.items():
        times = np.asarray(stream.times, dtype=np.float64)
        lost = {k.partition(": ")[2]: n for k, n in dropped.items() if k.startswith(f"{name}: ")}
        spent = np.zeros(len(times), dtype=np.bool_)
        for a, b in spans.get(name, []):
            i, j = np.searchsorted(times, a, "left"), np.searchsorted(times, b, "right")
            spent[i:j] = True
        used = int(spent.sum())
        role = "unused"
        asked, why = False, ""
        if name in streams_used:
            role = "input"
        elif isinstance(stream, Gps):
            asked = settings.gps.use != "none"
            role = "gps"
            factors = sum(isinstance(r, GpsRecord) for r in graph.records.values())
            used = min(used, factors)  # fixes that wait for a datum to the end are in the ledger, and in no factor
            if not asked:
                why = "gps.use is none; every-second: half of the fixes in the map, the others as a test"
            elif used == 0 and spent.any():
                why = (
                    f"its {int(spent.sum())} fixes on the path span less than {settings.gps.baseline:g} m, so the "
                    "heading of their frame cannot be estimated"
                )
            elif used < len(times) and settings.gps.use != "all":
                why = f"gps.use is {settings.gps.use}; the others are withheld as a test"
        elif isinstance(stream, Imu):
            asked = settings.imu.use == name or settings.imu.use == "auto"
            role, why = "imu", left_out.get(name, "") if asked else "imu.use is none"
        elif isinstance(stream, Compass):
            asked = settings.compass.use in (name, "auto")
            role, why = "compass", "" if asked else "compass.use is none"
        elif settings.beacons.use == name:
            asked, role = True, "beacons"
        elif (kind := next((k for k in sensor_kinds().values() if _always(k, stream)), None)) is not None:
            role, asked = kind.name, graph.dim in kind.dims
            why = "" if asked else f"a graph of {graph.dim} dimensions cannot use it"
        if asked and role in ("compass", "beacons") and 0 < used < len(times):
            every = (settings.compass if role == "compass" else settings.beacons).every
            why = f"limited to one every {every:g} s and to the time of the path" if every else ""
        if used < len(times) and not why:
            reasons = [f"{n} {k}" for k, n in lost.items()]
            outside = len(times) - used
            if outside and role != "unused":
                reasons.append(f"{outside} at times that no factor covers")
            why = ", ".join(reasons) or ("no part of this run reads it" if role == "unused" else "")
        out.append(StreamUse(name, role, len(times), used, asked, why))
    for option, why in _idle_options(log, settings, out):
        graph.log_event("no-effect", option=option, why=why)
    return out


def _always(kind: type[SensorFactors], stream: Any) -> bool:
    """Does a run use every such stream, without an option?"""
    return kind.options is None and isinstance(stream, kind.readings)


def _idle_options(log: SensorLog, settings: RunConfig, streams: list[StreamUse]) -> list[tuple[str, str]]:
    """Options that request a sensor that the log does not have, or that only the front end used; with the reason."""
    out = []
    for name, kind in sensor_kinds().items():
        use = getattr(getattr(settings, name, None), "use", "none")
        own = [s for s in streams if isinstance(log[s.name], kind.readings)]
        if use == "none" or (own and any(s.role != "input" for s in own)):
            continue
        front = ", ".join(s.name for s in own)
        why = f"the front end used {front}" if own else f"the log has no {kind.title}"
        out.append((f"{name}.use={use}", why))
    return out
