"""Compiled reading and writing of OctoMap trees (Hornung et al. 2013; octomap/OcTreeBaseImpl.hxx).

An OctoMap tree has 16 levels and covers a cube of 2¹⁶ voxels per edge; the key of a voxel is its signed coordinate +
2¹⁵. Bits 0, 1, 2 of the child index i select the upper half in x, y, z. Nodes are written depth first, a node before
its children. Here m = 16 - depth is the level of a node above the voxels: its edge is 2^m voxels.

A *record* is the data of a node in the file: in a ``.bt`` two bits per child, for nodes with children only; in a
``.ot`` the log-odds of any node and one bit per child.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee
from graphslam.evidence.cube_kernels import child_state, voxel_state
from graphslam.evidence.kernels import kernel

# error codes, and indices in a tally
TRUNCATED, TOO_DEEP, CHILDLESS = 1, 2, 3
ERROR, RECORD, NODES, REACH, BRICKS, CUBES = 0, 1, 2, 3, 4, 5


class TreeRecords(NamedTuple):
    """Records of a file.

    Parameters
    ----------
    codes : (r,) uint16
        Bits of the children.
    values : (r,) int16 or (0,)
        Log-odds of a ``.ot``, in units of `layout.STEP`; empty for a ``.bt``.
    tally : (6,) int64
        Error, records, nodes, voxels from the centre to the farthest face, bricks, cubes. The counts are complete even
        if the output arrays are too short.
    """

    codes: npt.NDArray[np.uint16]
    values: npt.NDArray[np.int16]
    tally: npt.NDArray[np.int64]


@kernel()
def read_tree(records, low, high, bricks, brick_values, cubes):
    """Parse the records of a file; list its bricks, and its leaves with an edge of 8 voxels or more.

    low, high : values of the free and occupied leaves of a ``.bt``.
    bricks : (b, 3) int64 out, signed coordinates; brick_values : (b, 512) int16 out, all unknown before.
    cubes : (c, 5) int64 out, signed coordinates of the first brick, m, value.
    """
    codes, values, tally = records
    stack = np.empty((8 * 17, 5), np.int64)
    binary = values.shape[0] == 0
    record, nodes, reach, found, large = 0, 0, 0, 0, 0
    # level, corner, kind from the parent: 1 free leaf, 2 occupied leaf, 3 node with a record
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3], stack[0, 4] = 16, 0, 0, 0, 3
    n = 1
    while n > 0:
        n -= 1
        m, x, y, z, kind = stack[n, 0], stack[n, 1], stack[n, 2], stack[n, 3], stack[n, 4]
        nodes += 1
        value, code = low, 0
        if kind == 3:
            tally[RECORD] = record
            if record == codes.shape[0]:
                tally[ERROR] = TRUNCATED
                return
            code = np.int64(codes[record])
            if not binary:
                value = np.int64(values[record])
            elif code == 0:
                tally[ERROR] = CHILDLESS
                return
            record += 1
        elif kind == 2:
            value = high
        edge = 1 << m
        if code != 0:
            if m == 0:
                tally[ERROR] = TOO_DEEP
                return
            if m == 3:
                if found < bricks.shape[0]:
                    bricks[found, 0], bricks[found, 1], bricks[found, 2] = (
                        (x >> 3) - 4096,
                        (y >> 3) - 4096,
                        (z >> 3) - 4096,
                    )
                found += 1
            half = edge >> 1
            for k in range(8):
                i = 7 - k  # reversed, because the stack is last in, first out
                what = (code >> (2 * i)) & 3 if binary else 3 * ((code >> i) & 1)
                if what != 0:
                    stack[n, 0] = m - 1
                    stack[n, 1] = x + half * (i & 1)
                    stack[n, 2] = y + half * ((i >> 1) & 1)
                    stack[n, 3] = z + half * (i >> 2)
                    stack[n, 4] = what
                    n += 1
            continue
        # a leaf
        near, far = min(x, y, z), max(x, y, z)
        reach = max(reach, 32768 - near, far + edge - 32768)
        if m >= 3:
            if large < cubes.shape[0]:
                cubes[large, 0], cubes[large, 1], cubes[large, 2] = (x >> 3) - 4096, (y >> 3) - 4096, (z >> 3) - 4096
                cubes[large, 3], cubes[large, 4] = m, value
            large += 1
        elif found <= brick_values.shape[0]:
            j = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
            for dz in range(edge):
                for dy in range(edge):
                    for dx in range(edge):
                        brick_values[found - 1, j + (dz << 6) + (dy << 3) + dx] = value
    tally[RECORD], tally[NODES], tally[REACH], tally[BRICKS], tally[CUBES] = record, nodes, reach, found, large


# --- writing -----------------------------------------------------------------------------------------------------
#
# A node of the octree is (m, id, part) in our tree. Our nodes have 4³ children, so an octree node of even m ≥ 4 is an
# octant of one of our nodes, one of odd m ≥ 5 is a whole node, and m = 3 is a brick. Octree nodes above the octants of
# our root (m = top = 2·levels + 2) contain one such octant each, because our root is centred on a corner of theirs.


@callee
def child_of(m, node, part, i, levels, children):
    """Child i of a node of the octree as (id, part)."""
    ix, iy, iz = i & 1, (i >> 1) & 1, i >> 2
    top = 2 * levels + 2
    if m > top:
        if m == 16:
            return node, i
        return (node, part) if i == 7 - part else (0, 0)
    if m == 16:  # 7 levels: the OctoMap cube is the centre of ours
        return np.int64(children[node, ((1 + iz) << 4) | ((1 + iy) << 2) | (1 + ix)]), 0
    if m & 1:
        return node, i
    z, y, x = 2 * (part >> 2) + iz, 2 * ((part >> 1) & 1) + iy, 2 * (part & 1) + ix
    return np.int64(children[node, (z << 4) | (y << 2) | x]), 0


@callee
def tree_node_state(m, node, part, levels, children, states):
    """State of a node of the octree, and its largest known value if ``states`` has maxima."""
    if node == 0 or m == 3 or m == 16 or (m & 1 == 1 and m < 2 * levels + 2):
        return child_state(node, m - 3, states)
    state, largest = 1 << 21, -32768
    level = min(m, 2 * levels + 2)
    for i in range(8):
        child, _ = child_of(level, node, part, i, levels, children)
        s, v = child_state(child, level - 4, states)
        largest = max(largest, v)
        state = s if state == 1 << 21 or state == s else 1 << 20
    if m > level and state != -32768:
        state = 1 << 20  # seven of its eight octants lie outside our cube
    return state, largest


@callee
def write_brick(row, order, classes, threshold, record, records):
    """Write the records of a mixed brick ``row (512,)``, from index ``record`` on; returns the index after the last.

    order : (512,) int64, voxels of the brick in octree order: each 8 in sequence are a cube of 2³, each 64 a cube of
    4³.
    """
    codes, values, tally = records
    states, maxima = np.empty(73, np.int64), np.empty(73, np.int64)  # cubes of 2³, cubes of 4³, the brick
    for q in range(73):
        state, largest = 1 << 21, -32768
        for c in range(8):
            if q < 64:
                v = np.int64(row[order[8 * q + c]])
                s = voxel_state(v, classes, threshold)
            else:
                v, s = maxima[8 * (q - 64) + c], states[8 * (q - 64) + c]
            largest = max(largest, v)
            state = s if state == 1 << 21 or state == s else 1 << 20
        states[q], maxima[q] = state, largest
    room = codes.shape[0]
    nodes = 0
    for k in range(73):  # depth first: the brick, then each cube of 4³ (k = 1, 10, …) before its cubes of 2³
        q = 72 if k == 0 else (64 + (k - 1) // 9 if (k - 1) % 9 == 0 else k - 2 - (k - 1) // 9)
        state = states[q]
        if state == -32768 or (q < 64 and states[64 + (q >> 3)] != 1 << 20):
            continue
        nodes += 1
        code = 0
        if state == 1 << 20:
            for c in range(8):
                if q < 64:
                    s = voxel_state(row[order[8 * q + c]], classes, threshold)
                else:
                    s = states[8 * (q - 64) + c]
                if s != -32768:
                    code |= ((3 if s == 1 << 20 else (2 if s == 1 else 1)) << (2 * c)) if classes else (1 << c)
        elif classes:
            continue
        if record < room:
            codes[record] = code
            if not classes:
                values[record] = maxima[q]
        record += 1
        if q >= 64 or state != 1 << 20:
            continue
        for c in range(8):
            v = row[order[8 * q + c]]
            if v != -32768:
                nodes += 1
                if not classes:
                    if record < room:
                        codes[record], values[record] = 0, v
                    record += 1
    tally[NODES] += nodes
    return record


@kernel()
def write_tree(root, classes, threshold, states, order, tree, records):
    """Write the records of a grid; nodes with one value (``classes``, for a ``.bt``: one class) are pruned.

    order : see :func:`write_brick`.
    """
    codes, values, tally = records
    stack = np.empty((8 * 17, 5), np.int64)
    # read from the stack: for literals tree_node_state would be compiled again
    stack[0, 0], stack[0, 1], stack[0, 2] = 16, root, 0
    m, node, part = stack[0, 0], stack[0, 1], stack[0, 2]
    state, largest = tree_node_state(m, node, part, tree.levels, tree.children, states)
    room = codes.shape[0]
    tally[RECORD], tally[NODES] = 0, 0
    record = tally[RECORD]  # not a literal either
    n = 0
    if state != -32768:
        stack[0, 3], stack[0, 4] = state, largest
        n = 1
    while n > 0:
        n -= 1
        m, node, part, state, largest = stack[n, 0], stack[n, 1], stack[n, 2], stack[n, 3], stack[n, 4]
        if m == 3 and state == 1 << 20:
            record = write_brick(tree.bricks[node], order, classes, threshold, record, records)
            continue
        tally[NODES] += 1
        leaf = state != 1 << 20
        if classes and leaf:  # a .bt has no records of leaves
            continue
        code = 0
        if not leaf:
            for k in range(8):
                i = 7 - k
                child, where = child_of(m, node, part, i, tree.levels, tree.children)
                s, v = tree_node_state(m - 1, child, where, tree.levels, tree.children, states)
                if s == -32768:
                    continue
                if classes:
                    code |= (3 if s == 1 << 20 else (2 if s == 1 else 1)) << (2 * i)
                else:
                    code |= 1 << i
                stack[n, 0], stack[n, 1], stack[n, 2], stack[n, 3], stack[n, 4] = m - 1, child, where, s, v
                n += 1
        if record < room:
            codes[record] = code
            if not classes:
                values[record] = largest
        record += 1
    tally[RECORD] = record
