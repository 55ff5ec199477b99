"""Initial guess of the inlier loops from consistency with neighbouring loops, without a solution.

A robot that returns to a place observes it repeatedly, so a true loop (a, b) has true neighbours (c, d) with c near a
and d near b. The cycle through both is short: two loops and a few steps of odometry, with a small covariance even after
a long drift. A false loop has no such neighbours, or only a few in similar places.

The noise in files is rarely right (the recorded networks overstate their variance 10 to 100,000 times), and thresholds
from it accept false loops. The neighbours also give the scale: at least the best quarter of the pairs of nearest loops
should be true ones, and its quantile gives the scale of χ².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from graphslam.association.consistent_set import LoopArrays, OdometryChain, chain_chi2, pair_chi2
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of

Mask = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
# Every loop is compared with this number of its nearest ones …
NEIGHBOURS = 8
# … within this multiple of the distance at which true loops have their nearest one.
REACH = 5.0
# A loop is likely if it has this share of the median votes of loops with a vote.
SUPPORT = 0.25
# Two loops agree if the D² of their cycle, in the scale of the network, is below this χ² quantile.
AGREEMENT = 0.999
# A cycle with a smaller D² is a repetition, not a measurement.
REPEATED = 1e-10
# A loop is used if the chain's variance between its ends is at least this share of its own, on average.
INFORMATIVE = 0.05
# Least share of the vertices in the odometry chain; below it the ids are not in the order of a drive.
CHAINED = 0.9
# Total number of representatives for the comparison of loop clusters …
REPRESENTATIVES = 700
# … and share of disagreeing pairs for a contradiction; only near pairs can disagree.
DISAGREEMENT = 0.1


@dataclass(frozen=True, slots=True)
class LoopConsensus:
    """Mutual consistency of the loops of a network.

    Parameters
    ----------
    odometry : (m,) bool
        Edges between neighbours in vertex order that form the chain; none if ``ordered`` is False.
    ordered : bool
        Whether vertices are in the order of a drive.
    likely : (m,) bool
        Loops confirmed by neighbours, in clusters that do not contradict the others.
    core : (m,) bool
        The largest of these clusters, which together hold half of the likely loops.
    votes : (m,) int64
        Number of neighbours that agree with a loop.
    scale : float
        Estimated ratio of the true variance to that in the file, at most 1.
    """

    odometry: Mask
    ordered: bool
    likely: Mask
    core: Mask
    votes: Ints
    scale: float


def odometry_edges(network: PoseNetwork) -> Mask:
    """Edges between neighbours in vertex order ``(m,)``; none if they do not join nearly all vertices.

    A file with arbitrary ids has some such edges by chance; they are not used.
    """
    step = np.asarray(np.abs(network.edges[:, 1] - network.edges[:, 0]) == 1) & network.relative
    joined = np.unique(network.edges[step].min(axis=1)) if step.any() else np.zeros(0)
    if len(joined) < CHAINED * (len(network) - 1):
        return np.zeros(len(step), dtype=np.bool_)
    return step


def odometry_chain(network: PoseNetwork, odometry: Mask) -> OdometryChain:
    """The odometry of a network as a chain, divided where an increment is missing or its information is singular."""
    n, d = len(network), network.tangent_dim
    rows = np.flatnonzero(odometry)
    loops = LoopArrays.of(_blank(network), network.edges[rows], network.measurements[rows], np.zeros((len(rows), d, d)))
    at, first = np.unique(loops.ends[:, 0], return_index=True)
    increments, covariances = _identities(network, n - 1), np.zeros((n - 1, d, d))
    known = np.zeros(n - 1, dtype=np.bool_)
    information = network.information[rows[first]]
    w = np.linalg.eigvalsh(information)
    sound = w[:, 0] > 1e-12 * w[:, -1]
    turned = LoopArrays.of(
        _blank(network),
        network.edges[rows[first]][sound],
        network.measurements[rows[first]][sound],
        np.linalg.inv(information[sound]),
    )
    k = at[sound]
    increments[k], covariances[k], known[k] = turned.measured, turned.covariance, True
    return OdometryChain.of(increments, covariances, known)


def _identities(network: PoseNetwork, n: int) -> Array:
    return np.tile(group_of(network.poses).identity, (n, 1))


def _blank(network: PoseNetwork) -> OdometryChain:
    n, d = len(network), network.tangent_dim
    return OdometryChain(_identities(network, n), np.zeros((n, d, d)), np.zeros(n, dtype=np.int64))


def loop_consensus(network: PoseNetwork) -> LoopConsensus:
    """Votes of neighbouring loops for each other, the noise scale, and the likely true loops.

    Landmark observations are not used.
    """
    m, d = len(network.edges), network.tangent_dim
    odometry = odometry_edges(network)
    nothing = LoopConsensus(
        odometry, bool(odometry.any()), np.zeros(m, np.bool_), np.zeros(m, np.bool_), np.zeros(m, np.int64), 1.0
    )
    w = np.linalg.eigvalsh(network.information)
    rows = np.flatnonzero(~odometry & (w[:, 0] > 1e-12 * w[:, -1]))
    if not nothing.ordered or len(rows) < 2:
        return nothing
    chain = odometry_chain(network, odometry)
    loops = LoopArrays.of(
        chain, network.edges[rows], network.measurements[rows], np.linalg.inv(network.information[rows])
    )
    informative = _informative(chain, loops)
    rows = rows[informative]
    if len(rows) < 2:
        return nothing
    loops = LoopArrays(loops.ends[informative], loops.measured[informative], loops.covariance[informative])
    near = min(NEIGHBOURS, len(rows) - 1)
    distance, other = cKDTree(loops.ends.astype(np.float64)).query(loops.ends, k=near + 1, p=1)
    # the loop itself is among the nearest, but not always first: two loops can have the same nodes
    distance = distance[:, 1:]
    other = np.where(other[:, :1] == np.arange(len(rows))[:, None], other, _own_first(other))[:, 1:]
    d2 = pair_chi2(chain, loops, np.repeat(np.arange(len(rows)), near), other.ravel()).reshape(-1, near)
    # distant neighbours agree by chance: their cycle is long and its covariance large
    close = distance <= REACH * max(float(np.quantile(distance[:, 0], 0.25)), 2.0)
    nearest = d2[:, 0][np.isfinite(d2[:, 0])]
    # repeated measurements (robot at standstill) have no information on noise
    nearest = nearest[nearest > REPEATED]
    if len(nearest) < 8:
        return nothing
    scale = min(1.0, float(np.quantile(nearest, 0.25) / chi2_quantile(0.25, d)))
    limit = scale * chi2_quantile(AGREEMENT, d)
    agree = (d2 <= limit) & close
    i, k = np.nonzero(agree)
    links = coo_matrix((np.ones(len(i)), (i, other[i, k])), shape=(len(rows), len(rows)))
    votes = agree.sum(axis=1)
    keep = votes >= max(1.0, SUPPORT * float(np.median(votes[votes > 0]) if (votes > 0).any() else 1.0))
    keep &= ~(chain_chi2(chain, loops) > limit)
    links = links.multiply(keep[:, None]).multiply(keep[None, :])
    _, label = connected_components(links, directed=False)
    keep &= np.bincount(label)[label] > 1
    keep &= _agreeing_clusters(chain, loops, np.where(keep, label, -1), limit)
    likely, core, all_votes = np.zeros(m, np.bool_), np.zeros(m, np.bool_), np.zeros(m, np.int64)
    likely[rows[keep]], core[rows[_largest(label, keep)]], all_votes[rows] = True, True, votes
    return LoopConsensus(odometry, True, likely, core, all_votes, max(scale, np.finfo(float).tiny))


def _informative(chain: OdometryChain, loops: LoopArrays) -> Mask:
    """Loops that are informative relative to the chain: others agree with any near loop."""
    a, b = loops.ends.T
    g = group_of(chain.poses)
    home = g.adjoint(g.inverse(chain.poses[b]))
    spread = home @ (chain.spread[b] - chain.spread[a]) @ np.swapaxes(home, 1, 2)
    ratio = np.trace(np.linalg.solve(loops.covariance, spread), axis1=1, axis2=2) / chain.tangent_dim
    return np.asarray((ratio > INFORMATIVE) | (chain.part[a] != chain.part[b]))


def _largest(label: Ints, keep: Mask) -> Mask:
    """Loops of the largest clusters that together hold half of those kept."""
    names, size = np.unique(label[keep], return_counts=True)
    order = np.argsort(-size, kind="stable")
    enough = np.searchsorted(np.cumsum(size[order]), 0.5 * size.sum()) + 1
    return keep & np.isin(label, names[order[:enough]])


def _own_first(other: Ints) -> Ints:
    """Neighbour lists with the row's own index first (it replaces the last neighbour if missing)."""
    out = other.copy()
    for k in np.flatnonzero(other[:, 0] != np.arange(len(other))):
        rest = other[k][other[k] != k][: other.shape[1] - 1]
        out[k] = np.concatenate([[k], rest])
    return out


