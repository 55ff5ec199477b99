"""Reader of pose-network files; the format is detected from the records, not from the file name."""

from __future__ import annotations

import os
from pathlib import Path

from graphslam.core.errors import FormatError
from graphslam.core.network import PoseNetwork
from graphslam.core.reading import read_text, size_limit
from graphslam.io import g2o, isam_graph
from graphslam.io.isam_graph import Noise
from graphslam.io.text_records import tagged_lines

# The first record of a known kind determines the format; it must be within this number of lines.
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
        Meaning of TORO/iSAM noise columns (:func:`graphslam.io.isam_graph.parse_isam_graph`); not used for g2o.
    repair : bool
        Project indefinite matrices to positive definite ones instead of raising an error.
    create_missing : bool
        Create vertices that occur only in edges instead of raising an error.
    max_size : int, optional
        Maximal size after decompression [bytes]; default :data:`~graphslam.core.reading.MAX_SIZE`.
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
    """The path itself: callers read the network by :func:`read_network`, with their options."""
    return Path(path)
