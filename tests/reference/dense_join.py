"""Slow, obvious twins: the submap problem with dense Jacobians, and the information join as the paper writes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import rotation2, se2_compose, se2_transform, wrap_angle
from graphslam.core.submap import Submap
from tests.reference.submap_model import predict_submap, submap_jacobians, submap_residual


def first_observation(submaps: Sequence[Submap]) -> list[int]:
    ids: list[int] = []
    for s in submaps:
        for j in s.landmarks.ids if s.landmarks is not None else ():
            if int(j) not in ids:
                ids.append(int(j))
    return ids


def dense_normal_equations(submaps: Sequence[Submap], x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Objective, ``JᵀΩr`` and ``JᵀΩJ`` at ``x = [poses, landmarks by first observation]``, one factor at a time."""
    ids, m = first_observation(submaps), len(submaps)
    place = {j: 3 * m + 2 * i for i, j in enumerate(ids)}
    f, g, H = 0.0, np.zeros(len(x)), np.zeros((len(x), len(x)))
    for k, s in enumerate(submaps):
        start = np.zeros(3) if k == 0 else x[3 * k - 3 : 3 * k]
        end = x[3 * k : 3 * k + 3]
        own = [place[int(j)] for j in s.landmarks.ids]
        points = np.array([x[a : a + 2] for a in own]).reshape(-1, 2)
        r = submap_residual(start, end, points, s.landmarks.mean, s.landmarks.chart)
        J_start, J_end, J_landmark = submap_jacobians(
            start, end, points, s.landmarks.mean, s.landmarks.chart, tangent=False
        )
        J = np.zeros((len(r), len(x)))
        if k:
            J[:, 3 * k - 3 : 3 * k] += J_start
        J[:, 3 * k : 3 * k + 3] += J_end
        for i, a in enumerate(own):
            J[3 + 2 * i : 5 + 2 * i, a : a + 2] += J_landmark
        omega = np.linalg.inv(s.landmarks.dense_covariance())
        f += r @ omega @ r
        g += J.T @ omega @ r
        H += J.T @ omega @ J
    return f, g, H


def dense_information_join(submaps: Sequence[Submap]) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Eq. 13–16 to the letter, dense: returns X, I and the ids, state ``[poses, landmarks by first observation]``.

    ``i`` itself is accumulated; the only liberty is that the predicted heading is unwrapped towards the measured one.
    """
    ids, m = first_observation(submaps), len(submaps)
    n = 3 * m + 2 * len(ids)
    place = {j: 3 * m + 2 * i for i, j in enumerate(ids)}
    X, i, I = np.zeros(n), np.zeros(n), np.zeros((n, n))
    active = np.zeros(n, dtype=bool)
    for k, s in enumerate(submaps):
        start = np.zeros(3) if k == 0 else X[3 * k - 3 : 3 * k]
        # 1. what is new gets its first value from this submap, with zero information
        X[3 * k : 3 * k + 3] = se2_compose(start, s.landmarks.exit_pose)
        X[3 * k + 2] = start[2] + s.landmarks.exit_pose[2]
        active[3 * k : 3 * k + 3] = True
        own = [place[int(j)] for j in s.landmarks.ids]
        for a, p in zip(own, s.landmarks.positions):
            if not active[a]:
                X[a : a + 2] = se2_transform(start, p)
                active[a : a + 2] = True
        i = I @ X  # rows of zeros for what is new
        # 2. the submap is a measurement
        end, points = X[3 * k : 3 * k + 3], np.array([X[a : a + 2] for a in own]).reshape(-1, 2)
        J_start, J_end, J_landmark = submap_jacobians(start, end, points, s.landmarks.mean, tangent=False)
        J = np.zeros((3 + 2 * len(own), n))
        if k:
            J[:, 3 * k - 3 : 3 * k] = J_start
        J[:, 3 * k : 3 * k + 3] = J_end
        for q, a in enumerate(own):
            J[3 + 2 * q : 5 + 2 * q, a : a + 2] = J_landmark
        omega = np.linalg.inv(s.landmarks.dense_covariance())
        innovation = s.landmarks.mean - predict_submap(start, end, points)
        innovation[2] = wrap_angle(innovation[2])
        I = I + J.T @ omega @ J
        i = i + J.T @ omega @ (innovation + J @ X)
        on = np.flatnonzero(active)
        X[on] = np.linalg.solve(I[np.ix_(on, on)], i[on])  # eq. 13
    return X, I, ids


Names = list[tuple[str, int]]


def dense_join_two(
    a: tuple[Names, np.ndarray, np.ndarray], b: tuple[Names, np.ndarray, np.ndarray]
) -> tuple[Names, np.ndarray, np.ndarray]:
    """Join map B, which starts at the last pose of map A, to A: eq. 13–16 with numerical Jacobians of H.

    A map is the names of its parts, ``("pose", k)`` or ``("landmark", id)``, its mean and its information matrix.
    """
    (names_a, x_a, I_a), (names_b, x_b, I_b) = a, b
    width = {"pose": 3, "landmark": 2}
    names = names_a + [n for n in names_b if n not in names_a]
    begin = dict(zip(names, np.cumsum([0] + [width[kind] for kind, _ in names])))
    size = sum(width[kind] for kind, _ in names)
    start = begin[max(n for n in names_a if n[0] == "pose")]

    def predicted(X: np.ndarray) -> np.ndarray:
        s, out = X[start : start + 3], []
        c, n = np.cos(s[2]), np.sin(s[2])
        for name in names_b:
            v = X[begin[name] : begin[name] + width[name[0]]]
            d = v[:2] - s[:2]
            out += [c * d[0] + n * d[1], c * d[1] - n * d[0]]
            if name[0] == "pose":
                out.append(v[2] - s[2])
        return np.array(out)

    X, I = np.zeros(size), np.zeros((size, size))
    X[: len(x_a)], I[: len(x_a), : len(x_a)] = x_a, I_a
    s, at = X[start : start + 3].copy(), 0
    for name in names_b:
        z = x_b[at : at + width[name[0]]]
        if name not in names_a:
            X[begin[name] : begin[name] + 2] = se2_transform(s, z[:2])
            if name[0] == "pose":
                X[begin[name] + 2] = s[2] + z[2]
        at += width[name[0]]
    J = np.zeros((len(x_b), size))
    for i in range(size):
        e = np.zeros(size)
        e[i] = 1e-6
        J[:, i] = (predicted(X + e) - predicted(X - e)) / 2e-6
    I = I + J.T @ I_b @ J
    X = X + np.linalg.solve(I, J.T @ I_b @ (x_b - predicted(X)))
    return names, X, I


def dense_tree_join(submaps: Sequence[Submap]) -> tuple[Names, np.ndarray, np.ndarray]:
    """Pairwise joins up a binary tree, dense; an odd one out goes up a level by itself."""
    level: list[tuple[Names, np.ndarray, np.ndarray]] = [
        (
            [("pose", k), *(("landmark", int(j)) for j in s.landmarks.ids)],
            s.landmarks.mean,
            np.linalg.inv(s.landmarks.dense_covariance()),
        )
        for k, s in enumerate(submaps)
    ]
    while len(level) > 1:
        above = [dense_join_two(a, b) for a, b in zip(level[::2], level[1::2])]
        level = above + level[len(level) - len(level) % 2 :]
    return level[0]


@dataclass(frozen=True)
class BentMap:
    """A map in the group chart, dense: its parts by name, mean, information, and the pose that each part hangs on."""

    names: Names
    x: np.ndarray
    information: np.ndarray
    anchor: dict[tuple[str, int], tuple[str, int]]

    def begin(self) -> dict[tuple[str, int], int]:
        return dict(zip(self.names, np.cumsum([0] + [3 if kind == "pose" else 2 for kind, _ in self.names])))

    def difference(self, x: np.ndarray) -> np.ndarray:
        """From the mean to ``x``: every part by the inverse mean rotation of its anchor's heading error."""
        at, out = self.begin(), np.empty(len(x))
        for name in self.names:
            i, d = at[name], float(wrap_angle(x[at[self.anchor[name]] + 2] - self.x[at[self.anchor[name]] + 2]))
            out[i : i + 2] = np.linalg.solve(mean_rotation(d), x[i : i + 2] - self.x[i : i + 2])
            if name[0] == "pose":
                out[i + 2] = d
        return out


