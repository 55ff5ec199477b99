"""Alternative graphs are judged by their own χ² first, then by the entropy of their maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.hypotheses import MinimumEntropyMap, write_minimum_entropy
from graphslam.backend.back_end import BackEnd
from graphslam.backend.config import BackEndConfig, GpsOptions
from graphslam.backend.hypotheses import LOOP, choices_of_matches, solve_choice
from graphslam.core.errors import DataError
from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.core.submap import Match, Submap
from graphslam.graph.ledger import EvidenceUse
from graphslam.graph.noise import RobustKernel
from graphslam.loops.ledger import LoopDecision, ledger_of_events
from graphslam.maps.alternatives import Alternative, chi2_of, noise_scale, rank_alternatives
from graphslam.maps.minimum_entropy import MapHypothesis
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.submaps import DividedSubmaps, divide_submaps
from tests.app.run.test_loops import there_and_back

OPTIONS = BackEndConfig()


@pytest.fixture(scope="module")
def run() -> tuple[list[Submap], BackEnd, list[LoopDecision], DividedSubmaps]:
    """Along a hall and back, its back end with the loops that it found, and the pieces of its map."""
    submaps, _ = there_and_back()
    back = BackEnd(BackEndConfig(loops=True), "batch")
    for s in submaps:
        back.add(s)
    back.finish()
    loops = [d for d in ledger_of_events(back.graph.events).current() if d.verdict == "accepted"]
    nodes = {s.key: np.asarray(s.times[:-1]) for s in back.graph.submaps}
    return submaps, back, loops, divide_submaps(submaps, config=DivisionConfig(reach=26.0), nodes=nodes)


def alternative(name: str, back: BackEnd, divided: DividedSubmaps) -> Alternative:
    solution = back.finish()
    poses = divided.along(solution.trajectory())
    return Alternative(name, back.graph, solution, MapHypothesis(divided.pieces, poses, name))


def fold(back: BackEnd, robust: RobustKernel) -> None:
    """Two ties that press the first stretch of the way together."""
    first, second = back.graph.submaps[:2]
    for j in (first.nodes[6], second.nodes[0]):
        back.graph.add_between(
            0, j, SE3.identity, 0.05**2 * np.eye(6), evidence=EvidenceUse(["match"], (0.0, 1.0), "shared-scan"),
            group="loop", robust=robust,
        )  # fmt: skip


def test_loops_of_a_ledger_are_choices_too(run: tuple) -> None:
    submaps, back, loops, _ = run
    assert loops
    choices = choices_of_matches(submaps, 0.5, loops=loops)
    assert choices["as the run"] == {(LOOP, d.loop) for d in loops}
    assert choices["no match or loop"] == frozenset()
    assert sum(name.startswith("without loop") for name in choices) == len(loops)
    again = solve_choice(submaps, choices["as the run"], OPTIONS, loops=loops)
    again.finish()
    np.testing.assert_allclose(again.graph.values.poses, back.graph.values.poses, atol=1e-6)
    bare = solve_choice(submaps, frozenset(), OPTIONS, loops=loops)
    bare.finish()
    assert np.abs(bare.graph.values.poses - back.graph.values.poses).max() > 0.05


def test_a_match_undone_by_hand_is_not_as_the_run(run: tuple) -> None:
    submaps = run[0]
    m = Match(target=0, T_target_here=SE3.identity, covariance=np.eye(6), fitness=0.9, support=0.9)
    with_match = [*submaps[:2], replace(submaps[2], matches=(m,))]
    key = (submaps[2].key, 0)
    assert key in choices_of_matches(with_match, 0.5)["as the run"]
    choices = choices_of_matches(with_match, 0.5, undone=frozenset({(submaps[2].key, 0)}))
    assert key not in choices["as the run"]
    assert key in choices["support ≥ 0.9"]


@pytest.mark.parametrize("robust", [RobustKernel(), RobustKernel("cauchy", 2.385)])
def test_a_folded_map_has_less_entropy_and_is_not_chosen(run: tuple, robust: RobustKernel, tmp_path: Path) -> None:
    """A kernel does not hide that: what is judged are the ties without it."""
    submaps, _, loops, divided = run
    choices = choices_of_matches(submaps, 0.5, loops=loops)
    made = [alternative(n, solve_choice(submaps, c, OPTIONS, loops=loops), divided) for n, c in choices.items()]
    folded = solve_choice(submaps, frozenset(), OPTIONS)
    fold(folded, robust)
    made.append(alternative("folded", folded, divided))
    choice = rank_alternatives(made)
    assert choice.scale == 1.0
    by_name = {j.alternative.name: j for j in choice.order}
    assert choice.order[-1] is by_name["folded"]
    assert by_name["folded"].contradicted
    assert not any(j.contradicted for j in choice.order[:-1])
    if robust.kind == "none":
        assert by_name["folded"].clarity.entropy == min(j.clarity.entropy for j in choice.order)
    else:
        assert by_name["folded"].chi2 > 10 * folded.graph.objective().total
    entropies = [j.clarity.entropy for j in choice.order[:-1]]
    assert entropies == sorted(entropies)
    assert by_name["no match or loop"] is choice.order[-2]  # the open chain is honest, and the dimmest
    assert choice.best_map.entropy() == pytest.approx(entropies[0])

    (tmp_path / "alternatives").mkdir()
    (tmp_path / "alternatives" / "99.tum").write_text("of an earlier choice")
    files = write_minimum_entropy(tmp_path, MinimumEntropyMap(choice, 3))
    assert all(p.is_file() for p in files)
    assert not (tmp_path / "alternatives" / "99.tum").exists()
    kept = json.loads((tmp_path / "clearest.json").read_text())
    assert (kept["left_out"], kept["why"], len(kept["candidates"])) == (3, choice.why(), len(made))
    only = rank_alternatives(made[-1:])
    assert only.best.contradicted
    assert "only one" in only.why()
    both = rank_alternatives([made[-1], alternative("folded again", _folded_more(submaps, robust), divided)])
    assert both.best.chi2_per_dof == min(j.chi2_per_dof for j in both.order)
    assert f"every graph contradicts itself, {both.best.alternative.name} least" in both.why()


def _folded_more(submaps: list[Submap], robust: RobustKernel) -> BackEnd:
    back = solve_choice(submaps, frozenset(), OPTIONS)
    fold(back, robust)
    last = back.graph.submaps[-1].exit_node
    back.graph.add_between(
        0, last, np.array([0, 0, 30.0, 0, 0, 0, 1]), 0.01**2 * np.eye(6),
        evidence=EvidenceUse(["match"], (0.0, 1.0), "shared-scan"), group="loop",
    )  # fmt: skip
    return back


def test_chi2_of_a_graph_without_kernels_is_its_objective(run: tuple) -> None:
    submaps = run[0]
    back = solve_choice(submaps, frozenset(), OPTIONS)
    fold(back, RobustKernel())
    back.finish()
    assert chi2_of(back.graph) == pytest.approx(back.graph.objective().total, rel=1e-12)


def test_most_ties_say_how_good_the_chain_is() -> None:
    """Sixteen ties over a chain that states a third of its variance; one of them is wrong."""
    counts = [16, 15, 15, 0]
    fits = [(900.0, 48), (140.0, 45), (860.0, 45), (0.0, 0)]
    assert noise_scale(counts, fits) == pytest.approx(140.0 / 45)
    assert noise_scale([4, 3, 0], [(900.0, 12), (140.0, 9), (0.0, 0)]) == 1.0  # too few to tell
    assert noise_scale(counts, [(30.0, 48), (29.0, 45), (28.0, 45), (0.0, 0)]) == 1.0  # no chain is too good
    # those that dropped most of the ties have no say
    assert noise_scale([16, 5], [(160.0, 48), (15.0, 15)]) == pytest.approx(160 / 48)


def test_ties_of_one_pair_of_submaps_count_once(run: tuple) -> None:
    submaps, _, loops, divided = run
    assert len({(d.submap_i, d.submap_j) for d in loops}) < len(loops)
    again = alternative("as the run", solve_choice(submaps, _all(loops), OPTIONS, loops=loops), divided)
    assert again.links == len({(d.submap_i, d.submap_j) for d in loops})
    folded = solve_choice(submaps, _all(loops), OPTIONS, loops=loops)
    fold(folded, RobustKernel())  # within the first submap, and from it to the second
    assert alternative("folded", folded, divided).links == again.links + 2
    assert alternative("open", solve_choice(submaps, frozenset(), OPTIONS), divided).links == 0


def _all(loops: list[LoopDecision]) -> frozenset[tuple[int, int]]:
    return frozenset((LOOP, d.loop) for d in loops)


def test_fixes_of_a_run_are_in_every_choice(run: tuple) -> None:
    submaps = run[0]
    times = np.concatenate([s.trajectory.times[::2] for s in submaps if s.trajectory is not None])
    graph = solve_choice(submaps, frozenset(), OPTIONS).graph
    at = np.concatenate(
        [SE3.compose(np.broadcast_to(graph.values.poses[n.node], (len(s.trajectory.times[::2]), 7)),
                     s.trajectory.poses[::2])[:, :3] for s, n in zip(submaps, graph.submaps)]
    )  # fmt: skip
    keep = np.unique(times, return_index=True)[1]
    fixes = Gps(times=times[keep], positions=at[keep] + [100.0, 0, 0], sigma=np.full(len(keep), 0.5),
                lever=np.zeros(3))  # fmt: skip
    back = solve_choice(submaps, frozenset(), OPTIONS, fixes=fixes, gps=GpsOptions(use="all"))
    solution = back.finish()
    assert back.graph.objective()["gps"].factors > 10
    np.testing.assert_allclose(solution.T_gps_world[:3], [100.0, 0, 0], atol=1.0)


def test_nothing_to_choose_from() -> None:
    with pytest.raises(DataError, match="no graphs"):
        rank_alternatives([])
