"""Compiled residuals of the smoothing: ranges, bearings, visits and steps, whitened, with their Jacobians."""

from __future__ import annotations

import math
from collections import namedtuple

from graphslam.core.jit import callee

YAW_BIAS, DISTANCE_SCALE, TURN_PER_METRE, TURN_SCALE, RANGE_SCALE, RANGE_OFFSET, SENSOR_YAW = range(7)
CONSTANTS = 7
RHS = CONSTANTS
HEAD = CONSTANTS + 1
(
    ALONG_METRE,
    ALONG_SECOND,
    LATERAL_METRE,
    HEADING_METRE,
    HEADING_RADIAN,
    HEADING_SECOND,
    RANGE,
    BEARING,
    VISIT_RANGE,
    VISIT_BEARING,
    FLOOR_POSITION,
    FLOOR_HEADING,
) = range(12)
PARAMETERS = 12
Data = namedtuple("Data", ["steps", "first", "detections", "slots", "kinds"])
"""Measurements of a window."""
Model = namedtuple("Model", ["g", "sensor", "p"])
"""Constants (CONSTANTS,), pose of the sensor in the base frame (3,), standard deviations (PARAMETERS,)."""
Row = namedtuple("Row", ["jp", "jn", "cols", "vals"])
"""Jacobians by this pose and the next one; border columns and their values, the first one the right-hand side."""


@callee(error_model="numpy")
def wrap_residual(a):
    """Angle in (-π, π]."""
    return math.pi - (math.pi - a) % (2.0 * math.pi)


@callee(error_model="numpy")
def lever_and_offset(x, landmark, sensor):
    """From the base to the sensor, and from the sensor to a landmark, along the axes of the map."""
    c, s = math.cos(x[2]), math.sin(x[2])
    ox, oy = c * sensor[0] - s * sensor[1], s * sensor[0] + c * sensor[1]
    return ox, oy, landmark[0] - x[0] - ox, landmark[1] - x[1] - oy


@callee(error_model="numpy")
def range_row(x, nuisance, model, data, q, at, row):
    """Whitened residual of the range of observation ``q`` from pose ``x``; returns its number of border columns."""
    jp, _, cols, vals = row
    g, sensor, p = model
    j, v = data.slots[q]
    ox, oy, dx, dy = lever_and_offset(x, nuisance[j], sensor)
    r = math.sqrt(dx * dx + dy * dy + 1e-12)
    base = HEAD + 2 * at[j]
    grow, w = 1.0 + g[RANGE_SCALE], 1.0 / p[RANGE]
    # residual: predicted minus measured
    e = grow * r + g[RANGE_OFFSET] - data.detections[q, 0]
    jp[:] = 0.0
    jp[0], jp[1] = -w * grow * dx / r, -w * grow * dy / r
    jp[2] = w * grow * (dx * oy - dy * ox) / r
    cols[1], vals[1] = base, w * grow * dx / r
    cols[2], vals[2] = base + 1, w * grow * dy / r
    cols[3], vals[3] = RANGE_SCALE, w * r
    cols[4], vals[4] = RANGE_OFFSET, w
    count = 5
    if v >= 0:
        e += nuisance[v, 0]
        cols[5], vals[5] = HEAD + 2 * at[v], w
        count = 6
    vals[0] = -w * e
    return count


@callee(error_model="numpy")
def bearing_row(x, nuisance, model, data, q, at, row):
    """Whitened residual of the bearing of observation ``q`` from pose ``x``; returns its number of border columns."""
    jp, _, cols, vals = row
    g, sensor, p = model
    j, v = data.slots[q]
    ox, oy, dx, dy = lever_and_offset(x, nuisance[j], sensor)
    r2 = dx * dx + dy * dy + 1e-12
    base = HEAD + 2 * at[j]
    w = 1.0 / p[BEARING]
    e = math.atan2(dy, dx) - x[2] - sensor[2] - g[SENSOR_YAW] - data.detections[q, 1]
    if v >= 0:
        e += nuisance[v, 1]
    e = wrap_residual(e)
    jp[:] = 0.0
    jp[0], jp[1] = w * dy / r2, -w * dx / r2
    jp[2] = w * (-(dx * ox + dy * oy) / r2 - 1.0)
    cols[1], vals[1] = base, -w * dy / r2
    cols[2], vals[2] = base + 1, w * dx / r2
    cols[3], vals[3] = SENSOR_YAW, -w
    count = 4
    if v >= 0:
        cols[4], vals[4] = HEAD + 2 * at[v] + 1, w
        count = 5
    vals[0] = -w * e
    return count


