"""Compiled detectors of steps, missing support and obstacles in one scan line, per cell.

A line is processed from its lowest beam upwards. Each detection is one row ``(line, band, ix, iy, channel, value)``
int32; for the channels below `GROUND`, a line has one detection per cell, the largest value.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.jit import callee
from graphslam.evidence.kernels import kernel

STEP, SUPPORT, OVERHANG, ABOVE, GROUND, ROUGH = 0, 1, 2, 3, 4, 5
"""Channels: height of a step [cm], depth of missing support [cm], obstacle at the height of the vehicle [1], object
above the vehicle [1], height of the ground [mm], roughness of the ground [mm]."""


class BandCells(NamedTuple):
    """Cells of the range bands."""

    edges: Array
    """Ranges at which the bands end ``(b,)`` [m]."""
    cells: Array
    """Widths of their cells ``(b,)`` [m]."""
    nearest: float
    """Detections nearer to the sensor are ignored [m]."""


class DetectorSettings(NamedTuple):
    """Settings of the detectors [m, or m per m]; see `lines.DetectorConfig`."""

    smooth: float
    window: float
    slack: float
    residual: float
    residual_rate: float
    memory: float
    support_reach: float
    most_slope: float
    clearance: float
    height: float
    above_limit: float
    climb: float
    width: float


@callee
def put_row(out, key, value, where, lattice):
    """Write a detection, or increase the value of the one of the same line and cell.

    ``out``: rows, hash slots (a power of 2), the number of rows so far and that before this line ``(2,)``; ``key``:
    line and channel; ``where``: x, y and range from the sensor. Nothing is written beyond the last band or nearer than
    the first.
    """
    rows, slots, total = out
    x, y, r = where
    band = 0
    while band < lattice.edges.shape[0] and r > lattice.edges[band]:
        band += 1
    if r < lattice.nearest or band == lattice.edges.shape[0] or total[0] == rows.shape[0]:
        return
    width = lattice.cells[band]
    ix, iy = math.floor(x / width), math.floor(y / width)
    line, channel = key
    count = total[0]
    if channel < 4:
        slot = (ix * 73856093 ^ iy * 19349663 ^ (4 * band + channel) * 83492791) & (slots.shape[0] - 1)
        while slots[slot] >= total[1]:  # a slot of an earlier line is free
            k = slots[slot]
            if rows[k, 2] == ix and rows[k, 3] == iy and rows[k, 4] == channel and rows[k, 1] == band:
                rows[k, 5] = max(rows[k, 5], value)
                return
            slot = (slot + 1) & (slots.shape[0] - 1)
        slots[slot] = count
    rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = line, band, ix, iy
    rows[count, 4], rows[count, 5] = channel, value
    total[0] = count + 1


@callee
def smooth_heights(s, z, n, reach, out):
    """``out``: mean height of each point and its neighbours on both sides within ``reach``.

    Neighbours whose height differs by more than that are excluded: a curb stays sharp.
    """
    for i in range(n):
        total, many = z[i], 1
        for side in (-1, 1):
            j = i + side
            while 0 <= j < n and abs(s[j] - s[i]) <= reach and abs(z[j] - z[i]) <= reach:
                total += z[j]
                many += 1
                j += side
        out[i] = total / many


@callee
def follow_ground(s, z, n, foot, f, ground, chain):
    """Classify ground points ``ground (n,)``: 1 continued from the previous ground, 2 on another level; and the state
    before each point, ``chain (n, 4)``.

    ``chain``: range and height of the last previous ground point on which the vehicle can be, the ground slope there,
    and 1 if an obstacle is in between. If the line climbs more than the vehicle can, the vehicle cannot be on anything
    narrower than itself (rail, hedge, bumper); then the last point is that before the climb. If the first observed
    ground is higher than the foot by that much, the last point is at that range with the height of the foot. A point is
    on the ground if it differs from the extrapolated ground by at most ``residual + residual_rate · distance``; a level
    of three points above (at most ``clearance``) or six below becomes the ground.
    """
    last_s, last_z, slope = 0.0, foot, 0.0
    from_s, from_z = 0.0, foot  # for the slope: about 0.5 m back
    first = 0  # first ground point for the slope
    run, side, blocked, found = 0, 0, 0.0, False
    raised, base_s, base_z, from_raised = False, 0.0, foot, 0.0
    for i in range(n):
        chain[i, 0], chain[i, 1], chain[i, 2], chain[i, 3] = last_s, last_z, slope, blocked
        if raised:
            chain[i, 0], chain[i, 1] = base_s, base_z
        ground[i] = 0
        step = s[i] - last_s
        off = z[i] - (last_z + slope * step)
        # the lowest beam can meet the ground far from the sensor, which is then the first known ground
        near = step < 2.0 * f.memory or not found
        if step > -0.05 and abs(off) < f.residual + f.residual_rate * max(step, 0.0) and near:
            accept = 1
            run = 0
        else:
            accept = 0
            now = 1 if off > 0.0 else -1
            level = False
            if i > 0 and not ground[i - 1] and side == now:
                ahead = s[i] - s[i - 1]
                level = ahead > 0.0 and abs(z[i] - z[i - 1]) < 0.02 + 0.3 * ahead
            run = run + 1 if level else 1
            side = now
            if off > f.clearance:
                blocked = 1.0
                run = 0
            elif (now > 0 and run >= 3) or (now < 0 and run >= 6):
                accept = 2
        if accept == 0:
            continue
        if accept == 2:
            for j in range(i - run + 1, i):
                ground[j] = 2
            first = i - run + 1
            from_s, from_z, slope = s[first], z[first], 0.0
            run = 0
        first_seen = not found
        ground[i], found = accept, True
        if accept == 1 and abs(step) < 0.03:
            continue  # do not follow a wall upwards point by point
        if first_seen and z[i] - foot > f.climb:
            # the ground up to here was not observed: a slope, or a bumper below the lowest beam
            raised, base_s, base_z, from_raised = True, s[i], foot, s[i]
        elif raised:
            on_it = z[i] - base_z - f.slack * (s[i] - base_s) > f.climb
            raised = on_it and s[i] - from_raised < f.width
        else:
            # lowest ground within the step window before the climb, or the previous point
            low_s, low_z = last_s, last_z
            for j in range(i - 1, -1, -1):
                if s[i] - s[j] > f.window:
                    break
                if ground[j] and z[j] + f.slack * (s[i] - s[j]) < low_z + f.slack * (s[i] - low_s):
                    low_s, low_z = s[j], z[j]
            if z[i] - low_z - f.slack * (s[i] - low_s) > f.climb:
                raised, base_s, base_z, from_raised = True, low_s, low_z, s[i]
        last_s, last_z, blocked = s[i], z[i], 0.0
        while first < i and (not ground[first] or s[i] - s[first] >= 0.5):
            if ground[first] and s[i] - s[first] >= 0.5:
                from_s, from_z = s[first], z[first]
            first += 1
        if last_s - from_s >= 0.3:
            slope = min(max((last_z - from_z) / (last_s - from_s), -f.most_slope), f.most_slope)


@callee
def heights_above(s, z, n, ground, reach, out):
    """``out``: height of each point above the nearest ground point of the line; NaN if none is within ``reach``."""
    low = np.empty(n, np.int64)
    many = 0
    for i in range(n):
        if ground[i]:
            low[many] = i
            many += 1
    for i in range(n):
        best, height = reach, 0.0 if ground[i] else np.nan
        if not ground[i]:
            for k in range(many):
                j = low[k]
                if abs(s[j] - s[i]) <= best:
                    best = abs(s[j] - s[i])
                    height = z[i] - z[j]
        out[i] = height


@callee
def passed_below(s, z, n, i, edge, ground, f):
    """Whether the beam to point i passed below ground observed by a higher beam of its line, i.e. was a reflection.

    ``edge``: range at which it went below the ground; range and height of the last ground before.
    """
    pierced, last_s, last_z = edge
    for j in range(i + 1, n):
        if ground[j] and pierced + 0.1 < s[j] < s[i] - 0.1 and z[j] > last_z - f.slack * (s[j] - last_s) - f.climb:
            return True
    return False


@callee
def observe_line(line, points, origin, foot, lattice, f, out):
    """Detections of one line; ``out``: see `put_row`."""
    m = points.shape[0]
    p, s = np.empty((m, 3)), np.empty(m)
    n = 0
    for i in range(m):
        if not math.isnan(points[i, 0]):
            r = math.hypot(points[i, 0] - origin[0], points[i, 1] - origin[1])
            if r > 0.2:
                p[n], s[n] = points[i], r
                n += 1
    z, height = np.empty(m), np.empty(m)
    ground, chain = np.zeros(m, np.int8), np.empty((m, 4))
    smooth_heights(s, p[:, 2], n, f.smooth, z)
    follow_ground(s, z, n, foot, f, ground, chain)
    heights_above(s, z, n, ground, f.memory, height)
    out[2][1] = out[2][0]
    for i in range(n):
        where = (p[i, 0], p[i, 1], s[i])
        if ground[i]:
            put_row(out, (line, SUPPORT), 0, where, lattice)
            put_row(out, (line, GROUND), round(1000.0 * z[i]), where, lattice)
            if 0 < i < n - 1 and ground[i - 1] and ground[i + 1] and s[i + 1] - s[i - 1] < 2.0 * f.window:
                share = (s[i] - s[i - 1]) / max(s[i + 1] - s[i - 1], 1e-6)
                bend = p[i, 2] - (1.0 - share) * p[i - 1, 2] - share * p[i + 1, 2]
                put_row(out, (line, ROUGH), round(1000.0 * abs(bend)), where, lattice)
        elif height[i] > f.clearance:
            channel = OVERHANG if height[i] <= f.height else ABOVE
            if height[i] <= f.above_limit:
                put_row(out, (line, channel), 1, where, lattice)
        # Missing support: the beam passed below the ground, and its point is below the steepest drivable slope by more
        # than the vehicle climbs: there is a drop in between.
        last_s, last_z, _, blocked = chain[i]
        depth = last_z - f.slack * (s[i] - last_s) - p[i, 2]
        if ground[i] != 1 and depth > f.climb and blocked == 0.0 and origin[2] > last_z > p[i, 2]:
            pierced = s[i] * (origin[2] - last_z) / (origin[2] - p[i, 2])
            there = pierced - last_s < f.memory and s[i] > pierced + 0.1
            if there and not passed_below(s, z, n, i, (pierced, last_s, last_z), ground, f):
                end, at = min(s[i], pierced + f.support_reach), pierced
                value = min(round(100.0 * depth), 1000)
                while at <= end:
                    band = 0
                    while band < lattice.edges.shape[0] - 1 and at > lattice.edges[band]:
                        band += 1
                    share = at / s[i]
                    x = origin[0] + share * (p[i, 0] - origin[0])
                    y = origin[1] + share * (p[i, 1] - origin[1])
                    put_row(out, (line, SUPPORT), value, (x, y, at), lattice)
                    at += 0.5 * lattice.cells[band]
    book_steps(line, (p, s, z, height, n), lattice, f, out)


@callee
def book_steps(line, profile, lattice, f, out):
    """Steps between points of a profile ``(points, ranges, heights, heights above the ground, number)``.

    For every point: the largest rise or fall to a later one within ``window``, minus that of a drivable slope
    (``slack`` per metre), written at the steepest place between the two; and its rise to the next point, written at the
    point, so that every cell with a point gets a detection.
    """
    p, s, z, height, n = profile
    for i in range(n):
        if not (height[i] <= f.clearance):
            continue
        best, at, end = -1.0, i, i
        before = i
        own = 0.0
        for j in range(i + 1, n):
            if not (height[j] <= f.clearance):
                continue
            ahead, rise = abs(s[j] - s[i]), abs(z[j] - z[i])
            if ahead > f.window:
                if before == i:  # neighbours farther apart: the middle between them
                    value = max(round(100.0 * (rise - f.slack * ahead)), 0)
                    where = (0.5 * (p[i, 0] + p[j, 0]), 0.5 * (p[i, 1] + p[j, 1]), 0.5 * (s[i] + s[j]))
                    if ahead < 2.0:
                        put_row(out, (line, STEP), value, where, lattice)
                break
            value = rise - f.slack * ahead
            if before == i:
                own = value
            if value > best:
                best, end = value, j
            before = j
        if end > i:
            steepest = -1.0
            before = i
            for j in range(i + 1, end + 1):
                if not (height[j] <= f.clearance):
                    continue
                rise = abs(z[j] - z[before]) - f.slack * abs(s[j] - s[before])
                if rise > steepest:
                    steepest, at = rise, j
                before = j
            before = at - 1
            while before > i and not (height[before] <= f.clearance):
                before -= 1
            where = (0.5 * (p[at, 0] + p[before, 0]), 0.5 * (p[at, 1] + p[before, 1]), 0.5 * (s[at] + s[before]))
            put_row(out, (line, STEP), max(round(100.0 * best), 0), where, lattice)
        where = (p[i, 0], p[i, 1], s[i])
        put_row(out, (line, STEP), max(round(100.0 * own), 0), where, lattice)


@kernel()
def observe_lines(points, origins, feet, lattice, figures, rows, counts):
    """Detections of all lines ``points (n, m, 3)`` (NaN: no return), lowest beam first; number of rows written.

    ``counts (n,)``: rows after each line. Writing stops where ``rows`` is full.
    """
    total = np.zeros(2, np.int64)
    room = 1024  # a power of 2
    while room < 32 * points.shape[1]:
        room *= 2
    out = (rows, np.full(room, -1), total)
    for k in range(points.shape[0]):
        observe_line(k, points[k], origins[k], feet[k], lattice, figures, out)
        counts[k] = total[0]
    return total[0]


@kernel()
def sort_into_columns(points, origin, order, filled):
    """Indices of the points of each azimuth column, lowest first: ``order (columns, beams)``, of which
    ``filled (columns,)`` are valid. Of more points the lowest are kept.
    """
    columns, beams = order.shape
    rising = np.empty((columns, beams))
    filled[:] = 0
    count = points.shape[0]
    down = count > 1 and points[0, 2] > points[count - 1, 2]  # scanners store the highest ring first, or last
    for i in range(count):
        k = count - 1 - i if down else i
        x, y, z = points[k, 0] - origin[0], points[k, 1] - origin[1], points[k, 2] - origin[2]
        c = math.floor((math.atan2(y, x) / (2.0 * math.pi) + 0.5) * columns) % columns
        own = z / math.sqrt(x * x + y * y + z * z + 1e-24)  # sine of the elevation
        n = filled[c]
        if n == beams:
            if own >= rising[c, n - 1]:
                continue
            n -= 1
        while n > 0 and rising[c, n - 1] > own:
            rising[c, n], order[c, n] = rising[c, n - 1], order[c, n - 1]
            n -= 1
        rising[c, n], order[c, n] = own, k
        filled[c] = min(filled[c] + 1, beams)


@kernel()
def bound_rows(rows, low, high):
    """Extend the least and largest ix and iy of each band, ``low (b, 2)`` and ``high (b, 2)``, by the detections."""
    for k in range(rows.shape[0]):
        b = rows[k, 1]
        for axis in range(2):
            low[b, axis] = min(low[b, axis], rows[k, 2 + axis])
            high[b, axis] = max(high[b, axis], rows[k, 2 + axis])


@kernel()
def add_rows(rows, first, shapes, offsets, tables, llr, counts, ground):
    """Add detections to cells; returns the number of those outside the box.

    ``first (b, 2)``: ix and iy of the first cell of every band; ``shapes (b, 2)``: ny and nx; ``offsets (b,)`` into the
    flat cells. ``tables (2, b, bins)`` int32; ``llr (2, c)`` int32: sums of the table; ``counts (4, c)`` int32:
    detections of `STEP`, `SUPPORT`, `OVERHANG`, `ABOVE`; ``ground (3, c)`` int64: number and sum of heights [mm], sum
    of roughness [mm].
    """
    outside = 0
    bins = tables.shape[2]
    for k in range(rows.shape[0]):
        b, channel, value = rows[k, 1], rows[k, 4], rows[k, 5]
        ix, iy = rows[k, 2] - first[b, 0], rows[k, 3] - first[b, 1]
        if ix < 0 or iy < 0 or ix >= shapes[b, 1] or iy >= shapes[b, 0]:
            outside += 1
            continue
        cell = offsets[b] + iy * shapes[b, 1] + ix
        if channel < 4:
            counts[channel, cell] += 1
            if channel < 2:
                llr[channel, cell] += tables[channel, b, min(value, bins - 1)]
        elif channel == 4:
            ground[0, cell] += 1
            ground[1, cell] += value
        else:
            ground[2, cell] += value
    return outside
