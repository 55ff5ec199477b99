"""Other graphs of a finished run: each choice of its matches and loops is solved, and the clearest map found.

SegSLAM draws map samples and takes the one of least entropy. A run hands over one settled chain, whose matches carry
the share of the particles that took them, and a ledger of loops; which of them to believe is what is left to choose.
How the graphs are judged is said in :mod:`graphslam.app.hypotheses.alternatives`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from graphslam.app.folders.generations import check_same, consistent
from graphslam.app.hypotheses.alternatives import Alternative, Choice, built, choose, write_choice
from graphslam.app.run.files import read_options
from graphslam.app.run.maps import RunMap, solved_poses
from graphslam.app.run.run import Run
from graphslam.app.run.taken import read_taken
from graphslam.backend.back_end import BackEnd
from graphslam.backend.config import BackEndConfig, GpsOptions, ImuOptions
from graphslam.backend.streams import ImuPart, imus_of
from graphslam.core.config import build
from graphslam.core.errors import MissingDataError
from graphslam.core.imu import Imu
from graphslam.core.records import Gps
from graphslam.core.submap import Match, Submap
from graphslam.loops.candidates import FRONT_END, TIE
from graphslam.loops.graph_loops import GraphLoops
from graphslam.loops.ledger import Decision, ledger_of_events
from graphslam.loops.measure import Loop
from graphslam.loops.rules import LoopConfig
from graphslam.loops.ties import ties_entries
from graphslam.maps.minimum_entropy import Candidate
from graphslam.solve.solution import Solution

logger = logging.getLogger(__name__)
MOST = 16
"""Choices that are solved at most."""
LOOP = -1
"""In place of the key of a submap: what follows is the number of a loop."""
Chosen = frozenset[tuple[int, int]]
"""Matches as (key of the submap, place among its matches), loops that were looked for as (LOOP, number)."""


@dataclass(frozen=True)
class Clearest:
    """Choices of matches and loops, judged.

    Parameters
    ----------
    choice : Choice
    choices : dict of str to Chosen
        What each of them holds.
    left_out : int
        Choices beyond the number that is solved.
    """

    choice: Choice
    choices: Mapping[str, Chosen]
    left_out: int

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The table of candidates, the chosen one first, with what each holds."""
        out = []
        for row in self.choice.rows():
            chosen = self.choices[row["choice"]]
            loops = sum(key == LOOP for key, _ in chosen)
            row |= {"matches": len(chosen) - loops, "loops": loops}
            out.append(row)
        return out


def choices_of_matches(
    submaps: Sequence[Submap],
    support: float,
    *,
    loops: Sequence[Decision] = (),
    undone: frozenset[tuple[int, int]] = frozenset(),
) -> dict[str, Chosen]:
    """Choices by name: the run's own, every threshold of support, and the run's own less each match and loop.

    Parameters
    ----------
    submaps : sequence of Submap
    support : float
        The run's own threshold (``backend.match_support``).
    loops : sequence of Decision
        Loops of the run's ledger that are in its graph and no matches of the front end.
    undone : frozenset of (int, int)
        Matches that are not in the run's graph, refused or taken out by hand: keys of the submap and of the one it
        entered.
    """
    every = {(s.key, i): m for s in submaps for i, m in enumerate(s.matches)}
    found_loops: Chosen = frozenset((LOOP, d.loop) for d in loops)
    taken: Chosen = frozenset(k for k, m in every.items() if m.support >= support and (k[0], m.target) not in undone)
    own = taken | found_loops
    found: dict[str, Chosen] = {"as the run": own, "no match or loop" if loops else "no match": frozenset()}
    found["matches alone"] = taken
    for least in sorted({m.support for m in every.values()}, reverse=True):
        at_least: Chosen = frozenset(k for k, m in every.items() if m.support >= least)
        found[f"support ≥ {least:.2g}"] = at_least | found_loops
    for key, i in sorted(taken):
        found[f"without {key} → {every[key, i].target}"] = own - {(key, i)}
    alone = [d for d in loops if d.source != TIE]
    for d in sorted(alone, key=lambda x: -x.chi2 if math.isfinite(x.chi2) else 0.0):  # the most doubtful first
        found[f"without loop {d.loop} ({d.submap_j} → {d.submap_i})"] = own - {(LOOP, d.loop)}
    needs = {(LOOP, d.loop): ties_entries(d.gates) for d in loops}
    out: dict[str, Chosen] = {}
    for name, chosen in found.items():
        entries = {(every[k].target, k[0]) for k in chosen if k in every}
        kept = frozenset(k for k in chosen if needs.get(k, set()) <= entries)  # a tie goes with its match
        if kept not in out.values():
            out[name] = kept
    return out


