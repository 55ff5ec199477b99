"""Compiled operations on the trees of a pool: allocate, copy on write, descend, read, write, release.

Capacity is not checked here: callers reserve it first, so that no tree is left half-changed. Node 0 and brick 0 mean
"absent"; brick 0 is all unknown, so it may be read as a source.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel

NODES_USED, NODES_FREE, BRICKS_USED, BRICKS_FREE = 0, 1, 2, 3


class Tree(NamedTuple):
    """Arrays of the nodes and bricks of all grids of a pool (:mod:`layout`).

    Kernels that are called for every scan take single arrays: tuples make the insertion of a planar scan 8 % slower.

    Parameters
    ----------
    children : (N, 64) int32
        Ids of the children: nodes, or bricks for a node of level 0.
    node_ref, brick_ref : (N,), (B,) int32
        Numbers of parents.
    node_occupied : (N,) uint64
        Bits of the children that contain an occupied voxel.
    bricks : (B, 512) int16
    brick_lines : (B,) uint16
        Bits of the lines of 32 voxels that contain an occupied one.
    node_free, brick_free : (N,), (B,) int32
        Stacks of free ids.
    counters : (5,) int64
        First node never used, free nodes on the stack, first brick never used, free bricks on the stack, 1 while an
        update is between its phases.
    levels, half : int
        Levels of nodes; voxels from the centre of the addressable cube to its faces.
    """

    children: npt.NDArray[np.int32]
    node_ref: npt.NDArray[np.int32]
    node_occupied: npt.NDArray[np.uint64]
    node_free: npt.NDArray[np.int32]
    bricks: npt.NDArray[np.int16]
    brick_ref: npt.NDArray[np.int32]
    brick_lines: npt.NDArray[np.uint16]
    brick_free: npt.NDArray[np.int32]
    counters: npt.NDArray[np.int64]
    levels: int
    half: int


@callee
def child_index(bx, by, bz, level):
    """Index of the child that contains a brick, in a node of level ``level``."""
    s = 2 * level
    return (((bz >> s) & 3) << 4) | (((by >> s) & 3) << 2) | ((bx >> s) & 3)


@callee
def take_node(children, node_ref, node_occupied, node_free, counters):
    """Allocate an empty node with one parent."""
    if counters[NODES_FREE] > 0:
        counters[NODES_FREE] -= 1
        n = int(node_free[counters[NODES_FREE]])
    else:
        n = int(counters[NODES_USED])
        counters[NODES_USED] += 1
    for c in range(64):
        children[n, c] = 0
    node_ref[n] = 1
    node_occupied[n] = np.uint64(0)
    return n


@callee
def take_brick(brick_ref, brick_free, counters):
    """Allocate a brick with one parent; its voxels are not initialised."""
    if counters[BRICKS_FREE] > 0:
        counters[BRICKS_FREE] -= 1
        b = int(brick_free[counters[BRICKS_FREE]])
    else:
        b = int(counters[BRICKS_USED])
        counters[BRICKS_USED] += 1
    brick_ref[b] = 1
    return b


@callee
def clone_node(source, level, children, node_ref, node_occupied, brick_ref, node_free, counters):
    """Copy a node. The copy has one parent, the source one parent less, the children one more."""
    n = take_node(children, node_ref, node_occupied, node_free, counters)
    for c in range(64):
        child = children[source, c]
        children[n, c] = child
        if child != 0:
            if level == 0:
                brick_ref[child] += 1
            else:
                node_ref[child] += 1
    node_occupied[n] = node_occupied[source]
    node_ref[source] -= 1
    return n


@callee
def own_child(node, c, level, tree):
    """Child of an unshared node, made unshared too: created if missing, copied if shared.

    ``level`` is that of the child.
    """
    children, node_ref, node_occupied, node_free = tree.children, tree.node_ref, tree.node_occupied, tree.node_free
    child = np.int64(children[node, c])
    if child == 0:
        child = take_node(children, node_ref, node_occupied, node_free, tree.counters)
    elif node_ref[child] > 1:
        child = clone_node(
            child, level, children, node_ref, node_occupied, tree.brick_ref, node_free, tree.counters
        )  # fmt: skip
    else:
        return child
    children[node, c] = child
    return child


@callee
def find_node(root, bx, by, bz, levels, children):
    """Node of level 0 that contains a brick, or 0."""
    node = root
    for level in range(levels - 1, 0, -1):
        shift = 2 * level
        c = (((bz >> shift) & 3) << 4) | (((by >> shift) & 3) << 2) | ((bx >> shift) & 3)
        node = np.int64(children[node, c])
        if node == 0:
            return 0
    return node


@callee
def set_occupied(root, bx, by, bz, levels, occupied, children, node_occupied):
    """Set whether a brick contains an occupied voxel, in all nodes on its path, which must be unshared."""
    path = np.empty(8, np.int64)
    path[levels - 1] = root
    for level in range(levels - 1, 0, -1):
        shift = 2 * level
        c = (((bz >> shift) & 3) << 4) | (((by >> shift) & 3) << 2) | ((bx >> shift) & 3)
        path[level - 1] = children[path[level], c]
    bit = occupied
    for level in range(levels):
        shift = 2 * level
        c = (((bz >> shift) & 3) << 4) | (((by >> shift) & 3) << 2) | ((bx >> shift) & 3)
        node = path[level]
        mask = np.uint64(1) << np.uint64(c)
        before = node_occupied[node]
        if bit:
            after = before | mask
        else:
            after = before & ~mask
        if after == before:
            return
        node_occupied[node] = after
        bit = after != np.uint64(0)


@kernel()
def unique_roots(roots, levels, children, node_ref, node_occupied, brick_ref, node_free, counters):
    """Replace the roots ``(n,)`` by copies, and those that are 0 (empty maps) by empty nodes.

    The old root keeps its parent count, because other handles still use it.
    """
    for k in range(roots.shape[0]):
        old = roots[k]
        if old == 0:
            roots[k] = take_node(children, node_ref, node_occupied, node_free, counters)
        else:
            roots[k] = clone_node(old, levels - 1, children, node_ref, node_occupied, brick_ref, node_free, counters)
            node_ref[old] += 1


@callee
def drop_brick(brick, brick_ref, brick_free, counters):
    """Decrease the parent count of a brick; free it at 0."""
    brick_ref[brick] -= 1
    if brick_ref[brick] == 0:
        brick_free[counters[BRICKS_FREE]] = brick
        counters[BRICKS_FREE] += 1


@kernel()
def release_roots(roots, levels, children, node_ref, brick_ref, node_free, brick_free, counters):
    """Free trees; parts shared with other trees stay."""
    # stack size: at most 63 siblings per level, and the node itself
    stack = np.empty(64 * 8, np.int64)
    depth = np.empty(64 * 8, np.int64)
    for k in range(roots.shape[0]):
        stack[0], depth[0] = roots[k], levels - 1
        n = 1
        while n > 0:
            n -= 1
            node, level = stack[n], depth[n]
            node_ref[node] -= 1
            if node_ref[node] > 0:
                continue
            for c in range(64):
                child = np.int64(children[node, c])
                if child == 0:
                    continue
                if level == 0:
                    drop_brick(child, brick_ref, brick_free, counters)
                else:
                    stack[n], depth[n] = child, level - 1
                    n += 1
            node_free[counters[NODES_FREE]] = node
            counters[NODES_FREE] += 1


@kernel()
def list_bricks(root, levels, children, out):
    """Number of bricks below a root; fills the rows of ``out (n, 2)`` [packed offset coordinates, brick]."""
    stack = np.empty((64 * 8, 5), np.int64)  # node, level, coordinates of its corner in bricks
    stack[0, 0], stack[0, 1] = root, levels - 1
    stack[0, 2], stack[0, 3], stack[0, 4] = 0, 0, 0
    n, found = 1, 0
    while n > 0:
        n -= 1
        node, level = stack[n, 0], stack[n, 1]
        x, y, z = stack[n, 2], stack[n, 3], stack[n, 4]
        shift = 2 * level
        for c in range(64):
            child = np.int64(children[node, c])
            if child == 0:
                continue
            cx, cy, cz = x + ((c & 3) << shift), y + (((c >> 2) & 3) << shift), z + ((c >> 4) << shift)
            if level == 0:
                if found < out.shape[0]:
                    out[found, 0] = (cz << 40) | (cy << 20) | cx
                    out[found, 1] = child
                found += 1
            else:
                stack[n, 0], stack[n, 1] = child, level - 1
                stack[n, 2], stack[n, 3], stack[n, 4] = cx, cy, cz
                n += 1
    return found


@kernel()
def gather_bricks(ids, bricks, out):
    """Copy bricks to rows of ``out (n, 512)``."""
    for k in range(ids.shape[0]):
        for j in range(512):  # a copy of whole rows would take 1 s to compile
            out[k, j] = bricks[ids[k], j]


@kernel()
def read_values(root, points, scale, half, levels, children, bricks, out):
    """Values of the voxels that contain points ``(n, 3)`` [m]; -32768 outside the cube."""
    edge = 2.0 * half
    for k in range(points.shape[0]):
        x, y, z = points[k, 0] * scale + half, points[k, 1] * scale + half, points[k, 2] * scale + half
        out[k] = -32768
        if root == 0 or not (0.0 <= x < edge and 0.0 <= y < edge and 0.0 <= z < edge):
            continue
        i, j, l = int(x), int(y), int(z)
        parent = find_node(root, i >> 3, j >> 3, l >> 3, levels, children)
        if parent == 0:
            continue
        b = np.int64(children[parent, (((l >> 3) & 3) << 4) | (((j >> 3) & 3) << 2) | ((i >> 3) & 3)])
        out[k] = bricks[b, ((l & 7) << 6) | ((j & 7) << 3) | (i & 7)]


@callee
def occupied_lines(brick, threshold, bricks):
    """Bits of the lines of a brick that contain an occupied voxel."""
    lines = 0
    for line in range(16):
        for j in range(32):
            v = bricks[brick, 32 * line + j]
            if v >= threshold and v != -32768:
                lines |= 1 << line
                break
    return lines


@kernel()
def write_bricks(root, keys, values, threshold, tree):
    """Replace bricks at packed offset coordinates ``keys (n,)`` by ``values (n, 512)``; the root must be unshared."""
    for k in range(keys.shape[0]):
        bx, by, bz = keys[k] & 0xFFFFF, (keys[k] >> 20) & 0xFFFFF, keys[k] >> 40
        parent = root
        for level in range(tree.levels - 1, 0, -1):
            c = child_index(bx, by, bz, level)
            parent = own_child(parent, c, level - 1, tree)
        c = ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)
        b = np.int64(tree.children[parent, c])
        if b == 0 or tree.brick_ref[b] > 1:
            if b != 0:
                tree.brick_ref[b] -= 1
            b = take_brick(tree.brick_ref, tree.brick_free, tree.counters)
            tree.children[parent, c] = b
        for j in range(512):  # a copy of whole rows would take 2 s to compile
            tree.bricks[b, j] = values[k, j]
        lines = occupied_lines(b, threshold, tree.bricks)
        tree.brick_lines[b] = lines
        set_occupied(root, bx, by, bz, tree.levels, lines != 0, tree.children, tree.node_occupied)
