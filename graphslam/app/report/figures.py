"""Pictures of a report: those of the run, and two drawn from its folder: loops, and NEES of the submaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphslam.app.report.curves import chart_of
from graphslam.app.report.folder import ReportFolder
from graphslam.app.report.markup import missing_note, page_section, remark
from graphslam.app.run.files import read_map, read_merged_dense
from graphslam.backend.sessions import SESSION
from graphslam.core.errors import DataError, GraphSlamError
from graphslam.core.markup import Markup, inline_picture, join_parts
from graphslam.evaluate.consistency import Consistency, nees
from graphslam.evaluate.path_consistency import map_errors
from graphslam.io.submap_store import read_truth
from graphslam.io.tum import read_tum

CAPTIONS = {
    "map.png": "Map: path with 95 % ellipses, landmarks; ground truth, GPS and dead reckoning if available",
    "refined.png": "Path of the graph and refined path: errors against ground truth, or their difference",
    "side.png": "The path from the side",
    "submaps.png": "Submaps at their solved poses",
    "fused.png": "Fused evidence grid at the solved poses",
    "fused_above.png": "Fused evidence grid from above",
    "fused_cut.png": "Fused evidence grid, cut from the side",
    "terrain.png": "Terrain: passable and not passable for a vehicle",
    "terrain_plain.png": "Terrain: free, hazard, unknown",
    "gps_residuals.png": "Distances to the GPS fixes",
    "gps_innovations.png": "Withheld GPS fixes against their prediction",
    "loops.png": "Loop closures of landmark submaps: disagreement",
}

MOST_NAMES = 60
"""If there are more loops, they are drawn without their numbers."""


def report_pictures(folder: ReportFolder) -> Markup:
    """All pictures, the map first."""
    made = dict(folder.figures())
    parts: list[Any] = []
    order = [n for n in CAPTIONS if n in made]
    levels = [n for n in made if n.startswith("fused_level")]
    rest = [n for n in made if n not in {*order, *levels}]
    at = order.index("submaps.png") + 1 if "submaps.png" in order else min(1, len(order))
    drawn = _drawn(folder)
    for name in order[:at]:
        parts.append(inline_picture(made[name], CAPTIONS[name]))
    parts += drawn
    for name in [*levels, *order[at:], *rest]:
        parts.append(inline_picture(made[name], _caption(name)))
    if not made:
        parts.append(missing_note("plots of the run: figures/ has none."))
    elif "map.png" not in made:
        parts.append(missing_note("the map (figures/map.png)."))
    if folder.kind == "run" and not any(n.startswith("fused") for n in made):
        reason = folder.report.get(
            "map_left_out", "the submaps have no evidence grids or clouds, or no map was requested."
        )
        parts.append(missing_note("a fused map: ", reason))
    return page_section("figures", "Figures", *parts)


def _caption(name: str) -> str:
    if name in CAPTIONS:
        return CAPTIONS[name]
    stem = name.removesuffix(".png")
    if stem.startswith("fused_level"):
        return f"Fused evidence grid, floor {stem.removeprefix('fused_level')}"
    return stem.replace("_", " ")


def _drawn(folder: ReportFolder) -> list[Markup]:
    """Loops over the path, and NEES by submap, drawn from the data in the folder."""
    if folder.kind == "interrupted":
        return [missing_note("loop closures on the path, and NEES by submap: the run is not finished.")]
    if folder.kind == "merged":
        return _session_links(folder)
    try:
        m = read_map(folder.path)
    except GraphSlamError as error:
        folder.problems["map.npz"] = _error_text(folder, error)
        return [
            missing_note("loop closures on the path, and NEES by submap: map.npz ", folder.problems["map.npz"], ".")
        ]
    bases = np.arange(len(m.node_poses)) if m.base_nodes is None else m.base_nodes
    loops = _loops(folder, m.node_poses, m.trajectory.poses)
    return [*loops, *_nees(folder, m.node_poses, m.node_covariances, bases)]


def _session_links(folder: ReportFolder) -> list[Markup]:
    """Loop closures between sessions over the paths of both."""
    from graphslam.plots.loops import plot_loops
    from graphslam.plots.save import figure_png

    links = [e for e in folder.events or [] if e.get("event") == "between" and e.get("group") == SESSION]
    if not links:
        return [missing_note("loop closures between sessions: none from place recognition.")]
    try:
        nodes = read_merged_dense(folder.path)["nodes"]
        paths = [read_tum(f).positions[:, :2] for f in sorted(folder.path.glob("trajectory_*.tum"))]
        gap = np.full((1, 2), np.nan)  # interrupts the line
        path = np.concatenate([x for p in paths for x in (p, gap)])
        ends = [(e["i"], e["j"], "accepted") for e in links]
        ax = plot_loops(None, path, nodes, ends, title="loop closures between sessions, from above")
    except GraphSlamError as error:
        return [missing_note("loop closures between sessions: ", _error_text(folder, error), ".")]
    return [inline_picture(figure_png(ax), "Paths of the sessions in the common frame, and loop closures between them")]


def _error_text(folder: ReportFolder, error: Exception) -> str:
    """Text of an error without the folder's path, so that the page is the same wherever it was made."""
    return " ".join(str(error).replace(f"{folder.path}/", "").replace(f"{folder.home}/", "").split())


