"""Reader of TORO and iSAM text graphs: ``VERTEX2``, ``EDGE2``, ``ODOMETRY``, ``LANDMARK``; ``VERTEX3``, ``EDGE3``.

The meaning of the noise columns depends on the program that wrote the file, which is not recorded in it. In 2-D:

* TORO: information, in the order I_xx I_xy I_yy I_θθ I_xθ I_yθ;
* iSAM: the upper triangle of a square root of the information, xx xy xθ yy yθ θθ;
* GTSAM's ``load2D``: a *covariance*, xx xy xθ yy yθ θθ, for lines whose off-diagonals are zero.

``noise="auto"`` reads matrices that are diagonal in TORO's order as TORO's information. Matrices that are diagonal in
the other order are covariances as in ``load2D`` or iSAM's square roots, whichever gives the smaller σ of turns.
``PoseNetwork.noise`` has the choice; other cases need the option. A line without noise has unit noise, as in iSAM.

In 3-D, ``x y z roll pitch yaw`` (R = R_z R_y R_x) + 21 numbers in that order: information (TORO, ``auto``), or as given
by the option. ``EQUIV i j`` (edges that TORO contracts) is ignored; the edges themselves are read.

Poses and landmarks share one index space: a node is a landmark if it is the second index of a ``LANDMARK`` line.
``LANDMARK pose landmark x y c_xx c_xy c_yy``: an isotropic covariance becomes bearing and range with
σ_range = √c and σ_bearing = √(c/10), as ``load2D`` does (the noise at ten metres); any other stays Cartesian. If the
option is information or its square root, it also applies to landmarks, and they stay Cartesian.
"""

from __future__ import annotations

import logging
import os
from typing import Literal, get_args

import numpy as np

from graphslam.core.errors import ConfigError, FormatError
from graphslam.core.geometry import Array
from graphslam.core.network import Ids, Labels, PoseNetwork
from graphslam.core.se3 import quat_multiply
from graphslam.io.g2o import SWAP
from graphslam.io.network_builder import NetworkBuilder, edge_labels, observation_labels, upper_triangle
from graphslam.io.text_records import Records

