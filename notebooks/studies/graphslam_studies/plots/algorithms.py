"""Names and looks of algorithms: the same colour, line and marker in every figure.

Colour says whose local maps they are, the line how they were joined.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from graphslam.plots import style

# name -> (label, colour, line, marker)
_ALGORITHMS: dict[str, tuple[str, str, str, str]] = {
    "ekf": ("EKF, one map", style.GREY, "-", "o"),
    "rbpf": ("RBPF, one map", style.BLACK, "-", "X"),
    "ekf-eif": ("EKF-EIF", style.BLUE, "-", "s"),
    "ekf-eif-tree": ("EKF-EIF, tree", style.BLUE, "--", "P"),
    "ekf-eif+polish": ("EKF-EIF, polished", style.SKY, ":", "s"),
    "rbpf-ekf": ("RBPF-EKF", style.ORANGE, "-.", "v"),
    "rbpf-eif": ("RBPF-EIF", style.VERMILION, "-", "^"),
    "rbpf-eif-tree": ("RBPF-EIF, tree", style.VERMILION, "--", "D"),
    "rbpf-eif+polish": ("RBPF-EIF, polished", style.ORANGE, ":", "^"),
    "default-eif": ("default-EIF", style.GREEN, "-", "o"),
    "default-eif-tree": ("default-EIF, tree", style.GREEN, "--", "D"),
    "default-ekf": ("default-EKF", style.GREEN, "-.", "v"),
    "default+polish": ("default, polished", style.PURPLE, ":", "s"),
    "default-eif+polish": ("default-EIF, polished", style.PURPLE, ":", "o"),
    "default-ekf+polish": ("default-EKF, polished", style.PURPLE, ":", "v"),
    "default-isam2": ("default, iSAM2", style.PURPLE, "--", "P"),
    "default-batch": ("default, batch", style.PURPLE, "-.", "X"),
    "default-online": ("default, online", style.PURPLE, "-", "D"),
    "default-optimum": ("default, optimum at every submap", style.SKY, "-.", "s"),
    "full-batch": ("full batch", style.BLACK, "--", "s"),
    "local-ekf": ("EKF", style.BLUE, "-", "s"),
    "local-paper": ("RBPF, moments (paper)", style.VERMILION, "-", "^"),
    "local-paper-1.0": ("RBPF 1.0, moments", style.ORANGE, "--", "v"),
    "local-paper-inflated": ("RBPF, moments inflated", style.PURPLE, "-.", "D"),
    "local-default": ("RBPF, smoothed (default)", style.GREEN, "-", "o"),
}


def in_order(names: Iterable[str]) -> list[str]:
    """Names in the order in which they are drawn: ours as listed, then others by name."""
    rank = {name: k for k, name in enumerate(_ALGORITHMS)}
    return sorted(set(names), key=lambda name: (rank.get(name, len(rank)), name))


def algorithm_label(name: str) -> str:
    """What an algorithm is called in a legend; its own name where it is not one of ours."""
    return _ALGORITHMS[name][0] if name in _ALGORITHMS else name


def algorithm_line(name: str, k: int = 0) -> dict[str, Any]:
    """Colour, line style and marker of an algorithm; of curve ``k`` of a series where it is not one of ours."""
    if name not in _ALGORITHMS:
        return style.line(k)
    _, colour, line, marker = _ALGORITHMS[name]
    return {"color": colour, "linestyle": line, "marker": marker}
