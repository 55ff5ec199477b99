"""Curves over the number of particles."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam_studies.plots.segslam_study import Curve, plot_by_particles


def test_curves_runs_and_the_paper_are_where_they_belong() -> None:
    n = np.array([1.0, 5.0, 20.0])
    curves = {
        "rbpf": Curve(
            particles=n, values=np.array([9.0, 3.0, 2.0]),
            low=np.array([8.0, 2.0, 1.0]), high=np.array([10.0, 4.0, 3.0]),
            points={1: np.array([8.5, 9.5])}, paper=np.array([9.3, 3.0, np.nan]),
        ),
        "segslam": Curve(particles=n, values=np.array([0.7, 0.5, 0.3])),
    }  # fmt: skip
    ax = plot_by_particles(None, curves, label="error [m]", reference=(9.0, "without"), limit=(1.5, "closed"))
    lines = {line.get_label(): line for line in ax.lines}
    np.testing.assert_array_equal(lines["RBPF"].get_ydata(), [9.0, 3.0, 2.0])
    np.testing.assert_array_equal(lines["SegSLAM"].get_ydata(), [0.7, 0.5, 0.3])
    assert len(lines["RBPF, paper"].get_xdata()) == 2
    assert "SegSLAM, paper" not in lines
    # beside each other, not over each other
    assert np.all(lines["RBPF"].get_xdata() < lines["SegSLAM"].get_xdata())
    np.testing.assert_allclose(lines["RBPF"].get_xdata(), n, rtol=0.05)
    assert [t.get_text() for t in ax.get_xticklabels()] == ["1", "5", "20"]
    assert ax.get_yscale() == "log"
    plt.close(ax.figure)


def test_an_axis_of_less_than_a_decade_is_numbered() -> None:
    ax = plot_by_particles(
        None, {"rbpf": Curve(particles=np.array([1.0, 5.0]), values=np.array([0.15, 0.6]))}, label="x"
    )
    ax.figure.canvas.draw()
    assert {t.get_text() for t in ax.get_yticklabels(minor=True)} == {"", "0.2", "0.5"}
    plt.close(ax.figure)


def test_nothing_to_draw_is_refused() -> None:
    with pytest.raises(DataError):
        plot_by_particles(None, {"rbpf": Curve(particles=np.zeros(0), values=np.zeros(0))}, label="x")
