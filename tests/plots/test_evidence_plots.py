"""Figures of evidence grids show the voxels that are there, where they are."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.evidence.grid import EvidenceGrid
from graphslam.plots.evidence import grid_section, plot_heights, plot_section
from graphslam_studies.plots.evidence import plot_sharing


def room() -> EvidenceGrid:
    """Beams from the origin to two voxels."""
    grid = EvidenceGrid(0.5)
    grid.insert_scan([[3.25, 0.25, 0.25], [-2.25, 0.25, 1.25]], origin=[0.25, 0.25, 0.25])
    return grid


def test_section_holds_the_probabilities_of_the_plane() -> None:
    p, (left, right, bottom, top) = grid_section(room(), "z", 0.25)
    columns, rows = round((right - left) / 0.5), round((top - bottom) / 0.5)
    assert p.shape == (rows, columns)
    i, j = int((0.25 - bottom) / 0.5), int((3.25 - left) / 0.5)
    assert p[i, j] == pytest.approx(0.7, abs=1e-3)
    assert p[i, j - 1] == pytest.approx(0.4, abs=1e-3)
    assert np.isnan(p[i + 1, j])
    assert np.isfinite(p).sum() == 7 + 1  # the beam along x with its end, and the first steps of the other one
    p, (left, *_) = grid_section(room(), "y", 0.25)  # rows are z now
    assert np.isfinite(p).sum() > 8


def test_heights_show_the_highest_occupied_voxel() -> None:
    ax = plot_heights(room())
    shown = [np.ma.filled(im.get_array(), np.nan) for im in ax.images]
    heights = sorted(shown[-1][np.isfinite(shown[-1])].tolist())
    assert heights == [0.25, 1.25]
    ax = plot_heights(room(), below=1.0)
    shown = np.ma.filled(ax.images[-1].get_array(), np.nan)
    assert shown[np.isfinite(shown)].tolist() == [0.25]
    plt.close("all")


def test_plots_take_and_return_axes_also_for_an_empty_grid() -> None:
    _, ax = plt.subplots()
    assert plot_section(EvidenceGrid(0.1), ax) is ax
    assert plot_heights(EvidenceGrid(0.1), ax, title="nothing") is ax
    flat = EvidenceGrid(0.1, dim=2)
    flat.insert_scan([[1.0, 0.0]])
    assert plot_section(flat, ax, title="flat") is ax
    with pytest.raises(ConfigError, match="no heights"):
        plot_heights(flat)
    with pytest.raises(ConfigError, match="no section"):
        grid_section(flat, "x")
    plt.close("all")


def test_sharing_shows_what_an_update_parted() -> None:
    a = EvidenceGrid(0.1)
    a.insert_scan([[5.03, 0.03, 0.03]], origin=[0.03, 0.03, 0.03])
    b = a.copy()
    b.insert_scan([[0.03, 2.03, 0.03]], origin=[0.03, 0.03, 0.03])
    ax = plot_sharing(b, [a])
    own = ax.images[1].get_array()
    assert own.shape == (3, 7)
    np.testing.assert_array_equal(np.isfinite(own.filled(np.nan))[:, 0], True)  # the beam along y, its start included
    assert np.isfinite(own.filled(np.nan)).sum() == 3
    assert ax.get_title() == "3 of 9 bricks its own"
    assert plot_sharing(EvidenceGrid(0.1), []) is not None
