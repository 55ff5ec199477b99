"""Loops between submaps in simulated worlds: matched, decided on, with wrong ones among them, and recognised by sight.

    python -m tests.benchmarks.bench_loops [WORLD:SEED ...] [--wrong N] [--first SEED] [--appearance] [--cache FOLDER]

SegSLAM with 5 particles that never looks back makes submaps with grids, whose paths drift as far as the world is long.
Per world: candidates by proximity; of those that the gates accept, how many are right (within 0.8 m and 0.1 rad of the
truth), their error and NEES; loops taken; ATE (aligned) and NEES of all places before and after. ``--wrong N``: the
measured right loops with wrong ones among them, N seeds of each kind and share. ``--appearance``: how often the place
of an earlier visit is among the k most alike, and what of the candidates by appearance is right. A garage takes half a
minute, building and mine some minutes.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphslam.core import se3
from graphslam.core.atomic import read_npz, write_npz
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.evidence.formats import load_npz
from graphslam.evidence.views import dense_view
from graphslam.io.submap_store import read_submaps, write_submaps
from graphslam.loops.appearance import AppearanceConfig, appearance_candidates
from graphslam.loops.candidates import CandidateConfig, proximity_candidates
from graphslam.loops.loops import LoopCloser
from graphslam.loops.map_overlap_test import MapCheck
from graphslam.loops.measure import Loop, LoopMeasurer
from graphslam.loops.places import Places
from graphslam.registration.place_descriptor import concatenate_descriptors, describe_places, descriptor_similarity
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_frontends.segslam.submaps import common_ancestor_chain, drift_by_path, submaps_of_segments
from graphslam_studies import segslam_building, segslam_garage, segslam_mine
from graphslam_studies.segslam_trial import GridTrial
from tests.reference.chain_poses import ChainRelativePoses
from tests.reference.loop_network import LoopNetwork
from tests.reference.loop_places import loop_places
from tests.reference.wrong_submap_loops import KINDS, inject_wrong_loops

WORLDS = {**segslam_garage.WORLDS, **segslam_mine.WORLDS, **segslam_building.WORLDS}
DEFAULT = ("garage-A:1", "garage-B:1", "garage-C:1", "garage-D:1", "building:1", "mine:1")
FORMAT = "graphslam.bench-loops/1"


def submaps_of(world: str, seed: int, cache: Path | None) -> tuple[list[Submap], Array, Array]:
    """Submaps, and times and true poses of the steps; read back where they were made before."""
    folder = None if cache is None else cache / f"{world}-{seed}"
    if folder is not None and (folder / "truth_path.npz").is_file():
        a = read_npz(folder / "truth_path.npz", fmt=FORMAT)
        return read_submaps(folder, load_grid=load_npz), a["times"], a["poses"]
    config = WORLDS[world]
    trial = GridTrial(config, seed)
    blind = replace(config.segslam, winnowing=replace(config.segslam.winnowing, gap=1e9))
    filter = replace(config.segslam_filter, particles=5)
    segmap = run_segslam(trial.steps, filter, blind, SeedTree(seed).child("filter", "segslam")).segmap
    last = int(segmap.alive[np.argmax(segmap.table.end[segmap.alive])])
    chain = common_ancestor_chain(segmap, last)
    submaps = submaps_of_segments(segmap, chain, drift_by_path(segmap, chain, FilterDrift()), blind.handover)
    if folder is not None:
        write_submaps(folder, submaps)
        arrays = {"format": FORMAT, "times": trial.steps.times, "poses": trial.truth}
        write_npz(folder / "truth_path.npz", arrays)
    return submaps, trial.steps.times, trial.truth


def true_places(submaps: list[Submap], places: Places, times: Array, truth: Array) -> Array:
    """True poses of places ``(n, 7)``: of the body then, and from there to the place as the submap has it."""
    out = np.empty((len(places), 7))
    for k, s in enumerate(submaps):
        at = places.of_submap(k)
        assert s.trajectory is not None
        body = s.trajectory.interpolate(places.time[at])
        step = np.searchsorted(times, places.time[at] - 1e-6)
        out[at] = se3.se3_compose(truth[step], se3.se3_between(body, places.T_base_node[at]))
    return out


def error_of(loop: Loop, truth: Array) -> Array:
    """Tangent of the error ``(6,)``."""
    return se3.se3_log(se3.se3_between(se3.se3_between(truth[loop.i], truth[loop.j]), loop.T_ij))


def is_right(loop: Loop, truth: Array) -> bool:
    e = error_of(loop, truth)
    return bool(np.linalg.norm(e[3:]) < 0.8 and np.linalg.norm(e[:3]) < 0.1)


def ate(poses: Array, truth: Array) -> float:
    """RMSE of positions after a rigid alignment [m]."""
    T, _ = se3.align_se3(poses[:, :3], truth[:, :3])
    moved = se3.se3_transform(np.broadcast_to(T, (len(poses), 7)), poses[:, :3])
    return float(np.sqrt(np.mean(np.sum((moved - truth[:, :3]) ** 2, axis=1))))


def nees(net: LoopNetwork, truth: Array) -> float:
    """Mean NEES per degree of freedom of all places seen from the first."""
    n = len(truth)
    wanted = se3.se3_between(np.broadcast_to(truth[0], truth.shape), truth)[1:]
    e = se3.se3_log(se3.se3_between(wanted, net.poses[1:n]))
    S = net.joint(np.arange(1, n))[np.arange(n - 1), :, np.arange(n - 1)]
    return float(np.mean(np.einsum("ki,kij,kj->k", e, np.linalg.inv(S), e)) / 6)


def closed(
    chain: ChainRelativePoses, loops: list[Loop], map_check: MapCheck | None = None
) -> tuple[LoopNetwork, LoopCloser]:
    net = LoopNetwork(chain.increments, chain.covariances)
    closer = LoopCloser(net, chain.increments, chain.covariances, map_check=map_check)
    closer.propose(loops)
    return net, closer


def wrong_table(chain: ChainRelativePoses, loops: list[Loop], truth: Array, seeds: range, map_check: MapCheck) -> None:
    """Precision and recall of decisions, and the ATE against that of the clean run."""
    clean = ate(closed(chain, loops, map_check)[0].poses[: len(truth)], truth)
    for kind in KINDS:
        for share in (0.1, 0.3, 0.5):
            counts, ratios = np.zeros((2, 2), int), []
            for seed in seeds:
                rng = SeedTree(seed).child("wrong", kind).generator()
                mixed, wrong = inject_wrong_loops(loops, truth, share, rng, kind=kind)
                net, closer = closed(chain, mixed, map_check)
                accepted = np.isin(np.arange(len(mixed)), closer.accepted)
                np.add.at(counts, (wrong.astype(int), accepted.astype(int)), 1)
                ratios.append(ate(net.poses[: len(truth)], truth) / clean)
            precision = counts[0, 1] / max(counts[:, 1].sum(), 1)
            print(
                f"    {kind:8} {share:.0%}: precision {precision:.3f}, recall {counts[0, 1] / counts[0].sum():.3f}, "
                f"wrong taken {counts[1, 1]} of {counts[1].sum()}, ATE / clean: median {np.median(ratios):.2f}, "
                f"max {max(ratios):.2f}"
            )


def appearance_table(submaps: list[Submap], places: Places, truth: Array) -> None:
    """Recall of descriptors at 1, 5, 10, 20, and precision of candidates."""
    begin = time.perf_counter()
    D = concatenate_descriptors(
        [describe_places(dense_view(s), places.T_base_node[places.of_submap(k)]) for k, s in enumerate(submaps)]
    )
    apart = np.linalg.norm(truth[:, None, :3] - truth[None, :, :3], axis=2)
    hits, visits = np.zeros(4), 0
    for j in range(len(places)):
        rows = np.flatnonzero((places.arc[j] - places.arc >= 30.0) & (places.submap != places.submap[j]))
        if not len(rows) or not np.any(apart[j, rows] < 3.0):
            continue
        visits += 1
        order = rows[np.argsort(-descriptor_similarity(D, j, D, rows)[0])]
        hits += [np.any(apart[j, order[:k]] < 4.0) for k in (1, 5, 10, 20)]
    seconds = time.perf_counter() - begin
    recall = ", ".join(f"{h / max(visits, 1):.2f}" for h in hits)
    print(f"    appearance: {visits} second visits, recall at 1, 5, 10, 20: {recall}; {seconds:.1f} s")
    for c in (AppearanceConfig(), AppearanceConfig(top=1, lead=0.1)):
        found = appearance_candidates(places, D, c)
        right = sum(apart[x.i, x.j] < 4.0 for x in found)
        print(f"    top {c.top}, lead {c.lead:g}: {len(found)} candidates, {right} right")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=DEFAULT, help=f"name:seed; names: {', '.join(WORLDS)}")
    parser.add_argument("--wrong", type=int, default=0, help="seeds of each kind and share of wrong loops")
    parser.add_argument("--first", type=int, default=0, help="the first of these seeds")
    parser.add_argument("--appearance", action="store_true")
    parser.add_argument("--cache", type=Path, help="folder for the submaps")
    parser.add_argument("--quick", action="store_true", help="one garage")
    args = parser.parse_args()
    for name in ["garage-A:3"] if args.quick else args.worlds:
        world, seed = name.split(":")
        submaps, times, path = submaps_of(world, int(seed), args.cache)
        places = loop_places(submaps)
        truth, chain = true_places(submaps, places, times, path), ChainRelativePoses(submaps, places)
        begin = time.perf_counter()
        config = CandidateConfig(height=2.0 if world == "mine" else 1.0)
        candidates = proximity_candidates(places, chain, config)
        measurer = LoopMeasurer(submaps, places)
        loops = [x for x in measurer.measure(candidates) if not x.why]
        matched = time.perf_counter()
        right = [x for x in loops if is_right(x, truth)]
        e = np.array([error_of(x, truth) for x in right]).reshape(-1, 6)
        own = [v @ np.linalg.solve(x.covariance, v) / 6 for v, x in zip(e, right)]
        net, closer = closed(chain, loops, measurer.contradictions)
        accepted = [is_right(closer.loops[n], truth) for n in closer.accepted]
        print(
            f"{name}: {len(places)} places, {len(submaps)} submaps, {len(candidates)} candidates; accepted by the "
            f"gates {len(loops)}, right {len(right)}; taken {len(accepted)}, right {sum(accepted)}; "
            f"{matched - begin:.1f} s to match, {time.perf_counter() - matched:.1f} s to decide"
        )
        if len(e):
            print(
                f"    errors of right ones: median {np.median(np.linalg.norm(e[:, 3:], axis=1)):.2f} m, "
                f"{np.median(np.linalg.norm(e[:, :3], axis=1)):.3f} rad; NEES/6 mean {np.mean(own):.2f}"
            )
        n = len(truth)
        print(
            f"    ATE {ate(chain.poses[:n], truth):.2f} → {ate(net.poses[:n], truth):.2f} m; NEES/6 of places "
            f"{nees(LoopNetwork(chain.increments, chain.covariances), truth):.2f} → {nees(net, truth):.2f}"
        )
        if args.wrong and right:
            seeds = range(args.first, args.first + args.wrong)
            wrong_table(chain, right, truth, seeds, measurer.contradictions)
        if args.appearance:
            appearance_table(submaps, places, truth)


if __name__ == "__main__":
    main()
