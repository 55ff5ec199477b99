"""Wrong landmark identities: a test of every observation against the whole map, at the optimum.

A barcode misread three times in a row, or a wrong association, gives a landmark of a submap the identity of another.
Only the whole map reveals it. The test is that of Baarda (1968, "data snooping"): by how much does the objective
decrease if landmark i of a submap may be displaced by an unknown amount?
With the submap's residual r, its information Ω and the covariance of the residual ``S = Ω⁻¹ - J P Jᵀ``::

    T_i = (Ω r)_iᵀ [(Ω S Ω)_ii]⁻¹ (Ω r)_i      ~ χ² with 2 degrees of freedom if nothing is wrong

An observation that fails is split off into a landmark of its own (:meth:`FactorGraph.split_landmark`): the submap keeps
all its internal information, and the event log records the split.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.landmark_submap import SubmapRecord, submap_jacobian
from graphslam.graph.factors.sensor_biases import sensor_biases_at


@dataclass(frozen=True, slots=True)
class AssociationOutlier:
    """An observation whose landmark identity is inconsistent with the map.

    Parameters
    ----------
    factor_id, entry : int
        Factor, and index of the landmark in its submap.
    statistic : float
        Decrease of the objective if the landmark were free.
    """

    factor_id: int
    entry: int
    landmark_id: int
    statistic: float


def identity_statistics(graph: FactorGraphState, record: SubmapRecord) -> Array:
    """``T_i`` of every landmark ``(n,)`` of one submap factor at the graph's values; nan where no other submap has it.

    The values must be the optimum: ``S`` is the covariance of the residuals there.
    """
    ids = record.landmark_ids
    n = len(ids)
    lonely = np.array([len(graph.detections(int(i))) < 2 for i in ids])
    if n == 0 or bool(lonely.all()):
        return np.full(n, np.nan)
    ends = graph.values.poses[record.start], graph.values.poses[record.start + 1]
    points = np.array([graph.landmark(int(i)) for i in ids])
    if record.robot >= 0:
        points = np.concatenate([points, sensor_biases_at(graph.values, record.robot).reshape(-1, 2)])
    r, J_entries = submap_jacobian(ends, points, record.z, record.chart, n)
    variables = record.variables()
    column = {name: k for k, name in enumerate(variables[2:])}
    J = np.zeros((len(r), 6 + 2 * len(column)))
    J[:, :6] = J_entries[:, :6]
    for k, name in enumerate(record.entries()):
        c = 6 + 2 * column[name]
        J[:, c : c + 2] += J_entries[:, 6 + 2 * k : 8 + 2 * k]
    if record.start == 0:
        J = J[:, 3:]  # the first base is fixed and has no columns
    P = graph.covariance().joint(variables)
    omega = record.whitener.T @ record.whitener
    g = (omega @ r)[3 : 3 + 2 * n].reshape(n, 2)
    JtO = J.T @ omega
    C = omega - JtO.T @ P @ JtO  # Ω S Ω
    rows = 3 + 2 * np.arange(n)[:, None] + np.arange(2)
    blocks = C[rows[:, :, None], rows[:, None, :]]
    # a landmark that only this submap constrains has no redundancy: its block vanishes
    share = np.linalg.eigvalsh(blocks)[:, 0] / np.maximum(np.trace(omega[3 : 3 + 2 * n, 3 : 3 + 2 * n]) / n, 1e-300)
    testable = ~lonely & (share > 1e-9)
    out = np.full(n, np.nan)
    if np.any(testable):
        y = np.linalg.solve(blocks[testable], g[testable][..., None])[..., 0]
        out[testable] = np.sum(g[testable] * y, axis=1)
    return out


def find_association_outliers(graph: FactorGraphState, gate: float) -> list[AssociationOutlier]:
    """Observations whose statistic exceeds ``gate``, the largest first.

    One wrong identity raises the statistics of others, too: split off the largest only, solve and test again.
    """
    found = []
    for record in graph.records.values():
        if isinstance(record, SubmapRecord):
            T = identity_statistics(graph, record)
            beyond = np.flatnonzero(np.nan_to_num(T) > gate)
            found += [
                AssociationOutlier(record.factor_id, int(k), int(record.landmark_ids[k]), float(T[k])) for k in beyond
            ]
    return sorted(found, key=lambda d: -d.statistic)
