"""False correspondences: landmarks with measurements of two objects, detected by χ² and split by traversals and
places."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from graphslam.core.geometry import Array
from graphslam.skeleton import correspondence_kernels, landmark_kernels
from graphslam.skeleton.collapse import number_by_first_observation
from graphslam.skeleton.schur import Network

Labels = npt.NDArray[np.int32]

# A landmark is false if its χ² is at least this share of the worst in view, and of the worst of all.
_AMONG, _OF_ALL = 0.3, 0.01


def landmark_chi2(network: Network) -> Array:
    """``Σ eᵀ W e`` of each landmark ``(L,)`` at the network's poses."""
    layout = network.layout
    parts = [np.zeros(r) for r in layout.reach]
    counts = [np.zeros(r, np.int32) for r in layout.reach]
    layout.workers.over(
        lambda k: landmark_kernels.landmark_chi2_kernel(
            layout.problem.detections, network.poses, network.landmarks, *layout.ranges[k], parts[k], counts[k]
        ),
        [(k,) for k in range(len(parts))],
    )
    out = parts[-1]
    for part in parts[:-1]:
        out[: len(part)] += part
    return out


FALSE_ALARM, GAP = 1e-10, 20
"""False-alarm probability for a correct landmark; poses without an observation between two traversals."""


def split_false_correspondences(network: Network) -> tuple[Labels, int]:
    """Split a landmark with an implausible χ² into one per traversal, or two if both objects are observed at once.

    Pose errors increase the χ² of all landmarks: it is compared relative to the median over the landmarks of several
    traversals (at least one per degree of freedom). A false landmark also distorts the poses that observe it, and thus
    its neighbours: only landmarks that are among the worst in view are split. The others are tested again later.

    Returns
    -------
    landmark : (M,)
        Numbered by first observation; the problem's array if nothing was split.
    found : int
        Number of landmarks that were split.
    """
    problem, counts = network.layout.problem, network.layout.counts
    L = problem.landmarks
    passes = np.zeros(L, np.int32)
    correspondence_kernels.count_passes(problem.landmark, problem.first, GAP, np.full(L, -1, np.int32), passes)
    several = np.flatnonzero(passes > 1)
    if not len(several):
        return problem.landmark, 0
    value = landmark_chi2(network)[several]
    freedom = 3.0 * (counts[several] - 1)
    scale = max(1.0, float(np.median(value / freedom)))
    kinds, which = np.unique(freedom, return_inverse=True)
    ratio, worst = np.zeros(L), np.zeros(L)
    ratio[several] = value / (scale * chdtri(kinds, FALSE_ALARM)[which])
    ratio[ratio < 1.0] = 0.0
    if not ratio.any():
        return problem.landmark, 0
    correspondence_kernels.worst_in_view(problem.landmark, problem.first, ratio, worst)
    wrong = np.flatnonzero((ratio > _AMONG * worst) & (ratio > _OF_ALL * ratio.max()))
    bad = np.zeros(L, np.bool_)
    bad[wrong] = True
    landmark = problem.landmark.copy()
    correspondence_kernels.split_labels(problem.detections, network.poses, bad, (GAP, 16.27), landmark, L)
    return number_by_first_observation(landmark)[0], len(wrong)
