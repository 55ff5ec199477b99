"""The settings are drawn beside each other, and its slider draws the one that it is moved to."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import pytest

from graphslam_studies.plots import setting_plots


def test_first_middle_and_last_setting_are_drawn_and_titled() -> None:
    drawn: list[float] = []
    row = setting_plots.plot_settings(lambda ax, v: drawn.append(v), [0.1, 1.0, 2.5, 10.0, 100.0], name="σ [m]")
    assert drawn == [0.1, 2.5, 100.0]
    assert [ax.get_title() for ax in row.axes] == ["σ [m]: 0.1", "σ [m]: 2.5", "σ [m]: 100"]
    plt.close(row)


def test_shown_settings_are_those_asked_for_and_own_titles_stay() -> None:
    row = setting_plots.plot_settings(
        lambda ax, v: ax.set_title(f"{v} squared: {v * v}"), [1, 2, 3], name="n", shown=(2,)
    )
    assert [ax.get_title() for ax in row.axes] == ["n: 2\n2 squared: 4"]
    plt.close(row)
    with pytest.raises(ValueError, match="at least one setting"):
        setting_plots.plot_settings(lambda ax, v: None, [], name="n")


def test_without_a_notebook_there_is_no_slider() -> None:
    assert setting_plots.slider_of(lambda ax, v: None, [1, 2], name="n") is None


def test_the_slider_draws_when_it_is_moved_and_not_before(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipywidgets", reason="the extra notebooks is not installed")
    import IPython

    class Shell:
        kernel = object()

    monkeypatch.setattr(IPython, "get_ipython", lambda: Shell())
    monkeypatch.setattr("IPython.display.display", lambda figure: None)
    drawn: list[Any] = []
    open_before = plt.get_fignums()  # tests of other files may leave some
    slider, _ = setting_plots.slider_of(lambda ax, v: drawn.append(v), ["few", "many"], name="particles").children
    assert drawn == []
    slider.value = 1
    assert drawn == ["many"]
    assert plt.get_fignums() == open_before
