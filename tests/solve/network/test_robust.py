"""GNC on networks with wrong loops: inliers, noise scale, what is trusted; Huber; GTSAM's GNC as a check."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy import stats

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import align_se2, se2_transform
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import SE2
from graphslam.core.random import SeedTree
from graphslam.graph.gtsam_values import from_gtsam
from graphslam.graph.network import network_values, problem_of_network
from graphslam.io.catalog import load_recording
from graphslam.io.network_file import read_network
from graphslam.solve.network.consensus import loop_consensus, odometry_edges
from graphslam.solve.network.robust import truncated_cost
from graphslam.solve.network.solve import solve_network
from tests.reference.gtsam_network import to_graph
from tests.reference.gtsam_twin import to_gtsam
from tests.reference.huber import huber_least_squares
from tests.reference.plain_network import edge_costs
from tests.reference.wrong_loops import add_wrong_loops, is_odometry
from tests.sim.test_wrong_loops import ring_drive


@pytest.mark.parametrize(
    ("dim", "kind", "share"),
    [(2, "random", 0.3), (2, "random", 0.5), (2, "aliased", 0.3), (3, "random", 0.3), (3, "random", 0.5)],
)
def test_gnc_ends_at_the_optimum_of_the_right_loops(dim: int, kind: str, share: float) -> None:
    net = ring_drive(dim)
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(net, share, SeedTree(3).generator(), kind=kind, reference=clean.poses)  # type: ignore[arg-type]
    answer = solve_network(mixed.network, "gnc")
    assert answer.converged
    assert answer.inliers is not None
    reached = edge_costs(mixed.network, answer.poses)[~mixed.wrong].sum()
    assert reached <= 1.01 * clean.objective
    assert not (answer.inliers & mixed.wrong).any()
    assert (~answer.inliers & ~mixed.wrong).sum() <= 1
    # least squares of everything is nowhere near
    plain = solve_network(mixed.network, "lm", starts=("chordal",))
    assert edge_costs(mixed.network, plain.poses)[~mixed.wrong].sum() > 2.0 * clean.objective


@pytest.mark.parametrize("overstated", [1.0, 25.0, 1e4])
def test_noise_scale_is_found_and_makes_the_choice_independent_of_it(overstated: float) -> None:
    net = ring_drive(2)
    net = replace(net, information=net.information / overstated)
    clean = solve_network(net, starts=("chordal",))
    # wrong by the true noise; against the stated one some would pass
    mixed = add_wrong_loops(replace(net, information=net.information * overstated), 0.3, SeedTree(4).generator())
    network = replace(mixed.network, information=mixed.network.information / overstated)
    answer = solve_network(network, "gnc")
    assert answer.inliers is not None
    assert answer.details["noise_scale"] == pytest.approx(1.0 / overstated, rel=0.5)
    assert not (answer.inliers & mixed.wrong).any()
    assert edge_costs(network, answer.poses)[~mixed.wrong].sum() <= 1.01 * clean.objective
    given = solve_network(network, "gnc", noise_scale=1.0 / overstated)
    assert given.inliers is not None
    assert (given.inliers == answer.inliers).all()


def test_few_loops_that_agree_too_well_say_nothing_of_the_noise() -> None:
    """Loops of one entry share their error: the chain fits three of them almost exactly, and a fourth as it states."""
    net = ring_drive(2)
    loops = np.flatnonzero(~is_odometry(net.edges))
    keep = np.zeros(len(net.edges), dtype=bool)
    keep[~np.isin(np.arange(len(keep)), loops)] = True
    few = loops[:4]
    keep[few] = True
    measurements = net.measurements.copy()
    poses = solve_network(replace(net, edges=net.edges[keep], measurements=net.measurements[keep],
                                  information=net.information[keep])).poses  # fmt: skip
    ends = poses[net.edges[few, 0]], poses[net.edges[few, 1]]
    measurements[few] = SE2.between(*ends)
    sigma = np.linalg.inv(net.information[few[-1]])
    measurements[few[-1]] = SE2.compose(measurements[few[-1]], SE2.exp(1.5 * np.sqrt(np.diag(sigma))))
    part = replace(net, edges=net.edges[keep], measurements=measurements[keep], information=net.information[keep])
    answer = solve_network(part, "gnc")
    assert answer.inliers is not None
    assert answer.inliers.all()
    # with as few, one that is wrong is still refused
    measurements[few[-1]] = SE2.compose(measurements[few[-1]], SE2.exp(60.0 * np.sqrt(np.diag(sigma))))
    answer = solve_network(replace(part, measurements=measurements[keep]), "gnc")
    assert answer.inliers is not None
    assert np.flatnonzero(~answer.inliers[: keep.sum()]).tolist() == [int(np.flatnonzero(keep).tolist().index(few[-1]))]


def test_votes_part_right_from_wrong_loops() -> None:
    net = ring_drive(2)
    mixed = add_wrong_loops(net, 0.5, SeedTree(5).generator())
    found = loop_consensus(mixed.network)
    loops = ~is_odometry(mixed.network.edges)
    assert (found.odometry == ~loops).all()
    assert found.likely[loops & ~mixed.wrong].mean() > 0.9
    assert found.likely[mixed.wrong].mean() < 0.02
    assert (found.core <= found.likely).all()


def test_ids_in_no_order_are_not_taken_for_odometry() -> None:
    net = ring_drive(2)
    clean = solve_network(net, starts=("chordal",))
    order = np.concatenate([[0], 1 + SeedTree(7).generator().permutation(len(net) - 1)])  # vertex k becomes order[k]
    poses = np.empty_like(net.poses)
    poses[order] = net.poses
    shuffled = replace(net, poses=poses, edges=order[net.edges].astype(np.intp))
    assert odometry_edges(net).sum() == len(net) - 1
    assert not odometry_edges(shuffled).any()
    answer = solve_network(shuffled, "gnc")  # nothing is trusted, so it begins from least squares of everything
    assert answer.objective == pytest.approx(clean.objective, rel=0.01)
    assert answer.inliers is not None
    assert answer.inliers.mean() > 0.99


def test_gtsams_gnc_agrees_where_it_succeeds() -> None:
    """From dead reckoning, with the same limits, on an easy network: the same loops."""
    net = ring_drive(2, n=150)
    mixed = add_wrong_loops(net, 0.2, SeedTree(8).generator())
    answer = solve_network(mixed.network, "gnc", noise_scale=1.0)
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([0, *(1 + np.flatnonzero(is_odometry(mixed.network.edges))).tolist()])
    start = network_values(mixed.network, net.poses)
    optimizer = gtsam.GncLMOptimizer(to_graph(mixed.network), to_gtsam(start, held=True), params)
    optimizer.setInlierCostThresholds(0.5 * float(answer.details["edge_limit"]))
    found = from_gtsam(optimizer.optimize(), start)
    assert answer.inliers is not None
    assert ((np.asarray(optimizer.getWeights())[1:] > 0.5) == answer.inliers).all()
    limit = np.where(is_odometry(mixed.network.edges), np.inf, stats.chi2.ppf(0.9999, 3))
    theirs = truncated_cost(problem_of_network(mixed.network), found, limit)
    assert answer.details["objective_truncated"] <= theirs * (1 + 1e-6)


def test_huber_lies_between_plain_and_truncated(rng: np.random.Generator) -> None:
    net = ring_drive(2)
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(net, 0.1, SeedTree(9).generator(), reference=clean.poses)
    odometry = is_odometry(mixed.network.edges)
    plain = solve_network(mixed.network, "lm", starts=("chordal",))
    huber = huber_least_squares(mixed.network, net.poses, odometry)
    error = {
        name: np.abs(p[:, :2] - clean.poses[:, :2]).max()
        for name, p in (
            ("plain", plain.poses),
            ("huber", huber.poses),
            ("gnc", solve_network(mixed.network, "gnc").poses),
        )
    }
    assert error["gnc"] < 1e-3 < error["huber"] < error["plain"]
    # at the end no small step lowers Huber's cost
    assert huber.converged
    costs = edge_costs(mixed.network, huber.poses)
    assert np.allclose(huber.weights[~odometry], np.minimum(1, 1.345 / np.sqrt(costs[~odometry])), rtol=0.05)
    # without outliers and with a wide k it is least squares
    wide = huber_least_squares(net, net.poses, is_odometry(net.edges), k=100.0)
    assert wide.cost == pytest.approx(clean.objective, rel=1e-6)
    with pytest.raises(ConfigError, match="positive"):
        huber_least_squares(net, net.poses, odometry[: len(net.edges)], k=0.0)


def test_options_are_checked() -> None:
    net = ring_drive(2, n=60)
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="noise_scale"):
            solve_network(net, "gnc", noise_scale=bad)


def drifting(network: PoseNetwork, degrees: float) -> PoseNetwork:
    """Odometry that turns too far by so much over the way; its stated noise knows nothing of it."""
    chain = odometry_edges(network)
    z = network.measurements.copy()
    z[chain, 2] += np.deg2rad(degrees) / np.count_nonzero(chain)
    return replace(network, measurements=z)


@pytest.mark.parametrize("degrees", [-30.0, 30.0])
def test_odometry_that_drifts_beyond_its_noise_does_not_win_against_loops(degrees: float) -> None:
    net = ring_drive(2)
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(drifting(net, degrees), 0.1, SeedTree(6).generator(), reference=clean.poses)
    answer = solve_network(mixed.network, "gnc")
    assert answer.inliers is not None
    loops = ~odometry_edges(mixed.network)
    assert answer.inliers[loops & ~mixed.wrong].mean() > 0.9
    assert (answer.inliers & mixed.wrong).sum() <= 0.2 * mixed.wrong.sum()
    off = align_se2(answer.poses[:, :2], clean.poses[:, :2])
    apart = np.linalg.norm(se2_transform(off, answer.poses[:, :2]) - clean.poses[:, :2], axis=1)
    assert np.sqrt(np.mean(apart**2)) < 1.0


def test_odometry_that_loops_cannot_outweigh_is_not_solved() -> None:
    """The odometry of this drive is stated so exactly that hundreds of degrees weigh more than all loops."""
    net = ring_drive(2)
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(drifting(net, 250.0), 0.1, SeedTree(6).generator(), reference=clean.poses)
    answer = solve_network(mixed.network, "gnc")
    assert not answer.converged
    assert "not solved" in str(answer.details["doubt"])


def test_nothing_but_wrong_loops_is_not_solved() -> None:
    net = ring_drive(2)
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(net, 0.9, SeedTree(7).generator(), reference=clean.poses)
    chain = odometry_edges(mixed.network)
    answer = solve_network(mixed.network.only(chain | mixed.wrong), "gnc")
    assert not answer.converged
    assert "not solved" in str(answer.details["doubt"])
    assert "NOT converged" in repr(answer)


@pytest.mark.data
@pytest.mark.parametrize("degrees", [0.0, -250.0])
def test_lecture_hall_with_a_drift_that_nobody_stated(data_dir: Path, degrees: float) -> None:
    log = load_recording("tuc-slam-lecture-hall")
    velocities = log.velocities.copy()
    velocities[:, 2] += np.deg2rad(degrees) / (log.times[-1] - log.times[0])
    net, times = replace(log, velocities=velocities).to_network(min_similarity=0.5)
    answer, truth = solve_network(net, "gnc"), log.truth_at(times)
    there = se2_transform(align_se2(answer.poses[:, :2], truth), answer.poses[:, :2])
    assert np.sqrt(np.mean(np.sum((there - truth) ** 2, axis=1))) < 0.45
    assert answer.converged


@pytest.mark.data
def test_recorded_network_with_a_third_of_wrong_loops(data_dir: Path) -> None:
    net = read_network(data_dir / "posegraphs" / "intel.g2o.xz")
    clean = solve_network(net, starts=("chordal",))
    mixed = add_wrong_loops(net, 0.3, SeedTree(0).generator(), reference=clean.poses)
    answer = solve_network(mixed.network, "gnc")
    assert edge_costs(mixed.network, answer.poses)[~mixed.wrong].sum() <= 1.01 * clean.objective
