"""Normalised innovations squared (NIS) of withheld GPS fixes, predicted by a graph.

The covariance of a prediction includes the pose of the submap base, the local path inside the submap, the datum between
map and GPS frame, and the bias of the fix segment if the graph estimates biases. Neighbouring fixes share most of it,
so their innovations are correlated and are tested jointly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.evaluate.gps_repeatability import fix_segments
from graphslam.evaluate.residual_consistency import correlated_dof, two_sided_bounds
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import GpsRecord, antenna_terms
from graphslam.graph.factors.landmark_submap import submap_jacobian
from graphslam.graph.factors.sensor_biases import sensor_biases_at
from graphslam.graph.sensors.gps import FixErrors, GpsFactors, arm_jacobian, datum_columns, lever_arm
from graphslam.graph.submap_node import SubmapNode

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsInnovations:
    """Innovations of fixes that the graph did not use, in the GPS frame.

    Parameters
    ----------
    times : (n,)
    innovations : (n, dim)
        Fix minus prediction [m].
    covariance : (dim n, dim n)
        Joint covariance of all innovations: path, datum, local path of the submap (lever), bias of the segment, and the
        fix itself.
    unpredicted : int
        Fixes outside the paths of all submaps.
    """

    times: Array
    innovations: Array
    covariance: Array
    unpredicted: int
    confidence: float = 0.95

    @property
    def dim(self) -> int:
        """Coordinates of a fix."""
        return self.innovations.shape[1]

    @property
    def blocks(self) -> Array:
        """Covariance of each innovation ``(n, dim, dim)``."""
        n, d = len(self.times), self.dim
        return self.covariance.reshape(n, d, n, d)[np.arange(n), :, np.arange(n), :]

    @property
    def normalised(self) -> Array:
        """Innovations over their own covariance ``(n, dim)``: each N(0, I), but correlated with each other."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.blocks), self.innovations[..., None])[..., 0])

    @property
    def whitened(self) -> Array:
        """Innovations given all earlier ones ``(n, dim)``: independent N(0, 1) if all covariances are right."""
        L = np.linalg.cholesky(self.covariance)
        return np.asarray(np.linalg.solve(L, self.innovations.ravel()).reshape(-1, self.dim))

    @property
    def nis(self) -> Array:
        """Normalised innovation squared of every fix ``(n,)``, with ``dim`` degrees of freedom."""
        return np.asarray(np.sum(self.normalised**2, axis=1))

    @property
    def rmse(self) -> float:
        """Root mean square of the innovations' lengths [m]."""
        return float(np.sqrt(np.mean(np.sum(self.innovations**2, axis=1))))

    def facts(self) -> dict[str, list[Any]]:
        """Entries of ``run.json`` per fix: time, innovation and its σ along each axis, NIS; six digits."""
        sigmas = np.sqrt(np.diagonal(self.blocks, axis1=1, axis2=2))
        return {
            "times": self.times.tolist(),
            "innovations": [[_six(v) for v in row] for row in self.innovations],
            "sigmas": [[_six(v) for v in row] for row in sigmas],
            "nis": [_six(v) for v in self.nis],
        }

    def tests(self) -> list[dict[str, Any]]:
        """Two tests, one row each: ``value`` is 1 if consistent, ``low … high`` its two-sided bounds.

        ``each``: mean of NIS/dim of the single fixes, bounds by :func:`correlated_dof`; tests the size of the predicted
        covariances. ``joint``: NIS of all fixes together over dim n, bounds by χ²; also tests their correlations.
        ``autocorrelation``: lag-1 correlation of the row's residuals over neighbours in time; ``white``: 95 % limit of
        its absolute value for independent residuals.
        """
        n, d = len(self.times), self.dim
        rows = []
        close = np.diff(self.times) < 2.0 * np.median(np.diff(self.times)) if n > 1 else np.zeros(0, dtype=bool)
        parts = (("each", self.normalised, correlated_dof(self.covariance, d)), ("joint", self.whitened, float(d * n)))
        for name, y, dof in parts:
            value = float(np.sum(y**2) / (d * n))
            low, high, verdict = two_sided_bounds(value, dof, self.confidence)
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
                    "inside": float(np.mean(np.sum(y**2, axis=1) < chi2_quantile(self.confidence, d))),
                    "autocorrelation": float(np.sum(pairs) / np.sum(y[1:][close] ** 2)) if len(pairs) else np.nan,
                    "white": float(1.96 / np.sqrt(d * len(pairs))) if len(pairs) else np.nan,
                    "confidence": self.confidence,
                }
            )
        return rows


