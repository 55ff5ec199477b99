"""Worlds, clouds, surfaces and terrain: what is drawn is what is there, and the way where it is seen."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.maps.terrain.pyramid import TerrainMap
from graphslam.plots.surface import plot_surface
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.world import World
from graphslam_studies.plots.solid import ViewDirection, plot_cloud, plot_solid
from graphslam_studies.plots.terrain import plot_bands


def boxes() -> World:
    """A floor, a tower of 3 m beside the way, and a lid at 4 m over everything."""
    mesh = MeshBuilder()
    mesh.slab((-4.0, -4.0, 14.0, 4.0), 0.0)
    mesh.slab((-4.0, -4.0, 14.0, 4.0), 4.3, thickness=0.3)
    mesh.box((4.0, -2.0, 0.0), (6.0, -1.0, 3.0))
    v, t = mesh.build()
    route = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    return World(name="boxes", vertices=v, triangles=t, waypoints=route, corner_radius=1.0, speed=1.0, meta={})


def picture(ax: plt.Axes) -> tuple[np.ndarray, np.ndarray]:
    """Colours, and the coordinates of the pixels ``(rows, columns, 2)``."""
    [image] = ax.get_images()
    a = np.asarray(image.get_array())
    left, right, low, high = image.get_extent()
    u, v = np.linspace(left, right, a.shape[1]), np.linspace(low, high, a.shape[0])
    return a, np.stack(np.meshgrid(u, v), axis=-1)


def test_views_keep_lengths_and_point_the_right_way() -> None:
    view = ViewDirection(azimuth=-np.pi / 2, elevation=np.pi / 2)  # from straight above, north up
    np.testing.assert_allclose(view.project([[1.0, 2.0, 7.0]]), [[1.0, 2.0]], atol=1e-12)
    axes = ViewDirection(azimuth=0.7, elevation=0.4).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)  # not a mirror image
    assert axes[1, 2] > 0  # up is up
    for bad in (0.0, 2.0, np.nan):
        with pytest.raises(ConfigError, match="elevation"):
            ViewDirection(elevation=bad)


def test_the_lid_comes_off_and_the_tower_stands_where_it_is() -> None:
    view = ViewDirection(azimuth=-np.pi / 2, elevation=np.pi / 2)
    cut = plot_solid(boxes(), below=3.5, view=view, margin=3.0, pixels=160, route=False)
    a, at = picture(cut)
    tower = (at[..., 0] > 4.2) & (at[..., 0] < 5.8) & (at[..., 1] > -1.8) & (at[..., 1] < -1.2)
    floor = (at[..., 1] > 0.5) & (at[..., 1] < 2.5) & (at[..., 0] > -2.0) & (at[..., 0] < 12.0)
    assert a[tower][:, :3].mean() < a[floor][:, :3].mean() - 0.1  # darker: higher
    assert np.ptp(a[floor][:, :3], axis=0).max() < 0.02  # one flat floor
    lid, at = picture(plot_solid(boxes(), below=4.5, view=view, margin=3.0, pixels=160, route=False))
    inside = (np.abs(at[..., 1]) < 2.5) & (at[..., 0] > -2.5) & (at[..., 0] < 12.5)
    assert np.ptp(lid[inside][:, :3], axis=0).max() < 0.02  # nothing but the lid
    plt.close("all")


def test_the_way_is_dotted_where_something_hides_it() -> None:
    """From the south, 45° up, a tower of 3 m whose north side is at y = -1 hides the ground behind it to y = 2."""
    view = ViewDirection(azimuth=-np.pi / 2, elevation=np.pi / 4)
    ax = plot_solid(boxes(), below=3.5, view=view, pixels=120)
    dotted, seen = (np.column_stack(line.get_data()) for line in ax.lines[:2])
    hidden = np.isfinite(dotted[:, 0])
    assert np.array_equal(~hidden, np.isfinite(seen[:, 0]))
    x = np.arange(len(hidden)) * 0.25
    inner, outer = (x > 4.3) & (x < 5.7), (x < 3.7) | (x > 6.3)
    assert hidden[inner].all()
    assert not hidden[outer].any()
    assert {t.get_text() for t in ax.get_legend().get_texts()} == {"start", "end"}
    with pytest.raises(DataError, match="nothing below the cut"):
        plot_solid(boxes(), below=-5.0)
    plt.close("all")


def test_clouds_are_drawn_far_to_near_and_refused_if_broken() -> None:
    rng = np.random.default_rng(0)
    p = rng.normal(size=(50, 3))
    view = ViewDirection(azimuth=0.3, elevation=0.5)
    ax = plot_cloud(p, view=view)
    dots = ax.collections[0]
    order = np.argsort(p @ view.axes[2])
    np.testing.assert_allclose(dots.get_offsets(), view.project(p)[order])
    np.testing.assert_allclose(dots.get_array(), p[order, 2])
    line = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    own = rng.uniform(size=(50, 4))
    both = plot_cloud(p, view=view, path=line, colours=own)
    np.testing.assert_allclose(both.collections[0].get_facecolors(), own[order])
    np.testing.assert_allclose(both.lines[-1].get_xydata(), view.project(line))
    with pytest.raises(DataError, match="colours"):
        plot_cloud(p, colours=own[:9])
    for bad in (np.zeros((0, 3)), np.zeros((3, 2)), np.full((2, 3), np.nan)):
        with pytest.raises(DataError, match="no cloud"):
            plot_cloud(bad)
    plt.close("all")


def test_edges_of_a_surface_are_its_folds_and_its_rim() -> None:
    """A flat square with a flat roof 2 m above its middle: lines there, none inside the flats, and no scale."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.0, 8.01, 0.1), np.arange(0.0, 8.01, 0.1), indexing="ij"))
    n = 81
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    z = np.where((np.abs(x - 4.0) < 2.0) & (np.abs(y - 4.0) < 2.0), 2.0, 0.0)
    ax = plot_surface(np.column_stack([x, y, z]), triangles, z, edges=True, slant=0.0)
    image, at = picture(ax)
    black = image[..., 0] < 0.5
    at = at - at[0, 0]
    off = np.maximum(np.abs(at[..., 0] - 4.0), np.abs(at[..., 1] - 4.0))  # distance from the middle, by squares
    assert black[(off > 1.7) & (off < 2.2)].mean() > 0.2
    assert not black[off < 1.5].any()
    assert not black[(off > 2.4) & (off < 3.6)].any()
    assert len(ax.figure.axes) == 1  # no scale of a value that is not shown
    assert len(plot_surface(np.column_stack([x, y, z]), triangles, z).figure.axes) == 2
    plt.close("all")


def test_bands_of_a_pyramid_are_named_with_their_share() -> None:
    band = np.full((4, 5), -1, np.int8)
    band[:2, :3], band[2:, 3:] = 0, 1
    known = np.where(band >= 0, 0.1, np.nan)
    zero = np.zeros((4, 5))
    found = TerrainMap(np.array([-1.0, 2.0]), 0.5, known, np.zeros((4, 5), np.int8), zero, zero, band, zero > 0)
    ax = plot_bands(found, (0.5, 1.0), place=(0.0, 3.0))
    labels = [t.get_text() for t in ax.get_legend().get_texts()]
    assert labels == ["cells of 0.5 m (30%)", "cells of 1 m (20%)", "vehicle"]
    shown = ax.get_images()[0].get_array()
    np.testing.assert_array_equal(np.ma.filled(shown, -1), band)
    assert tuple(ax.get_images()[0].get_extent()) == (-1.0, 1.5, 2.0, 4.0)
    with pytest.raises(DataError, match="without a width"):
        plot_bands(found, (0.5,))
    plt.close("all")
