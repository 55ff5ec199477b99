"""Joining by adding matrices: each step against a slow twin that only composes poses, on a ring and on a ramp."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE3, Group, group_of
from graphslam.core.se3 import quat_rotate, so3_exp
from graphslam.join.joined_map import JoinTimes
from graphslam.join.pose_map import PoseMap, join_poses, level_meeting, level_step, level_tangent
from graphslam.join.pose_problem import PoseProblem, RelativePoseFactors
from tests.reference.pose_ramp import pose_ramp

NONE = np.zeros(0, dtype=np.int64)
CASES = [{"dim": 2}, {"dim": 3}, {"dim": 3, "level_sigma": 0.01}]


def stepped(group: Group, poses: Array, up: Array | None, xi: Array) -> tuple[Array, Array | None]:
    """Every node and the level frame moved on the right, pose by pose."""
    moved = np.stack([group.compose(p, group.exp(x)) for p, x in zip(poses, xi)])
    if up is not None:
        up = SE3.compose(up, np.append(np.zeros(3), so3_exp(np.array([xi[-1, 0], xi[-1, 1], 0.0]))))
    return moved, up


def residuals(ties: RelativePoseFactors, poses: Array, up: Array | None) -> Array:
    """Whitened residuals of all ties, one by one."""
    g, out = group_of(poses), []
    for (i, j), T, W in zip(ties.ends, ties.measured, ties.whiteners):
        out.append(W @ g.log(g.compose(g.inverse(T), g.compose(g.inverse(poses[i]), poses[j]))))
    for k, direction, W in zip(ties.level_nodes, ties.directions, ties.level_whiteners):
        down = quat_rotate(SE3.inverse(poses[k])[3:], -quat_rotate(up[3:], np.array([0.0, 0.0, 1.0])))
        # the two components across the measured direction: for one near -z these are near x and y
        axis = np.array([1.0, 0, 0]) if abs(direction[0]) < 0.9 else np.array([0, 0, 1.0])
        first = axis - (axis @ direction) * direction
        first /= np.linalg.norm(first)
        out.append(W @ np.array([first @ down, np.cross(first, direction) @ down]))
    return np.concatenate(out)


def jacobian(ties: RelativePoseFactors, poses: Array, up: Array | None, h: float = 1e-6) -> Array:
    """Of :func:`residuals` by central differences, over all nodes, base included, and the level frame."""
    g, n = group_of(poses), len(poses)
    columns = [(k, c) for k in range(n) for c in range(g.dof)] + ([] if up is None else [(n, 0), (n, 1)])
    out = []
    for k, c in columns:
        ends = []
        for sign in (1.0, -1.0):
            xi = np.zeros((n + 1, g.dof))
            xi[k, c] = sign * h
            ends.append(residuals(ties, *stepped(g, poses, up, xi)))
        out.append((ends[0] - ends[1]) / (2 * h))
    return np.stack(out, axis=1)


def dense(found: PoseMap) -> Array:
    """Matrix over all nodes, the base included, and the level frame."""
    d, n = found.group.dof, len(found.poses)
    size = d * n + (0 if found.up is None else 2)
    out = np.zeros((d * (n + 1), d * (n + 1)))
    for (i, j), block in zip(found.information.pairs, found.information.values):
        out[d * i : d * (i + 1), d * j : d * (j + 1)] += block
        if i != j:
            out[d * j : d * (j + 1), d * i : d * (i + 1)] += block.T
    return out[:size, :size]


@pytest.mark.parametrize("case", CASES)
def test_a_leaf_is_at_its_optimum_with_the_matrix_of_finite_differences(case: dict) -> None:
    problem, _ = pose_ramp(4, submaps=1, steps=12, around=5, loops=9, radians=0.03, **case)
    leaf = PoseMap.leaf(problem)
    r, J = residuals(problem, leaf.poses, leaf.up), jacobian(problem, leaf.poses, leaf.up)
    np.testing.assert_allclose(dense(leaf), J.T @ J, rtol=1e-6, atol=1e-6 * np.abs(J.T @ J).max())
    assert np.abs(J.T @ r).max() < 1e-4 * np.abs(J).max()
    assert r @ r < 0.5 * np.sum(residuals(problem, problem.start, leaf.up) ** 2)
    # the frame does not matter: all of it moved on the left, the residuals and the matrix stay as they are
    g = leaf.group
    T = g.exp(np.linspace(0.3, 1.1, g.dof))
    up = None if leaf.up is None else SE3.compose(T, leaf.up)
    there = PoseMap(g.compose(T, leaf.poses), up, leaf.information).linearised(problem)[0]
    np.testing.assert_allclose(there.values, leaf.information.values, atol=1e-7 * np.abs(J.T @ J).max())


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("passes", [1, 3])
def test_a_join_is_gauss_newton_on_two_gaussians_and_its_ties(case: dict, passes: int) -> None:
    """The twin keeps the two matrices dense, finds steps by dense least squares, and carries by finite differences."""
    problem, _ = pose_ramp(5, submaps=2, steps=5, around=4, loops=9, radians=0.02, **case)
    low, high = problem.ends.min(axis=1), problem.ends.max(axis=1)
    meet = np.flatnonzero((low < 5) & (high > 5))
    ties = problem.take(meet, NONE)
    assert len(meet) > 3
    A, B = PoseMap.leaf(problem.part(0, 1)), PoseMap.leaf(problem.part(1, 2))
    found = join_poses(A, B, ties, JoinTimes(), passes=passes)

    g, d = A.group, A.group.dof
    n, levelled = 11, A.up is not None
    X0 = np.concatenate([A.poses, g.compose(A.poses[-1], B.poses[1:])])
    seen = None if not levelled else SE3.compose(A.poses[-1], B.up)
    start = None if not levelled else level_meeting(A.up, seen)[2]
    size = d * n + 2 * levelled

    def steps_from(poses: Array, up: Array | None) -> tuple[Array, Array]:
        """How far all this is from where the two maps were put: (A's, B's) tangents, B's base among them."""
        xi = [g.log(g.between(x, y)) for x, y in zip(X0, poses)]
        a, b = np.concatenate(xi[:6]), np.concatenate(xi[5:])
        if levelled:
            a, b = np.append(a, level_step(A.up, up)), np.append(b, level_step(seen, up))
        return a, b

    def moved(x: Array, poses: Array, up: Array | None) -> tuple[Array, Array | None]:
        xi = np.zeros((n + 1, d))
        xi[:n] = x[: d * n].reshape(n, d)
        xi[n, :2] = x[d * n :] if levelled else 0.0
        return stepped(g, poses, up, xi)

    def differences(f: Callable[[Array, Array | None], Array], poses: Array, up: Array | None) -> Array:
        h, out = 1e-6, []
        for c in range(size):
            x = np.zeros(size)
            x[c] = h
            out.append((f(*moved(x, poses, up)) - f(*moved(-x, poses, up))) / (2 * h))
        return np.stack(out, axis=1)

    def ties_of(poses: Array, up: Array | None) -> Array:
        return residuals(ties, poses, up)

    poses, up = X0, start
    IA, IB = dense(A), dense(B)
    for _ in range(passes):
        a, b = steps_from(poses, up)
        both = differences(lambda *there: np.concatenate(steps_from(*there)), poses, up)
        DA, DB = both[: len(a)], both[len(a) :]
        J = differences(ties_of, poses, up)
        H = DA.T @ IA @ DA + DB.T @ IB @ DB + J.T @ J
        gradient = DA.T @ IA @ a + DB.T @ IB @ b + J.T @ ties_of(poses, up)
        step = np.zeros(size)
        step[d:] = np.linalg.lstsq(H[d:, d:], -gradient[d:], rcond=None)[0]
        before = poses, up
        poses, up = moved(step, poses, up)
    np.testing.assert_allclose(found.poses, poses, atol=1e-6)
    if levelled:
        assert np.abs(level_step(found.up, up)).max() < 1e-6

    def back(there: Array, above: Array | None) -> Array:
        """Where a small step after the last one leads, seen from before it."""
        out = [g.log(g.between(p, q)) for p, q in zip(before[0], there)]
        return np.concatenate([*out, level_step(before[1], above)] if levelled else out)

    T = differences(back, poses, up)
    if not levelled:
        wanted = T.T @ H @ T
        np.testing.assert_allclose(dense(found)[d:, d:], wanted[d:, d:], atol=3e-4 * np.abs(wanted).max())
    else:  # the level frame's own x and y may differ: the poses alone are compared
        wanted = np.linalg.inv((T.T @ H @ T)[d:, d:])[: d * (n - 1), : d * (n - 1)]
        got = np.linalg.inv(dense(found)[d:, d:])[: d * (n - 1), : d * (n - 1)]
        np.testing.assert_allclose(got, wanted, atol=3e-4 * np.abs(wanted).max())


