"""How well a graph foretells the GPS fixes that it was not given: normalised innovations squared (NIS).

The prediction of a fix has a covariance of its own: of the path where the submap begins, of the local path inside the
submap, of the datum that ties the map to the GPS frame, of the bias of the segment where the graph knows biases.
Neighbouring fixes share most of it, so their innovations are correlated and must be judged together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, rotation2, se2_adjoint, se2_between, se2_compose, se2_inverse, se2_transform
from graphslam.core.records import Gps
from graphslam.evaluate.gps_floor import fix_segments
from graphslam.evaluate.without_truth import correlated_dof, two_sided
from graphslam.graph.factors.gps import GpsRecord, gps_terms
from graphslam.graph.gps import lever_arm
from graphslam.graph.pose_graph import PoseGraph

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsInnovations:
    """Fixes that the graph did not use, against where it predicts them; everything in the GPS frame.

    Parameters
    ----------
    times : (n,)
    innovations : (n, 2)
        Fix less prediction [m].
    covariance : (2n, 2n)
        Joint covariance of all innovations: path, datum, local path of the submap (lever), bias of the segment, and
        the fix itself.
    unpredicted : int
        Fixes outside every submap's path.
    confidence : float
    """

    times: Array
    innovations: Array
    covariance: Array
    unpredicted: int
    confidence: float = 0.95

    @property
    def blocks(self) -> Array:
        """Covariance of every innovation by itself ``(n, 2, 2)``."""
        n = len(self.times)
        return self.covariance.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n), :]

    @property
    def normalised(self) -> Array:
        """Innovations over their own covariance ``(n, 2)``: each N(0, I), but correlated with each other."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.blocks), self.innovations[..., None])[..., 0])

    @property
    def whitened(self) -> Array:
        """Innovations given all earlier ones ``(n, 2)``: independent N(0, 1) if everything stated is right."""
        L = np.linalg.cholesky(self.covariance)
        return np.asarray(np.linalg.solve(L, self.innovations.ravel()).reshape(-1, 2))

    @property
    def nis(self) -> Array:
        """Normalised innovation squared of every fix ``(n,)``, two degrees of freedom each."""
        return np.asarray(np.sum(self.normalised**2, axis=1))

    def tests(self) -> pd.DataFrame:
        """Two tests, one row each: ``value`` is 1 if the prediction is honest, ``low … high`` its two-sided bounds.

        ``each`` is the mean NIS/2 of the fixes by themselves, bounds by :func:`correlated_dof`: are the predicted
        covariances of the right size? ``joint`` is the NIS of all of them together over 2n, bounds by ``χ²_2n``: are
        they also correlated as the model says? ``autocorrelation`` is the lag-1 correlation of what stands in the row,
        over neighbours in time; ``white`` the 95 % limit of its absolute value for independent ones.
        """
        n = len(self.times)
        rows = []
        close = np.diff(self.times) < 2.0 * np.median(np.diff(self.times)) if n > 1 else np.zeros(0, dtype=bool)
        parts = (("each", self.normalised, correlated_dof(self.covariance, 2)), ("joint", self.whitened, 2.0 * n))
        for name, y, dof in parts:
            value = float(np.sum(y**2) / (2 * n))
            low, high, verdict = two_sided(value, dof, self.confidence)
            pairs = y[1:][close] * y[:-1][close]
            rows.append(
                {
                    "test": name,
                    "value": value,
                    "low": low,
                    "high": high,
                    "verdict": verdict,
                    "dof": dof,
                    "fixes": n,
                    "inside": float(np.mean(np.sum(y**2, axis=1) < stats.chi2.ppf(self.confidence, 2))),
                    "autocorrelation": float(np.sum(pairs) / np.sum(y[1:][close] ** 2)) if len(pairs) else np.nan,
                    "white": float(1.96 / np.sqrt(2 * len(pairs))) if len(pairs) else np.nan,
                    "confidence": self.confidence,
                }
            )
        return pd.DataFrame(rows)


