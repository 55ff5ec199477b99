"""TORO and iSAM text graphs: ``VERTEX2``, ``EDGE2``, ``ODOMETRY`` and ``LANDMARK`` lines (two-dimensional).

The six noise columns mean different things in different programs, and no file says which:

* TORO: information, in the order I_xx I_xy I_yy I_θθ I_xθ I_yθ;
* iSAM: the upper triangle of a square root of the information, xx xy xθ yy yθ θθ;
* GTSAM's ``load2D``: a *covariance*, xx xy xθ yy yθ θθ, for lines whose off-diagonals are zero.

``noise="auto"`` reads a diagonal in TORO's places as TORO's information and a diagonal in the other places as
``load2D`` does, and says so in ``PoseNetwork.noise``; anything else has to be asked for by name.

Poses and landmarks share one index space: a node is a landmark if it is the second index of a ``LANDMARK`` line.
``LANDMARK pose landmark x y c_xx c_xy c_yy``: an isotropic covariance becomes bearing and range with
σ_range = √c and σ_bearing = √(c/10), as ``load2D`` does (the noise at ten metres); any other stays Cartesian. If the
noise is asked for as information or its square root, that is meant of landmarks too, and they stay Cartesian.
"""

from __future__ import annotations

import logging
import os
from typing import Literal, get_args

import numpy as np

from graphslam.core.errors import ConfigError, FormatError
from graphslam.core.geometry import Array
from graphslam.core.network import Ids, Labels, PoseNetwork
from graphslam.io.network_builder import NetworkBuilder, edge_labels, sighting_labels, upper_triangle
from graphslam.io.text_records import Records

Noise = Literal["auto", "covariance", "information", "sqrt-information", "toro"]
UNKNOWN_TURN = 0.5
"""A measured turn of this standard deviation says hardly anything [rad]: the columns probably mean something else."""
log = logging.getLogger(__name__)
LAYOUTS: dict[str, tuple[int, int]] = {
    "VERTEX2": (1, 3),
    "EDGE2": (2, 9),
    "ODOMETRY": (2, 9),
    "LANDMARK": (2, 5),
}
# row-wise upper triangle of columns given as I_xx I_xy I_yy I_θθ I_xθ I_yθ
_TORO = np.array([0, 1, 4, 2, 5, 3])


def parse_isam_graph(
    path: str | os.PathLike[str],
    text: str,
    *,
    noise: Noise = "auto",
    repair: bool = False,
    create_missing: bool = False,
) -> PoseNetwork:
    """Read a TORO or iSAM graph from the content of its file; ``path`` names it in errors.

    Parameters
    ----------
    noise : {"auto", "covariance", "information", "sqrt-information", "toro"}
        Meaning of the noise columns of edges; "toro" is information in TORO's order, the others are in the order
        xx xy xθ yy yθ θθ.
    repair : bool
        Project impossible matrices instead of refusing them.
    create_missing : bool
        Make vertices that only edges name, where others are given, instead of refusing them.
    """
    if noise not in get_args(Noise):
        raise ConfigError(f"unknown noise format {noise!r}; known: {', '.join(get_args(Noise))}")
    records = Records(path, text, LAYOUTS)
    rows = records.rows
    build = NetworkBuilder(records.path, 2, records.where, repair, create_missing)
    vertices = rows["VERTEX2"]
    build.add_vertices(vertices.whole[:, 0], vertices.real, vertices.lines)
    parts = rows["EDGE2"], rows["ODOMETRY"]
    lines = np.concatenate([p.lines for p in parts])
    if len(lines):
        order = np.argsort(lines)
        pairs, lines = np.concatenate([p.whole for p in parts])[order], lines[order]
        values = np.concatenate([p.real for p in parts])[order]
        name = _guess(values[:, 3:], records, lines) if noise == "auto" else noise
        information = _information(values[:, 3:], name, build, edge_labels(pairs))
        build.noise = {
            "toro": "information, TORO order",
            "sqrt-information": "square-root information",
            "covariance": "covariance, as GTSAM's load2D reads it",
        }.get(name, name)
        build.add_edges(pairs, values[:, :3], information, lines)
    if len(rows["LANDMARK"]):
        _landmarks(records, build, noise)
    return build.build()


def _guess(columns: Array, records: Records, lines: Ids) -> Noise:
    nonzero = columns != 0.0
    patterns: dict[Noise, list[int]] = {"toro": [0, 2, 3], "covariance": [0, 3, 5]}
    for name, places in patterns.items():
        wanted = np.isin(np.arange(6), places)
        if (nonzero == wanted).all():
            turn = float(np.sqrt(np.median(columns[:, 5])))
            if name == "covariance" and turn > UNKNOWN_TURN:
                log.warning(
                    "%s: noise columns are read as covariances, as GTSAM does, so that σ of a turn is "
                    "%.0f degrees. Programs that use iSAM write the square root of the information: "
                    "--noise sqrt-information",
                    records.path,
                    np.rad2deg(turn),
                )
            return name
    odd = np.flatnonzero((nonzero != np.isin(np.arange(6), [0, 3, 5])).any(axis=1))
    raise FormatError(
        "the meaning of the noise columns is not clear from the numbers",
        where=records.where(int(lines[odd[0]])),
        wanted="--noise covariance, information, sqrt-information or toro (in Python noise=…)",
    )


def _information(columns: Array, noise: Noise, build: NetworkBuilder, labels: Labels) -> Array:
    if noise == "toro":
        return upper_triangle(columns[:, _TORO], 3)
    if noise == "information":
        return upper_triangle(columns, 3)
    if noise == "covariance":
        return build.invert(upper_triangle(columns, 3), labels, "edge covariance matrices")
    R = np.triu(upper_triangle(columns, 3))
    return np.asarray(np.swapaxes(R, 1, 2) @ R)


def _landmarks(records: Records, build: NetworkBuilder, noise: Noise) -> None:
    rows = records.rows["LANDMARK"]
    pairs, lines, labels = rows.whole, rows.lines, sighting_labels(rows.whole)
    xy, c = rows.real[:, :2], rows.real[:, 2:]
    covariance = upper_triangle(c, 2)
    if noise in ("information", "sqrt-information"):
        R = np.triu(covariance)
        build.add_observations(pairs, xy, covariance if noise == "information" else np.swapaxes(R, 1, 2) @ R, lines)
        return
    if not np.all((np.abs(c[:, 0] - c[:, 2]) < 1e-4) & (c[:, 1] == 0.0)):
        build.add_observations(pairs, xy, build.invert(covariance, labels, "landmark covariance matrices"), lines)
        return
    distance = np.hypot(xy[:, 0], xy[:, 1])
    bad = np.flatnonzero((distance <= 0.0) | (c[:, 0] <= 0.0))
    if len(bad):
        raise FormatError("landmark at zero distance or with zero covariance", where=records.where(int(lines[bad[0]])))
    information = np.zeros((len(rows), 2, 2))
    information[:, 0, 0] = 10.0 / c[:, 0]  # σ_bearing² = c / 10, "at ten metres"
    information[:, 1, 1] = 1.0 / c[:, 0]
    build.kind = "bearing-range"
    build.add_observations(pairs, np.stack([np.arctan2(xy[:, 1], xy[:, 0]), distance], axis=1), information, lines)
