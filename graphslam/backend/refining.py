"""Refine the solved map of a run with its scans, or state why the map is unchanged."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.ledger import EXCLUSIVE, Ledger
from graphslam.graph.sensors.control import CONTROL_ROWS
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.refined import refined_map, refined_submaps
from graphslam.refine.config import RefineConfig
from graphslam.refine.refine import refine_by_scans, refine_if_contradicted
from graphslam.refine.result import Refinement, ScanCheck
from graphslam.refine.revisit_constraints import FAR, tangent_lengths
from graphslam.refine.scans import Scans

logger = logging.getLogger(__name__)

CONTRADICTED = 3.0
"""Limit on χ²/dof of the yaw-bias random walk; above it, scans of different traversals contradict the motion."""
WIDENED = 1.5
"""From this ratio of estimated to assumed σ of the motion on, it is reported."""
NAMED = {
    "scale": (0.03, "odometry distances {v:.1%} too {sign} (wheel scale)", 1.0, ("long", "short")),
    "side": (
        0.009,
        "scanner yaw {v:.2f}° to the {sign} of the odometry direction (mounting)",
        57.29578,
        ("left", "right"),
    ),
    "rise": (0.009, "scanner pitch {v:.2f}° {sign} the odometry direction (mounting)", 57.29578, ("below", "above")),
    "clock": (0.02, "odometry stamps {v:.0f} ms too {sign} relative to the scans", 1e3, ("early", "late")),
}
"""Systematic errors that are reported: smallest size, text, unit factor, and the words for their sign."""


@dataclass(frozen=True)
class RefinedRun:
    """Result of a refinement.

    Parameters
    ----------
    map : GlobalMap
        With the refined path and nodes.
    submaps : list of Submap
        Along the refined path; empty if the run's have no grids.
    graph_path : Trajectory
        Path of the graph, the initial guess.
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
    graph: FactorGraph | None = None,
    progress: Callable[[str], Any] | None = None,
    fixes: str = "GPS fixes",
) -> tuple[RefinedRun | None, list[Finding]]:
    """Refine the solved map of a run.

    Parameters
    ----------
    scans : Scans or None
        None: the front end does not use scans.
    m : GlobalMap
        Solved.
    gps : (Gps, GpsConfig), optional
        Fixes in the graph, and their options; the refined path uses them, too.
    graph : FactorGraph, optional
        The graph of the map; its loop closures are compared with the refined path.
    fixes : str
        Name of the content of ``gps``, for the findings.

    Returns
    -------
    refined : RefinedRun or None
        None if the path of the graph is the result.
    findings : list of Finding
        Lines of the verdict.
    """
    if not config.use or scans is None:
        return None, []
    path = m.trajectory
    try:
        start = path.interpolate(np.clip(scans.times, path.times[0], path.times[-1]))
        if config.use != "always" and gps is None and scans.matched:
            found = refine_if_contradicted(scans, start, config, progress=progress)
        else:
            found = refine_by_scans(scans, start, config, gps=gps, progress=progress)
        if isinstance(found, ScanCheck):
            text = (
                "refinement: not used — the odometry has matched the same scans, and they do not contradict the graph. "
                f"The graph's path is the result. Scan agreement: odometry {found.odometry:.1%}, graph "
                f"{found.start:.1%}."
            )
            return None, [Finding("", "refine-nothing-new", text)]
        if not found.better:
            text = (
                f"refinement: not used — scans agree in {found.agreement[1]:.0%} of the points along the refined "
                f"path and in {found.agreement[0]:.0%} along the graph's path, which is the result."
            )
            return None, [Finding("look", "refine-refused", text), *_input(found)]
        refined = refined_map(m, found, submaps)
        grids = all(isinstance(s.grid, EvidenceGrid) for s in submaps)
        drawn = refined_submaps(submaps, refined, found, scans) if grids else []
    except GraphSlamError as error:  # a failed refinement does not discard the solved run
        logger.warning("refinement failed: %s", error)
        return None, [
            Finding("look", "refine-failed", f"refinement: failed — {error}. The graph's path is the result.")
        ]
    wrong = None if graph is None else wrong_loops(graph, refined)
    return RefinedRun(found, refined, drawn, path), refinement_findings(found, wrong, fixes)