def _six(value: float) -> float:
    return float(f"{value:.6g}")


def gps_innovations(
    graph: FactorGraph,
    gps: Gps,
    *,
    sigma: float | None = None,
    bias_sigma: float | None = None,
    segment_gap: float = 2.0,
    confidence: float = 0.95,
) -> GpsInnovations:
    """Predict fixes that are not in the graph.

    Parameters
    ----------
    graph : FactorGraph
        At its optimum, with other GPS fixes: without them there is no datum.
    gps : Gps
        The withheld fixes.
    sigma : float, optional
        σ of each coordinate [m] in place of the noise of the stream.
    bias_sigma : float, optional
        Prior σ of a segment's bias in the graph [m], if it has biases. A fix within ``segment_gap`` of a used one gets
        its bias; the others get a new bias per segment.
    segment_gap : float
        Pause that starts a new segment [s].
    """
    values, lay = graph.values, graph.flat().layout
    if values.datum is None or graph.gps_origin is None:
        raise DataError("withheld fixes cannot be predicted: the graph has no GPS datum", wanted="a graph with GPS")
    node, arm, arm_cov, inner = antenna_places(graph, gps.times, gps.lever[: graph.dim])
    found = node >= 0
    if not np.any(found):
        raise DataError("no withheld fix lies inside a submap's path", got=len(gps.times))
    d = graph.dim
    times, z = gps.times[found], gps.positions[found, :d] - graph.gps_origin
    node, arm = node[found], arm[found]
    n = len(times)
    fitted = GpsFactors.of(graph).fitted
    correlated = fitted is not None and fitted.bias_sigma > 0
    bias = np.full(n, -1, dtype=np.int64) if correlated else _biases(graph, times, bias_sigma, segment_gap)
    own = (bias >= 0) & (bias < len(values.biases))
    predicted, by = antenna_terms(values.poses[node], values.datum, values.tilt, arm)
    predicted[own] += values.biases[bias[own]]
    each = gps.noise[found][:, :d, :d] if sigma is None else np.tile(sigma**2 * np.eye(d), (n, 1, 1))

    # everything the innovations depend on: nodes, datum, tilt, biases, and the variables of a landmark submap; the
    # first base is fixed and has no column
    base = datum_columns(graph, node)
    columns = np.concatenate([base, lay.at("bias", np.where(own, bias, -1))], axis=1)
    J = np.concatenate([by[:, :, : base.shape[1]], np.tile(np.eye(d), (n, 1, 1))], axis=2)
    parts = [(slice(d * k, d * k + d), c, j) for k, (c, j) in enumerate(zip(columns, J))]
    turn = by[:, :, :2] if d == 2 else by[:, :, 3:6]  # the node's axes in the GPS frame
    rank = np.cumsum(found) - 1
    for antennas in inner:
        for k, fix in enumerate(rank[antennas.fixes].tolist()):
            moved = turn[fix] @ antennas.jacobian[2 * k : 2 * k + 2]
            parts.append((slice(d * fix, d * fix + d), antennas.columns, moved))
    needed = np.unique(np.concatenate([c for _, c, _ in parts]))
    needed = needed[needed >= 0]
    A = np.zeros((d * n, len(needed)))
    between = np.zeros((n, d, n, d))
    if fitted is not None and correlated:  # bias interpolated between those of the used fixes
        known, numbers = _used_biases(graph)
        gain, left = _bridged(times, known, fitted)
        U = np.linalg.cholesky(each / (0.5 * np.trace(each[:, :2, :2], axis1=1, axis2=2))[:, None, None])
        between = np.einsum("ab,aij,bkj->aibk", left, U, U, optimize=True)
        predicted += gain @ values.biases[numbers]
        for k in range(n):
            near = np.flatnonzero(np.abs(gain[k]) > 1e-9)
            j = np.einsum("q,ij->iqj", gain[k, near], np.eye(d)).reshape(d, -1)
            parts.append((slice(d * k, d * k + d), lay.at("bias", numbers[near]).ravel(), j))
        needed = np.unique(np.concatenate([c for _, c, _ in parts]))
        needed = needed[needed >= 0]
        A = np.zeros((d * n, len(needed)))
    for rows, c, j in parts:
        free = np.flatnonzero(c >= 0)
        np.add.at(A, np.ix_(np.arange(rows.start, rows.stop), np.searchsorted(needed, c[free])), j[:, free])
    S = A @ graph.covariance().columns(needed) @ A.T
    S = S.reshape(n, d, n, d) + between
    new = (bias >= 0) & ~own
    if np.any(new):
        assert bias_sigma is not None
        same = (bias[:, None] == bias[None]) & new[:, None]
        S += bias_sigma**2 * same[:, None, :, None] * np.eye(d)[None, :, None, :]
    arm_cov = arm_cov.reshape(len(found), d, len(found), d)[np.ix_(found, np.arange(d), found, np.arange(d))]
    S += np.einsum("aij,ajbk,bmk->aibm", turn, arm_cov, turn, optimize=True)
    if fitted is not None:
        each = fitted.white**2 * each
    S[np.arange(n), :, np.arange(n)] += each
    S = S.reshape(d * n, d * n)
    return GpsInnovations(
        times=times,
        innovations=z - predicted,
        covariance=0.5 * (S + S.T),
        unpredicted=int(np.sum(~found)),
        confidence=confidence,
    )