def solve_choice(
    submaps: Sequence[Submap],
    chosen: Chosen,
    config: BackEndConfig,
    *,
    loops: Sequence[Decision] = (),
    decided: Sequence[Decision] = (),
    fixes: Gps | None = None,
    gps: GpsOptions | None = None,
    imu: ImuPart | None = None,
) -> BackEnd:
    """The graph of submaps with some of their matches and loops, solved to its optimum.

    Parameters
    ----------
    submaps : sequence of Submap
    chosen : Chosen
    config : BackEndConfig
        The run's.
    loops : sequence of Decision
        With their measurements; those that are chosen become factors as they were in the run.
    decided : sequence of Decision
        Matches that the run decided on with its loops: in the graph as loops are, where they are chosen.
    fixes, gps, imu
        See :func:`graphslam.app.hypotheses.alternatives.built`.
    """
    bare = []
    # two matches of one pair of submaps are told apart by their support
    as_loops = {(d.submap_j, d.submap_i, round(d.score, 9)): d for d in decided}
    taken = [d for d in loops if (LOOP, d.loop) in chosen]
    for s in submaps:
        kept: list[Match] = []
        for m in (m for i, m in enumerate(s.matches) if (s.key, i) in chosen):
            loop = as_loops.get((s.key, m.target, round(m.support, 9)))
            if loop is None:
                kept.append(m)
            else:
                taken.append(loop)
        bare.append(replace(s, matches=tuple(kept), grid=None))
    back = built(bare, replace(config, match_support=0.0, loops=False), fixes=fixes, gps=gps, imu=imu)
    back.solver.solve_to_optimum()
    if taken:
        graph = GraphLoops(back.graph, back.solver)
        for d in taken:
            C = np.array(d.covariance)
            measured = Loop(i=d.i, j=d.j, T_ij=np.array(d.T_ij), covariance=C, source=d.source)
            graph.add_loop(measured, LoopConfig().robust(len(C)))
    return back


def clearest_of_run(run: Run, made: RunMap, *, progress: bool = True) -> Clearest:
    """Solve a finished run with every choice of its matches and loops, and judge the graphs and their maps.

    Parameters
    ----------
    run : Run
        Read back with its grids (`remake_map.map_of_folder`).
    made : RunMap
        Its fused map.
    progress : bool
        Show a progress bar.

    Raises
    ------
    MissingDataError
        The graph of the run held GPS or an IMU, whose records are not in its folder: an older version wrote it.
    """
    values: Mapping[str, Any] = read_options(run.folder) if run.folder is not None else {}
    gps: GpsOptions = build(GpsOptions, values.get("gps", {}), "gps")
    if gps.use != "none" and run.fixes is None:
        raise MissingDataError(
            f"{run.folder}: the graph of this run holds GPS, and its fixes are not in the folder",
            wanted="fixes.npz, or a run with gps.use = none",
        )
    imu: ImuOptions = build(ImuOptions, values.get("imu", {}), "imu")
    imus: dict[str, Imu] = {}
    if imu.use != "none" and run.folder is not None:
        taken, generation = consistent(run.folder, read_taken)
        check_same((run.folder / "run.json", run.report.get("generation")), (run.folder / "taken.npz", generation))
        imus = imus_of(taken.log)
    config: BackEndConfig = build(BackEndConfig, values.get("backend", {}), "backend")
    ledger = ledger_of_events(run.events).current()
    loops = [d for d in ledger if d.verdict == "accepted" and d.source != FRONT_END and d.T_ij]
    decided = [d for d in ledger if d.verdict == "accepted" and d.source == FRONT_END and d.T_ij]
    undone = frozenset((d.submap_j, d.submap_i) for d in ledger if d.verdict != "accepted" and d.source == FRONT_END)
    every = choices_of_matches(run.submaps, config.match_support, loops=loops, undone=undone)
    choices = dict(list(every.items())[:MOST])
    if len(every) > MOST:
        logger.warning("%d of %d choices of matches and loops are solved", MOST, len(every))
    alternatives = []
    for name, chosen in tqdm(choices.items(), desc="choices", unit="graph", disable=not progress):
        part = ImuPart(imus, imu) if imus else None
        back = solve_choice(
            run.submaps, chosen, config, loops=loops, decided=decided, fixes=run.fixes, gps=gps, imu=part
        )
        solution = back.finish()
        poses = solved_poses(made.divided, _nodes(run, solution))
        alternatives.append(Alternative(name, back.graph, solution, Candidate(made.divided.pieces, poses, name)))
    choice = choose(alternatives, model=made.fused.grid.model, progress=progress)
    return Clearest(choice, choices, len(every) - len(choices))


def write_clearest(
    folder: Path, found: Clearest, *, bands: Mapping[str, tuple[float, float]] | None = None
) -> list[Path]:
    """Keep the clearest map and the runners-up in the folder (:func:`write_choice`)."""
    return write_choice(folder, found.choice, found.rows, left_out=found.left_out, bands=bands)


def _nodes(run: Run, solution: Solution) -> Any:
    """Nodes by submap of another solution of the same submaps."""
    ends = [*solution.base_nodes.tolist(), int(solution.exit_nodes[-1])]
    return {s.key: (solution.node_times[a:b], solution.poses[a:b]) for s, a, b in zip(run.submaps, ends, ends[1:])}
