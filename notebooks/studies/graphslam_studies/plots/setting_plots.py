"""One picture at several settings; in a live notebook a slider selects one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graphslam.plots import style


def plot_settings(
    draw: Callable[[Axes, Any], object],
    settings: Sequence[Any],
    *,
    name: str,
    shown: int | Sequence[Any] = 3,
    size: tuple[float, float] = (4.4, 4.0),
    share: bool = True,
) -> Figure:
    """Draw the same picture at some settings side by side, and offer all of them to select from.

    The row of pictures needs nothing but matplotlib, so that a notebook says the same on paper, on a site, and where it
    is run without anybody looking. Where ipywidgets are installed and a notebook is open, a slider is below it.

    Parameters
    ----------
    draw : callable
        ``draw(ax, setting)`` draws one picture.
    settings : sequence
        All settings, in order.
    name : str
        Name of the setting, with its unit.
    shown : int or sequence
        How many settings are drawn beside each other, evenly spaced from first to last; or which.
    size : (float, float)
        Width and height of one picture [inch].
    share : bool
        All pictures have the same axes.

    Returns
    -------
    Figure
        The row of pictures.

    Raises
    ------
    ValueError
        There are no settings.

    Examples
    --------
    >>> row = plot_settings(lambda ax, n: ax.plot(np.sin(n * np.arange(9.0))), [1, 2, 3], name="frequency", shown=2)
    >>> [ax.get_title() for ax in row.axes]
    ['frequency: 1', 'frequency: 3']
    """
    if not len(settings):
        raise ValueError("wanted at least one setting")
    if isinstance(shown, int):
        shown = [settings[k] for k in np.unique(np.linspace(0, len(settings) - 1, shown).round().astype(int))]
    row, axes = plt.subplots(
        1,
        len(shown),
        figsize=(size[0] * len(shown), size[1]),
        squeeze=False,
        sharex=share,
        sharey=share,
        layout="constrained",
    )
    for ax, setting in zip(axes.flat, shown):
        _one(ax, draw, setting, name)
    slider = slider_of(draw, settings, name=name, size=size)
    if slider is not None:
        from IPython.display import display

        display(slider)
    return row


def slider_of(
    draw: Callable[[Axes, Any], object], settings: Sequence[Any], *, name: str, size: tuple[float, float] = (4.4, 4.0)
) -> Any:
    """The slider of the settings and the picture below it; None outside a notebook, or without ipywidgets.

    Nothing is drawn before it is moved for the first time.
    """
    try:
        import ipywidgets
        from IPython import get_ipython
        from IPython.display import display
    except ImportError:
        return None
    if getattr(get_ipython(), "kernel", None) is None:
        return None
    options = [(_written(s), k) for k, s in enumerate(settings)]
    wide = {"layout": ipywidgets.Layout(width="32em"), "style": {"description_width": "initial"}}
    slider = ipywidgets.SelectionSlider(options=options, description=name, continuous_update=False, **wide)
    picture = ipywidgets.Output()

    def turn(change: Any) -> None:
        with picture:
            picture.clear_output(wait=True)
            figure, ax = plt.subplots(figsize=(1.4 * size[0], 1.4 * size[1]), layout="constrained")
            _one(ax, draw, settings[change["new"]], name)
            display(figure)
            plt.close(figure)

    slider.observe(turn, "value")
    return ipywidgets.VBox([slider, picture])


def _one(ax: Axes, draw: Callable[[Axes, Any], object], setting: Any, name: str) -> None:
    """One picture under a title that says the setting; what the drawing puts there stands below."""
    style.new_axes(ax)
    draw(ax, setting)
    own = ax.get_title()
    ax.set_title(f"{name}: {_written(setting)}" + (f"\n{own}" if own else ""), fontsize="medium")


def _written(setting: Any) -> str:
    return f"{setting:g}" if isinstance(setting, (int, float, np.number)) else str(setting)
