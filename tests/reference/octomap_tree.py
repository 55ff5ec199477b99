"""OctoMap's files written and read the obvious way: recursion over cubes of a dictionary of voxels.

A map is {(i, j, k): log-odds in steps of 1/2048}. Nothing here is shared with the library.
"""

from __future__ import annotations

import itertools
import struct

Voxel = tuple[int, int, int]
Map = dict[Voxel, int]
HALF, DEPTH, STEP = 32768, 16, 1.0 / 2048.0


def header(kind: str, nodes: int, resolution: float) -> bytes:
    """What stands before the nodes."""
    first = "# Octomap OcTree binary file" if kind == "bt" else "# Octomap OcTree file"
    note = "# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
    return f"{first}\n{note}id OcTree\nsize {nodes}\nres {resolution}\ndata\n".encode()


class _Node:
    """A cube: ``children`` None for a leaf of one value, else eight nodes or None."""

    def __init__(self, voxels: Map, corner: Voxel, depth: int) -> None:
        edge = 2 ** (DEPTH - depth)
        self.top = max(voxels.values())
        self.children: list[_Node | None] | None = None
        if len(voxels) == edge**3 and len(set(voxels.values())) == 1:
            return
        parts: list[Map] = [{} for _ in range(8)]
        half = edge // 2
        for v, value in voxels.items():
            upper = [int(v[a] - corner[a] >= half) for a in range(3)]
            parts[upper[0] + 2 * upper[1] + 4 * upper[2]][v] = value
        self.children = []
        for i, part in enumerate(parts):
            low = (corner[0] + half * (i & 1), corner[1] + half * (i >> 1 & 1), corner[2] + half * (i >> 2))
            self.children.append(_Node(part, low, depth + 1) if part else None)

    def count(self) -> int:
        return 1 + sum(c.count() for c in self.children or [] if c)

    def full(self) -> bytes:
        bits = sum(1 << i for i, c in enumerate(self.children or []) if c)
        return struct.pack("<fB", self.top * STEP, bits) + b"".join(c.full() for c in self.children or [] if c)

    def binary(self) -> bytes:
        assert self.children is not None
        code = 0
        for i, c in enumerate(self.children):
            if c:
                code |= (3 if c.children else 1 + c.top) << 2 * i  # of a map of classes: 0 free, 1 occupied
        return struct.pack("<H", code) + b"".join(c.binary() for c in self.children if c and c.children)


def write(voxels: Map, kind: str, resolution: float, threshold: int = 0) -> bytes:
    """The whole file. ``kind``: "ot", or "bt" with occupied = at least the threshold."""
    if kind == "bt":
        voxels = {v: int(value >= threshold) for v, value in voxels.items()}
    if not voxels:
        return header(kind, 0, resolution)
    root = _Node(voxels, (-HALF, -HALF, -HALF), 0)
    return header(kind, root.count(), resolution) + (root.full() if kind == "ot" else root.binary())


def read(data: bytes, low: int, high: int) -> Map:
    """The voxels of a file; leaves of a "bt" get ``low`` (free) or ``high``."""
    head, body = data.split(b"data\n", 1)
    binary = head.startswith(b"# Octomap OcTree binary")
    out: Map = {}
    at = 0

    def fill(corner: Voxel, edge: int, value: int) -> None:
        for v in itertools.product(*(range(c, c + edge) for c in corner)):
            out[v] = value  # type: ignore[index]

    def node(corner: Voxel, edge: int) -> None:
        nonlocal at
        half = edge // 2
        places = [
            (corner[0] + half * (i & 1), corner[1] + half * (i >> 1 & 1), corner[2] + half * (i >> 2)) for i in range(8)
        ]
        if binary:
            (code,) = struct.unpack_from("<H", body, at)
            at += 2
            for i, place in enumerate(places):
                if code >> 2 * i & 3 in (1, 2):
                    fill(place, half, high if code >> 2 * i & 3 == 2 else low)
            for i, place in enumerate(places):
                if code >> 2 * i & 3 == 3:
                    node(place, half)
            return
        value, bits = struct.unpack_from("<fB", body, at)
        at += 5
        if bits == 0:
            fill(corner, edge, round(value / STEP))
        for i, place in enumerate(places):
            if bits >> i & 1:
                node(place, half)

    if body:
        node((-HALF, -HALF, -HALF), 2 * HALF)
    assert at == len(body)
    return out
