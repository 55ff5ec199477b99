"""End of segments: motion error (A7), predictive score (A8), period; within a minimum and a maximum size.

The predictive score is the quality of the maps' prediction of the beams of the next seconds. It depends on the place
far more than on the particle (it falls at doors, corners, ramps), so the default is one decision for the whole filter.
It is low in a new map, so the first seconds of a segment are not used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of, normalise_weights
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.likelihood import CastLikelihood
from graphslam.evidence.queries import cast_grids
from graphslam_frontends.segslam.config import SegmentationConfig

Scan = tuple[Array, Array, npt.NDArray[np.bool_]]
"""Points, origins and returns of one step, in the base frame at its stamp."""
SCORE_SIGMA, SCORE_CLIP = 0.3, 3.0
"""σ of the ranges in the log-likelihood of the predictive score [m], and the limit of residuals [σ]."""
KNOWN_SCORE = 0.8
"""Predictive score above which revisited ground counts as known: it does not add to the length of a segment, because a
new segment there would map it a second time. In a simulated building 75 % of the scores on new ground are below 0.78,
and 75 % of those on the way back above 0.84."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LookAheadWindow:
    """Beams of the look-ahead window, transformed by dead reckoning to the body frame before it (A8).

    Parameters
    ----------
    points, origins : (n, dim)
        Of returns within range [m].
    beams : int
        Number of beams of the window, including those without a return.
    """

    points: Array
    origins: Array
    beams: int

    def __len__(self) -> int:
        return len(self.points)

    def thinned(self, most: int) -> LookAheadWindow:
        """At most ``most`` of its points, evenly spaced."""
        if len(self) <= most:
            return self
        rows = np.linspace(0, len(self) - 1, most).astype(np.int64)
        return LookAheadWindow(points=self.points[rows], origins=self.origins[rows], beams=self.beams)


def gather_window(increments: ArrayLike, scans: Sequence[Scan], max_range: float) -> LookAheadWindow:
    """Transform the scans of a window to one frame.

    Parameters
    ----------
    increments : (w, 7) or (w, 3)
        Dead reckoning from each step of the window to the next, the first from the body frame to the first step.
    scans : sequence of w scans
    max_range : float
        Beams longer than this are left out [m].
    """
    u = np.asarray(increments, dtype=np.float64)
    g = group_of(u)
    if len(u) != len(scans):
        raise DataError("a window needs one increment for each scan", got=len(u), wanted=len(scans))
    if not scans:
        return LookAheadWindow(points=np.zeros((0, g.dim)), origins=np.zeros((0, g.dim)), beams=0)
    T = np.empty_like(u)
    for k, step in enumerate(u):
        T[k] = step if k == 0 else g.compose(T[k - 1], step)
    p, o, returns = (np.concatenate(part) for part in zip(*scans))
    ranges = np.linalg.norm(p - o, axis=1)
    use = np.asarray(returns, dtype=bool) & (ranges < max_range) & (ranges > 0.0)
    at = np.repeat(T, [len(scan[0]) for scan in scans], axis=0)[use]
    return LookAheadWindow(points=g.transform(at, p[use]), origins=g.transform(at, o[use]), beams=len(p))


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowScore:
    """Prediction of a window by maps.

    Parameters
    ----------
    shares : (P,)
        Share of the beams that the map of a particle predicts; NaN without any beam.
    log_likelihoods : (P,)
        Mean log-likelihood per beam, 0 = perfect (eq. 15–17, limited); NaN likewise.
    share, log_likelihood : float
        Weighted means over the particles.
    """

    shares: Array
    log_likelihoods: Array
    share: float
    log_likelihood: float
    beams: int


