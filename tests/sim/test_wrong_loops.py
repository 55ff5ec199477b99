"""Wrong loops: as many as asked for, wrong, of the stated information, the same for a seed; aliased ones agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from graphslam.association.consistent_set import LoopArrays, OdometryChain, pair_chi2
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.network import PoseNetwork
from graphslam.core.random import SeedTree
from tests.reference.plain_network import between, compose, edge_costs, exp
from tests.reference.wrong_loops import Kind, add_wrong_loops, is_odometry


def ring_drive(dim: int, n: int = 200, lap: int = 50, sigma: float = 0.01, seed: int = 0) -> PoseNetwork:
    """A drive of several laps, each beside the one before, with a loop from every pose to the lap before."""
    rng = SeedTree(seed).child("laps").generator()
    d = 3 if dim == 2 else 6
    step = np.zeros(d)
    step[[2, 0] if dim == 2 else [2, 3]] = [2 * np.pi / lap, 1.0]
    step[1 if dim == 2 else 4] = 0.03
    poses = [exp(np.zeros(d))]
    for _ in range(n - 1):
        poses.append(compose(poses[-1], exp(step)))
    x = np.array(poses)
    edges = np.concatenate(
        [np.stack([np.arange(n - 1), np.arange(1, n)], 1), np.stack([np.arange(lap, n), np.arange(n - lap)], 1)]
    )
    z = compose(between(x[edges[:, 0]], x[edges[:, 1]]), exp(sigma * rng.standard_normal((len(edges), d))))
    info = np.tile(np.eye(d) / sigma**2, (len(edges), 1, 1))
    return PoseNetwork(dim, np.arange(n), x, np.ones(n, bool), edges.astype(np.intp), z, info)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["random", "aliased"])
def test_share_information_and_wrongness(dim: int, kind: Kind) -> None:
    net = ring_drive(dim)
    loops = int((~is_odometry(net.edges)).sum())
    for share in (0.0, 0.3, 0.5):
        mixed = add_wrong_loops(net, share, SeedTree(1).generator(), kind=kind, reference=net.poses)
        added = int(mixed.wrong.sum())
        assert added == round(share / (1 - share) * loops)
        assert (mixed.network.edges[: len(net.edges)] == net.edges).all()
        assert not is_odometry(mixed.network.edges[mixed.wrong]).any()
        assert (mixed.group[~mixed.wrong] == -1).all()
        costs = edge_costs(mixed.network, net.poses)
        assert (costs[mixed.wrong] > stats.chi2.ppf(0.999, net.tangent_dim)).all()
        assert np.median(costs[~mixed.wrong]) < stats.chi2.ppf(0.9, net.tangent_dim)
        if kind == "random":
            assert len(np.unique(mixed.group[mixed.wrong])) == added


def test_a_seed_is_a_set_of_loops() -> None:
    net = ring_drive(2)
    one, two, three = (add_wrong_loops(net, 0.3, SeedTree(s).generator()) for s in (5, 5, 6))
    assert (one.network.edges == two.network.edges).all()
    assert (one.network.measurements == two.network.measurements).all()
    assert (one.network.edges[one.wrong] != three.network.edges[three.wrong]).any()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("solved", [True, False])
def test_aliased_groups_agree_with_each_other_and_random_ones_do_not(dim: int, solved: bool) -> None:
    net = ring_drive(dim, n=300)
    chain_z, P = net.measurements[:299], np.linalg.inv(net.information)
    chain = OdometryChain.of(chain_z, P[:299])
    share = {}
    for kind in ("aliased", "random"):
        rng = SeedTree(2).generator()
        mixed = add_wrong_loops(net, 0.5, rng, kind=kind, reference=net.poses if solved else None, group_size=10)
        net2 = mixed.network
        rows = np.flatnonzero(mixed.wrong)
        loops = LoopArrays.of(chain, net2.edges[rows], net2.measurements[rows], np.linalg.inv(net2.information[rows]))
        d2 = pair_chi2(chain, loops, np.arange(len(rows) - 1), np.arange(1, len(rows)))
        same = np.diff(mixed.group[rows]) == 0 if kind == "aliased" else np.ones(len(d2), bool)
        share[kind] = np.mean(d2[same] < stats.chi2.ppf(0.99, net.tangent_dim))
    assert share["aliased"] > 0.9
    assert share["random"] < 0.2


def test_what_makes_no_sense_is_refused() -> None:
    net = ring_drive(2)
    rng = SeedTree(0).generator()
    for bad in ({"share": 1.0}, {"share": -0.1}, {"kind": "sly"}, {"group_size": 0}):
        with pytest.raises(ConfigError):
            add_wrong_loops(net, **{"share": 0.3, "rng": rng, **bad})  # type: ignore[arg-type]
    chain = replace(net, edges=net.edges[:199], measurements=net.measurements[:199], information=net.information[:199])
    with pytest.raises(DataError, match="no loop whose information"):
        add_wrong_loops(chain, 0.3, rng)
    with pytest.raises(DataError, match="reference poses do not fit"):
        add_wrong_loops(net, 0.3, rng, reference=net.poses[:5])
    with pytest.raises(DataError, match="need reference poses"):
        add_wrong_loops(replace(net, has_initial=np.zeros(len(net), bool)), 0.3, rng)
    # everything at one place, known to a kilometre: nothing can be wrong
    vague = replace(net, information=np.tile(1e-9 * np.eye(3), (len(net.edges), 1, 1)))
    with pytest.raises(DataError, match="no wrong loop can be drawn"):
        add_wrong_loops(vague, 0.3, rng, reference=net.poses)
