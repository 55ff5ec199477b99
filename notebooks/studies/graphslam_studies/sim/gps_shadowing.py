"""GPS among buildings: which satellites an antenna sees, and what walls do to the fixes.

Every satellite has a direction of its own. One behind a wall is lost, or taken by a reflection whose longer way the
receiver does not know; one in view has an error where a wall is near. All of these errors last for seconds to minutes.
A fix is the least-squares solution of its distances, so that its error grows, and leans, as the satellites that are
left stand badly: upwards more than along the ground, across a street more than along it, most of all at a door.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.core.se3 import se3_transform
from graphslam.sim.crawler_sensors import ornstein_uhlenbeck
from graphslam.sim.drive import RouteMotion
from graphslam.sim.raycast import RayCaster
from graphslam_studies.sim.campus_config import CampusConfig

Mask = npt.NDArray[np.bool_]
_ROUND = 24  # directions in which the nearest wall is looked for


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsFixSeries:
    """Positions of an antenna.

    Parameters
    ----------
    times : (n,)
    positions : (n, 3)
        East, north, up [m].
    covariances : (n, 3, 3)
        What the receiver takes their covariance to be, from the satellites' directions: it knows of no walls [m²].
    truth : (n, 3)
    hidden : (n,)
        How many of the satellites used are behind a wall.
    seen : (k,), (k,) int
        Times at which a fix was tried, and the number of satellites in direct view then.
    """

    times: Array
    positions: Array
    covariances: Array
    truth: Array
    hidden: npt.NDArray[np.int64]
    seen: tuple[Array, npt.NDArray[np.int64]]


def draw_satellites(config: CampusConfig, tree: SeedTree) -> Array:
    """Directions of satellites ``(s, 3)``, even over the sky above the mask."""
    rng = tree.child("sky").generator()
    up = rng.uniform(np.sin(config.mask), 1.0, config.satellites)
    turn = rng.uniform(0.0, 2.0 * np.pi, config.satellites)
    level = np.sqrt(1.0 - up**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), up])


def satellites_in_view(caster: RayCaster, antennas: Array, sky: Array) -> Mask:
    """Which satellites ``(s, 3)`` each antenna ``(n, 3)`` sees past everything ``(n, s)``."""
    n, s = len(antennas), len(sky)
    rays = np.hstack([np.repeat(antennas, s, axis=0), np.tile(sky, (n, 1))])
    return np.isnan(caster.ranges(rays)).reshape(n, s)


def nearest_wall(caster: RayCaster, antennas: Array) -> Array:
    """Distance of each antenna ``(n, 3)`` from what stands beside it, on its own level ``(n,)`` [m]."""
    angle = 2.0 * np.pi * np.arange(_ROUND) / _ROUND
    level = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_ROUND)])
    rays = np.hstack([np.repeat(antennas, _ROUND, axis=0), np.tile(level, (len(antennas), 1))])
    away = caster.ranges(rays).reshape(-1, _ROUND)
    return np.where(np.isnan(away), np.inf, away).min(axis=1)


def measure_gps(
    motion: RouteMotion, caster: RayCaster, config: CampusConfig, drawn: dict[str, float], tree: SeedTree
) -> GpsFixSeries:
    """Fixes along a drive.

    Parameters
    ----------
    caster : RayCaster
        Of what stands still.
    drawn : dict of str to float
        Figures of the noise, see :meth:`CampusConfig.draw`.
    """
    c, scale = config, config.noise_scale
    times = np.arange(0.0, motion.duration, 1.0 / c.gps_rate)
    antennas = se3_transform(motion.poses(times), np.broadcast_to(np.array(c.lever), (len(times), 3)))
    sky = draw_satellites(c, tree)
    seen, wall = satellites_in_view(caster, antennas, sky), nearest_wall(caster, antennas)

    shape, dt = (len(times), c.satellites), 1.0 / c.gps_rate

    def correlated(name: str, time: float) -> Array:
        return ornstein_uhlenbeck(tree.child(name).generator(), shape, 1.0, time, dt)

    # a satellite behind a wall is taken while a slow process is in its upper tail; its way is longer, never shorter
    reflected = correlated("taken", c.reflect_time) > _upper(drawn["hidden_share"])
    longer = drawn["hidden_path"] * 0.5 * (1.0 + correlated("way", c.reflect_time) ** 2)
    by_wall = drawn["reflect_sigma"] * np.exp(-wall / c.reflect_reach)[:, None]
    error = drawn["orbit_sigma"] * correlated("orbit", c.orbit_time) + by_wall * correlated("wall", c.reflect_time)
    error += drawn["code_sigma"] * tree.child("code").generator().standard_normal(shape)
    error += np.where(seen, 0.0, longer)
    used = seen | (reflected & (scale > 0.0))

    sigma = float(np.hypot(drawn["orbit_sigma"], drawn["code_sigma"]))
    rows, found, stated = [], [], []
    for k in range(len(times)):
        if used[k].sum() < c.least_satellites or seen[k].sum() < c.least_in_view:
            continue
        # distance = |satellite - antenna| + clock: the derivative is minus the direction, and one
        H = np.column_stack([-sky[used[k]], np.ones(int(used[k].sum()))])
        N = H.T @ H
        if np.linalg.cond(N) > 1e8:
            continue
        C = np.linalg.inv(N)
        if np.sqrt(np.trace(C[:3, :3])) > c.most_pdop:
            continue
        rows.append(k)
        found.append((C @ H.T @ (scale * error[k, used[k]]))[:3])
        stated.append(sigma**2 * C[:3, :3])
    index = np.array(rows, dtype=np.int64)
    return GpsFixSeries(
        times=times[index],
        positions=antennas[index] + np.array(found).reshape(-1, 3),
        covariances=np.array(stated).reshape(-1, 3, 3),
        truth=antennas[index],
        hidden=(used & ~seen)[index].sum(axis=1),
        seen=(times, seen.sum(axis=1)),
    )


def _upper(share: float) -> float:
    """Where a standard normal number is above it with that probability."""
    return float(-ndtri(share))
