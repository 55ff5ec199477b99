"""Loops over the path: which are drawn, where, and how."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection

from graphslam.core.errors import DataError
from graphslam.plots.loops import plot_loops
from graphslam.plots.save import figure_png, save_figure

PATH = np.array([[0.0, 0.0, 5.0], [10.0, 0.0, 5.0], [np.nan, np.nan, np.nan], [10.0, 10.0, 5.0], [0.0, 10.0, 5.0]])
NODES = PATH[[0, 1, 3, 4]]


def test_every_loop_is_a_line_between_its_nodes() -> None:
    loops = [(0, 3, "accepted"), (1, 2, "accepted"), (0, 2, "rejected"), (1, 1, "undone")]
    ax = plot_loops(None, PATH, NODES, loops, title="loops")
    lines = {c.get_label(): c for c in ax.collections if isinstance(c, LineCollection)}
    assert set(lines) == {"accepted (2)", "rejected (1)", "undone (1)"}
    np.testing.assert_array_equal(lines["accepted (2)"].get_segments(), [[[0, 0], [0, 10]], [[10, 0], [10, 10]]])
    np.testing.assert_array_equal(lines["rejected (1)"].get_segments(), [[[0, 0], [10, 10]]])
    assert lines["accepted (2)"].get_zorder() > lines["rejected (1)"].get_zorder()
    colours = {tuple(c.get_colors()[0]) for c in lines.values()}
    assert len(colours) == 3
    assert ax.get_legend() is not None
    assert ax.get_aspect() == 1.0
    plt.close(ax.figure)


def test_names_stand_beside_what_is_or_was_in_the_graph() -> None:
    loops = [(0, 3, "accepted"), (0, 2, "rejected"), (1, 2, "undone")]
    ax = plot_loops(None, PATH, NODES, loops, names=[7, 8, 9])
    assert {t.get_text(): tuple(t.xy) for t in ax.texts} == {"7": (0.0, 5.0), "9": (10.0, 5.0)}
    plt.close(ax.figure)


def test_no_loop_is_a_path_alone() -> None:
    ax = plot_loops(None, PATH, NODES, [])
    assert not [c for c in ax.collections if isinstance(c, LineCollection)]
    plt.close(ax.figure)


@pytest.mark.parametrize("loop", [(0, 4, "accepted"), (-1, 2, "rejected"), (0, 1, "believed")])
def test_what_cannot_be_drawn_is_refused(loop: tuple[int, int, str]) -> None:
    with pytest.raises(DataError, match="loop cannot be drawn"):
        plot_loops(None, PATH, NODES, [loop])


def test_a_png_in_memory_is_the_one_on_disk(tmp_path) -> None:
    before = plt.get_fignums()
    made = [plot_loops(None, PATH, NODES, [(0, 3, "accepted")]) for _ in range(2)]
    assert figure_png(made[0]) == save_figure(made[1], tmp_path / "a.png").read_bytes()
    assert plt.get_fignums() == before  # those that other tests have left open
