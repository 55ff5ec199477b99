"""Figures of a SegMap: every viable segment in its interval, the sample's segments and their depth, scores in place."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba

from graphslam.core.errors import DataError
from graphslam.plots import style
from graphslam_frontends.segslam.sampling import grow_sample, root_of_segment
from graphslam_frontends.segslam.segmap import SegMap, SegmentEntry
from graphslam_studies.plots.segmap import plot_expansion, plot_score_map, plot_segmap
from graphslam_studies.plots.segments import sample_paths
from tests.reference.segmap_twin import flat_grid, match_entry, small_segmap, straight


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


def two_particles() -> SegMap:
    """Two intervals with two segments each; in a third both particles are back in the first map."""
    m = small_segmap(7, 2)
    for k in range(2):
        m.open(2 * k, [SegmentEntry(T_entry=np.zeros(3))] * 2)
        paths = [straight(np.zeros(3), 2.0, 2), straight(np.zeros(3), 2.1 + 0.1 * k, 2)]
        m.close(2 * k + 2, [flat_grid(), flat_grid()], paths)
    back = np.array([1.9, 2.1, np.pi])
    m.open(4, [match_entry(back, 0), match_entry(back, 1)])
    m.close(6, [flat_grid(), flat_grid()], [straight(back, 1.0, 2), straight(back, 1.1, 2)])
    return m


def legend_of(ax: plt.Axes) -> list[str]:
    return [t.get_text() for t in ax.get_legend().get_texts()]


def test_a_segmap_is_drawn_segment_by_segment() -> None:
    m = two_particles()
    sample = grow_sample(m, root_of_segment(m, len(m) - 1), np.random.default_rng(0))
    ax = plot_segmap(None, m, sample=sample)
    ax.figure.canvas.draw()
    labels = legend_of(ax)
    assert f"segments ({len(m.alive)} of 2 particles)" in labels
    assert f"those of one map sample ({len(sample)})" in labels
    assert any(t.startswith("entered an older map (2)") for t in labels)
    dark = [x.get_xydata() for x in ax.lines if x.get_lw() == 4.0]
    pale = next(c for c in ax.collections if isinstance(c, LineCollection)).get_segments()
    assert len(dark) + len(pale) == len(m.alive)
    want = sorted((m.path_length[m[int(i)].interval[0]], m.path_length[m[int(i)].interval[1]]) for i in m.alive)
    assert sorted((float(s[0][0]), float(s[1][0])) for s in [*dark, *pale]) == want
    # no two segments lie on each other
    assert len({(float(s[0][0]), float(s[0][1])) for s in [*dark, *pale]}) == len(m.alive)
    with pytest.raises(DataError, match="no segment"):
        plot_segmap(None, small_segmap(7, 1))


def test_a_sample_is_coloured_by_its_links_from_the_root() -> None:
    m = two_particles()
    sample = grow_sample(m, root_of_segment(m, len(m) - 1), np.random.default_rng(0))
    ax = plot_expansion(None, m, sample)
    paths = sample_paths(m, sample)[0]
    for line, path in zip(ax.lines, paths):
        np.testing.assert_array_equal(line.get_xydata(), path[:, :2])
    depths = sample.depth[sample.in_time]
    assert [t.get_text() for t in ax.texts] == [str(d) for d in depths]
    colours = [to_rgba(line.get_color()) for line in ax.lines[: len(paths)]]
    for a in range(len(paths)):
        for b in range(a):
            assert (colours[a] == colours[b]) == (depths[a] == depths[b])
    assert "frame of the root" in legend_of(ax)


def test_scores_stand_where_they_were_measured() -> None:
    where = np.column_stack([np.arange(5.0), np.arange(5.0) ** 2, np.zeros(5)])
    score = np.array([0.1, np.nan, 0.5, 0.9, 0.2])
    ax = plot_score_map(None, where, score, boundaries=where[[3]])
    [dots] = ax.collections
    np.testing.assert_array_equal(dots.get_offsets(), where[[0, 2, 3, 4], :2])
    np.testing.assert_array_equal(dots.get_array(), score[[0, 2, 3, 4]])
    cross = next(x for x in ax.lines if x.get_color() == style.VERMILION)
    np.testing.assert_array_equal(cross.get_xydata(), where[[3], :2])
    assert legend_of(ax) == ["segments end (1)"]
    for bad in (score[:4], np.full(5, np.nan)):
        with pytest.raises(DataError, match="do not belong"):
            plot_score_map(None, where, bad)
