"""Compiled work on cubes of equal voxels: find them, share them, list them, fill them.

The *state* of a brick or node is the value all its voxels have, or MIXED. States are kept in tables by id, so that a
part of a tree that is shared many times (also within one grid) is looked at once: ``brick_state (B,) int32``,
``node_state (N,) int32``, UNSEEN to begin with. Where only classes matter, the values are reduced to FREE_STATE and
OCCUPIED_STATE first. The *size* s of a cube: 0 a brick, s a node of level s - 1; its edge is ``8·4**s`` voxels.
"""

from __future__ import annotations

import numpy as np

from graphslam.evidence.kernels import kernel
from graphslam.evidence.tree_kernels import drop_brick, occupied_lines, release_roots, take_brick, take_node

MIXED, UNSEEN = 1 << 20, 1 << 21  # no value of a voxel
FREE_STATE, OCCUPIED_STATE = -1, 1


@kernel()
def voxel_state(value, classes, threshold):
    """State of one voxel."""
    v = int(value)
    if not classes or v == -32768:
        return v
    return 1 if v >= threshold else -1


@kernel()
def voxels_state(row, classes, threshold):
    """State of the voxels of a brick ``(512,)``."""
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
            other |= np.int16(row[j] ^ first)  # int16 after each operation, or it is not vectorised
        if other != 0:
            return 1 << 20
    return int(first)


@kernel()
def find_states(
    root, levels, classes, threshold, children, bricks, brick_state, node_state, brick_max, node_max
):  # fmt: skip
    """States of everything below a root, and the root's own.

    ``brick_max (B,), node_max (N,) int16`` take the largest known value (-32768: none); empty if not wanted.
    """
    want_max = brick_max.shape[0] > 0
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
                child = np.int64(children[n, k])
                s = -32768
                if child != 0:
                    s = np.int64(brick_state[child]) if level == 0 else np.int64(node_state[child])
                    if want_max:
                        top = max(top, np.int64(brick_max[child]) if level == 0 else np.int64(node_max[child]))
                state = s if state == 1 << 21 or state == s else 1 << 20
            node_state[n] = state
            if want_max:
                node_max[n] = top
            level += 1
            continue
        cursor[level] += 1
        child = np.int64(children[n, c])
        if child == 0:
            continue
        if level > 0:
            if node_state[child] == 1 << 21:
                level -= 1
                node[level], cursor[level] = child, 0
        elif brick_state[child] == 1 << 21:
            brick_state[child] = voxels_state(bricks[child], classes, threshold)
            if want_max:
                top = -32768
                for j in range(512):
                    top = max(top, int(bricks[child, j]))
                brick_max[child] = top


@kernel()
def share_cubes(
    root, levels, brick_state, node_state, seen, shared, children, node_ref, brick_ref, node_free, brick_free, counters
):  # fmt: skip
    """Point every parent of a cube of one value at one brick or node, and at nothing where nothing is known.

    The contents of no grid change, so nodes that have several parents are written as well: all of them gain.
    ``seen (N,) uint8`` marks nodes that were done; ``shared (levels, 65536) int32`` holds the brick or node of each
    size and value, 0 where none is known yet.
    """
    one = np.empty(1, np.int64)
    stack = np.empty((64 * 8, 2), np.int64)
    stack[0, 0], stack[0, 1] = root, levels - 1
    n = 1
    seen[root] = 1
    while n > 0:
        n -= 1
        node, level = stack[n, 0], stack[n, 1]
        for c in range(64):
            child = np.int64(children[node, c])
            if child == 0:
                continue
            state = np.int64(brick_state[child]) if level == 0 else np.int64(node_state[child])
            if state != 1 << 20:
                keep = 0
                if state != -32768:
                    keep = int(shared[level, state + 32768])
                    if keep == 0:
                        shared[level, state + 32768] = child
                        keep = child
                if keep != child:
                    children[node, c] = keep
                    if level == 0:
                        brick_ref[keep] += 1 if keep != 0 else 0
                        drop_brick(child, brick_ref, brick_free, counters)
                    else:
                        node_ref[keep] += 1 if keep != 0 else 0
                        one[0] = child
                        release_roots(one, level, children, node_ref, brick_ref, node_free, brick_free, counters)
                    continue
            if level > 0 and seen[child] == 0:
                seen[child] = 1
                stack[n, 0], stack[n, 1] = child, level - 1
                n += 1