def gps_innovations(
    graph: PoseGraph,
    gps: Gps,
    *,
    sigma: float | None = None,
    bias_sigma: float | None = None,
    segment_gap: float = 2.0,
    confidence: float = 0.95,
) -> GpsInnovations:
    """Predict fixes that the graph does not hold.

    Parameters
    ----------
    graph : PoseGraph
        At its optimum, with GPS of its own: without it there is no datum to predict from.
    gps : Gps
        The withheld fixes.
    sigma : float, optional
        σ of each coordinate [m] in place of the stream's own.
    bias_sigma : float, optional
        The graph's prior of a segment's bias [m], where it has biases. A fix within ``segment_gap`` of a used one has
        its bias; the others share a new one per segment.
    segment_gap : float
        [s]

    Raises
    ------
    DataError
        The graph has no datum, is in space, or no fix lies inside a submap's path.
    """
    if graph.dim != 2:
        raise DataError("withheld fixes are predicted in the plane only", got=f"a graph of {graph.dim} dimensions")
    values, lay = graph.values, graph.flat().layout
    if values.datum is None or graph.gps_origin is None:
        raise DataError("withheld fixes cannot be predicted: the graph has no GPS datum", wanted="a graph with GPS")
    node, arm, arm_cov = _arms(graph, gps)
    found = node >= 0
    if not np.any(found):
        raise DataError("no withheld fix lies inside a submap's path", got=len(gps.times))
    times, z = gps.times[found], gps.positions[found, :2] - graph.gps_origin
    node, arm = node[found], arm[found]
    n = len(times)
    bias = _biases(graph, times, bias_sigma, segment_gap)
    own = bias < len(values.biases)
    with_bias = np.where(own, bias, -1)
    predicted = se2_transform(se2_compose(np.broadcast_to(values.datum, (n, 3)), values.poses[node]), arm)
    known = with_bias >= 0
    given = np.zeros((n, 2))
    given[known] = values.biases[with_bias[known]]
    predicted += given
    _, J = gps_terms(
        values.poses[node], values.datum, given, arm, predicted
    )  # where the fix should be, not where it is
    J[~known, :, 6:] = 0.0
    R = rotation2(values.datum[2]) @ rotation2(values.poses[node, 2])  # base frame → GPS frame
    if bias_sigma is not None or len(values.biases):
        J[:, :, 6:8] = np.where((bias >= 0)[:, None, None], np.swapaxes(R, 1, 2), 0.0)

    # everything the innovations depend on: nodes, datum, biases; the first base is fixed and has no column
    pose_columns = np.where(node[:, None] > 0, 3 * (node[:, None] - 1) + np.arange(3), -1)
    datum_columns = np.tile(lay.start("datum") + np.arange(3), (n, 1))
    bias_columns = np.where((own & (bias >= 0))[:, None], lay.start("bias") + 2 * bias[:, None] + np.arange(2), -1)
    columns = np.concatenate([pose_columns, datum_columns, bias_columns], axis=1)
    needed, at = np.unique(columns, return_inverse=True)
    at = at.reshape(columns.shape)
    first = int(needed[0] < 0)
    A = np.zeros((n, 2, len(needed)))
    np.put_along_axis(A, np.broadcast_to(at[:, None], J.shape).copy(), J, axis=2)
    jacobian = A[:, :, first:].reshape(2 * n, -1)
    S = jacobian @ graph.covariance().columns(needed[first:]) @ jacobian.T
    fresh = bias[~own]
    if len(fresh):
        assert bias_sigma is not None
        rows = np.flatnonzero(~own)
        same = fresh[:, None] == fresh[None]
        cross = bias_sigma**2 * same[:, :, None, None] * (np.swapaxes(R[rows], 1, 2)[:, None] @ R[rows][None])
        ix = (2 * rows[:, None] + np.arange(2)).ravel()
        S[np.ix_(ix, ix)] += cross.transpose(0, 2, 1, 3).reshape(len(ix), -1)
    S += arm_cov[np.ix_(np.repeat(found, 2), np.repeat(found, 2))]
    noise = gps.sigma[found] if sigma is None else np.full(n, sigma)
    S[np.arange(2 * n), np.arange(2 * n)] += np.repeat(noise**2, 2)

    turned = np.einsum("kij,kjm->kim", R, S.reshape(n, 2, 2 * n)).reshape(2 * n, n, 2)
    S = np.einsum("mkj,kij->mki", turned, R).reshape(2 * n, 2 * n)
    return GpsInnovations(
        times=times,
        innovations=z - predicted,
        covariance=0.5 * (S + S.T),
        unpredicted=int(np.sum(~found)),
        confidence=confidence,
    )


