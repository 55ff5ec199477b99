"""Maximum-likelihood noise and constants of wheels and of a landmark sensor, from smoothed windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphslam.calibrate import kernels as K
from graphslam.calibrate import residual_kernels as R
from graphslam.calibrate.smoothing import (
    CONSTANTS,
    START,
    Smoothing,
    SmoothingWindow,
    keep_observations,
    renumber_slots,
)
from graphslam.calibrate.windows import ObservationLog, cut_windows
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree

WHEELS = ("along_metre", "along_second", "lateral_metre", "heading_metre", "heading_radian", "heading_second")
TRIMS = (5.0, 4.0)
"""Observations with a larger whitened residual are removed; a new fit follows each limit."""


def smoothing_of(
    windows: Sequence[SmoothingWindow], sensor: Array, free: Sequence[str], *, visits: bool = False
) -> Smoothing:
    """Smoothing of windows that estimates the noise of the motion and of the measured quantities."""
    bearings = any(np.isfinite(w.detections[:, 1]).any() for w in windows)
    fitted = [*WHEELS, "range"] + ["bearing"] * bearings
    fitted += (["visit_range"] + ["visit_bearing"] * bearings) if visits else []
    return Smoothing(list(windows), np.asarray(sensor, dtype=np.float64), tuple(free), tuple(fitted))


def smooth_observations(
    seen: ObservationLog, seconds: float, count: int | None, free: Sequence[str], *, visits: bool = False
) -> Smoothing:
    """Smoothing of windows of range and bearing, initialised by odometry."""
    windows = cut_windows(seen, seconds, count, visits=visits)
    return smoothing_of(windows, seen.detections.T_base_sensor, free, visits=visits)


def trim_outliers(s: Smoothing, limit: float) -> Smoothing:
    """The smoothing without observations whose residual is above ``limit`` standard deviations."""
    seen = s.residuals()
    good = [np.nan_to_num(np.abs(r), nan=0.0).max(axis=1, initial=0.0) < limit for r in seen]
    return s if all(g.all() for g in good) else keep_observations(s, good)


def fit_noise(s: Smoothing, *, trims: Sequence[float] = TRIMS) -> tuple[Smoothing, float]:
    """Fit, trim and fit again; the smoothing and its objective."""
    s.converge(8)
    s = trim_outliers(s, 12.0)  # a false association by metres would inflate the noise of all
    value = s.fit(rounds=2 if trims else 4)
    for limit in trims:
        less = trim_outliers(s, limit)
        if less is s:
            continue
        s = less
        value = s.fit(rounds=2)
    return s, value


def fit_without(s: Smoothing, constant: str) -> tuple[Smoothing, float]:
    """The smoothing with one constant fixed at zero, its noise fitted again, and its objective."""
    alone = s.copy(free=tuple(c for c in s.free if c != constant))
    alone.constants[CONSTANTS.index(constant)] = 0.0
    return alone, alone.fit(rounds=3)


def smooth_ranges(seen: ObservationLog, until: float, *, seed: int = 0) -> tuple[Smoothing, Smoothing] | None:
    """Smooth one range-only window without an initial guess: best of 16 random beacon layouts, then longer windows.

    Parameters
    ----------
    until : float
        Length of the used part of the log [s].

    Returns
    -------
    (Smoothing, Smoothing) or None
        Smoothing of the whole part, and of about its first half.
    """
    free = ("yaw_bias", "range_scale", "range_offset")
    rng = SeedTree(seed).child("calibrate", "ranges").generator()
    s, (begin, _) = seen.detections, seen.span
    (whole,) = cut_windows(seen, 1e9)[:1] or (None,)
    if whole is None:
        return None
    ends = [until]
    while ends[0] > 1.5 * 150.0:
        ends.insert(0, 0.5 * ends[0])
    places: dict[int, Array] = {}
    constants, sigmas = np.zeros(K.CONSTANTS), {**START, "range": 1.0}
    poses = np.zeros((0, 3))
    made: list[Smoothing] = []
    for end in ends:  # in steps: dead reckoning of a whole log may turn by π with a small yaw bias
        n = int(np.searchsorted(whole.times, begin + end, side="right"))
        if n < 20:
            continue
        tries: list[tuple[float, Smoothing]] = []
        for trial in range(1 if len(poses) else 16):
            g = constants.copy()
            if not len(poses):
                g[R.YAW_BIAS] = rng.normal(0.0, 0.005) if trial else 0.0
            path = _extended(whole, poses, n, g)
            w = _part(whole, path, places, rng)
            one = smoothing_of([w], s.T_base_sensor, free)
            one.constants, one.sigmas = g, {**sigmas, "range": max(sigmas["range"], 1.0)}
            tries.append((one.converge(60), one))
        best = min(tries, key=lambda x: x[0])[1]
        best.fit(rounds=2)
        best = trim_outliers(best, 5.0)
        best.fit(rounds=2)
        constants, sigmas, poses = best.constants, best.sigmas, best.windows[0].poses
        names = _names(whole, best.windows[0])
        places = {int(l): best.windows[0].nuisance[j] for j, l in enumerate(names)}
        made.append(best)
    return (made[-1], made[-2] if len(made) > 1 else made[-1]) if made else None


def _names(whole: SmoothingWindow, w: SmoothingWindow) -> Array:
    """Landmark index in the whole window for each landmark of a part of it."""
    of_row = dict(zip(whole.rows.tolist(), whole.slots[:, 0].tolist()))
    out = np.full(len(w.nuisance), -1)
    for row, (l, _) in zip(w.rows.tolist(), w.slots.tolist()):
        out[l] = of_row[row]
    return out


def _extended(whole: SmoothingWindow, poses: Array, n: int, g: Array) -> Array:
    """Path of ``n`` poses: the given ones, extended by dead reckoning corrected for the yaw bias."""
    u = whole.steps[:n].copy()
    u[:, 2] -= g[R.YAW_BIAS] * u[:, 3]
    out = np.zeros((n, 3))
    known = min(len(poses), n)
    out[:known] = poses[:known]
    rest = out[max(known - 1, 0) :]
    K.compose_steps(u[max(known - 1, 0) :], out[max(known - 1, 0)].copy(), rest)
    return out


def _part(whole: SmoothingWindow, path: Array, places: dict[int, Array], rng: np.random.Generator) -> SmoothingWindow:
    """The first poses of a window; beacons without a position are initialised by :func:`_anywhere`."""
    n = len(path)
    q = int(whole.first[n])
    slots, order = renumber_slots(whole.slots[:q])
    k = np.repeat(np.arange(n), np.diff(whole.first[: n + 1]))
    nuisance = np.zeros((len(order), 2))
    for j, l in enumerate(order.tolist()):
        if l in places:
            nuisance[j] = places[l]
            continue
        mine = np.flatnonzero(slots[:, 0] == j)
        at, r = path[k[mine], :2], whole.detections[mine, 0]
        nuisance[j] = _anywhere(at, r, rng)
    return SmoothingWindow(
        times=whole.times[:n],
        steps=whole.steps[:n],
        first=whole.first[: n + 1],
        detections=whole.detections[:q],
        slots=slots,
        kinds=np.zeros(len(order), dtype=np.int64),
        rows=whole.rows[:q],
        poses=path.copy(),
        nuisance=nuisance,
    )


def _anywhere(at: Array, r: Array, rng: np.random.Generator) -> Array:
    """Beacon position from ranges: random choice of the best two of 24 solutions started on the shortest range."""
    i = int(np.argmin(r))
    angle = np.arange(24) * (2 * np.pi / 24)
    found = []
    for x in at[i] + r[i] * np.column_stack([np.cos(angle), np.sin(angle)]):
        for _ in range(8):
            d = x - at
            length = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-6)
            J = d / length[:, None]
            e = r - length
            x = x + np.linalg.lstsq(J.T @ J + 1e-3 * np.eye(2), J.T @ np.clip(e, -10.0, 10.0), rcond=None)[0]
        found.append((float(np.sum(np.minimum(np.abs(r - np.hypot(*(x - at).T)), 5.0))), x))
    found.sort(key=lambda f: f[0])
    best = found[0][1]
    other = next((x for _, x in found if np.linalg.norm(x - best) > 2.0), best)
    return best if rng.random() < 0.7 else other


def shift_motion(s: Smoothing, seen: ObservationLog, shift: float) -> Smoothing:
    """The smoothing with its motion evaluated at stamps that are later by ``shift`` [s]."""
    windows = [replace(w, steps=seen.steps(w.times, shift)) for w in s.windows]
    return s.copy(windows=windows)