@kernel()
def list_pieces(root, levels, children, brick_state, node_state, mixed, cubes, found):
    """List what is known: mixed bricks as [packed offset coordinates, id] in ``mixed (n, 2)``, the largest cubes of one
    value as [packed offset coordinates of their first brick, size, value] in ``cubes (m, 3)``.

    ``found (2,)`` gets the numbers of both, also where the arrays are too short. The root is never one cube.
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
            state = np.int64(brick_state[child]) if level == 0 else np.int64(node_state[child])
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


# --- building a tree that nobody else holds: room reserved, root owned, no shared node on any path ---------------


@kernel()
def make_path(root, bx, by, bz, size, levels, children, node_ref, node_occupied, node_free, counters):
    """Node whose children are cubes of a size, over a brick; missing nodes are made."""
    node = root
    for level in range(levels - 1, size, -1):
        shift = 2 * level
        c = (((bz >> shift) & 3) << 4) | (((by >> shift) & 3) << 2) | ((bx >> shift) & 3)
        child = np.int64(children[node, c])
        if child == 0:
            child = take_node(children, node_ref, node_occupied, node_free, counters)
            children[node, c] = child
        node = child
    return node


@kernel()
def uniform_cube(
    size, value, threshold, uniform, children, node_ref, node_occupied, bricks, brick_ref, brick_lines, node_free,
    brick_free, counters,
):  # fmt: skip
    """Brick or node all of whose voxels have a value, made where ``uniform (levels, 65536) int32`` has none yet.

    Its count of parents is the caller's to raise.
    """
    k = value + 32768
    occupied = value >= threshold
    if uniform[0, k] == 0:
        b = take_brick(brick_ref, brick_free, counters)
        brick_ref[b] = 0
        for j in range(512):
            bricks[b, j] = value
        brick_lines[b] = 0xFFFF if occupied else 0
        uniform[0, k] = b
    for s in range(1, size + 1):
        if uniform[s, k] == 0:
            n = take_node(children, node_ref, node_occupied, node_free, counters)
            node_ref[n] = 0
            child = int(uniform[s - 1, k])
            for c in range(64):
                children[n, c] = child
            if s == 1:
                brick_ref[child] += 64
            else:
                node_ref[child] += 64
            if occupied:
                node_occupied[n] = ~np.uint64(0)
            uniform[s, k] = n
    return int(uniform[size, k])


@kernel()
def fill_cube(
    root, bx, by, bz, log_edge, value, threshold, levels, uniform, children, node_ref, node_occupied, bricks, brick_ref,
    brick_lines, node_free, brick_free, counters,
):  # fmt: skip
    """Give a cube of ``2**log_edge`` (≥ 8) voxels one value; bx, by, bz are the offset coordinates of its first brick.

    A cube of an even ``log_edge`` is eight children of a node, one of an odd ``log_edge`` is one child.
    """
    size = (log_edge - 3) >> 1
    parts = 1 if log_edge & 1 else 2
    shift = 2 * size
    child = uniform_cube(
        size, value, threshold, uniform, children, node_ref, node_occupied, bricks, brick_ref, brick_lines, node_free,
        brick_free, counters,
    )  # fmt: skip
    for iz in range(parts):
        for iy in range(parts):
            for ix in range(parts):
                x, y, z = bx + (ix << shift), by + (iy << shift), bz + (iz << shift)
                node = make_path(root, x, y, z, size, levels, children, node_ref, node_occupied, node_free, counters)
                c = (((z >> shift) & 3) << 4) | (((y >> shift) & 3) << 2) | ((x >> shift) & 3)
                children[node, c] = child
                if size == 0:
                    brick_ref[child] += 1
                else:
                    node_ref[child] += 1


@kernel()
def add_brick(
    root, bx, by, bz, levels, children, node_ref, node_occupied, brick_ref, node_free, brick_free, counters
):  # fmt: skip
    """A brick of one's own at a place that is empty; its voxels are whatever they were."""
    lowest = levels - levels  # 0, but no literal, for which make_path would be compiled once more
    node = make_path(root, bx, by, bz, lowest, levels, children, node_ref, node_occupied, node_free, counters)
    b = take_brick(brick_ref, brick_free, counters)
    children[node, ((bz & 3) << 4) | ((by & 3) << 2) | (bx & 3)] = b
    return b


@kernel()
def finalise_occupied(root, levels, threshold, children, node_ref, node_occupied, bricks, brick_ref, brick_lines):
    """Write the flags of occupied voxels of a tree just built; parts with several parents have theirs already."""
    node, cursor = np.empty(9, np.int64), np.empty(9, np.int64)
    for k in range(9):  # np.zeros would take longer to compile
        cursor[k] = 0
    level = levels - 1
    node[level] = root
    while level < levels:
        n, c = node[level], cursor[level]
        if c == 64:
            flags = np.uint64(0)
            for k in range(64):
                child = np.int64(children[n, k])
                if child == 0:
                    continue
                if (level == 0 and brick_lines[child] != 0) or (level > 0 and node_occupied[child] != np.uint64(0)):
                    flags |= np.uint64(1) << np.uint64(k)
            node_occupied[n] = flags
            level += 1
            continue
        cursor[level] += 1
        child = np.int64(children[n, c])
        if child == 0:
            continue
        if level > 0:
            if node_ref[child] == 1:
                level -= 1
                node[level], cursor[level] = child, 0
        elif brick_ref[child] == 1:
            brick_lines[child] = occupied_lines(child, threshold, bricks)


@kernel()
def build_tree(
    root, corners, values, cubes, threshold, levels, uniform, children, node_ref, node_occupied, bricks, brick_ref,
    brick_lines, node_free, brick_free, counters,
):  # fmt: skip
    """Fill an empty grid with bricks (offset coordinates ``corners (n, 3) int64``, ``values (n, 512) int16``) and cubes
    ``(m, 5) int64`` [offset coordinates of the first brick, log2 of the edge in voxels, value]; none overlaps another.
    """
    for k in range(corners.shape[0]):
        b = add_brick(
            root, corners[k, 0], corners[k, 1], corners[k, 2], levels, children, node_ref, node_occupied, brick_ref,
            node_free, brick_free, counters,
        )  # fmt: skip
        for j in range(512):
            bricks[b, j] = values[k, j]
    for k in range(cubes.shape[0]):
        fill_cube(
            root, cubes[k, 0], cubes[k, 1], cubes[k, 2], cubes[k, 3], cubes[k, 4], threshold, levels, uniform,
            children, node_ref, node_occupied, bricks, brick_ref, brick_lines, node_free, brick_free, counters,
        )  # fmt: skip
    finalise_occupied(root, levels, threshold, children, node_ref, node_occupied, bricks, brick_ref, brick_lines)
