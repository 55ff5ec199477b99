"""Solve alternative graphs of a finished run and keep the map of lowest entropy.

The alternatives are topologies of its SegMap, or choices of its matches and loops
(:mod:`graphslam.backend.hypotheses`); :mod:`graphslam.maps.alternatives` ranks them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from graphslam.app.folders.generations import check_same, read_consistently
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.config import RunConfig
from graphslam.app.run.control import control_facts, control_findings, left_out_of_refinement
from graphslam.app.run.files import read_options
from graphslam.app.run.front_ends import make_front_end
from graphslam.app.run.maps import sensor_reach
from graphslam.app.run.options import RunOptions
from graphslam.app.run.run import Run
from graphslam.app.run.run_inputs import RunInputs, read_inputs
from graphslam.app.run.source import log_of_run
from graphslam.backend.back_end import find_config
from graphslam.backend.config import BackEndConfig
from graphslam.backend.hypotheses import LOOP, choices_of_matches, hypotheses_of, solve_choice, solve_hypotheses
from graphslam.backend.refining import RefinedRun, refine_run
from graphslam.backend.streams import ImuSource
from graphslam.core.errors import ConfigError, MissingDataError, RunFolderError
from graphslam.core.findings import Finding
from graphslam.core.imu import Imu
from graphslam.core.log import SensorLog
from graphslam.core.progress import Bar
from graphslam.core.random import SeedTree
from graphslam.core.record_source import RecordSource
from graphslam.core.submap import Submap
from graphslam.evaluate.check_points import check_points
from graphslam.evidence.formats import load_npz
from graphslam.graph.network import to_network
from graphslam.io.g2o import write_g2o
from graphslam.io.submap_store import read_submaps
from graphslam.io.tum import write_tum
from graphslam.loops.candidates import FRONT_END
from graphslam.loops.ledger import ledger_of_events
from graphslam.maps.alternatives import Alternative, RankedAlternatives, rank_alternatives
from graphslam.maps.export import save_maps
from graphslam.maps.global_map import make_global_map
from graphslam.maps.minimum_entropy import MapHypothesis
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.refined import map_of_frames
from graphslam.maps.run_map import REACH_MARGIN, RunMap, make_run_map, solved_poses
from graphslam_frontends.segslam.front_end import SegSlam

logger = logging.getLogger(__name__)
MOST = 16
"""Largest number of choices of matches and loops that are solved."""


@dataclass(frozen=True)
class MinimumEntropyMap:
    """Ranked alternative graphs of a run.

    Parameters
    ----------
    choice : RankedAlternatives
        The chosen one first.
    left_out : int
        Number of alternatives that were not solved.
    refined : RefinedRun or None
        The chosen one refined with its scans; None if the run is not refined, or the refinement was rejected.
    refined_map : RunMap or None
        Its fused map.
    findings : list of Finding
        Of the refinement, control points and check points.
    """

    choice: RankedAlternatives
    left_out: int
    refined: RefinedRun | None = None
    refined_map: RunMap | None = None
    findings: list[Finding] = field(default_factory=list)


def minimum_entropy_loops(run: Run, made: RunMap, *, progress: bool = True) -> MinimumEntropyMap:
    """Solve a finished run with different choices of its matches and loops, and rank the graphs and their maps.

    SegSLAM chooses the map sample of lowest entropy. A run outputs only one chain of segments, with matches that have a
    support (the share of particles that use them), and a ledger of loops; the choices are subsets of these.

    Parameters
    ----------
    run : Run
        Read with its grids (`remake_map.map_of_folder`).
    made : RunMap
        Its fused map. For a refined run the graphs are compared by their maps before the refinement.
    progress : bool
        Show a progress bar.
    """
    config, streams = _graph_options(run)
    if run.folder is not None and any(s.report.get("refined") for s in run.submaps):
        folder = run.folder
        run = replace(run, submaps=read_submaps(folder, load_grid=load_npz))
        made = make_run_map(run.submaps, run.map, reach=sensor_reach(read_options(folder)))
    ledger = ledger_of_events(run.events).current()
    loops = [d for d in ledger if d.verdict == "accepted" and d.source != FRONT_END and d.T_ij]
    decided = [d for d in ledger if d.verdict == "accepted" and d.source == FRONT_END and d.T_ij]
    undone = frozenset((d.submap_j, d.submap_i) for d in ledger if d.verdict != "accepted" and d.source == FRONT_END)
    every = choices_of_matches(run.submaps, config.match_support, loops=loops, undone=undone)
    choices = dict(list(every.items())[:MOST])
    if len(every) > MOST:
        logger.warning("solved %d of %d choices of matches and loop closures", MOST, len(every))
    alternatives = []
    for name, chosen in Bar(choices.items(), name="choices", unit="graph", shown=progress):
        back = solve_choice(run.submaps, chosen, config, loops=loops, decided=decided, **streams())
        solution = back.finish()
        ends = [*solution.base_nodes.tolist(), int(solution.exit_nodes[-1])]
        nodes = {s.key: (solution.node_times[a:b], solution.poses[a:b]) for s, a, b in zip(run.submaps, ends, ends[1:])}
        candidate = MapHypothesis(made.divided.pieces, solved_poses(made.divided, nodes), name)
        loop_count = sum(key == LOOP for key, _ in chosen)
        facts = {"matches": len(chosen) - loop_count, "loops": loop_count}
        alternatives.append(Alternative(name, back.graph, solution, candidate, facts))
    choice = rank_alternatives(alternatives, model=made.fused.grid.model, progress=progress)
    return _finished(run, MinimumEntropyMap(choice, len(every) - len(choices)), run.submaps)


def minimum_entropy_topology(
    run: Run, most: int, *, log: str | Path | SensorLog | None = None, progress: bool = True
) -> MinimumEntropyMap:
    """Solve the topologies in the particles of a SegSLAM run, and rank the graphs and their maps.

    The folder has only one chain of segments. The other chains are in the particles, so the front end processes the log
    once more with the configuration of the folder: the same seed gives the same particles.

    Parameters
    ----------
    run : Run
        Of the front end ``segslam``, with its folder.
    most : int
        Largest number of topologies to solve: by weight, then the first one without each of its entries into older
        maps.
    log : data set name, folder, or SensorLog; optional
        Where the run's log is now; default: its original location.
    progress : bool
        Show a progress bar.
    """
    if run.folder is None:
        raise RunFolderError("the run has no folder to read its configuration from; wanted a run with out=…")
    values = read_options(run.folder)
    settings = values["run"]
    if settings["frontend"] != SegSlam.name:
        raise ConfigError(f"front end {settings['frontend']!r} tells one topology; only {SegSlam.name!r} tells several")
    source = log_of_run(settings, log)
    front: Any = make_front_end(SegSlam.name, values["frontend"])
    config, streams = _graph_options(run)
    reach = sensor_reach(values)
    with Bar(name="particles", unit="step", shown=progress) as bar:

        def watch(at: Any) -> None:
            bar.total = at.steps
            bar.update(at.step - bar.n)

        result = front.result(source, seed=SeedTree(settings["seed"]).child("frontend"), watch=watch)
    topologies, left_out = hypotheses_of(result, most, drift=front.config.drift, handover=front.config.segslam.handover)
    alternatives = solve_hypotheses(
        topologies,
        config,
        find=find_config(config),
        division=None if reach is None else DivisionConfig(reach=reach + REACH_MARGIN),
        streams=streams,
        progress=progress,
    )
    model = next(iter(topologies[0].grids.values())).model
    found = MinimumEntropyMap(rank_alternatives(alternatives, model=model, progress=progress), left_out)
    return _finished(run, found, topologies[found.choice.best.number].submaps)


def _finished(run: Run, found: MinimumEntropyMap, submaps: Sequence[Submap]) -> MinimumEntropyMap:
    """Refine the chosen alternative and compare it with check points; both have no influence on the choice."""
    if run.folder is None:
        return found
    options = RunOptions.of_folder(run.folder)
    found = _refined(run, options, found, submaps)
    graph, r, findings = found.choice.best.alternative.graph, found.refined, list(found.findings)
    if (rows := options.table("control")) is not None:
        facts = control_facts(graph, rows)
        findings += control_findings({"control_points": facts})
        findings += [] if r is None else [left_out_of_refinement(0, facts["used"])]
    if (rows := options.table("check")) is not None:
        tested = check_points(graph, rows, None if r is None else (r.refinement, r.map.trajectory))
        findings += control_findings({"check_points": tested.facts()})
    return replace(found, findings=findings)


def _refined(run: Run, options: RunOptions, found: MinimumEntropyMap, submaps: Sequence[Submap]) -> MinimumEntropyMap:
    """The chosen alternative refined with the scans of the run, if the run is refined."""
    settings = options.settings
    scans = _inputs_of(run).scans if settings.refine.use else None
    if scans is None:
        return found
    solution = found.choice.best.alternative.solution
    solved = make_global_map(solution, list(submaps), {}, 1)
    gps = None
    if solution.T_gps_world is not None and run.fixes is not None:
        gps = (run.fixes, settings.gps)
    refined, findings = refine_run(settings.refine, scans, submaps, solved, gps=gps)
    if refined is None or not refined.submaps:
        return replace(found, refined=refined, findings=findings)
    reach = sensor_reach(options.as_config())
    made = make_run_map(refined.submaps, map_of_frames(refined.map), reach=reach, config=settings.map)
    return replace(found, refined=refined, refined_map=made, findings=findings)


def _inputs_of(run: Run) -> RunInputs:
    """The inputs stored in the folder of a run."""
    assert run.folder is not None
    inputs, generation = read_consistently(run.folder, read_inputs)
    check_same((run.folder / "run.json", run.report.get("generation")), (run.folder / "inputs.npz", generation))
    return inputs


def _graph_options(run: Run) -> tuple[BackEndConfig, Callable[[], dict[str, Any]]]:
    """Back-end options of a run, and a function that makes the GPS, IMU and control inputs of a new graph."""
    options = None if run.folder is None else RunOptions.of_folder(run.folder)
    settings = RunConfig() if options is None else options.settings
    if settings.gps.use != "none" and run.fixes is None:
        raise MissingDataError(
            f"{run.folder}: the graph of this run has GPS factors, but its fixes are not in the folder",
            wanted="fixes.npz, or a run with gps.use = none",
        )
    if options is None and "control_points" in run.report:
        raise MissingDataError("only its folder holds the control points of a run", wanted="a run with out=…")
    feed = RecordSource(_inputs_of(run).log) if settings.imu.use != "none" and options is not None else None
    control = None if options is None else options.table("control")

    def streams() -> dict[str, Any]:
        source = ImuSource(feed, settings.imu) if feed and feed.names(Imu) else None
        return {"fixes": run.fixes, "gps": settings.gps, "imu": source, "control": control}

    return settings.backend, streams


def write_minimum_entropy(
    folder: Path, found: MinimumEntropyMap, *, bands: Mapping[str, tuple[float, float]] | None = None
) -> list[Path]:
    """Write the alternatives into a run folder.

    The chosen map and its path are ``clearest.ply``, ``clearest.tum`` and so on, refined with the scans if the run is.
    For every alternative, ``alternatives/NN.tum`` has the path of its graph and ``NN.g2o`` the graph, in the order of
    ``clearest.json``.

    Parameters
    ----------
    bands : mapping, optional
        Heights of floor plans [m].
    """
    choice, refined = found.choice, found.refined
    drawn = choice.best_map if found.refined_map is None else found.refined_map.fused
    made = save_maps(drawn.grid, folder, name="clearest", bands=bands)
    kept = folder / "alternatives"
    kept.mkdir(exist_ok=True)
    for old in (*kept.glob("[0-9]*.tum"), *kept.glob("[0-9]*.g2o")):
        old.unlink()
    table = []
    for k, (row, j) in enumerate(zip(choice.rows(), choice.order, strict=True)):
        path = j.alternative.solution.trajectory(covariances=False)
        if k == 0:
            write_tum(folder / "clearest.tum", path if refined is None else refined.map.trajectory)
        files = [f"alternatives/{k:02d}.tum", f"alternatives/{k:02d}.g2o"]
        write_tum(folder / files[0], path)
        write_g2o(folder / files[1], to_network(j.alternative.graph))
        table.append({**row, "files": files})
    value = {"why": choice.why(), "scale": choice.scale, "left_out": found.left_out, "candidates": table}
    if found.refined_map is not None:
        value["refined_entropy"] = found.refined_map.fused.entropy()
    if found.findings:
        value["findings"] = [f.as_row() for f in found.findings]
    OutputFiles(folder).write_json("clearest.json", {"format": "graphslam.clearest/1", **value})
    return [*made, folder / "clearest.tum", folder / "clearest.json"]