Noise = Literal["auto", "covariance", "information", "sqrt-information", "toro"]
UNKNOWN_TURN = 0.25
"""If the median variance of turns is larger [rad²], the columns are probably not covariances."""
log = logging.getLogger(__name__)
LAYOUTS: dict[str, tuple[int, int]] = {
    "VERTEX2": (1, 3),
    "EDGE2": (2, 9),
    "ODOMETRY": (2, 9),
    "LANDMARK": (2, 5),
    "VERTEX3": (1, 6),
    "EDGE3": (2, 27),
}
ALIASES = {"VERTEX": "VERTEX2", "EDGE": "EDGE2", "POSE3D_INIT": "VERTEX3"}
IGNORED = ("EQUIV", "EDGE3_INIT", "EDGE3_TRUE", "POSE3D_TRUE", "SOLVE")
_UNIT = ["1", "0", "0", "1", "0", "1"]
_IMPLIED = {
    "EDGE2": (6, _UNIT),
    "ODOMETRY": (6, _UNIT),
    "EDGE3": (9, [str(int(i == j)) for i in range(6) for j in range(i, 6)]),
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
        Project indefinite matrices to positive definite ones instead of raising an error.
    create_missing : bool
        Create vertices that occur only in edges, instead of raising an error.
    """
    if noise not in get_args(Noise):
        raise ConfigError(f"unknown noise format {noise!r}; known: {', '.join(get_args(Noise))}")
    records = Records(path, text, LAYOUTS, ignored=IGNORED, aliases=ALIASES, implied=_IMPLIED)
    rows = records.rows
    if in_3d := [tag for tag in ("VERTEX3", "EDGE3") if len(rows[tag])]:
        if in_2d := [tag for tag in rows if tag not in in_3d and len(rows[tag])]:
            where = records.where(int(rows[in_3d[0]].lines[0]))
            raise FormatError(f"{in_2d[0]} and {in_3d[0]} in one file", where=where, wanted="one dimension")
        return _spatial(records, NetworkBuilder(records.path, 3, records.where, repair, create_missing), noise)
    build = NetworkBuilder(records.path, 2, records.where, repair, create_missing)
    vertices = rows["VERTEX2"]
    build.add_vertices(vertices.whole[:, 0], vertices.real, vertices.lines)
    parts = rows["EDGE2"], rows["ODOMETRY"]
    lines, name = np.concatenate([p.lines for p in parts]), noise
    if len(lines):
        order = np.argsort(lines)
        pairs, lines = np.concatenate([p.whole for p in parts])[order], lines[order]
        values = np.concatenate([p.real for p in parts])[order]
        name = _guess(values[:, 3:], records, lines) if noise == "auto" else name
        information = _information(values[:, 3:], name, build, edge_labels(pairs))
        build.noise = {
            "toro": "information, TORO order",
            "sqrt-information": "square-root information",
            "covariance": "covariance, as GTSAM's load2D reads it",
        }.get(name, name)
        build.add_edges(pairs, values[:, :3], information, lines)
    if len(rows["LANDMARK"]):
        _landmarks(records, build, name)
    return build.build()


def _spatial(records: Records, build: NetworkBuilder, noise: Noise) -> PoseNetwork:
    vertices, edges = records.rows["VERTEX3"], records.rows["EDGE3"]
    build.add_vertices(vertices.whole[:, 0], _euler_poses(vertices.real), vertices.lines)
    name: Noise = "information" if noise in ("auto", "toro") else noise
    if noise == "auto" and not np.isin(edges.real[:, 6:], (0.0, 1.0)).all():  # else both are the same
        log.warning("%s: EDGE3 is read as information; if a square root of it: --noise sqrt-information", records.path)
    information = _information(edges.real[:, 6:], name, build, edge_labels(edges.whole))
    build.noise = "information, TORO order" if name == "information" else name
    build.add_edges(edges.whole, _euler_poses(edges.real[:, :6]), information[:, SWAP][:, :, SWAP], edges.lines)
    return build.build()


def _euler_poses(rows: Array) -> Array:
    """``x y z qx qy qz qw`` from ``x y z roll pitch yaw``."""
    q = np.zeros((3, len(rows), 4))
    for k in range(3):
        q[k, :, k], q[k, :, 3] = np.sin(0.5 * rows[:, 3 + k]), np.cos(0.5 * rows[:, 3 + k])
    return np.column_stack([rows[:, :3], quat_multiply(quat_multiply(q[2], q[1]), q[0])])


def _guess(columns: Array, records: Records, lines: Ids) -> Noise:
    nonzero = columns != 0.0
    patterns: dict[Noise, list[int]] = {"toro": [0, 2, 3], "covariance": [0, 3, 5]}
    for name, places in patterns.items():
        wanted = np.isin(np.arange(6), places)
        if (nonzero == wanted).all():
            if name == "covariance" and (turn := float(np.median(columns[:, 5]))) > UNKNOWN_TURN:
                # σ is √c for a covariance, 1 / c for a square root of the information
                name = "covariance" if turn <= 1.0 else "sqrt-information"
                sigma = np.sqrt(turn) if name == "covariance" else 1.0 / turn
                text = (
                    "%s: noise columns are read as %s, so that σ of a turn is %.2g rad; if they mean something else: "
                )
                text += "--noise covariance (GTSAM) or sqrt-information (iSAM)"
                log.warning(text, records.path, name, sigma)
            return name
    odd = np.flatnonzero((nonzero != np.isin(np.arange(6), [0, 3, 5])).any(axis=1))
    raise FormatError(
        "the meaning of the noise columns is not clear from the numbers",
        where=records.where(int(lines[odd[0]])),
        wanted="--noise covariance, information, sqrt-information or toro (in Python noise=…)",
    )


def _information(columns: Array, noise: Noise, build: NetworkBuilder, labels: Labels) -> Array:
    d = 3 if columns.shape[1] == 6 else 6
    triangle = upper_triangle(columns[:, _TORO] if noise == "toro" else columns, d)
    if noise == "covariance":
        return build.invert(triangle, labels, "edge covariance matrices")
    R = np.triu(triangle)
    return np.asarray(np.swapaxes(R, 1, 2) @ R) if noise == "sqrt-information" else triangle


def _landmarks(records: Records, build: NetworkBuilder, noise: Noise) -> None:
    rows = records.rows["LANDMARK"]
    pairs, lines, labels = rows.whole, rows.lines, observation_labels(rows.whole)
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