@dataclass(frozen=True, slots=True, eq=False)
class InnerAntennas:
    """Fixes on the path of a landmark submap, conditioned on the variables of the graph.

    Parameters
    ----------
    fixes : (k,)
        Indices of the fixes.
    places : (k, 2)
        Antennas in the submap's base frame [m].
    columns : (c,)
    jacobian : (2k, c)
        Of the antennas in the base frame, with a fixed base.
    left : (2k, 2k)
        Conditional covariance [m²].
    """

    fixes: Ints
    places: Array
    columns: Ints
    jacobian: Array
    left: Array


def _inner(graph: FactorGraph, s: SubmapNode, fixes: Ints, points: Ints) -> InnerAntennas:
    """Path points, conditioned on exit, landmarks, and the path points that are variables of the graph."""
    inner, values, lay = s.inner_points, graph.values, graph.flat().layout
    assert inner is not None
    ids = graph.landmark_ids_of(s.key)
    used = sorted(inner.rows)
    rows = np.array([inner.rows[k] for k in used], dtype=np.int64)
    path, ix, own = inner.path, inner.path.scalars(points), inner.path.scalars(used)
    joint = np.block([[inner.joint, path.cross[own].T], [path.cross[own], path.covariance[np.ix_(own, own)]]])
    cross = np.hstack([path.cross[ix], path.covariance[np.ix_(ix, own)]])
    gain = np.linalg.solve(joint, cross.T).T
    z = np.concatenate([inner.mean, path.positions[used].ravel()])
    if inner.biases is not None:  # shifted by the sensor biases that the graph estimated
        g = sensor_biases_at(values, s.robot)
        z = z + np.concatenate([inner.biases.response, inner.biases.points[own]]) @ g
        path = replace(path, positions=path.positions + (inner.biases.points @ g).reshape(-1, 2))
    marks = np.array([lay.row_of[i] for i in ids.tolist()], dtype=np.int64)
    places = np.concatenate([values.landmarks[marks].reshape(-1, 2), values["point"][rows].reshape(-1, 2)])
    record = graph.records[s.factor_id]
    chart = str(getattr(record, "chart", "cartesian"))
    u, J = submap_jacobian((values.poses[s.node], values.poses[s.exit_node]), places, z, chart)
    V = np.linalg.inv(-J[:2, :2])  # V⁻¹: maps a residual of the parametrisation to a difference in the base frame
    off = (gain @ u).reshape(-1, 2) @ V.T
    columns = np.concatenate(
        [
            lay.pose_columns(np.array([s.node, s.exit_node])).ravel(),
            lay.at("l", marks).ravel(),
            lay.at("point", rows).ravel(),
        ]
    )
    left = inner.scale * (path.covariance[np.ix_(ix, ix)] - gain @ cross.T)
    turned = np.kron(np.eye(len(points)), V)
    return InnerAntennas(fixes, path.positions[points] + off, columns, turned @ gain @ J, 0.5 * (left + left.T))


