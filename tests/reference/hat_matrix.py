"""Leverages and expected χ² of a graph by its dense whitened Jacobian, differentiated numerically: slow and obvious."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import se2_between, se2_log
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.gps import BiasPriorRecord, GpsRecord
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.factors.sensor_biases import SensorBiasRecord, sensor_biases_at
from graphslam.graph.noise import robust_terms
from graphslam.graph.variables import Values
from tests.reference.plain_gps import gps_residual
from tests.reference.submap_model import submap_residual


def whitened_residual(record: object, values: Values) -> np.ndarray:
    """``W r`` of one factor."""
    if isinstance(record, SubmapRecord):
        row = {int(i): k for k, i in enumerate(values.landmark_ids)}
        points = values.landmarks[[row[int(i)] for i in record.landmark_ids]]
        z, W = record.own
        r = W @ submap_residual(values.poses[record.start], values.poses[record.start + 1], points, z, record.chart)
        if record.robot < 0:
            return r
        g = sensor_biases_at(values, record.robot)
        return r + record.whitener[:, len(z) :] @ g
    if isinstance(record, SensorBiasRecord):
        return record.root @ sensor_biases_at(values, record.robot) - record.offset
    if isinstance(record, BetweenRecord):
        h = se2_between(values.poses[record.i], values.poses[record.j])
        return record.whitener @ se2_log(se2_between(record.T_ij, h))
    if isinstance(record, GpsRecord):
        bias = np.zeros(2) if record.bias is None else values.biases[record.bias]
        return record.whitener @ gps_residual(values.poses[record.node], values.datum, bias, record.arm, record.z)
    assert isinstance(record, BiasPriorRecord)
    return values.biases[record.bias] / record.sigma


def numeric_jacobian(f, values: Values, step: float = 1e-6) -> np.ndarray:
    """Central differences of ``f(values)`` over all free columns."""
    n = values.layout().size
    out = []
    for k in range(n):
        d = np.zeros(n)
        d[k] = step
        out.append((f(values.retract(d)) - f(values.retract(-d))) / (2 * step))
    return np.array(out).T


def class_figures(graph: FactorGraph) -> dict[str, tuple[float, float, float]]:
    """(leverage, expected χ², χ²) of every class; the covariance of the residuals is formed whole."""
    records = list(graph.records.values())
    v = graph.values
    r = [whitened_residual(rec, v) for rec in records]
    J = np.vstack([numeric_jacobian(lambda x, rec=rec: whitened_residual(rec, x), v) for rec in records])
    w = []
    for rec, one in zip(records, r):
        kernel = getattr(rec, "robust", None)
        weight = 1.0
        if kernel is not None:
            d2 = np.array([one @ one])
            weight = float(robust_terms(d2, np.array([kernel.code]), np.array([kernel.k]))[1][0])
        w += [weight] * len(one)
    W = np.diag(w)
    P = np.linalg.inv(J.T @ W @ J)
    # r = (I - J P Jᵀ W) ε with ε ~ N(0, I)
    A = np.eye(len(w)) - J @ P @ J.T @ W
    C, H = A @ A.T, J @ P @ J.T @ W
    out: dict[str, np.ndarray] = {}
    start = 0
    for rec, one in zip(records, r):
        ix = slice(start, start + len(one))
        start += len(one)
        figures = np.array([np.trace(H[ix, ix]), np.trace(C[ix, ix]), one @ one])
        out[rec.group] = out.get(rec.group, np.zeros(3)) + figures
    return {k: tuple(x) for k, x in out.items()}
