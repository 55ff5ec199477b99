"""Curves of a report: consistency of the run along its path. Drawn by ``curves.js``."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.app.report.folder import ReportFolder
from graphslam.app.report.packed import base64_floats, packed_points
from graphslam.app.report.sections import metrics_of_folder
from graphslam.app.run.files import read_gps_residuals
from graphslam.app.verdict.figures import CONFIDENCE, class_rows
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, arc_length
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.path_consistency import path_consistency
from graphslam.evaluate.residual_consistency import two_sided_bounds
from graphslam.io.submap_store import read_truth
from graphslam.io.tum import read_tum
from graphslam.maps.global_map import GlobalMap
from graphslam.plots import style

MOST = 2_000
"""Largest number of points of a curve; longer curves keep both ends, and minimum and maximum of each interval."""
SIGMAS = 2.0
"""Half width of the bands around errors and innovations."""
_BOUNDS = f"{100 * CONFIDENCE:g} %"
_ROW = ("low", "high")
Rows = npt.NDArray[np.intp]


def report_curves(folder: ReportFolder, m: GlobalMap) -> list[dict[str, Any]]:
    """Panels of a finished run, the most important first; empty if there is nothing to show.

    With ground truth: NEES per degree of freedom of every pose with the two-sided bounds of a single pose, and its
    errors with ± 2 σ, first base fixed. Innovations of withheld fixes; without these, distances to the fixes.
    Without ground truth also χ² by factor class.

    Returns
    -------
    list of dict
        ``name``, ``said``, ``unit`` and ``kind``. For the kinds ``line`` and ``dots``: ``t`` [s] from the start of the
        path, ``s`` [m] path length, ``xyz`` [m], ``value``, as base64 of float32; ``log``; ``expected`` value
        or None; ``bounds``: two numbers, or ``half``: half width of the band at each point; ``cut``: points before
        which the line breaks. For the kind ``rows``: ``rows``, each ``name``, ``value``, ``low``, ``high``.
    """
    judged = _against_truth(folder, m)
    panels = [*judged, *_fixes(folder, m.trajectory)]
    return panels if judged else [*panels, *_kinds(folder)]


@dataclass(frozen=True)
class _Axis:
    """Times and positions of the points of a panel."""

    t: Array
    s: Array
    xyz: Array
    piece: npt.NDArray[np.int64]
    """Index of the piece of each point; points of one piece are joined by a line."""
    kind: str

    @classmethod
    def of(cls, path: Trajectory, rows: Rows) -> _Axis:
        """At poses of the path; the line breaks where poses are omitted."""
        piece = np.cumsum(np.diff(rows, prepend=rows[:1]) > 1, dtype=np.int64)
        t, s = path.times[rows] - path.times[0], arc_length(path.positions)[rows]
        return cls(t, s, path.positions[rows], piece, "line")

    @classmethod
    def at(cls, path: Trajectory, times: Array) -> _Axis:
        """At any times within the path."""
        t = np.clip(times, path.times[0], path.times[-1])
        s = np.interp(t, path.times, arc_length(path.positions))
        xyz = path.interpolate(t)[:, : path.dim] if len(t) else np.zeros((0, path.dim))
        return cls(times - path.times[0], s, xyz, np.arange(len(times)), "dots")

    def panel(
        self,
        name: str,
        text: str,
        values: Array,
        *,
        unit: str = "",
        expected: float | None = None,
        bounds: tuple[float, float] | None = None,
        sigmas: Array | None = None,
    ) -> dict[str, Any]:
        keep = extreme_rows(values, MOST)
        cut = np.flatnonzero(np.diff(self.piece[keep]) > 0) + 1
        out: dict[str, Any] = {
            **{"name": name, "said": text, "unit": unit, "kind": self.kind, "colour": style.ESTIMATE},
            **{"log": bounds is not None, "expected": expected, "cut": cut.tolist()},
            **{"t": base64_floats(self.t[keep]), "s": base64_floats(self.s[keep])},
            **{"xyz": packed_points(self.xyz[keep]), "value": base64_floats(values[keep])},
        }
        if self.kind == "dots":
            del out["cut"]
        if bounds is not None:
            out["bounds"] = [round(b, 6) for b in bounds]
        if sigmas is not None:
            out["half"] = base64_floats(SIGMAS * sigmas[keep])
        return out


def extreme_rows(values: Array, most: int) -> Rows:
    """At most ``most`` rows of the values ``(n,)``: both ends, and minimum and maximum of each interval."""
    n = len(values)
    if n <= most:
        return np.arange(n)
    edges = np.unique(np.linspace(0, n, (most - 2) // 2 + 1).astype(np.intp))
    of_each = [(a + int(np.argmin(values[a:b])), a + int(np.argmax(values[a:b]))) for a, b in pairwise(edges)]
    return np.unique(np.concatenate([np.array([0, n - 1]), np.array(of_each).ravel()])).astype(np.intp)


def _against_truth(folder: ReportFolder, m: GlobalMap) -> list[dict[str, Any]]:
    """NEES and errors of every pose; empty without ground truth in the frame of the first base."""
    file = folder.path / "truth.tum"
    if not file.is_file():
        return []
    try:
        if read_truth(folder.path) is None:
            return []
        made = path_consistency(m.trajectory, read_tum(file, dim=m.dim), chart=chart_of(folder))
    except GraphSlamError as error:
        text = " ".join(str(error).replace(f"{folder.path}/", "").split())
        folder.problems.setdefault("truth.tum", f"no NEES curve: {text}")
        return []
    if len(made.rows) < 2:
        return []
    axis, ratio = _Axis.of(m.trajectory, made.rows), made.nees / made.dof
    low, high, _ = two_sided_bounds(1.0, made.dof, CONFIDENCE)
    inside = float(np.mean((ratio >= low) & (ratio <= high)))
    text = (
        f"NEES of every pose (ground truth, first base fixed); {_BOUNDS} bounds of one pose with {made.dof} degrees of "
        f"freedom [{low:.3g}, {high:.3g}]; {_percent(inside)} of {len(ratio)} poses are inside. Errors of neighbours "
        "are correlated."
    )
    if made.certain:
        text += f" Not shown: {made.certain} poses with a singular covariance, such as the first base."
    panels = [axis.panel("NEES/dof of the path", text, ratio, expected=1.0, bounds=(low, high))]
    for k, name in enumerate(made.names):
        turn = name == "heading"
        scale = np.rad2deg(1.0) if turn else 1.0
        errors, sigmas = scale * made.errors[:, k], scale * made.sigmas[:, k]
        out = float(np.mean(np.abs(errors) > SIGMAS * sigmas))
        text = f"Ground truth minus estimate, ± {SIGMAS:g} σ; {_percent(out)} outside (consistent: 5 %)."
        panels.append(
            axis.panel(f"Error of {name}", text, errors, unit="°" if turn else "m", expected=0.0, sigmas=sigmas)
        )
    return panels


def chart_of(folder: ReportFolder) -> str:
    """Parametrisation of the NEES of the run; older runs do not store it, and most of them used ``group``."""
    return "cartesian" if folder.report.get("nees_chart") == "cartesian" else "group"


def _fixes(folder: ReportFolder, path: Trajectory) -> list[dict[str, Any]]:
    """Innovations of withheld fixes; without these, distances to the fixes."""
    found = _innovations(folder)
    if found is not None:
        times, v, sigma, nis = found
        d, axis = v.shape[1], _Axis.at(path, times)
        low, high, _ = two_sided_bounds(1.0, d, CONFIDENCE)
        inside = float(np.mean((nis / d >= low) & (nis / d <= high)))
        note = (
            f"Withheld GPS fixes against their prediction by the graph; {_BOUNDS} bounds of one fix "
            f"[{low:.3g}, {high:.3g}]; {_percent(inside)} of {len(nis)} are inside."
        )
        if folder.part("refine"):
            note += " The prediction is that of the graph before refinement."
        name = "NIS/dof of withheld GPS"
        out = [axis.panel(name, note, nis / d, expected=1.0, bounds=(low, high))]
        for k, of in enumerate("xyz"[:d]):
            note = f"Fix minus prediction, {of} of the GPS frame, ± {SIGMAS:g} σ of both."
            name, half = f"Withheld GPS, {of}", sigma[:, k]
            out.append(axis.panel(name, note, v[:, k], unit="m", expected=0.0, sigmas=half))
        return out
    for name, note in (("withheld", "withheld from the graph"), ("all", "as in the metrics")):
        try:
            scored = read_gps_residuals(folder.path / f"gps_{name}.npz")
        except GraphSlamError:
            continue
        if len(scored.times):
            text = f"Distance of fixes to the antenna on the path; {note}. No bounds available."
            return [_Axis.at(path, scored.times).panel("Distance to GPS", text, scored.errors, unit="m")]
    return []


def _innovations(folder: ReportFolder) -> tuple[Array, Array, Array, Array] | None:
    """Times, innovations, σ and NIS of withheld fixes; None if the run has none."""
    found = folder.part("gps_innovations")
    if not found.get("times"):
        return None
    n, wide = len(found["times"]), {len(row) for k in ("innovations", "sigmas") for row in found[k]}
    if {len(found[k]) for k in ("innovations", "sigmas", "nis")} != {n} or len(wide) != 1 or not wide <= {2, 3}:
        folder.problems["run.json"] = "has inconsistent innovations of withheld fixes"
        return None
    times, v, sigma, nis = (np.array(found[k], dtype=np.float64) for k in ("times", "innovations", "sigmas", "nis"))
    return times, v, sigma, nis


def _kinds(folder: ReportFolder) -> list[dict[str, Any]]:
    """χ²/dof by factor class with its bounds."""
    rows = [
        {"name": str(r.get("class")), **{k: round(float(r[k]), 6) for k in _ROW}, "value": _six(r["chi2_per_dof"])}
        for r in class_rows(metrics_of_folder(folder))
        if all(isinstance(r.get(k), (int, float)) and np.isfinite(r[k]) for k in (*_ROW, "chi2_per_dof"))
    ]
    if not rows:
        return []
    text = f"At the optimum, with {_BOUNDS} bounds. Above them the assumed noise is too small, below them too large."
    return [{"name": "χ²/dof by class of factor", "said": text, "unit": "", "kind": "rows", "log": True, "rows": rows}]


def _six(value: float) -> float:
    return float(f"{value:.6g}")


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
