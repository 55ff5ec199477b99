"""Runs of grid front ends against the truth: paths, re-entries, loops, exits, entropy. Nothing here runs a filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array, arc_length, wrap_angle
from graphslam.core.poses import group_of, heading_of, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.entropy import MapEntropy, grid_placements, mean_map_entropy
from graphslam.sim.route import Route
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.grid.motion import move_poses, with_roll_pitch
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.config import HandoverConfig
from graphslam_frontends.segslam.paths import concatenate_segments
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.sampling import draw_weights, grow_sample, nearest_step, root_of_segment
from graphslam_frontends.segslam.segmap import MATCH, SegMap
from graphslam_frontends.segslam.submaps import (
    Drift,
    common_ancestor_chain,
    drift_by_errors,
    drift_by_path,
    submaps_of_segments,
)
from graphslam_studies.evaluate.exit_nees import ExitNees, exit_nees

Ints = npt.NDArray[np.int64]

FALSE_DISTANCE, FALSE_ANGLE = 1.0, float(np.radians(5.0))
"""A re-entry farther off than this is a false match [m], [rad]."""
CLOSED_DISTANCE = 1.0
"""A loop is closed if the two visits agree within this [m]."""


def relative(poses: Array) -> Array:
    """Poses ``(n, d)`` in the level frame of the first."""
    group = group_of(poses)
    return group.between(np.broadcast_to(remove_roll_pitch(poses[0]), poses.shape), poses)


@dataclass(frozen=True, slots=True)
class PathErrors:
    """Errors of a path in the level frame of its first pose.

    Parameters
    ----------
    final, final_yaw : float
        Of the last pose [m], [rad].
    anchored, aligned : float
        RMS of the positions [m], with the first poses in the same place, and after a rigid alignment of all.
    height : float
        RMS of the heights [m], with the first poses in the same place; 0 in two dimensions.
    """

    final: float
    final_yaw: float
    anchored: float
    aligned: float
    height: float


def path_errors(path: Trajectory, truth: Array, final_pose: Array | None = None) -> PathErrors:
    """A path against true poses ``(n, d)`` at its stamps.

    Parameters
    ----------
    truth : (n, 7) or (n, 3)
    final_pose : (7,) or (3,), optional
        The estimate of the last pose, in the frame that the path is in; default the path's own.
    """
    est, true = relative(path.poses), relative(truth)
    group = group_of(est)
    last = est[-1] if final_pose is None else group.between(remove_roll_pitch(path.poses[0]), final_pose)
    reference = Trajectory(path.times, true)
    moved = Trajectory(path.times, est)
    return PathErrors(
        final=float(np.linalg.norm((last - true[-1])[: group.dim])),
        final_yaw=float(np.abs(wrap_angle(heading_of(last) - heading_of(true[-1])))),
        anchored=ate(moved, reference, alignment="none").statistics.rmse,
        aligned=ate(moved, reference, alignment="se").statistics.rmse,
        height=float(np.sqrt(np.mean((est[:, 2] - true[:, 2]) ** 2))) if group.dim == 3 else 0.0,
    )


@dataclass(frozen=True, slots=True)
class Climbs:
    """Climbs along a path against the true ones, a row for every ramp of the way.

    Parameters
    ----------
    true : (m,)
        Of the ramps [m]; negative where they lead down.
    error : (m,)
        By how much the path climbs more, as a share of the true one: above 0 where it is too steep, up or down.
    """

    true: Array
    error: Array


def climbs(path: Array, truth: Array, *, slope: float = 0.04, least: float = 1.0) -> Climbs:
    """Climbs of the ramps of a way.

    Parameters
    ----------
    path, truth : (n, 7)
        Poses at the same stamps.
    slope : float
        A ramp is a stretch that is everywhere steeper, up or down.
    least : float
        Shorter climbs are left out [m].
    """
    est, true = relative(path)[:, 2], relative(truth)
    along = arc_length(true[:, :3])
    driven = np.gradient(along)
    steep = np.zeros(len(along))
    moving = driven > 1e-3
    steep[moving] = np.gradient(true[:, 2])[moving] / driven[moving]
    side = np.where(np.abs(steep) > slope, np.sign(steep), 0.0)
    edges = np.flatnonzero(np.diff(side, prepend=np.nan, append=np.nan))
    found = []
    for a, b in zip(edges[:-1], edges[1:] - 1):
        rise = true[b, 2] - true[a, 2]
        if side[a] != 0.0 and abs(rise) >= least:
            found.append((rise, (est[b] - est[a]) / rise - 1.0))
    rows = np.array(found).reshape(-1, 2)
    return Climbs(rows[:, 0], rows[:, 1])


# --- re-entries ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MatchErrors:
    """Entries into older maps against the truth, one a segment that was entered so (also those pruned since).

    Parameters
    ----------
    segments : (m,) int64
    steps : (m,) int64
        At which the old map was entered.
    places : (m,) int64
        Step of the old map's path beside which the entry puts the body.
    offsets, angles : (m,)
        How far off the entry is [m], and its heading (without gravity the whole rotation) [rad].
    weights : (m,)
        Share of the particles' weight of each segment when it was closed.
    """

    segments: Ints
    steps: Ints
    places: Ints
    offsets: Array
    angles: Array
    weights: Array

    @property
    def false(self) -> npt.NDArray[np.bool_]:
        """Those beyond `FALSE_DISTANCE` or `FALSE_ANGLE`."""
        return (self.offsets > FALSE_DISTANCE) | (self.angles > FALSE_ANGLE)


def _place(segmap: SegMap, i: int) -> tuple[int, Array]:
    """Step of the path, of all that drew the map that segment ``i`` entered, nearest to the entry; ``T_there_entry``.

    A map is bent: its frame is where it began, and what it shows of places farther on is off by its own drift. Where
    the body passed, the map is right about what it saw from there.
    """
    t, g = segmap.table, segmap.group
    T, k = t.entry[i], i
    best: tuple[float, int, Array] | None = None
    begin = (0, T)
    while t.source[k] >= 0:
        k = int(t.source[k])
        begin = (int(t.start[k]), g.between(t.entry[k], T))
        path = t.paths[k]
        if path is None:  # pruned
            continue
        step = nearest_step(segmap, k, T)
        there = path[step - int(t.start[k])]
        d = float(np.linalg.norm((there - T)[: g.dim]))
        if best is None or d < best[0]:
            best = d, step, g.between(there, T)
    return begin if best is None else best[1:]


def match_errors(segmap: SegMap, truth: Array) -> MatchErrors:
    """Every re-entry against the true poses ``(n, d)`` of the steps."""
    t, g = segmap.table, segmap.group
    found = np.flatnonzero(t.kind[: len(segmap)] == MATCH).astype(np.int64)
    places, offsets, angles = np.zeros(len(found), np.int64), np.zeros(len(found)), np.zeros(len(found))
    for row, i in enumerate(found.tolist()):
        step, T = _place(segmap, i)
        true = g.between(truth[step], truth[int(t.start[i])])
        e = g.log(g.between(true, T))
        places[row] = step
        offsets[row] = np.linalg.norm((T - true)[: g.dim])
        # where gravity tells roll and pitch they are no part of the match
        angles[row] = np.abs(e[2]) if g.dim == 2 or segmap.gravity else np.linalg.norm(e[:3])
    return MatchErrors(found, t.start[found], places, offsets, angles, t.weight[found])


# --- the way -------------------------------------------------------------------------------------------------


def steps_of_path(truth: Trajectory, times: Array, length: float) -> Array:
    """Arc length of the way at every step ``(n,)`` [m], from the truth; the end of the truth is that of the way."""
    driven = arc_length(truth.positions)
    return np.asarray(np.interp(times, truth.times, driven * (length / driven[-1])))


def nearest(arc: Array, s: float) -> int:
    """Step nearest to an arc length; steps never go back."""
    return int(np.argmin(np.abs(arc - s)))


def merged_stretches(matches: MatchErrors, arc: Array, pairs: Sequence[Sequence[Sequence[float]]]) -> int:
    """Re-entries that take one of two stretches, ``[[s1a, s1b], [s2a, s2b]]`` each, for the other."""

    def within(s: Array, stretch: Sequence[float]) -> npt.NDArray[np.bool_]:
        return np.asarray((s >= min(stretch)) & (s <= max(stretch)))

    here, there = arc[matches.steps], arc[matches.places]
    merged = np.zeros(len(here), dtype=np.bool_)
    for a, b in pairs:
        merged |= (within(here, a) & within(there, b)) | (within(here, b) & within(there, a))
    return int(np.sum(merged & matches.false))


def overlapping_stretches(path: Array, truth: Array, arc: Array, pairs: Sequence[Sequence[Sequence[float]]]) -> int:
    """Pairs of parallel stretches that are less than half as far apart in the path as in truth: galleries overlap.

    Distance: median over the first stretch of the distance to the nearest point of the second, in plan.
    """

    def apart(poses: Array, one: slice, other: slice) -> float:
        return float(np.median(cKDTree(poses[other, :2]).query(poses[one, :2])[0]))

    def steps(s: Sequence[float]) -> slice:
        return slice(nearest(arc, min(s)), nearest(arc, max(s)) + 1)

    at = [(steps(one), steps(other)) for one, other in pairs]
    return sum(apart(path, *p) < 0.5 * apart(truth, *p) for p in at)


def visit_error(path: Array, truth: Array, first: int, again: int) -> float:
    """Error of where the body was at one visit of a place, seen from the body at the other [m]."""
    group = group_of(path)
    error = group.between(path[first], path[again]) - group.between(truth[first], truth[again])
    return float(np.linalg.norm(error[: group.dim]))


def path_at(result: SegSlamResult, step: int, number: int = 0) -> Trajectory:
    """The path of a map sample grown from the segment that the best particle's history was in at a step.

    What the filter believes of earlier places depends on where it looks from (A6): at a revisit it is asked there.
    """
    segmap = result.segmap
    chain = common_ancestor_chain(segmap, int(result.closed[result.best]))
    t = segmap.table
    inside = chain[(t.start[chain] < step) & (t.end[chain] >= step)]
    at = int(inside[0]) if len(inside) else int(chain[0])
    rng = result.seed.child("visit", step, number).generator()
    sample = grow_sample(segmap, root_of_segment(segmap, at), rng, weights=draw_weights(segmap))
    return concatenate_segments(segmap, sample)


def legs(route: Route, arc: Array, shortest: float = 10.0) -> list[tuple[int, int]]:
    """First and last step of the straight pieces of a way, a metre off both ends; shorter ones are left out."""
    out = []
    for a, b, curvature in zip(route.starts[:-1], route.starts[1:], route.curvature):
        if abs(curvature) < 1e-9 and b - a >= shortest:
            out.append((nearest(arc, a + 1.0), nearest(arc, b - 1.0)))
    return out


def leg_angle_error(path: Array, truth: Array, pieces: Sequence[tuple[int, int]], storey: float = 1.0) -> float:
    """RMS error of the angles between straight pieces on different levels (of all pairs if there is one) [rad]."""

    def directions(poses: Array) -> Array:
        d = np.array([poses[b, :2] - poses[a, :2] for a, b in pieces])
        return np.asarray(np.arctan2(d[:, 1], d[:, 0]))

    error = directions(path) - directions(truth)
    heights = np.array([truth[a, 2] if truth.shape[1] == 7 else 0.0 for a, _ in pieces])
    i, j = np.triu_indices(len(pieces), 1)
    apart = np.abs(heights[i] - heights[j]) > storey
    if apart.any():
        i, j = i[apart], j[apart]
    if not len(i):
        return float("nan")
    return float(np.sqrt(np.mean(wrap_angle(error[i] - error[j]) ** 2)))


# --- exits and maps ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ExitErrors:
    """NEES of the exits of the settled segments under three covariances, and the errors themselves.

    Parameters
    ----------
    lengths : (m,)
        Of the segments [m].
    default, matched, stated : ExitNees
        Particles and drift model; the paper's moment matching; particles and the drift that the motion's noise states
        (as ``default`` where the steps do not know it).
    blocks : mapping of str to ExitNees
        ``default`` by block: ``heading``, ``plan``, and in space ``height``.
    """

    lengths: Array
    default: ExitNees
    matched: ExitNees
    stated: ExitNees
    blocks: Mapping[str, ExitNees]


def exit_errors(result: SegSlamResult, truth: Array, drift: FilterDrift) -> ExitErrors:
    """Exits of the settled chain against the truth: each end as seen from its own start, both level where frames are.

    Parameters
    ----------
    truth : (n, 7) or (n, 3)
        At the steps.
    """
    segmap, steps = result.segmap, result.steps
    g = segmap.group
    chain = common_ancestor_chain(segmap, int(result.closed[result.best]))
    by_path = drift_by_path(segmap, chain, drift, steps)
    stated: Drift = by_path if steps.errors is None else drift_by_errors(steps.errors, gravity=segmap.gravity)
    made = [
        submaps_of_segments(segmap, chain, d, HandoverConfig(matched_only=m), with_grids=False)
        for d, m in ((by_path, False), (by_path, True), (stated, False))
    ]
    t = segmap.table
    ends = remove_roll_pitch(truth) if segmap.gravity else truth
    true = g.between(ends[t.start[chain]], ends[t.end[chain]])
    # roll and pitch of level frames are exact by definition
    components = (2, 3, 4, 5) if segmap.gravity else None

    def score(made: Sequence[Submap], components: Sequence[int] | None) -> ExitNees:
        poses, covariances = (np.array([getattr(s, f"exit_{what}") for s in made]) for what in ("pose", "covariance"))
        return exit_nees(poses, covariances, true, components=components)

    blocks = {"heading": (2,), "plan": (0, 1)} if g.dim == 2 else {"heading": (2,), "plan": (3, 4), "height": (5,)}
    scores = [score(m, components) for m in made]
    lengths = segmap.path_length[t.end[chain]] - segmap.path_length[t.start[chain]]
    by_block = {name: score(made[0], of) for name, of in blocks.items()}
    return ExitErrors(lengths, scores[0], scores[1], scores[2], by_block)


def end_errors(submap: Submap, truth: Array) -> dict[str, ExitNees]:
    """Where a submap of a whole log ends, in space: all four components that are not gravity's (``""``), and by block.

    Parameters
    ----------
    truth : (n, 7)
        At the steps.
    """
    g = group_of(truth)
    true = g.between(remove_roll_pitch(truth[0]), truth[-1])
    blocks = {"": (2, 3, 4, 5), "heading": (2,), "plan": (3, 4), "height": (5,)}
    return {k: exit_nees(submap.exit_pose, submap.exit_covariance[None], true, components=c) for k, c in blocks.items()}


def fused_grid(steps: Steps, path: Array, *, voxel_size: float = 0.2, model: BeamModel | None = None) -> EvidenceGrid:
    """One map of all scans, inserted along a path ``(n, d)`` in its own frame."""
    grid = EvidenceGrid(voxel_size, model=model, dim=steps.dim)
    for k in range(len(steps)):
        points, origins, returns = steps.scan(k)
        if len(points):
            grid.insert_scan(points, origins, pose=path[k], max_range=steps.max_range, returns=returns)
    return grid


def clarity(
    steps: Steps, path: Array, *, voxel_size: float = 0.2, model: BeamModel | None = None, count: int = 1
) -> MapEntropy:
    """Entropy of all scans along a path ``(n, d)``, in grids that stand in ``count`` different ways.

    Where the voxels lie counts: a floor in the middle of its layer is clear, one between two layers is not. A filter
    that has one map all along pulls its path to where that map's voxels are clearest; map samples are put together of
    segments with maps of their own, and cannot have that in one frame.
    """
    group = group_of(path)
    grids = [
        fused_grid(steps, group.compose(np.broadcast_to(T, path.shape), path), voxel_size=voxel_size, model=model)
        for T in grid_placements(count, voxel_size, steps.dim)
    ]
    return mean_map_entropy(grids)


def quarters(seconds: Array) -> tuple[float, float]:
    """Mean time of a step in the first and in the last quarter of a run [s]."""
    n = max(len(seconds) // 4, 1)
    return float(seconds[:n].mean()), float(seconds[-n:].mean())


def distinct(rows: Array, most: int) -> list[int]:
    """Places of the first ``most`` different rows ``(n, …)``, in order."""
    seen: dict[bytes, int] = {}
    for k, row in enumerate(rows):
        seen.setdefault(row.tobytes(), k)
    return list(seen.values())[:most]


def dead_reckoned(steps: Steps) -> Trajectory:
    """The odometry alone; roll and pitch are those that gravity shows, where it does."""
    poses = np.array(steps.odometry.increments)
    poses[0] = group_of(poses).identity
    for k in range(len(poses)):
        at = poses[:1] if k == 0 else move_poses(poses[k - 1 : k], steps.odometry.increments[k], None)
        poses[k] = at[0] if steps.tilt is None else with_roll_pitch(at, steps.tilt[k : k + 1])[0]
    return Trajectory(steps.times, poses)
