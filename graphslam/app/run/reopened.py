"""Rebuild the graph of a finished run from its folder; no log is read and no submap is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graphslam.app.folders.generations import read_consistently
from graphslam.app.machine import one_blas_thread
from graphslam.app.run.attempts import best_map
from graphslam.app.run.files import read_report, removed_loops_of_run
from graphslam.app.run.folder import RunFolder
from graphslam.app.run.options import RunOptions
from graphslam.app.run.outputs import write_outputs
from graphslam.app.run.run import Run
from graphslam.app.run.run_bar import RunBar
from graphslam.app.run.run_inputs import read_inputs
from graphslam.app.run.stages import RunClock
from graphslam.app.run.submap_slam import SubmapSlam
from graphslam.core.lock import lock_folder
from graphslam.core.record_source import RecordSource
from graphslam.graph.factor_graph import FactorGraph
from graphslam.loops.ledger import LoopDecision
from graphslam.solve.solution import Solution


def rerun_without_loops(folder: str | Path, undo: Sequence[LoopDecision], *, progress: bool = True) -> Run:
    """Solve a finished run again from its folder without these loops, and write its files anew.

    Parameters
    ----------
    undo : sequence of LoopDecision
        Loops to remove.
    progress : bool
        Show a progress bar on stderr.
    """
    root = Path(folder)
    with one_blas_thread(), lock_folder(root), RunBar(progress) as bar:
        clock = RunClock()
        bar.stage("reading")
        inputs, _ = read_consistently(root, read_inputs)
        options = RunOptions.of_folder(root)
        clock.lap("load")
        bar.log_read(inputs.log)
        bar.stage("front end")
        slam = SubmapSlam(options, RecordSource(inputs.log), [bar], RunFolder(root))
        made = best_map(inputs, slam, clock, undo)
        bar.stage("figures")
        return write_outputs(root, made)


def resolve_from_folder(folder: str | Path) -> tuple[FactorGraph, Solution]:
    """Graph and solution of a finished run, without the loops that were undone."""
    root = Path(folder)
    with one_blas_thread():
        inputs, _ = read_consistently(root, read_inputs)
        options = RunOptions.of_folder(root)
        attempts = read_consistently(root, read_report).get("map_attempts", [])
        if any(a["kept"] and a["loops"] for a in attempts):  # "auto": loops were searched after a contradictory map
            options = options.searching_loops()
        slam = SubmapSlam(options, RecordSource(inputs.log), [], RunFolder(root))
        solution = slam.back.finish(removed_loops_of_run(root))
    return slam.back.graph, solution
