"""Compiled functions for cubes of equal voxels: find, share, list and fill them.

The *state* of a brick or node is the common value of all its voxels, or MIXED. With ``classes``, known values are
replaced by FREE_STATE or OCCUPIED_STATE first. The *size* s of a cube: 0 a brick, s a node of level s - 1; its edge is
``8·4**s`` voxels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel
from graphslam.evidence.tree_kernels import (
    child_index,
    drop_brick,
    occupied_lines,
    release_roots,
    take_brick,
    take_node,
)

MIXED, UNSEEN = 1 << 20, 1 << 21  # outside the range of voxel values
FREE_STATE, OCCUPIED_STATE = -1, 1


class States(NamedTuple):
    """States of bricks and nodes below some roots, by id, so that shared parts are examined once.

    Parameters
    ----------
    brick, node : (B,), (N,) int32
        States, initially UNSEEN.
    brick_max, node_max : (B,), (N,) int16
        Largest known value, -32768 if all is unknown; both (0,) if not requested.
    """

    brick: npt.NDArray[np.int32]
    node: npt.NDArray[np.int32]
    brick_max: npt.NDArray[np.int16]
    node_max: npt.NDArray[np.int16]


@callee
def voxel_state(value, classes, threshold):
    """State of one voxel."""
    v = int(value)
    if not classes or v == -32768:
        return v
    return 1 if v >= threshold else -1


@callee
def voxels_state(row, classes, threshold):
    """State of a brick, given its voxels ``(512,)``."""
    if classes:
        s = voxel_state(row[0], classes, threshold)
        for j in range(1, 512):
            if voxel_state(row[j], classes, threshold) != s:
                return 1 << 20
        return s
    first = row[0]
    for line in range(16):
        other = np.int16(0)
        for j in range(32 * line, 32 * line + 32):
            other |= np.int16(row[j] ^ first)  # int16 after each operation, else the loop is not vectorised
        if other != 0:
            return 1 << 20
    return int(first)


@callee
def child_state(child, level, states):
    """State and largest known value of a child of a node of level ``level``."""
    want_max = states.brick_max.shape[0] > 0
    if child == 0:
        return np.int64(-32768), np.int64(-32768)
    if level == 0:
        return np.int64(states.brick[child]), (np.int64(states.brick_max[child]) if want_max else np.int64(-32768))
    return np.int64(states.node[child]), (np.int64(states.node_max[child]) if want_max else np.int64(-32768))


@kernel()
def find_states(root, classes, threshold, tree, states):
    """Compute the states of a root and of everything below it."""
    levels, children = tree.levels, tree.children
    want_max = states.brick_max.shape[0] > 0
    node, cursor = np.empty(9, np.int64), np.empty(9, np.int64)
    for k in range(9):  # np.zeros would take longer to compile
        cursor[k] = 0
    level = levels - 1
    node[level] = root
    while level < levels:
        n, c = node[level], cursor[level]
        if c == 64:
            state, top = 1 << 21, -32768
            for k in range(64):
                s, largest = child_state(np.int64(children[n, k]), level, states)
                top = max(top, largest)
                state = s if state == 1 << 21 or state == s else 1 << 20
            states.node[n] = state
            if want_max:
                states.node_max[n] = top
            level += 1
            continue
        cursor[level] += 1
        child = np.int64(children[n, c])
        if child == 0:
            continue
        if level > 0:
            if states.node[child] == 1 << 21:
                level -= 1
                node[level], cursor[level] = child, 0
        elif states.brick[child] == 1 << 21:
            states.brick[child] = voxels_state(tree.bricks[child], classes, threshold)
            if want_max:
                top = -32768
                for j in range(512):
                    top = max(top, int(tree.bricks[child, j]))
                states.brick_max[child] = top


@kernel()
def share_cubes(root, states, seen, shared, tree):
    """Replace every uniform cube by one shared brick or node per size and value; unknown cubes are removed.

    No value changes, so nodes with several parents are changed in place, for all grids that share them.
    ``seen (N,) uint8`` marks nodes that were visited; ``shared (levels, 65536) int32`` has the brick or node of each
    size and value, 0 if there is none yet.
    """
    one = np.empty(1, np.int64)
    stack = np.empty((64 * 8, 2), np.int64)
    stack[0, 0], stack[0, 1] = root, tree.levels - 1
    n = 1
    seen[root] = 1
    while n > 0:
        n -= 1
        node, level = stack[n, 0], stack[n, 1]
        for c in range(64):
            child = np.int64(tree.children[node, c])
            if child == 0:
                continue
            state = np.int64(states.brick[child]) if level == 0 else np.int64(states.node[child])
            if state != 1 << 20:
                keep = 0
                if state != -32768:
                    keep = int(shared[level, state + 32768])
                    if keep == 0:
                        shared[level, state + 32768] = child
                        keep = child
                if keep != child:
                    tree.children[node, c] = keep
                    if level == 0:
                        tree.brick_ref[keep] += 1 if keep != 0 else 0
                        drop_brick(child, tree.brick_ref, tree.brick_free, tree.counters)
                    else:
                        tree.node_ref[keep] += 1 if keep != 0 else 0
                        one[0] = child
                        release_roots(
                            one, level, tree.children, tree.node_ref, tree.brick_ref, tree.node_free, tree.brick_free,
                            tree.counters,
                        )  # fmt: skip
                    continue
            if level > 0 and seen[child] == 0:
                seen[child] = 1
                stack[n, 0], stack[n, 1] = child, level - 1
                n += 1


@kernel()
def list_pieces(root, levels, children, states, mixed, cubes, found):
    """List known space: mixed bricks as [packed offset coordinates, id] in ``mixed (n, 2)``, the largest uniform cubes
    as [packed offset coordinates of their first brick, size, value] in ``cubes (m, 3)``.

    ``found (2,)`` gets the numbers of both, even if the arrays are too short. The root is never listed as one cube.
    """
    stack = np.empty((64 * 8, 5), np.int64)
    stack[0, 0], stack[0, 1] = root, levels - 1
    stack[0, 2], stack[0, 3], stack[0, 4] = 0, 0, 0
    n = 1
    found[0], found[1] = 0, 0
    while n > 0:
        n -= 1
        node, level = stack[n, 0], stack[n, 1]
        x, y, z = stack[n, 2], stack[n, 3], stack[n, 4]
        shift = 2 * level
        for c in range(64):
            child = np.int64(children[node, c])
            if child == 0:
                continue
            state = np.int64(states.brick[child]) if level == 0 else np.int64(states.node[child])
            if state == -32768:
                continue
            cx, cy, cz = x + ((c & 3) << shift), y + (((c >> 2) & 3) << shift), z + ((c >> 4) << shift)
            key = (cz << 40) | (cy << 20) | cx
            if state != 1 << 20:
                if found[1] < cubes.shape[0]:
                    cubes[found[1], 0], cubes[found[1], 1], cubes[found[1], 2] = key, level, state
                found[1] += 1
            elif level == 0:
                if found[0] < mixed.shape[0]:
                    mixed[found[0], 0], mixed[found[0], 1] = key, child
                found[0] += 1
            else:
                stack[n, 0], stack[n, 1] = child, level - 1
                stack[n, 2], stack[n, 3], stack[n, 4] = cx, cy, cz
                n += 1


# --- building a tree without other owners: capacity reserved, root owned, no shared node on any path --------------


@callee
def make_path(root, bx, by, bz, size, tree):
    """Node above a brick whose children are cubes of size ``size``, and the child index; missing nodes are created."""
    node = root
    for level in range(tree.levels - 1, size, -1):
        c = child_index(bx, by, bz, level)
        child = np.int64(tree.children[node, c])
        if child == 0:
            child = take_node(tree.children, tree.node_ref, tree.node_occupied, tree.node_free, tree.counters)
            tree.children[node, c] = child
        node = child
    return node, child_index(bx, by, bz, size)


@callee
def uniform_cube(size, value, threshold, uniform, tree):
    """Brick or node whose voxels all have one value; created if ``uniform (levels, 65536) int32`` has none yet.

    The caller must increase its parent count.
    """
    k = value + 32768
    occupied = value >= threshold
    if uniform[0, k] == 0:
        b = take_brick(tree.brick_ref, tree.brick_free, tree.counters)
        tree.brick_ref[b] = 0
        for j in range(512):
            tree.bricks[b, j] = value
        tree.brick_lines[b] = 0xFFFF if occupied else 0
        uniform[0, k] = b
    for s in range(1, size + 1):
        if uniform[s, k] == 0:
            n = take_node(tree.children, tree.node_ref, tree.node_occupied, tree.node_free, tree.counters)
            tree.node_ref[n] = 0
            child = int(uniform[s - 1, k])
            for c in range(64):
                tree.children[n, c] = child
            if s == 1:
                tree.brick_ref[child] += 64
            else:
                tree.node_ref[child] += 64
            if occupied:
                tree.node_occupied[n] = ~np.uint64(0)
            uniform[s, k] = n
    return int(uniform[size, k])


@callee
def finalise_occupied(root, threshold, tree):
    """Set the occupancy flags of a new tree; parts with several parents have theirs already."""
    node, cursor = np.empty(9, np.int64), np.empty(9, np.int64)
    for k in range(9):  # np.zeros would take longer to compile
        cursor[k] = 0
    level = tree.levels - 1
    node[level] = root
    while level < tree.levels:
        n, c = node[level], cursor[level]
        if c == 64:
            flags = np.uint64(0)
            for k in range(64):
                child = np.int64(tree.children[n, k])
                if child == 0:
                    continue
                if tree.brick_lines[child] != 0 if level == 0 else tree.node_occupied[child] != np.uint64(0):
                    flags |= np.uint64(1) << np.uint64(k)
            tree.node_occupied[n] = flags
            level += 1
            continue
        cursor[level] += 1
        child = np.int64(tree.children[n, c])
        if child == 0:
            continue
        if level > 0:
            if tree.node_ref[child] == 1:
                level -= 1
                node[level], cursor[level] = child, 0
        elif tree.brick_ref[child] == 1:
            tree.brick_lines[child] = occupied_lines(child, threshold, tree.bricks)


@kernel()
def build_tree(root, corners, values, cubes, threshold, uniform, tree):
    """Fill an empty grid with bricks (offset coordinates ``corners (n, 3) int64``, ``values (n, 512) int16``) and cubes
    ``(m, 5) int64`` [offset coordinates of the first brick, log2 of the edge ≥ 8 in voxels, value] without overlaps. A
    cube with an even log2 is eight children of a node, a cube with an odd log2 is one child.
    """
    for k in range(corners.shape[0]):
        lowest = tree.levels - tree.levels  # 0, but not a literal, for which make_path would be compiled again
        node, c = make_path(root, corners[k, 0], corners[k, 1], corners[k, 2], lowest, tree)
        b = take_brick(tree.brick_ref, tree.brick_free, tree.counters)
        tree.children[node, c] = b
        for j in range(512):
            tree.bricks[b, j] = values[k, j]
    for k in range(cubes.shape[0]):
        size = (cubes[k, 3] - 3) >> 1
        child = uniform_cube(size, cubes[k, 4], threshold, uniform, tree)
        for part in range(1 if cubes[k, 3] & 1 else 8):
            x = cubes[k, 0] + ((part & 1) << 2 * size)
            y = cubes[k, 1] + (((part >> 1) & 1) << 2 * size)
            node, c = make_path(root, x, y, cubes[k, 2] + ((part >> 2) << 2 * size), size, tree)
            tree.children[node, c] = child
            if size == 0:
                tree.brick_ref[child] += 1
            else:
                tree.node_ref[child] += 1
    finalise_occupied(root, threshold, tree)