def predictive_score(
    grids: Sequence[EvidenceGrid],
    poses: ArrayLike,
    window: LookAheadWindow,
    max_range: float,
    *,
    weights: ArrayLike | None = None,
    tolerance: float = 0.6,
    threads: int = 1,
) -> WindowScore:
    """Ray-cast the beams of a look-ahead window in the particles' maps (A8).

    Parameters
    ----------
    grids : sequence of P EvidenceGrid
    poses : (P, 7) or (P, 3)
        ``T_map_body`` before the window.
    max_range : float
        [m]
    weights : (P,), optional
    tolerance : float
        A beam is predicted if the expected range is within this [m]; without an expected range it is not.
    threads : int
        The result does not depend on it.
    """
    n = len(grids)
    w = normalise_weights(weights, n)
    if not len(window):
        nan = np.full(n, np.nan)
        return WindowScore(shares=nan, log_likelihoods=nan, share=math.nan, log_likelihood=math.nan, beams=0)
    rays = window.points - window.origins
    measured = np.linalg.norm(rays, axis=1)
    # a wall slightly beyond the beam must count, or the tolerance would be one-sided at the limit
    reach = max_range + tolerance
    c = cast_grids(grids, poses, window.origins, rays, reach, threads=threads)
    with np.errstate(invalid="ignore"):
        near = c.hit & (np.abs(c.ranges - measured) <= tolerance)
    shares = near.mean(axis=1)
    likelihood = CastLikelihood(exponent=1.0, sigma=SCORE_SIGMA, clip=SCORE_CLIP)
    log_p = likelihood.beams(c.ranges, c.status, measured, reach).mean(axis=1)
    return WindowScore(
        shares=shares,
        log_likelihoods=log_p,
        share=float(w @ shares),
        log_likelihood=float(w @ log_p),
        beams=len(window),
    )


def representative_particles(weights: Array, most: int) -> tuple[npt.NDArray[np.int64], Array]:
    """Indices of at most ``most`` representative particles, evenly spaced over the weight, and their shares.

    Their weighted mean approximates that of all, within the spread of one ``most``-th of the weight.
    """
    if len(weights) <= most:
        return np.arange(len(weights), dtype=np.int64), weights
    at = (np.arange(most) + 0.5) / most * weights.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), at, side="right"), np.flatnonzero(weights > 0)[-1])
    rows, counts = np.unique(chosen, return_counts=True)
    return rows.astype(np.int64), counts / most


def motion_error(lengths: ArrayLike, turns: ArrayLike, translation: ArrayLike, rotation: ArrayLike) -> Array:
    """Accumulated motion error of a segment after each step ``(n,)`` (A7, eq. 13).

    Parameters
    ----------
    lengths, turns : (n,)
        Metres driven and radians rotated in each step of the segment.
    translation, rotation : float or (n,)
        α1 [1/m] and α2 [1/rad]; with arrays the error depends on the state (eq. 14).
    """
    d, a = np.abs(np.asarray(lengths, dtype=np.float64)), np.abs(np.asarray(turns, dtype=np.float64))
    per_metre, per_radian = np.asarray(translation, dtype=np.float64), np.asarray(rotation, dtype=np.float64)
    return np.asarray(np.cumsum(per_metre * d + per_radian * a))


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentDecision:
    """Decision whether a segment ends here.

    Parameters
    ----------
    why : str
        "score", "relative-score", "motion-error", "period", "max-length", "max-seconds"; if it does not end: "young" or
        "short" (a criterion is met too early), or "".
    score, best_score : float
        The score, NaN if there is none, and its maximum in the segment, NaN before the first that counts.
    seconds, length : float
        Duration and path length of the segment [s], [m].
    new_ground : float
        Path length over ground that its map did not predict [m].
    error : float
        Motion error.
    """

    ends: bool
    why: str
    score: float
    best_score: float
    seconds: float
    length: float
    new_ground: float
    error: float


