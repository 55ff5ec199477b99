"""A loop driven twice through point landmarks, cut into submaps with trajectories inside, with truth and GPS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import (
    rotation2,
    se2_between,
    se2_compose,
    se2_exp,
    se2_log,
    se2_transform,
    tangent_to_vector_covariance,
)
from graphslam.core.records import Gps
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory


@dataclass
class Chain:
    """Submaps with truth; ``poses`` in the frame of the first base."""

    submaps: list[Submap]
    poses: np.ndarray
    landmarks: np.ndarray


def correlated_covariance(rng: np.random.Generator, n: int, sigma: float) -> np.ndarray:
    """A well-conditioned covariance with correlations everywhere."""
    A = rng.standard_normal((n, n)) / np.sqrt(n)
    return sigma**2 * (0.5 * np.eye(n) + A @ A.T)


def make_chain(
    rng: np.random.Generator,
    m: int = 12,
    landmarks: int = 25,
    *,
    reach: float = 14.0,
    sigma: float = 0.05,
    noise: float = 1.0,
    radius: float = 12.0,
    laps: float = 1.25,
) -> Chain:
    """A loop of ``m`` submaps; ``noise = 0`` draws none (the covariances stay)."""
    angle = 2 * np.pi * laps * np.arange(m + 1) / m
    world = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), angle], -1)
    points = np.zeros((0, 2))
    while len(points) < landmarks:  # like trees, no two within a metre
        p = rng.uniform([-radius - 4, -4], [radius + 4, 2 * radius + 4])
        if np.all(np.linalg.norm(points - p, axis=1) > 1.0):
            points = np.vstack([points, p])
    submaps = []
    for k in range(m):
        exit_pose = se2_between(world[k], world[k + 1])
        local = (points - world[k, :2]) @ rotation2(world[k, 2])
        ids = np.flatnonzero(np.linalg.norm(local, axis=1) < reach)
        n = 3 + 2 * len(ids)
        P = correlated_covariance(rng, n, sigma)
        P[2] *= 0.1
        P[:, 2] *= 0.1
        z = np.concatenate([exit_pose, local[ids].ravel()])
        z += noise * np.linalg.cholesky(P) @ rng.standard_normal(n)
        lm = LandmarkMap(ids=ids, exit_pose=z[:3], positions=z[3:].reshape(-1, 2), covariance=P)
        u = np.linspace(0, 1, 11)
        path = Trajectory(
            10.0 * (k + u),
            se2_exp(u[:, None] * se2_log(z[:3])),
            (1e-8 + u)[:, None, None] * np.diag([1e-4, 1e-4, 1e-6]),
        )
        submaps.append(
            Submap.from_landmarks(
                k, lm, interval=(10.0 * k, 10.0 * (k + 1)), trajectory=path, uses=frozenset({"laser", "odometry"})
            )
        )
    return Chain(submaps, se2_compose(np.zeros_like(world), world), points)


def dense_submap(key: int, exit_pose: np.ndarray, covariance: np.ndarray) -> Submap:
    """A submap without landmarks, as a dense front end makes them."""
    return Submap(key=key, interval=(key, key + 1.0), exit_pose=exit_pose, exit_covariance=covariance)


def end_only_submap(key: int, exit_pose: np.ndarray, tangent_covariance: np.ndarray) -> Submap:
    """The same as a landmark submap of no landmarks."""
    P = tangent_to_vector_covariance(exit_pose, tangent_covariance)
    lm = LandmarkMap(ids=np.zeros(0, dtype=int), exit_pose=exit_pose, positions=np.zeros((0, 2)), covariance=P)
    return Submap.from_landmarks(key, lm)


def anonymous(submap: Submap) -> Submap:
    """The same submap with unidentified landmarks."""
    assert submap.landmarks is not None
    return submap.with_ids(np.full(len(submap.landmarks), -1))


def make_gps(
    chain: Chain,
    rng: np.random.Generator,
    T_gps_world: np.ndarray,
    *,
    sigma: float = 0.3,
    lever: tuple[float, float] = (0.5, 0.2),
    step: float = 1.0,
) -> Gps:
    """Fixes along the true path (geodesic between nodes)."""
    times, points = [], []
    for k in range(len(chain.submaps)):
        xi = se2_log(se2_between(chain.poses[k], chain.poses[k + 1]))
        for t in np.arange(10.0 * k + 0.5, 10.0 * (k + 1), step):
            body = se2_compose(chain.poses[k], se2_exp((t - 10.0 * k) / 10.0 * xi))
            times.append(t)
            points.append(se2_transform(T_gps_world, se2_transform(body, np.asarray(lever))))
    z = np.array(points) + sigma * rng.standard_normal((len(points), 2))
    return Gps(times=np.array(times), positions=z, sigma=np.full(len(z), sigma), lever=np.asarray(lever))
