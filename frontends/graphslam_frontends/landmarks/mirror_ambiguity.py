"""Mirror images of range-only landmarks: resolved by smoothing the submap; ambiguous landmarks are removed.

A filter initialises a beacon by the best fit *given the path of a particle*. A path with some drift may fit the mirror
image better, and after resampling no other particles may be left. The smoother can change the path. So after it, every
other position that explains the ranges of a landmark is tried: the whole submap is smoothed again from there, and the
better one is kept. If both fit similarly well, the landmark is ambiguous and removed, as is one that is too uncertain
for a Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array, se2_transform
from graphslam_frontends.landmarks.config import DelayedInitialisation
from graphslam_frontends.landmarks.range_only_kernels import FIT_LENGTH, circle_starts, trilaterate_kernel
from graphslam_frontends.landmarks.summarise import SmoothingProblem, SmoothingResult

Bools = npt.NDArray[np.bool_]
_ROUNDS = 3  # a swap changes the path, so the others are tried again
_APART = 1.0  # an alternative this near [m] is the landmark itself


@dataclass(frozen=True, slots=True)
class ResolvedMirrors:
    """A submap without mirror ambiguities.

    Parameters
    ----------
    smoothed : SmoothingResult
        Over the observations and landmarks of the problem.
    swapped : int
        Number of landmarks replaced by their mirror image.
    ambiguous : int
        Number of landmarks removed because both fit similarly well.
    vague : int
        Number of landmarks removed because they are too uncertain for a Gaussian.
    """

    smoothed: SmoothingResult
    swapped: int
    ambiguous: int
    vague: int


def resolve_mirror_ambiguity(
    problem: SmoothingProblem, first: SmoothingResult, config: DelayedInitialisation
) -> ResolvedMirrors:
    """Try every alternative position of every landmark without bearings.

    Parameters
    ----------
    first : SmoothingResult
        Smoothing from the start of the filter.
    config : DelayedInitialisation
        A landmark must be better than its alternatives by ``margin``, with a σ within ``spread``.
    """
    blind = np.ones(len(first.landmark_kept), dtype=np.bool_)
    np.logical_and.at(blind, problem.ob_landmark, np.isinf(problem.observations[:, 3]))
    if not np.any(blind & first.landmark_kept):
        return ResolvedMirrors(first, 0, 0, 0)
    current, swapped = first, 0
    for _ in range(_ROUNDS):
        current, ambiguous, swaps = _round(problem, current, blind, config.margin)
        swapped += swaps
        if not swaps:
            break
    vague = _vague(problem, current, blind, config.spread) & ~ambiguous
    if not np.any(ambiguous | vague):
        return ResolvedMirrors(current, swapped, 0, 0)
    without = current.landmark_kept & ~(ambiguous | vague)
    kept = current.kept & without[problem.ob_landmark]
    small = problem.restricted(kept, without)
    start = _positions(current)[without[current.landmark_kept]]
    last = small.smooth(current.poses, start)
    last = replace(last, kept=kept, landmark_kept=without)
    return ResolvedMirrors(last, swapped, int(ambiguous.sum()), int(vague.sum()))


def _vague(problem: SmoothingProblem, current: SmoothingResult, blind: Bools, spread: float) -> Bools:
    """Landmarks with largest σ above ``spread`` of their mean range, relative to both base and exit.

    The drift of the two is different: a landmark observed at the beginning is precise relative to the base, one at the
    end relative to the exit.
    """
    out = np.zeros(len(blind), dtype=np.bool_)
    P, exit_pose = current.gaussian.covariance, current.gaussian.mean[:3]
    c, s = np.cos(exit_pose[2]), np.sin(exit_pose[2])
    for rank, j in enumerate(np.flatnonzero(current.landmark_kept)):
        if not blind[j]:
            continue
        ix = np.array([0, 1, 2, 3 + 2 * rank, 4 + 2 * rank])
        dx, dy = current.gaussian.mean[ix[3:]] - exit_pose[:2]
        # ∂/∂[pose, l] of R(θ)ᵀ (l - p), as in eq. 15
        J = np.array([[-c, -s, -s * dx + c * dy, c, s], [s, -c, -c * dx - s * dy, -s, c]])
        local = J @ P[np.ix_(ix, ix)] @ J.T
        largest = min(np.linalg.eigvalsh(local)[-1], np.linalg.eigvalsh(P[np.ix_(ix[3:], ix[3:])])[-1])
        ranges = problem.observations[(problem.ob_landmark == j) & current.kept, 0]
        out[j] = np.sqrt(largest) > spread * ranges.mean()
    return out


def _positions(smoothed: SmoothingResult) -> Array:
    return smoothed.gaussian.mean[3:].reshape(-1, 2)


def _round(
    problem: SmoothingProblem, current: SmoothingResult, blind: Bools, margin: float
) -> tuple[SmoothingResult, Bools, int]:
    """One iteration over all landmarks: the best smoothing, which ones are ambiguous, number of swaps."""
    inner = problem.restricted(current.kept, current.landmark_kept)
    poses, landmarks, chi2 = current.poses, _positions(current), current.chi2
    where = np.flatnonzero(current.landmark_kept)
    ambiguous = np.zeros(len(blind), dtype=np.bool_)
    swaps = 0
    for j in np.flatnonzero(blind[where]):
        closest = np.inf
        for rival in _rivals(inner, poses, landmarks[j], int(j)):
            start = landmarks.copy()
            start[j] = rival
            other = inner.smooth(poses, start)
            moved = _positions(other)
            if not other.converged or np.hypot(*(moved[j] - landmarks[j])) < _APART:
                continue  # it converged to the same minimum
            gain = chi2 - other.chi2
            closest = min(closest, abs(gain))
            if gain > 0.0:
                poses, landmarks, chi2 = other.poses, moved, other.chi2
                swaps += 1
        ambiguous[where[j]] = closest < margin
    if not swaps:
        return current, ambiguous, 0
    # observations trimmed with the mirror image may be good: start from the whole problem
    again = problem.restricted(np.ones(len(problem.ob_pose), dtype=np.bool_), current.landmark_kept)
    again = replace(again, trim=problem.trim, min_hits=problem.min_hits)
    solved = again.smooth(poses, landmarks)
    among = current.landmark_kept[problem.ob_landmark]
    kept = np.zeros(len(among), dtype=np.bool_)
    kept[among] = solved.kept
    landmark_kept = np.zeros(len(blind), dtype=np.bool_)
    landmark_kept[where] = solved.landmark_kept
    return replace(solved, kept=kept, landmark_kept=landmark_kept), ambiguous & landmark_kept, swaps


def _rivals(problem: SmoothingProblem, poses: Array, landmark: Array, j: int) -> Iterator[Array]:
    """Other positions that explain the ranges of landmark j, for the current path."""
    rows = problem.ob_landmark == j
    anchors = np.ascontiguousarray(se2_transform(poses[problem.ob_pose[rows]], problem.sensor[:2]))
    ranges, variances = problem.observations[rows, 0], problem.observations[rows, 2]
    starts = circle_starts(anchors, ranges, np.inf)
    minima = np.empty((len(starts), 3))
    fit, used = np.empty(FIT_LENGTH), np.zeros(len(ranges), dtype=np.bool_)
    found = trilaterate_kernel(anchors, ranges, variances, np.inf, starts, fit, used, minima)
    for x, y, _ in minima[:found]:
        if np.hypot(x - landmark[0], y - landmark[1]) > _APART:
            yield np.array([x, y])
