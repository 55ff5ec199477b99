"""Error model of GPS fixes, fitted to the log: bias σ, correlation time and white noise.

A receiver states a σ as if its errors were independent, but real errors are correlated over about a minute. Model::

    z = T_gps_world(p) + b + w,      b Gauss–Markov (σ s_b, time constant τ),  w white (m times the stated σ),

(s_b, τ, m) maximise the likelihood of the innovations of a subset of the fixes against the antenna positions of the map
*without* fixes, with their joint covariance, at the values of the robust optimum. The bias is accepted if twice its
gain in log-likelihood over white noise of any size is above :data:`GATE`; then every fix has a bias, linked to that of
the previous fix. Without a bias, larger white noise is accepted by the same gate; smaller noise is never used.

Before that, fixes farther than :data:`WILD` σ from the robust optimum are removed, because a Gaussian bias would follow
them; σ is larger than stated if the median distance is, or most fixes of an optimistic receiver would be removed.
Without a robust kernel none are removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import linalg, optimize

from graphslam.core.errors import IndeterminateError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import BiasPriorRecord, GpsBatch, GpsRecord
from graphslam.graph.noise import whitener
from graphslam.graph.sensors.gps import FixErrors, GpsFactors

GATE = 8.0
"""Gate on twice the gain in log-likelihood: with two more parameters, white noise exceeds it in one of 50 logs."""
WILD = 4.0
"""A fix farther off than this multiple of its σ is an outlier."""
LEAST = 24
"""Minimum number of fixes to estimate the correlation time."""
MOST = {2: 200, 3: 130}
"""Largest number of innovations, by dimension."""
EVERY = 3
"""Every fix up to every third one is used; from a longer log …"""
TOGETHER = 40
"""… blocks of this number of fixes, so that short and long correlation times can be estimated."""
NAT = 0.5
"""Of all parameters with a log-likelihood this close to the best, those with the strongest bias are used: a bias that
is too small makes a map overconfident, one that is too large costs accuracy."""
LOOSE = 1e3
"""Prior σ of each component of the datum, which is unobservable without fixes."""


def fit_fix_errors(graph: FactorGraph) -> FixErrors | None:
    """Fit the errors of the fixes of a graph at its optimum, and update the graph.

    The caller must solve the graph again. Returns None if nothing was changed.
    """
    gps = GpsFactors.of(graph)
    fixes = sorted((r for r in graph.records.values() if isinstance(r, GpsRecord)), key=lambda r: r.time)
    if gps.fitted is not None or len(fixes) < LEAST or any(r.bias is not None or r.stated is None for r in fixes):
        return None
    off = _distances(graph, fixes)
    limit = WILD * max(1.0, float(np.median(off)) / np.sqrt(chi2_quantile(0.5, len(fixes[0].z))))
    wild = [r for r, d in zip(fixes, off) if d > limit and r.robust.kind != "none"]
    kept = [r for r, d in zip(fixes, off) if d <= limit or r.robust.kind == "none"]
    if len(kept) < LEAST:
        return None
    try:
        seen = _Innovations.of(graph, kept)
        found = seen.fit()
    except (IndeterminateError, np.linalg.LinAlgError):  # without fixes there is no map to compare with
        return None
    if found is None and not wild:
        return None
    errors = replace(found or FixErrors(0.0, np.inf, 1.0, 0.0), wild=len(wild), fixes=len(fixes))
    for r in wild:
        del graph.records[r.factor_id]
        graph.ledger.release(r.factor_id)
    graph.revision += 1
    _put(graph, kept, errors)
    gps.fitted = errors
    graph.log_event(
        "gps-errors", fixes=len(fixes), wild=len(wild), bias_sigma=errors.bias_sigma, white=errors.white,
        bias_time=errors.bias_time if np.isfinite(errors.bias_time) else None, gain=errors.gain,
    )  # fmt: skip
    return errors


def _batch(graph: FactorGraph, fixes: list[GpsRecord]) -> GpsBatch:
    return GpsBatch(fixes, graph.flat().layout)


def _distances(graph: FactorGraph, fixes: list[GpsRecord]) -> Array:
    """Residual norm of each fix in units of its σ."""
    return np.asarray(np.sqrt(_batch(graph, fixes).squared(graph.values)))


@dataclass(frozen=True, slots=True, eq=False)
class _Innovations:
    """Fixes minus predicted antenna positions of the map without fixes, in the frame of the fixes.

    Parameters
    ----------
    times : (n,)
    y : (n d,)
    known : (n d, n d)
        Covariance of the prediction, with that of the lever arms.
    stated : (n, d, d)
        Stated by the receiver.
    span : float
        Duration of the whole log [s].
    """

    times: Array
    y: Array
    known: Array
    stated: Array
    span: float

    @classmethod
    def of(cls, graph: FactorGraph, fixes: list[GpsRecord]) -> _Innovations:
        """At the graph's values: one Gauss–Newton step towards the optimum without fixes."""
        flat, values, d = graph.flat(), graph.values, graph.dim
        w = np.array([0.0 if isinstance(r, GpsRecord) else 1.0 for r in flat.records])
        free = flat.evaluate(values, weights=w)
        A = free.A.copy()
        at_datum = flat.layout.columns("datum")
        A[at_datum, at_datum] += LOOSE**-2 if isinstance(A, np.ndarray) else np.full(len(at_datum), LOOSE**-2)
        covariance = JointCovariance(flat.layout, A)
        chosen = [fixes[k] for k in spread_fixes(len(fixes), MOST[d])]
        batch = _batch(graph, chosen)
        r, J = batch.terms(*batch.gather(values))
        turn = batch.turns(values)
        r, J = np.einsum("kij,kj->ki", turn, r), turn @ J
        n = len(chosen)
        columns = batch.columns.reshape(n, -1)
        needed = np.unique(columns[columns >= 0])
        M = np.zeros((n * d, len(needed)))
        for k in range(n):
            own = np.flatnonzero(columns[k] >= 0)
            np.add.at(M, np.ix_(np.arange(d * k, d * k + d), np.searchsorted(needed, columns[k][own])), J[k][:, own])
        step = -covariance.solve(free.g)[needed]
        known = M @ covariance.columns(needed) @ M.T
        stated = np.stack([np.asarray(f.stated) for f in chosen])
        for k, f in enumerate(chosen):  # uncertainty of the lever arm
            own = np.linalg.inv(f.whitener.T @ f.whitener)
            arm = turn[k] @ own @ turn[k].T - stated[k]
            known[d * k : d * k + d, d * k : d * k + d] += 0.5 * (arm + arm.T)
        span = fixes[-1].time - fixes[0].time
        return cls(np.array([f.time for f in chosen]), r.ravel() + M @ step, known, stated, span)

    def likelihood(self, bias: float, time: float, white: float) -> float:
        """Log-likelihood up to a constant; -inf if it cannot be computed."""
        n, d = len(self.times), self.stated.shape[1]
        C = self.known.copy().reshape(n, d, n, d)
        k = np.arange(n)
        C[k, :, k] += white**2 * self.stated
        if bias > 0:
            U = np.linalg.cholesky(self.stated / plane_variance(self.stated)[:, None, None])
            alike = bias**2 * np.exp(-np.abs(self.times[:, None] - self.times) / time)
            C += np.einsum("ab,aij,bkj->aibk", alike, U, U, optimize=True)
        try:
            L = linalg.cholesky(C.reshape(n * d, n * d), lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:
            return -np.inf
        white_y = linalg.solve_triangular(L, self.y, lower=True, check_finite=False)
        return float(-0.5 * np.sum(white_y**2) - np.sum(np.log(np.diag(L))))

    def fit(self) -> FixErrors | None:
        """The accepted error model; None: the fixes are used as stated."""
        size = float(np.sqrt(np.median(plane_variance(self.stated))))
        spacing = float(np.median(np.diff(self.times)))
        alone = optimize.minimize_scalar(
            lambda u: -self.likelihood(0.0, 1.0, float(np.exp(u))),
            bounds=(np.log(0.03), np.log(100.0)),
            method="bounded",
        )
        white, plain = float(np.exp(alone.x)), -float(alone.fun)
        low = np.log([1e-2 * size, 0.5 * spacing, 0.02])
        high = np.log([1e3 * size, 2.0 * self.span, 100.0])

        tried: list[tuple[float, Array]] = []

        def cost(u: Array) -> float:
            beyond = float(np.sum(np.maximum(u - high, 0.0) + np.maximum(low - u, 0.0)))
            v = np.exp(np.clip(u, low, high))
            value = -self.likelihood(float(v[0]), float(v[1]), float(v[2])) + 10.0 * beyond
            tried.append((value, v))
            return value

        for begin in ((white * size, 20.0 * spacing, 0.3 * white), (0.5 * white * size, 0.2 * self.span, white)):
            start = np.clip(np.log(begin), low, high)
            options = {"maxfev": 70, "xatol": 0.05, "fatol": 0.1, "initial_simplex": start + _SIMPLEX}
            optimize.minimize(cost, start, method="Nelder-Mead", options=options)
        best = min(value for value, _ in tried)
        gain = 2.0 * (-best - plain)
        if gain > GATE:
            # σ² τ is the density of the process at long times
            near = [v for value, v in tried if value < best + NAT]
            bias, time, part = (float(v) for v in max(near, key=lambda v: float(v[0] ** 2 * v[1])))
            return FixErrors(bias, time, part, gain)
        more = 2.0 * (plain - self.likelihood(0.0, 1.0, 1.0))
        return FixErrors(0.0, np.inf, white, more) if white > 1.0 and more > GATE else None


_SIMPLEX = np.array([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, -0.7]])


