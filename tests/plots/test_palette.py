"""The palette of all figures: colours that stand for something are told apart with any common colour vision."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from graphslam.app.report import scene
from graphslam.plots import style

# Machado, Oliveira and Fernandes (2009), severity 1, on linear RGB
VISION = {
    "common": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
HEX = re.compile(r"[\"']#[0-9A-Fa-f]{3,8}[\"']")
LEAST = 12.0
"""Distance in CIELAB; 2.3 is just noticed side by side, and a line of a map stands alone."""


def lab(colour: str, vision: np.ndarray) -> np.ndarray:
    """CIELAB (D65) of a colour as it is seen."""
    c = np.array(to_rgb(colour))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    x = XYZ @ np.clip(vision @ linear, 0.0, 1.0) / np.array([0.95047, 1.0, 1.08883])
    f = np.where(x > (6 / 29) ** 3, np.cbrt(x), x / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def closest(colours: list[str], vision: str) -> float:
    """Least distance of two of the colours."""
    points = [lab(c, VISION[vision]) for c in colours]
    return min(float(np.linalg.norm(a - b)) for a, b in combinations(points, 2))


@pytest.mark.parametrize("vision", VISION)
def test_colours_that_mean_something_are_distinguished(vision: str) -> None:
    assert closest(sorted(set(style.NAMES.values())), vision) > LEAST
    assert closest(list(style.CYCLE), vision) > LEAST
    assert closest(list(style.TERRAIN.values()), vision) > LEAST


def test_red_and_green_would_not_pass() -> None:
    for vision, pair in (("protanopia", ["#b05030", "#606020"]), ("deuteranopia", ["#a04030", "#606020"])):
        assert closest(pair, "common") > 3 * LEAST
        assert closest(pair, vision) < LEAST


def test_white_and_black_are_where_they_belong() -> None:
    np.testing.assert_allclose(lab("#ffffff", VISION["common"]), [100.0, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(lab("#000000", VISION["deuteranopia"]), 0.0, atol=1e-9)


def test_colours_stand_in_one_file() -> None:
    """No figure has a colour of its own but the white of edges, and black and shades of grey of a canvas."""
    plots = Path(style.__file__).parent
    own = [f.name for f in sorted(plots.glob("*.py")) if f.name != "style.py" and HEX.search(f.read_text())]
    assert own == []
    assert "#" not in Path(scene.__file__).read_text().replace("# ", "")
