"""Other graphs of a finished run: topologies of its SegMap, or choices of its matches and loops; the clearest is kept.

Which graphs there are is said in :mod:`graphslam.backend.hypotheses`, how they are judged in
:mod:`graphslam.maps.alternatives`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from graphslam.app.folders.generations import check_same, consistent
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.files import read_options
from graphslam.app.run.front_ends import make_front_end
from graphslam.app.run.maps import sensor_reach
from graphslam.app.run.pipeline import load_log_source
from graphslam.app.run.run import Run
from graphslam.app.run.taken import read_taken
from graphslam.backend.back_end import find_config
from graphslam.backend.config import BackEndConfig, GpsOptions, ImuOptions
from graphslam.backend.hypotheses import LOOP, choices_of_matches, hypotheses_of, solve_choice, solve_hypotheses
from graphslam.backend.streams import ImuPart, imus_of
from graphslam.core.config import build
from graphslam.core.errors import ConfigError, DataError, MissingDataError, RunFolderError
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.frontends.segslam.front_end import SegSlam
from graphslam.graph.network import to_network
from graphslam.io.g2o import write_g2o
from graphslam.io.log_digest import log_digest
from graphslam.io.tum import write_tum
from graphslam.loops.candidates import FRONT_END
from graphslam.loops.ledger import ledger_of_events
from graphslam.maps.alternatives import Alternative, Choice, choose
from graphslam.maps.export import save_maps
from graphslam.maps.minimum_entropy import Candidate
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.run_map import REACH_MARGIN, RunMap, solved_poses

logger = logging.getLogger(__name__)
MOST = 16
"""Choices of matches and loops that are solved at most."""


@dataclass(frozen=True)
class Clearest:
    """Alternative graphs of a run, judged.

    Parameters
    ----------
    choice : Choice
        The chosen one first.
    left_out : int
        Alternatives that were not solved.
    """

    choice: Choice
    left_out: int


def clearest_of_choices(run: Run, made: RunMap, *, progress: bool = True) -> Clearest:
    """Solve a finished run with every choice of its matches and loops, and judge the graphs and their maps.

    SegSLAM draws map samples and takes the one of least entropy. A run hands over one settled chain, whose matches
    carry the share of the particles that took them, and a ledger of loops; which of them to believe is what is left to
    choose.

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
    config, streams = _graph_options(run)
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
        back = solve_choice(run.submaps, chosen, config, loops=loops, decided=decided, **streams())
        solution = back.finish()
        ends = [*solution.base_nodes.tolist(), int(solution.exit_nodes[-1])]
        nodes = {s.key: (solution.node_times[a:b], solution.poses[a:b]) for s, a, b in zip(run.submaps, ends, ends[1:])}
        candidate = Candidate(made.divided.pieces, solved_poses(made.divided, nodes), name)
        taken = sum(key == LOOP for key, _ in chosen)
        facts = {"matches": len(chosen) - taken, "loops": taken}
        alternatives.append(Alternative(name, back.graph, solution, candidate, facts))
    choice = choose(alternatives, model=made.fused.grid.model, progress=progress)
    return Clearest(choice, len(every) - len(choices))


def clearest_of_topologies(
    run: Run, most: int, *, log: str | Path | SensorLog | None = None, progress: bool = True
) -> Clearest:
    """Solve the topologies that the particles of a SegSLAM run told, and judge the graphs and their maps.

    The folder holds one chain of segments; the others are in the particles. So the front end works through the log once
    more, as the folder's configuration says: the same seed gives the same particles.

    Parameters
    ----------
    run : Run
        Of the front end ``segslam``, with its folder.
    most : int
        Topologies that are solved at most: by weight, then the first without each of its entries into older maps.
    log : card name, folder, or SensorLog; optional
        Where the run's log is by now; default where it was.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ConfigError
        A run of another front end, or ``most`` less than 1.
    DataError
        The log is not that of the run.
    MissingDataError
        No such log.
    """
    if run.folder is None:
        raise RunFolderError("the run has no folder to read its configuration from; wanted a run with out=…")
    values = read_options(run.folder)
    said = values["run"]
    if said["frontend"] != SegSlam.name:
        raise ConfigError(f"front end {said['frontend']!r} tells one topology; only {SegSlam.name!r} tells several")
    source = load_log_source(said["source"] if log is None else log)
    digest = log_digest(source)
    if said.get("log", digest) != digest:
        raise DataError("the log is not that of the run", where=source.name, got=digest, wanted=said["log"])
    front: Any = make_front_end(SegSlam.name, values["frontend"])
    config, streams = _graph_options(run)
    reach = sensor_reach(values)
    with tqdm(desc="particles", unit="step", disable=not progress) as bar:

        def watch(at: Any) -> None:
            bar.total = at.steps
            bar.update(at.step - bar.n)

        result = front.result(source, seed=SeedTree(said["seed"]).child("frontend"), watch=watch)
    told, left_out = hypotheses_of(result, most, drift=front.config.drift, handover=front.config.segslam.handover)
    alternatives = solve_hypotheses(
        told,
        config,
        find=find_config(config),
        division=None if reach is None else DivisionConfig(reach=reach + REACH_MARGIN),
        streams=streams,
        progress=progress,
    )
    model = next(iter(told[0].grids.values())).model
    return Clearest(choose(alternatives, model=model, progress=progress), left_out)


def _graph_options(run: Run) -> tuple[BackEndConfig, Callable[[], dict[str, Any]]]:
    """How the graph of a run was made, and what makes the GPS and IMU of one graph more, as `built` takes them."""
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

    def streams() -> dict[str, Any]:
        return {"fixes": run.fixes, "gps": gps, "imu": ImuPart(imus, imu) if imus else None}

    return build(BackEndConfig, values.get("backend", {}), "backend"), streams


def write_clearest(
    folder: Path, found: Clearest, *, bands: Mapping[str, tuple[float, float]] | None = None
) -> list[Path]:
    """Keep the alternatives in a run folder.

    The chosen map and its path are ``clearest.ply``, ``clearest.tum`` and so on; of every alternative
    ``alternatives/NN.tum`` has the path and ``NN.g2o`` the graph, in the order of ``clearest.json``.

    Parameters
    ----------
    folder : Path
    found : Clearest
    bands : mapping, optional
        Heights of floor plans [m].
    """
    choice = found.choice
    made = save_maps(choice.best_map.grid, folder, name="clearest", bands=bands)
    kept = folder / "alternatives"
    kept.mkdir(exist_ok=True)
    for old in (*kept.glob("[0-9]*.tum"), *kept.glob("[0-9]*.g2o")):
        old.unlink()
    table = []
    for k, (row, j) in enumerate(zip(choice.rows(), choice.order, strict=True)):
        path = j.alternative.solution.trajectory(covariances=False)
        if k == 0:
            write_tum(folder / "clearest.tum", path)
        files = [f"alternatives/{k:02d}.tum", f"alternatives/{k:02d}.g2o"]
        write_tum(folder / files[0], path)
        write_g2o(folder / files[1], to_network(j.alternative.graph))
        table.append({**row, "files": files})
    value = {"why": choice.why(), "scale": choice.scale, "left_out": found.left_out, "candidates": table}
    OutputFiles(folder).write_json("clearest.json", {"format": "graphslam.clearest/1", **value})
    return [*made, folder / "clearest.tum", folder / "clearest.json"]