@dataclass(slots=True)
class Segmenter:
    """Decides when the segment of a filter (or of a particle) ends.

    Parameters
    ----------
    time : float
        Start of the segment [s].
    length : float
        Path length by odometry up to there [m].
    turned : float
        Sum of absolute rotations up to there [rad].
    """

    config: SegmentationConfig
    time: float
    length: float = 0.0
    turned: float = 0.0
    best: float = field(default=math.nan, init=False)
    last: float = field(default=-math.inf, init=False)
    new_ground: float = field(default=0.0, init=False)
    seen: float = field(default=math.nan, init=False)

    def __post_init__(self) -> None:
        self.seen = self.length

    def begin(self, time: float, length: float, turned: float = 0.0) -> None:
        """Start a new segment."""
        self.time, self.length, self.turned = time, length, turned
        self.best, self.last = math.nan, -math.inf
        self.new_ground, self.seen = 0.0, length

    def copy(self) -> Segmenter:
        """A copy, for a resampled particle."""
        twin = Segmenter(self.config, self.time, self.length, self.turned)
        twin.follow(self)
        return twin

    def follow(self, other: Segmenter) -> None:
        """Copy the state of another one that has decided."""
        self.best, self.last, self.new_ground, self.seen = other.best, other.last, other.new_ground, other.seen

    def due(self, time: float) -> bool:
        """Is it time for a decision? Rounding of the clock does not delay it."""
        return time - max(self.last, self.time) >= self.config.every - 1e-6

    def wants_score(self, time: float) -> bool:
        """Would a score be used now? Otherwise ray casting is skipped."""
        c = self.config
        return not c.period and bool(c.score or c.relative_score) and time - self.time >= c.excluded - 1e-6

    def decide(
        self, time: float, length: float, turned: float = 0.0, score: float = math.nan, *, again: bool = False
    ) -> SegmentDecision:
        """Does the segment end here?

        Parameters
        ----------
        time, length, turned : float
            Current values, on the same scales as at the start.
        score : float
            Predictive score of the window ahead; NaN: there is none.
        again : bool
            The path of its map was here before; only then may the ground be known.
        """
        c = self.config
        seconds, driven = time - self.time, length - self.length
        if not (seconds >= 0.0 and driven >= -1e-9 and math.isfinite(seconds) and math.isfinite(driven)):
            raise GeometryError("a segment runs backwards", got=f"{seconds} s, {driven} m", wanted="≥ 0")
        self.last = time
        error = float(motion_error([driven], [turned - self.turned], c.motion_translation, c.motion_rotation)[-1])
        counts = not math.isnan(score) and seconds >= c.excluded - 1e-6
        known = counts and again and score >= KNOWN_SCORE
        if counts:
            # The running maximum includes the current score, but not the high scores of revisited ground: going from
            # there to new ground is no drop.
            usual = KNOWN_SCORE if known else score
            self.best = usual if math.isnan(self.best) else max(self.best, usual)
        if not known:  # since the last decision; without a score the ground counts as new
            self.new_ground += length - self.seen
        self.seen = length
        why = self._why(seconds, driven, error, score if counts else math.nan)
        ends = bool(why)
        if ends and not why.startswith("max"):
            if seconds < c.min_seconds - 1e-6 and why != "period":
                ends, why = False, "young"
            elif driven < c.min_length:
                ends, why = False, "short"
        return SegmentDecision(
            ends=ends, why=why, score=score, best_score=self.best, seconds=seconds, length=driven,
            new_ground=self.new_ground, error=error,
        )  # fmt: skip

    def _why(self, seconds: float, driven: float, error: float, score: float) -> str:
        c = self.config
        if self.new_ground >= c.max_length - 1e-9:
            return "max-length"
        if seconds >= c.max_seconds and driven >= c.min_length:
            return "max-seconds"
        if c.period:
            return "period" if seconds >= c.period - 1e-6 else ""
        if (c.motion_translation or c.motion_rotation) and error >= 1.0:
            return "motion-error"
        if not math.isnan(score):
            if score < c.score:
                return "score"
            if score < c.relative_score * self.best:
                return "relative-score"
        return ""
