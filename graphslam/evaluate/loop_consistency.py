"""Pairwise consistency of the loop closures of a landmark map (PCM, Mangelson et al. 2018).

Two submaps that share at least two landmarks give a measurement of their relative pose ``T_ab``. The chain of submap
exits gives another one. The *cycle* a → b by the loop, b → a by the chain must close within its predicted covariance;
so must the cycle a → b by one loop, b → d by the chain, d → c by another loop, c → a by the chain.

Everything is linear in the measurements about the solved poses ``X``: an exit k has the residual ``ρ_k = Log(T̂_k⁻¹
T_k)``, a loop ``ρ_ab = Log(T̂_ab⁻¹ T_ab)``, ``T̂`` from the poses, and in world coordinates

    ``e_ab = Ad(X_b) ρ_ab - Σ_{a ≤ k < b} Ad(X_{k+1}) ρ_k``

is the error of the cycle of one loop, and ``e_ab - e_cd`` that of two: the poses and the common part of the chains
cancel. A submap's exit and landmarks are correlated, and a submap may take part in many loops; both are in the joint
covariance of all ``e``, because each ``e`` is a linear function of the independent Gaussians of the submaps.

Limit: the data association was gated by similar errors. A false association in the map has already passed one test, and
the errors of true loops are slightly truncated by the gate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy import special

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, rotation2, se2_adjoint, se2_between, se2_log, se2_transform, wrap_angle
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.evaluate.residual_consistency import correlated_dof, two_sided_bounds
from graphslam.join.submap_blocks import fuse_repeated, landmark_map_of

if TYPE_CHECKING:
    import pandas as pd

Ints = npt.NDArray[np.int64]
MAX_HEADING = 0.2
"""Largest σ of the heading that the shared landmarks give [rad]: beyond it a cycle is not linear in the landmarks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkLoops:
    """Re-observations between the submaps of a chain, and the errors of their cycles.

    Parameters
    ----------
    a, b : (l,) int64
        Indices of the submaps in the chain, a < b.
    shared : (l,) int64
        Number of shared landmarks; 0 for a match of the front end.
    errors : (l, 3)
        ``e`` of every loop: x, y [m], heading [rad], in the frame of the first base.
    covariance : (3l, 3l)
        Joint covariance of all errors.
    shape_chi2, shape_dof : (l,)
        χ² of the shared landmarks after the best relative pose, and its degrees of freedom.
    skipped : int
        Pairs of submaps whose shared landmarks do not determine a relative heading (they are too close together).
    left_out : int
        Pairs of submaps that were not used because of ``max_loops``.
    """

    a: Ints
    b: Ints
    shared: Ints
    errors: Array
    covariance: Array
    shape_chi2: Array
    shape_dof: Array
    skipped: int = 0
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.a)


