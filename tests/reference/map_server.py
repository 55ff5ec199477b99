"""A floor plan or cost map as nav2's map server reads it, by the rules that nav2 states for its YAML and image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

KEYS = {"image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}


def read_map_server(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Cells ``(ny, nx)`` of the occupancy grid, the row of the smallest y first: 0 to 100, −1 unknown; and the YAML."""
    info = yaml.safe_load(path.read_text())
    assert set(info) <= KEYS
    assert len([float(v) for v in info["origin"]]) == 3
    low, high, mode = info["free_thresh"], info["occupied_thresh"], info.get("mode", "trinary")
    assert 0.0 < low < high < 1.0
    assert info["resolution"] > 0.0
    file = path.parent / info["image"]
    assert file.read_bytes().startswith(b"P5\n" if file.suffix == ".pgm" else b"\x89PNG")
    image = Image.open(file)
    data = np.asarray(image, dtype=float)
    alpha = data[..., -1] if image.mode in ("LA", "RGBA") else np.full(data.shape[:2], 255.0)
    grey = data if data.ndim == 2 else data[..., :1].mean(axis=-1)
    shade = grey / 255.0
    occupied = shade if info["negate"] else 1.0 - shade
    if mode == "raw":
        value = np.round(255.0 * shade)
        cells = np.where(value <= 100, value, -1)
    else:
        between = np.rint((occupied - low) / (high - low) * 100.0) if mode == "scale" else np.full(grey.shape, -1.0)
        cells = np.where(occupied > high, 100, np.where(occupied < low, 0, between))
        if mode == "scale":
            cells = np.where(alpha < 255, -1, cells)
    return cells[::-1].astype(int), info
