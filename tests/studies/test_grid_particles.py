"""Figures of RBPF and SegSLAM runs: every edge of the tree is drawn, those that died out in another colour."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from graphslam.core.errors import DataError
from graphslam.core.random import SeedTree
from graphslam_frontends.grid.config import GridFilterConfig
from graphslam_frontends.segslam.config import SegmentationConfig, SegSlamConfig
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_studies.frontends.rbpf_grid import RbpfResult, run_rbpf
from graphslam_studies.plots.particles import plot_ancestry, plot_effective, plot_pasts
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


def test_ancestry_of_segments_begins_where_it_is_asked_to_and_their_pasts_are_counted(result: RbpfResult) -> None:
    steps = ring(2, 2, length=16.0, beams=40)
    often = SegmentationConfig(period=8.0, window=0.8, min_seconds=2.0, min_length=1.0, excluded=1.0)
    segslam = run_segslam(
        steps, GridFilterConfig(particles=6), SegSlamConfig(segmentation=often), SeedTree(0), prune_every=0
    )
    ends = [float(steps.times[b.step]) for b in segslam.boundaries[:-1]]
    assert ends
    ax = plot_ancestry(segslam, None, ends, since=float(steps.times[0]) + 5.0)
    assert ax.get_xlim() == pytest.approx((5.0, float(steps.times[-1] - steps.times[0])))
    drawn = [c for c in ax.collections if isinstance(c, LineCollection)]
    assert sum(len(c.get_segments()) for c in drawn) == 6 * (len(steps) - 1)

    ax = plot_pasts(result, segslam, None)
    intervals = segslam.segmap.intervals()
    counts = [len(segslam.segmap.in_interval((int(a), int(b)))) for a, b in intervals]
    flat = [line for line in ax.lines if len(line.get_xdata()) == 2 and line.get_linestyle() == "-"]
    assert [int(line.get_ydata()[0]) for line in flat] == counts
    np.testing.assert_array_equal(ax.lines[-1].get_ydata(), result.ancestry.survivors())
    ways = next(t.get_text() for t in ax.get_legend().get_texts() if "ways" in t.get_text())
    assert (f"{np.prod(counts):,} ways" in ways) == (np.prod(counts) < 1e5)
    short = run_rbpf(ring(2, 2, length=3.0, beams=8), GridFilterConfig(particles=1), SeedTree(0))
    with pytest.raises(DataError, match="different steps"):
        plot_pasts(short, segslam, None)
    plt.close("all")


def test_a_single_particle_and_a_single_step_can_be_drawn() -> None:
    for length in (0.3, 3.0):
        one = run_rbpf(ring(0, 2, length=length, beams=8), GridFilterConfig(particles=1), SeedTree(0))
        plot_ancestry(one, None)
        plot_effective(one, None)
    plt.close("all")
