"""Compiled kernels on bricks of signed distances: integration of points and beams, and fusion of pieces.

Bricks are those of the evidence grid (:mod:`graphslam.evidence.layout`): 8³ voxels, x fastest. Distances are in voxels,
positive in front of a surface. Tables ``(nz, ny, nx)`` hold rows of bricks plus one, 0 where there is none.
"""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel

UNIT = 1024
"""Distances and normals are summed as integers in units of 1/1024 voxel, so that sums do not depend on their order."""
ACROSS = 2
"""A point contributes to voxels up to this distance along each axis [voxels] …"""
WIDE = 1.5
"""… and up to this distance along its plane …"""
FRONT, BEHIND = 2.0, 2.0
"""… and up to this distance in front of its plane and behind it; beyond one voxel behind with less weight."""
FULL = 16
"""Weight of a point whose normal passes through the voxel's centre."""
NUM, WEIGHT, PASSED, HIT, NX, NY, NZ = 0, 1, 2, 3, 4, 5, 6
"""Columns of sums: weighted distance, weight, passing beams, points inside, weighted normal."""
COLUMNS = 7
MOST = 65535
"""Limit of weights and counts of a piece."""


@callee
def point_weight(d, along):
    """Weight 0 … `FULL` of a point for a voxel ``d`` in front of its plane and ``along`` in the plane [voxels]."""
    if along >= WIDE or d > FRONT or d <= -BEHIND:
        return 0
    w = FULL * (1.0 - along / WIDE)
    if d < -1.0:
        w *= BEHIND + d
    return math.floor(w + 0.5)


@kernel()
def mark_bricks(points, first, table):
    """Mark with 1 every brick that a point (in voxels) may contribute to."""
    for k in range(points.shape[0]):
        low = np.empty(3, np.int64)
        high = np.empty(3, np.int64)
        for a in range(3):
            low[a] = (math.floor(points[k, a]) - ACROSS) // 8 - first[a]
            high[a] = (math.floor(points[k, a]) + ACROSS) // 8 - first[a]
        for bz in range(low[2], high[2] + 1):
            for by in range(low[1], high[1] + 1):
                for bx in range(low[0], high[0] + 1):
                    table[bz, by, bx] = 1


