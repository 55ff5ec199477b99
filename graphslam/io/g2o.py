"""Reader and writer of g2o pose graphs.

``VERTEX_SE2 id x y θ``, ``EDGE_SE2 i j x y θ`` + 6 information entries; ``VERTEX_SE3:QUAT id x y z qx qy qz qw``,
``EDGE_SE3:QUAT i j x y z qx qy qz qw`` + 21; ``FIX id …``; 2-D landmarks ``VERTEX_XY id x y``,
``EDGE_SE2_XY i l x y`` + 3, and GTSAM's ``BR i l bearing range σ_bearing σ_range``. Upper triangles row by row.
Priors ``EDGE_PRIOR_SE2 id x y θ`` + 6 and ``EDGE_SE3_PRIOR id parameter x y z qx qy qz qw`` + 21, with or without the
parameter, become edges from an additional vertex, which is fixed at the origin. So do priors of a position alone
(``PoseNetwork.position_priors``): ``EDGE_PRIOR_SE2_XY id x y`` + 3, ``EDGE_SE3_PRIOR_XYZ id parameter x y z`` + 6, with
or without the parameter, and ``EDGE_SE3_PRIOR_XY id x y`` + 3, whose height was not measured.

g2o orders a 3-D information matrix translation first, a :class:`PoseNetwork` rotation first. The entries are not
rescaled, as in GTSAM: the residual of g2o uses the vector part of the quaternion, half the rotation vector, so the two
programs print different objectives for the same file (:mod:`graphslam.solve.network.solve` has both). Files may be
compressed.
"""

from __future__ import annotations

import logging
import os

import numpy as np

from graphslam.core.errors import DataError, FormatError
from graphslam.core.geometry import Array
from graphslam.core.network import Ids, PoseNetwork
from graphslam.core.reading import read_text
from graphslam.io.network_builder import NetworkBuilder, upper_triangle
from graphslam.io.text_records import Records, write_text

log = logging.getLogger(__name__)
# tag -> (integers, floats)
LAYOUTS: dict[str, tuple[int, int]] = {
    "VERTEX_SE2": (1, 3),
    "EDGE_SE2": (2, 9),
    "VERTEX_SE3:QUAT": (1, 7),
    "EDGE_SE3:QUAT": (2, 28),
    "FIX": (-1, 0),
    "VERTEX_XY": (1, 2),
    "EDGE_SE2_XY": (2, 5),
    "BR": (2, 4),
    "EDGE_PRIOR_SE2": (1, 9),
    "EDGE_PRIOR_SE3:QUAT": (2, 28),
    "EDGE_PRIOR_SE2_XY": (1, 5),
    "EDGE_SE3_PRIOR_XYZ": (2, 9),
    "EDGE_SE3_PRIOR_XY": (1, 5),
    "PARAMS_SE3OFFSET": (1, 7),
}
IGNORED = (
    *("PARAMS_SE2OFFSET", "VERTEX_TAG", "VERTEX_CAM", "DATA_TAG"),
    *("ROBOTLASER1", "FLASER", "RLASER", "ODOM", "TRUEPOS", "MARKER", "VERTEX_ELLIPSE"),
)
"""Records without a measurement between vertices: parameters, tags, and sensor data."""
ALIASES = (
    dict.fromkeys(("EDGE_SE3_PRIOR", "EDGE_SE3_PRIOR:QUAT", "EDGE_PRIOR_SE3"), "EDGE_PRIOR_SE3:QUAT")
    | dict.fromkeys(("EDGE_SE2_XY_PRIOR", "EDGE_PRIOR_XY"), "EDGE_PRIOR_SE2_XY")
    | dict.fromkeys(("EDGE_PRIOR_SE3_XYZ", "EDGE_PRIOR_XYZ", "EDGE_POINTXYZ_PRIOR"), "EDGE_SE3_PRIOR_XYZ")
)
_2D = ("VERTEX_SE2", "EDGE_SE2", "EDGE_PRIOR_SE2", "EDGE_PRIOR_SE2_XY", "VERTEX_XY", "EDGE_SE2_XY", "BR")
_3D = ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "EDGE_PRIOR_SE3:QUAT", "EDGE_SE3_PRIOR_XYZ", "EDGE_SE3_PRIOR_XY")
# g2o (translation, rotation) -> graphslam (rotation, translation); the permutation is its own inverse
SWAP = np.array([3, 4, 5, 0, 1, 2])


def read_g2o(path: str | os.PathLike[str], *, repair: bool = False, create_missing: bool = False) -> PoseNetwork:
    """Read a g2o file.

    Parameters
    ----------
    path : path-like
        Plain, or compressed with xz, gzip or bzip2 (detected from the content).
    repair : bool
        Project indefinite information matrices to positive definite ones instead of raising an error; the number is in
        ``PoseNetwork.repaired``.
    create_missing : bool
        Create vertices that occur only in edges, without an initial pose, instead of raising an error. A file without
        vertices is always read.
    """
    return parse_g2o(path, read_text(path), repair=repair, create_missing=create_missing)


