"""One door for pose-network files: the format is told by the records inside, not by the name."""

from __future__ import annotations

import os

from graphslam.core.errors import FormatError
from graphslam.core.network import PoseNetwork
from graphslam.core.reading import size_limit
from graphslam.io import g2o, isam_graph
from graphslam.io.g2o import read_g2o
from graphslam.io.isam_graph import Noise, read_isam_graph
from graphslam.io.text_records import tags_of


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
        Meaning of TORO/iSAM noise columns (:func:`graphslam.io.isam_graph.read_isam_graph`); g2o says it itself.
    repair : bool
        Project indefinite matrices to positive definite ones instead of refusing them.
    create_missing : bool
        Make vertices that only edges name instead of refusing them.
    max_size : int, optional
        Bytes that are read at most, after decompression; default :data:`~graphslam.core.reading.MAX_SIZE`.

    Raises
    ------
    MissingDataError, FormatError, CovarianceError
    """
    with size_limit(max_size):
        tags = tags_of(path)
        if tags & set(g2o.LAYOUTS):
            return read_g2o(path, repair=repair, create_missing=create_missing)
        if tags & set(isam_graph.LAYOUTS):
            return read_isam_graph(path, noise=noise, repair=repair, create_missing=create_missing)
    raise FormatError(
        "not a pose network",
        where=str(path),
        got="records " + ", ".join(sorted(t[:20] for t in tags)[:5]) if tags else "an empty file",
        wanted="g2o, TORO or iSAM records",
    )