@kernel()
def add_planes(points, normals, first, table, sums):
    """Integrate points (in voxels) with normals towards the sensor into the voxels around them.

    The distance of a voxel's centre x is ``n · (x − p)``, with the plane through p.
    """
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        ix, iy, iz = math.floor(px), math.floor(py), math.floor(pz)
        for z in range(iz - ACROSS, iz + ACROSS + 1):
            for y in range(iy - ACROSS, iy + ACROSS + 1):
                for x in range(ix - ACROSS, ix + ACROSS + 1):
                    ux, uy, uz = x + 0.5 - px, y + 0.5 - py, z + 0.5 - pz
                    d = nx * ux + ny * uy + nz * uz
                    along = math.sqrt(max(ux * ux + uy * uy + uz * uz - d * d, 0.0))
                    w = point_weight(d, along)
                    here = x == ix and y == iy and z == iz
                    if w == 0 and not here:
                        continue
                    row = table[z // 8 - first[2], y // 8 - first[1], x // 8 - first[0]] - 1
                    v = (z % 8) * 64 + (y % 8) * 8 + x % 8
                    sums[row, v, HIT] += here
                    if w:
                        sums[row, v, NUM] += math.floor(w * d * UNIT / FULL + 0.5)
                        sums[row, v, WEIGHT] += w
                        sums[row, v, NX] += math.floor(w * nx * UNIT / FULL + 0.5)
                        sums[row, v, NY] += math.floor(w * ny * UNIT / FULL + 0.5)
                        sums[row, v, NZ] += math.floor(w * nz * UNIT / FULL + 0.5)


@kernel()
def add_rays(points, origins, first, table, sums):
    """Integrate distances along the beams (truncated signed distance): the baseline of :func:`add_planes`."""
    for k in range(points.shape[0]):
        ox, oy, oz = origins[k, 0], origins[k, 1], origins[k, 2]
        dx, dy, dz = points[k, 0] - ox, points[k, 1] - oy, points[k, 2] - oz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        last, at = -1, max(length - FRONT, 0.0)
        while at < length + BEHIND:
            x, y, z = math.floor(ox + at * dx), math.floor(oy + at * dy), math.floor(oz + at * dz)
            at += 0.25
            v = (z % 8) * 64 + (y % 8) * 8 + x % 8
            row = table[z // 8 - first[2], y // 8 - first[1], x // 8 - first[0]] - 1
            if row * 512 + v == last:
                continue
            last = row * 512 + v
            d = length - ((x + 0.5 - ox) * dx + (y + 0.5 - oy) * dy + (z + 0.5 - oz) * dz)
            w = point_weight(d, 0.0)
            if w:
                sums[row, v, NUM] += math.floor(w * d * UNIT / FULL + 0.5)
                sums[row, v, WEIGHT] += w
                sums[row, v, NX] += math.floor(-w * dx * UNIT / FULL + 0.5)
                sums[row, v, NY] += math.floor(-w * dy * UNIT / FULL + 0.5)
                sums[row, v, NZ] += math.floor(-w * dz * UNIT / FULL + 0.5)


@kernel()
def count_passing_beams(points, origins, short, first, table, sums):
    """Count the beams that pass through each voxel of the bricks; beams end ``short`` voxels before their points."""
    shape = table.shape
    for k in range(points.shape[0]):
        ox, oy, oz = origins[k, 0], origins[k, 1], origins[k, 2]
        dx, dy, dz = points[k, 0] - ox, points[k, 1] - oy, points[k, 2] - oz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= short:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        end = length - short
        at, last = 0.0, -1
        while at < end:
            x, y, z = ox + at * dx, oy + at * dy, oz + at * dz
            bx, by, bz = math.floor(x / 8) - first[0], math.floor(y / 8) - first[1], math.floor(z / 8) - first[2]
            row = 0
            if 0 <= bx < shape[2] and 0 <= by < shape[1] and 0 <= bz < shape[0]:
                row = table[bz, by, bx]
            if row == 0:  # advance to the exit of this brick
                step = 1e9
                for p, d, b in ((x, dx, bx + first[0]), (y, dy, by + first[1]), (z, dz, bz + first[2])):
                    if d > 1e-9:
                        step = min(step, (8.0 * (b + 1) - p) / d)
                    elif d < -1e-9:
                        step = min(step, (8.0 * b - p) / d)
                at += max(step, 0.0) + 1e-3
                continue
            v = (math.floor(z) % 8) * 64 + (math.floor(y) % 8) * 8 + math.floor(x) % 8
            this = row * 512 + v
            if this != last:
                sums[row - 1, v, PASSED] += 1
                last = this
            at += 0.5


@kernel()
def field_distances(sums, distance, normal, counts):
    """Distances ``(n, 512)`` float32, their gradients ``(n, 512, 3)`` int8 (in 1/127), and weight, beams and points
    ``counts (n, 512, 3)`` uint16 of sums; 0 without data.

    The gradient is the mean normal; it extrapolates the distance from the voxel's centre.
    """
    for b in range(sums.shape[0]):
        for v in range(512):
            w = sums[b, v, WEIGHT]
            for a in range(3):
                counts[b, v, a] = min(sums[b, v, WEIGHT + a], MOST)
            if w:
                distance[b, v] = sums[b, v, NUM] * FULL / (w * UNIT)
                for a in range(3):
                    normal[b, v, a] = math.floor(127.0 * FULL * sums[b, v, NX + a] / (w * UNIT) + 0.5)


@kernel()
def reach_bricks(coordinates, R, t, found):
    """World bricks ``found (m, 3)`` that bricks of a piece at a pose (voxels) may touch; returns their number.

    Each piece brick adds the bounding box of its rotated cube; bricks can be repeated.
    """
    count = 0
    for b in range(coordinates.shape[0]):
        low = np.empty(3, np.int64)
        high = np.empty(3, np.int64)
        for a in range(3):
            middle, half = t[a], 0.0
            for c in range(3):
                middle += R[a, c] * (8.0 * coordinates[b, c] + 4.0)
                half += 4.0 * abs(R[a, c])
            low[a] = math.floor((middle - half - 0.5) / 8)
            high[a] = math.floor((middle + half + 0.5) / 8)
        for z in range(low[2], high[2] + 1):
            for y in range(low[1], high[1] + 1):
                for x in range(low[0], high[0] + 1):
                    if count < found.shape[0]:
                        found[count, 0], found[count, 1], found[count, 2] = x, y, z
                    count += 1
    return count


@kernel()
def pose_piece(bricks, rows, R, t, piece, sign, world, touched):
    """Add a piece at a pose to world bricks, or subtract it.

    ``bricks (m, 3)``, ``rows (m,)`` of ``world (·, 512, 4)`` int32; ``piece``: first, table, distance, normal, counts.
    A voxel gets the distance of the piece's voxel at its centre **plus the gradient times the offset**, without which
    the error is 0.29 voxels. ``touched (m,)``: has data there.
    """
    first, table, distance, normal, counts = piece
    shape = table.shape
    for m in range(bricks.shape[0]):
        for v in range(512):
            px = 8 * bricks[m, 0] + v % 8 + 0.5 - t[0]
            py = 8 * bricks[m, 1] + (v // 8) % 8 + 0.5 - t[1]
            pz = 8 * bricks[m, 2] + v // 64 + 0.5 - t[2]
            x = R[0, 0] * px + R[1, 0] * py + R[2, 0] * pz
            y = R[0, 1] * px + R[1, 1] * py + R[2, 1] * pz
            z = R[0, 2] * px + R[1, 2] * py + R[2, 2] * pz
            ix, iy, iz = math.floor(x), math.floor(y), math.floor(z)
            bx, by, bz = ix // 8 - first[0], iy // 8 - first[1], iz // 8 - first[2]
            if bx < 0 or by < 0 or bz < 0 or bx >= shape[2] or by >= shape[1] or bz >= shape[0]:
                continue
            row = table[bz, by, bx] - 1
            if row < 0:
                continue
            u = (iz % 8) * 64 + (iy % 8) * 8 + ix % 8
            w = np.int64(counts[row, u, 0])
            passed = np.int64(counts[row, u, 1])
            if w:
                along = normal[row, u, 0] * (x - ix - 0.5)
                along += normal[row, u, 1] * (y - iy - 0.5)
                along += normal[row, u, 2] * (z - iz - 0.5)
                d = distance[row, u] + along / 127.0
                world[rows[m], v, NUM] += sign * math.floor(w * d * UNIT / FULL + 0.5)
                world[rows[m], v, WEIGHT] += sign * w
            if w or passed:
                world[rows[m], v, PASSED] += sign * passed
                world[rows[m], v, HIT] += sign * np.int64(counts[row, u, 2])
                touched[m] = 1


@kernel()
def make_target(rows, world, figures, target, known):
    """Measured distance and confidence of each voxel ``target (·, 512, 2)``, and whether it is known.

    ``figures``: least weight of a known voxel, and least number of beams, total and per point, for carving. The
    confidence is ``W / (W + 3)`` for W points. A voxel behind a surface that enough beams passed is free.
    """
    enough, least, per_hit = figures
    for k in range(rows.shape[0]):
        r = rows[k]
        for v in range(512):
            w = world[r, v, WEIGHT]
            known[r, v] = 0
            target[r, v, 0], target[r, v, 1] = 0.0, 0.0
            if w >= enough:
                known[r, v] = 1
                points = w / FULL
                d = world[r, v, NUM] * FULL / (w * UNIT)
                passed = world[r, v, PASSED]
                if d < 0.0 and passed >= least and passed > per_hit * world[r, v, HIT]:
                    d = FRONT
                target[r, v, 0], target[r, v, 1] = d, points / (points + 3.0)


@callee
def fill_block(b, near, phi, known, block, there):
    """The 10³ voxels of a brick with its neighbours: values, and whether they are known."""
    for z in range(10):
        for y in range(10):
            for x in range(10):
                kx, ky, kz = (x + 7) // 8, (y + 7) // 8, (z + 7) // 8
                row = near[b, kz * 9 + ky * 3 + kx]
                there[z, y, x] = 0
                if row >= 0:
                    v = ((z + 7) % 8) * 64 + ((y + 7) % 8) * 8 + (x + 7) % 8
                    if known[row, v]:
                        there[z, y, x] = 1
                        block[z, y, x] = phi[row, v]


@callee
def neighbour_values(block, there, z, y, x, step):
    """Values on both sides along an axis, ``step`` its offset; unknown ones are extrapolated linearly."""
    c = block[z, y, x]
    dz, dy, dx = step
    low, high = there[z - dz, y - dy, x - dx], there[z + dz, y + dy, x + dx]
    a = block[z - dz, y - dy, x - dx] if low else c
    b = block[z + dz, y + dy, x + dx] if high else c
    if low and not high:
        b = 2.0 * c - a
    elif high and not low:
        a = 2.0 * c - b
    return a, b


@callee
def mixed_difference(block, there, z, y, x, first, second):
    """Mixed second difference along two axes; 0 if one of its four corners is unknown."""
    total = 0.0
    for s in (-1, 1):
        for t in (-1, 1):
            k = z + s * first[0] + t * second[0]
            j = y + s * first[1] + t * second[1]
            i = x + s * first[2] + t * second[2]
            if not there[k, j, i]:
                return 0.0
            total += s * t * block[k, j, i]
    return 0.25 * total


@kernel()
def curvature(block, there, z, y, x):
    """``κ |∇φ|`` of the level set through a voxel, limited to ±1."""
    xa, xb = neighbour_values(block, there, z, y, x, (0, 0, 1))
    ya, yb = neighbour_values(block, there, z, y, x, (0, 1, 0))
    za, zb = neighbour_values(block, there, z, y, x, (1, 0, 0))
    c = block[z, y, x]
    gx, gy, gz = 0.5 * (xb - xa), 0.5 * (yb - ya), 0.5 * (zb - za)
    hxx, hyy, hzz = xa + xb - 2.0 * c, ya + yb - 2.0 * c, za + zb - 2.0 * c
    hxy = mixed_difference(block, there, z, y, x, (0, 0, 1), (0, 1, 0))
    hxz = mixed_difference(block, there, z, y, x, (0, 0, 1), (1, 0, 0))
    hyz = mixed_difference(block, there, z, y, x, (0, 1, 0), (1, 0, 0))
    total = hxx * (gy * gy + gz * gz) + hyy * (gx * gx + gz * gz) + hzz * (gx * gx + gy * gy)
    total -= 2.0 * (gx * gy * hxy + gx * gz * hxz + gy * gz * hyz)
    return min(max(total / (gx * gx + gy * gy + gz * gz + 1e-6), -1.0), 1.0)


@kernel()
def evolve_level_set(near, phi, other, target, known, rows, figures):
    """One step of ``φ ← φ + dt [w (f − φ) + λ κ |∇φ|]`` from ``phi`` into ``other``; ``figures``: dt and λ."""
    dt, smooth = figures
    block, there = np.zeros((10, 10, 10)), np.zeros((10, 10, 10), np.uint8)
    for b in range(rows.shape[0]):
        r = rows[b]
        fill_block(b, near, phi, known, block, there)
        for v in range(512):
            if not known[r, v]:
                continue
            z, y, x = v // 64 + 1, (v // 8) % 8 + 1, v % 8 + 1
            c = block[z, y, x]
            pull = target[r, v, 1] * (target[r, v, 0] - c)
            if smooth != 0.0:
                pull += smooth * curvature(block, there, z, y, x)
            other[r, v] = c + dt * pull


@kernel()
def redistance(near, phi, other, start, known, rows, dt):
    """One step of ``∂φ/∂τ = sgn(φ₀)(1 − |∇φ|)`` from ``phi`` into ``other``, upwind, with Russo and Smereka's fix.

    Next to a change of sign of ``start`` (φ₀) a voxel relaxes to its distance ``φ₀ / |∇φ₀|``, so that the zero set does
    not move.
    """
    block, there = np.zeros((10, 10, 10)), np.zeros((10, 10, 10), np.uint8)
    origin, same = np.zeros((10, 10, 10)), np.zeros((10, 10, 10), np.uint8)
    steps = ((0, 0, 1), (0, 1, 0), (1, 0, 0))
    for b in range(rows.shape[0]):
        r = rows[b]
        fill_block(b, near, phi, known, block, there)
        fill_block(b, near, start, known, origin, same)
        for v in range(512):
            if not known[r, v]:
                continue
            z, y, x = v // 64 + 1, (v // 8) % 8 + 1, v % 8 + 1
            c0, c = origin[z, y, x], block[z, y, x]
            sign = 1.0 if c0 > 0.0 else -1.0
            crossed, slope = False, 0.0
            for s in range(3):
                a, d = neighbour_values(origin, same, z, y, x, steps[s])
                crossed = crossed or a * c0 <= 0.0 or d * c0 <= 0.0
                one = max(abs(0.5 * (d - a)), abs(d - c0), abs(c0 - a))
                slope += one * one
            if crossed:
                other[r, v] = c - dt * (sign * abs(c) - c0 / max(math.sqrt(slope), 0.5))
                continue
            total = 0.0
            for s in range(3):
                dz, dy, dx = steps[s]
                back = c - block[z - dz, y - dy, x - dx] if there[z - dz, y - dy, x - dx] else 0.0
                ahead = block[z + dz, y + dy, x + dx] - c if there[z + dz, y + dy, x + dx] else 0.0
                back, ahead = sign * back, sign * ahead
                one = max(max(back, 0.0), -min(ahead, 0.0))
                total += one * one
            other[r, v] = c - dt * sign * (math.sqrt(total) - 1.0)
