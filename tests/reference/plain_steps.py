"""Deskewing and choosing beams one by one, with matrices; and a small robot whose scanner spins."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.range_scans import RangeScans
from graphslam.core.se3 import pose_to_matrix, se3_compose, se3_exp
from graphslam.core.trajectory import Trajectory


def rotation(axis: int, angle: float) -> np.ndarray:
    """Homogeneous rotation about a coordinate axis."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    M = np.eye(4)
    M[i, i] = M[j, j] = c
    M[i, j], M[j, i] = -s, s
    return M


def beam_in_base(scans: RangeScans, k: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin ``(3,)`` and unit direction ``(3,)`` of beam j of scan k, base at the beam's own time."""
    mount = pose_to_matrix(scans.T_base_mount)
    head = mount @ rotation(0, scans.spin[k] + scans.spin_rate[k] * scans.beam_times[j])
    return mount[:3, 3], head[:3, :3] @ scans.directions[j]


def deskew_all(scans: RangeScans, path: Trajectory, steps: np.ndarray, begin: float) -> list[list[tuple]]:
    """For every step its beams in order: (origin, end, met) in the base at the step's stamp; nothing thinned."""
    out: list[list[tuple]] = [[] for _ in steps]
    for k in range(len(scans.times)):
        for j in range(len(scans.beam_times)):
            r, t = float(scans.ranges[k, j]), scans.times[k] + scans.beam_times[j]
            if math.isnan(r) or r < 0.1 or t < begin or t > steps[-1]:
                continue
            step = next(i for i, stamp in enumerate(steps) if t <= stamp)
            at_beam = pose_to_matrix(path.interpolate(t)[0])
            at_step = pose_to_matrix(path.interpolate(steps[step])[0])
            T = np.linalg.inv(at_step) @ at_beam
            origin, direction = beam_in_base(scans, k, j)
            end = origin + min(r, scans.max_range) * direction
            out[step].append((T[:3, :3] @ origin + T[:3, 3], T[:3, :3] @ end + T[:3, 3], r < scans.max_range))
    return out


def winding_path(seconds: float = 4.0, rate: float = 50.0) -> Trajectory:
    """A path with turns, slopes and roll."""
    t = np.arange(round(seconds * rate) + 1) / rate
    poses = [np.array([0.0, 0, 0, 0, 0, 0, 1])]
    for s in t[:-1]:
        twist = np.array([0.3 * math.sin(s), 0.2 * math.cos(2 * s), 0.6 * math.sin(0.7 * s), 1.0, 0.0, 0.0])
        poses.append(se3_compose(poses[-1], se3_exp(twist / rate)))
    return Trajectory(t, np.array(poses))


def room_scans(
    path: Trajectory, half: np.ndarray, *, beams: int = 15, rate: float = 12.5, max_range: float = 8.0
) -> RangeScans:
    """Scans of the inside of a box ``[-half, half]`` from a head that spins while the base follows ``path``."""
    times = np.arange(0.0, path.times[-1] - 0.05, 1.0 / rate)
    bearings = np.linspace(-1.5, 1.5, beams)
    scans = RangeScans(
        times=times,
        ranges=np.zeros((len(times), beams)),
        directions=np.column_stack([np.cos(bearings), np.sin(bearings), 0 * bearings]),
        beam_times=np.linspace(0.0, 0.04, beams),
        max_range=max_range,
        sigma=0.02,
        T_base_mount=np.array([0.2, 0.1, 0.5, 0.0, math.sin(0.1), 0.0, math.cos(0.1)]),
        spin=1.5 * times,
        spin_rate=np.full(len(times), 1.5),
    )
    for k in range(len(times)):
        for j in range(beams):
            T = pose_to_matrix(path.interpolate(times[k] + scans.beam_times[j])[0])
            origin, direction = beam_in_base(scans, k, j)
            p, d = T[:3, :3] @ origin + T[:3, 3], T[:3, :3] @ direction
            walls = [(math.copysign(half[a], d[a]) - p[a]) / d[a] for a in range(3) if abs(d[a]) > 1e-12]
            scans.ranges[k, j] = min(*walls, max_range)
    return scans
