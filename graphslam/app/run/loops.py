"""Remove loops from a finished run, or restore them; the run is solved again from the data in its folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from graphslam.app.run.files import loops_of_run, removed_loops_of_run
from graphslam.app.run.reopened import rerun_without_loops
from graphslam.core.errors import DataError
from graphslam.core.lock import lock_folder
from graphslam.loops.candidates import FRONT_END
from graphslam.loops.ledger import LoopDecision, LoopLedger
from graphslam.loops.overlap_constraints import overlap_entries


def undo_loop(folder: str | Path, loop: int, *, progress: bool = True) -> LoopLedger:
    """Remove a loop from a finished run. Its graph is built from the folder and solved without the loop.

    All files are written anew. Loops that were undone before stay undone, and so does this one if the run is resumed;
    :func:`redo_loop` restores it. Other loops that were found while this loop was in the graph stay, too.

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
    """Restore a loop that :func:`undo_loop` removed; a match with its overlap constraints. Others stay undone.

    Parameters and errors are those of :func:`undo_loop`.
    """

    def without(before: LoopLedger, undone: list[LoopDecision]) -> list[LoopDecision]:
        d = before.of(loop)
        if d.verdict != "undone":
            raise DataError(f"loop {loop} was not undone", where=str(folder), got=d.verdict, wanted="an undone loop")
        entry = (d.submap_i, d.submap_j)
        left = [x for x in undone if x.loop != loop]
        return [x for x in left if entry not in overlap_entries(x.gates)] if d.source == FRONT_END else left

    return _again(folder, without, progress)


def _again(
    folder: str | Path, without: Callable[[LoopLedger, list[LoopDecision]], list[LoopDecision]], progress: bool
) -> LoopLedger:
    """Run again without the loops that ``without`` selects from the ledger and the undone loops."""
    without(loops_of_run(folder), [])  # checks first, so that a folder that is not a run is neither locked nor created
    with lock_folder(folder):  # before the ledger is read again
        undone = without(loops_of_run(folder), removed_loops_of_run(folder))
        rerun_without_loops(folder, sorted(undone, key=lambda x: x.loop), progress=progress)
    return loops_of_run(folder)
