"""Figures of a study: the curves are the table's figures, the bounds are those of a consistent estimator."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.plots import style
from graphslam_studies.plots.algorithms import _ALGORITHMS, algorithm_label, algorithm_line, in_order
from graphslam_studies.plots.study import (
    median_bounds,
    plot_ci,
    plot_error_band,
    plot_error_panels,
    plot_rms,
    plot_rms_panels,
)
from graphslam_studies.plots.study_figures import save_paper_figures
from graphslam_studies.plots.study_local import plot_local_consistency
from graphslam_studies.plots.study_table import algorithms_with
from graphslam_studies.plots.study_time import plot_cumulative_time
from tests.pictures import full_pictures
from tests.reference.study_rows import COLUMNS, study_rows


@pytest.fixture(autouse=True, scope="module")
def _full_pictures() -> Iterator[None]:
    with full_pictures():
        yield


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def study() -> tuple[pd.DataFrame, pd.DataFrame]:
    return study_rows(runs=12, submaps=40)


def line(ax: Axes, label: str) -> np.ndarray:
    return next(l for l in ax.get_lines() if str(l.get_label()).startswith(label)).get_xydata()


def legend_of(ax: Axes) -> list[str]:
    return [t.get_text() for t in ax.get_legend().get_texts()]


def band(ax: Axes) -> tuple[float, float]:
    """Vertical extent of the bounds of a consistent estimator."""
    patch = next(p for p in ax.patches if "bounds" in str(p.get_label()))
    box = patch.get_path().vertices if not hasattr(patch, "get_bbox") else patch.get_bbox().get_points()
    return float(box[:, 1].min()), float(box[:, 1].max())


@pytest.mark.parametrize("statistic", ["mean", "median"])
def test_ci_curves_are_the_statistic_over_the_runs(study, statistic: str) -> None:
    table, _ = study
    ax = plot_ci(None, table, "pose_nees", statistic=statistic)  # type: ignore[arg-type]
    rows = table[(table["algorithm"] == "rbpf-eif") & (table["quantity"] == "pose_nees")]
    expected = getattr(rows.groupby("submap")["value"], statistic)() / stats.chi2.ppf(0.95, 3)
    xy = line(ax, "RBPF-EIF")
    assert np.allclose(xy[:, 0], np.arange(40) + 1)
    assert np.allclose(xy[:, 1], expected)
    assert ax.get_yscale() == "log"  # the single particle filter explodes
    assert any("12 runs" in text for text in legend_of(ax))
    low, high = band(ax)
    consistent = line(ax, "default, online")[:, 1]
    assert np.mean((consistent > low) & (consistent < high)) > 0.8
    assert np.all(line(ax, "RBPF, one map")[-5:, 1] > 1e3 * high)


def test_bounds_of_mean_and_median_hold_as_often_as_they_say(rng: np.random.Generator) -> None:
    for runs in (5, 12, 21):
        d2 = rng.chisquare(3, (4000, runs))
        low, high = median_bounds(3, runs)
        middle = np.median(d2, axis=1)
        # an even number has its median between two order statistics: the bounds are then a little wide
        assert 0.94 < np.mean((middle > low) & (middle < high)) < 0.975
    t = pd.DataFrame(
        [("A", r, "a", k, "pose_nees", v) for k in range(300) for r, v in enumerate(rng.chisquare(3, 10))],
        columns=COLUMNS,
    )
    for statistic in ("mean", "median"):
        ax = plot_ci(None, t, statistic=statistic)  # type: ignore[arg-type]
        low, high = band(ax)
        y = line(ax, "a")[:, 1]
        assert 0.91 < np.mean((y > low) & (y < high)) < 0.985


def test_a_run_that_ended_early_is_reported_and_an_infinite_value_does_not_hide_it(study) -> None:
    table, _ = study
    own = table[(table["algorithm"] == "ekf") & (table["quantity"] == "pose_nees")]
    cut = own[~((own["run"] == 3) & (own["submap"] > 20))].copy()
    cut.loc[(cut["run"] == 4) & (cut["submap"] == 39), "value"] = np.inf
    ax = plot_ci(None, cut)
    assert "EKF, one map (2 of 12 runs not to the end)" in legend_of(ax)
    assert np.isfinite(line(ax, "EKF")[:, 1]).all()


def test_a_figure_is_of_one_world_and_of_what_is_there(study) -> None:
    table, _ = study
    both = pd.concat([table, table.assign(world="B")])
    with pytest.raises(DataError, match="of one world; got A, B"):
        plot_ci(None, both)
    with pytest.raises(DataError, match="no 'seconds_x'"):
        algorithms_with(table, "seconds_x", online=True)
    assert algorithms_with(table, "feature_nees", online=True)[:2] == ["ekf", "rbpf"]


def test_error_band_counts_what_lies_outside() -> None:
    error, sigma = np.array([0.0, 2.9, -3.1, 7.0]), np.ones(4)
    ax = plot_error_band(None, np.arange(4), error, sigma, label="error of x")
    assert np.array_equal(line(ax, "outside"), [[2, -3.1], [3, 7.0]])
    assert "outside (50%)" in legend_of(ax)
    assert ax.get_ylabel() == "error of x [m]"
    with pytest.raises(DataError, match="none negative"):
        plot_error_band(None, np.arange(4), error, -sigma)


def test_error_panels_show_one_run_in_metres_and_degrees(study) -> None:
    table, _ = study
    axes = plot_error_panels(table, "default-online", run=5)
    own = table[(table["run"] == 5) & (table["algorithm"] == "default-online")]
    heading = own[own["quantity"] == "error_heading"].sort_values("submap")["value"]
    assert np.allclose(line(axes[2], "error")[:, 1], np.degrees(heading))
    assert axes[0].get_title() == "default, online, run 5"
    assert "RBPF-EIF" in plot_error_panels(table)[0].get_title()
    with pytest.raises(DataError, match="no run 99"):
        plot_error_panels(table, "ekf", run=99)
    with pytest.raises(DataError, match="of 'nobody'"):
        plot_error_panels(table, "nobody")


def test_rms_marks_mean_and_median_of_the_runs(study) -> None:
    table, _ = study
    ax = plot_rms(None, table, "heading_rms", algorithms=["ekf", "default-online"], factor=180 / np.pi, unit="°")
    v = np.degrees(table[(table["algorithm"] == "ekf") & (table["quantity"] == "heading_rms")]["value"])
    assert np.allclose(line(ax, "median")[:, 0], v.median())
    means = [l.get_xdata()[0] for l in ax.get_lines() if l.get_marker() == "D" and len(l.get_xdata())]
    assert any(np.isclose(m, v.mean()) for m in means)
    assert [t.get_text() for t in ax.get_yticklabels()] == ["default, online", "EKF, one map"]
    assert len(ax.collections[0].get_offsets()) == 12
    assert len(plot_rms_panels(table)) == 3


def test_an_algorithm_without_a_figure_says_so_in_its_row(study) -> None:
    table, _ = study
    lost = table.copy()
    lost.loc[(lost["algorithm"] == "rbpf") & (lost["run"] < 3), "value"] = np.nan
    ax = plot_rms(None, lost, algorithms=["rbpf", "absent"])
    assert {t.get_text() for t in ax.texts} == {"3 without a figure", "no figure"}


def test_time_is_the_median_and_the_tree_a_level(study) -> None:
    _, timings = study
    ax = plot_cumulative_time(None, timings, algorithms=["ekf", "rbpf-eif", "rbpf-eif-tree"], log=False)
    ekf = timings[(timings["algorithm"] == "ekf")].groupby("submap")["value"].median()
    assert np.allclose(line(ax, "EKF")[:, 1], ekf)
    total = timings[timings["algorithm"] == "rbpf-eif-tree"]["value"].median()
    assert np.allclose(line(ax, "RBPF-EIF, tree, all at once")[:, 1], total)
    assert ax.get_ylim()[0] == 0.0


def test_local_map_histogram_has_the_area_and_the_density_it_should(study) -> None:
    table, _ = study
    ax = plot_local_consistency(None, table)
    widths = None
    for patch in ax.patches:
        if not hasattr(patch, "get_data"):
            continue
        density, edges, _ = patch.get_data()
        widths = np.diff(np.log(edges))
        assert 0.97 < np.sum(density * widths) <= 1.0 + 1e-9
    assert widths is not None
    shade = ax.collections[0].get_paths()[0].vertices
    x, f = shade[:, 0], shade[:, 1]
    upper = f > 0
    order = np.argsort(x[upper])
    assert np.trapezoid(f[upper][order], np.log(x[upper][order])) == pytest.approx(1.0, abs=0.02)
    text = " ".join(legend_of(ax))
    assert "RBPF, smoothed (default): mean 1" in text
    assert "RBPF, moments (paper): mean 1.2" in text
    bad = table[~((table["quantity"] == "local_joint_dof") & (table["submap"] == 3))]
    with pytest.raises(DataError, match="degrees of freedom"):
        plot_local_consistency(None, bad, algorithms=["local-ekf"])


def test_known_algorithms_look_different_and_unknown_ones_are_drawn() -> None:
    looks = [tuple(algorithm_line(n).values()) for n in _ALGORITHMS if not n.startswith("local")]
    assert len(set(looks)) == len(looks)
    assert algorithm_label("mine") == "mine"
    assert algorithm_line("mine", 3) == style.line(3)
    assert in_order(["zebra", "rbpf", "ekf", "mine"]) == ["ekf", "rbpf", "mine", "zebra"]


def test_paper_figures_of_every_world_and_only_of_what_is_there(study, tmp_path: Path) -> None:
    table, timings = study
    both = [pd.concat([t[t["run"] < 3], t[t["run"] < 2].assign(world="C")]) for t in study]
    names = {p.name for p in save_paper_figures(*both, tmp_path)}
    for world in "AC":
        for name in ("fig5-errors-rbpf-eif", "fig6-pose-mean", "fig6-features-median", "fig7-rms", "fig8-joining",
                     "fig9-time", "local-maps"):  # fmt: skip
            assert f"{name}-{world}.png" in names
    assert all((tmp_path / n).stat().st_size > 5_000 for n in names)
    assert not plt.get_fignums()
    poses = table[(table["quantity"] == "pose_nees") & (table["run"] < 2)]
    few = {p.name for p in save_paper_figures(poses, timings.iloc[:0], tmp_path)}
    assert few == {"fig6-pose-mean-A.png", "fig6-pose-median-A.png"}
