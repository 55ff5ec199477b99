"""Storeys and cuts of fused maps show the voxels that are there."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import UNKNOWN
from graphslam.plots.evidence import probability
from graphslam.plots.fused_map import cut_plane, plot_cut, plot_storey, slab
from tests.reference.small_maps import scanned


def path(points: list[tuple[float, float, float]]) -> Trajectory:
    """Level poses through points, every 0.1 m or so."""
    p = np.array(points)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    at = np.arange(0.0, s[-1], 0.1)
    xyz = np.column_stack([np.interp(at, s, p[:, k]) for k in range(3)])
    return Trajectory(at, np.column_stack([xyz, np.tile([0.0, 0, 0, 1], (len(at), 1))]))


@pytest.mark.parametrize("axis", [0, 1])
def test_slab_is_the_most_occupied_voxel_across_it(rng: np.random.Generator, axis: int) -> None:
    grid = scanned(rng, 3)
    p, (left, right, bottom, top) = slab(grid, axis, -0.5, 0.75)
    size = grid.voxel_size
    u = left + size * (np.arange(round((right - left) / size)) + 0.5)
    w = bottom + size * (np.arange(round((top - bottom) / size)) + 0.5)
    assert p.shape == (len(w), len(u))
    best = np.full(p.shape, UNKNOWN, np.int16)
    for across in np.arange(-0.5 + size / 2, 0.75, size):
        points = np.zeros((len(w), len(u), 3))
        points[..., 1 - axis], points[..., axis], points[..., 2] = u[None], across, w[:, None]
        best = np.maximum(best, grid.values_at(points.reshape(-1, 3)).reshape(p.shape))
    np.testing.assert_array_equal(p, probability(best))
    assert np.isfinite(p).sum() > 50


def test_the_cut_goes_through_the_ramp() -> None:
    ramp = path([(0, 0, 0), (10, 0, 0), (30, 5, 0), (50, 5, 3.5), (10, 9, 3.5)])
    axis, at = cut_plane(ramp)
    assert axis == 1
    assert at == pytest.approx(5.0)
    assert cut_plane(path([(0, 0, 0), (1, 8, 0), (3, 20, 0)]))[0] == 0


def test_pictures(rng: np.random.Generator) -> None:
    grid = scanned(rng, 3)
    driven = path([(-1, 0, 0), (1, 0, 0), (1, 1, 0)])
    ax = plot_storey(grid, -0.5, 1.0, path=driven, title="a storey")
    assert np.isfinite(ax.lines[0].get_ydata()).all()
    plt.close(ax.figure)
    ax = plot_storey(grid, -0.5, 1.0, path=driven.transformed(np.array([0, 0, 5.0, 0, 0, 0, 1])))
    assert not np.isfinite(ax.lines[0].get_ydata()).any()  # of another storey
    plt.close(ax.figure)
    ax = plot_cut(grid, driven)
    assert ax.get_xlabel() == "x [m]"
    cloud, (_, at) = grid.occupied_cloud(), cut_plane(driven)
    z = cloud[np.abs(cloud[:, 1] - at) < 1.0, 2]
    assert ax.get_ylim() == pytest.approx((z.min() - 0.5, z.max() + 0.5), abs=grid.voxel_size)
    plt.close(ax.figure)
    with pytest.raises(DataError, match="plane"):
        plot_cut(grid, Trajectory(np.array([0.0, 1.0]), np.zeros((2, 3))))
    with pytest.raises(ConfigError, match="slab"):
        slab(EvidenceGrid(0.2), 0, 1.0, 1.0)
