"""Colours, sizes and axes of every figure: the appearance of graphslam's figures is defined here.

The palette is that of Okabe and Ito (2008), distinguishable with any common type of colour vision. Meaning is never
carried by colour alone: reference data are dashed or have a marker of their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # the colours are also those of the report, which draws without Matplotlib

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
YELLOW = "#F0E442"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#6B6B6B"
PALE = "#D9D9D9"

# quantity -> its colour, in every figure
ESTIMATE = BLUE
LANDMARK = VERMILION
TRUTH = BLACK
GPS = GREEN
DEAD_RECKONING = ORANGE
GRAPH = SKY
"""The path of the graph, where a refinement by scans began."""
BOUNDS = PALE

# … and its name in every legend and layer
NAMES = {
    "map": GREY,
    "path": ESTIMATE,
    "landmarks": LANDMARK,
    "truth": TRUTH,
    "true landmarks": TRUTH,
    "GPS": GPS,
    "dead reckoning": DEAD_RECKONING,
    "graph, before the refinement": GRAPH,
}


TERRAIN = {
    "unknown": "#FFFFFF",
    "free": "#8FD19E",
    "above_reach": "#5DA9D6",
    "step": "#F0A202",
    "steep": "#B07AA1",
    "obstacle": "#C8102E",
    "hole": "#202020",
}
"""Colours of the terrain classes: green and blue are traversable, warm colours and black are not."""


def ellipses(of: str, confidence: float = 0.95) -> str:
    """Name of the ellipses of a quantity, for legends: ``95 % ellipses of the path``."""
    return f"{100 * confidence:.3g} % ellipses of {'the ' if of == 'path' else ''}{of}"


# curves and bars that have no meaning of their own, in order
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, GREY)
LINE_STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

FIGURE_SIZE = (8.0, 5.5)
DPI = 150


def use_palette() -> None:
    """Make the palette matplotlib's own, so that figures drawn directly in a notebook have the same colours.

    Examples
    --------
    >>> gs.plots.use_palette()
    >>> import matplotlib
    >>> matplotlib.rcParams["axes.prop_cycle"].by_key()["color"][0]
    '#0072B2'
    """
    import matplotlib.pyplot as plt

    plt.rcParams["axes.prop_cycle"] = plt.cycler(color=CYCLE)
    plt.rcParams["axes.formatter.min_exponent"] = 3  # 0.2 in place of 2 × 10⁻¹: labels of log axes do not overlap


def colour(k: int) -> str:
    """Colour of item k of a series; repeats after the palette's length."""
    return CYCLE[k % len(CYCLE)]


def line(k: int) -> dict[str, Any]:
    """Colour, marker and line style of curve k: distinct for 28 curves, also in grey."""
    return {
        "color": CYCLE[k % len(CYCLE)],
        "linestyle": LINE_STYLES[(k // len(CYCLE)) % len(LINE_STYLES)],
        "marker": MARKERS[k % len(MARKERS)],
    }


def new_axes(ax: Axes | None, size: tuple[float, float] = FIGURE_SIZE) -> Axes:
    """``ax``, or the axes of a new figure; with the common frame."""
    if ax is None:
        import matplotlib.pyplot as plt

        _, ax = plt.subplots(figsize=size, dpi=DPI, layout="constrained")
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(True, color=PALE, linewidth=0.5, alpha=0.6)
    ax.set_axisbelow(True)
    return ax


def metric_axes(ax: Axes, x: str = "x", y: str = "y") -> None:
    """Equal scales in metres: angles are preserved."""
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlabel(f"{x} [m]")
    ax.set_ylabel(f"{y} [m]")


def legend(ax: Axes, *, outside: bool = True, **options: Any) -> None:
    """Legend, if there are labels; to the right of the axes, where it covers no data."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        place = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0} if outside else {}
        options = {"frameon": True, "framealpha": 0.85, "edgecolor": "none", "fontsize": "small", **place, **options}
        ax.legend(handles, labels, **options)
