"""Truncated least squares on a pose network: detection of outliers, and solution of the inliers.

The cost of a measurement is at most ``s² χ²_d(p)`` (Yang, Antonante, Tzoumas & Carlone 2020, TLS cost), where s² is the
true variance over that in the file. Graduated non-convexity finds a good local minimum from a near start; least squares
of all measurements, its usual start, is not near if a third of the loops are false. So it starts from the loops that
are confirmed by their neighbours (:mod:`~graphslam.solve.network.consensus`), with μ as large as the residuals allow.
The alternative is trimming from every start. The results are tested loop by loop and group by group
(:mod:`~graphslam.solve.network.leave_one_out`) with an estimated limit, and the lowest truncated cost is selected.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, IndeterminateError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.position_priors import align_to_positions, keep_datum, without_position_priors
from graphslam.core.progress import Bar
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.network import network_values
from graphslam.graph.variables import Values
from graphslam.solve.descent import descend_to_minimum
from graphslam.solve.gnc import truncation_weights
from graphslam.solve.network.consensus import REPEATED, loop_consensus, odometry_edges
from graphslam.solve.network.diagnose import check_determined
from graphslam.solve.network.leave_one_out import FEW, RobustResult, leave_one_out_test, weighted_problem
from graphslam.solve.network.start import chordal_start, landmarks_from, network_arrays, odometry_start
from graphslam.solve.sparse import SparseProblem

log = logging.getLogger(__name__)

Mask = npt.NDArray[np.bool_]
ROUNDS = 12
# The bulk of recorded loops does not determine the tail: with an estimated scale, the limit is wider by this factor
# until the tail is estimated, but at most that of the file's noise.
MARGIN = 20.0
# Growth of μ, descent steps at each, and largest number of stages (Yang et al. 2020 use growth 1.4).
GROWTH, STEPS, STAGES = 1.4, 2, 60
# Assumed largest ratio of residuals to the limit for the initial inliers, which gives the initial μ.
WORST = 1e3
# The guess is confirmed if fewer than this share of all edges are initial inliers and final outliers.
CONFIRMED = 0.001
# Steps of a solve between two choices of inliers; the last solve goes to the end.
TRIM_STEPS = 6
FINAL_STEPS = 200
# If neighbours confirm fewer of the loops than this share, they are not used as a guess: robust least squares of all
# measurements gives another start, and the noise of the file is used. A scale estimated from the few loops that fit the
# odometry by chance is too small, and would reject all others.
BORNE_OUT = 0.2
# Cauchy's width in standard deviations (95 % efficient), rounds of reweighting, and descent steps in each.
CAUCHY, KERNEL_ROUNDS, KERNEL_STEPS = 2.385, 15, 2
# Steps for a sub-network: false loops in the guess make it hard, and the result is only a start.
START_STEPS = 40


def truncated_cost(flat: FactorArrays, values: Values, limit: Array) -> float:
    """``Σ min(rᵀ Ω r, limit)`` over all factors."""
    return float(np.minimum(flat.squared(values), limit).sum())


def truncated_least_squares(
    network: PoseNetwork,
    flat: FactorArrays,
    given: dict[str, Values] | None = None,
    probability: float = 0.99,
    *,
    trust_odometry: bool = True,
    noise_scale: float | None = None,
    progress: bool = False,
) -> RobustResult:
    """Minimise ``Σ min(rᵀ Ω r, s² χ²_d(p))``.

    Parameters
    ----------
    flat : FactorArrays
        All measurements of the network.
    given : dict of str to Values, optional
        Additional starts.
    probability : float
        Probability of keeping an inlier with Gaussian noise.
    trust_odometry : bool
        Edges between neighbours in id order are never outliers (they are not loop closures), if they connect nearly all
        vertices; otherwise no edge is trusted. Position priors can be outliers, as long as
        at least half of them, and enough for the frame, are left.
    noise_scale : float, optional
        s², true variance of the edges over that in the file; default: estimated. The noise of landmark observations and
        of position priors is not scaled.
    """
    if not 0.0 < probability < 1.0:
        raise ConfigError(f"inlier_probability must lie between 0 and 1, got {probability}")
    if noise_scale is not None and not (np.isfinite(noise_scale) and noise_scale > 0.0):
        raise ConfigError(f"noise_scale must be positive, got {noise_scale}")
    m = len(network.edges)
    consensus = loop_consensus(network)
    trusted = np.zeros(m + len(network.observations), dtype=np.bool_)
    if trust_odometry:
        trusted[:m] = odometry_edges(network)
    starts: dict[str, tuple[Values, Mask]] = {}
    absolute = ~network.relative
    loops = int(np.count_nonzero(~trusted[:m] & ~absolute))
    guessed = np.count_nonzero(consensus.likely) >= BORNE_OUT * loops
    if noise_scale is None and not guessed:
        noise_scale = 1.0
    scale = 1.0 if noise_scale is None else noise_scale
    for name, believed in (("consensus", consensus.likely), ("core", consensus.core)):
        if believed.any() and not (name == "core" and (believed == consensus.likely).all()):
            used = trusted | True
            used[:m] = consensus.odometry | believed | absolute
            begun = _least_squares(network, used, chordal=True)
            if begun is None:
                continue
            starts[name] = (begun, used)
            if noise_scale is None:
                costs = flat.squared(begun)
                scale = min(_scale(network, costs, used, believed), scale if len(starts) > 1 else np.inf)
    if not starts and trusted.any():
        used = trusted.copy()
        used[:m] |= absolute
        used[m:] = True
        begun = _least_squares(network, used, chordal=False)
        if begun is not None:
            starts["odometry"] = (begun, used)
    if not guessed and loops:
        begun = _least_squares(network, np.ones_like(trusted), chordal=True)
        if begun is not None:
            used = np.ones_like(trusted)
            starts["cauchy"] = (_under_kernel(network, flat, begun, trusted), used)
    limit = _limits(network, probability, scale if noise_scale is not None else min(1.0, MARGIN * scale), trusted)
    starts |= {name: (values, np.ones_like(trusted)) for name, values in (given or {}).items()}
    found: list[tuple[str, RobustResult]] = []
    for name in Bar(list(starts), name="robust starts", unit="start", shown=progress):
        if name not in starts:
            continue
        values, believed = starts[name]
        trimmed = _trim(network, flat, values, keep_datum(network, flat.squared(values) <= limit), limit)
        confirmed = (trimmed.inliers[:m] | ~consensus.likely).mean() > 1.0 - CONFIRMED
        if not (name == "consensus" and confirmed):
            weights, annealed = _anneal(network, flat, values, limit, believed)
            again = _trim(network, flat, annealed, keep_datum(network, weights > 0.5), limit)
            trimmed = min(trimmed, again, key=lambda t: t.truncated)
        here, kept = trimmed.end.values, trimmed.inliers
        best = leave_one_out_test(
            network, flat, here, kept, limit, probability=probability, own_tail=noise_scale is None
        )
        found.append((name, best))
        if name == "consensus" and (best.inliers[:m] | ~consensus.likely).mean() > 1.0 - CONFIRMED:
            starts.pop("core", None)  # the initial inliers are the final ones
    if not found:
        raise IndeterminateError(f"{network.source}: no robust start could be made")
    # one limit for all, the smallest: false loops widen the estimated tail
    limit = np.min([f.limit for _, f in found], axis=0)
    reached: dict[str, float] = {}
    for name, descent in found:
        cost = truncated_cost(flat, descent.end.values, limit)
        reached[name] = min(cost, reached.get(name, np.inf))
    name, best = min(found, key=lambda f: reached[f[0]])
    final = _trim(network, flat, best.end.values, best.inliers, best.limit, steps=FINAL_STEPS)
    return replace(final, scale=best.scale, rounds=best.rounds, start=name, reached=reached)


def with_weaker_positions(
    network: PoseNetwork, probability: float, *, trust_odometry: bool = True, noise_scale: float | None = None
) -> tuple[PoseNetwork, float]:
    """The network with the information of its position priors divided by their variance over that in the file, >= 1.

    It is the median of their χ² at the map that all other measurements give, which is then aligned to them.
    """
    rest = without_position_priors(network)
    options: dict[str, Any] = {"trust_odometry": trust_odometry, "noise_scale": noise_scale}
    found = truncated_least_squares(rest, network_arrays(rest), None, probability, **options).end.values
    poses = align_to_positions(network, found.poses)
    priors = network.position_priors
    costs = network_arrays(network).squared(network_values(network, poses, found.landmarks.reshape(-1, 2)))
    excess = max(float(np.median(costs[: len(priors)][priors])) / chi2_quantile(0.5, network.dim), 1.0)
    information = np.where(priors[:, None, None], network.information / excess, network.information)
    return replace(network, information=information), excess


def _least_squares(network: PoseNetwork, used: Mask, *, chordal: bool) -> Values | None:
    """Least squares of the measurements in ``used``, from rotations first or from dead reckoning."""
    part = network.only(used)
    inner = SparseProblem(network_arrays(part), thorough=True)
    try:
        check_determined(part, inner.flat)
        if chordal and not len(part.observations):
            arrays = chordal_start(part)
        else:
            poses = odometry_start(part)
            arrays = poses, landmarks_from(part, poses)
        return descend_to_minimum(inner, network_values(part, *arrays), max_iterations=START_STEPS).values
    except (IndeterminateError, RuntimeError) as error:
        log.info("%s: %d measurements make no start: %s", part.source, int(used.sum()), error)
        return None


def _under_kernel(network: PoseNetwork, flat: FactorArrays, values: Values, trusted: Mask) -> Values:
    """Iteratively reweighted least squares of all measurements, loops with Cauchy's kernel."""
    for _ in range(KERNEL_ROUNDS):
        weights = np.where(trusted, 1.0, 1.0 / (1.0 + flat.squared(values) / CAUCHY**2))
        values = descend_to_minimum(weighted_problem(network, weights), values, max_iterations=KERNEL_STEPS).values
    return values


