"""Windows smoothed the slow and obvious way: residuals as they are defined, Jacobians by differences, dense algebra."""

from __future__ import annotations

import numpy as np

from graphslam.calibrate.smoothing import CONSTANTS, PRIOR, START, WIDTH, Smoothing


def _wrap(a):
    return np.pi - np.mod(np.pi - a, 2 * np.pi)


def residuals(s: Smoothing, states: np.ndarray) -> tuple[np.ndarray, float]:
    """All whitened residuals of all windows, and Σ ln σ; ``states``: free constants, then windows."""
    p = s.sigmas
    g = dict(zip(CONSTANTS, s.constants))
    g.update(zip(s.free, states))
    at, out, sigmas = len(s.free), [], []

    def add(e, sigma):
        out.append(e / sigma)
        sigmas.append(sigma)

    for name in s.free:
        out.append(g[name] / PRIOR[CONSTANTS.index(name)])
        sigmas.append(PRIOR[CONSTANTS.index(name)])
    for w in s.windows:
        n, D = w.poses.shape
        poses = states[at : at + n * D].reshape(n, D)
        at += n * D
        nuisance = states[at : at + 2 * len(w.nuisance)].reshape(-1, 2)
        at += 2 * len(w.nuisance)
        for a in range(3):  # the first pose is the frame
            out.append(1e6 * (poses[0, a] - w.poses[0, a]))
        for kind, value in zip(w.kinds, nuisance):
            if kind == 1:
                add(value[0], p["visit_range"])
                add(value[1], p["visit_bearing"])
        for k in range(n):
            x, y, th = poses[k, :3]
            here = np.array([x, y]) + _rotation(th) @ s.sensor[:2]
            for q in range(w.first[k], w.first[k + 1]):
                dx, dy = nuisance[w.slots[q, 0]] - here
                more = nuisance[w.slots[q, 1]] if w.slots[q, 1] >= 0 else np.zeros(2)
                r = (1 + g["range_scale"]) * np.hypot(dx, dy) + g["range_offset"] + more[0]
                add(r - w.detections[q, 0], p["range"])
                if np.isfinite(w.detections[q, 1]):
                    b = np.arctan2(dy, dx) - th - s.sensor[2] - g["sensor_yaw"] + more[1]
                    add(_wrap(b - w.detections[q, 1]), p["bearing"])
            if k + 1 == n:
                continue
            ux, uy, turn, dt, d, *given = w.steps[k + 1]
            less = g["yaw_bias"] * dt + g["turn_per_metre"] * d + g["turn_scale"] * turn
            chord = _rotation(-turn / 2) @ [ux, uy]
            moved = _rotation(-(th + turn / 2 - less / 2)) @ (poses[k + 1, :2] - poses[k, :2])
            moved = np.exp(g["distance_scale"]) * moved
            along = p["along_metre"] ** 2 * d + p["along_second"] ** 2 * dt + p["floor_position"] ** 2
            side = p["lateral_metre"] ** 2 * d + p["floor_position"] ** 2
            head = p["heading_metre"] ** 2 * d + p["heading_radian"] ** 2 * abs(turn)
            head += p["heading_second"] ** 2 * dt + p["floor_heading"] ** 2
            if given[0] > 0:
                along, side, head = given
            add(moved[0] - chord[0], np.sqrt(along))
            add(moved[1] - chord[1], np.sqrt(side))
            add(_wrap(poses[k + 1, 2] - th - turn + less), np.sqrt(head))
    return np.array(out), float(np.sum(np.log(sigmas)))


def _rotation(a):
    return np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])


def states_of(s: Smoothing) -> np.ndarray:
    parts = [s.constants[[CONSTANTS.index(c) for c in s.free]]]
    for w in s.windows:
        parts += [w.poses.ravel(), w.nuisance.ravel()]
    return np.concatenate(parts)


def objective_and_step(s: Smoothing, h: float = 1e-6) -> tuple[float, np.ndarray]:
    """Negative log likelihood of the linearised problem, and the Gauss-Newton step of all states."""
    x = states_of(s)
    r, volume = residuals(s, x)
    J = np.column_stack([(residuals(s, x + h * e)[0] - residuals(s, x - h * e)[0]) / (2 * h) for e in np.eye(len(x))])
    H = J.T @ J
    step = -np.linalg.solve(H, J.T @ r)
    chi2 = float(np.sum((r + J @ step) ** 2))
    value = 0.5 * chi2 + 0.5 * np.linalg.slogdet(H)[1] + volume
    value += sum(0.5 * (np.log(s.sigmas[k] / START[k]) / WIDTH) ** 2 for k in s.fitted)
    return value, step
