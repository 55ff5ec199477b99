"""The curves of a report, as a browser draws them: every point against figures made here from the run's own files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

import graphslam as gs
from graphslam.app.report.report import make_report
from tests.app.report.test_report_in_browser import PIXELS, folder, needs_chromium, page  # noqa: F401
from tests.reference.browser import act

Curve = dict[str, Any]

RECORDED = """
const paths = new Map(), words = new Map(), dots = new Map();
const into = (of, c, x) => { if (!of.has(c)) of.set(c, []); of.get(c).push(x); };
const P = CanvasRenderingContext2D.prototype, line = P.lineTo, text = P.fillText, arc = P.arc, clear = P.clearRect;
P.lineTo = function (x, y) { into(paths, this.canvas, [x, y]); return line.call(this, x, y); };
P.fillText = function (t, x, y) {
  into(words, this.canvas, [t, x, y, this.textAlign]);
  return text.call(this, t, x, y);
};
P.arc = function (x, y, r, ...rest) { into(dots, this.canvas, [x, y]); return arc.call(this, x, y, r, ...rest); };
P.clearRect = function (...a) {
  for (const of of [paths, words, dots]) of.delete(this.canvas);
  return clear.apply(this, a);
};
"""
"""What a canvas was told to draw since it was last cleared."""

LOOK = """
const look = () => Object.fromEntries([...document.querySelectorAll("#panels figure")].map((f) => {
  const c = f.querySelector("canvas");
  return [f.querySelector("h3").textContent, { line: paths.get(c) || [], dots: dots.get(c) || [],
    words: words.get(c) || [], said: f.querySelector("figcaption").textContent, w: c.clientWidth }];
}));
"""


def scale(words: list[list[Any]], align: str, at: int, *, log: bool = False) -> tuple[float, float]:
    """Offset and slope from pixels to values, by the first and the last label that stands on an axis."""
    on = [(float(t), w[at]) for t, *w, side in words if side == align and _is_number(t)]
    (v0, p0), (v1, p1) = on[0], on[-1]
    if log:
        v0, v1 = math.log10(v0), math.log10(v1)
    slope = (v1 - v0) / (p1 - p0)
    return v0 - slope * p0, slope


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read(drawn: Curve, part: str, *, log: bool = False) -> np.ndarray:
    """Points of a curve ``(n, 2)`` in the units of its axes; and nothing but the labels tells what they are."""
    points = np.array(drawn[part], dtype=np.float64)
    (ax, bx), (ay, by) = scale(drawn["words"], "center", 0), scale(drawn["words"], "right", 1, log=log)
    y = ay + by * points[:, 1]
    return np.column_stack([ax + bx * points[:, 0], 10.0**y if log else y])


def truth_of(root: Path) -> tuple[np.ndarray, ...]:
    """Times, travelled metres, NEES/dof, and errors with σ of x, y [m], heading [°]: written without the package.

    In the group chart (the docstring of graphslam/core/charts.py): ``(V(d)⁻¹ (t - t̂), d)`` with the covariance of
    the vector (x, y, θ), which of a pose stored as a right tangent is that turned by its heading.
    """
    with np.load(root / "map.npz") as a:
        times, poses, P = a["trajectory_times"], a["trajectory_poses"], a["trajectory_covariances"]
    true = np.loadtxt(root / "truth.tum")
    assert np.array_equal(true[:, 0], times)
    heading = 2.0 * np.arctan2(true[:, 6], true[:, 7])
    out = []
    for x, C, t, h in zip(poses[1:], P[1:], true[1:, 1:3], heading[1:]):  # the first base is fixed
        d = math.remainder(h - x[2], 2.0 * math.pi)
        s, c = (math.sin(d) / d, (1.0 - math.cos(d)) / d) if abs(d) > 1e-9 else (1.0, 0.0)
        e = np.array([*np.linalg.solve([[s, -c], [c, s]], t - x[:2]), d])
        R = np.array([[math.cos(x[2]), -math.sin(x[2]), 0], [math.sin(x[2]), math.cos(x[2]), 0], [0, 0, 1]])
        V = R @ C @ R.T
        out.append([e @ np.linalg.inv(V) @ e / 3.0, *(e * DEGREES), *(np.sqrt(np.diag(V)) * DEGREES)])
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    rows = np.array(out)
    return times[1:] - times[0], far[1:], rows[:, 0], rows[:, 1:4], rows[:, 4:]


DEGREES = np.array([1.0, 1.0, 180.0 / math.pi])


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
def test_points_drawn_are_those_of_the_files(folder: Path, page: str, tmp_path: Path, width: int) -> None:  # noqa: F811
    found = act(
        page,
        tmp_path,
        LOOK
        + """
        const first = look();
        document.querySelector('[data-along="s"]').click();
        const page = document.documentElement;
        return { t: first, s: look(), w: page.clientWidth, all: page.scrollWidth,
          ms: performance.timing.domContentLoadedEventEnd - performance.timing.navigationStart };
        """,
        width=width,
        before=RECORDED,
    )
    assert found["all"] <= found["w"] == width
    assert found["ms"] < 2000
    assert list(found["t"])[:4] == ["NEES/dof of the path", "Error of x [m]", "Error of y [m]", "Error of heading [°]"]
    t, s, nees, errors, sigmas = truth_of(folder)
    for along, x in (("t", t), ("s", s)):
        for k, (name, values) in enumerate(zip(list(found[along])[:4], [nees, *errors.T])):
            drawn = read(found[along][name], "line", log=k == 0)
            assert len(drawn) == len(x)
            # a label is set to a part of a pixel, and values travel as float32
            assert drawn[:, 0] == pytest.approx(x, abs=1e-3 * x[-1])
            if k == 0:
                assert drawn[:, 1] == pytest.approx(values, rel=1e-3)
            else:
                assert drawn[:, 1] == pytest.approx(values, abs=1e-3 * np.abs(2.0 * sigmas[:, k - 1]).max())
    low, high = stats.chi2.ppf([0.025, 0.975], 3) / 3.0
    outside = np.sum((nees < low) | (nees > high))
    assert len(found["t"]["NEES/dof of the path"]["dots"]) == outside
    assert f"[{low:.3g}, {high:.3g}]" in found["t"]["NEES/dof of the path"]["said"]
    for k, name in enumerate(list(found["t"])[1:4]):
        assert len(found["t"][name]["dots"]) == np.sum(np.abs(errors[:, k]) > 2.0 * sigmas[:, k])


@needs_chromium
def test_withheld_fixes_are_drawn_with_their_sigmas(folder: Path, page: str, tmp_path: Path) -> None:  # noqa: F811
    stored = json.loads((folder / "run.json").read_text())["gps_innovations"]
    found = act(page, tmp_path, LOOK + "return look();", before=RECORDED)
    with np.load(folder / "map.npz") as a:
        begin = a["trajectory_times"][0]
    m = {r["key"]: r["value"] for r in json.loads((folder / "metrics.json").read_text())}
    assert np.mean(stored["nis"]) / 2.0 == pytest.approx(m["gps_nis_each_value"], rel=1e-4)
    assert len(stored["times"]) == m["gps_withheld_fixes"]
    for name, values in (
        ("NIS/dof of withheld GPS", np.array(stored["nis"]) / 2.0),
        ("Withheld GPS, x [m]", np.array(stored["innovations"])[:, 0]),
        ("Withheld GPS, y [m]", np.array(stored["innovations"])[:, 1]),
    ):
        drawn = read(found[name], "dots", log=name.startswith("NIS"))
        assert drawn[:, 0] == pytest.approx(np.array(stored["times"]) - begin, abs=0.05)
        assert drawn[:, 1] == pytest.approx(values, rel=2e-3, abs=2e-3)


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
def test_pointing_tells_value_and_time_and_a_click_shows_the_place(
    folder: Path,  # noqa: F811
    page: str,  # noqa: F811
    tmp_path: Path,
    width: int,
) -> None:
    found = act(
        page,
        tmp_path,
        PIXELS
        + """
        const plot = document.querySelector("#panels canvas"), [x, y] = paths.get(plot)[100];
        const b = plot.getBoundingClientRect();
        const where = { clientX: b.left + x, clientY: b.top + y, bubbles: true };
        const at = (type) => plot.dispatchEvent(new MouseEvent(type, where));
        const before = hash(), out = plot.parentElement.querySelector("output");
        at("pointermove");
        const told = out.textContent, same = hash() === before;
        at("click");
        const ring = (dots.get(v) || []).at(-1), marked = colours()["240,228,66"] || 0;
        plot.focus();
        plot.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
        const next = out.textContent;
        at("pointerleave");
        return { told, same, place: v.dataset.place, ring, marked, next, left: out.textContent.trim(),
          words: words.get(v), path: paths.get(v) };
        """,
        width=width,
        before=RECORDED,
    )
    t, s, nees, _, _ = truth_of(folder)
    low, high = stats.chi2.ppf([0.025, 0.975], 3) / 3.0

    def told(k: int) -> str:
        return f"t {t[k]:.4g} s, {s[k]:.4g} m: {nees[k]:.4g} ({low:.4g} to {high:.4g})"

    assert found["told"] == told(100)
    assert found["next"] == told(101)
    assert found["same"], "pointing alone does not move the map"
    assert found["place"] == f"NEES/dof of the path, {told(100)}"
    assert found["marked"] > 10
    assert found["left"] == ""
    with np.load(folder / "map.npz") as a:
        path = a["trajectory_poses"][:, :2]
    # where the ring stands in the map, by its own scale: the path is drawn there too, point by point
    drawn = np.array(found["path"])
    first = next(k for k in range(len(drawn)) if _similar(drawn[k : k + len(path)], path))
    assert found["ring"] == pytest.approx(drawn[first + 101].tolist(), abs=0.01)


def _similar(drawn: np.ndarray, path: np.ndarray) -> bool:
    """Is it the path, at some scale, y upwards?"""
    if len(drawn) != len(path):
        return False
    a, b = drawn - drawn[0], (path - path[0]) * [1.0, -1.0]
    k = np.sum(a * b) / np.sum(b * b)
    return bool(k > 0 and np.abs(a - k * b).max() < 0.05)


@needs_chromium
def test_a_run_without_truth_shows_what_it_has(tmp_path: Path) -> None:
    """No NEES: withheld fixes, and χ² by kind of factor; of a run with neither, no curves at all."""
    log = replace(gs.simulate("landmark-field", preset="quick", seed=3), truth=None)
    out = tmp_path / "run"
    gs.run(log, seed=5, out=out, solver="batch", config={"frontend": {"particles": 20}}, progress=False)
    report = json.loads((out / "run.json").read_text())
    found = act(make_report(out).html, tmp_path, LOOK + "return look();", before=RECORDED, width=390)
    (shown,) = found.values()
    assert list(found) == ["χ²/dof by class of factor"]
    values = {w[0].rsplit("  ", 1)[0]: float(w[0].rsplit("  ", 1)[1]) for w in shown["words"] if "  " in w[0]}
    classes = [c for c in report["graph"]["classes"] if c["chi2_per_dof"] is not None and c["dof"] > 0]
    assert values == pytest.approx({c["class"]: c["chi2_per_dof"] for c in classes}, rel=1e-3)
    report["graph"]["classes"] = []
    (out / "run.json").write_text(json.dumps(report))
    bare = make_report(out).html
    assert 'id="curves"' not in bare
    assert act(bare, tmp_path, "return document.querySelectorAll('figure canvas').length;") == 0