def _loops(folder: ReportFolder, nodes: np.ndarray, path: np.ndarray) -> list[Markup]:
    from graphslam.plots.loops import plot_loops
    from graphslam.plots.save import figure_png

    n = len(nodes)
    rows = [r for r in folder.loop_rows if 0 <= r["i"] < n and 0 <= r["j"] < n]
    if not folder.loop_rows:
        return []  # the section on loops gives the reason
    try:
        ends = [(int(r["i"]), int(r["j"]), str(r["verdict"])) for r in rows]
        names = [r["loop"] for r in rows] if len(rows) <= MOST_NAMES else None
        ax = plot_loops(None, path, nodes, ends, names=names, title="loop closures, from above")
    except DataError as error:
        return [missing_note("loop closures on the path: ", error, ".")]
    out = [inline_picture(figure_png(ax), "Loop closures by their number in the ledger: accepted, undone, rejected")]
    lost = len(folder.loop_rows) - len(rows)
    return [*out, remark(f"{lost} loop closures have no node to draw.")] if lost else out


def _nees(folder: ReportFolder, nodes: np.ndarray, covariances: np.ndarray, bases: np.ndarray) -> list[Markup]:
    try:
        truth = read_truth(folder.path)
        if truth is None:
            return [missing_note("NEES by submap: no ground truth in the folder.")]
        keys = np.array([int(e["key"]) for e in folder.submaps], dtype=np.int64)
        if len(bases) != len(keys) + 1:
            raise DataError("nodes do not match the submaps", got=len(bases) - 1, wanted=len(keys))
        here = np.isin(truth.keys, keys)
        if not np.any(here):
            return [missing_note("NEES by submap: no ground truth for these submaps.")]
        end = bases[1 + np.searchsorted(keys, truth.keys[here])]
        d2 = nees(*map_errors(nodes[end], covariances[end], truth.exit_poses[here], chart_of(folder)))
    except (GraphSlamError, KeyError, TypeError, IndexError, ValueError) as error:
        return [missing_note("NEES by submap: ", _error_text(folder, error), ".")]
    from graphslam.plots.consistency import plot_consistency
    from graphslam.plots.save import figure_png

    dof = covariances.shape[-1]
    made = Consistency(
        quantity="ends of submaps", nees=d2[None], dof=np.full((1, len(d2)), dof), gauge="first base fixed"
    )
    ax = plot_consistency(
        None, {"this run": made}, submaps=truth.keys[here], title=f"n = {dof}, first base fixed, one run"
    )
    text = "NEES/n of the submap end poses (ground truth), with the 95 % bounds of a consistent run"
    return [
        inline_picture(figure_png(ax), text),
        remark(join_parts(["Errors of one run are correlated: neighbours are inside or outside together."])),
    ]
