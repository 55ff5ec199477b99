"""Every submap from the front end to the back end, stored as soon as it is finished."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from graphslam.app.run.folder import RunFolder
from graphslam.backend.back_end import BackEnd, Observer
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.evidence.formats import load_npz
from graphslam.evidence.grid import EvidenceGrid
from graphslam.frontends.base import FrontEnd
from graphslam.graph.pose_graph import PoseGraph
from graphslam.solve.solution import Solution

logger = logging.getLogger(__name__)


class ProgressBar(Observer):
    """How much of the log is in the graph, on stderr."""

    def __init__(self, log: SensorLog, shown: bool) -> None:
        first, last = log.interval
        self.bar = tqdm(total=round(last - first, 1), unit="s", desc=log.name, disable=not shown, leave=False)
        self.bar.set_postfix_str("kernels are compiled at their first use ever, about half a minute")

    def submap_added(self, submap: Submap, graph: PoseGraph) -> None:
        """A step."""
        self.bar.update(submap.interval[1] - submap.interval[0])
        self.bar.set_postfix(submaps=len(graph.submaps), landmarks=len(graph.values.landmarks))

    def solved(self, solution: Solution) -> None:
        """The end."""
        self.bar.close()


@dataclass(frozen=True, slots=True)
class FrontEndWork:
    """What the front end did in this session.

    Parameters
    ----------
    seconds : float
    resumed : int
        Submaps that were there already.
    per_scan : (k,)
        Seconds a scan of each submap but the first, which may have compiled.
    """

    seconds: float
    resumed: int
    per_scan: Array


def front_to_back(
    log: SensorLog,
    front: FrontEnd,
    back: BackEnd,
    seed: SeedTree,
    folder: RunFolder | None,
    drops: DropCounter,
    with_grids: bool,
) -> tuple[list[Submap], FrontEndWork]:
    """Feed every submap to the back end as soon as it is finished and stored."""
    store = None if folder is None else folder.submaps_with(load_npz if with_grids else None)
    submaps = store.complete_prefix() if store is not None else []
    if store is not None:
        store.truncate(len(submaps))
    for s in submaps:
        back.add(s)
    if submaps:
        logger.info("resumed after submap %d at %.2f s", submaps[-1].key, submaps[-1].interval[1])
    front_s, resumed, cost = 0.0, len(submaps), []

    def watch(at: Any) -> None:
        for o in back.observers:
            o.front_end_at(at)

    last = submaps[-1] if submaps else None
    stream = front.submaps(log, seed=seed.child("frontend"), after=last, drops=drops, watch=watch)
    while True:
        start = time.perf_counter()
        submap = next(stream, None)
        spent = time.perf_counter() - start
        front_s += spent
        if submap is None:
            break
        if isinstance(submap.grid, EvidenceGrid):
            submap.grid.pool.release_scratch()
        if store is not None:
            store.append(submap)
        back.add(submap)
        submaps.append(submap)
        cost.append(spent / max(int(submap.report.get("scans", 1)), 1))
    return submaps, FrontEndWork(front_s, resumed, np.array(cost[1:]))
