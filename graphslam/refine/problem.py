"""The joint least-squares problem of a refinement: blocks, Gauss–Newton steps, covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from graphslam.core.geometry import Array
from graphslam.core.poses import rotation_matrices
from graphslam.core.workers import run_tasks
from graphslam.linear.block_cholesky import BlockFactor, BlockSymbolic
from graphslam.linear.symmetric_factor import elimination_order
from graphslam.refine.fixes import FixModel
from graphslam.refine.motion import MotionModel, MotionTerms, States
from graphslam.refine.surfaces import ScanReturns, SurfacePairs, Surfaces, over_rows, rotate_by_step
from graphslam.registration.plane_kernels import (
    GroupInformation,
    PlanePairs,
    group_information,
    no_noise_correction,
    plane_blocks,
    plane_residuals,
)

Index = npt.NDArray[np.int64]


def halves(n: int) -> tuple[slice, slice]:
    """Rows that are added on their own, always in two sums: these do not depend on the number of threads."""
    return slice(0, n // 2), slice(n // 2, n)


class BlockStructure:
    """Pairs of nodes that share a block, and the offsets of the blocks in one flat array.

    Parameters
    ----------
    widths : (N,)
    a, b : (k,)
        Pairs of nodes, in any order, with repetitions.
    """

    def __init__(self, widths: Index, a: Index, b: Index) -> None:
        N = len(widths)
        order = elimination_order(a.astype(np.intp), b.astype(np.intp), N).astype(np.int64)
        self.rank = np.empty(N, np.int64)
        self.rank[order] = np.arange(N)
        own = np.arange(N)
        rows, columns = self._sorted(np.concatenate([own, a]), np.concatenate([own, b]))
        self.N, self.widths = N, widths
        self.keys = np.unique(rows * N + columns)
        rows, columns = self.keys // N, self.keys % N
        sizes = widths[rows] * widths[columns]
        self.offset = (np.cumsum(sizes) - sizes).astype(np.int64)
        self.size = int(sizes.sum())
        self.begin = np.cumsum(widths) - widths
        ptr = np.searchsorted(rows, np.arange(N + 1)).astype(np.int64)
        self.symbolic = BlockSymbolic(order, widths, ptr, columns.astype(np.int64))

    def _sorted(self, a: Index, b: Index) -> tuple[Index, Index]:
        """Pairs sorted so that the node that is eliminated first comes first."""
        earlier = self.rank[a] <= self.rank[b]
        return np.where(earlier, a, b), np.where(earlier, b, a)

    def at(self, a: Index, b: Index) -> Index:
        """Offsets of blocks; their rows are those of the node that is eliminated first."""
        out = np.empty(len(a), np.int64)

        def find(s: slice) -> None:
            rows, columns = self._sorted(a[s], b[s])
            out[s] = self.offset[np.searchsorted(self.keys, rows * self.N + columns)]

        over_rows(find, len(a))
        return out

    def add(self, terms: MotionTerms, H: Array, g: Array) -> float:
        """Add the blocks of a kind of factor to ``H`` and ``Jᵀ r`` to ``g``; returns the sum of squares."""
        first = np.cumsum((0, *terms.widths))
        JtJ = np.swapaxes(terms.J, 1, 2) @ terms.J
        Jtr = np.einsum("kij,ki->kj", terms.J, terms.r)
        for u, wu in enumerate(terms.widths):
            nu = terms.nodes[:, u]
            np.add.at(g, self.begin[nu][:, None] + np.arange(wu), Jtr[:, first[u] : first[u + 1]])
            for v, wv in enumerate(terms.widths):
                nv = terms.nodes[:, v]
                some = self.rank[nu] <= self.rank[nv]  # the other triangle is symmetric
                if not np.any(some):
                    continue
                block = JtJ[some, first[u] : first[u + 1], first[v] : first[v + 1]].reshape(-1, wu * wv)
                np.add.at(H, self.at(nu[some], nv[some])[:, None] + np.arange(wu * wv), block)
        return float(np.sum(terms.r**2))


@dataclass(frozen=True, slots=True)
class LinearisedProblem:
    """One linearisation, factorised.

    Parameters
    ----------
    parts : dict of str to float
        Objective by kind of factor, ``Σ rᵀ Λ r`` at the point of linearisation.
    """

    pattern: BlockStructure
    factor: BlockFactor
    parts: dict[str, float]


FEW = 200
"""Minimum number of pairs for separate estimates of range noise and surface noise."""
BINS = 6
"""Number of classes of incidence, and of classes of motion variance in each of them."""
MOTION = 0.25
"""Largest share of the motion within a step in the residual variance for classes that estimate other noise."""


def pair_noise(pairs: SurfacePairs, residuals: Array) -> Array:
    """Variances ``(3,)`` of a range and of the surfaces [m²], from the residuals; 1 for the motion.

    At grazing incidence the residual is much smaller than the range error, so the spread of residuals depends on the
    incidence of their beams: squared spreads (1.48 × the median absolute residual) of classes of incidence are
    fitted by a line with two non-negative coefficients.
    """
    if not len(residuals):
        return np.array([0.0, 1e-4, 1.0])
    spread = (1.4826 * float(np.median(np.abs(residuals)))) ** 2
    if len(residuals) < FEW:
        return np.array([0.0, max(spread, LEAST_SPREAD**2), 1.0])
    order = np.argsort(pairs.once[:, 0], kind="stable")
    classes = [
        c[part]
        for c in np.array_split(order, BINS)
        for part in np.array_split(np.argsort(pairs.once[c, 2], kind="stable"), BINS)
    ]

    def medians(c: Index) -> tuple[Array, float]:
        return np.median(pairs.once[c], axis=0), (1.4826 * np.median(np.abs(residuals[c]))) ** 2

    A, v = map(np.array, zip(*run_tasks(medians, ((c,) for c in classes))))
    # a step's own pose absorbs a part of the motion error: classes dominated by motion have too small residuals
    ruled = A[:, 2] / np.maximum(v, LEAST_SPREAD**2)
    some = ruled <= max(MOTION, float(np.quantile(ruled, 0.25)))
    A, v = A[some, :2], np.maximum(v[some] - A[some, 2], LEAST_SPREAD**2)
    w = 1.0 / np.maximum(v, 1e-3 * spread + LEAST_SPREAD**2)  # the σ of a variance is proportional to it
    found, _ = nnls(A * w[:, None], v * w)
    return np.append(np.maximum(found, [0.0, LEAST_SPREAD**2]), 1.0)


LEAST_SPREAD = 1e-3
"""Minimum σ of a surface [m]."""


def agreeing_share(found: SurfacePairs, r: Array, noise: Array) -> float:
    """Share of the source points with a surface in reach that are on it, within three times their σ."""
    near = np.maximum(1.0 - r**2 / (9.0 * found.once @ noise), 0.0)
    weight = 1.0 / found.spent[:, 1]
    return float(np.sum(near * weight) / max(np.sum(weight), 1.0))


def point_information(pairs: SurfacePairs, residuals: Array, noise: Array, least: float = 0.0) -> Array:
    """Information of each pair: Geman–McClure weight divided by its variance.

    Parameters
    ----------
    residuals : (k,) [m]
    noise : (3,)
        Variances of a range and of the surfaces [m²], and 1 (:func:`pair_noise`).
    least : float
        Residuals below it are not down-weighted, because they are large while the path is wrong [m].
    """
    doubt = np.maximum(4.0 * pairs.once @ noise, least**2)
    w = 1.0 / (1.0 + residuals**2 / doubt) ** 2
    return np.asarray(w / (pairs.spent @ noise))


ALIKE = 80
"""Number of consecutive beams of a step whose errors may be correlated: a scan line, a wall. Also tried: all of a
step."""
FEWEST_SUMS = 50
"""Minimum number of sums of residuals to estimate their correlation."""


def correlation_factor(found: SurfacePairs, cloud: ScanReturns, residuals: Array, noise: Array) -> float:
    """Ratio of the variance of sums of residuals to that of independent errors of points, ≥ 1.

    Beams of one scan share errors: of a scan line, of the material and the incidence of a wall, of a wrong motion
    correction. A mean over them is then less accurate than their number suggests. Residuals of consecutive points of a
    step, on surfaces of one chunk, are added. If errors are independent, each source point contributes half of the
    variance of its residual, each target this times the square of its number of pairs; the motion within the step is
    common to all. The same ratio is assumed for all directions.
    Parameters
    ----------
    residuals : (k,) [m]
    noise : (3,)
        See :func:`pair_noise`.
    """
    v = found.once @ noise
    good = np.flatnonzero(residuals**2 < 9.0 * v)
    if not len(good):
        return 1.0
    p, q, i, m = found.pairs.source[good], found.pairs.target[good], found.pairs.i[good], found.whose[good]
    z = residuals[good] / np.sqrt(v[good])
    moved = np.sqrt(found.once[good, 2] * noise[2] / v[good])
    order = p - np.searchsorted(cloud.step, i)

    def ratio(length: int) -> float:
        key = (m * (int(i.max()) + 1) + i) * (int(order.max()) // length + 1) + order // length
        key = np.unique(key, return_inverse=True)[1]
        shared, times = np.unique(key * len(cloud.points) + q, return_counts=True)
        own = np.bincount(key, weights=1.0 - moved**2) / np.bincount(key)
        targets = np.bincount(shared // len(cloud.points), weights=times.astype(float) ** 2)
        wanted = 0.5 * own * (np.bincount(key) + targets) + np.bincount(key, weights=moved) ** 2
        if len(wanted) < FEWEST_SUMS:
            return 1.0
        return float(np.sum(np.bincount(key, weights=z) ** 2) / np.sum(wanted))

    return max(1.0, *run_tasks(ratio, ((ALIKE,), (len(cloud.points),))))


def surface_residuals(pairs: PlanePairs, cloud: ScanReturns, surfaces: Surfaces, poses: Array) -> Array:
    """Distances of source points from their surfaces ``(k,)`` at a path ``(n, 7|3)`` [m]."""
    out = np.empty(len(pairs.source))
    t = np.ascontiguousarray(poses[:, : cloud.points.shape[1]])
    R = rotation_matrices(poses)

    def fill(s: slice) -> None:
        plane_residuals(pairs.some(s), R, t, cloud.points, surfaces.normals, out[s])

    over_rows(fill, len(out))
    return out


NOISE_INDUCED = 1.5
"""Factor on the average spurious information of noisy normals that is subtracted, because groups scatter."""


def chunk_information(
    found: SurfacePairs, cloud: ScanReturns, surfaces: Surfaces, poses: Array, information: Array
) -> GroupInformation:
    """Information between each two chunks, without the spurious information of noisy normals.

    Normals of a smooth wall have random errors along it. Their squares, summed over thousands of pairs, look like
    information on the motion along the wall, and pull the path to where the pairs were found. The variance of each
    normal gives the average spurious information ``F`` and the pull. The pull is subtracted from the gradient. In a
    direction whose information is h times the spurious one, the share 1 - 1/h of each derivative is kept, which leaves
    ``(h - 1)² / h``, the information of an estimate without that pull. In a corridor nothing remains along it, in a
    round room nothing of the rotation, over a plain neither.
    """
    pairs, group = found.pairs, found.whose
    d = cloud.points.shape[1]
    if not len(group):
        return no_noise_correction(d)
    w, G = (6 if d == 3 else 3), int(group.max()) + 1
    R, t = rotation_matrices(poses), np.ascontiguousarray(poses[:, :d])
    x = rotate_by_step(R, pairs.j, cloud.points[pairs.target], t)
    centre: Array = np.stack([np.bincount(group, x[:, k], G) for k in range(d)], axis=1, dtype=np.float64)
    centre /= np.maximum(np.bincount(group, minlength=G), 1)[:, None]
    surfaces_of = (cloud.points, surfaces.normals, surfaces.tilts)
    sums = np.zeros((2, 2, G, w, w))

    def add(s: slice, out: Array) -> None:
        group_information(pairs.some(s), (R, t), surfaces_of, information[s], (group[s], centre), out[0], out[1])

    run_tasks(add, zip(halves(len(group)), sums))
    H, F = sums[0] + sums[1]
    size = np.einsum("mii->mi", H + F) + 1e-12
    L = np.linalg.cholesky(F + 1e-9 * np.eye(w) * size[:, None, :])
    values, U = np.linalg.eigh(np.linalg.solve(L, np.swapaxes(np.linalg.solve(L, H), 1, 2)))
    share = np.maximum(1.0 - NOISE_INDUCED / np.maximum(values, 1e-12), 0.0)
    back = np.swapaxes(np.linalg.solve(np.swapaxes(L, 1, 2), U), 1, 2)  # Uᵀ L⁻¹
    return GroupInformation(group, centre, np.ascontiguousarray((L @ (U * share[:, None, :])) @ back), surfaces.tilts)


class RefinementProblem:
    """Scans, motion, gravity and fixes on the nodes of a path.

    Parameters
    ----------
    held : (7,) or (3,)
        Fixed value of the first pose.
    """

    def __init__(self, motion: MotionModel, cloud: ScanReturns, held: Array, fixes: FixModel | None = None) -> None:
        self.motion, self.cloud, self.held, self.fixes = motion, cloud, held, fixes
        self.widths = motion.widths if fixes is None else np.concatenate([motion.widths, fixes.widths])
        self._key: object = None
        self._pattern: BlockStructure | None = None

    def _pattern_of(self, pairs: PlanePairs, extra: list[MotionTerms]) -> BlockStructure:
        key = (id(pairs.source), *(id(t.nodes) for t in extra))
        if self._key != key:
            n = self.motion.steps_count
            nodes = self.motion.nodes
            met = np.unique(pairs.i * n + pairs.j)  # pairs of steps: far fewer than pairs of points
            a, b = [met // n], [met % n]
            for u in range(nodes.shape[1]):
                for v in range(u):
                    a.append(nodes[:, u])
                    b.append(nodes[:, v])
            K = len(self.motion.knots)
            a += [n + np.arange(K), np.arange(n), n + np.arange(K - 1)]
            b += [np.full(K, n + K), np.full(n, n + K), n + np.arange(1, K)]
            for t in extra:
                for u in range(len(t.widths)):
                    for v in range(u):
                        a.append(t.nodes[:, u])
                        b.append(t.nodes[:, v])
            self._pattern = BlockStructure(self.widths, np.concatenate(a), np.concatenate(b))
            self._key, self._held = key, (pairs.source, extra)  # references keep the ids in the key valid
        assert self._pattern is not None
        return self._pattern

    def linearise(
        self,
        poses: Array,
        states: States,
        pairs: PlanePairs,
        surfaces: Surfaces,
        information: Array,
        extra: list[MotionTerms] | None = None,
        holds: GroupInformation | None = None,
    ) -> tuple[LinearisedProblem, Array]:
        """Factorised Gauss–Newton matrix at a path, and the step ``(N scalars,)``; ``holds`` None: no correction."""
        more = [*(extra or []), *([] if self.fixes is None else self.fixes.terms(poses, states))]
        pattern, motion = self._pattern_of(pairs, more), self.motion
        n, w = motion.steps_count, motion.group.dof
        H, g = np.zeros(pattern.size), np.zeros(pattern.widths.sum())
        gp = np.zeros((n, w))
        own = np.arange(n)
        R, t = rotation_matrices(poses), np.ascontiguousarray(poses[:, : motion.group.dim])
        first, offset = pattern.at(own, own), pattern.at(pairs.i, pairs.j)
        held = holds or no_noise_correction(motion.group.dim)

        def add(s: slice, H: Array, g: Array) -> float:
            slots, groups = (first, offset[s], pattern.rank), held._replace(group=held.group[s])
            clouds = self.cloud.points, surfaces.normals
            return plane_blocks(pairs.some(s), (R, t), clouds, information[s], slots, groups, H, g)

        other, gq = np.zeros_like(H), np.zeros_like(gp)
        parts = {"scans": sum(run_tasks(add, zip(halves(len(pairs.source)), (H, other), (gp, gq))))}
        H += other
        del other
        g[: n * w] = (gp + gq).ravel()
        for terms in [*motion.terms(poses, states), motion.gauge(poses, self.held), *more]:
            parts[terms.name] = parts.get(terms.name, 0.0) + pattern.add(terms, H, g)
        factor = pattern.symbolic.factor(pattern.offset, H)
        return LinearisedProblem(pattern, factor, parts), -factor.solve(g)

    def moved(self, poses: Array, states: States, step: Array) -> tuple[Array, States]:
        """Path and states after a step."""
        n, w = self.motion.steps_count, self.motion.group.dof
        g = self.motion.group
        K = len(self.motion.knots)
        rest = step[n * w :]
        c = self.motion.constants
        out: States = (states[0] + rest[:K], states[1] + rest[K : K + c])
        if self.fixes is not None:
            out = (*out, *self.fixes.moved(states, step))
        return g.compose(poses, g.exp(step[: n * w].reshape(n, w))), out