def parse_g2o(
    path: str | os.PathLike[str], text: str, *, repair: bool = False, create_missing: bool = False
) -> PoseNetwork:
    """The same from the content of the file; ``path`` names it in errors."""
    # without the parameter: no sensor offset
    implied = dict.fromkeys(("EDGE_PRIOR_SE3:QUAT", "EDGE_SE3_PRIOR_XYZ"), (2, ["0"]))
    records = Records(path, text, LAYOUTS, ignored=IGNORED, aliases=ALIASES, implied=implied)
    rows = records.rows
    in_3d = [tag for tag in _3D if len(rows[tag])]
    in_2d = [tag for tag in _2D if len(rows[tag])]
    if in_2d and in_3d:
        line = int(rows[in_3d[0]].lines[0])
        raise FormatError(f"{in_2d[0]} and {in_3d[0]} in one file", where=records.where(line), wanted="one dimension")
    _check_offsets(records)
    build = NetworkBuilder(records.path, 3 if in_3d else 2, records.where, repair, create_missing)
    for tag, n in records.not_read.items():
        log.info("%s: %d records %s hold no measurement and are not read", records.path, n, tag)
    vertices, edges, priors = (rows[tag] for tag in (_3D if in_3d else _2D)[:3])
    width, d = (7, 6) if in_3d else (3, 3)
    ids, poses, lines = vertices.whole[:, 0], vertices.real, vertices.lines
    fixed, fixed_lines = rows["FIX"].whole[:, 0], rows["FIX"].lines
    pairs, values, at = edges.whole, edges.real, edges.lines
    at_vertex, positions, position_information, position_lines = _positions(records, 3 if in_3d else 2)
    origin = -1
    if len(priors) or len(at_vertex):
        build.create_missing |= not len(ids)  # a file without vertices
        identity = np.eye(width)[-1] * (width == 7)
        still = ids[(poses == identity).all(axis=1) & np.isin(ids, fixed) & ~np.isin(ids, at_vertex)]
        if len(still) and not len(priors):
            origin = int(still[0])  # as in a file that this module wrote
        else:
            named = np.concatenate(
                [ids, edges.whole.ravel(), priors.whole[:, 0], at_vertex, rows["VERTEX_XY"].whole[:, 0]]
            )
            origin = int(np.setdiff1d(np.arange(len(named) + 1), named)[0])
            first_line = np.append(priors.lines, position_lines)[:1]
            ids, poses = np.append(ids, origin), np.vstack([poses, identity])
            lines, fixed_lines = np.append(lines, first_line), np.append(fixed_lines, first_line)
            fixed = np.append(fixed, origin)
    if len(priors):
        pairs = np.vstack([pairs, np.column_stack([np.full(len(priors), origin), priors.whole[:, 0]])])
        values, at = np.vstack([values, priors.real]), np.concatenate([at, priors.lines])
    build.add_vertices(ids, poses, lines)
    marks = rows["VERTEX_XY"]
    build.add_landmarks(marks.whole[:, 0], marks.real, marks.lines)
    build.fixed = fixed, fixed_lines
    information = upper_triangle(values[:, width:], d)
    if in_3d:
        information = information[:, SWAP][:, :, SWAP]
    build.add_edges(pairs, values[:, :width], information, at)
    if len(at_vertex):
        ends = np.stack([np.full(len(at_vertex), origin), at_vertex], axis=1)
        build.add_positions(ends, positions, position_information, position_lines)
    _read_landmarks(records, build)
    return build.build()


def _check_offsets(records: Records) -> None:
    """Refuse priors of a sensor that is not at its vertex."""
    offsets = records.rows["PARAMS_SE3OFFSET"]
    away = offsets.whole[offsets.real[:, :6].any(axis=1), 0]
    for rows in (records.rows["EDGE_PRIOR_SE3:QUAT"], records.rows["EDGE_SE3_PRIOR_XYZ"]):
        bad = np.flatnonzero(np.isin(rows.whole[:, 1], away))
        if len(bad):
            raise FormatError(
                "a prior of a sensor that is not at its vertex", where=records.where(int(rows.lines[bad[0]])),
                got=f"parameter {rows.whole[bad[0], 1]}", wanted="an offset of zero (PARAMS_SE3OFFSET)",
            )  # fmt: skip


