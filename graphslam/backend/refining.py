"""The refinement at the end of a run: from the solved map to the refined one, or why it stays as it is."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.gps import GpsConfig
from graphslam.graph.ledger import EXCLUSIVE, Ledger
from graphslam.graph.pose_graph import PoseGraph
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.moving import moving_points, without_moving
from graphslam.maps.refined import base_frames, refined_map, refined_submaps
from graphslam.refine.config import RefineConfig
from graphslam.refine.refine import Refinement, refine_by_scans
from graphslam.refine.revisit_constraints import FAR, tangent_lengths
from graphslam.refine.scans import Scans

logger = logging.getLogger(__name__)

CONTRADICTED = 3.0
"""χ² of the walk of the yaw bias by its degrees of freedom beyond which scans of passes and motion contradict."""
WIDENED = 1.5
"""σ of the motion that the scans show, in multiples of what is stated, from which it is told."""
NAMED = {
    "scale": (0.03, "distances of the odometry are {v:.1%} too {sign} (scale of the wheels)", 1.0, ("long", "short")),
    "side": (
        0.009,
        "the scanner looks {v:.2f}° to the {sign} of the way that the odometry tells (its mounting)",
        57.29578,
        ("left", "right"),
    ),
    "rise": (
        0.009,
        "the scanner looks {v:.2f}° {sign} the way that the odometry tells (its mounting)",
        57.29578,
        ("below", "above"),
    ),
    "clock": (
        0.02,
        "the stamps of the motion are {v:.0f} ms too {sign} beside those of the scans",
        1e3,
        ("early", "late"),
    ),
}
"""Lasting errors that are named: beyond which size, in which words, in multiples of their unit, and what their sign
means."""


@dataclass(frozen=True)
class RefinedRun:
    """What a refinement made of a run.

    Parameters
    ----------
    map : GlobalMap
        With the refined path and nodes.
    submaps : list of Submap
        Along the refined path; empty where the run's have no grids.
    graph_path : Trajectory
        Path of the graph, where the refinement began.
    """

    refinement: Refinement
    map: GlobalMap
    submaps: list[Submap]
    graph_path: Trajectory


def refine_run(
    config: RefineConfig,
    scans: Scans | None,
    submaps: Sequence[Submap],
    m: GlobalMap,
    *,
    gps: tuple[Gps, GpsConfig] | None = None,
    graph: PoseGraph | None = None,
    progress: Callable[[str], Any] | None = None,
) -> tuple[RefinedRun | None, list[Finding]]:
    """Refine the solved map of a run, and say what was found.

    Parameters
    ----------
    scans : Scans or None
        None: the front end works on no scans.
    m : GlobalMap
        Solved.
    gps : (Gps, GpsConfig), optional
        Fixes that are in the graph, and how they entered: they hold the refined path, too.
    graph : PoseGraph, optional
        What the map was solved from: its loops are held against the refined path.

    Returns
    -------
    refined : RefinedRun or None
        None where the path of the graph stays the result.
    findings : list of Finding
        Lines of the verdict.
    """
    if not config.use or scans is None:
        return None, []
    path = m.trajectory
    try:
        start = path.interpolate(np.clip(scans.times, path.times[0], path.times[-1]))
        found = refine_by_scans(scans, start, config, gps=gps, progress=progress)
        if not found.better:
            text = (
                "The path was not refined by its scans: they agree less at the refined path "
                f"({found.agreement[1]:.0%}) than at the graph's ({found.agreement[0]:.0%}), so the graph's stays."
            )
            return None, [Finding("look", "refine-refused", text), *_input(found)]
        refined = refined_map(m, found, submaps)
        grids = all(isinstance(s.grid, EvidenceGrid) for s in submaps)
        drawn = refined_submaps(submaps, refined, found, scans) if grids else []
        drawn, moved = _static_submaps(drawn, base_frames(refined))
    except GraphSlamError as error:  # a run that is solved is not thrown away for its refinement
        logger.warning("the path is not refined: %s", error)
        return None, [Finding("look", "refine-failed", f"The path could not be refined by its scans: {error}.")]
    wrong = None if graph is None else wrong_loops(graph, refined)
    return RefinedRun(found, refined, drawn, path), [*refinement_findings(found, wrong), *moved]


def _input(r: Refinement) -> list[Finding]:
    """Is the odometry that came in better than what came out?"""
    if r.left is not None:
        text = (
            f"The odometry of the log is better than what was made of it: scans agree in {r.reckoned:.1%} of the "
            f"points along it, in {r.agreement[0]:.1%} along the graph's path and in {r.left:.1%} along the refined "
            "one. So the path is the odometry's, and as sure as its own noise says; no loop is closed in it."
        )
        return [Finding("look", "input-better", text)]
    if not r.input_better:
        return []
    text = (
        f"The odometry of the log is better than this result: scans agree in {r.reckoned:.1%} of the points along it, "
        f"here in {max(r.agreement):.1%}. Use its path, or state its noise as small as it is."
    )
    return [Finding("bad", "input-better", text)]


def _static_submaps(submaps: list[Submap], bases: Array) -> tuple[list[Submap], list[Finding]]:
    """Submaps without what moved, where they carry clouds, and how much that was."""
    if not submaps or bases.shape[1] != 7 or any(s.cloud is None for s in submaps):
        return submaps, []
    moving = moving_points(submaps, bases[:-1])
    gone, every = sum(int(m.sum()) for m in moving), sum(len(m) for m in moving)
    text = f"{gone} of {every} points ({gone / max(every, 1):.1%}) lie on things that moved and are not in the map."
    return without_moving(submaps, moving), [Finding("", "moving", text)] if gone else []


def wrong_loops(graph: PoseGraph, m: GlobalMap) -> list[tuple[int, int, float, float]]:
    """Loops and matches of a graph that a refined map contradicts by more than scans could bridge.

    Returns
    -------
    list of (i, j, metres, radians)
        Nodes, and by how much the factor is off; the farthest first.
    """
    ends = [r for r in graph.records.values() if isinstance(r, BetweenRecord) and abs(r.i - r.j) > 1]
    if not ends:
        return []
    g, T = group_of(m.node_poses), np.array([r.T_ij for r in ends])
    i, j = np.array([(r.i, r.j) for r in ends]).T
    off, turned = tangent_lengths(g.log(g.between(T, g.between(m.node_poses[i], m.node_poses[j]))), g)
    wrong = np.flatnonzero((off > FAR[0]) | (turned > FAR[1]))
    wrong = wrong[np.argsort(-off[wrong], kind="stable")]
    return [(int(i[k]), int(j[k]), float(off[k]), float(turned[k])) for k in wrong]


def refined_ledger(ledger: Ledger, submaps: Sequence[Submap], r: Refinement) -> tuple[Ledger, list[Finding]]:
    """What a refined path spends: every scan with motion and gravity once; all factors of the graph were its start.

    Parameters
    ----------
    ledger : Ledger
        Of the graph.
    submaps : sequence of Submap
        That say which streams their front end used.

    Returns
    -------
    findings : list of Finding
        What is spent, and which streams of the graph the refined path does not hold.
    """
    out, entries = ledger.as_start(), ledger.entries()
    streams = frozenset().union(*(s.uses for s in submaps))
    # gravity that the front end had of a stream which it used for nothing else that weighs
    gravity = frozenset().union(*(s.assisting_streams for s in submaps)) if "gravity" in r.parts else frozenset()
    out.spend(SCAN_PAIRS, "scan-pairs", streams | gravity, (float(r.times[0]), float(r.times[-1])))
    held = {e.stream for e in entries if e.kind == EXCLUSIVE and e.factor.startswith("GPS fix")} if r.fixes else set()
    for stream in sorted(held):
        out.spend(SCAN_PAIRS, "fixes", [stream], (float(r.times[0]), float(r.times[-1])))
    streams = streams | held
    factors = len({e.factor_id for e in entries})
    spent = ", ".join(sorted(streams | gravity)) or "the scans"
    text = (
        f"The refined path spends {spent} once (scan-pairs). The {factors} factors of the graph, its exits, matches "
        "and loops, were its start and enter no sum."
    )
    found = [Finding("", "refine-evidence", text)]
    lost = sorted({e.stream.partition("/")[0] for e in entries if e.kind == EXCLUSIVE} - streams)
    if lost:
        text = f"The refined path does not hold {', '.join(lost)}: the graph that was its start did."
        if some := sorted(gravity.intersection(lost)):
            text += f" Of {', '.join(some)} it holds gravity."
        found.append(Finding("look", "refine-streams", text))
    return out, found


SCAN_PAIRS = -1
"""Number of the refinement in a ledger of factors, which are counted from 0."""


def refinement_findings(r: Refinement, wrong: Sequence[tuple[int, int, float, float]] | None = None) -> list[Finding]:
    """What a refinement says of the run, as lines of the verdict.

    Parameters
    ----------
    wrong : sequence of (i, j, metres, radians), optional
        Loops of the graph that it contradicts (:func:`wrong_loops`); None: the graph is not known.
    """
    if r.left is not None:
        return _input(r)
    last = r.rounds[-1]
    text = (
        f"The path was refined by its scans: {last.pairs} points on surfaces of other steps, {last.passes} of them of "
        f"other passes, with a spread of {1e3 * last.spread:.0f} mm; scans agree in {r.agreement[1]:.0%} of the points "
        f"(before: {r.agreement[0]:.0%}; along the odometry alone: {r.reckoned:.0%})."
    )
    out = [Finding("good", "refined", text)]
    out += _input(r)
    if (f := r.fixes) is not None:
        text = (
            f"{f.used} fixes hold the refined path; they lie {f.rms:.2f} m from it (RMS), with a median χ² of "
            f"{f.typical:.2f} times that of errors as stated."
        )
        if f.left:
            text += f" {f.left} others were left out: before, after or in a gap of the path."
        if f.wild:
            text += f" {f.wild} of them are farther off than chance allows and count little."
        if f.contradicted:
            text += (
                " So errors of fixes are larger than stated, or last: state gps.bias_sigma and gps.bias_time, or a "
                "larger gps.sigma; the covariance of this path is too small."
            )
        out.append(Finding("look" if f.contradicted else "good", "refine-fixes", text))
    if wrong:
        some = "; ".join(f"x{i} and x{j} by {d:.1f} m, {np.rad2deg(t):.0f}°" for i, j, d, t in wrong[:4])
        text = (
            f"{len(wrong)} loops of the graph contradict the scans between their places, and bent its path: nodes "
            f"{some}. The refined path does not follow them; undo them if the graph shall not, either."
        )
        out.append(Finding("look", "refine-contradicted", text))
    elif wrong is None and len(r.refused):
        a, b = r.times[r.refused].T
        some = "; ".join(f"{x:.0f} s and {y:.0f} s" for x, y in list(zip(a, b))[:4])
        text = (
            f"{len(r.refused)} pairs of places of the start contradict the scans between them by more than 1 m or 6° "
            f"and were left apart ({some}): look at its loops there."
        )
        out.append(Finding("look", "refine-contradicted", text))
    if r.other is not None and r.other.apart > r.rounds[-1].distance:
        text = (
            f"Begun at the graph's path and at the odometry's, the refinement ended {r.other.apart:.2f} m apart. The "
            f"path from the {'odometry' if r.other.taken else 'graph'} was kept, since its scans agree better "
            f"({r.other.kept:.1%} of the points against {r.other.left:.1%}): look at the map before you trust it."
        )
        out.append(Finding("look", "refine-two-paths", text))
    if r.motion > CONTRADICTED:
        text = (
            f"Scans of other passes bend the motion more than the gyro can (χ²/dof {r.motion:.1f}): a place was taken "
            "for another one, or the sensor moved on the robot. The refined path and its covariance are not to be "
            "trusted."
        )
        out.append(Finding("bad", "refine-motion", text))
    if (times := float(max(r.scales.max(), r.walk))) > WIDENED:
        what = "the yaw bias walks" if r.walk >= r.scales.max() else "the motion is"
        text = f"Scans show that {what} {times:.1f} times as noisy as the log or the front end states; taken as seen."
        out.append(Finding("look", "refine-widened", text))
    if r.alike > WIDENED:
        text = (
            "Points of one scan err alike, as those of a line of the scanner or of a slanted wall do: sums of their "
            f"residuals vary {r.alike:.1f} times as much as independent errors would. The covariance is so much larger."
        )
        out.append(Finding("", "refine-alike", text))
    for name, (limit, words, unit, signs) in NAMED.items():
        if name in r.constants:
            v, sigma = r.constants[name]
            if abs(v) > limit and abs(v) > 5.0 * sigma:
                what = words.format(v=abs(v) * unit, sign=signs[int(v < 0)])
                out.append(Finding("look", f"refine-{name}", f"Scans and motion differ all along: {what}."))
    return out
