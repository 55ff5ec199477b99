"""Every submap from the front end to the back end, stored as soon as it is finished."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graphslam.app.run.folder import RunFolder
from graphslam.backend.back_end import BackEnd
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.spilled_grid import load_spilled, spill_grid
from graphslam_frontends.base import FrontEnd

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class FrontEndTiming:
    """What the front end did in this session.

    Parameters
    ----------
    resumed : int
        Submaps that were there already.
    per_scan : (k,)
        Seconds a scan of each submap but the first, which may have compiled.
    """

    seconds: float
    resumed: int
    per_scan: Array


class SubmapPipeline:
    """Feeds every submap to the back end as soon as the front end has made it of the records that have come.

    Parameters
    ----------
    folder : RunFolder or None
        Where submaps are stored; those that are there already are not made again.
    with_grids : bool
        The grids of stored submaps are needed.
    draw : int, optional
        Which draw of random numbers it is; by default the first one, or that which the folder settled on.
    """

    def __init__(
        self,
        feed: RecordSource,
        front: FrontEnd,
        back: BackEnd,
        seed: SeedTree,
        folder: RunFolder | None,
        with_grids: bool,
        draw: int | None = None,
    ) -> None:
        self.front, self.back, self.feed, self.folder = front, back, feed, folder
        self._seed, self._with_grids = seed, with_grids
        self.drops = DropCounter()
        self.settled = None if folder is None else folder.settled()
        """What earlier draws of the folder came to, where that is decided."""
        settled = 0 if self.settled is None else self.settled.draw
        self.draw = settled if draw is None else draw
        of = None if self.draw == settled else self.draw
        self.store = None if folder is None else folder.submaps_with(load_spilled if with_grids else None, draw=of)
        self.submaps: list[Submap] = self.store.complete_prefix() if self.store is not None else []
        if self.store is not None:
            self.store.truncate(len(self.submaps))
        for s in self.submaps:
            back.add(s)
        last = self.submaps[-1] if self.submaps else None
        if last is not None:
            logger.info("resumed after submap %d at %.2f s", last.key, last.interval[1])
        self._resumed, self._seconds, self._since, self._cost = len(self.submaps), 0.0, 0.0, list[float]()
        drawn = seed.child("draw", self.draw, "frontend") if self.draw else seed.child("frontend")
        self._stream = front.follow(feed, seed=drawn, after=last, drops=self.drops, watch=self._watch)

    def step(self) -> None:
        """Use what has come; at the end of the log everything is used."""
        while True:
            start = time.perf_counter()
            submap = next(self._stream, None)
            spent = time.perf_counter() - start
            self._seconds, self._since = self._seconds + spent, self._since + spent
            if submap is None:  # more records are wanted, or there are none
                return
            if isinstance(submap.grid, EvidenceGrid):
                submap.grid.pool.release_scratch()
                submap = replace(submap, grid=spill_grid(submap.grid))
            if self.store is not None:
                self.store.append(submap)
            self.back.add(submap)
            self.submaps.append(submap)
            self._cost.append(self._since / max(int(submap.report.get("scans", 1)), 1))
            self._since = 0.0

    def with_next_seed(self, back: BackEnd) -> SubmapPipeline:
        """The same log with the next draw of random numbers, for another back end."""
        feed = RecordSource(self.feed.log)
        return SubmapPipeline(feed, self.front, back, self._seed, self.folder, self._with_grids, self.draw + 1)

    @property
    def work(self) -> FrontEndTiming:
        """What the front end did so far."""
        return FrontEndTiming(self._seconds, self._resumed, np.array(self._cost[1:]))

    def _watch(self, at: Any) -> None:
        for o in self.back.observers:
            o.front_end_at(at)
