"""Figures of an RBPF run: every edge of the tree is drawn, those that died out in another colour."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from frontends.grid_config import GridFilterConfig
from frontends.rbpf_grid import RbpfResult, run_rbpf
from graphslam.core.random import SeedTree
from graphslam.plots.particles import plot_ancestry, plot_effective
from tests.frontends.grid_world import ring


@pytest.fixture(scope="module")
def result() -> RbpfResult:
    config = GridFilterConfig(particles=6, voxel_size=0.2, heading_walk=0.02)
    return run_rbpf(ring(2, 2, length=16.0, beams=40), config, SeedTree(0), prune_every=0)


def test_ancestry_shows_every_edge(result: RbpfResult) -> None:
    _, ax = plt.subplots()
    assert plot_ancestry(result, ax, segment_boundaries=[4.0, 9.0], title="tree") is ax
    drawn = [c for c in ax.collections if isinstance(c, LineCollection)]
    edges, alive = result.ancestry.links()
    assert sorted(len(c.get_segments()) for c in drawn) == sorted([int(alive.sum()), int((~alive).sum())])
    assert len(edges) == 6 * (len(result.times) - 1)
    ends = np.array([s[1] for c in drawn for s in c.get_segments()])
    assert set(np.round(ends[:, 0], 6)) == set(np.round(result.times[1:], 6))
    dashed = [line for line in ax.get_lines() if line.get_linestyle() == "--"]
    assert sorted(float(line.get_xdata()[0]) for line in dashed) == [4.0, 9.0]
    plt.close("all")


def test_effective_shows_every_step_and_every_resampling(result: RbpfResult) -> None:
    ax = plot_effective(result, None)
    by_label = {line.get_label().split(" (")[0]: line for line in ax.get_lines()}
    assert np.array_equal(by_label["effective, before resampling"].get_ydata(), result.effective)
    assert len(by_label["resampled"].get_xdata()) == result.tally.resamplings > 0
    assert np.array_equal(by_label["ancestors of the last particles"].get_ydata(), result.ancestry.survivors())
    plt.close("all")


def test_a_single_particle_and_a_single_step_can_be_drawn() -> None:
    for length in (0.3, 3.0):
        one = run_rbpf(ring(0, 2, length=length, beams=8), GridFilterConfig(particles=1), SeedTree(0))
        plot_ancestry(one, None)
        plot_effective(one, None)
    plt.close("all")
