"""Mutually consistent loops of a chain: pairwise consistency maximisation (PCM, Mangelson et al. 2018).

Two loops (a, b) and (c, d) and the two pieces of the chain between their ends form a cycle,

    ``E = T_ab B_bd T_cd⁻¹ B_ca``,  ``B_ij = X_i⁻¹ X_j`` along the chain,

the identity if both loops are correct, up to noise. ``r = Log E`` is a right tangent at a; to first order its
covariance is

    ``S = A_ab P_ab A_abᵀ + A_cd P_cd A_cdᵀ + M ΔC_bd Mᵀ + N ΔC_ca Nᵀ ± (M ΔC_both Nᵀ + N ΔC_both Mᵀ)``,

where ``C_k = Σ_{i<k} Ad(X_{i+1}) Q_i Ad(X_{i+1})ᵀ`` is the covariance of the chain summed in the frame of its start
(that of any piece is a difference of two sums), ``M = Ad(B_ac T_cd X_d⁻¹)`` and ``N = Ad(X_a⁻¹)`` transform it to a,
and the last term accounts for the correlation of the two pieces where they overlap. ``D² = rᵀ S⁻¹ r`` is χ² of 3
(SE(2)) or 6 (SE(3)) degrees of freedom if both loops are correct. No linearisation about a solution is needed.

The largest set of pairwise consistent loops is the maximum clique of the consistency graph. A pair of correct loops
fails the test with probability ``1 - level``, and one failed pair excludes a loop from the clique, so loops that are
inconsistent with no more of the clique than expected by chance are readmitted (``readmit``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.association.clique import maximum_clique
from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.errors import ConfigError, CovarianceError, GeometryError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array

Ints = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
# Pairs that are evaluated at a time.
CHUNK = 20_000


@dataclass(frozen=True, slots=True)
class OdometryChain:
    """A dead-reckoned chain and its covariance, accumulated from its start.

    Parameters
    ----------
    poses : (n, 3) or (n, 7)
        ``T_0_k``.
    spread : (n, d, d)
        ``C_k``: covariance of ``T_0_k`` as a *left* tangent, in the frame of the start.
    part : (n,) int64
        Nodes with the same number are connected; between parts there is no information.
    """

    poses: Array
    spread: Array
    part: Ints

    @classmethod
    def of(
        cls, increments: npt.ArrayLike, covariances: npt.ArrayLike, known: npt.NDArray[np.bool_] | None = None
    ) -> OdometryChain:
        """Chain of ``n - 1`` increments.

        Parameters
        ----------
        increments : (n - 1, 3) or (n - 1, 7)
            ``T_k_k+1``.
        covariances : (n - 1, d, d)
            Of their right tangents.
        known : (n - 1,) bool, optional
            Increments that were measured; the chain is cut at the others, whose values are ignored.
        """
        z, Q = np.array(increments, dtype=np.float64), np.array(covariances, dtype=np.float64)
        d = _tangent(z)
        if Q.shape != (len(z), d, d):
            raise GeometryError("chain covariances have the wrong shape", got=Q.shape, wanted=(len(z), d, d))
        good = np.ones(len(z), dtype=np.bool_) if known is None else np.asarray(known, dtype=np.bool_)
        z[~good], Q[~good] = _identity(d), 0.0
        _check(z, Q, "increment")
        poses = np.empty((len(z) + 1, z.shape[1]))
        poses[0] = _identity(d)
        for k in range(len(z)):
            poses[k + 1] = _compose(poses[k], z[k])
        ad = _adjoint(poses[1:])
        spread = np.zeros((len(z) + 1, d, d))
        np.cumsum(ad @ Q @ np.swapaxes(ad, 1, 2), axis=0, out=spread[1:])
        return cls(poses, spread, np.concatenate([[0], np.cumsum(~good)]).astype(np.int64))

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def tangent_dim(self) -> int:
        """3 or 6."""
        return int(self.spread.shape[1])


@dataclass(frozen=True, slots=True)
class LoopArrays:
    """Loop constraints with the earlier node first.

    Parameters
    ----------
    ends : (l, 2) int64
        a < b.
    measured : (l, 3) or (l, 7)
        ``T_a_b``.
    covariance : (l, d, d)
        Of the right tangent, at b.
    """

    ends: Ints
    measured: Array
    covariance: Array

    @classmethod
    def of(
        cls, chain: OdometryChain, ends: npt.ArrayLike, measured: npt.ArrayLike, covariance: npt.ArrayLike
    ) -> LoopArrays:
        """Loops (i, j) in either direction, validated and inverted where j < i."""
        e = np.array(ends, dtype=np.int64).reshape(-1, 2)
        d = chain.tangent_dim
        z = np.array(measured, dtype=np.float64).reshape(len(e), chain.poses.shape[1])
        P = np.array(covariance, dtype=np.float64).reshape(len(e), d, d)
        bad = np.flatnonzero((e < 0).any(1) | (e >= len(chain)).any(1) | (e[:, 0] == e[:, 1]))
        if len(bad):
            raise GeometryError(
                f"loop {bad[0]} does not join two nodes of the chain",
                got=tuple(e[bad[0]].tolist()),
                wanted=f"two different nodes of 0 … {len(chain) - 1}",
            )
        _check(z, P, "loop")
        back = e[:, 0] > e[:, 1]
        # (T Exp n)⁻¹ = T⁻¹ Exp(-Ad(T) n)
        ad = _adjoint(z[back])
        P[back] = ad @ P[back] @ np.swapaxes(ad, 1, 2)
        z[back] = _inverse(z[back])
        e[back] = e[back][:, ::-1]
        return cls(e, z, P)

    def __len__(self) -> int:
        return len(self.ends)


def chain_chi2(chain: OdometryChain, loops: LoopArrays) -> Array:
    """``D²`` of every loop against the chain alone ``(l,)``; ``nan`` where the chain does not connect its ends.

    ``E = T_ab B_ba``: χ² of 3 or 6 degrees of freedom for a correct loop.
    """
    a, b = loops.ends.T
    X = chain.poses
    B = _between(X[a], X[b])
    r = _log(_compose(loops.measured, _inverse(B)))
    carry, home = _adjoint(B), _adjoint(_inverse(X[a]))
    S = carry @ loops.covariance @ np.swapaxes(carry, 1, 2)
    S += home @ (chain.spread[b] - chain.spread[a]) @ np.swapaxes(home, 1, 2)
    return np.where(chain.part[a] == chain.part[b], _mahalanobis(r, S), np.nan)


def pair_chi2(chain: OdometryChain, loops: LoopArrays, first: npt.ArrayLike, second: npt.ArrayLike) -> Array:
    """``D²`` of the cycles through the loops ``first[k]`` and ``second[k]``, ``(k,)``.

    ``nan`` where the chain does not connect a with c, or b with d.
    """
    one, two = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    out = np.empty(len(one))
    for start in range(0, len(one), CHUNK):
        part = slice(start, start + CHUNK)
        out[part] = _pair_chi2(chain, loops, one[part], two[part])
    return out


def _pair_chi2(chain: OdometryChain, loops: LoopArrays, one: Ints, two: Ints) -> Array:
    X, C = chain.poses, chain.spread
    (a, b), (c, d) = loops.ends[one].T, loops.ends[two].T
    T_ab, T_cd = loops.measured[one], loops.measured[two]
    ac = _between(X[a], X[c])
    a_to_d = _compose(ac, T_cd)  # over c
    M = _compose(a_to_d, _inverse(X[d]))
    ahead = _compose(M, X[b])  # the factor after T_ab in E, inverted: a → b over c and d
    r = _log(_compose(T_ab, _inverse(ahead)))
    A_ab, A_cd, M, N = _adjoint(ahead), _adjoint(a_to_d), _adjoint(M), _adjoint(_inverse(X[a]))
    S = A_ab @ loops.covariance[one] @ np.swapaxes(A_ab, 1, 2)
    S += A_cd @ loops.covariance[two] @ np.swapaxes(A_cd, 1, 2)
    low_bd, high_bd, low_ca, high_ca = np.minimum(b, d), np.maximum(b, d), np.minimum(a, c), np.maximum(a, c)
    S += M @ (C[high_bd] - C[low_bd]) @ np.swapaxes(M, 1, 2)
    S += N @ (C[high_ca] - C[low_ca]) @ np.swapaxes(N, 1, 2)
    low, high = np.maximum(low_bd, low_ca), np.minimum(high_bd, high_ca)
    both = np.flatnonzero(low < high)
    if len(both):
        # B_bd is traversed forwards if b < d, B_ca if c < a: the same noise enters with the sign of the direction
        sign = np.where((b < d) == (c < a), 1.0, -1.0)[both]
        cross = M[both] @ (C[high[both]] - C[low[both]]) @ np.swapaxes(N[both], 1, 2)
        S[both] += sign[:, None, None] * (cross + np.swapaxes(cross, 1, 2))
    joined = (chain.part[a] == chain.part[c]) & (chain.part[b] == chain.part[d])
    return np.where(joined, _mahalanobis(r, S), np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsistentSet:
    """The largest set of mutually consistent loops.

    Parameters
    ----------
    accepted : (l,) bool
    clique : (l,) bool
        Accepted by the clique itself; the others were readmitted.
    chi2 : (l, l)
        ``D²`` of every pair; on the diagonal, of every loop against the chain alone. ``nan`` where the chain does not
        connect the ends.
    limit : float
        χ² limit of ``D²``.
    bound : int
        No clique is larger; equal to the size of the clique if that is proved to be a maximum.
    reasons : tuple of str
        Reason for the decision on every loop.
    """

    accepted: Mask
    clique: Mask
    chi2: Array
    limit: float
    bound: int
    reasons: tuple[str, ...]

    @property
    def exact(self) -> bool:
        """Whether the clique is proved to be a maximum."""
        return int(self.clique.sum()) == self.bound

    def __len__(self) -> int:
        return len(self.accepted)


def consistent_loops(
    chain_increments: npt.ArrayLike,
    chain_covariances: npt.ArrayLike,
    loops: tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike],
    level: float = 0.99,
    *,
    against_chain: bool = True,
    readmit: float = 0.05,
    budget: int = 200_000,
) -> ConsistentSet:
    """Loops that are consistent with each other and with the chain.

    Parameters
    ----------
    chain_increments : (n - 1, 3) or (n - 1, 7)
        ``T_k_k+1``, 2-D or 3-D.
    chain_covariances : (n - 1, d, d)
        Of their right tangents (3-D: rotation first).
    loops : tuple
        Ends ``(l, 2)``, relative poses ``T_ij`` ``(l, 3)`` or ``(l, 7)``, covariances of their right tangents
        ``(l, d, d)``. All pairs are compared: memory and time grow with the square (2000 loops: two million pairs).
    level : float
        Probability that a pair of correct loops passes the test.
    against_chain : bool
        Also reject loops that are inconsistent with the chain alone.
    readmit : float
        A loop outside the clique is readmitted if it is inconsistent with at most this share of the clique; 0 readmits
        none. A correct loop's expected share is ``1 - level``.
    budget : int
        Branches of the exact search (:func:`~graphslam.association.clique.maximum_clique`).

    Notes
    -----
    Limitation: false loops are accepted if they form a larger mutually consistent set than the correct ones.
    """
    if not 0.0 < level < 1.0:
        raise ConfigError(f"level must lie between 0 and 1, got {level}")
    if not 0.0 <= readmit < 1.0:
        raise ConfigError(f"readmit must lie in [0, 1), got {readmit}")
    chain = OdometryChain.of(chain_increments, chain_covariances)
    edges = LoopArrays.of(chain, *loops)
    l = len(edges)
    limit = chi2_quantile(level, chain.tangent_dim)
    i, j = np.triu_indices(l, 1)
    chi2 = np.empty((l, l))
    chi2[i, j] = chi2[j, i] = pair_chi2(chain, edges, i, j)
    np.fill_diagonal(chi2, chain_chi2(chain, edges))
    return largest_consistent_set(chi2, limit, against_chain=against_chain, readmit=readmit, budget=budget)


def largest_consistent_set(
    chi2: npt.ArrayLike, limit: float, *, against_chain: bool = True, readmit: float = 0.05, budget: int = 200_000
) -> ConsistentSet:
    """Largest set of loops whose pairwise ``D²`` are within a limit, from the matrix of ``D²`` (diagonal: the chain).

    ``nan`` counts as consistent: such a pair cannot be compared.
    """
    D = np.asarray(chi2, dtype=np.float64)
    conflict = limit < D
    alone = np.diag(conflict) & against_chain
    agree = ~conflict & ~alone[:, None] & ~alone[None, :]
    found = maximum_clique(agree & agree.T, budget=budget)
    clique = found.members & ~alone
    size = int(clique.sum())
    against = (conflict & ~np.eye(len(D), dtype=np.bool_))[:, clique].sum(axis=1)
    back = ~clique & ~alone & (against <= readmit * size) & (size > 0)
    reasons = []
    for k in range(len(D)):
        if clique[k]:
            reasons.append(f"agrees with all {size} of the consistent set")
        elif alone[k]:
            reasons.append(f"contradicts the chain: D² = {D[k, k]:.4g} > {limit:.4g}")
        else:
            worst = int(np.nanargmax(np.where(clique, D[k], -np.inf))) if size else k
            text = f"contradicts {against[k]} of {size} (most: loop {worst}, D² = {D[k, worst]:.4g} > {limit:.4g})"
            reasons.append("readmitted: " + text if back[k] else text)
    return ConsistentSet(
        accepted=clique | back,
        clique=clique,
        chi2=D,
        limit=limit,
        bound=size if found.exact else found.bound,
        reasons=tuple(reasons),
    )


def _check(poses: Array, covariances: Array, what: str) -> None:
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=1))
    if len(bad):
        raise GeometryError(f"{what} {bad[0]} is not finite", got=poses[bad[0]])
    if not np.isfinite(covariances).all():
        k = int(np.flatnonzero(~np.isfinite(covariances).all(axis=(1, 2)))[0])
        raise CovarianceError(f"covariance of {what} {k} is not finite")
    if len(covariances):
        w = np.linalg.eigvalsh(covariances)
        bad = np.flatnonzero(w[:, 0] < -1e-9 * np.abs(w).max(axis=1))
        if len(bad):
            raise CovarianceError(
                f"covariance of {what} {bad[0]} is not positive semi-definite", got=f"eigenvalue {w[bad[0], 0]:.3g}"
            )


def _mahalanobis(r: Array, S: Array) -> Array:
    # scaled by the diagonal first: metres and radians of very different σ
    u = np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2), np.finfo(float).tiny))
    y, C = r / u, S / (u[:, :, None] * u[:, None, :])
    d = C.shape[-1]
    return np.einsum("ki,ki->k", y, np.linalg.solve(C + 1e-12 * np.eye(d), y[..., None])[..., 0])


def _tangent(poses: Array) -> int:
    if poses.ndim != 2 or poses.shape[1] not in (3, 7):
        raise GeometryError("poses have the wrong shape", got=poses.shape, wanted="(n, 3) or (n, 7)")
    return 3 if poses.shape[1] == 3 else 6


def _identity(d: int) -> Array:
    return np.zeros(3) if d == 3 else np.array([0.0, 0, 0, 0, 0, 0, 1])


def _compose(a: Array, b: Array) -> Array:
    return se2.se2_compose(a, b) if a.shape[-1] == 3 else se3.se3_compose(a, b)


def _inverse(a: Array) -> Array:
    return se2.se2_inverse(a) if a.shape[-1] == 3 else se3.se3_inverse(a)


def _between(a: Array, b: Array) -> Array:
    return se2.se2_between(a, b) if a.shape[-1] == 3 else se3.se3_between(a, b)


def _adjoint(a: Array) -> Array:
    return se2.se2_adjoint(a) if a.shape[-1] == 3 else se3.se3_adjoint(a)


def _log(a: Array) -> Array:
    return se2.se2_log(a) if a.shape[-1] == 3 else se3.se3_log(a)