def _agreeing_clusters(chain: OdometryChain, loops: LoopArrays, label: Ints, limit: float) -> Mask:
    """Loops of the clusters that remain after the most contradicted cluster was removed repeatedly.

    A cluster is contradicted by the loops of every cluster that disagrees with it; the one with the largest number,
    relative to its size, is removed first. A cluster too small for representatives is removed.
    """
    chosen, size = np.unique(label[label >= 0], return_counts=True)
    order = np.argsort(-size, kind="stable")[:REPRESENTATIVES]
    chosen, weight = chosen[order], size[order].astype(np.float64)
    share = np.minimum(weight, np.maximum(2.0, weight * REPRESENTATIVES / max(weight.sum(), 1.0)))
    picks = []
    for name, wanted in zip(chosen, share, strict=True):
        members = np.flatnonzero(label == name)
        picks.append(members[np.linspace(0, len(members) - 1, int(wanted)).astype(int)])
    if not picks:
        return np.zeros(len(label), dtype=np.bool_)
    pick = np.concatenate(picks)
    own = np.repeat(np.arange(len(picks)), [len(p) for p in picks])
    i, j = np.triu_indices(len(pick), 1)
    i, j = i[own[i] != own[j]], j[own[i] != own[j]]
    bad = pair_chi2(chain, loops, pick[i], pick[j]) > limit
    count = len(chosen)
    pairs = np.zeros((count, count))
    conflicts = np.zeros((count, count))
    np.add.at(pairs, (own[i], own[j]), 1.0)
    np.add.at(conflicts, (own[i], own[j]), bad)
    pairs, conflicts = pairs + pairs.T, conflicts + conflicts.T
    against = conflicts > DISAGREEMENT * pairs
    inside = np.ones(count, dtype=np.bool_)
    while True:
        load = (against * weight * inside).sum(axis=1) / weight * inside
        worst = int(np.argmax(load))
        if load[worst] <= 0.0:
            break
        inside[worst] = False
    return np.isin(label, chosen[inside])