def plane_variance(stated: Array) -> Array:
    """Mean variance over east and north ``(n,)`` of covariances ``(n, d, d)``."""
    return np.asarray(0.5 * np.trace(stated[:, :2, :2], axis1=1, axis2=2))


def spread_fixes(n: int, most: int) -> npt.NDArray[np.intp]:
    """Indices of at most ``most`` of n fixes: with a constant step, or in evenly spread blocks."""
    step = -(-n // most)
    if step <= EVERY:
        return np.arange(0, n, step)
    first = np.unique(np.linspace(0, n - 1 - EVERY * (TOGETHER - 1), most // TOGETHER).astype(int))
    return np.asarray(np.unique((first[:, None] + EVERY * np.arange(TOGETHER)).ravel()), dtype=np.intp)


def _put(graph: FactorGraph, fixes: list[GpsRecord], errors: FixErrors) -> None:
    """Add a bias to every fix, linked to the previous one, and scale the white noise."""
    before, previous = None, 0.0
    for r in fixes:
        stated = np.asarray(r.stated)
        W = r.whitener
        if errors.white != 1.0:
            own = np.linalg.inv(W.T @ W)
            round_ = not (r.uneven or r.point is not None)  # isotropic, so equal in the axes of the node
            part = stated if not round_ else stated[0, 0] * np.eye(len(stated))
            W = whitener(own + (errors.white**2 - 1.0) * part, what=r.label())
        bias = None
        if errors.bias_sigma > 0:
            bias = graph.structure.append("bias", np.zeros(graph.dim))
            keep = 0.0 if before is None else float(np.exp(-(r.time - previous) / errors.bias_time))
            sigma = errors.bias_sigma * float(np.sqrt(max(1.0 - keep**2, 1e-12)))
            even = np.allclose(stated, stated[0, 0] * np.eye(len(stated)))
            shape = None if even else stated / plane_variance(stated[None])[0]
            prior = BiasPriorRecord(
                graph.next_factor(), bias, sigma, dim=graph.dim, before=before, keep=keep, shape=shape
            )
            graph.ledger.spend(prior.factor_id, prior.label(), ["-"], (r.time, r.time), "prior")
            graph.insert(prior)
            before, previous = bias, r.time
        graph.insert(replace(r, whitener=W, bias=bias))