def _scale(network: PoseNetwork, costs: Array, used: Mask, believed: Mask) -> float:
    """True variance of the loops over that in the file, at most 1, from the median cost of the inliers after the fit.

    A value above 1 can also come from false loops or biased odometry: the noise of the file is then used, and also with
    few loops.

    Residuals after the fit are smaller than the noise: ``rows`` residuals have ``rows - states`` degrees of freedom.
    """
    m = len(network.edges)
    rows = network.only(used).residuals
    left = max(rows - network.states, 1) / rows
    costs = costs[:m][believed]
    costs = costs[costs > REPEATED]  # loops at standstill have no information on noise
    if len(costs) < FEW:
        return 1.0
    return min(1.0, float(np.median(costs)) / (left * chi2_quantile(0.5, network.tangent_dim)))


def _limits(network: PoseNetwork, probability: float, scale: float, trusted: Mask) -> Array:
    limit = np.full(len(trusted), chi2_quantile(probability, 2))
    edges = scale * chi2_quantile(probability, network.tangent_dim)
    limit[: len(network.edges)] = np.where(network.position_priors, chi2_quantile(probability, network.dim), edges)
    limit[trusted] = np.inf
    return limit


def _anneal(
    network: PoseNetwork, flat: FactorArrays, values: Values, limit: Array, believed: Mask
) -> tuple[Array, Values]:
    """Graduated non-convexity (Yang et al. 2020, eq. 14-16): weights and the resulting values."""

    def ratio(values: Values) -> Array:
        return np.where(loose, flat.squared(values) / np.where(loose, limit, 1.0), 0.0)

    loose = np.isfinite(limit)
    now = ratio(values)
    worst = float(min(now[believed].max(initial=0.0), WORST))
    mu = 1.0 / max(2.0 * worst - 1.0, 1.0)
    weights = np.ones(len(limit))
    for _ in range(STAGES):
        weights = np.where(loose, truncation_weights(now, mu), 1.0)
        weights[keep_datum(network, weights > 0.0) & (weights <= 0.0)] = 1.0
        values = descend_to_minimum(weighted_problem(network, weights), values, max_iterations=STEPS).values
        now = ratio(values)
        if not ((weights > 0.0) & (weights < 1.0)).any():
            break
        mu *= GROWTH
    return weights, values


def _trim(
    network: PoseNetwork, flat: FactorArrays, values: Values, inliers: Mask, limit: Array, *, steps: int = TRIM_STEPS
) -> RobustResult:
    """Alternate least squares of the inliers and selection of inliers until the selection is constant.

    Neither step increases the truncated cost, so it terminates.
    """
    for _ in range(ROUNDS):
        inner = weighted_problem(network, inliers)
        end = descend_to_minimum(inner, values, max_iterations=steps)
        costs = flat.squared(end.values)
        fresh = keep_datum(network, costs <= limit)
        if (fresh == inliers).all():
            break
        inliers, values = fresh, end.values
    return RobustResult(inliers, inner, end, limit, float(np.where(inliers, costs, limit).sum()))