def mean_rotation(d: float) -> np.ndarray:
    """``V(d) = ∫₀¹ R(s d) ds``."""
    if abs(d) < 1e-9:
        return np.array([[1.0, -0.5 * d], [0.5 * d, 1.0]])
    A, B = np.sin(d) / d, (1.0 - np.cos(d)) / d
    return np.array([[A, -B], [B, A]])


def bent_leaf(k: int, submap: Submap) -> BentMap:
    assert submap.landmarks is not None
    names: Names = [("pose", k), *(("landmark", int(j)) for j in submap.landmarks.ids)]
    information = np.linalg.inv(submap.landmarks.dense_covariance())
    return BentMap(names, submap.landmarks.mean, information, dict.fromkeys(names, ("pose", k)))


def bent_join(a: BentMap, b: BentMap, passes: int = 30) -> BentMap:
    """Least squares over what A and B say, each in its own chart, with numerical Jacobians, to the end; the joined
    Gaussian is the Gauss-Newton matrix there."""
    names = a.names + [n for n in b.names if n not in a.names]
    anchor = {**b.anchor, **a.anchor}
    start = max(n for n in a.names if n[0] == "pose")

    def seen(x: np.ndarray, begin: dict[tuple[str, int], int]) -> np.ndarray:
        s, out = x[begin[start] : begin[start] + 3], []
        for name in b.names:
            i = begin[name]
            out += list((x[i : i + 2] - s[:2]) @ rotation2(s[2]))
            out += [x[i + 2] - s[2]] if name[0] == "pose" else []
        return np.array(out)

    x = list(a.x)
    s, at = a.x[a.begin()[start] : a.begin()[start] + 3], b.begin()
    for name in names[len(a.names) :]:
        x += list(se2_transform(s, b.x[at[name] : at[name] + 2]))
        x += [s[2] + b.x[at[name] + 2]] if name[0] == "pose" else []
    joined = BentMap(names, np.array(x), np.zeros((len(x), len(x))), anchor)
    begin = joined.begin()
    both = np.zeros((len(a.x) + len(b.x),) * 2)
    both[: len(a.x), : len(a.x)], both[len(a.x) :, len(a.x) :] = a.information, b.information

    def residual(x: np.ndarray) -> np.ndarray:
        return np.concatenate([a.difference(x[: len(a.x)]), b.difference(seen(x, begin))])

    x = joined.x
    for _ in range(passes):
        J = np.stack([(residual(x + h) - residual(x - h)) / 2e-6 for h in 1e-6 * np.eye(len(x))], axis=1)
        I = J.T @ both @ J
        x = x - np.linalg.solve(I, J.T @ both @ residual(x))
    J = np.stack([(residual(x + h) - residual(x - h)) / 2e-6 for h in 1e-6 * np.eye(len(x))], axis=1)
    return BentMap(names, x, J.T @ both @ J, anchor)
