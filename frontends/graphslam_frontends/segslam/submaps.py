"""Conversion of finished segments to submaps for the graph.

The base of a submap is the body at its entry, if gravity is known levelled and lowered to the voxel grid of its map,
also if the segment used the frame of an older map; so the end pose of each submap is the base of the next. Matches are
output as hypotheses with their support, including those of particles outside the chain.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import frame_between, group_of, normalise_weights, pose_scatter, remove_roll_pitch
from graphslam.core.submap import Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.registration.search import at_once
from graphslam_frontends.grid.filter_error_model import FilterDrift, interpolate_covariances
from graphslam_frontends.odometry.growing_steps import GrowingSteps
from graphslam_frontends.odometry.scan_use import dead_reckoning_covariance, unobserved_covariance, unobserved_stretches
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.scan_odometry_steps import ScanOdometryErrors
from graphslam_frontends.segslam.config import HandoverConfig
from graphslam_frontends.segslam.covariance import exit_covariance
from graphslam_frontends.segslam.sampling import MapSample, nearest_step
from graphslam_frontends.segslam.segmap import KINDS, MATCH, SegMap, Segment

Ints = npt.NDArray[np.int64]

KNOTS = 9
"""Places along a segment where the drift model is evaluated; its covariance is interpolated between them."""
MINIMUM_SUPPORT = 0.05
"""Matches with a smaller share of the particle weights are not output."""


class Drift(Protocol):
    """Covariance ``(d, d)`` of dead reckoning from step ``start`` to step ``end``, right tangent.

    The frame at the start is levelled if frames are; that at the end if ``level_end``.
    """

    def __call__(self, start: int, end: int, *, level_end: bool) -> Array: ...


class _Errors(Protocol):
    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]: ...


def drift_by_path(
    segmap: SegMap, chain: Sequence[int] | Ints, model: FilterDrift, steps: Steps | GrowingSteps | None = None
) -> Drift:
    """Drift model along the paths of the segments of a chain, for the number of particles of the filter.

    With ``steps`` it includes the share of the dead-reckoning errors that the filter does not correct
    (:class:`~graphslam_frontends.grid.filter_error_model.ErrorPassThrough`), and all of it without scan corrections
    (:mod:`graphslam_frontends.odometry.scan_use`). Steps from scan-to-window odometry have their own covariance.
    """
    if steps is not None and isinstance(steps.errors, ScanOdometryErrors):
        steps.errors.prepare(segmap[int(i)].interval[0] for i in chain)
        return drift_by_errors(steps.errors, gravity=segmap.gravity)
    paths = {(s := segmap[int(i)]).interval[0]: s.path for i in chain}
    # a single particle corrects nothing
    stretches = [] if steps is None or segmap.particles == 1 else unobserved_stretches(steps)

    def drift(start: int, end: int, *, level_end: bool) -> Array:
        path, level_here = paths[start][: end - start + 1], segmap.gravity and level_end
        if steps is None:
            return model.covariance(path, segmap.particles, gravity=level_here)
        reckoned = dead_reckoning_covariance(steps, start, end, level_end=level_here)
        tilt = None if steps.tilt is None else steps.tilt_sigma
        C = model.covariance(path, segmap.particles, gravity=level_here, reckoned=reckoned, tilt_sigma=tilt)
        return C + unobserved_covariance(steps, stretches, path, start, end)

    return drift


def drift_by_errors(errors: _Errors, *, gravity: bool) -> Drift:
    """The drift covariance that the source of the motion gives for any interval (`IntervalCovariance`)."""

    def drift(start: int, end: int, *, level_end: bool) -> Array:
        return errors.between(start, end, level_start=gravity, level_end=gravity and level_end)[1]

    return drift


def common_ancestor_chain(segmap: SegMap, last: int) -> Ints:
    """Segments from the first to ``last``, each beginning where the previous one ends.

    The history of the particle as far as it exists, then the segment of largest weight that fits (A6).
    """
    t = segmap.table
    chain = [segmap[last].index]
    while True:
        i = chain[-1]
        before = int(t.previous[i])
        if before < 0 or not t.alive[before]:
            fits = segmap.ending_at(int(t.start[i]))
            if not len(fits):
                return np.array(chain[::-1], np.int64)
            before = int(fits[np.argmax(t.weight[fits])])
        chain.append(before)


def sampled_chain(segmap: SegMap, sample: MapSample) -> Ints:
    """Segments of a full map sample in the order of time, of any particles."""
    if (sample.segments < 0).any():
        raise DataError(
            "a map sample with an open segment is no chain", wanted="a sample from a segment that is closed"
        )
    return np.asarray(sample.segments[np.argsort(segmap.table.start[sample.segments])], np.int64)


def submaps_in_slices(
    segmap: SegMap,
    chain: Sequence[int] | Ints,
    drift: Drift,
    config: HandoverConfig | None = None,
    *,
    uses: frozenset[str] = frozenset(),
    reasons: Mapping[int, str] | None = None,
    after: int = -1,
    with_grids: bool = True,
) -> Generator[None, None, list[Submap]]:
    """Submaps of a chain of segments.

    In slices of bounded work; the SegMap must not change in between. :data:`submaps_of_segments` does them in one call.

    Parameters
    ----------
    chain : sequence of int
        Each begins where the previous one ends.
    uses : frozenset of str
        Streams of the log that were used.
    reasons : mapping of step to str, optional
        Reason for the end of the interval that ends there.
    after : int
        Only the submaps after this key, for segments that were output before; the first has key 0.
    with_grids : bool
        Include the maps, in the frames of the submaps' bases.
    """
    config = HandoverConfig() if config is None else config
    segments = [segmap[int(i)] for i in chain]
    for a, b in pairwise(segments):
        if a.interval[1] != b.interval[0]:
            raise DataError(
                f"segment {b.index} does not follow segment {a.index}", got=b.interval, wanted=f"({a.interval[1]}, …)"
            )
    keys = {s.index: k for k, s in enumerate(segments)}
    out, g, ended = [], segmap.group, reasons or {}
    for s in segments[after + 1 :]:
        matches, considered = _matches(segmap, s, segments, keys)
        considered["holds"] = _holds(segmap, s, segments, keys)
        yield
        start, end = s.interval
        base = segment_base(segmap, s.T_entry)
        exit_pose = g.between(base, segment_base(segmap, s.T_exit))
        exits, weights = exits_of_interval(segmap, s.interval)
        exit = exit_covariance(
            exits, exit_pose, drift(start, end, level_end=True), weights=weights, drift_scale=config.drift_scale
        )
        report: dict[str, Any] = {
            "ended": ended.get(end, "unknown"),
            "segment": s.index,
            "entered": s.kind,
            "steps": end - start,
            "length": round(s.length, 3),
            "segments_of_interval": len(exits),
            "effective_segments": round(exit.effective, 3),
            "weight": s.weight,
            "exit_sigma_particles": np.sqrt(np.diag(exit.particles)).tolist(),
            "exit_sigma_matched": np.sqrt(np.diag(exit.matched)).tolist(),
            "exit_sigma_drift": np.sqrt(np.diag(exit.drift)).tolist(),
            "covariance": "moment-matched" if config.matched_only else "particles+drift",
            **considered,
        }
        poses = g.compose(g.inverse(base), s.path)
        yield
        covariances = yield from _path_covariances(segmap, s, poses, drift, config.drift_scale)
        yield
        out.append(
            Submap(
                key=keys[s.index],
                interval=(s.t_start, s.t_end),
                exit_pose=exit_pose,
                exit_covariance=exit.matched if config.matched_only else exit.total,
                trajectory=Trajectory(segmap.times[start : end + 1], poses, covariances),
                grid=_payload(segmap, s.index, base) if with_grids else None,
                matches=matches,
                uses=uses,
                report=report,
            )
        )
    return out


submaps_of_segments = at_once(submaps_in_slices)


def segment_base(segmap: SegMap, body: Array) -> Array:
    """``T_segment_base`` of a body at its entry, or at its exit, where the next base is.

    The body itself or, with gravity, levelled and on the voxel grid on which maps begin, so that no resampling is
    needed.
    """
    if not segmap.gravity:
        return np.array(body)
    base = remove_roll_pitch(body)
    base[..., 2] -= segmap.lift
    return base


def exits_of_interval(segmap: SegMap, interval: tuple[int, int]) -> tuple[Array, Array]:
    """End poses ``(n, 7|3)`` of all segments of an interval relative to their bases, and weights ``(n,)``."""
    g, t = segmap.group, segmap.table
    i = segmap.in_interval(interval)
    entry, exit = t.entry[i], t.exit[i]
    base = remove_roll_pitch(entry) if segmap.gravity else entry
    T = g.between(base, exit)
    return (remove_roll_pitch(T) if segmap.gravity else T), _shares(t.weight[i])


def _shares(weights: Array) -> Array:
    """Weights that sum to one; equal if all are zero."""
    return normalise_weights(weights if weights.sum() > 0 else None, len(weights))


def _payload(segmap: SegMap, index: int, base: Array) -> EvidenceGrid:
    """The map in the frame of the base; unchanged if it is already in that frame."""
    g = segmap.group
    grid, T_base_map = segmap.map_of(index), g.inverse(base)
    if np.abs(g.log(T_base_map)).max() < 1e-9:
        return grid.copy()
    moved = grid.empty()
    moved.merge(grid, T_base_map)
    return moved


def _path_covariances(
    segmap: SegMap, s: Segment, poses: Array, drift: Drift, scale: float
) -> Generator[None, None, Array]:
    """Covariances ``(n, d, d)`` along a path, right tangents: particles at every step, drift interpolated."""
    g, t = segmap.group, segmap.table
    start, end = s.interval
    n = end - start + 1
    i = segmap.in_interval(s.interval)
    w = _shares(t.weight[i])
    P = np.zeros((n, g.dof, g.dof))
    for k, wk in zip(i.tolist(), w.tolist()):
        path = cast(Array, t.paths[k])
        base = segment_base(segmap, path[0])
        e = g.log(g.between(poses, g.compose(g.inverse(base), path)))
        P += wk * e[:, :, None] * e[:, None, :]
    knots = np.unique(np.linspace(0, n - 1, min(KNOTS, n)).round().astype(np.int64))
    D = []
    for number, k in enumerate(knots):
        if number % 3 == 0:
            yield
        D.append(drift(start, start + int(k), level_end=False))
    along = segmap.path_length[start : end + 1]
    return P + scale * interpolate_covariances(knots, np.stack(D), poses, along)


def _matches(
    segmap: SegMap, s: Segment, segments: Sequence[Segment], keys: Mapping[int, int]
) -> tuple[tuple[Match, ...], dict[str, Any]]:
    """Re-entries of all particles of an interval, one per entered submap, by descending support."""
    t = segmap.table
    members = segmap.in_interval(s.interval)
    share = np.zeros(t.count)
    share[members] = _shares(t.weight[members])
    groups: dict[int, list[tuple[int, Array]]] = {}
    lost = 0
    for i in members[t.kind[members] == MATCH].tolist():
        found = match_target(segmap, int(t.source[i]), t.entry[i], segments)
        if found is None or keys[found[0].index] >= keys[s.index]:
            lost += 1
            continue
        groups.setdefault(keys[found[0].index], []).append((i, found[1]))
    out = []
    for target, entries in groups.items():
        index = np.array([i for i, _ in entries])
        weight = share[index]
        support = min(float(weight.sum()), 1.0)
        if support < MINIMUM_SUPPORT:
            continue
        # the match of the chain represents its group, else that of the largest weight
        lead = int(np.argmax(index == s.index)) if s.index in index else int(np.argmax(weight))
        T = np.stack([T for _, T in entries])
        scatter = pose_scatter(T, T[lead], _shares(weight)) if len(T) > 1 else 0.0
        i = int(index[lead])
        fitness = float(t.fitness[i])
        out.append(
            Match(
                target=target,
                T_target_here=T[lead],
                covariance=levelled_covariance(segmap, t.entry[i], cast(Array, t.covariances[i])) + scatter,
                fitness=0.0 if np.isnan(fitness) else fitness,
                support=support,
            )
        )
    out.sort(key=lambda m: (-m.support, m.target))
    kinds = {KINDS[k]: float(share[members[t.kind[members] == k]].sum()) for k in range(len(KINDS))}
    return tuple(out), {"entered_share": kinds, "matches_without_target": lost}


def _holds(segmap: SegMap, s: Segment, segments: Sequence[Segment], keys: Mapping[int, int]) -> list[int]:
    """Keys of the submaps with scans in the map of a segment: its own, and those of maps that it continued."""
    scans = segmap.maps.scans[int(segmap.table.map[s.index])]
    return [keys[c.index] for c in segments if any(a < c.interval[1] and c.interval[0] < b for a, b in scans)]


def match_target(
    segmap: SegMap, source: int, entry: Array, segments: Sequence[Segment]
) -> tuple[Segment, Array] | None:
    """The segment of the chain that a match leads to, and ``T_target_here`` between the bases; None: there is none.

    Parameters
    ----------
    source : int
        The segment whose map was entered.
    entry : (7,) or (3,)
        ``T_segment_body`` at the entry.
    """
    g, t = segmap.group, segmap.table
    if not t.alive[source]:
        return None
    step = nearest_step(segmap, source, entry)
    # the chain may have another particle's segment there: the body pose at that step relates the two
    same = [c for c in segments if c.index == source]
    at = same or [c for c in segments if c.interval[0] <= step <= c.interval[1]]
    if not at:
        return None
    c = at[0]
    T_c_source = g.identity
    if c.index != source:
        there = cast(Array, t.paths[source])[step - int(t.start[source])]
        T_c_source = frame_between(c.path[step - c.interval[0]], there, gravity=segmap.gravity)
    here = g.compose(T_c_source, entry)
    return c, g.between(segment_base(segmap, c.T_entry), segment_base(segmap, here))


def levelled_covariance(segmap: SegMap, entry: Array, covariance: Array) -> Array:
    """Covariance in the body frame → in the levelled base frame at the same place."""
    g = group_of(entry)
    A = g.adjoint(g.between(segment_base(segmap, entry), entry))
    C = A @ covariance @ A.T
    return np.asarray(0.5 * (C + C.T))