def _positions(records: Records, dim: int) -> tuple[Ids, Array, Array, Ids]:
    """Vertices, positions ``(p, dim)``, information ``(p, dim, dim)`` and lines of the priors of a position alone."""
    tags = ("EDGE_PRIOR_SE2_XY",) if dim == 2 else ("EDGE_SE3_PRIOR_XYZ", "EDGE_SE3_PRIOR_XY")
    parts = []
    for rows, size in ((records.rows[tag], 3 if tag.endswith("Z") else 2) for tag in tags):
        z, information = np.zeros((len(rows), dim)), np.zeros((len(rows), dim, dim))
        z[:, :size] = rows.real[:, :size]
        information[:, :size, :size] = upper_triangle(rows.real[:, size:], size)
        parts.append((rows.whole[:, 0], z, information, rows.lines))
    vertices, z, information, lines = (np.concatenate(p) for p in zip(*parts, strict=True))
    marks = records.rows["VERTEX_XY"].whole[:, 0]
    of_mark = np.isin(vertices, marks)
    if of_mark.any():
        log.warning("%s: %d priors of landmarks are left out: they are not read", records.path, of_mark.sum())
    return vertices[~of_mark], z[~of_mark], information[~of_mark], lines[~of_mark]


def _read_landmarks(records: Records, build: NetworkBuilder) -> None:
    cartesian, polar = records.rows["EDGE_SE2_XY"], records.rows["BR"]
    if len(cartesian) and len(polar):
        where = records.where(int(polar.lines[0]))
        raise FormatError("EDGE_SE2_XY and BR in one file", where=where, wanted="one kind of observation")
    if len(cartesian):
        build.add_observations(
            cartesian.whole, cartesian.real[:, :2], upper_triangle(cartesian.real[:, 2:], 2), cartesian.lines
        )
    if len(polar):
        bad = np.flatnonzero(~(polar.real[:, 1:] > 0.0).all(axis=1))
        if len(bad):
            where = records.where(int(polar.lines[bad[0]]))
            raise FormatError("range and standard deviations must be positive", where=where)
        information = np.zeros((len(polar), 2, 2))
        information[:, [0, 1], [0, 1]] = polar.real[:, 2:] ** -2.0
        build.kind = "bearing-range"
        build.add_observations(polar.whole, polar.real[:, :2], information, polar.lines)


def write_g2o(path: str | os.PathLike[str], network: PoseNetwork) -> None:
    """Write a network as g2o with 17 significant digits; ``.xz``, ``.gz`` and ``.bz2`` compress.

    Poses without an initial value are not written, as in a file of edges only.
    """
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if network.dim == 2 else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    priors = network.position_priors
    # an origin of position priors alone is not a vertex of the file
    alone = np.isin(np.arange(len(network)), network.edges[priors, 0])
    alone[np.append(network.edges[~priors].ravel(), network.edges[priors, 1])] = False
    alone[network.observations[:, 0]] = False
    lines = [
        f"{vertex} {v} {_row(p)}"
        for v, p, known in zip(network.ids, network.poses, network.has_initial & ~alone, strict=True)
        if known
    ]
    lines += [
        f"VERTEX_XY {v} {_row(p)}"
        for v, p, known in zip(network.landmark_ids, network.landmarks, network.has_landmark, strict=True)
        if known
    ]
    lines += [f"FIX {v}" for v in network.ids[network.fixed & ~alone]]
    information = network.information
    if network.dim == 3:
        information = information[:, SWAP][:, :, SWAP]
    upper = np.triu_indices(network.tangent_dim)
    tag, d = ("EDGE_PRIOR_SE2_XY", 2) if network.dim == 2 else ("EDGE_SE3_PRIOR_XYZ", 3)
    for (i, j), z, omega, only in zip(
        network.ids[network.edges], network.measurements, information, priors, strict=True
    ):
        if only:  # the information is in the order of g2o
            lines.append(f"{tag} {j} {_row(z[:d])} {_row(omega[:d, :d][np.triu_indices(d)])}")
        else:
            lines.append(f"{edge} {i} {j} {_row(z)} {_row(omega[upper])}")
    lines += _observation_lines(network)
    write_text(path, "\n".join(lines) + "\n")


def _observation_lines(network: PoseNetwork) -> list[str]:
    lines = []
    rows = zip(network.observations, network.observation_values, network.observation_information, strict=True)
    for (i, j), z, omega in rows:
        head = f"{network.ids[i]} {network.landmark_ids[j]} {_row(z)}"
        if network.observation_kind == "cartesian":
            lines.append(f"EDGE_SE2_XY {head} {_row(omega[np.triu_indices(2)])}")
        elif omega[0, 1] != 0.0 or omega[0, 0] <= 0.0 or omega[1, 1] <= 0.0:
            raise DataError(
                "g2o cannot hold correlated bearing-range noise", got=f"{network.ids[i]} sees {network.landmark_ids[j]}"
            )
        else:
            lines.append(f"BR {head} {_row(np.diag(omega) ** -0.5)}")
    return lines


def _row(values: Array) -> str:
    return " ".join(format(float(v), ".17g") for v in values)