def test_without_ties_a_join_moves_nothing_and_adds_the_matrices() -> None:
    problem, _ = pose_ramp(1, submaps=2, steps=5, loops=0)
    A, B = PoseMap.leaf(problem.part(0, 1)), PoseMap.leaf(problem.part(1, 2))
    joined = join_poses(A, B, problem.take(NONE, NONE), JoinTimes())
    np.testing.assert_allclose(joined.poses, problem.start, atol=1e-12)
    wanted = np.zeros((66, 66))
    wanted[:36, :36] += dense(A)
    wanted[30:, 30:] += dense(B)
    np.testing.assert_allclose(dense(joined), wanted, atol=1e-9)
    assert np.linalg.matrix_rank(wanted, tol=1e-6) == 60  # the base is in it


def test_tangents_of_the_level_frame() -> None:
    rng = np.random.default_rng(2)
    for scale in (1e-7, 0.3, 2.0):
        frame = np.append(np.zeros(3), so3_exp(rng.normal(size=3)))
        step = scale * rng.normal(size=2) / 2

        def after(x: Array, at: Array = step, base: Array = frame) -> Array:
            one = SE3.compose(base, np.append(np.zeros(3), so3_exp(np.append(at, 0.0))))
            return level_step(base, SE3.compose(one, np.append(np.zeros(3), so3_exp(np.append(x, 0.0)))))

        np.testing.assert_allclose(after(np.zeros(2)), step, atol=1e-12)
        h = 1e-6
        T = np.stack([(after(h * e) - after(-h * e)) / (2 * h) for e in np.eye(2)], axis=1)
        np.testing.assert_allclose(level_tangent(step), T, atol=1e-7)


def test_a_chain_that_is_broken_or_undetermined_is_refused_by_name() -> None:
    problem, _ = pose_ramp(3, dim=2, submaps=2)
    step = problem.ends.max(axis=1) == 3
    known = {name: getattr(problem, name) for name in problem.__dataclass_fields__}
    flat = {"whiteners": np.where(step[:, None, None], np.diag([1.0, 1.0, 0.0]), problem.whiteners)}
    with pytest.raises(DataError, match="nodes 2 and 3 says nothing of a direction"):
        PoseProblem(**known | flat)
    gap = {name: known[name][~step] for name in ("ends", "measured", "whiteners")}
    with pytest.raises(DataError, match="nodes 2 and 3 are not tied"):
        PoseProblem(**known | gap)
    with pytest.raises(DataError, match="no submaps"):
        PoseProblem(**known | {"keys": NONE, "bases": np.zeros(1, dtype=int)})
    with pytest.raises(DataError, match="do not rise"):
        PoseProblem(**known | {"bases": np.array([0, 7, 6])})
    with pytest.raises(DataError, match="not there"):
        PoseProblem(**known | {"ends": problem.ends + 1})
