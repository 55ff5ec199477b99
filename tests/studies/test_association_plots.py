"""Figures without truth and of the association study show the numbers that they were given."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.core.errors import DataError
from graphslam.evaluate.gps_innovation import GpsInnovations
from graphslam.evaluate.loop_consistency import LandmarkLoops, loop_consistency
from graphslam.plots.residual_consistency import plot_innovations, plot_loop_matrix
from graphslam_studies.plots.association import plot_runs


def loops_of(errors: np.ndarray) -> LandmarkLoops:
    n = len(errors)
    return LandmarkLoops(
        a=np.arange(n),
        b=np.arange(n) + 5,
        shared=np.full(n, 3),
        errors=errors,
        covariance=np.eye(3 * n),
        shape_chi2=np.full(n, 3.0),
        shape_dof=np.full(n, 3),
    )


def test_loop_matrix_shows_each_pair_in_units_of_its_dof(rng):
    errors = rng.standard_normal((6, 3))
    errors[4] = 30.0
    found = loop_consistency(loops_of(errors))
    ax = plot_loop_matrix(None, found)
    image = ax.images[0].get_array()
    assert image.shape == (6, 6)
    assert image[1, 2] == pytest.approx(np.clip(np.sum((errors[1] - errors[2]) ** 2) / 2 / 3, 1e-2, 1e2))
    assert image[0, 0] == pytest.approx(np.clip(np.sum(errors[0] ** 2) / 3, 1e-2, 1e2))
    assert np.all(image[4] == 1e2)  # the false loop is a cross
    assert [t.get_text() for t in ax.get_xticklabels()] == [f"{a}–{a + 5}" for a in range(6)]
    assert "overconfident" in ax.get_title()


def test_innovations_show_every_fix_and_the_mean_with_its_bounds(rng):
    gps = GpsInnovations(
        times=100.0 + np.arange(50.0),
        innovations=2.0 * rng.standard_normal((50, 2)),
        covariance=4.0 * np.eye(100),
        unpredicted=0,
    )
    ax = plot_innovations(None, gps)
    fixes = next(line for line in ax.lines if line.get_label() == "withheld fix")
    assert np.allclose(fixes.get_xdata(), np.arange(50.0))
    assert np.allclose(fixes.get_ydata(), np.sum(gps.innovations**2, axis=1) / 4.0)
    mean = next(line for line in ax.lines if line.get_label().startswith("mean"))
    assert mean.get_ydata()[0] == pytest.approx(np.mean(gps.nis))
    band = ax.patches[0].get_extents().transformed(ax.transData.inverted())
    row = gps.tests()[0]
    assert (band.y0, band.y1) == pytest.approx((2 * row["low"], 2 * row["high"]))


def test_runs_are_points_and_their_median_a_bar():
    rows = [("w", run, name, v + run) for name, v in (("b", 10.0), ("a", 1.0)) for run in range(5)]
    rows += [("v", run, "a", 3.0) for run in range(5)]
    table = pd.DataFrame(rows, columns=["world", "run", "algorithm", "value"])
    ax = plot_runs(table, label="figure")
    panels = ax.figure.axes
    assert [p.get_title() for p in panels] == ["w (5 runs)", "v (5 runs)"]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["b", "a"]  # in the order given
    points = [line for line in ax.lines if line.get_marker() == "."]
    assert sorted(points[0].get_xdata()) == [10.0, 11.0, 12.0, 13.0, 14.0]
    assert abs(np.mean(points[0].get_ydata())) < 0.3
    medians = [line.get_xdata()[0] for line in ax.lines if line.get_color() == "#000000" and len(line.get_xdata()) == 2]
    assert medians[:2] == [12.0, 3.0]
    assert ax.get_xscale() == "linear"
    table.loc[0, "value"] = 1e4
    assert plot_runs(table, label="figure").get_xscale() == "log"
    with pytest.raises(DataError, match="no runs"):
        plot_runs(table[:0], label="figure")