def antenna_places(graph: FactorGraph, times: Array, lever: Array) -> tuple[Ints, Array, Array, list[InnerAntennas]]:
    """Node at each time (-1: none), antenna in its frame, joint covariance of these points ``(dim n, dim n)``.

    Fixes between two nodes share the path error since the first node. Fixes on the path of a landmark submap use the
    joint Gaussian of that submap.
    """
    n, d = len(times), graph.dim
    node, arm, cov = np.full(n, -1, dtype=np.int64), np.zeros((n, d)), np.zeros((d * n, d * n))
    inner: list[InnerAntennas] = []
    for k, s in enumerate(graph.submaps):
        path = s.trajectory
        if path is None or not len(path):
            continue
        t0, t1 = max(s.interval[0], path.times[0]), min(s.interval[1], path.times[-1])
        last = k == len(graph.submaps) - 1
        inside = (times >= t0) & ((times <= t1) if last else (times < t1))
        known = s.inner_points
        if known is not None:
            mine = np.flatnonzero(inside)
            at = [known.path.at(t, lever) for t in times[mine].tolist()]
            pairs = [(f, p) for f, p in zip(mine.tolist(), at) if p is not None]
            if pairs:
                antennas = _inner(graph, s, np.array([f for f, _ in pairs]), np.array([p for _, p in pairs]))
                inner.append(antennas)
                inside[antennas.fixes] = False
                node[antennas.fixes], arm[antennas.fixes] = s.node, antennas.places
                ix = (d * antennas.fixes[:, None] + np.arange(d)).ravel()
                cov[np.ix_(ix, ix)] = antennas.left
        at_node = s.before(times)
        for i in range(len(s.nodes) - 1):
            rows = np.flatnonzero(inside & (at_node == i))
            if len(rows):
                T, P = s.local(times[rows], at_node[rows])
                node[rows] = s.nodes[i]
                arm[rows], _ = lever_arm(T, None, lever)
                ix = (d * rows[:, None] + np.arange(d)).ravel()
                cov[np.ix_(ix, ix)] = _arm_covariance(T, P, lever)
    return node, arm, cov, inner


def _arm_covariance(T: Array, P: Array | None, lever: Array) -> Array:
    """Joint covariance ``(dim q, dim q)`` of the antenna at poses ``(q, 3|7)`` between two nodes.

    Only marginals of the path are stored. The correlations are those of dead reckoning, ``ξ_j = Ad(T_ij⁻¹) ξ_i + w``
    with independent w.
    """
    q, group = len(T), group_of(T)
    d, dof = group.dim, group.dof
    if P is None:
        return np.zeros((d * q, d * q))
    G = arm_jacobian(T, lever)
    joint = np.zeros((q, dof, q, dof))
    for j in range(q):
        joint[j, :, j] = P[j]
        if j == 0:
            continue
        ad = group.adjoint(group.inverse(group.between(T[j - 1], T[j])))
        carried = ad @ joint[j - 1, :, j - 1] @ ad.T
        values, vectors = np.linalg.eigh(P[j] - carried)
        joint[j, :, j] = carried + (vectors * np.maximum(values, 0.0)) @ vectors.T  # w has no negative variance
        joint[j, :, :j] = np.einsum("ij,jkl->ikl", ad, joint[j - 1, :, :j])
        joint[:j, :, j] = joint[j, :, :j].transpose(1, 2, 0)
    return np.asarray(np.einsum("aij,ajbk,bmk->aibm", G, joint, G, optimize=True).reshape(d * q, d * q))


def _used_biases(graph: FactorGraph) -> tuple[Array, Ints]:
    """Times of the used fixes with a bias, in order, and the indices of the biases."""
    used = sorted((r.time, r.bias) for r in graph.records.values() if isinstance(r, GpsRecord) and r.bias is not None)
    return np.array([t for t, _ in used]), np.array([b for _, b in used], dtype=np.int64)


def _bridged(times: Array, known: Array, errors: FixErrors) -> tuple[Array, Array]:
    """A Gauss–Markov process at times ``(n,)``, given its values at times ``(m,)``: gain and conditional covariance."""

    def alike(a: Array, b: Array) -> Array:
        return np.asarray(errors.bias_sigma**2 * np.exp(-np.abs(a[:, None] - b) / errors.bias_time))

    own = alike(known, known) + 1e-9 * errors.bias_sigma**2 * np.eye(len(known))
    gain = np.linalg.solve(own, alike(known, times)).T
    gain[np.abs(gain) < 1e-6] = 0.0  # keep neighbours only
    left = alike(times, times) - gain @ alike(known, times)
    return np.asarray(gain), 0.5 * (left + left.T)


def _biases(graph: FactorGraph, times: Array, bias_sigma: float | None, gap: float) -> Ints:
    """Index of the bias of every fix: one of the graph's, a new one (numbered after them), or -1."""
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
