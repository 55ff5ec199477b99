"""Which of several paths makes the sharper map, by points of the clouds that none of them was made of.

A path that was fitted to some points agrees with these. Others of the same scans were seen from the same poses, and
nobody used them: surfaces that they make are thinner along a better path. That says nothing of what bends slowly, such
as the length of a way that is never passed again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.point_clouds import PointClouds
from graphslam.core.trajectory import Trajectory
from graphslam.refine.scans import Scans

FEWEST = 12
"""Points of a neighbourhood, at least …"""
FEWEST_SCANS = 4
"""… of so many scans."""
FLAT = 0.3
"""Of a surface the least eigenvalue is below this share of the middle one."""


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Of a map of points along a path; all figures of the same neighbourhoods for every path.

    Parameters
    ----------
    thickness : float
        Median σ of points across their surfaces [m].
    revisited : float
        The same where they were seen at times more than ``apart`` from each other [m]; nan if nowhere.
    entropy : float
        Mean differential entropy of neighbourhoods as Gaussians [nat].
    gain : (float, float)
        By how much it is lower than along the first path, and the σ of that, neighbourhoods ten to one being
        independent.
    count : int
        Neighbourhoods.
    """

    thickness: float
    revisited: float
    entropy: float
    gain: tuple[float, float]
    count: int


def sharpness(
    clouds: PointClouds,
    paths: Mapping[str, Trajectory],
    *,
    used: Scans | None = None,
    points: int = 600,
    places: int = 15_000,
    radius: float = 0.3,
    reach: tuple[float, float] = (1.0, 30.0),
    apart: float = 20.0,
    seed: int = 0,
) -> dict[str, Sharpness]:
    """Surfaces of points that no path was made of, along each of some paths of the base.

    Parameters
    ----------
    paths : mapping of str to Trajectory
        Begin with the one that the others are compared with.
    used : Scans, optional
        Points that are left out.
    points : int
        Of a scan, drawn.
    places : int
        Neighbourhoods, drawn among them.
    radius : float
        Of a neighbourhood [m].
    reach : (float, float)
        Least and greatest range of a point [m].
    apart : float
        [s]
    """
    rng = np.random.default_rng(seed)
    first, last = max(p.times[0] for p in paths.values()), min(p.times[-1] for p in paths.values())
    spent = set() if used is None else {x.tobytes() for x in np.ascontiguousarray(used.points)}
    drawn, times = [], []
    for k in np.flatnonzero((clouds.times >= first) & (clouds.times <= last)).tolist():
        x = clouds.cloud(k)
        r = np.linalg.norm(x, axis=1)
        x = se3.se3_transform(clouds.T_base_sensor, x[(r > reach[0]) & (r < reach[1])])
        x = x[rng.permutation(len(x))[: 4 * points]]
        some = np.ascontiguousarray(x, np.float32)
        x = x[[row.tobytes() not in spent for row in some]][:points]
        drawn.append(x)
        times.append(np.full(len(x), clouds.times[k]))
    P, t = np.concatenate([np.zeros((0, 3)), *drawn]), np.concatenate([np.zeros(0), *times])
    rows = rng.permutation(len(P))[:places]
    found = {name: _neighbourhoods(path, P, t, rows, radius, apart) for name, path in paths.items()}
    seen = np.all([np.isfinite(f[:, 1]) for f in found.values()], axis=0)
    if not np.any(seen):
        raise DataError(
            "no two scans see the same surfaces", got=f"{len(P)} points", wanted=f"{FEWEST} near each other"
        )
    flat, again = (np.all([np.isfinite(g[:, c]) for g in found.values()], axis=0) for c in (0, 2))
    base = next(iter(found.values()))[seen, 1]
    out = {}
    for name, f in found.items():
        lower = base - f[seen, 1]
        gain = float(lower.mean()), float(lower.std() / np.sqrt(max(seen.sum() / 10.0, 1.0)))
        thick, twice = (float(np.median(f[some, c])) if some.any() else np.nan for some, c in ((flat, 0), (again, 2)))
        out[name] = Sharpness(thick, twice, float(f[seen, 1].mean()), gain, int(seen.sum()))
    return out


def _neighbourhoods(
    path: Trajectory, P: Array, t: Array, rows: npt.NDArray[np.int64], radius: float, apart: float
) -> Array:
    """Thickness, entropy, and thickness of what was seen again ``(m, 3)``; nan where there is none."""
    W = se3.se3_transform(path.interpolate(t), P)
    out = np.full((len(rows), 3), np.nan)
    for m, near in enumerate(cKDTree(W).query_ball_point(W[rows], radius)):
        if len(near) < FEWEST or len(np.unique(t[near])) < FEWEST_SCANS:
            continue
        C = np.cov(W[near].T)
        w = np.linalg.eigvalsh(C)
        out[m, 1] = 0.5 * float(np.sum(np.log(2.0 * math.pi * math.e * np.maximum(w, 1e-12))))
        if w[0] < FLAT * w[1]:
            out[m, 0] = np.sqrt(max(w[0], 0.0))
            if np.ptp(t[near]) > apart:
                out[m, 2] = out[m, 0]
    return out
