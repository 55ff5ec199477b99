"""The loops of a finished run, from its events: what was tried, what was believed, and why."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from graphslam.app.folders.generations import consistent, outputs
from graphslam.app.folders.lock import locked
from graphslam.app.run.files import read_events
from graphslam.core.errors import DataError
from graphslam.loops.candidates import FRONT_END
from graphslam.loops.ledger import Decision, LoopLedger
from graphslam.loops.ties import ties_entries

DECIDED = "decided on with all loops"
"""Why a factor of a front end's match is taken out where it is a loop among others from then on."""


def loops_of_run(folder: str | Path) -> LoopLedger:
    """Ledger of all loops of a run: those that were decided on, then the front end's matches that were not.

    Raises
    ------
    RunFolderError, DataError, FormatError
    """
    events = consistent(folder, lambda root: read_events(root, home=folder))
    return ledger_of_events(events, where=str(Path(folder) / "events.jsonl"))


def ledger_of_events(events: Sequence[Mapping[str, Any]], *, where: str = "events") -> LoopLedger:
    """Ledger of all loops in the events of a graph; see :func:`loops_of_run`."""
    ledger = LoopLedger.from_events(events, where=where)
    number = 1 + max((d.loop for d in ledger.decisions), default=-1)
    removed = {e.get("factor_id"): str(e.get("reason", "")) for e in events if e.get("event") == "removed"}
    for e in events:
        match = _match(e, number, removed)
        if match is not None:
            ledger.write(match)
            number += 1
    return ledger


def _match(e: Mapping[str, Any], number: int, removed: Mapping[Any, str]) -> Decision | None:
    """A front end's match that became a factor, or did not; None for other events."""
    taken = e.get("event") == "between" and e.get("group") == "match"
    if not taken and e.get("event") != "match-not-used":
        return None

    def figure(name: str) -> float:
        value = e.get(name)
        return math.nan if value is None else float(value)

    fid = int(e.get("factor_id", -1))
    gone = taken and fid in removed
    if gone and removed[fid] == DECIDED:
        return None  # it is among the loops
    support = figure("support")
    why = f"removed: {removed[fid]}" if gone else f"support {support:.2f}"
    return Decision(
        loop=number,
        verdict="undone" if gone else "accepted" if taken else "rejected",
        why=why if taken else f"{why} is too little",
        i=int(e.get("i", -1)),
        j=int(e.get("j", -1)),
        submap_i=int(e.get("target", -1)),
        submap_j=int(e.get("submap", -1)),
        source=FRONT_END,
        score=support,
        gates={"fitness": figure("fitness")},
        weight=math.nan if taken and not gone else 0.0,
        factor_id=-1 if gone or not taken else fid,
    )


def undone_of_run(folder: str | Path) -> list[Decision]:
    """Loops that were taken out of a finished run by hand; none where a run was not finished.

    Raises
    ------
    DataError, FormatError
        The folder's events are damaged.
    """
    if not (outputs(folder) / "events.jsonl").is_file():
        return []
    return [d for d in loops_of_run(folder).current() if d.verdict == "undone"]


def same_loop(d: Decision, ledger: LoopLedger) -> Decision | None:
    """The loop of another ledger that is in the graph, between the same nodes, and found the same way; or None.

    Numbers may differ where something else was tried in between; of several the one of that number is taken.
    """
    found = [x for x in ledger.current() if x.verdict == "accepted" and _identity(x) == _identity(d)]
    found.sort(key=lambda x: x.loop != d.loop)
    return found[0] if found else None


def _identity(d: Decision) -> tuple[str, int, int, int, int]:
    return d.source, d.submap_i, d.submap_j, d.i, d.j


def undo_loop(folder: str | Path, loop: int, *, progress: bool = True) -> LoopLedger:
    """Take a loop out of a finished run: its graph is made again from what the folder holds, solved without the loop,
    and everything in the folder is written anew.

    Loops that were undone before stay so, as this one does whenever the run is resumed (:func:`redo_loop` takes it in
    again). What was found with the loop in the graph stays too.

    Parameters
    ----------
    folder : path
    loop : int
        Number in the ledger.
    progress : bool

    Raises
    ------
    RunFolderError, DataError
        No run, or no loop of that number in its graph; or another process is writing into the folder.
    MissingDataError
        An older version wrote the folder, which does not hold what the graph was made of.
    """

    def without(before: LoopLedger, undone: list[Decision]) -> list[Decision]:
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

    def without(before: LoopLedger, undone: list[Decision]) -> list[Decision]:
        d = before.of(loop)
        if d.verdict != "undone":
            raise DataError(f"loop {loop} was not undone", where=str(folder), got=d.verdict, wanted="an undone loop")
        entry = (d.submap_i, d.submap_j)
        gone = [x for x in undone if x.loop != loop]
        return [x for x in gone if entry not in ties_entries(x.gates)] if d.source == FRONT_END else gone

    return _again(folder, without, progress)


def _again(
    folder: str | Path, without: Callable[[LoopLedger, list[Decision]], list[Decision]], progress: bool
) -> LoopLedger:
    """Make a run again without the loops that are chosen from its ledger and from those that are undone."""
    from graphslam.app.run.pipeline import again

    without(loops_of_run(folder), [])  # a folder that is no run is not locked, nor made
    with locked(folder):  # from the look at the ledger on
        undone = without(loops_of_run(folder), undone_of_run(folder))
        again(folder, sorted(undone, key=lambda x: x.loop), progress=progress)
    return loops_of_run(folder)
