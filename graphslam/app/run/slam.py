"""SLAM of records as they come: for people who feed their own sensors."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from graphslam.app.machine import Stopwatch, one_blas_thread
from graphslam.app.run import config as cfg
from graphslam.app.run.calibration import can_calibrate
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.front_ends import make_front_end, named_preset
from graphslam.app.run.front_to_back import SubmapPipeline
from graphslam.app.run.outputs import write_outputs
from graphslam.app.run.pipeline import back_end, effective_config, run, solve_and_evaluate, with_digest, with_grids
from graphslam.app.run.run import Run
from graphslam.backend.back_end import Observer
from graphslam.core.config import build_config, merge_options
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import Stream
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.stream_checks import check_streams
from graphslam.io.growing_log import GrowingLog
from graphslam.io.log_kinds import kind_name
from graphslam.maps.global_map import GlobalMap, make_global_map
from graphslam.solve.batch import state_of
from graphslam.solve.solution import make_solution
from graphslam_frontends.base import FrontEnd


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
        Nested options: ``{"frontend": {...}, "backend": {...}, "gps": {...}}``.
    preset : str, optional
        Name of the source whose recommended settings are taken; by default none.
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
        preset: str | None = None,
        observers: Sequence[Observer] = (),
        records: str | Path | None = None,
    ) -> None:
        options = merge_options(named_preset(frontend, preset), config or {})
        settings: cfg.RunConfig = build_config(cfg.RunConfig, options)
        front = make_front_end(frontend, settings.frontend)
        self.waits_for = _waits_for(front, settings)
        """What has to wait for the end of the log; empty where submaps are made while records come."""
        self._asked: dict[str, Any] = {
            "frontend": frontend, "solver": solver, "seed": seed, "out": out, "config": config, "preset": preset,
            "observers": observers,
        }  # fmt: skip
        self._stack, self._closed = ExitStack(), False
        self._run: Run | None = None
        self._seconds = 0.0
        with self._closing_on_error():
            folder = records or self._stack.enter_context(tempfile.TemporaryDirectory(prefix="graphslam-records-"))
            self._feed = GrowingLog(name, folder)
            self._work: SubmapPipeline | None = None
            if self.waits_for:
                return
            own = replace(settings.calibrate, use="none") if can_calibrate(front) else settings.calibrate
            self._settings = replace(settings, calibrate=own)
            self._effective = effective_config(name, frontend, solver, seed, front.config, self._settings)
            self._folder: RunFolder | None = None
            if out is not None:
                self._folder = self._stack.enter_context(RunFolder.start(out, self._effective, resume=False))
            self._stack.enter_context(one_blas_thread())
            back = back_end(self._feed, self._settings, solver, observers)
            tree = SeedTree(seed)
            self._work = SubmapPipeline(self._feed, front, back, tree, self._folder, with_grids(self._settings))

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
        if self._work is not None:
            try:
                self._work.step()
            except BaseException:
                self.close()
                raise
        self._seconds += time.perf_counter() - begin

    @property
    def submaps(self) -> Sequence[Submap]:
        """Those that are finished, and in the graph."""
        return () if self._work is None else tuple(self._work.submaps)

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
        if self._work is None or not self._work.submaps:
            why = self.waits_for or "the first submap ends after its last record"
            raise MissingDataError(f"no submap is finished yet: {why}", where=self._feed.name)
        back, submaps = self._work.back, self._work.submaps
        here = make_solution(
            self._asked["solver"], back.graph, state_of(back.graph), iterations=0, gap=None, seconds=0.0
        )
        return make_global_map(here, submaps, back.landmark_hits(submaps), self._settings.backend.confirmed_hits)

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
            self._run = self._whole() if self._work is None else self._finished(self._work)
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
        return run(self._feed.log, progress=False, **{**self._asked, "preset": self._asked["preset"] or "none"})

    def _finished(self, work: SubmapPipeline) -> Run:
        log, seconds = self._feed.log, {"load": 0.0, "calibrate": 0.0}
        begin = Stopwatch(self._seconds)  # time in which records were waited for is nobody's
        noticed = check_streams(log)
        effective = self._effective
        if self._folder is not None:
            effective = with_digest(effective, log)
            self._folder.describe(effective)
        work.step()
        result = solve_and_evaluate(log, work, self._settings, effective, seconds, begin, (), noticed)
        return result if self._folder is None else write_outputs(self._folder.path, result)

    def _closing_on_error(self) -> ExitStack:
        guard = ExitStack()
        guard.push(lambda kind, *_: self._stack.close() if kind is not None else None)
        return guard


def _waits_for(front: FrontEnd, settings: cfg.RunConfig) -> str:
    """What has to wait for the end of the log; empty where nothing has."""
    if not front.incremental():
        return f"the front end {front.name} needs the whole log"
    for what, use in (("imu", settings.imu.use), ("compass", settings.compass.use), ("beacons", settings.beacons.use)):
        if use != "none":
            return f"{what}.use = {use!r} needs the whole log"
    if settings.calibrate.given is not None or settings.calibrate.use == "always":
        return "a calibration is applied to the whole log"
    return ""
