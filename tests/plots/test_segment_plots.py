"""Figures of segments show the scores, boundaries, paths and matches that are there."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_compose
from graphslam.plots.segments import DrawnMatch, plot_segments
from graphslam_frontends.segslam.paths import concatenate_segments
from graphslam_frontends.segslam.sampling import grow_sample, root_of_segment
from graphslam_frontends.segslam.segmap import SegMap, SegmentEntry
from graphslam_studies.plots.segments import plot_entropies, plot_samples, plot_scores, running_maximum, sample_paths
from tests.reference.segmap_twin import flat_grid, match_entry, small_segmap, straight


def texts(ax: plt.Axes) -> list[str]:
    return [t.get_text() for t in ax.get_legend().get_texts()]


def two_sides() -> SegMap:
    """2 m ahead, a new segment 2 m to the left, then back into the first map."""
    m = small_segmap(7, 1)
    path = straight(np.zeros(3), 2.0, 2)
    path[-1, 2] = np.pi / 2
    for k in range(2):
        m.open(2 * k, [SegmentEntry(T_entry=np.zeros(3))])
        m.close(2 * k + 2, [flat_grid()], [path])
    m.open(4, [match_entry(np.array([1.9, 2.1, np.pi]), 0)])
    m.close(6, [flat_grid()], [straight(np.array([1.9, 2.1, np.pi]), 1.0, 2)])
    return m


def test_scores_are_drawn_with_the_boundaries_and_their_reasons() -> None:
    s, y = np.arange(6.0), np.array([0.5, 0.8, np.nan, 0.3, 0.7, 0.6])
    ax = plot_scores(None, s, y, boundaries=[(3.0, "score"), (5.0, "max-length")], threshold=0.45, relative=0.5)
    line = ax.lines[0]
    np.testing.assert_array_equal(line.get_ydata(), y)
    assert sorted(x.get_xdata()[0] for x in ax.lines if len(set(x.get_xdata())) == 1 and len(x.get_xdata()) == 2) == [
        3.0,
        5.0,
    ]
    assert texts(ax)[1:3] == ["segment ends: max-length (1)", "segment ends: score (1)"]
    np.testing.assert_allclose(running_maximum(s, y, [3.0]), [0.5, 0.8, 0.8, 0.8, 0.7, 0.7])
    assert np.isnan(running_maximum(s[:2], np.array([np.nan, 0.4]), [])[0])
    with pytest.raises(DataError, match="do not belong"):
        plot_scores(None, [1.0, 0.0], [0.5, 0.5])
    plt.close("all")


def test_segments_stand_where_the_sample_puts_them_and_matches_join_them() -> None:
    m = two_sides()
    sample = grow_sample(m, root_of_segment(m, 2), np.random.default_rng(0))
    paths, matches, labels = sample_paths(m, sample)
    assert labels == ["0", "1", "2m"]
    assert len(matches) == 1
    whole = concatenate_segments(m, sample)
    np.testing.assert_allclose(np.concatenate([paths[0], paths[1][1:], paths[2][1:]]), whole.positions, atol=1e-12)
    # the match: from the entry of segment 2 to the nearest pose of segment 0, at its end
    k = sample.segments.tolist().index(0)
    np.testing.assert_allclose(matches[0].there, se2_compose(sample.poses[k], m[0].path[-1])[:2], atol=1e-12)
    np.testing.assert_allclose(matches[0].here, [1.9, 2.1], atol=1e-12)
    # the root is the last segment: seen from the first, everything is moved as one, and the first stands at the origin
    early, first_matches, same = sample_paths(m, sample, frame="first")
    assert same == labels
    np.testing.assert_allclose(early[0], m[0].path[:, :2], atol=1e-12)
    moved = sample.poses[k]
    for here, there in zip([*early, first_matches[0].there[None]], [*paths, matches[0].there[None]]):
        back = se2_compose(np.broadcast_to(moved, (len(here), 3)), np.column_stack([here, np.zeros(len(here))]))
        np.testing.assert_allclose(back[:, :2], there, atol=1e-12)
    with pytest.raises(ConfigError, match="frame"):
        sample_paths(m, sample, frame="last")  # type: ignore[arg-type]
    ax = plot_segments(None, paths, matches=matches, labels=labels, truth=whole)
    assert "matches (1)" in texts(ax)
    assert {t.get_text() for t in ax.texts} == set(labels)
    np.testing.assert_allclose(ax.lines[1].get_xydata(), paths[0])
    colours = {line.get_color() for line in ax.lines[1:7:2]}
    assert len(colours) == 3
    plt.close("all")


def test_other_planes_and_impossible_ones() -> None:
    p = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    ax = plot_segments(None, [p], matches=[DrawnMatch(p[0], p[1])], plane="xz")
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), p[:, [0, 2]])
    assert ax.get_ylabel() == "z [m]"
    with pytest.raises(DataError, match="cannot be drawn"):
        plot_segments(None, [p[:, :2]], plane="xz")
    with pytest.raises(ConfigError, match="plane"):
        plot_samples(None, [p], plane="zx")
    for draw in (plot_segments, plot_samples):
        with pytest.raises(DataError):
            draw(None, [])
    plt.close("all")


def test_samples_lie_over_each_other() -> None:
    _, ax = plt.subplots()
    rng = np.random.default_rng(0)
    paths = [rng.normal(size=(4, 2)) for _ in range(5)]
    assert plot_samples(ax, paths, best=2, truth=paths[0], title="five") is ax
    np.testing.assert_array_equal(ax.lines[-2].get_xydata(), paths[2])
    assert texts(ax) == ["5 map samples", "the best of them", "truth"]
    assert texts(plot_samples(None, paths, what="path")) == ["5 paths"]
    plt.close("all")


def test_entropies_are_counted_in_common_bins() -> None:
    ax = plot_entropies(None, {"segslam": [1.0, 1.1, 3.0, 5.0], "rbpf": [2.0]}, bins=4)
    assert texts(ax) == ["segslam: least 1, median 2 of 4", "rbpf: 2"]
    tops = {round(float(h), 6) for p in ax.patches for h in p.get_path().vertices[:, 1]}
    assert tops == {0.0, 1.0, 2.0}
    assert plot_entropies(None, {"same": [2.0, 2.0]}).patches
    for bad in ({}, {"a": []}, {"a": [np.nan]}):
        with pytest.raises(DataError, match="no entropies"):
            plot_entropies(None, bad)
    plt.close("all")
