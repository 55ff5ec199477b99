"""Paths and their ellipses stand in the axes of the figure, whatever way the body looks."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import se2_compose, se2_exp
from graphslam.core.poses import position_covariances
from graphslam.core.trajectory import Trajectory
from graphslam.plots.paths import plot_paths


def straight(n: int = 11, *, covariance: bool = True) -> Trajectory:
    """Ten metres north, facing north; known to 0.1 m along and 0.5 m across."""
    poses = np.zeros((n, 7))
    poses[:, 1] = np.linspace(0.0, 10.0, n)
    poses[:, 5] = poses[:, 6] = np.sqrt(0.5)  # 90° to the left
    C = np.broadcast_to(np.diag([1e-4, 1e-4, 1e-4, 0.1**2, 0.5**2, 0.2**2]), (n, 6, 6))
    return Trajectory(np.arange(float(n)), poses, C if covariance else None)


@pytest.mark.parametrize("dim", [2, 3])
def test_covariances_of_positions_are_those_of_samples(dim: int) -> None:
    rng = np.random.default_rng(dim)
    d = 3 if dim == 2 else 6
    A = 0.02 * rng.normal(size=(d, d))
    C = A @ A.T + 1e-6 * np.eye(d)
    xi = rng.multivariate_normal(np.zeros(d), C, size=40_000)
    if dim == 2:
        pose = np.array([3.0, -2.0, 2.2])
        at = se2_compose(np.broadcast_to(pose, (len(xi), 3)), se2_exp(xi))[:, :2]
    else:
        pose = se3.se3_exp(np.array([0.3, -0.4, 2.0, 1.0, 2.0, 3.0]))
        at = se3.se3_compose(np.broadcast_to(pose, (len(xi), 7)), se3.se3_exp(xi))[:, :3]
    P = position_covariances(pose[None], C[None])[0]
    # 40,000 samples: entries good to 1 %, and the exponential map bends them by less
    np.testing.assert_allclose(np.cov(at.T), P, atol=0.05 * P.diagonal().max())
    assert not np.allclose(P, C[-dim:, -dim:] if dim == 3 else C[:2, :2], atol=0.05 * P.diagonal().max())


def test_ellipses_lie_across_a_path_that_is_unsure_across() -> None:
    path = straight()
    ax = plot_paths(None, {"dead reckoning": path, "RBPF": straight(covariance=False)}, truth=path, ellipses=4)
    [ellipses] = [c for c in ax.collections if isinstance(c, EllipseCollection)]
    at = np.asarray(ellipses.get_offsets())
    assert len(at) == 4
    np.testing.assert_allclose(at[-1], [0.0, 10.0])
    scale = 2.0 * np.sqrt(chi2_quantile(0.95, 2))
    np.testing.assert_allclose(ellipses.get_widths(), scale * 0.5)
    np.testing.assert_allclose(ellipses.get_heights(), scale * 0.1)
    angles = np.radians(ellipses.get_angles())
    np.testing.assert_allclose(np.abs(np.cos(angles)), 1.0)  # along x: across the path
    labels = [t.get_text() for t in ax.get_legend().get_texts()]
    assert labels == ["truth", "dead reckoning", "95 % ellipses of dead reckoning", "RBPF"]
    side = plot_paths(None, {"p": path}, plane="yz", ellipses=1)
    [ellipses] = [c for c in side.collections if isinstance(c, EllipseCollection)]
    np.testing.assert_allclose(ellipses.get_widths(), scale * 0.2)
    assert side.get_ylabel() == "z [m]"
    plt.close("all")


def test_impossible_paths_are_refused() -> None:
    flat = Trajectory(np.arange(3.0), np.zeros((3, 3)))
    with pytest.raises(DataError, match="no paths"):
        plot_paths(None, {})
    with pytest.raises(DataError, match="no paths"):
        plot_paths(None, {"flat": flat}, plane="xz")
    with pytest.raises(ConfigError, match="plane"):
        plot_paths(None, {"flat": flat}, plane="yx")
    plt.close("all")
