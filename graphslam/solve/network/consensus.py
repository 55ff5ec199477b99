"""Which loops do their neighbours bear out? A first guess of the inliers that needs no solution.

A robot that comes back to a place sees it for a while, so a right loop (a, b) has right neighbours (c, d) with c near a
and d near b, and the cycle through both is short: two loops and a few steps of odometry, whose covariance is small
however far the robot drifted in between. A wrong loop has no such neighbours, or, where places look alike, a few.

Noise in files is rarely what it says it is (the recorded networks overstate their variance 10 to 100,000 times), and
thresholds by the stated one let wrong loops pass that bend the map. The neighbours give the scale, too: among the pairs
of nearest loops at least the better quarter should be right ones, and its quantile says what χ² is there.
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
# Every loop is compared with so many of its nearest ones.
NEIGHBOURS = 8
# … that are within so many times the distance at which right loops have their nearest one.
REACH = 5.0
# A loop is likely if it has this share of the votes that a loop with any vote has in the median.
SUPPORT = 0.25
# Two loops agree if the D² of their cycle, in the scale of the network, is below this quantile.
AGREEMENT = 0.999
# A cycle that closes to within this D² is a repetition, not a measurement.
REPEATED = 1e-10
# A loop takes part if the chain's variance between its ends is at least this share of its own, on average.
INFORMATIVE = 0.05
# A chain of odometry that joins fewer of the vertices than this is none: the ids are not in the order of a drive.
CHAINED = 0.9
# Clusters of loops are compared with each other by about so many representatives, together …
REPRESENTATIVES = 700
# … and disagree if this share of the pairs does: only pairs that are near to each other can.
DISAGREEMENT = 0.1


@dataclass(frozen=True, slots=True)
class LoopConsensus:
    """What the loops of a network say about each other.

    Parameters
    ----------
    odometry : (m,) bool
        Edges between neighbours in vertex order that make up the chain; nothing if ``ordered`` is False.
    ordered : bool
        Whether vertices come in the order of a drive.
    likely : (m,) bool
        Loops that neighbours bear out, in clusters that do not contradict the others.
    core : (m,) bool
        The largest of these clusters, which together hold half of the likely loops.
    votes : (m,) int64
        Neighbours that agree with a loop.
    scale : float
        Estimated ratio of the true to the stated variance, at most 1.
    """

    odometry: Mask
    ordered: bool
    likely: Mask
    core: Mask
    votes: Ints
    scale: float


def odometry_edges(network: PoseNetwork) -> Mask:
    """Edges between neighbours in vertex order ``(m,)``; none if they do not join nearly all vertices.

    A file whose ids are in no particular order has such edges too, by chance; they are then nothing to be trusted.
    """
    step = np.asarray(np.abs(network.edges[:, 1] - network.edges[:, 0]) == 1)
    joined = np.unique(network.edges[step].min(axis=1)) if step.any() else np.zeros(0)
    if len(joined) < CHAINED * (len(network) - 1):
        return np.zeros(len(step), dtype=np.bool_)
    return step


def odometry_chain(network: PoseNetwork, odometry: Mask) -> OdometryChain:
    """The odometry of a network as a chain, cut where an increment is missing or its information singular."""
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
    """Votes of neighbouring loops for each other, the noise scale, and the loops that are likely right.

    Landmark observations take no part.
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
    told = _informative(chain, loops)
    rows = rows[told]
    if len(rows) < 2:
        return nothing
    loops = LoopArrays(loops.ends[told], loops.measured[told], loops.covariance[told])
    near = min(NEIGHBOURS, len(rows) - 1)
    distance, other = cKDTree(loops.ends.astype(np.float64)).query(loops.ends, k=near + 1, p=1)
    # the loop itself is among the nearest, but not always the first: two loops may join the same nodes
    distance = distance[:, 1:]
    other = np.where(other[:, :1] == np.arange(len(rows))[:, None], other, _own_first(other))[:, 1:]
    d2 = pair_chi2(chain, loops, np.repeat(np.arange(len(rows)), near), other.ravel()).reshape(-1, near)
    # far neighbours agree by chance: the cycle through them is long and its covariance large
    close = distance <= REACH * max(float(np.quantile(distance[:, 0], 0.25)), 2.0)
    nearest = d2[:, 0][np.isfinite(d2[:, 0])]
    # said twice word for word (a robot that stands still): nothing about noise
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
    """Loops whose ends the chain does not tie far better than they do: those agree with anything near them."""
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
    """Neighbour lists with the row's own number moved to the front (or the last neighbour dropped for it)."""
    out = other.copy()
    for k in np.flatnonzero(other[:, 0] != np.arange(len(other))):
        rest = other[k][other[k] != k][: other.shape[1] - 1]
        out[k] = np.concatenate([[k], rest])
    return out


def _agreeing_clusters(chain: OdometryChain, loops: LoopArrays, label: Ints, limit: float) -> Mask:
    """Loops of clusters that are left when the most contradicted cluster has been taken out again and again.

    A cluster is contradicted by the loops of every cluster that disagrees with it; the one for which they are most,
    in its own size, goes first. A cluster too small to be represented is left out.
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
