"""Numba kernels that find and split falsely merged landmarks. Plain arrays only."""

from __future__ import annotations

import numpy as np

from graphslam.core.jit import njit
from graphslam.skeleton.landmark_kernels import _nine, _seen


@njit(nogil=True)
def count_passes(landmark, first, gap, last, passes):
    """``passes[j]``: number of traversals with landmark j, separated by more than ``gap`` poses without it."""
    for i in range(len(first) - 1):
        for m in range(first[i], first[i + 1]):
            j = landmark[m]
            if last[j] < 0 or i - last[j] > gap:
                passes[j] += 1
            last[j] = i


@njit(nogil=True)
def worst_in_view(landmark, first, ratio, out):
    """``out[j]``: the largest ``ratio (L,)`` of all landmarks observed from a common pose with landmark j."""
    for i in range(len(first) - 1):
        worst = 0.0
        for m in range(first[i], first[i + 1]):
            worst = max(worst, ratio[landmark[m]])
        if worst > 0.0:
            for m in range(first[i], first[i + 1]):
                out[landmark[m]] = max(out[landmark[m]], worst)


@njit(nogil=True, error_model="numpy")
def split_labels(detections, poses, wrong, rules, landmark, n):
    """Give every track of a false landmark a new number, from ``n`` on. Returns the number of labels.

    A track is a sequence of observations in one traversal at one place: each is compared with the last one of the
    track, in the world frame and in units of the noise of both. The first track keeps its number.

    Parameters
    ----------
    wrong : (L,) bool
    rules : (gap, gate)
        Poses without an observation between two traversals; limit of χ²(3) for one place.
    landmark : (M,) changed
    n : int
    """
    gap, gate = rules
    room = 64
    label, last, after = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32)
    place = np.empty((room, 3))
    used = 0
    head = np.full(len(wrong), -1, np.int32)
    for i in range(len(detections.first) - 1):
        R = _nine(poses.rotation, i)
        px, py, pz = poses.position[i, 0], poses.position[i, 1], poses.position[i, 2]
        for m in range(detections.first[i], detections.first[i + 1]):
            j = landmark[m]
            if not wrong[j]:
                continue
            sx, sy, sz, nx, ny, nz, al, be = _seen(R, detections, m)
            best, least = -1, 2.0 * gate
            at = head[j]
            while at >= 0:
                if i - last[at] <= gap and last[at] < i:  # a pose observes an object once
                    ex, ey, ez = place[at, 0] - px - sx, place[at, 1] - py - sy, place[at, 2] - pz - sz
                    d = nx * ex + ny * ey + nz * ez
                    misfit = al * (ex * ex + ey * ey + ez * ez) + be * d * d
                    if misfit < least:
                        best, least = at, misfit
                at = after[at]
            if best < 0:
                if used == room:
                    room *= 2
                    longer = np.empty((3, room), np.int32)
                    longer[0, :used], longer[1, :used], longer[2, :used] = label, last, after
                    label, last, after = longer[0].copy(), longer[1].copy(), longer[2].copy()
                    wider = np.empty((room, 3))
                    wider[:used] = place
                    place = wider
                best = used
                used += 1
                if head[j] < 0:
                    label[best] = j
                else:
                    label[best] = n
                    n += 1
                after[best] = head[j]
                head[j] = best
            last[best] = i
            place[best, 0], place[best, 1], place[best, 2] = px + sx, py + sy, pz + sz
            landmark[m] = label[best]
    return n
