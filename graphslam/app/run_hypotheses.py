"""Other graphs of the same submaps: each choice of matches is solved, and the clearest fused map found.

SegSLAM draws map samples and takes the one of least entropy. A run hands over one settled chain, whose matches carry
the share of the particles that took them; which of them to believe is what is left to choose. Each choice is optimised
*before* its entropy is taken: an unsolved sample is blurred by errors that the graph would have removed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from graphslam.app import config as cfg
from graphslam.app.back_end import BackEnd
from graphslam.app.run import Run
from graphslam.app.run_folder import RunFolder
from graphslam.app.run_maps import RunMap, folder_options, solved_poses
from graphslam.core.errors import MissingDataError
from graphslam.core.submap import Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.io.tum import write_tum
from graphslam.maps.export import save_maps
from graphslam.maps.minimum_entropy import Candidate, Ranking, rank_by_entropy
from graphslam.solve.solution import Solution

MOST = 16
"""Choices of matches that are solved at most."""
Chosen = frozenset[tuple[int, int]]
"""Matches as (key of the submap, place among its matches)."""


@dataclass(frozen=True)
class Clearest:
    """Choices of matches in the order of the entropy of their maps.

    Parameters
    ----------
    rows : list of dict
        ``choice``, ``matches``, ``entropy`` [nat m³], ``known_volume`` [m³], ``objective``; the clearest first.
    ranking : Ranking
    trajectory : Trajectory
        Of the clearest.
    """

    rows: list[dict[str, Any]]
    ranking: Ranking
    trajectory: Trajectory


def choices_of_matches(submaps: Sequence[Submap], support: float) -> dict[str, Chosen]:
    """Choices by name: the run's own, every threshold of support, and the run's own less each of its matches.

    Parameters
    ----------
    submaps : sequence of Submap
    support : float
        The run's own threshold (``backend.match_support``).
    """
    every = {(s.key, i): m for s in submaps for i, m in enumerate(s.matches)}
    own: Chosen = frozenset(k for k, m in every.items() if m.support >= support)
    found: dict[str, Chosen] = {"as the run": own, "no match": frozenset()}
    for least in sorted({m.support for m in every.values()}, reverse=True):
        found[f"support ≥ {least:.2g}"] = frozenset(k for k, m in every.items() if m.support >= least)
    for key, i in sorted(own):
        found[f"without {key} → {every[key, i].target}"] = own - {(key, i)}
    out: dict[str, Chosen] = {}
    for name, chosen in found.items():
        if chosen not in out.values():
            out[name] = chosen
    return dict(list(out.items())[:MOST])


def solve_choice(submaps: Sequence[Submap], chosen: Chosen, config: cfg.BackEndConfig) -> Solution:
    """The graph of submaps with some of their matches, solved to its optimum."""
    back = BackEnd(replace(config, match_support=0.0), "batch")
    for s in submaps:
        kept: tuple[Match, ...] = tuple(m for i, m in enumerate(s.matches) if (s.key, i) in chosen)
        back.append(replace(s, matches=kept, grid=None))
        if len(back.graph.submaps) == 1:
            back.solver.update()
    return back.finish()


def clearest_of_run(run: Run, made: RunMap, *, progress: bool = True) -> Clearest:
    """Solve a finished run with every choice of matches, and put these in the order of their maps' entropy.

    Parameters
    ----------
    run : Run
        Read back with its grids (`run_maps.map_of_folder`).
    made : RunMap
        Its fused map.
    progress : bool
        Show a progress bar.

    Raises
    ------
    MissingDataError
        The graph of the run held GPS, whose fixes are not in its folder.
    """
    values: Mapping[str, Any] = folder_options(run.folder) if run.folder is not None else {}
    if values.get("gps", {}).get("use", "none") != "none":
        raise MissingDataError(
            f"{run.folder}: the graph of this run holds GPS, and its fixes are not in the folder",
            wanted="a run with gps.use = none",
        )
    config: cfg.BackEndConfig = cfg.build(cfg.BackEndConfig, values.get("backend", {}), "backend")
    choices = choices_of_matches(run.submaps, config.match_support)
    solved: dict[str, Solution] = {}
    for name, chosen in tqdm(choices.items(), desc="choices of matches", unit="graph", disable=not progress):
        solved[name] = solve_choice(run.submaps, chosen, config)
    divided = made.divided
    candidates = [Candidate(divided.pieces, solved_poses(divided, _nodes(run, s)), name) for name, s in solved.items()]
    ranking = rank_by_entropy(candidates, model=made.fused.grid.model, progress=progress)
    rows = [
        {
            "choice": r.name,
            "matches": len(choices[r.name]),
            "entropy": r.clarity.entropy,
            "known_volume": r.clarity.volume,
            "objective": solved[r.name].objective,
        }
        for r in ranking.order
    ]
    return Clearest(rows, ranking, solved[ranking.order[0].name].trajectory(covariances=False))


def write_clearest(
    folder: Path, found: Clearest, *, bands: Mapping[str, tuple[float, float]] | None = None
) -> list[Path]:
    """Write the clearest map and its path beside those of the run: ``clearest.ply``, ``clearest.tum`` and so on."""
    made = save_maps(found.ranking.best.grid, folder, name="clearest", bands=bands)
    write_tum(folder / "clearest.tum", found.trajectory)
    RunFolder(folder).write_json("clearest.json", {"format": "graphslam.clearest/1", "candidates": found.rows})
    return [*made, folder / "clearest.tum", folder / "clearest.json"]


def _nodes(run: Run, solution: Solution) -> Any:
    """Nodes by submap of another solution of the same submaps."""
    ends = [*solution.base_nodes.tolist(), int(solution.exit_nodes[-1])]
    return {s.key: (solution.node_times[a:b], solution.poses[a:b]) for s, a, b in zip(run.submaps, ends, ends[1:])}
