"""Floor plans of worlds: what is drawn is what stands and what is driven there."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from graphslam.core.errors import ConfigError
from graphslam.sim.garage import garage
from graphslam.sim.mesh import MeshBuilder
from graphslam.sim.world import World
from tests.reference.plot_world import plot_world


def drawn(ax: plt.Axes) -> np.ndarray:
    """All wall lines ``(n, 2, 2)``."""
    parts = [c.get_segments() for c in ax.collections if isinstance(c, LineCollection)]
    return np.array([s for part in parts for s in part]).reshape(-1, 2, 2)


def way(ax: plt.Axes) -> np.ndarray:
    [line] = [x for x in ax.lines if x.get_label() == "way"]
    return np.column_stack(line.get_data())


def test_level_shows_its_own_walls_and_way() -> None:
    world = garage("A")
    plans = [plot_world(world, level=k) for k in (0, 1)]
    for level, ax in enumerate(plans):
        assert f"level {level}" in ax.get_title()
        assert ax.get_xlabel() == "x [m]"
        w = way(ax)
        on = ~np.isnan(w[:, 0])
        assert 0.2 < on.mean() < 0.8
    # the upper exit is a gap in the west wall of the upper level only
    for level, gap in ((0, False), (1, True)):
        s = drawn(plans[level])
        west = s[(np.abs(s[:, :, 0] + 0.15) < 1e-6).all(axis=1)]
        low, high = west[:, :, 1].min(axis=1), west[:, :, 1].max(axis=1)
        assert bool(((low < 28.0) & (high > 28.0)).any()) is not gap
    both = ~np.isnan(way(plans[0])[:, 0]) & ~np.isnan(way(plans[1])[:, 0])
    assert both.mean() < 0.1  # on the ramps at most
    plt.close("all")


def test_sections_follow_a_sloping_floor() -> None:
    """A box 1 m high on a floor 4 m up is cut although a section at one height would miss one of the two boxes."""
    mesh = MeshBuilder()
    mesh.ramp((0.0, 0.0, 0.0), (40.0, 0.0, 4.0), 8.0)
    mesh.box((1.0, 2.0, -1.0), (2.0, 3.0, 1.0))
    mesh.box((37.0, 2.0, 3.0), (38.0, 3.0, 4.8))
    v, t = mesh.build()
    points = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 4.0]])
    world = World(name="slope", vertices=v, triangles=t, waypoints=points, corner_radius=1.0, speed=1.0, meta={})
    s = drawn(plot_world(world, heights=(0.5,)))
    x = s[:, :, 0].mean(axis=1)
    assert ((x >= 1.0) & (x <= 2.0)).any()
    assert ((x >= 37.0) & (x <= 38.0)).any()
    assert np.isfinite(way(plt.gca())).all()
    with pytest.raises(ConfigError, match="no level 0"):
        plot_world(world, level=0)
    plt.close("all")
