"""SLAM of records as they come: for people who feed their own sensors."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.options import RunOptions
from graphslam.app.run.outputs import write_outputs
from graphslam.app.run.pipeline import finish_run, run
from graphslam.app.run.run import Run
from graphslam.app.run.stages import RunClock
from graphslam.app.run.submap_slam import SubmapSlam
from graphslam.backend.back_end import Observer
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.records import Stream
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.stream_checks import check_streams
from graphslam.io.growing_log import GrowingLog
from graphslam.io.log_kinds import kind_name
from graphslam.maps.global_map import GlobalMap, make_global_map
from graphslam.solve.batch import state_of
from graphslam.solve.solution import make_solution


class Slam:
    """SLAM of records as they come: what :func:`graphslam.run` does over a stored log, fed from the outside.

    Records are added in the order of their stamps. A submap is in the graph, and the graph is solved with it, as soon
    as the records that make it have come; :attr:`map` and :attr:`path` are those of the graph. What only the whole log
    allows is done by :meth:`finish`: loops are looked for a last time, the path is refined by its scans, maps are
    fused, and the verdict is given. The result is that of ``gs.run`` over the same records, to the last byte, with the
    same options.

    Beams that were used are freed; they are on disk until the end, where the verdict and a refinement ask for them
    once more. Work is done inside :meth:`add`, in the caller's thread, on one BLAS thread: where sensors cannot wait,
    put a queue between them and it.

    Some things cannot be done before all is known, and :attr:`waits_for` names the first of them; then records are
    only kept, and :meth:`finish` is a run over them: front ends that decide late (``segslam``, ``rbpf-grid``), whose
    steps are made of the whole log (``scan-window``), or that make a single map of it; an IMU, a compass or beacons in
    the graph; figures of a calibration (``calibrate.given``, ``calibrate.use = "always"``). With ``"auto"`` nothing is
    estimated from records that are still to come: noise is that of the options.

    Parameters
    ----------
    frontend : str
        Registered name.
    name : str
        Of the log, in reports.
    solver, seed
        As for :func:`graphslam.run`.
    out : path, optional
        Run folder; without one nothing is written.
    config : mapping, optional
        Nested options: ``{"frontend": {...}, "backend": {...}, "gps": {...}}``; ``"preset"`` names a source whose
        recommended settings are used, by default none.
    observers : sequence of Observer
        Told what goes on while it does (:class:`graphslam.backend.back_end.Observer`).
    records : path, optional
        Folder for beams while they are recorded; by default a temporary one, gone at the end.

    Raises
    ------
    GraphSlamError
        Or one of its children; says what, where, got, wanted.

    Examples
    --------
    >>> with gs.Slam("rbpf-ekf", config={"frontend": {"particles": 10}}) as slam:
    ...     slam.add(log["controls"])
    ...     slam.add(log["landmarks"])
    ...     done = slam.finish()
    >>> len(done.submaps) > 3
    True
    """

    def __init__(
        self,
        frontend: str,
        *,
        name: str = "live",
        solver: str = "isam2",
        seed: int = 0,
        out: str | Path | None = None,
        config: Mapping[str, Any] | None = None,
        observers: Sequence[Observer] = (),
        records: str | Path | None = None,
    ) -> None:
        options = RunOptions.for_records(name, frontend, solver, seed, config)
        self.waits_for = _waits_for(options)
        """What has to wait for the end of the log; empty where submaps are made while records come."""
        self._asked: dict[str, Any] = {
            "frontend": frontend, "solver": solver, "seed": seed, "out": out,
            "config": {"preset": "none", **(config or {})}, "progress": list(observers) or False,
        }  # fmt: skip
        self._stack, self._closed = ExitStack(), False
        self._run: Run | None = None
        self._seconds = 0.0
        with self._closing_on_error():
            folder = records or self._stack.enter_context(tempfile.TemporaryDirectory(prefix="graphslam-records-"))
            self._feed = GrowingLog(name, folder)
            self._slam: SubmapSlam | None = None
            if self.waits_for:
                return
            self._folder = self._stack.enter_context(RunFolder.start(out, options.as_config(), resume=False))
            self._stack.enter_context(one_blas_thread())
            self._slam = SubmapSlam(options, self._feed, observers, self._folder)

    def add(self, records: Stream, stream: str | None = None) -> None:
        """Take one record or more of a sensor, and go on as far as they allow.

        Parameters
        ----------
        records : Stream
            Of any kind that a log holds, such as :class:`graphslam.PointClouds` with one scan; mounting, limits and
            noise of the sensor are the same every time.
        stream : str, optional
            Name of the sensor; by default that of the kind of its records (``PointClouds``: ``point-clouds``).

        Raises
        ------
        DataError
            The records are not later than those before them, or of another sensor: they are not taken, and others may
            follow.
        GraphSlamError
            What the front end or the graph cannot use; nothing more is taken then.
        """
        if self._feed.ended or self._closed:
            raise DataError("records after the end", where=self._feed.name, wanted="a new Slam")
        begin = time.perf_counter()
        self._feed.add(stream or kind_name(records), records)
        if self._slam is not None:
            try:
                self._slam.step()
            except BaseException:
                self.close()
                raise
        self._seconds += time.perf_counter() - begin

    @property
    def submaps(self) -> Sequence[Submap]:
        """Those that are finished, and in the graph."""
        return () if self._slam is None else tuple(self._slam.submaps)

    @property
    def map(self) -> GlobalMap:
        """The map so far: trajectory, nodes and landmarks of the graph; after :meth:`finish` that of the run.

        Raises
        ------
        MissingDataError
            No submap is finished yet.
        """
        if self._run is not None:
            return self._run.map
        if self._slam is None or not self._slam.submaps:
            why = self.waits_for or "the first submap ends after its last record"
            raise MissingDataError(f"no submap is finished yet: {why}", where=self._feed.name)
        back, submaps = self._slam.back, self._slam.submaps
        here = make_solution(
            self._asked["solver"], back.graph, state_of(back.graph), iterations=0, gap=None, seconds=0.0
        )
        least = self._slam.options.settings.backend.confirmed_hits
        return make_global_map(here, submaps, back.landmark_hits(submaps), least)

    @property
    def path(self) -> Trajectory:
        """The path so far, in the frame of the first base, up to the end of the last submap: see :attr:`map`."""
        return self.map.trajectory

    @property
    def log(self) -> SensorLog:
        """All records, once :meth:`finish` was called; they are gone from disk when the folder ``records`` is."""
        return self._feed.log

    def finish(self) -> Run:
        """No more records will come: the last submap, loops, the refined path, maps, and the verdict.

        Raises
        ------
        GraphSlamError
            The records make no map.
        """
        if self._run is not None:
            return self._run
        if self._closed:
            raise DataError("it was closed", where=self._feed.name, wanted="a new Slam")
        self._closed = True
        with self._stack:
            self._feed.end()
            self._run = self._whole() if self._slam is None else self._finished(self._slam)
        return self._run

    def close(self) -> None:
        """Give back what is held, without a result where :meth:`finish` was not called."""
        self._closed = True
        self._stack.close()

    def __enter__(self) -> Slam:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _whole(self) -> Run:
        return run(self._feed.log, **self._asked)

    def _finished(self, slam: SubmapSlam) -> Run:
        log, clock = self._feed.log, RunClock(self._seconds)  # time in which records were waited for is nobody's
        noticed = check_streams(log)
        if self._folder is not None:
            slam.options = slam.options.with_digest(log)
            self._folder.describe(slam.options.as_config())
        result = finish_run(log, slam, clock, noticed)
        return result if self._folder is None else write_outputs(self._folder.path, result)

    def _closing_on_error(self) -> ExitStack:
        guard = ExitStack()
        guard.push(lambda kind, *_: self._stack.close() if kind is not None else None)
        return guard


def _waits_for(options: RunOptions) -> str:
    """What has to wait for the end of the log; empty where nothing has."""
    front, settings = options.front, options.settings
    assert front is not None
    if not front.incremental():
        return f"the front end {front.name} needs the whole log"
    for what, use in (("imu", settings.imu.use), ("compass", settings.compass.use), ("beacons", settings.beacons.use)):
        if use != "none":
            return f"{what}.use = {use!r} needs the whole log"
    if settings.calibrate.given is not None or settings.calibrate.use == "always":
        return "a calibration is applied to the whole log"
    return ""
