"""Which variables a pose network does not determine, in the file's own words, before a solver hides it.

GTSAM's LM "succeeds" on an undetermined network (its damping fills the gap) and its other solvers name one key. Here
the whole set is named, with what would fix it.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.solve.network.model import Layout, linearise
from graphslam.solve.network.sparse import factor

# Relative to a system scaled to unit diagonal: below it a direction is not determined in double precision.
SINGULAR = 1e-13


def check_determined(network: PoseNetwork) -> None:
    """Raise if some vertex or landmark is not connected to an anchor by measurements.

    Raises
    ------
    IndeterminateError
        ``variables`` names every one of them; the message says what would fix it.
    """
    n = len(network)
    pairs = np.concatenate([network.edges, network.observations + [0, n]])
    size = n + len(network.landmark_ids)
    links = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    _, label = connected_components(links, directed=False)
    loose = ~np.isin(label, label[network.anchors])
    if loose.any():
        names = tuple(_name(network, int(k)) for k in np.flatnonzero(loose))
        islands = len(np.unique(label[loose]))
        raise IndeterminateError(
            f"{network.source}: {_list(names)} {'are' if len(names) > 1 else 'is'} not connected to "
            f"{_name(network, int(network.anchors[0]))} ({islands} separate part{'s' if islands > 1 else ''}); each "
            "part needs an edge to the rest, or a FIX of one of its vertices",
            names,
        )


def check_full_rank(network: PoseNetwork, poses: Array, landmarks: Array) -> None:
    """Raise if measurements with rank-deficient information leave a direction free.

    Costs nothing where every information matrix has full rank; otherwise the smallest eigenvector of the linear
    system, scaled to unit diagonal, by inverse iteration.

    Raises
    ------
    IndeterminateError
        Naming the vertices that move most in the free direction.
    """
    full = all(
        len(information) == 0 or bool((np.linalg.eigvalsh(information)[:, 0] > 0.0).all())
        for information in (network.information, network.observation_information)
    )
    if full:
        return
    layout = Layout.of(network)
    J, _ = linearise(network, poses, landmarks, layout)
    H = sp.csc_matrix(J.T @ J)
    diagonal = H.diagonal()
    dead = diagonal <= 0.0
    if dead.any():
        _raise_free(network, layout, dead.astype(float))
    scale = sp.diags(1.0 / np.sqrt(diagonal))
    S = sp.csc_matrix(scale @ H @ scale)
    try:
        lu = factor(S + 0.01 * SINGULAR * sp.identity(S.shape[0], format="csc"))
    except RuntimeError:
        lu = factor(S + 1e-10 * sp.identity(S.shape[0], format="csc"))
    v = np.random.default_rng(0).standard_normal(S.shape[0])
    for _ in range(4):
        v = lu.solve(v)
        v /= np.linalg.norm(v)
    if float(v @ (S @ v)) < SINGULAR:
        _raise_free(network, layout, np.abs(v) / np.sqrt(diagonal))


def _raise_free(network: PoseNetwork, layout: Layout, motion: Array) -> None:
    owner = np.empty(layout.size, dtype=np.intp)
    d = network.tangent_dim
    for k, at in enumerate(layout.pose_at):
        if at >= 0:
            owner[at : at + d] = k
    for k, at in enumerate(layout.mark_at):
        owner[at : at + 2] = len(network) + k
    share = np.zeros(len(network) + len(network.landmark_ids))
    np.maximum.at(share, owner, motion)
    free = np.flatnonzero(share > 1e-3 * share.max())
    names = tuple(_name(network, int(k)) for k in free[np.argsort(-share[free], kind="stable")])
    raise IndeterminateError(
        f"{network.source}: measurements with singular information leave {_list(names)} free in some direction; give "
        "an edge there information in every direction, add another edge, or a FIX",
        names,
    )


def _name(network: PoseNetwork, k: int) -> str:
    n = len(network)
    return f"vertex {network.ids[k]}" if k < n else f"landmark {network.landmark_ids[k - n]}"


def _list(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more