def find_landmark_loops(
    submaps: Sequence[Submap],
    poses: npt.ArrayLike,
    *,
    ids: Sequence[npt.ArrayLike] | None = None,
    min_shared: int = 2,
    min_gap: int = 1,
    max_loops: int = 500,
    covariance_scale: float = 1.0,
) -> LandmarkLoops:
    """Loops of a chain of landmark submaps: shared landmarks, and matches of the front end.

    Parameters
    ----------
    submaps : sequence of Submap
        In order, 2-D.
    poses : (m + 1, 3)
        Solved bases and the last end pose: the linearisation point.
    ids : sequence of (n_k,) int, optional
        Landmark id of every entry of every submap; default: the ids in the submap. Negative: unknown.
    min_shared : int
        Landmarks that two submaps must share, at least 2.
    min_gap : int
        Least difference of the submaps' indices in the chain; 1 includes neighbours.
    max_loops : int
        If there are more pairs of submaps, every n-th is used: memory and time grow with the square.
    covariance_scale : float
        Factor on every submap's covariance, as in the graph.
    """
    X = np.asarray(poses, dtype=np.float64)
    if X.shape != (len(submaps) + 1, 3):
        raise DataError("poses do not fit the chain of submaps", got=X.shape, wanted=(len(submaps) + 1, 3))
    if min_shared < 2 or min_gap < 1:
        raise DataError(
            "a loop needs two shared landmarks and two submaps", got=(min_shared, min_gap), wanted="≥ 2, ≥ 1"
        )
    maps = [_identified(s, None if ids is None else ids[k]) for k, s in enumerate(submaps)]
    chain = _Chain(X, maps, covariance_scale)
    row_of = [{int(i): r for r, i in enumerate(m.ids)} for m in maps]
    found: list[tuple[int, int, int, Array, float, int]] = []
    rows: list[sp.csr_matrix] = []
    own_noise: list[Array] = []
    skipped = 0
    pairs = _sharing_pairs(maps, min_shared, min_gap)
    tested = pairs[:: -(-len(pairs) // max_loops)] if pairs else []
    for a, b in tested:
        common = [i for i in row_of[a] if i in row_of[b]]
        fit = chain.align(a, b, [row_of[a][i] for i in common], [row_of[b][i] for i in common])
        if fit is None:
            skipped += 1
            continue
        rho, gain_a, gain_b, chi2 = fit
        error, row = chain.cycle(a, b, rho, gain_a, gain_b)
        found.append((a, b, len(common), error, chi2, 2 * len(common) - 3))
        rows.append(row)
        own_noise.append(np.zeros((3, 3)))
    key_at = {s.key: k for k, s in enumerate(submaps)}
    for here, s in enumerate(submaps):
        for match in s.matches:
            target = key_at.get(match.target)
            if target is None or here - target < min_gap:
                continue
            rho = se2_log(se2_between(se2_between(X[target], X[here]), match.T_target_here))
            error, row = chain.cycle(target, here, rho, None, None)
            ad = se2_adjoint(X[here])
            found.append((target, here, 0, error, 0.0, 0))
            rows.append(row)
            own_noise.append(ad @ match.covariance @ ad.T)
    if not found:
        raise DataError(
            "the map has no loops to compare", got=0, wanted=f"two submaps with {min_shared} landmarks in common"
        )
    half = sp.vstack(rows, format="csr")
    covariance = (half @ half.T).toarray() + np.asarray(sp.block_diag(own_noise).toarray())
    return LandmarkLoops(
        a=np.array([f[0] for f in found], dtype=np.int64),
        b=np.array([f[1] for f in found], dtype=np.int64),
        shared=np.array([f[2] for f in found], dtype=np.int64),
        errors=np.array([f[3] for f in found]),
        covariance=covariance,
        shape_chi2=np.array([f[4] for f in found]),
        shape_dof=np.array([f[5] for f in found], dtype=np.int64),
        skipped=skipped,
        left_out=len(pairs) - len(tested),
    )


def _sharing_pairs(maps: Sequence[LandmarkMap], min_shared: int, min_gap: int) -> list[tuple[int, int]]:
    """Pairs of submaps with enough landmarks in common, in order."""
    seen_in: dict[int, list[int]] = {}
    for k, m in enumerate(maps):
        for i in m.ids.tolist():
            seen_in.setdefault(i, []).append(k)
    shared: Counter[tuple[int, int]] = Counter()
    for where in seen_in.values():
        shared.update((a, b) for n, a in enumerate(where) for b in where[n + 1 :] if b - a >= min_gap)
    return sorted(p for p, n in shared.items() if n >= min_shared)


def _identified(submap: Submap, ids: npt.ArrayLike | None) -> LandmarkMap:
    """Landmarks with a known identity, each once."""
    lm = landmark_map_of(submap if ids is None or submap.landmarks is None else submap.with_ids(ids))
    return fuse_repeated(lm if np.all(lm.ids >= 0) else lm.subset(lm.ids >= 0), what=f"submap {submap.key}")


class _Chain:
    """The measurements of a chain as one vector of independent blocks, and residuals as its linear functions."""

    def __init__(self, X: Array, maps: Sequence[LandmarkMap], scale: float) -> None:
        self.X, self.maps = X, maps
        self.P = [scale * m.dense_covariance() for m in maps]
        self.offset = np.concatenate([[0], np.cumsum([len(p) for p in self.P])])
        self.root = [np.linalg.cholesky(p) for p in self.P]
        hops = se2_between(X[:-1], X[1:])
        exits = np.array([m.exit_pose for m in maps])
        rho = se2_log(se2_between(hops, exits))
        self.ad = se2_adjoint(X)
        self.world = np.einsum("kij,kj->ki", self.ad[1:], rho)
        # ρ_k over the submap's own vector (x, y, θ): a change of the position is rotated into the frame of the exit
        turn = np.zeros((len(maps), 3, 3))
        turn[:, :2, :2] = np.swapaxes(rotation2(exits[:, 2]), 1, 2)
        turn[:, 2, 2] = 1.0
        # times the root of its covariance, of which the exit's rows have three columns
        self.exit_root = self.ad[1:] @ turn @ np.array([r[:3, :3] for r in self.root])

    def align(self, a: int, b: int, in_a: list[int], in_b: list[int]) -> tuple[Array, Array, Array, float] | None:
        """Residual ``ρ_ab`` of the relative pose from shared landmarks, its gains on both maps, and the remaining χ².

        ``r_j = z_a,j - T_ab z_b,j`` with covariance ``S = P_a + R P_b Rᵀ`` over all shared landmarks; one weighted
        least-squares step about the solved ``T̂_ab``, ``ρ = G r``.
        """
        T = se2_between(self.X[a], self.X[b])
        R = rotation2(T[2])
        za, zb = self.maps[a].positions[in_a], self.maps[b].positions[in_b]
        ia, ib = (3 + 2 * np.asarray(k)[:, None] + np.arange(2) for k in (in_a, in_b))
        Pa, Pb = self.P[a][np.ix_(ia.ravel(), ia.ravel())], self.P[b][np.ix_(ib.ravel(), ib.ravel())]
        n = len(in_a)
        turn = np.kron(np.eye(n), R)
        S = Pa + turn @ Pb @ turn.T
        r = (za - se2_transform(T, zb)).ravel()
        # T Exp(ρ) z_b: d/dρ = R [I | (-y, x)ᵀ]
        H = np.zeros((n, 2, 3))
        H[:, :, :2] = R
        H[:, :, 2] = np.stack([-zb[:, 1], zb[:, 0]], -1) @ R.T
        M = H.reshape(2 * n, 3)
        L = np.linalg.cholesky(S)
        Mw, rw = np.linalg.solve(L, M), np.linalg.solve(L, r)
        A = Mw.T @ Mw
        if not np.linalg.cond(A) < 1e12 or np.linalg.inv(A)[2, 2] > MAX_HEADING**2:
            return None
        G = np.linalg.solve(A, Mw.T) @ np.linalg.inv(L)
        rho = G @ r
        full_a, full_b = np.zeros((3, len(self.P[a]))), np.zeros((3, len(self.P[b])))
        full_a[:, ia.ravel()] = G
        full_b[:, ib.ravel()] = -G @ turn
        return rho, full_a, full_b, float(np.sum((rw - Mw @ rho) ** 2))

    def cycle(
        self, a: int, b: int, rho: Array, gain_a: Array | None, gain_b: Array | None
    ) -> tuple[Array, sp.csr_matrix]:
        """``e_ab`` and its derivative with respect to the whitened measurements of all submaps."""
        error = self.ad[b] @ rho - self.world[a:b].sum(axis=0)
        error[2] = wrap_angle(error[2])
        columns = [(self.offset[a:b, None] + np.arange(3)).ravel()]
        blocks = [-self.exit_root[a:b].transpose(1, 0, 2).reshape(3, -1)]
        if gain_a is not None and gain_b is not None:
            for k, gain in ((a, gain_a), (b, gain_b)):
                columns.append(np.arange(self.offset[k], self.offset[k + 1]))
                blocks.append(self.ad[b] @ gain @ self.root[k])
        c, v = np.concatenate(columns), np.hstack(blocks)
        row = sp.coo_matrix((v.ravel(), (np.repeat(np.arange(3), len(c)), np.tile(c, 3))), shape=(3, self.offset[-1]))
        return error, row.tocsr()


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopConsistency:
    """Normalised errors of the cycles of single loops and of pairs of loops.

    Parameters
    ----------
    d2 : (l, l)
        Off the diagonal ``D²_ij = (e_i - e_j)ᵀ (Σ_ii + Σ_jj - Σ_ij - Σ_ji)⁻¹ (e_i - e_j)``, on it ``e_iᵀ Σ_ii⁻¹ e_i``;
        each χ² of three degrees of freedom if the submaps are consistent and the data association is right. ``nan``
        where two loops are the same measurement.
    confidence : float
        Of the two-sided bounds.
    """

    loops: LandmarkLoops
    d2: Array
    confidence: float = 0.95

    @property
    def single(self) -> Array:
        """``D²`` of every loop against the chain ``(l,)``."""
        return np.asarray(np.diag(self.d2))

    def test(self) -> dict[str, Any]:
        """Mean ``D²/3`` of the single loops, with two-sided bounds that include their correlation.

        Loops over the same part of the chain share its error; ``dof`` is the effective number of degrees of freedom
        (:func:`~graphslam.evaluate.residual_consistency.correlated_dof`). ``inside`` is the share of pairs within the
        confidence region of one pair, ``shape`` the χ²/dof of the shared landmarks against each other.
        """
        value = float(np.mean(self.single) / 3.0)
        dof = correlated_dof(self.loops.covariance, 3)
        low, high, verdict = two_sided_bounds(value, dof, self.confidence)
        off = self.d2[np.triu_indices(len(self.d2), 1)]
        off = off[np.isfinite(off)]
        limit = chi2_quantile(self.confidence, 3)
        shape_dof = int(self.loops.shape_dof.sum())
        return {
            "loops": len(self.loops),
            "value": value,
            "low": low,
            "high": high,
            "verdict": verdict,
            "dof": dof,
            "inside_single": float(np.mean(self.single < limit)),
            "pairs": len(off),
            "inside": float(np.mean(off < limit)) if len(off) else float("nan"),
            "shape": float(self.loops.shape_chi2.sum() / shape_dof) if shape_dof else float("nan"),
            "confidence": self.confidence,
        }

    def blame(self) -> Array:
        """Share of the other loops with which each loop disagrees beyond the confidence region ``(l,)``.

        A single false loop disagrees with nearly all others; each of these disagrees with it only.
        """
        other = self.d2.copy()
        np.fill_diagonal(other, np.nan)
        known = np.isfinite(other)
        bad = np.where(known, other, 0.0) > chi2_quantile(self.confidence, 3)
        return np.asarray(bad.sum(axis=1) / np.maximum(known.sum(axis=1), 1))

    def table(self) -> pd.DataFrame:
        """One row per loop: submaps, shared landmarks, error of its cycle, D², blame."""
        e = self.loops.errors
        import pandas as pd

        return pd.DataFrame(
            {
                "a": self.loops.a,
                "b": self.loops.b,
                "shared": self.loops.shared,
                "error": np.hypot(e[:, 0], e[:, 1]),
                "heading": e[:, 2],
                "d2": self.single,
                "p": special.chdtrc(3, self.single),
                "blame": self.blame(),
            }
        )


def loop_consistency(loops: LandmarkLoops, *, confidence: float = 0.95) -> LoopConsistency:
    """Compare every loop with the chain and with every other loop."""
    n = len(loops)
    S = loops.covariance.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    own = S[np.arange(n), np.arange(n)]
    d2 = np.full((n, n), np.nan)
    scale = np.sqrt(np.einsum("kii->ki", own))
    for i in range(n):
        e = loops.errors[i] - loops.errors[i + 1 :]
        C = own[i] + own[i + 1 :] - S[i, i + 1 :] - np.swapaxes(S[i, i + 1 :], 1, 2)
        # units of the two loops' own σ: a relatively tiny variance is only rounding
        u = np.maximum(scale[i], scale[i + 1 :])
        C = C / (u[:, :, None] * u[:, None, :])
        values, vectors = np.linalg.eigh(C)
        y = np.einsum("kji,kj->ki", vectors, e / u)
        fit = values[:, 0] > 1e-9
        d2[i, i + 1 :] = np.where(fit, np.sum(y**2 / np.where(fit[:, None], values, 1.0), axis=1), np.nan)
        d2[i + 1 :, i] = d2[i, i + 1 :]
        d2[i, i] = loops.errors[i] @ np.linalg.solve(own[i], loops.errors[i])
    return LoopConsistency(loops=loops, d2=d2, confidence=confidence)
