"""The step *Estimate* of SegSLAM: the current pose from the particles, brought up to date by dead reckoning."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.poses import Group, pose_mean
from graphslam_frontends.base import PoseEstimate
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.odometry.growing_steps import GrowingSteps
from graphslam_frontends.odometry.scan_use import dead_reckoning_covariance, unobserved_covariance, unobserved_stretches
from graphslam_frontends.segslam.covariance import exit_covariance
from graphslam_frontends.segslam.segmap import KINDS, MATCH, Segment, SegmentEntry
from graphslam_frontends.segslam.segslam import SegSlamFilter
from graphslam_frontends.segslam.submaps import (
    Drift,
    common_ancestor_chain,
    drift_by_path,
    exits_of_interval,
    levelled_covariance,
    match_target,
    segment_base,
)

Link = tuple[int, Array, Array]
"""Key of a submap, a pose relative to its base, and its covariance."""


class PoseEstimator:
    """The current pose relative to a submap: mean of the particles after the last filtered step, then dead reckoning.

    The path leads from the end of the last submap that was output, over the segments of the best particle since then,
    or from an older submap whose map its particles have entered. Where particles disagree, the mean and its covariance
    hold all of them: their motion since the start of the segment.

    Parameters
    ----------
    drift : FilterDrift
        Errors common to all particles.
    scale : float
        Factor on the drift, as for end poses.
    """

    def __init__(self, run: SegSlamFilter, steps: GrowingSteps, drift: FilterDrift, scale: float) -> None:
        self.run, self.steps, self.drift, self.scale = run, steps, drift, scale
        self.committed = 0
        """Number of submaps that were output."""
        self._base: tuple[Any, Link] = (None, (0, np.zeros(0), np.zeros(0)))
        self._reckoned: tuple[Any, Link] = self._base
        self._drifts: dict[int, Array] = {}  # over closed segments

    def now(self) -> PoseEstimate:
        """The pose at the last record of the motion."""
        g, run, steps = self.run.segmap.group, self.run, self.steps
        k, made = run.at, steps.made - 1
        key = k, made, len(run.boundaries), self.committed
        if self._reckoned[0] != key:
            link = self._to_segment()
            if all(e is not None for e in run.segmap.entries):
                link = self._in_segment(link)
            if made > k:  # dead reckoning over the look-ahead
                link = link[0], *_compose(g, link[1], link[2], *steps.all_errors().between(k, made))
            self._reckoned = key, link
        anchor, T, C = self._reckoned[1]
        more = steps.motion_to_now()
        if more is not None:
            T, C = _compose(g, T, C, *more[1:])
        return PoseEstimate(more[0] if more else float(steps.all_times()[-1]), anchor, T, C, float(steps.times[k]))

    def _to_segment(self) -> Link:
        """The base of the open segment."""
        segmap, best = self.run.segmap, self.run.filter.particles.best
        key = (int(segmap.previous[best]), id(segmap.entries[best]), self.committed)
        if self._base[0] != key:
            self._base = key, self._chain(key[0], best)
        return self._base[1]

    def _chain(self, last: int, best: int) -> Link:
        segmap, n = self.run.segmap, self.committed
        g = segmap.group
        chain = common_ancestor_chain(segmap, last).tolist() if last >= 0 else []
        known = [segmap[i] for i in chain[:n]]
        link: Link = n, g.identity, np.zeros((g.dof, g.dof))
        drift = drift_by_path(segmap, chain[n:], self.drift, self.steps) if chain[n:] else None
        for i in chain[n:]:
            s = segmap[i]
            if s.kind == KINDS[MATCH]:
                link = self._entered(link, s.source, (s.T_entry, s.match_covariance), known)
            exit_pose = g.between(segment_base(segmap, s.T_entry), segment_base(segmap, s.T_exit))
            exits, weights = exits_of_interval(segmap, s.interval)
            if i not in self._drifts:
                self._drifts[i] = cast(Drift, drift)(*s.interval, level_end=True)
            C = exit_covariance(exits, exit_pose, self._drifts[i], weights=weights, drift_scale=self.scale).total
            link = link[0], *_compose(g, link[1], link[2], exit_pose, C)
        e = segmap.entries[best]
        if e is not None and e.kind == MATCH:
            link = self._entered(link, e.source, (e.T_entry, e.covariance), known)
        return link

    def _entered(self, link: Link, source: int, entry: tuple[Array, Array | None], known: list[Segment]) -> Link:
        """The link by the older submap whose map was entered, if that was output."""
        segmap = self.run.segmap
        found = match_target(segmap, source, entry[0], known)
        if found is None or entry[1] is None:
            return link
        anchor = next(k for k, s in enumerate(known) if s.index == found[0].index)
        return anchor, found[1], levelled_covariance(segmap, entry[0], entry[1])

    def _in_segment(self, link: Link) -> Link:
        """Motion of all particles since they entered the open segment."""
        run, segmap, k = self.run, self.run.segmap, self.run.at
        p, g, best, steps = run.filter.particles, segmap.group, run.filter.particles.best, self.steps
        entries = np.stack([cast(SegmentEntry, e).T_entry for e in segmap.entries])
        moved = g.between(segment_base(segmap, entries), p.poses)
        mean = pose_mean(moved, p.weights)
        start = int(segmap.start[best])
        own = run.filter.ancestry.recent(k - start)[:, best] if k > start else p.poses[:0]
        path = np.concatenate([entries[best][None], own])
        # the body is not levelled here, as it is at the end of a segment
        reckoned = dead_reckoning_covariance(steps, start, k, level_end=False)
        tilt = None if steps.tilt is None else steps.tilt_sigma
        D = self.drift.covariance(path, segmap.particles, gravity=False, reckoned=reckoned, tilt_sigma=tilt)
        stretches = [] if segmap.particles == 1 else unobserved_stretches(steps)
        D = D + unobserved_covariance(steps, stretches, path, start, k)
        C = exit_covariance(moved, mean, D, weights=p.weights, drift_scale=self.scale).total
        return link[0], *_compose(g, link[1], link[2], mean, C)


def _compose(g: Group, T: Array, C: Array, then: Array, P: Array) -> tuple[Array, Array]:
    A = g.adjoint(g.inverse(then))
    return g.compose(T, then), A @ C @ A.T + P
