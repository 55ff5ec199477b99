"""Export of figures to files."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from graphslam.plots import style


def save_figure(ax: Axes, path: Path) -> Path:
    """Write the figure of ``ax`` as PNG and close it; the same data give the same bytes (no date, no version)."""
    figure = ax.figure
    assert isinstance(figure, Figure)
    figure.savefig(path, dpi=style.DPI, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
    return path


def show_figure(ax: Axes) -> None:
    """Show the figure of ``ax`` in a window and wait until it is closed."""
    plt.figure(ax.figure.number)  # type: ignore[union-attr]
    plt.show()


def figure_png(ax: Axes) -> bytes:
    """The figure of ``ax`` as the bytes of a PNG, as :func:`save_figure` would write them; closes it."""
    figure = ax.figure
    assert isinstance(figure, Figure)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=style.DPI, bbox_inches="tight", metadata={"Software": None})
    plt.close(figure)
    return out.getvalue()
