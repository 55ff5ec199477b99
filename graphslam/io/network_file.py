"""One door for pose-network files: the format is told by the records inside, not by the name."""

from __future__ import annotations

import os
from pathlib import Path

from graphslam.core.errors import FormatError
from graphslam.core.network import PoseNetwork
from graphslam.core.reading import read_text, size_limit
from graphslam.io import g2o, isam_graph
from graphslam.io.isam_graph import Noise
from graphslam.io.text_records import tagged_lines

# The first record of a known kind tells the format; it is looked for in so many lines.
_LINES = 100_000


def read_network(
    path: str | os.PathLike[str],
    *,
    noise: Noise = "auto",
    repair: bool = False,
    create_missing: bool = False,
    max_size: int | None = None,
) -> PoseNetwork:
    """Read a pose network: g2o, TORO or iSAM, plain or compressed.

    Parameters
    ----------
    noise : str
        Meaning of TORO/iSAM noise columns (:func:`graphslam.io.isam_graph.parse_isam_graph`); g2o says it itself.
    repair : bool
        Project indefinite matrices to positive definite ones instead of refusing them.
    create_missing : bool
        Make vertices that only edges name instead of refusing them.
    max_size : int, optional
        Bytes that are read at most, after decompression; default :data:`~graphslam.core.reading.MAX_SIZE`.
    """
    with size_limit(max_size):
        text = read_text(path)
    other = set[str]()
    for number, tokens in tagged_lines(text):
        if tokens[0] in g2o.LAYOUTS | g2o.ALIASES:
            return g2o.parse_g2o(path, text, repair=repair, create_missing=create_missing)
        if tokens[0] in isam_graph.LAYOUTS | isam_graph.ALIASES:
            return isam_graph.parse_isam_graph(path, text, noise=noise, repair=repair, create_missing=create_missing)
        other.add(tokens[0][:20])
        if number > _LINES:
            break
    raise FormatError(
        "not a pose network",
        where=str(path),
        got="records " + ", ".join(sorted(other)[:5]) if other else "an empty file",
        wanted="records of g2o (VERTEX_SE2, EDGE_SE3:QUAT …), TORO (VERTEX2, EDGE2, EDGE3 …) or iSAM (ODOMETRY …)",
    )


def network_path(path: str | os.PathLike[str]) -> Path:
    """The file itself: networks are read by :func:`read_network`, with the options of its caller."""
    return Path(path)
