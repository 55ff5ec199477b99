"""Pictures that are one point and say what was drawn: drawing them in full is half the time of a tiny run."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from graphslam.core.digest import Digest

FULL = Figure.savefig
ONE = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGNoAAAAggCBd81ytgAAAABJRU5ErkJggg==")


def drawn(figure: Figure) -> str:
    """Digest of titles, lines, images and points of a figure."""
    d = Digest()
    for axes in figure.axes:
        d.add("title", axes.get_title())
        for line in axes.lines:
            d.add("line", np.asarray(line.get_xydata(), dtype=np.float64))
        for image in axes.images:
            d.add("image", np.ma.filled(image.get_array(), 0))
        for points in axes.collections:
            d.add("points", np.ma.filled(points.get_offsets(), np.nan).astype(np.float64))
            for path in points.get_paths():
                d.add("path", path.vertices)
    return d.text()


def save_point(figure: Figure, file: Any, **_: Any) -> None:
    """In the place of ``Figure.savefig``: a PNG of one point with :func:`drawn` beside it."""
    at = len(ONE) - 12  # of the chunk that ends it
    text = b"tEXtdrawn\0" + drawn(figure).encode()
    data = ONE[:at] + struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text)) + ONE[at:]
    if hasattr(file, "write"):
        file.write(data)
    else:
        Path(file).write_bytes(data)


@contextmanager
def full_pictures() -> Iterator[None]:
    """Figures are drawn as for a user: in tests of what they show, and that they can be drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", FULL)
        yield
