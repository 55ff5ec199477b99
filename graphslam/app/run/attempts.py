"""Several graphs of one log: loops are looked for, and submaps drawn anew, where the fused map contradicts itself."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from graphslam.app.run.run import Run
from graphslam.app.run.run_inputs import RunInputs
from graphslam.app.run.stages import RunClock, run_of_solution
from graphslam.app.run.submap_slam import SubmapSlam
from graphslam.app.run.summary import summarise_run
from graphslam.app.verdict.checks import run_findings
from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.findings import verdict_json
from graphslam.loops.ledger import LoopDecision
from graphslam.maps.contradictions import Contradictions

logger = logging.getLogger(__name__)


def best_map(inputs: RunInputs, slam: SubmapSlam, clock: RunClock, undo: Sequence[int | LoopDecision] = ()) -> Run:
    """The run whose fused map contradicts itself least.

    Where the passes of its map contradict each other, as they do after particles diverged, particles are drawn again
    and the better map is kept. A folder that settled on a draw before, or of which loops were taken out by hand, keeps
    its own.
    """
    found = _MapCandidates([] if slam.settled is None else slam.settled.attempts)
    front, folder, most = slam.options.front, slam.folder, slam.options.settings.backend.draws
    again = front is not None and front.draws and slam.settled is None and not undo
    while True:
        for candidate in _solved(inputs, slam, clock, undo):
            found.add(candidate)
        if not (again and found.kept.denied and slam.draw + 1 < most):
            break
        logger.warning("overlapping submaps still contradict each other: making submaps again with another seed")
        slam = slam.next_draw()
    if front is not None and folder is not None and slam.settled is None and slam.draw:
        folder.settle(found.kept.draw, found.of_others(found.kept.draw))
    return found.result()


def _solved(
    inputs: RunInputs, slam: SubmapSlam, clock: RunClock, undo: Sequence[int | LoopDecision]
) -> Iterator[_MapCandidate]:
    """The graph of the submaps; where its passes contradict each other, a second one with loops.

    A graph without a loop and one with a wrong loop both show in the fused map: walls of one pass stand in what another
    one saw to be free. So the front end's matches alone are tried first, then loops that the back end looks for.
    """
    run = run_of_solution(inputs, slam, slam.finish(undo), clock)
    first = _MapCandidate(run, slam.draw, slam.back.config.looks)
    yield first
    if slam.options.settings.backend.loops == "auto" and first.denied:
        logger.warning("overlapping submaps contradict each other: searching loop closures between submaps")
        other = slam.searching_loops()
        yield _MapCandidate(run_of_solution(inputs, other, other.finish(undo), clock), slam.draw, True)


@dataclass(frozen=True, slots=True)
class _MapCandidate:
    """One graph that was solved for a run.

    Parameters
    ----------
    draw : int
        Of the random numbers its submaps were made of.
    loops : bool
        With loops that the back end looked for.
    """

    run: Run
    draw: int
    loops: bool

    @property
    def passes(self) -> Contradictions | None:
        """What the passes of its map say of each other; None where it has no fused map."""
        return None if self.run.fused is None else self.run.fused.passes

    @property
    def denied(self) -> bool:
        """Do passes of its map contradict each other?"""
        return self.passes is not None and self.passes.is_contradictory

    def beats(self, other: _MapCandidate) -> bool:
        """Do its passes contradict each other less?"""
        known = self.passes is not None and other.passes is not None
        return known and self.passes.agrees_better(other.passes)  # type: ignore[union-attr, arg-type]

    def row(self) -> dict[str, Any]:
        """What a report says of it, JSON-serialisable."""
        facts = {"share": None} if self.passes is None else self.passes.facts()
        return {"draw": self.draw, "loops": self.loops, **facts}


class _MapCandidates:
    """Graphs that were solved for a run, of which the best is kept; maps of the others take no memory.

    Parameters
    ----------
    earlier : sequence of dict
        Rows of draws that a folder settled on not to use.
    """

    def __init__(self, earlier: Sequence[Mapping[str, Any]] = ()) -> None:
        self.rows = [dict(r) for r in earlier]
        self.best: _MapCandidate | None = None

    @property
    def kept(self) -> _MapCandidate:
        """The best one so far; there is one at least."""
        assert self.best is not None
        return self.best

    def add(self, attempt: _MapCandidate) -> None:
        """One more."""
        self.rows.append(attempt.row())
        if self.best is None or attempt.beats(self.best):
            self.best = attempt

    def of_others(self, draw: int) -> list[dict[str, Any]]:
        """Rows of all draws but one."""
        return [r for r in self.rows if r["draw"] != draw]

    def result(self) -> Run:
        """The best run, with what became of the others in its report and verdict."""
        best = self.kept
        if len(self.rows) < 2:
            return best.run
        rows = sorted(self.rows, key=lambda r: (r["draw"], r["loops"]))
        rows = [{**r, "kept": (r["draw"], r["loops"]) == (best.draw, best.loops)} for r in rows]
        report = {**best.run.report, "map_attempts": rows}
        figures = RunMetrics.of_table(report, best.run.metrics, best.run.events)
        lines = run_findings(figures)
        report["verdict"] = verdict_json(summarise_run(figures, lines), lines)
        return replace(best.run, report=report)
