"""Result of a SegSLAM run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.grid.ancestry import Ancestry
from graphslam_frontends.grid.filter import FilterCounts
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.candidate_selection import CandidateSelection
from graphslam_frontends.segslam.matching import MatchAttempt
from graphslam_frontends.segslam.paths import concatenate_segments
from graphslam_frontends.segslam.sampling import MapSample, draw_weights, grow_sample, root_of_segment
from graphslam_frontends.segslam.segmap import SegMap

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreLine:
    """The predictive score at one step (A8)."""

    step: int
    share: float
    log_likelihood: float
    beams: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Boundary:
    """A boundary: where segments ended, the reason, the number of particles, and of distinct segments."""

    step: int
    why: str
    particles: int
    segments: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SegSlamResult:
    """A run of SegSLAM.

    Parameters
    ----------
    segmap : SegMap
        All its segments are closed.
    closed : (N,) int64
        The last segment of each particle.
    weights : (N,)
    best : int
        Index of the particle with the largest weight.
    effective, resampled : (n,)
        N_eff of each step before resampling; whether it was resampled.
    ancestry : Ancestry
        Poses in the frames of the segments; tags are the numbers of the segments.
    scores, attempts, boundaries : tuples
        In the order of time; only attempts with candidates.
    seconds : mapping of str to float
        Wall time by part [s].
    step_seconds : (n,)
        CPU time of each step, all parts together [s].
    used_bytes : int
        Memory of all maps at the end [bytes].
    """

    steps: Steps
    segmap: SegMap
    closed: Ints
    weights: Array
    best: int
    effective: Array
    resampled: npt.NDArray[np.bool_]
    ancestry: Ancestry
    scores: tuple[ScoreLine, ...]
    attempts: tuple[MatchAttempt, ...]
    boundaries: tuple[Boundary, ...]
    winnowed: CandidateSelection
    tally: FilterCounts
    seconds: dict[str, float]
    step_seconds: Array
    used_bytes: int
    seed: SeedTree

    @property
    def total_seconds(self) -> float:
        """Wall time of all parts [s]."""
        return float(sum(self.seconds.values()))

    def sample(self, number: int = 0, particle: int | None = None) -> MapSample:
        """A full map sample, grown from the last segment of a particle (default: the best).

        Parameters
        ----------
        number : int
            Samples with different numbers are independent; the same number gives the same sample.
        """
        at = int(self.closed[self.best if particle is None else particle])
        rng = self.seed.child("map-sample", number).generator()
        return grow_sample(self.segmap, root_of_segment(self.segmap, at), rng, weights=draw_weights(self.segmap))

    def trajectory(self, number: int = 0, particle: int | None = None) -> Trajectory:
        """The whole path of a map sample in the frame of its first segment (A6)."""
        s = self.sample(number, particle)
        path = concatenate_segments(self.segmap, s)
        group = self.segmap.group
        first = int(s.in_time[0])
        return path.transformed(group.inverse(s.poses[first]))

    @property
    def final_pose(self) -> Array:
        """End pose of the best particle in the frame of the first segment, by the map sample."""
        s = self.sample()
        group = self.segmap.group
        exit = self.segmap.table.exit[int(self.closed[self.best])]
        return np.asarray(group.between(s.poses[int(s.in_time[0])], exit))

    def report(self) -> dict[str, Any]:
        """Metrics of the run, ready for JSON."""
        n = len(self.weights)
        quantiles = np.quantile(self.effective / n, [0.05, 0.5])
        t = self.segmap.table
        return {
            "steps": len(self.steps),
            "particles": n,
            "path_length": float(self.steps.path_length[-1]),
            "segments": len(self.segmap),
            "intervals": len(self.segmap.intervals()),
            "pruned": self.segmap.pruned,
            "matches": int(np.sum(t.kind[: len(self.segmap)] == 1)),
            "attempts": len(self.attempts),
            "searches": sum(a.searches for a in self.attempts),
            "registrations": sum(a.registrations for a in self.attempts),
            "resamplings": self.tally.resamplings,
            "effective_median": float(quantiles[1]),
            "effective_p05": float(quantiles[0]),
            "steps_without_beams": self.tally.without_beams,
            "steps_without_returns": self.tally.without_returns,
            "beams_dropped": self.tally.dropped_rays,
            "maps_megabytes": self.used_bytes / 1e6,
            "seconds": {k: round(v, 6) for k, v in self.seconds.items()},
        }
