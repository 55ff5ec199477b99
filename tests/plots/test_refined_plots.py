"""A path before and after its refinement, drawn."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from graphslam.core.trajectory import Trajectory
from graphslam.plots.paths import GRAPH, plot_paths
from graphslam.plots.refined import plot_before_after, plot_yaw_bias

T = 0.5 * np.arange(60)
TRUE = np.column_stack([0.4 * T, np.sin(0.2 * T), np.zeros(60)])


def path(amplitude: float, sigma: float | None = None) -> Trajectory:
    """The true one with a wave across it."""
    poses = TRUE + np.column_stack([np.zeros(60), amplitude * np.sin(T), np.zeros(60)])
    return Trajectory(T, poses, None if sigma is None else np.tile(sigma**2 * np.eye(3), (60, 1, 1)))


def test_errors_of_both_paths_and_the_sigma_that_is_claimed() -> None:
    ax = plot_before_after(None, path(0.4), path(0.02, sigma=0.03), truth=path(0.0))
    lines = {str(x.get_label()): np.asarray(x.get_ydata()) for x in ax.lines}
    graph, refined, sigma = lines.values()
    first, second, _ = lines
    assert first.startswith("graph, RMS 0.2")
    assert second.startswith("refined, RMS 0.01")
    assert graph.max() > 10 * refined.max()
    np.testing.assert_allclose(sigma, np.sqrt(2) * 0.03)
    plt.close(ax.figure)


def test_without_truth_it_is_how_far_the_path_moved() -> None:
    ax = plot_before_after(None, path(0.4), path(0.0))
    (line,) = ax.lines
    assert 0.1 < np.asarray(line.get_ydata()).max() < 0.5
    assert ax.get_ylabel() == "distance [m]"
    plt.close(ax.figure)


def test_bias_at_its_knots_in_mrad() -> None:
    ax = plot_yaw_bias(None, [(10.0, 1e-3), (40.0, -2e-3)])
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [(0.0, 1.0), (30.0, -2.0)])
    plt.close(ax.figure)


def test_the_path_of_the_graph_is_below_the_result() -> None:
    ax = plot_paths(None, {"run": path(0.0), GRAPH: path(0.4)})
    z = {x.get_label(): x.get_zorder() for x in ax.lines}
    assert z[GRAPH] < z["run"]
    plt.close(ax.figure)
