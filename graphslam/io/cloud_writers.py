"""Writers of point clouds: PCD and LAS."""

from __future__ import annotations

import os

import numpy as np

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import DataError
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array


def write_pcd(path: str | os.PathLike[str], points: Array) -> None:
    """Write points ``(n, 3)`` [m] as binary PCD 0.7, float32."""
    rows = np.ascontiguousarray(points, dtype="<f4")
    n = len(rows)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    )
    head += f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    with atomic_open(path) as stream:
        stream.write(head.encode() + rows.tobytes())


def write_las(path: str | os.PathLike[str], points: Array) -> None:
    """Write points ``(n, 3)`` [m] as LAS 1.4 with a resolution of 1 mm; compressed if the name ends in ``.laz``."""
    where = os.fspath(path)
    laspy = import_extra("laspy", "a LAS file", where=where)
    p = np.asarray(points, dtype=np.float64)
    if not len(p):
        raise DataError("a map without a point cannot be written", where=where)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = None  # the same map has the same bytes every day
    header.scales, header.offsets = np.full(3, 0.001), np.floor(p.min(axis=0))
    las = laspy.LasData(header)
    las.xyz = p
    with atomic_open(path) as stream:
        las.write(stream, do_compress=where.lower().endswith(".laz"))
