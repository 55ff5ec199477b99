"""Layers of the map in a report: points, lines, ellipses and loops, in the frame of the first base."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from graphslam.app.report.curves import report_curves
from graphslam.app.report.folder import ReportFolder
from graphslam.app.report.packed import base64_floats, packed_points, space
from graphslam.app.run.files import read_gps_residuals, read_map
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, se2_inverse, se2_transform
from graphslam.core.poses import position_covariances
from graphslam.io.cloud_files import read_cloud
from graphslam.io.submap_store import read_truth
from graphslam.io.tum import read_tum
from graphslam.maps.global_map import GlobalMap
from graphslam.plots import style

MOST_POINTS = 60_000
"""Largest number of map points in the page; larger maps are subsampled."""
MOST_PLACES = 4_000
"""Largest number of points of a path, about."""
ELLIPSES = 60
"""Largest number of ellipses along the path."""
CHI2_95 = -2.0 * math.log(0.05)
"""95 % quantile of χ² with two degrees of freedom (closed form)."""


def report_scene(folder: ReportFolder) -> dict[str, Any] | None:
    """The layers of a finished run; None if there is no map to show.

    Returns
    -------
    dict
        ``dim``, ``layers``: each ``name``, ``kind`` (points, line, ellipses, loops), ``colour``, ``on``, and its data:
        ``xyz`` as base64 of float32 ``(n, 3)`` [m]; of ellipses also ``cov``, ``(n, 3)``: xx, xy, yy of the 95 %
        ellipse [m²]; of loops ``rows``: number and both ends. ``curves``: panels of
        :func:`~graphslam.app.report.curves.report_curves`.
    """
    if folder.kind != "run":
        return None
    try:
        m = read_map(folder.path)
    except GraphSlamError:
        return None  # the section on figures gives the reason
    below, above = _references(folder, m.dim)
    layers = [*_map(folder), *below, _line("path", style.ESTIMATE, m.trajectory.positions)]
    if m.trajectory.covariances is not None:
        at = np.unique(np.linspace(0, len(m.trajectory) - 1, ELLIPSES).astype(np.int64))
        P = position_covariances(m.trajectory.poses[at], m.trajectory.covariances[at])
        layers.append(_ellipses(style.ellipses("path"), style.ESTIMATE, m.trajectory.positions[at], P))
    if len(m.landmarks):
        layers.append(_points("landmarks", style.LANDMARK, m.landmarks, size=5.0))
        name = style.ellipses("landmarks")
        layers.append(_ellipses(name, style.LANDMARK, m.landmarks, m.landmark_covariances))
    layers += [*above, *_loops(folder, m)]
    return {"dim": m.dim, "layers": layers, "curves": report_curves(folder, m)}


def _map(folder: ReportFolder) -> list[dict[str, Any]]:
    file = folder.path / "map.ply"
    if not file.is_file():
        return []
    try:
        points = read_cloud(file).points
    except GraphSlamError as error:
        folder.problems["map.ply"] = " ".join(str(error).replace(f"{folder.path}/", "").split())
        return []
    if not len(points):
        return []
    step = max(1, math.ceil(len(points) / MOST_POINTS))
    return [_points("map", style.GREY, points[::step], size=1.6)]


def _references(folder: ReportFolder, dim: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Dead reckoning, the graph before the refinement and GPS, drawn below the path; ground truth, drawn above it."""
    below: list[dict[str, Any]] = []
    above: list[dict[str, Any]] = []
    for name, file, colour, on in (
        ("dead reckoning", "dead_reckoning.tum", style.DEAD_RECKONING, False),
        ("graph, before the refinement", "trajectory_graph.tum", style.GRAPH, False),
        ("two maps, the first", "two_maps/first.tum", style.VERMILION, True),
        ("two maps, the second", "two_maps/second.tum", style.PURPLE, True),
        ("truth", "truth.tum", style.TRUTH, True),
    ):
        if (folder.path / file).is_file():
            try:
                path = read_tum(folder.path / file, dim=dim)
            except GraphSlamError as error:
                folder.problems[file] = " ".join(str(error).replace(f"{folder.path}/", "").split())
                continue
            line = _line(name, colour, path.positions, dashed=name == "truth", on=on)
            (above if name == "truth" else below).append(line)
    try:
        truth = read_truth(folder.path)
        scored = read_gps_residuals(folder.path / "gps_all.npz") if (folder.path / "gps_all.npz").is_file() else None
    except GraphSlamError:
        return below, above
    if truth is not None and len(truth.landmarks) and truth.landmarks.shape[1] == dim:
        above.append(_points("true landmarks", style.TRUTH, truth.landmarks, size=3.0))
    if scored is not None:
        fixes = se2_transform(se2_inverse(scored.T_gps_map), scored.points + scored.residuals)
        below.append(_points("GPS", style.GPS, fixes, size=3.0))
    return below, above


def _loops(folder: ReportFolder, m: GlobalMap) -> list[dict[str, Any]]:
    nodes = space(m.node_poses[:, : m.dim])
    colours = {
        "accepted": style.VERMILION,
        "switched-off": style.ORANGE,
        "undone": style.PURPLE,
        "rejected": style.GREY,
    }
    out = []
    for verdict, colour in colours.items():
        rows = [
            {"loop": int(r["loop"]), "a": _rounded(nodes[r["i"]]), "b": _rounded(nodes[r["j"]])}
            for r in folder.loop_rows
            if r["verdict"] == verdict and 0 <= r["i"] < len(nodes) and 0 <= r["j"] < len(nodes)
        ]
        if rows:
            name = f"loops, {verdict}"
            layer = {"name": name, "kind": "loops", "colour": colour, "on": verdict == "accepted", "rows": rows}
            out.append(layer)
    return out


def _points(name: str, colour: str, points: Array, *, size: float) -> dict[str, Any]:
    return {"name": name, "kind": "points", "colour": colour, "on": True, "size": size, "xyz": packed_points(points)}


def _line(name: str, colour: str, points: Array, *, dashed: bool = False, on: bool = True) -> dict[str, Any]:
    step = max(1, math.ceil(len(points) / MOST_PLACES))
    kept = np.vstack([points[::step], points[-1:]])
    return {"name": name, "kind": "line", "colour": colour, "on": on, "dashed": dashed, "xyz": packed_points(kept)}


def _ellipses(name: str, colour: str, centres: Array, covariances: Array) -> dict[str, Any]:
    P = CHI2_95 * np.stack([covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]], axis=1)
    return {
        "name": name,
        "kind": "ellipses",
        "colour": colour,
        "on": True,
        "xyz": packed_points(centres),
        "cov": base64_floats(P),
    }


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(v), 3) for v in values]
