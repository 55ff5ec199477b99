"""Loops taken out of a finished run, or in again: the run is made again from its folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from graphslam.app.folders.lock import lock_folder
from graphslam.app.run.files import loops_of_run, removed_loops_of_run
from graphslam.app.run.reopened import rerun_without_loops
from graphslam.core.errors import DataError
from graphslam.loops.candidates import FRONT_END
from graphslam.loops.ledger import LoopDecision, LoopLedger
from graphslam.loops.overlap_constraints import overlap_entries


def undo_loop(folder: str | Path, loop: int, *, progress: bool = True) -> LoopLedger:
    """Take a loop out of a finished run: its graph is made again from what the folder holds, solved without the loop,
    and everything in the folder is written anew.

    Loops that were undone before stay so, as this one does whenever the run is resumed (:func:`redo_loop` takes it in
    again). What was found with the loop in the graph stays too.

    Parameters
    ----------
    loop : int
        Number in the ledger.
    """

    def without(before: LoopLedger, undone: list[LoopDecision]) -> list[LoopDecision]:
        d = before.of(loop)
        if d.verdict != "accepted":
            raise DataError(
                f"loop {loop} is not in the graph", where=str(folder), got=d.verdict, wanted="an accepted loop"
            )
        return [*undone, d]

    return _again(folder, without, progress)


def redo_loop(folder: str | Path, loop: int, *, progress: bool = True) -> LoopLedger:
    """Take in again a loop that :func:`undo_loop` took out, a match with its ties; others that were undone stay so.

    Parameters and errors are those of :func:`undo_loop`.
    """

    def without(before: LoopLedger, undone: list[LoopDecision]) -> list[LoopDecision]:
        d = before.of(loop)
        if d.verdict != "undone":
            raise DataError(f"loop {loop} was not undone", where=str(folder), got=d.verdict, wanted="an undone loop")
        entry = (d.submap_i, d.submap_j)
        gone = [x for x in undone if x.loop != loop]
        return [x for x in gone if entry not in overlap_entries(x.gates)] if d.source == FRONT_END else gone

    return _again(folder, without, progress)


def _again(
    folder: str | Path, without: Callable[[LoopLedger, list[LoopDecision]], list[LoopDecision]], progress: bool
) -> LoopLedger:
    """Make a run again without the loops that are chosen from its ledger and from those that are undone."""
    without(loops_of_run(folder), [])  # a folder that is no run is not locked, nor made
    with lock_folder(folder):  # from the look at the ledger on
        undone = without(loops_of_run(folder), removed_loops_of_run(folder))
        rerun_without_loops(folder, sorted(undone, key=lambda x: x.loop), progress=progress)
    return loops_of_run(folder)