@callee(error_model="numpy")
def visit_row(value, part, p, at, row):
    """Whitened prior of the range (``part`` 0) or bearing (1) of a visit."""
    _, _, cols, vals = row
    w = 1.0 / (p[VISIT_RANGE] if part == 0 else p[VISIT_BEARING])
    cols[1], vals[0], vals[1] = HEAD + 2 * at + part, -w * value, w


@callee(error_model="numpy")
def motion_variances(step, p, out):
    """Variances of a step: along, lateral, heading."""
    turn, dt, d = step[2], step[3], step[4]
    out[0] = p[ALONG_METRE] ** 2 * d + p[ALONG_SECOND] ** 2 * dt + p[FLOOR_POSITION] ** 2
    out[1] = p[LATERAL_METRE] ** 2 * d + p[FLOOR_POSITION] ** 2
    out[2] = p[HEADING_METRE] ** 2 * d + p[HEADING_RADIAN] ** 2 * abs(turn) + p[HEADING_SECOND] ** 2 * dt
    out[2] += p[FLOOR_HEADING] ** 2
    if step[5] > 0.0:
        out[0] = step[5]
    if step[6] > 0.0:
        out[1], out[2] = step[6], step[7]


@callee(error_model="numpy")
def motion_row(x, then, g, step, variances, axis, row):
    """Whitened residual of a step from pose ``x`` to ``then``: along, lateral or heading; 5 border columns."""
    jp, jn, cols, vals = row
    ux, uy, turn, dt, d = step[0], step[1], step[2], step[3], step[4]
    less = g[YAW_BIAS] * dt + g[TURN_PER_METRE] * d + g[TURN_SCALE] * turn
    h = 0.5 * turn
    phi = x[2] + h - 0.5 * less
    cp, sp = math.cos(phi), math.sin(phi)
    mx, my = then[0] - x[0], then[1] - x[1]
    longer = math.exp(g[DISTANCE_SCALE])  # the prediction is scaled, not the measurement with its noise
    qx, qy = longer * (cp * mx + sp * my), longer * (-sp * mx + cp * my)
    w = 1.0 / math.sqrt(variances[axis])
    u = w * longer
    jp[:] = 0.0
    jn[:] = 0.0
    if axis == 0:
        e, dphi, scale = qx - (math.cos(h) * ux + math.sin(h) * uy), qy, qx
        jp[0], jp[1], jn[0], jn[1] = -u * cp, -u * sp, u * cp, u * sp
    elif axis == 1:
        e, dphi, scale = qy - (-math.sin(h) * ux + math.cos(h) * uy), -qx, qy
        jp[0], jp[1], jn[0], jn[1] = u * sp, -u * cp, -u * sp, u * cp
    else:
        e, dphi, scale = wrap_residual(then[2] - x[2] - turn + less), -1.0, 0.0
        jn[2] = w
    jp[2] = w * dphi
    # a change of the turn by the constants rotates the chord by half of it, the heading by all of it
    part = -0.5 * dphi if axis < 2 else 1.0
    cols[1], vals[1] = YAW_BIAS, w * part * dt
    cols[2], vals[2] = DISTANCE_SCALE, w * scale
    cols[3], vals[3] = TURN_PER_METRE, w * part * d
    cols[4], vals[4] = TURN_SCALE, w * part * turn
    vals[0] = -w * e
