"""Figures: what is drawn is what was given, in metres, with names; ellipses have the right size; all on Agg."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from graphslam.core.errors import CovarianceError, DataError, GeometryError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import se2_compose
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.consistency import Consistency
from graphslam.evaluate.gps import gps_residuals
from graphslam.plots import style
from graphslam.plots.consistency import plot_consistency
from graphslam.plots.map import ellipse_axes, landmark_blocks, plot_ellipses, plot_map
from graphslam.plots.submaps import chain_poses, plot_submap_chain
from graphslam.plots.trajectory import plot_gps_residuals
from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field
from graphslam_studies.plots.comparison import plot_comparison


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


def rendered(ax: Axes, tmp_path: Path) -> Axes:
    """Draw for real, and check what every figure must have."""
    ax.figure.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5_000
    assert ax.get_xlabel()
    assert ax.get_legend() is not None
    return ax


def legend_of(ax: Axes) -> list[str]:
    return [t.get_text() for t in ax.get_legend().get_texts()]


def line(ax: Axes, label: str) -> np.ndarray:
    return next(l for l in ax.get_lines() if l.get_label() == label).get_xydata()


@pytest.fixture(scope="module")
def log():
    return simulate_landmark_field(landmark_field_preset("quick", gps_rate=1.0), 0)


def test_map_draws_path_landmarks_gps_and_truth(log, tmp_path: Path) -> None:
    t = log.truth.trajectory
    est = Trajectory(t.times, t.poses + [0.5, 0, 0], np.tile(np.diag([0.1, 0.2, 0.01]), (len(t), 1, 1)))
    P = np.tile(np.diag([1.0, 0.25]), (len(log.truth.landmarks), 1, 1))
    ax = plot_map(
        trajectory=est,
        landmarks=log.truth.landmarks + 0.2,
        covariances=P,
        gps=log["gps"],
        truth=log.truth,
        dead_reckoning=t.poses - 1.0,
    )
    rendered(ax, tmp_path)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    assert ax.get_aspect() == 1.0
    assert np.array_equal(line(ax, "path"), est.positions)
    assert np.array_equal(line(ax, "truth"), t.positions)
    assert np.array_equal(line(ax, "GPS"), log["gps"].positions)
    assert np.array_equal(line(ax, "true landmarks"), log.truth.landmarks)
    names = legend_of(ax)
    for name in ("path", "truth", "GPS", style.ellipses("landmarks"), "dead reckoning", style.ellipses("path")):
        assert name in names
    assert len(names) == len(set(names))


def test_map_takes_plain_arrays_and_parts_of_it(tmp_path: Path) -> None:
    p = np.random.default_rng(0).normal(size=(10, 2))
    ax = plot_map(trajectory=p, landmarks=p, gps=p, truth=p)
    rendered(ax, tmp_path)
    assert "landmarks" in legend_of(ax)
    plot_map(landmarks=p[:0])
    with pytest.raises(GeometryError, match="wrong shape"):
        plot_map(trajectory=p[0])


def test_map_draws_into_the_axes_it_is_given() -> None:
    _, (a, b) = plt.subplots(1, 2)
    assert plot_map(b, trajectory=np.zeros((2, 2))) is b
    assert not a.lines
    assert len(plt.get_fignums()) == 1


def test_landmark_map_brings_its_own_ellipses() -> None:
    P = np.diag([1, 1, 1, 4.0, 9.0, 16.0, 25.0])
    m = LandmarkMap(ids=[1, 2], exit_pose=np.zeros(3), positions=[[0.0, 0], [50, 0]], covariance=P)
    ax = plot_map(landmarks=m)
    e = next(c for c in ax.collections if isinstance(c, EllipseCollection))
    k = 2 * np.sqrt(chi2_quantile(0.95, 2))
    assert np.allclose(np.sort(2 * e._widths), np.sort([k * 3, k * 5]))
    assert np.array_equal(landmark_blocks(P, 2, offset=3)[1], np.diag([16.0, 25.0]))
    with pytest.raises(CovarianceError, match="does not fit"):
        landmark_blocks(P, 2)


def test_ellipse_holds_the_stated_share_of_samples(rng: np.random.Generator) -> None:
    P = np.array([[4.0, 1.5], [1.5, 1.0]])
    for confidence in (0.5, 0.95):
        w, h, angle = (float(v[0]) for v in ellipse_axes(P[None], confidence))
        x = rng.multivariate_normal([0, 0], P, 50_000)
        c, s = np.cos(angle), np.sin(angle)
        u, v = x @ [c, s], x @ [-s, c]
        inside = np.mean((2 * u / w) ** 2 + (2 * v / h) ** 2 < 1)
        assert inside == pytest.approx(confidence, abs=5 * np.sqrt(0.25 / 50_000))
    assert w > h


def test_ellipses_are_drawn_in_metres_and_enter_the_limits(tmp_path: Path) -> None:
    ax = plot_ellipses(None, [[0.0, 0.0]], [np.diag([100.0, 1.0])], label="e")
    style.metric_axes(ax)
    style.legend(ax)
    rendered(ax, tmp_path)
    half = 10 * np.sqrt(chi2_quantile(0.95, 2))
    low, high = ax.get_xlim()
    assert low <= -half
    assert high >= half


def test_ellipse_on_paper_spans_its_metres_also_on_unequal_axes() -> None:
    """Count the inked pixels: on axes whose y scale is 5 × the x scale the ellipse must still span its own data."""
    ax = plot_ellipses(None, [[3.0, 1.0]], [[[100.0, 4.0], [4.0, 1.0]]])
    ax.set(xlim=(-30, 40), ylim=(-6, 8))
    ax.set_axis_off()
    ax.figure.canvas.draw()
    ink = np.any(np.asarray(ax.figure.canvas.buffer_rgba())[..., :3] < 250, axis=2)  # type: ignore[attr-defined]
    rows, columns = np.flatnonzero(ink.any(axis=1)), np.flatnonzero(ink.any(axis=0))
    height = ink.shape[0]
    corners = ax.transData.inverted().transform([[columns[0], height - rows[-1]], [columns[-1], height - rows[0]]])
    half = np.sqrt(chi2_quantile(0.95, 2)) * np.array([10.0, 1.0])
    assert np.allclose(corners, [[3.0, 1.0] - half, [3.0, 1.0] + half], atol=0.02 * half.max())
    assert np.allclose((corners[1] - corners[0]) / (2 * half), 1.0, atol=0.03)


@pytest.mark.parametrize("P", [np.eye(3)[None], -np.eye(2)[None], np.full((1, 2, 2), np.nan)])
def test_impossible_ellipses_are_refused(P: np.ndarray) -> None:
    with pytest.raises(CovarianceError):
        ellipse_axes(P)
    with pytest.raises(CovarianceError, match="differ in number"):
        plot_ellipses(None, np.zeros((3, 2)), np.eye(2)[None])


def submaps() -> list[Submap]:
    rng = np.random.default_rng(0)
    out = []
    for k in range(9):
        positions = rng.normal(size=(5, 2)) * 10
        m = LandmarkMap(ids=np.arange(5), exit_pose=[10.0, 1.0, 0.7], positions=positions, covariance=0.1 * np.eye(13))
        path = Trajectory([0.0, 0.5, 1.0], [[0, 0, 0], [5, 0, 0.3], [10, 1, 0.7]]) if k % 2 else None
        out.append(Submap.from_landmarks(k, m, interval=(float(k), k + 1.0), trajectory=path))
    return out


def test_submap_chain_is_drawn_at_its_poses(tmp_path: Path) -> None:
    maps = submaps()
    poses = chain_poses(maps)
    assert np.allclose(poses[2], se2_compose(maps[0].exit_pose, maps[1].exit_pose))
    ax = rendered(plot_submap_chain(None, maps, landmark_ellipses=True, ellipse_scale=5.0), tmp_path)
    assert ax.get_aspect() == 1.0
    assert "exit, 95% ellipse × 5" in legend_of(ax)
    shifted = poses + [100.0, 0, 0]
    ax = rendered(plot_submap_chain(None, maps, shifted[:-1]), tmp_path)
    assert ax.get_xlim()[0] > 50.0
    first = next(l for l in ax.get_lines() if len(l.get_xdata()) == 2)
    assert np.allclose(first.get_xydata(), [[100.0, 0.0], [110.0, 1.0]])


def test_submap_chain_refuses_what_does_not_fit() -> None:
    with pytest.raises(DataError, match="no submaps"):
        plot_submap_chain(None, [])
    with pytest.raises(DataError, match="node poses"):
        plot_submap_chain(None, submaps(), np.zeros((3, 3)))


def judged(d2: np.ndarray) -> Consistency:
    return Consistency(quantity="pose", nees=d2, dof=np.array(3), gauge="first base fixed")


def test_consistency_curves_show_mean_and_bounds(rng: np.random.Generator, tmp_path: Path) -> None:
    d2 = rng.chisquare(3, size=(10, 20))
    curves = {"consistent": judged(d2), "bold": judged(9 * d2)}
    ax = rendered(plot_consistency(None, curves), tmp_path)
    assert ax.get_yscale() == "log"
    assert np.allclose(line(ax, "consistent")[:, 1], d2.mean(0) / 3)
    assert np.allclose(line(ax, "expected if consistent")[:, 1], 1.0)
    assert np.allclose(line(ax, "bold")[:, 1], 3 * d2.mean(0))
    assert "95% bounds, 10 runs" in legend_of(ax)
    assert "first base fixed" in ax.get_title()
    ci = rendered(plot_consistency(None, {"bold": judged(d2)}, figure="ci", submaps=np.arange(20) * 2), tmp_path)
    assert np.allclose(line(ci, "bold")[:, 1], d2.mean(0) / chi2_quantile(0.95, 3))
    assert np.array_equal(line(ci, "bold")[:, 0], np.arange(20) * 2)
    assert ci.get_yscale() == "linear"


def test_gps_residual_figure(log, tmp_path: Path) -> None:
    r = gps_residuals(log.truth.trajectory, log["gps"])
    ax = rendered(plot_gps_residuals(None, {"truth": r}), tmp_path)
    assert ax.get_xlabel() == "time [s]"
    assert "[m]" in ax.get_ylabel()
    assert f"RMSE {r.statistics.rmse:.2f} m" in legend_of(ax)[0]
    assert plot_gps_residuals(None, r).get_ylim()[1] > r.statistics.maximum


def test_gps_residual_figure_draws_no_line_over_a_pause(log) -> None:
    g = log["gps"]
    r = gps_residuals(log.truth.trajectory, g.take((g.times < 10) | (g.times > 30)))
    drawn = plot_gps_residuals(None, r).get_lines()[0].get_xydata()
    assert np.sum(np.isnan(drawn[:, 1])) == 1
    assert np.sum(~np.isnan(drawn[:, 1])) == len(r.times)


def test_comparison_bars_and_points(tmp_path: Path) -> None:
    rows = [{"method": "isam2", "s": 0.5, "h": 0.1}, {"method": "batch", "s": 0.02, "h": 0.001}]
    ax = rendered(plot_comparison(None, rows, "s", unit="s", errors="h", reference=(0.3, "limit")), tmp_path)
    assert ax.get_xlabel() == "s [s]"
    assert [p.get_width() for p in ax.patches] == [0.5, 0.02]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["isam2", "batch"]
    ax = rendered(plot_comparison(None, rows, "s", log=True, band=(0.1, 1.0, "fair"), label="time"), tmp_path)
    assert ax.get_xscale() == "log"
    assert ax.get_xlabel() == "time"


@pytest.mark.parametrize("log_axis", [False, True])
def test_a_method_without_a_figure_says_so(log_axis: bool) -> None:
    rows = [{"method": "eif", "s": 0.5}, {"method": "ekf", "s": None}]
    ax = plot_comparison(None, rows, "s", log=log_axis)
    assert "no figure" in [t.get_text() for t in ax.texts]


def test_comparison_refuses_unknown_columns() -> None:
    with pytest.raises(DataError, match="no column 'x'"):
        plot_comparison(None, [{"method": "a", "s": 1.0}], "x")
    with pytest.raises(DataError, match="no logarithmic axis"):
        plot_comparison(None, [{"method": "a", "s": -1.0}], "s", log=True)


def test_palette_is_distinct_also_for_the_colour_blind() -> None:
    """Machado et al. (2009), full severity: every pair of series colours stays apart in each kind of vision."""
    vision = {
        "common": np.eye(3),
        "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    }
    rgb = np.array([[int(c[k : k + 2], 16) / 255 for k in (1, 3, 5)] for c in style.CYCLE])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    for name, M in vision.items():
        seen = np.clip(linear @ np.asarray(M).T, 0, 1) ** (1 / 2.2)
        d = np.linalg.norm(seen[:, None] - seen[None], axis=2) + 9 * np.eye(len(seen))
        assert d.min() > 0.08, (name, np.unravel_index(d.argmin(), d.shape), d.min())
