"""Several graphs of one log: if the fused map contradicts itself, loops are searched and submaps are sampled again."""

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
    """The run whose fused map has the fewest contradictions.

    If traversals in the map contradict each other, as after a divergence of the particles, the submaps are made again
    with another seed and the better map is kept. This is not done for a folder that already settled on a draw, or if
    loops were removed by hand.
    """
    found = _MapCandidates([] if slam.seed_choice is None else slam.seed_choice.attempts)
    front, folder, most = slam.options.front, slam.folder, slam.options.settings.backend.draws
    again = front is not None and front.draws and slam.seed_choice is None and not undo
    while True:
        for candidate in _solved(inputs, slam, clock, undo):
            found.add(candidate)
        if not (again and found.kept.contradicted and slam.draw + 1 < most):
            break
        logger.warning("overlapping submaps still contradict each other: making submaps again with another seed")
        slam = slam.next_draw()
    if front is not None and folder is not None and slam.seed_choice is None and slam.draw:
        folder.keep_draw(found.kept.draw, found.of_others(found.kept.draw))
    return found.result()


def _solved(
    inputs: RunInputs, slam: SubmapSlam, clock: RunClock, undo: Sequence[int | LoopDecision]
) -> Iterator[_MapCandidate]:
    """The graph of the submaps and, if its traversals contradict each other, a second one with searched loops.

    A missing loop and a wrong loop both show in the fused map: walls of one traversal are in space that another one
    observed to be free. So the first graph has only the front end's matches; loops of the back end are tried second.
    """
    run = run_of_solution(inputs, slam, slam.finish(undo), clock)
    first = _MapCandidate(run, slam.draw, slam.back.config.looks)
    yield first
    if slam.options.settings.backend.loops == "auto" and first.contradicted:
        logger.warning("overlapping submaps contradict each other: searching loop closures between submaps")
        other = slam.searching_loops()
        yield _MapCandidate(run_of_solution(inputs, other, other.finish(undo), clock), slam.draw, True)


@dataclass(frozen=True, slots=True)
class _MapCandidate:
    """One solved graph of a run.

    Parameters
    ----------
    draw : int
        Number of the random draw (seed) of its submaps; 0 is the first.
    loops : bool
        The back end searched for loops.
    """

    run: Run
    draw: int
    loops: bool

    @property
    def passes(self) -> Contradictions | None:
        """Contradictions between traversals in its fused map; None without a fused map."""
        return None if self.run.fused is None else self.run.fused.passes

    @property
    def contradicted(self) -> bool:
        """Do traversals in its map contradict each other?"""
        return self.passes is not None and self.passes.is_contradictory

    def beats(self, other: _MapCandidate) -> bool:
        """Are there fewer contradictions than in the other one? False if one of them has no fused map."""
        known = self.passes is not None and other.passes is not None
        return known and self.passes.agrees_better(other.passes)  # type: ignore[union-attr, arg-type]

    def row(self) -> dict[str, Any]:
        """JSON-serialisable row for the report."""
        facts = {"share": None} if self.passes is None else self.passes.facts()
        return {"draw": self.draw, "loops": self.loops, **facts}


class _MapCandidates:
    """Solved graphs of a run. Only the best one is kept; maps of the others take no memory.

    Parameters
    ----------
    earlier : sequence of dict
        Rows of draws that the folder rejected before.
    """

    def __init__(self, earlier: Sequence[Mapping[str, Any]] = ()) -> None:
        self.rows = [dict(r) for r in earlier]
        self.best: _MapCandidate | None = None

    @property
    def kept(self) -> _MapCandidate:
        """The best candidate so far; at least one was added."""
        assert self.best is not None
        return self.best

    def add(self, attempt: _MapCandidate) -> None:
        """Add a candidate; it is kept if it is better than the best one."""
        self.rows.append(attempt.row())
        if self.best is None or attempt.beats(self.best):
            self.best = attempt

    def of_others(self, draw: int) -> list[dict[str, Any]]:
        """Rows of all draws except this one."""
        return [r for r in self.rows if r["draw"] != draw]

    def result(self) -> Run:
        """The best run; its report and verdict list the other candidates."""
        best = self.kept
        if len(self.rows) < 2:
            return best.run
        rows = sorted(self.rows, key=lambda r: (r["draw"], r["loops"]))
        rows = [{**r, "kept": (r["draw"], r["loops"]) == (best.draw, best.loops)} for r in rows]
        report = {**best.run.report, "map_attempts": rows}
        figures = RunMetrics.of_rows(report, best.run.metric_rows, best.run.events)
        lines = run_findings(figures)
        report["verdict"] = verdict_json(summarise_run(figures, lines), lines)
        return replace(best.run, report=report)