def _arms(graph: PoseGraph, gps: Gps) -> tuple[Ints, Array, Array]:
    """Node of every fix (-1: none), antenna in its frame, joint covariance of these points ``(2n, 2n)``.

    Fixes of one stretch of path, from a node to the next, share what the path has lost since the node.
    """
    n = len(gps.times)
    node, arm, cov = np.full(n, -1, dtype=np.int64), np.zeros((n, 2)), np.zeros((2 * n, 2 * n))
    for k, s in enumerate(graph.submaps):
        path = s.trajectory
        if path is None or not len(path):
            continue
        t0, t1 = max(s.interval[0], path.times[0]), min(s.interval[1], path.times[-1])
        last = k == len(graph.submaps) - 1
        inside = (gps.times >= t0) & ((gps.times <= t1) if last else (gps.times < t1))
        at = s.before(gps.times)
        for i in range(len(s.nodes) - 1):
            rows = np.flatnonzero(inside & (at == i))
            if len(rows):
                T, P = s.local(gps.times[rows], at[rows])
                node[rows] = s.nodes[i]
                arm[rows], _ = lever_arm(T, None, gps.lever[:2])
                ix = (2 * rows[:, None] + np.arange(2)).ravel()
                cov[np.ix_(ix, ix)] = _arm_covariance(T, P, gps.lever[:2])
    return node, arm, cov


def _arm_covariance(T: Array, P: Array | None, lever: Array) -> Array:
    """Joint covariance ``(2q, 2q)`` of the antenna at several poses ``(q, 3)`` of one stretch of path.

    The path is told by its marginals; between them it is taken as a process whose error is carried along and grows,
    ``ξ_j = Ad(T_ij⁻¹) ξ_i + w``, as that of dead reckoning does.
    """
    q = len(T)
    if P is None:
        return np.zeros((2 * q, 2 * q))
    G = np.zeros((q, 2, 3))
    G[:, :, :2] = rotation2(T[:, 2])
    G[:, :, 2] = rotation2(T[:, 2]) @ np.array([-lever[1], lever[0]])
    joint = np.zeros((q, 3, q, 3))
    for j in range(q):
        joint[j, :, j] = P[j]
        if j == 0:
            continue
        ad = se2_adjoint(se2_inverse(se2_between(T[j - 1], T[j])))
        carried = ad @ joint[j - 1, :, j - 1] @ ad.T
        values, vectors = np.linalg.eigh(P[j] - carried)
        joint[j, :, j] = carried + (vectors * np.maximum(values, 0.0)) @ vectors.T  # an error never shrinks by itself
        joint[j, :, :j] = np.einsum("ij,jkl->ikl", ad, joint[j - 1, :, :j])
        joint[:j, :, j] = joint[j, :, :j].transpose(1, 2, 0)
    out = np.einsum("aij,ajbk->aibk", G, joint)
    return np.asarray(np.einsum("aibk,bmk->aibm", out, G).reshape(2 * q, 2 * q))


def _biases(graph: PoseGraph, times: Array, bias_sigma: float | None, gap: float) -> Ints:
    """Bias of every fix: one of the graph's, a new one (numbered on from the graph's), or -1."""
    used = sorted((r.time, r.bias) for r in graph.records.values() if isinstance(r, GpsRecord) and r.bias is not None)
    if bias_sigma is None:
        if used:
            raise DataError("the graph has GPS biases", got="no bias_sigma", wanted="the prior that it was built with")
        return np.full(len(times), -1, dtype=np.int64)
    known = np.array([t for t, _ in used])
    out = np.full(len(times), -1, dtype=np.int64)
    if len(known):
        j = np.clip(np.searchsorted(known, times), 1, len(known) - 1) if len(known) > 1 else np.zeros(len(times), int)
        if len(known) > 1:
            j = np.where(times - known[j - 1] < known[j] - times, j - 1, j)
        near = np.abs(known[j] - times) <= gap
        out[near] = np.array([b for _, b in used])[j[near]]
    rest = np.flatnonzero(out < 0)
    out[rest] = len(graph.values.biases) + fix_segments(times[rest], gap)
    return out
