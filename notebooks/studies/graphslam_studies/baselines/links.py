"""Relative poses between pairs of poses from the landmarks that both saw: links in the manner of Lu and Milios."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.se3 import matrix_to_quat, quat_multiply, quat_to_matrix, se3_exp, se3_transform, skew
from graphslam.skeleton.problem import SkeletonProblem


class RelativeLinks(NamedTuple):
    """Relative poses with what is known of them, once and for all.

    Parameters
    ----------
    edges : (m, 2)
    measurements : (m, 7)
        Pose of the second in the first.
    information : (m, 6, 6)
        Right tangent: rotation, then translation.
    """

    edges: npt.NDArray[np.int64]
    measurements: Array
    information: Array


def relative_links(problem: SkeletonProblem, *, shared: int = 4, gap: int = 20) -> RelativeLinks:
    """Links of every pose to the one before and, of each earlier pass, to the pose with which it shares most landmarks.

    Each is the least-squares alignment of the two point sets, weighted by the noise of both. A measurement has a part
    in several links, which are treated as independent, as in the original.

    Parameters
    ----------
    shared : int
        Fewest landmarks of a link.
    gap : int
        Poses between two passes.
    """
    N = problem.poses
    seen: dict[int, list[tuple[int, int]]] = {}
    edges, measured, information = [], [], []
    for i in range(N):
        with_pose: dict[int, list[tuple[int, int]]] = {}
        for m in range(problem.first[i], problem.first[i + 1]):
            for k, other in seen.get(int(problem.landmark[m]), ()):
                with_pose.setdefault(k, []).append((other, m))
        for k in _chosen(i, {k: len(v) for k, v in with_pose.items()}, shared, gap):
            a, b = np.array(with_pose[k]).T
            T, info = align_points(problem, problem.points[a].astype(np.float64), problem.points[b].astype(np.float64))
            edges.append((k, i))
            measured.append(T)
            information.append(info)
        for m in range(problem.first[i], problem.first[i + 1]):
            seen.setdefault(int(problem.landmark[m]), []).append((i, m))
    if not edges:
        raise DataError("no two poses share enough landmarks for a link", wanted=f"{shared} landmarks")
    return RelativeLinks(np.array(edges, dtype=np.int64), np.array(measured), np.array(information))


def _chosen(i: int, counts: dict[int, int], shared: int, gap: int) -> list[int]:
    """Poses to which pose ``i`` is linked."""
    near = [k for k in counts if i - k <= gap and counts[k] >= shared]
    out = [max(near)] if near else []
    run: list[int] = []
    for k in [*sorted(k for k in counts if i - k > gap and counts[k] >= shared), 1 << 60]:
        if run and k - run[-1] > gap:
            out.append(max(run, key=lambda p: (counts[p], p)))
            run = []
        run.append(k)
    return out


def align_points(problem: SkeletonProblem, a: Array, b: Array, iterations: int = 5) -> tuple[Array, Array]:
    """Pose of the points ``b (n, 3)`` in the frame of ``a``, and its information."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    U, _, Vt = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T = np.concatenate([mean_a - R @ mean_b, matrix_to_quat(R)])
    noise_a, noise_b = _noise(problem, a), _noise(problem, b)
    H = np.eye(6)
    for _ in range(iterations):
        R = quat_to_matrix(T[3:])
        W = np.linalg.inv(noise_a + R @ noise_b @ R.T)
        J = np.concatenate([-R @ skew(b), np.broadcast_to(R, (len(b), 3, 3))], axis=2)
        r = se3_transform(T, b) - a
        H = np.einsum("nij,nik,nkl->jl", J, W, J)
        x = np.linalg.solve(H + 1e-9 * np.eye(6), -np.einsum("nij,nik,nk->j", J, W, r))
        step = se3_exp(x)
        T = np.concatenate([se3_transform(T, step[:3]), quat_multiply(T[3:], step[3:])])
    return T, 0.5 * (H + H.T)


def _noise(problem: SkeletonProblem, z: Array) -> Array:
    r = np.linalg.norm(z, axis=1)
    d = z / r[:, None]
    across = (problem.bearing_sigma * r) ** 2
    along = problem.range_sigma**2 - across
    return np.asarray(across[:, None, None] * np.eye(3) + along[:, None, None] * d[:, :, None] * d[:, None, :])
