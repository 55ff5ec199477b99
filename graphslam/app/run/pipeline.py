"""Main pipeline: raw log → submaps → graph → map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.attempts import best_map
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.options import FrontEnds, RunOptions, check_names
from graphslam.app.run.outputs import write_outputs
from graphslam.app.run.progress_picture import ProgressPicture
from graphslam.app.run.run import Run
from graphslam.app.run.run_bar import RunBar
from graphslam.app.run.source import load
from graphslam.app.run.stages import RunClock
from graphslam.app.run.submap_slam import SubmapSlam, tell_stage
from graphslam.backend.back_end import Observer
from graphslam.core.errors import MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.record_source import RecordSource
from graphslam.evaluate.stream_checks import StreamFinding, check_streams, refuse_faulty


def run(
    source: str | Path | SensorLog,
    *,
    frontend: FrontEnds | None = None,
    solver: str = "isam2",
    seed: int = 0,
    out: str | Path | None = None,
    config: Mapping[str, Any] | None = None,
    resume: bool = False,
    progress: bool | Sequence[Observer] = True,
) -> Run:
    """Run a front end over a log, join its submaps in a graph, and compute the metrics.
    Parameters
    ----------
    source : data set name, file, folder, or SensorLog
        To use another reader than the default one, load the log first (:func:`graphslam.load`).
    frontend : str, class or object, or a list of these, optional
        Registered name; by default the one that fits the streams of the log (:mod:`graphslam.app.run.choice`). Or a
        class that inherits from :class:`~graphslam_frontends.base.FrontEnd`, or an object of one, which has its own
        options. One of landmarks and one of planar scans can map a log together in one graph, each the intervals that
        suit it (:mod:`graphslam_frontends.mixed`).
    solver : str
        Registered name.
    seed : int
        Root of the seed tree.
    out : path, optional
        Run folder; without one nothing is written.
    config : mapping, optional
        Nested options over the source's preset: ``{"frontend": {...}, "backend": {...}, "gps": {...}}``; ``"preset"``
        names another preset than that of the log, its reader or its kind, ``"none"`` for defaults. ``"control"`` and
        ``"check"``: control points and distances that enter the graph, and check points that are withheld to test the
        result; each a CSV file, a table, or a list of mappings (:mod:`graphslam.core.control`).
    resume : bool
        Continue after the last finished submap of ``out``, to the same result. Loops that were undone stay undone.
    progress : bool or sequence of Observer
        Show a progress bar on stderr; or observers of the run: steps of a front end, submaps, loops, the solution
        (`graphslam.backend.back_end.Observer`). A `RunBar` among them is used as the progress bar. With a bar and
        ``out``, ``figures/progress.png`` shows the map so far until the run has finished.

    Returns
    -------
    Run
        In the frame of the first base [m, rad].

    Raises
    ------
    GraphSlamError
        Or one of its children; the message has what, where, got, wanted.

    Examples
    --------
    >>> made = gs.run(log, frontend="rbpf-ekf", solver="batch", config={"frontend": {"particles": 10}}, progress=False)
    >>> made.metric("converged")
    1.0
    """
    check_names(None if isinstance(source, SensorLog) else frontend, solver)
    RunFolder.check(out, resume=resume)
    observers = [] if isinstance(progress, bool) else list(progress)
    bar = next((o for o in observers if isinstance(o, RunBar)), None) or RunBar(progress is True)
    picture = ProgressPicture(Path(out)) if out is not None and bar.shown else None
    watch = [bar, *([picture] if picture else []), *(o for o in observers if o is not bar)]
    with one_blas_thread(), bar:
        clock = RunClock()
        tell_stage(watch, "reading")
        log = load(source)
        clock.lap("load")
        for o in watch:
            o.log_read(log)
        seen = check_streams(log)
        refuse_faulty(seen, log)
        options = RunOptions.for_log(log, frontend, solver, seed, config)
        if out is not None:
            options = options.with_digest(log)
        tell_stage(watch, "calibration")
        log, options, findings = options.calibrated(log)
        clock.lap("calibrate")
        with RunFolder.start(out, options.as_config(), resume=resume) as folder:
            undone = [] if folder is None or not resume else folder.removed_loops()
            tell_stage(watch, "front end")
            slam = SubmapSlam(options, RecordSource(log), watch, folder)
            result = finish_run(log, slam, clock, [*seen, *findings], undone)
            tell_stage(watch, "figures")
            if folder is not None:
                result = write_outputs(folder.path, result)
            if picture is not None:
                picture.remove()
            return result


def finish_run(
    log: SensorLog, slam: SubmapSlam, clock: RunClock, noticed: Sequence[StreamFinding], undone: Sequence[Any] = ()
) -> Run:
    """Finish the run of a complete log: the last submaps, then the graph, its maps, and the verdict."""
    slam.step()
    if not slam.submaps:
        raise MissingDataError("the log gave no submap", where=log.name)
    return replace(best_map(slam.inputs(log, noticed), slam, clock, undone), log=log)
