"""Data association of the landmarks of a new submap with those of the graph.

Every decision uses the *joint* covariance of the pose where the submap starts and of the candidates (Combined SLAM
Algorithm 1): after a long loop the pose may be off by metres, but the errors of all its landmarks are then correlated,
which only a joint test takes into account. The default is a joint-compatibility search from several starts; nearest
neighbour by Mahalanobis distance is the plain alternative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from graphslam.association.compatibility import (
    joint_limits,
    mahalanobis2,
    most_pairings,
    nearest_neighbour_pairs,
    search_compatible_sets,
)
from graphslam.core.config import check_options
from graphslam.core.geometry import Array, rotation2
from graphslam.core.submap import Submap
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_graph import FactorGraph

Ids = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class AssociationConfig:
    """Parameters of :func:`associate_landmarks`.

    Parameters
    ----------
    method : {"joint-compatibility", "nearest-neighbour"}
    gate : float
        χ² gate (2 dof) of each pairing; 11.8 corresponds to three sigma.
    joint_probability : float
        Confidence of the χ² test of all pairings together.
    starts : int
        Number of seed pairings of the search.
    covariance_scale : float
        Factor on the submap's covariance, the same as in :meth:`FactorGraph.add_submap`.
    max_distance : float
        No candidate further than this from its prediction [m], however uncertain the pose.
    """

    method: Literal["joint-compatibility", "nearest-neighbour"] = "joint-compatibility"
    gate: float = 11.8
    joint_probability: float = 0.997
    starts: int = 25
    covariance_scale: float = 1.0
    max_distance: float = 40.0

    def __post_init__(self) -> None:
        ranges = {"> 0 or inf": "gate covariance_scale", "≥ 1": "starts", "in (0, 1)": "joint_probability"}
        check_options(self, "association: ", ranges)


@dataclass(frozen=True, slots=True)
class CompatiblePairings:
    """Individually compatible pairings of one submap.

    Parameters
    ----------
    observed : (p,) int
        Submap entry.
    target : (p,) int
        Row of the graph landmark.
    innovation : (p, 2)
        Entry minus prediction, in the submap's base frame [m].
    covariance : (2p, 2p)
        Of all innovations together.
    """

    observed: npt.NDArray[np.int64]
    target: npt.NDArray[np.int64]
    innovation: Array
    covariance: Array

    def distance2(self) -> Array:
        """Individual Mahalanobis distances ``(p,)``."""
        return mahalanobis2(self.innovation, _blocks(self.covariance))


def associate_landmarks(graph: FactorGraph, submap: Submap, config: AssociationConfig | None = None) -> Ids:
    """Graph ids of the landmarks of a submap that starts at the graph's last node.

    Parameters
    ----------
    graph : FactorGraph
        Its current values and covariance are used: update the solver first.
    submap : Submap
        Entries whose id is not -1 keep it.

    Returns
    -------
    (n,) int64
        -1 = new. No id occurs twice.
    """
    cfg = config or AssociationConfig()
    if submap.landmarks is None:
        return np.zeros(0, dtype=np.int64)
    ids = submap.landmarks.ids.copy()
    unknown = np.flatnonzero(ids < 0)
    used = set(ids[ids >= 0].tolist())
    pairs = find_pairings(graph, submap, unknown, cfg, exclude=used)
    if len(pairs.observed) == 0:
        return ids
    if cfg.method == "nearest-neighbour":
        chosen = nearest_neighbour_pairs(pairs.distance2(), pairs.observed, pairs.target)
    else:
        chosen = _search(pairs, cfg)
    ids[pairs.observed[chosen]] = graph.values.landmark_ids[pairs.target[chosen]]
    return ids


def find_pairings(
    graph: FactorGraph,
    submap: Submap,
    entries: npt.NDArray[np.intp],
    config: AssociationConfig,
    exclude: set[int] | frozenset[int] = frozenset(),
) -> CompatiblePairings:
    """Pairings that pass the gate individually, with the joint covariance of their innovations.

    With pose ``x`` (node of the submap's base), landmark ``l`` and entry ``z``: ``ν = z - R(θ)ᵀ (l - p)``,
    ``S = J Σ_{x,l} Jᵀ + P_z`` where ``Σ`` is the graph's joint covariance and ``P_z`` the submap's own.
    """
    lm, v = submap.landmarks, graph.values
    assert lm is not None
    none = CompatiblePairings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 0)))
    if len(entries) == 0 or len(v.landmarks) == 0:
        return none
    z = lm.positions[entries]
    rows = (3 + 2 * entries[:, None] + np.arange(2)).ravel()
    P_z = config.covariance_scale * lm.dense_covariance()[np.ix_(rows, rows)]
    node = len(v.poses) - 1
    p, R = v.poses[node, :2], rotation2(v.poses[node, 2])
    q = (v.landmarks - p) @ R  # predictions of every graph landmark in the base frame
    free = ~np.isin(v.landmark_ids, np.fromiter(exclude, dtype=np.int64, count=len(exclude)))
    # cheap preselection: nothing beyond max_distance of every entry
    low, high = z.min(0) - config.max_distance, z.max(0) + config.max_distance
    near = np.flatnonzero(free & np.all((q >= low) & (q <= high), axis=1))
    if len(near) == 0:
        return none
    covariance, lay = graph.covariance(), graph.flat().layout
    pose_columns = lay.columns(f"x{node}")
    # marginal test: S needs only the blocks of one landmark and the pose
    J_x, J_l = _jacobians(q[near], R, fixed=node == 0)
    S_pred = _predicted_blocks(covariance, pose_columns, lay.landmark_start + 2 * near, J_x, J_l)
    i = np.arange(len(entries))
    own = P_z.reshape(len(entries), 2, len(entries), 2)[i, :, i, :]
    nu = z[:, None, :] - q[near][None, :, :]
    d2 = mahalanobis2(nu, S_pred[None] + own[:, None])
    obs, tar = np.nonzero((d2 <= config.gate) & (np.sum(nu**2, axis=2) <= config.max_distance**2))
    if len(obs) == 0:
        return none
    # joint covariance over the remaining candidates
    used, slot = np.unique(tar, return_inverse=True)
    columns = np.concatenate(
        [pose_columns, (lay.landmark_start + 2 * near[used][:, None] + np.arange(2)).ravel()]
    ).astype(np.intp)
    Sigma = covariance.columns(columns)
    k = len(pose_columns)
    J = np.zeros((len(used), 2, len(columns)))
    J[:, :, :k] = J_x[used]
    for a in range(2):
        for b in range(2):
            J[np.arange(len(used)), a, k + 2 * np.arange(len(used)) + b] = J_l[a, b]
    flat = J.reshape(2 * len(used), -1)
    H = flat @ Sigma @ flat.T
    pick = (2 * slot[:, None] + np.arange(2)).ravel()
    mine = (2 * obs[:, None] + np.arange(2)).ravel()
    C = H[np.ix_(pick, pick)] + P_z[np.ix_(mine, mine)]
    return CompatiblePairings(entries[obs].astype(np.int64), near[tar].astype(np.int64), nu[obs, tar], C)


def _jacobians(q: Array, R: Array, *, fixed: bool) -> tuple[Array, Array]:
    """Jacobians of ``R(θ)ᵀ (l - p)`` in the pose's right tangent ``(c, 2, 3)`` and in the landmark ``(2, 2)``."""
    J_x = np.zeros((len(q), 2, 0 if fixed else 3))
    if not fixed:
        J_x[:, 0, 0] = J_x[:, 1, 1] = -1.0
        J_x[:, 0, 2], J_x[:, 1, 2] = q[:, 1], -q[:, 0]
    return J_x, R.T


def _predicted_blocks(
    covariance: JointCovariance, pose: npt.ArrayLike, first: npt.ArrayLike, J_x: Array, J_l: Array
) -> Array:
    """``(c, 2, 2)`` covariance of each prediction, from blocks of pose and one landmark each."""
    P_xx, P_xl, P_ll = covariance.pose_and_points(pose, first)
    cross = J_x @ P_xl @ J_l.T
    return J_x @ P_xx @ np.swapaxes(J_x, 1, 2) + cross + np.swapaxes(cross, 1, 2) + J_l @ P_ll @ J_l.T


def _blocks(C: Array) -> Array:
    p = len(C) // 2
    i = np.arange(p)
    return C.reshape(p, 2, p, 2)[i, :, i, :]


def _search(pairs: CompatiblePairings, cfg: AssociationConfig) -> npt.NDArray[np.intp]:
    """Best of the beam search: the start with the greatest ``Σ (gate - d²)``."""
    seeds = _seeds(pairs, cfg.starts)
    limits = joint_limits(cfg.joint_probability, most_pairings(pairs.observed, pairs.target))
    limits[1] = max(limits[1], cfg.gate)  # a single pairing is tested by its own gate
    found = search_compatible_sets(
        pairs.observed, pairs.target, pairs.innovation, pairs.covariance, seeds, cfg.gate, limits, persistent=False
    )
    return found.of(int(np.argmax(found.score)))


def _seeds(pairs: CompatiblePairings, starts: int) -> npt.NDArray[np.int64]:
    """First pairings: all candidates of the least ambiguous entries, the closest first.

    Taking every candidate of an entry before the next entry ensures that, if the entry is in the map at all, one start
    is correct even with a large error of the prediction; the nearest pairings of all entries would share that error.
    """
    d2 = pairs.distance2()
    _, inverse, counts = np.unique(pairs.observed, return_inverse=True, return_counts=True)
    order = np.lexsort((d2, pairs.observed, counts[inverse]))
    return order[:starts].astype(np.int64)
