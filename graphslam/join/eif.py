"""Join two maps in information form (Combined SLAM B6, eq. 13–16): exactly sparse, linearised once.

Map B is one measurement of the global quantities, seen from the last pose of map A: ``x_B = H(X) + v``,
``v ~ N(0, I_B⁻¹)``. The end poses and new landmarks of B enter A with rows and columns of zeros (zero information), at
the values B gives them, and then

    I ← I + ∇Hᵀ I_B ∇H,        X ← X + I⁻¹ ∇Hᵀ I_B (x_B - H(X)),

which is eq. 16 with ``i = I X`` (eq. 13) subtracted on both sides: in this residual form a heading can be wrapped.
Nothing is marginalised out, so ``I`` keeps only the couplings that submaps made.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.geometry import Array, wrap_angle
from graphslam.join.joined_map import JoinedMap, JoinTimes

Index = npt.NDArray[np.intp]

# A kept order is given up when the factors have this much more fill-in than under the last fresh one.
_STALE = 1.3
# Below this a difference between B and its own prediction is arithmetic, not news.
_ROUNDING = 1e-12


def match_by_id(a: JoinedMap, b: JoinedMap) -> Index:
    """For every landmark of B the landmark of A with the same id, or -1 ``(L_b,)``."""
    if len(a.ids) == 0:
        return np.full(len(b.ids), -1, dtype=np.intp)
    order = np.argsort(a.ids)
    at = np.minimum(np.searchsorted(a.ids[order], b.ids), len(a.ids) - 1)
    candidate = order[at]
    return np.where(a.ids[candidate] == b.ids, candidate, -1).astype(np.intp)


def join_maps(a: JoinedMap, b: JoinedMap, match: Index, times: JoinTimes | None = None) -> JoinedMap:
    """Join B, which starts where A ends, to A.

    Parameters
    ----------
    a, b : JoinedMap
    match : (L_b,)
        Landmark of A that each landmark of B is, or -1 for a new one. Several of B may not be one of A.
    times : JoinTimes, optional
        Where to add the time spent.

    Returns
    -------
    JoinedMap
        In the frame of A's first base.
    """
    times = times or JoinTimes()
    with times.measure("update"):
        joined, gradient = _assemble(a, b, match)
    if not np.any(gradient):  # nothing in B was known before: the mean stays, and no factorisation is needed
        return joined
    with times.measure("recovery"):
        factor = joined.factor()
        joined.x = joined.x + factor.solve(gradient)  # eq. 13
        if joined.ordered and factor.nnz / joined.information.nnz > _STALE * joined.fill:
            joined = joined.reordered()
    return joined


def _assemble(a: JoinedMap, b: JoinedMap, match: Index) -> tuple[JoinedMap, Array]:
    """The joined map at its values before the update, and ``∇Hᵀ I_B (x_B - H(X))`` there."""
    n_a, m_b = len(a.x), len(b.pose_at)
    new = np.flatnonzero(match < 0)
    pose_at = n_a + 3 * np.arange(m_b, dtype=np.intp)
    landmark_at = np.empty(len(match), dtype=np.intp)
    landmark_at[match >= 0] = a.landmark_at[match[match >= 0]]
    landmark_at[new] = n_a + 3 * m_b + 2 * np.arange(len(new))
    size = n_a + 3 * m_b + 2 * len(new)

    # First values of what is new come from B alone.
    start_at = a.pose_at[-1]
    px, py, heading = a.x[start_at : start_at + 3]
    c, s = np.cos(heading), np.sin(heading)
    x = np.concatenate([a.x, np.zeros(size - n_a)])
    rows = np.concatenate([b.pose_at, b.landmark_at])  # where positions begin in B
    columns = np.concatenate([pose_at, landmark_at])  # and in the joined map
    fresh = np.concatenate([np.ones(m_b, dtype=bool), match < 0])
    zx, zy = b.x[rows], b.x[rows + 1]
    x[columns[fresh]] = (px + c * zx - s * zy)[fresh]
    x[columns[fresh] + 1] = (py + s * zx + c * zy)[fresh]
    x[pose_at + 2] = heading + b.x[b.pose_at + 2]

    # H of eq. 15 and its Jacobian, everything seen from A's last pose.
    dx, dy = x[columns] - px, x[columns + 1] - py
    qx, qy = c * dx + s * dy, c * dy - s * dx
    difference = np.zeros(len(b.x))
    difference[rows], difference[rows + 1] = zx - qx, zy - qy
    difference[b.pose_at + 2] = wrap_angle(b.x[b.pose_at + 2] - (x[pose_at + 2] - heading))
    ones = np.ones(len(rows))
    turn = b.pose_at + 2
    entries = [
        (rows, columns, c * ones),
        (rows, columns + 1, s * ones),
        (rows + 1, columns, -s * ones),
        (rows + 1, columns + 1, c * ones),
        (rows, start_at * np.ones_like(rows), -c * ones),
        (rows, (start_at + 1) * np.ones_like(rows), -s * ones),
        (rows + 1, start_at * np.ones_like(rows), s * ones),
        (rows + 1, (start_at + 1) * np.ones_like(rows), -c * ones),
        (rows, (start_at + 2) * np.ones_like(rows), qy),
        (rows + 1, (start_at + 2) * np.ones_like(rows), -qx),
        (turn, pose_at + 2, np.ones(m_b)),
        (turn, (start_at + 2) * np.ones_like(turn), -np.ones(m_b)),
    ]
    i, j, v = (np.concatenate(part) for part in zip(*entries))
    J = sp.csc_matrix((v, (i, j)), shape=(len(b.x), size))
    difference[np.abs(difference) < _ROUNDING * (1.0 + np.abs(b.x))] = 0.0
    JtI = sp.csc_matrix(J.T @ b.information)
    grown = sp.csc_matrix(
        (
            a.information.data,
            a.information.indices,
            np.append(a.information.indptr, [a.information.nnz] * (size - n_a)),
        ),
        shape=(size, size),
    )
    place = np.where(match >= 0, match, len(a.landmark_at) + np.cumsum(match < 0) - 1).astype(np.intp)
    joined = JoinedMap(
        x=x,
        information=sp.csc_matrix(grown + JtI @ J),  # eq. 16
        pose_at=np.concatenate([a.pose_at, pose_at]),
        landmark_at=np.concatenate([a.landmark_at, landmark_at[new]]),
        ids=np.concatenate([a.ids, b.ids[new]]),
        entries=a.entries + tuple(place[e] for e in b.entries),
        ordered=a.ordered,
        fill=a.fill,
    )
    return joined, np.asarray(JtI @ difference)
