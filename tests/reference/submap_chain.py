"""Submaps drawn from a known truth: a wavy loop through random landmarks, Gaussian noise of full covariance."""

from __future__ import annotations

import numpy as np

from graphslam.core.charts import inverse_left_jacobian_terms
from graphslam.core.geometry import se2_between, wrap_angle
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import LandmarkMap, Submap
from tests.reference.submap_model import predict_submap


def wavy_loop(submaps: int, radius: float, laps: float) -> np.ndarray:
    """Poses ``(submaps + 1, 3)`` along r(φ) = radius (1 + 0.1 sin 5φ), in the frame of the first."""
    phi = np.linspace(0.0, 2.0 * np.pi * laps, submaps + 1)
    r, dr = radius * (1.0 + 0.1 * np.sin(5.0 * phi)), 0.5 * radius * np.cos(5.0 * phi)
    x, y = r * np.cos(phi), r * np.sin(phi)
    heading = np.arctan2(dr * np.sin(phi) + r * np.cos(phi), dr * np.cos(phi) - r * np.sin(phi))
    poses = np.column_stack([x, y, heading])
    return se2_between(poses[0], poses)


def random_covariance(rng: np.random.Generator, sigma: np.ndarray, *, lone: tuple[int, ...] = ()) -> np.ndarray:
    """Covariance with about these standard deviations and strong correlations; ``lone`` components have none."""
    A = np.eye(len(sigma)) + 0.6 * rng.standard_normal((len(sigma), len(sigma))) / np.sqrt(len(sigma))
    for i in lone:
        A[i], A[:, i] = 0.0, 0.0
        A[i, i] = 1.0
    A = sigma[:, None] * A
    return A @ A.T


def submap_chain(
    rng: np.random.Generator,
    *,
    submaps: int = 12,
    landmarks: int = 50,
    radius: float = 30.0,
    reach: float = 14.0,
    laps: float = 1.3,
    sigma: float = 0.05,
    sigma_heading: float = 0.005,
    known_heading: bool = False,
    claimed: float = 1.0,
    chart: str = "cartesian",
) -> tuple[list[Submap], MapTruth]:
    """Submaps with truth.

    Parameters
    ----------
    sigma, sigma_heading : float
        Noise of positions [m] and of the end heading [rad].
    known_heading : bool
        The end heading is exact to 1e-9 rad and independent of all else: the problem is linear.
    claimed : float
        Factor between the covariance a submap claims and the one its noise has.
    chart : "cartesian" or "group"
        In which the noise is Gaussian.
    """
    truth = wavy_loop(submaps, radius, laps)
    angle = rng.uniform(0.0, 2.0 * np.pi, landmarks)
    r = radius * (1.0 + 0.1 * np.sin(5.0 * angle)) + rng.uniform(-8.0, 8.0, landmarks)
    points = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    start = wavy_loop_start(radius)
    points = se2_between(start, np.column_stack([points, np.zeros(landmarks)]))[:, :2]
    ids = 100 + rng.permutation(landmarks)
    chain = []
    for k in range(submaps):
        seen = np.flatnonzero(np.linalg.norm(points - truth[k, :2], axis=1) < reach)
        seen = rng.permutation(seen)
        z = predict_submap(truth[k], truth[k + 1], points[seen])
        s = np.full(len(z), sigma)
        s[2] = 1e-9 if known_heading else sigma_heading
        P = random_covariance(rng, s, lone=(2,) if known_heading else ())
        noise = np.linalg.cholesky(P) @ rng.standard_normal(len(z))
        if chart == "group":  # the truth is the estimate, moved along arcs by minus the noise
            rows = np.r_[0:2, 3 : len(z)]
            a, b, _ = inverse_left_jacobian_terms(-noise[2])
            noise[rows] = (noise[rows].reshape(-1, 2) @ np.linalg.inv([[a, b], [-b, a]]).T).ravel()
        z = z + noise
        z[2] = wrap_angle(z[2])
        local = LandmarkMap(
            ids=ids[seen], exit_pose=z[:3], positions=z[3:].reshape(-1, 2), covariance=claimed * P, chart=chart
        )
        chain.append(Submap.from_landmarks(k, local))
    known = np.unique(np.concatenate([s.landmarks.ids for s in chain if s.landmarks is not None]))
    at = {int(i): n for n, i in enumerate(ids)}
    return chain, MapTruth(
        keys=np.arange(submaps),
        exit_poses=truth[1:],
        landmark_ids=known,
        landmarks=points[[at[int(i)] for i in known]],
    )


def wavy_loop_start(radius: float) -> np.ndarray:
    """First pose of :func:`wavy_loop` in the frame of the loop's centre."""
    return np.array([radius, 0.0, np.arctan2(radius, 0.5 * radius)])
