"""Exits of segments: ellipses of the claimed size about the claimed place, scores of every segment."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.submap import Submap
from graphslam_studies.evaluate.exit_nees import ExitNees
from graphslam_studies.plots.segment_exits import plot_exit_nees, plot_segment_exit


def ending(sigma: float) -> Submap:
    return Submap(
        key=0, interval=(0.0, 1.0), exit_pose=np.array([2.0, 1.0, 0.4]), exit_covariance=np.diag([sigma**2] * 3)
    )  # fmt: skip


def test_exit_shows_every_particle_and_each_covariance() -> None:
    exits = np.array([[2.0, 1.0, 0.4], [2.1, 1.0, 0.4], [2.0, 1.1, 0.4]])
    weights = np.array([0.5, 0.25, 0.25])
    both = {"wide": ending(0.5), "narrow": ending(0.01)}
    ax = plot_segment_exit(None, both, exits=exits, weights=weights, truth=np.array([2.3, 1.2, 0.4]))
    wide, narrow = (c for c in ax.collections if isinstance(c, EllipseCollection))
    np.testing.assert_allclose(wide.get_widths() / narrow.get_widths(), 50.0)
    np.testing.assert_allclose(wide.get_widths(), 2.0 * np.sqrt(chi2_quantile(0.95, 2)) * 0.5)
    np.testing.assert_allclose(wide.get_offsets(), [[2.0, 1.0]])
    dots = ax.collections[0]
    np.testing.assert_allclose(dots.get_offsets(), exits[:, :2])
    assert dots.get_sizes()[0] == pytest.approx(2.0 * dots.get_sizes()[1])
    low, high = ax.get_xlim()
    assert low < 2.0 - 0.5 * wide.get_widths()[0]  # nothing is cut off
    assert high > 2.0 + 0.5 * wide.get_widths()[0]
    with pytest.raises(DataError, match="no submap"):
        plot_segment_exit(None, {})
    plt.close("all")


def test_scores_of_all_segments_are_there_and_those_inside_counted() -> None:
    consistent, sure = np.array([2.0, 4.0, 20.0]), np.array([400.0, 4000.0, 3.0])
    scores = {n: ExitNees(v, 4, np.zeros((3, 4))) for n, v in (("consistent", consistent), ("sure", sure))}
    ax = plot_exit_nees(None, scores)
    points = [line for line in ax.lines if line.get_marker() not in ("None", "")]
    np.testing.assert_allclose(points[0].get_ydata(), consistent / 4)
    np.testing.assert_allclose(points[1].get_ydata(), sure / 4)
    labels = [t.get_text() for t in ax.get_legend().get_texts()]
    assert "consistent: mean 2.2, 2 of 3 inside" in labels
    assert "sure: mean 366.9, 1 of 3 inside" in labels
    band = ax.patches[0]
    low, high = band.get_y(), band.get_y() + band.get_height()
    assert low == pytest.approx(chi2_quantile(0.025, 4) / 4)
    assert high == pytest.approx(chi2_quantile(0.975, 4) / 4)
    for bad in (
        {},
        {"a": ExitNees(np.zeros(0), 4, np.zeros((0, 4)))},
        {"a": scores["sure"], "b": ExitNees(sure[:1], 4, sure)},
    ):
        with pytest.raises(DataError, match="no exits"):
            plot_exit_nees(None, bad)
    plt.close("all")
