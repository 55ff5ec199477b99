"""Reading and writing of OctoMap files: ``.ot`` (log-odds) and ``.bt`` (occupied or free).

Files have the same contents as OctoMap would write for this map: pruned, and inner nodes of a ``.ot`` have the largest
value of their children. The lattice is that of OctoMap, so voxels are identical.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import FormatError, GridError
from graphslam.core.reading import read_bytes
from graphslam.evidence.beams import BeamModel
from graphslam.evidence.compact import GridPieces, check_reach, fill_grid, find_all_states, tree_levels
from graphslam.evidence.cube_kernels import UNSEEN
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.layout import BRICK_VOXELS, DEFAULT_LEVELS, LARGEST_VOXEL, LIMIT, SMALLEST_VOXEL, STEP, UNKNOWN
from graphslam.evidence.octomap_kernels import (
    BRICKS,
    CHILDLESS,
    CUBES,
    ERROR,
    NODES,
    REACH,
    RECORD,
    TOO_DEEP,
    TRUNCATED,
    TreeRecords,
    read_tree,
    write_tree,
)
from graphslam.evidence.pool import GridPool

log = logging.getLogger(__name__)

BINARY_MAGIC, FULL_MAGIC = b"# Octomap OcTree binary file", b"# Octomap OcTree file"
HEADER_LIMIT = 1 << 16
"""Maximum size of a header [bytes]; it may contain any comments."""
OCTOMAP_HALF = 1 << 15
"""Voxels from the centre of the OctoMap cube to its faces."""
GUESS = {True: 74, False: 400}
"""Records per brick without the nodes above it: an upper bound for a ``.bt``, rarely exceeded in a ``.ot``."""
ORDER = sum(
    (np.arange(BRICK_VOXELS) >> 3 * level & 1 << axis) << 2 * axis + level for level in range(3) for axis in range(3)
)
"""Voxels of a brick in octree order: bits 0, 1, 2 are x, y, z in a cube of 2³, the next three those of it in 4³."""
FULL_RECORD = np.dtype([("value", "<f4"), ("code", "u1")])

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Header:
    binary: bool
    nodes: int
    resolution: float
    start: int  # offset of the first record [bytes]

    @property
    def width(self) -> int:
        """Size of a record [bytes]."""
        return 2 if self.binary else FULL_RECORD.itemsize


def read_octomap(
    path: str | os.PathLike[str], *, model: BeamModel | None = None, pool: GridPool | None = None
) -> EvidenceGrid:
    """Read a ``.bt`` or ``.ot`` file of an OctoMap ``OcTree``; the format is detected from the header.

    Parameters
    ----------
    model : BeamModel, optional
        The files contain no model. Leaves of a ``.bt`` get its clamping values, as in OctoMap.
    pool : GridPool, optional
        Default: a new pool with as many levels as the map needs, at least `layout.DEFAULT_LEVELS`.

    Returns
    -------
    EvidenceGrid
        Log-odds of a ``.ot`` are rounded to the nearest multiple of `layout.STEP` and clipped at ±16.
    """
    where = str(path)
    data = read_bytes(path)
    head = _read_header(data, where)
    if head.nodes == 0 and len(data) == head.start:
        return EvidenceGrid(head.resolution, model=model, pool=pool)
    records = _read_records(data, head, where)
    model = BeamModel() if model is None else model
    pieces, reach = _pieces_of(records, head, model, where)
    levels = tree_levels(reach)
    assert levels is not None  # the OctoMap cube is smaller than our largest cube
    pool = GridPool(max(levels, DEFAULT_LEVELS)) if pool is None else pool
    check_reach(reach, pool, where)
    return fill_grid(EvidenceGrid(head.resolution, model=model, pool=pool), pieces)


def _read_header(data: bytes, where: str) -> _Header:
    """The text before the records (octomap/AbstractOcTree.cpp, readHeader)."""
    first = data[:HEADER_LIMIT].split(b"\n", 1)[0]
    if first.startswith(BINARY_MAGIC):
        binary = True
    elif first.startswith(FULL_MAGIC):
        binary = False
    else:
        raise FormatError(
            "not an OctoMap file",
            where=f"{where}, byte 0",
            got=repr(first[:40]),
            wanted=f"{BINARY_MAGIC.decode()!r} or {FULL_MAGIC.decode()!r}",
        )
    fields: dict[str, tuple[str, int]] = {}
    at = 0
    while True:
        end = data.find(b"\n", at, HEADER_LIMIT)
        if end < 0:
            raise FormatError("header is truncated", where=f"{where}, byte {min(len(data), HEADER_LIMIT)}")
        words = data[at:end].decode("latin-1").split()
        if words and words[0] == "data":
            start = end + 1
            break
        if words and not words[0].startswith("#"):
            fields[words[0]] = (words[1] if len(words) > 1 else "", at)
        at = end + 1
    for name in ("id", "size", "res"):
        if name not in fields:
            raise FormatError(f"header has no {name!r}", where=f"{where}, byte {start}")
    kind, at = fields["id"]
    if kind not in ("OcTree", "1"):  # 1: the name in early versions of OctoMap
        raise FormatError("another type of OctoMap tree", where=f"{where}, byte {at}", got=kind, wanted="OcTree")
    size, at = fields["size"]
    if not (size.isascii() and size.isdigit()):
        raise FormatError("number of nodes is impossible", where=f"{where}, byte {at}", got=repr(size))
    text, at = fields["res"]
    try:
        resolution = float(text)
    except ValueError:
        resolution = math.nan
    if not SMALLEST_VOXEL <= resolution <= LARGEST_VOXEL:
        raise FormatError(
            "resolution is impossible",
            where=f"{where}, byte {at}",
            got=repr(text),
            wanted=f"{SMALLEST_VOXEL:g} to {LARGEST_VOXEL:g} m",
        )
    return _Header(binary, int(size), resolution, start)


def _read_records(data: bytes, head: _Header, where: str) -> TreeRecords:
    """The bytes after the header as arrays; the tree structure is not checked here."""
    width, tally = head.width, np.zeros(6, np.int64)
    number, rest = divmod(len(data) - head.start, width)
    if rest:
        raise FormatError(
            "file ends within a record", where=f"{where}, byte {len(data)}", got=f"{rest} bytes", wanted=f"{width}"
        )
    if head.binary:
        codes = np.frombuffer(data, "<u2", number, head.start)
        return TreeRecords(codes.astype(np.uint16), np.zeros(0, np.int16), tally)
    rows = np.frombuffer(data, FULL_RECORD, number, head.start)
    floats = np.ascontiguousarray(rows["value"])
    bad = np.flatnonzero(~np.isfinite(floats))
    if len(bad):
        raise FormatError(
            "log-odds of a node is not finite",
            where=f"{where}, byte {head.start + width * int(bad[0])}",
            got=float(floats[bad[0]]),
        )
    leaf = rows["code"] == 0
    cut = int(np.count_nonzero(np.abs(floats[leaf]) > LIMIT * STEP))
    if cut:
        log.warning("%s: log-odds of %d leaves cut at ±%g", where, cut, LIMIT * STEP)
    values = np.rint(np.clip(floats, -LIMIT * STEP, LIMIT * STEP) * np.float32(1 / STEP)).astype(np.int16)
    return TreeRecords(rows["code"].astype(np.uint16), values, tally)


def _pieces_of(records: TreeRecords, head: _Header, model: BeamModel, where: str) -> tuple[GridPieces, int]:
    """Pieces in the records, and their extent [voxels]; the tree structure is checked before memory is allocated."""
    tally = records.tally
    bricks, cubes = np.zeros((0, 3), np.int64), np.zeros((0, 5), np.int64)
    values = np.zeros((0, BRICK_VOXELS), np.int16)
    low, high = model.clamp_steps
    read_tree(records, low, high, bricks, values, cubes)
    _check_tree(records, head, where)
    bricks, cubes = np.empty((tally[BRICKS], 3), np.int64), np.empty((tally[CUBES], 5), np.int64)
    values = np.full((len(bricks), BRICK_VOXELS), UNKNOWN, np.int16)
    read_tree(records, low, high, bricks, values, cubes)
    return GridPieces(bricks, values, cubes[:, :3], cubes[:, 3], cubes[:, 4]), int(tally[REACH])


def _check_tree(records: TreeRecords, head: _Header, where: str) -> None:
    tally, record = records.tally, int(records.tally[RECORD])
    place = f"{where}, byte {head.start + head.width * record}"
    if tally[ERROR] == TRUNCATED:
        raise FormatError("tree is truncated", where=place, got=f"{record} records", wanted="more")
    if tally[ERROR] == TOO_DEEP:
        raise FormatError("a node lies deeper than 16 levels", where=place)
    if tally[ERROR] == CHILDLESS:
        raise FormatError("an inner node has no children", where=place)
    if record < len(records.codes):
        left = (len(records.codes) - record) * head.width
        raise FormatError("bytes are left over behind the tree", where=place, got=f"{left} bytes")
    if tally[NODES] != head.nodes:
        raise FormatError(
            "number of nodes is not that of the header", where=place, got=int(tally[NODES]), wanted=head.nodes
        )


def write_octomap(grid: EvidenceGrid, path: str | os.PathLike[str]) -> None:
    """Write a grid as an OctoMap ``OcTree``; the file is written atomically.

    Parameters
    ----------
    grid : EvidenceGrid
        A 2-D grid is written as one layer of voxels.
    path : path
        Suffix ``.ot``: exact log-odds. Suffix ``.bt``: known voxels are written as occupied or free by the threshold
        of the model (maximum likelihood); their log-odds are not stored.
    """
    suffix = Path(path).suffix
    if suffix not in (".bt", ".ot"):
        raise FormatError("unknown ending of an OctoMap file", where=str(path), got=suffix, wanted=".bt or .ot")
    binary = suffix == ".bt"
    codes, values, nodes = _records_of(grid, binary, str(path))
    magic = BINARY_MAGIC if binary else FULL_MAGIC
    with atomic_open(path) as stream:
        stream.write(magic + b"\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n")
        stream.write(f"id OcTree\nsize {nodes}\nres {grid.voxel_size!r}\ndata\n".encode("ascii"))
        if binary:
            stream.write(codes.astype("<u2").tobytes())
        else:
            rows = np.empty(len(codes), FULL_RECORD)
            rows["value"], rows["code"] = values * np.float32(STEP), codes
            stream.write(rows.tobytes())


def _records_of(
    grid: EvidenceGrid, binary: bool, where: str
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.int16], int]:
    pool = grid.pool
    codes, values = np.zeros(0, np.uint16), np.zeros(0, np.int16)
    tally = np.zeros(6, np.int64)
    with pool.lock:
        if grid.root == 0:
            return codes, values, 0
        threshold = grid.model.threshold_step
        states = find_all_states([grid], classes=binary, threshold=threshold, maxima=not binary)
        if pool.half > OCTOMAP_HALF:
            _check_middle(grid, states.node, where)
        tally[RECORD] = GUESS[binary] * np.count_nonzero(states.brick != UNSEEN)
        while tally[RECORD] > len(codes):  # once, or twice if the guess was too small
            codes = np.empty(int(tally[RECORD]), np.uint16)
            values = np.empty(0 if binary else len(codes), np.int16)
            write_tree(grid.root, binary, threshold, states, ORDER, pool.tree, TreeRecords(codes, values, tally))
    return codes[: tally[RECORD]], values[: tally[RECORD]], int(tally[NODES])


def _check_middle(grid: EvidenceGrid, states: npt.NDArray[np.int32], where: str) -> None:
    """Raise `GridError` if a grid with 7 levels has known voxels outside the central eight children of its root."""
    children = grid.pool.tree.children[grid.root]
    inner = np.zeros((4, 4, 4), bool)
    inner[1:3, 1:3, 1:3] = True
    outer = children[(children != 0) & ~inner.ravel()]
    if np.any(states[outer] != UNKNOWN):
        raise GridError(
            "known voxels lie outside OctoMap's cube", where=where, wanted=f"±{OCTOMAP_HALF} voxels of the origin"
        )