def _input(r: Refinement) -> list[Finding]:
    """Finding, if the scans agree better along the input odometry than along the result."""
    if r.left is not None:
        text = (
            f"scan agreement: odometry {r.reckoned:.1%}, graph {r.agreement[0]:.1%}, refined {r.left:.1%} of the "
            "points — the odometry is best and is the result; its covariance is the odometry's, without loop closures."
        )
        return [Finding("look", "input-better", text)]
    if not r.input_better:
        return []
    text = (
        f"scan agreement: odometry {r.reckoned:.1%}, this result {max(r.agreement):.1%} of the points — the odometry "
        "is better. Use its path, or reduce its assumed noise."
    )
    return [Finding("bad", "input-better", text)]


def wrong_loops(graph: FactorGraph, m: GlobalMap) -> list[tuple[int, int, float, float]]:
    """Loops and matches of a graph that a refined map contradicts by more than :data:`FAR`.

    Returns
    -------
    list of (i, j, metres, radians)
        Nodes, and the error of the factor; the largest distance first.
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


def refined_ledger(
    ledger: Ledger, submaps: Sequence[Submap], r: Refinement, control: Sequence[str] = ()
) -> tuple[Ledger, list[Finding]]:
    """Measurements of a refined path: scans, motion and gravity, once each; the graph was its initial guess.

    Parameters
    ----------
    ledger : Ledger
        Of the graph.
    submaps : sequence of Submap
        With the streams that their front end used.
    control : sequence of str
        Control rows used by the refinement, with their names in the ledger.

    Returns
    -------
    findings : list of Finding
        Measurements used, and streams of the graph that the refined path does not use.
    """
    out, entries = ledger.as_start(), ledger.entries()
    streams = frozenset().union(*(s.uses for s in submaps))
    # streams that the front end used only for the gravity direction
    gravity = frozenset().union(*(s.assisting_streams for s in submaps)) if "gravity" in r.parts else frozenset()
    out.spend(SCAN_PAIRS, "scan-pairs", streams | gravity, (float(r.times[0]), float(r.times[-1])))
    held = {e.stream for e in entries if e.kind == EXCLUSIVE and e.factor.startswith("GPS fix")} if r.fixes else set()
    for stream in sorted(held.union(control)):
        out.spend(SCAN_PAIRS, "fixes", [stream], (float(r.times[0]), float(r.times[-1])))
    streams = streams | held | ({CONTROL_ROWS} if control else set())
    factors = len({e.factor_id for e in entries})
    spent = ", ".join(sorted(streams | gravity)) or "the scans"
    text = (
        f"measurements of the refined path: {spent} — each used once (scan-pairs). The {factors} factors of the graph "
        "are only its initial guess."
    )
    found = [Finding("", "refine-evidence", text)]
    lost = sorted({e.stream.partition("/")[0] for e in entries if e.kind == EXCLUSIVE} - streams - {CONTROL_ROWS})
    if lost:
        text = f"streams used by the graph only: {', '.join(lost)} — not used in the refined path."
        if some := sorted(gravity.intersection(lost)):
            text += f" It uses the gravity direction of {', '.join(some)}."
        found.append(Finding("look", "refine-streams", text))
    return out, found


SCAN_PAIRS = -1
"""Id of the refinement in a ledger of factors, whose ids start at 0."""


def refinement_findings(
    r: Refinement, wrong: Sequence[tuple[int, int, float, float]] | None = None, fixes: str = "GPS fixes"
) -> list[Finding]:
    """Findings of a refinement.

    Parameters
    ----------
    wrong : sequence of (i, j, metres, radians), optional
        Contradicted loops of the graph (:func:`wrong_loops`); None: the graph is not known.
    fixes : str
        Measurements used besides scans.
    """
    if r.left is not None:
        return _input(r)
    last = r.rounds[-1]
    text = (
        f"scan agreement of the refined path: {r.agreement[1]:.0%} of the points (before: {r.agreement[0]:.0%}, "
        f"odometry: {r.reckoned:.0%}) — {last.pairs} point-to-surface pairs, {last.passes} of them of other "
        f"traversals, residual spread {1e3 * last.spread:.0f} mm."
    )
    out = [Finding("good", "refined", text)]
    out += _input(r)
    if (f := r.fixes) is not None:
        text = (
            f"{fixes} in the refinement: {f.used}, {f.rms:.2f} m RMS from the path — median χ² is {f.typical:.2f} "
            "times the expected one."
        )
        if f.left:
            text += f" {f.left} others are outside the path in time."
        if f.wild:
            text += f" {f.wild} are outliers and have a low weight."
        if f.contradicted:
            text += (
                " Their errors are larger than assumed or time-correlated: the covariance of this path is too small. "
            )
            text += "Check their sigma; for GPS, set gps.bias_sigma and gps.bias_time, or a larger gps.sigma."
        out.append(Finding("look" if f.contradicted else "good", "refine-fixes", text))
    if wrong:
        some = "; ".join(f"x{i} and x{j} by {d:.1f} m, {np.rad2deg(t):.0f}°" for i, j, d, t in wrong[:4])
        text = (
            f"loop closures that contradict the scans: {len(wrong)} ({some}) — they deform the graph's path, not the "
            "refined one. Remove them with `graphslam loops RUN --undo N`."
        )
        out.append(Finding("look", "refine-contradicted", text))
    elif wrong is None and len(r.refused):
        a, b = r.times[r.refused].T
        some = "; ".join(f"{x:.0f} s and {y:.0f} s" for x, y in list(zip(a, b))[:4])
        text = (
            f"initial pairs of places that contradict the scans: {len(r.refused)} by more than 1 m or 6° ({some}) — "
            "not used. Check the loop closures there."
        )
        out.append(Finding("look", "refine-contradicted", text))
    if r.other is not None and r.other.apart > r.rounds[-1].distance:
        text = (
            f"refinement from two initial paths: {r.other.apart:.2f} m apart — the one from the "
            f"{'odometry' if r.other.swapped else 'graph'} was kept, its scans agree better ({r.other.kept:.1%} of the "
            f"points, the other {r.other.left:.1%}). Check the map."
        )
        out.append(Finding("look", "refine-two-paths", text))
    if r.motion > CONTRADICTED:
        text = (
            f"chi-square of the motion in the refinement: {r.motion:.1f} per degree of freedom [≤ {CONTRADICTED:g}] — "
            "a loop closure is false, or the sensor moved on the robot. Do not use the refined path."
        )
        out.append(Finding("bad", "refine-motion", text))
    if (times := float(max(r.scales.max(), r.walk))) > WIDENED:
        what = "yaw bias" if r.walk >= r.scales.max() else "motion"
        text = f"{what} noise: {times:.1f} times the assumed σ — estimated by the refinement, and used there."
        out.append(Finding("look", "refine-widened", text))
    if r.alike > WIDENED:
        text = (
            f"correlation of points within a scan: variance of residual sums {r.alike:.1f} times that of independent "
            "errors — the covariance is scaled by it."
        )
        out.append(Finding("", "refine-alike", text))
    for name, (limit, words, unit, signs) in NAMED.items():
        if name in r.constants:
            v, sigma = r.constants[name]
            if abs(v) > limit and abs(v) > 5.0 * sigma:
                what = words.format(v=abs(v) * unit, sign=signs[int(v < 0)])
                out.append(Finding("look", f"refine-{name}", f"systematic error between scans and motion: {what}."))
    return out
