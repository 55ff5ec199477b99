"""Landmark submaps in space: filters, batch and iSAM2, by the same names as in the plane.

All of them are least squares over Gaussians of poses and points (:mod:`graphslam.linear.space_maps`). A joined map is
such a Gaussian itself, every landmark hanging on the end of the submap that saw it first; a join finds the values at
which two of them meet, in at most three Gauss–Newton passes, and carries both to there. Classically, maps are Cartesian
and one pass is made.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.charts import chart_difference, pose_differences
from graphslam.core.errors import CovarianceError, DataError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.poses import SE3
from graphslam.core.progress import Bar
from graphslam.core.se3 import quat_to_matrix, se3_compose, se3_transform, skew
from graphslam.core.submap import LandmarkMap, Submap, turned_covariance
from graphslam.join.joined_map import JoinResult, JoinTimes
from graphslam.linear.space_maps import (
    ORIGIN,
    PlacedMap,
    SpaceMap,
    minimise_space_maps,
    normal_equations,
    space_objective,
    step_values,
)
from graphslam.linear.symmetric_factor import SymmetricFactor

Index = npt.NDArray[np.int64]

_PASSES = 3
# … and no more of them once a step is a thousandth of a standard deviation, on the average over the map.
_STEP = 1e-3


@dataclass(frozen=True)
class SpaceEstimate(JoinResult):
    """A joined map of landmark submaps in space.

    ``poses`` are ``(m + 1, 7)``, ``landmarks`` ``(L, 3)``. The state vector is a turn about the axes of the first base
    [rad] and a shift along them [m] for every pose but the first, then a shift of every landmark.
    """

    dof: int = 0

    @property
    def states(self) -> int:
        """Free scalars; the fixed first base is not among them."""
        return 6 * (len(self.poses) - 1) + 3 * len(self.landmark_ids)

    @property
    def vector(self) -> Array:
        """Turns have no vector of values; see ``poses`` and ``landmarks``."""
        raise UnknownNameError("state vector of poses in space", "vector", ("poses", "landmarks"))

    def pose_indices(self, k: int) -> npt.NDArray[np.intp]:
        """Where ``poses[k]`` stands in the state vector (k ≥ 1)."""
        if not 1 <= k < len(self.poses):
            raise UnknownNameError("pose", str(k), (f"1 … {len(self.poses) - 1} (pose 0 is fixed)",))
        return 6 * (k - 1) + np.arange(6)

    def landmark_indices(self, landmark_id: int) -> npt.NDArray[np.intp]:
        """Where the landmark of that id stands in the state vector."""
        at = np.flatnonzero(self.landmark_ids == landmark_id)
        if len(at) == 0:
            raise UnknownNameError("landmark", str(landmark_id), (f"{len(self.landmark_ids)} ids",))
        return 6 * (len(self.poses) - 1) + 3 * int(at[0]) + np.arange(3)

    def difference(self, poses: Array, landmarks: Array, *, chart: str | None = None) -> Array:
        """What other values differ from these by ``(states,)``, in the chart of this map or in another.

        Parameters
        ----------
        poses : (m, 7)
            End poses in the frame of the first base.
        landmarks : (L, 3)
            In the order of :attr:`landmark_ids`.
        """
        chart = chart or self.chart
        assert self.anchors is not None
        e, w = pose_differences(poses, self.poses[1:], chart)
        return np.concatenate([e.ravel(), chart_difference(landmarks - self.landmarks, w[self.anchors], chart).ravel()])


@dataclass(frozen=True, eq=False)
class _Joined:
    """What a joiner carries along: a Gaussian, the ids of its points, and which of them each entry became."""

    map: SpaceMap
    ids: Index


@dataclass(frozen=True, eq=False)
class SpaceProblem:
    """A chain of landmark submaps in space as one least-squares problem.

    Parameters
    ----------
    leaves : list of SpaceMap
        In the chart of the submaps.
    ids : (L,) int64
        Landmarks in the order of first sighting.
    anchors : (L,) int64
        The submap that saw each first.
    """

    submaps: Sequence[Submap]
    leaves: list[SpaceMap]
    leaf_ids: list[Index]
    ids: Index
    anchors: Index
    chart: str
    placed: list[PlacedMap] = field(default_factory=list)

    @classmethod
    def of(cls, submaps: Sequence[Submap]) -> SpaceProblem:
        """The problem of a chain of submaps."""
        if not submaps:
            raise DataError("there are no submaps", got=0, wanted="at least one")
        flat = [s.key for s in submaps if s.dim != 3]
        if flat:
            raise DataError("submaps of two dimensions cannot be joined with others", got=flat[0], wanted="3-D")
        matched = [s.key for s in submaps if s.matches]
        if matched:
            raise DataError(
                "submaps with landmarks in space are not joined by matches", got=f"a match of submap {matched[0]}",
                wanted="none, or submaps without landmarks",
            )  # fmt: skip
        maps = [_landmarks_of(s) for s in submaps]
        first: dict[int, int] = {}
        for k, m in enumerate(maps):
            ids = m.ids.tolist()
            if len(ids) and (min(ids) < 0 or len(set(ids)) < len(ids)):
                raise DataError(
                    f"a landmark of submap {submaps[k].key} has no id, or its id is repeated",
                    got=ids, wanted="landmarks in space, each identified and once in a submap",
                )  # fmt: skip
            for i in ids:
                first.setdefault(i, k)
        chart = "group" if all(m.chart == "group" for m in maps) else "cartesian"
        place = {i: k for k, i in enumerate(first)}
        leaves, placed = [], []
        for k, (s, m) in enumerate(zip(submaps, maps, strict=True)):
            information = _information(m, f"submap {s.key}")
            leaf = SpaceMap(m.exit_pose[None], m.positions, np.zeros(len(m), np.int64), information, m.chart)
            leaves.append(leaf)
            points = np.array([place[i] for i in m.ids.tolist()], dtype=np.int64)
            placed.append(PlacedMap(leaf, k - 1 if k else ORIGIN, np.array([k]), points))
        ids = np.array(list(first), dtype=np.int64)
        return cls(
            submaps, leaves, [m.ids for m in maps], ids, np.array(list(first.values()), dtype=np.int64), chart, placed
        )

    @property
    def dof(self) -> int:
        """Scalars measured less the free ones."""
        measured = sum(one.map.information.shape[0] for one in self.placed)
        return int(measured) - 6 * len(self.leaves) - 3 * len(self.ids)

    def chain(self) -> tuple[Array, Array]:
        """The ends of the submaps one after the other, and each landmark where it was first seen from there."""
        base, poses = SE3.identity, []
        points = np.zeros((len(self.ids), 3))
        for k, one in enumerate(self.placed):
            new = self.anchors[one.points] == k
            points[one.points[new]] = se3_transform(base, one.map.points[new])
            base = se3_compose(base, one.map.poses[0])
            poses.append(base)
        return np.array(poses), points

    def result(
        self,
        poses: Array,
        points: Array,
        information: sp.csc_matrix | None,
        *,
        method: str,
        seconds: float,
        **rest: Any,
    ) -> SpaceEstimate:
        """A map with the objective of all submaps there."""
        return SpaceEstimate(
            poses=np.vstack([SE3.identity, poses]), landmark_ids=self.ids, landmarks=points, information=information,
            objective=space_objective(self.placed, poses, points), objective_polished=rest.pop("objective_polished",
            None), iterations=rest.pop("iterations", 0), converged=rest.pop("converged", False), seconds=seconds,
            chart=rest.pop("chart", self.chart), anchors=self.anchors, method=method, dof=self.dof,
            submap_ids=tuple(self.leaf_ids), **rest,
        )  # fmt: skip


def _landmarks_of(submap: Submap) -> LandmarkMap:
    """The landmark map of a submap in space; one without landmarks measures its end pose alone."""
    if submap.landmarks is not None:
        return submap.landmarks
    R = quat_to_matrix(submap.exit_pose[3:])
    return LandmarkMap(
        ids=np.zeros(0, dtype=np.int64), exit_pose=submap.exit_pose, positions=np.zeros((0, 3)),
        covariance=turned_covariance(R, submap.exit_covariance), chart="group",
    )  # fmt: skip


def _information(m: LandmarkMap, what: str) -> sp.csr_matrix:
    if m.information is not None:
        return sp.csr_matrix(m.information)
    try:
        L = np.linalg.inv(np.linalg.cholesky(m.dense_covariance()))
    except np.linalg.LinAlgError:
        raise CovarianceError(f"covariance of {what} is not positive definite", wanted="positive definite") from None
    return sp.csr_matrix(L.T @ L)


def _join(a: _Joined, b: _Joined, times: JoinTimes, passes: int) -> _Joined:
    """B, which starts where A ends, joined to A, in the frame of A's first base."""
    with times.measure("update"):
        A, B = a.map, b.map
        m = len(A.poses)
        at = {i: k for k, i in enumerate(a.ids.tolist())}
        new = np.array([i not in at for i in b.ids.tolist()], dtype=bool)
        for i in b.ids[new].tolist():
            at[i] = len(at)
        mine = np.array([at[i] for i in b.ids.tolist()], dtype=np.int64)
        poses = np.vstack([A.poses, se3_compose(A.poses[-1], B.poses)])
        points = np.vstack([A.points, se3_transform(A.poses[-1], B.points[new])])
        maps = [
            PlacedMap(A, ORIGIN, np.arange(m), np.arange(len(A.points))),
            PlacedMap(B, m - 1, m + np.arange(len(B.poses)), mine),
        ]
        _, g, H = normal_equations(maps, poses, points)
    known = not new.all()
    while known and passes:
        with times.measure("recovery"):
            step = -SymmetricFactor(H).solve(g)
            poses, points = step_values(poses, points, step)
            passes = passes - 1 if -(g @ step) > _STEP**2 * len(step) else 0
        if A.chart == "cartesian" and not passes:
            break  # linearised once: the matrix is that of the values before
        with times.measure("update"):
            _, g, H = normal_equations(maps, poses, points)
    anchors = np.concatenate([A.anchors, np.where(B.anchors[new] >= 0, m + B.anchors[new], m - 1)])
    ids = np.concatenate([a.ids, b.ids[new]])
    return _Joined(SpaceMap(poses, points, anchors, sp.csr_matrix(H), A.chart), ids)


def _leaves(problem: SpaceProblem, classical: bool) -> list[_Joined]:
    chart = "cartesian" if classical else problem.chart
    return [_Joined(replace(leaf, chart=chart), ids) for leaf, ids in zip(problem.leaves, problem.leaf_ids)]


def _finished(problem: SpaceProblem, joined: _Joined, times: JoinTimes, method: str) -> SpaceEstimate:
    """In the order of first sighting; entries of a tree stand in that order anyway, sequence for sequence."""
    rank = {i: k for k, i in enumerate(joined.ids.tolist())}
    order = np.array([rank[i] for i in problem.ids.tolist()], dtype=np.int64)
    m = len(joined.map.poses)
    scalars = np.concatenate([np.arange(6 * m), (6 * m + 3 * order[:, None] + np.arange(3)).ravel()])
    information = sp.csc_matrix(joined.map.information)[scalars][:, scalars]
    return problem.result(
        joined.map.poses, joined.map.points[order], sp.csc_matrix(information), method=method, seconds=times.wall,
        times=dict(times.parts), chart=joined.map.chart,
    )  # fmt: skip


def join_space_sequential(
    submaps: Sequence[Submap], *, classical: bool = False, progress: bool = False
) -> SpaceEstimate:
    """Join submaps in space one after the other (Combined SLAM B6, in SE₁₊ₙ(3)).

    Parameters
    ----------
    submaps : sequence of Submap
        In order, with landmarks that are identified.
    classical : bool
        Cartesian, each join linearised once.
    """
    problem, times = SpaceProblem.of(submaps), JoinTimes()
    first, *rest = _leaves(problem, classical)
    for leaf in Bar(rest, name="joining", unit="submap", shown=progress):
        first = _join(first, leaf, times, 1 if classical else _PASSES)
    return _finished(problem, first, times, "eif-sequential" + "-classical" * classical)


def join_space_tree(submaps: Sequence[Submap], *, classical: bool = False, progress: bool = False) -> SpaceEstimate:
    """Join submaps in space pairwise, then the pairs, and so on (B9), as :func:`join_space_sequential`."""
    problem, times = SpaceProblem.of(submaps), JoinTimes()
    level = _leaves(problem, classical)
    with Bar(total=len(level) - 1, name="joining", unit="join", shown=progress) as bar:
        while len(level) > 1:
            pairs = zip(level[::2], level[1::2])
            joined = [_join(a, b, times, 1 if classical else _PASSES) for a, b in pairs]
            level = [*joined, *level[2 * len(joined) :]]
            bar.update(len(joined))
    return _finished(problem, level[0], times, "eif-tree" + "-classical" * classical)


def join_space_ekf(submaps: Sequence[Submap], *, progress: bool = False) -> SpaceEstimate:
    """Join submaps in space by an extended Kalman filter: Cartesian, linearised once, a dense covariance.

    Joining is a constraint without noise (Combined SLAM eq. 9 to 12): where submap B sees a landmark of A, the place
    where A and B's base put it and the place that B gives it are one. See :func:`join_space_sequential`.
    """
    problem, times = SpaceProblem.of(submaps), JoinTimes()
    covariances = [np.linalg.inv(leaf.information.toarray()) for leaf in problem.leaves]
    poses, points = problem.leaves[0].poses, problem.leaves[0].points
    ids, P = problem.leaf_ids[0], covariances[0]
    for k in Bar(range(1, len(problem.leaves)), name="joining", unit="submap", shown=progress):
        leaf, theirs = problem.leaves[k], problem.leaf_ids[k]
        with times.measure("update"):
            m, n = len(poses), len(points)
            at = {i: j for j, i in enumerate(ids.tolist())}
            new = np.array([i not in at for i in theirs.tolist()], dtype=bool)
            base = poses[-1]
            R = quat_to_matrix(base[3:])
            seen = np.concatenate([leaf.poses[:, :3], leaf.points]) @ R.T  # from the base, along the outer axes
            whole = np.zeros((len(P) + len(covariances[k]),) * 2)
            whole[: len(P), : len(P)], whole[len(P) :, len(P) :] = P, covariances[k]
            own = len(P)
            G = np.zeros((6 + 3 * int(new.sum()), len(whole)))  # new scalars by base and leaf
            turn, shift = 6 * (m - 1), 6 * (m - 1) + 3
            G[:3, turn : turn + 3], G[:3, own : own + 3] = np.eye(3), R
            rows = [0, *(1 + np.flatnonzero(new))]
            for row, j in enumerate(rows):
                r = slice(3 + 3 * row, 6 + 3 * row)
                G[r, turn : turn + 3], G[r, shift : shift + 3] = -skew(seen[j]), np.eye(3)
                G[r, own + 3 + 3 * j : own + 6 + 3 * j] = R
            old = np.flatnonzero(~new)
            C = np.zeros((3 * len(old), len(whole)))
            z = np.zeros(3 * len(old))
            for row, j in enumerate(old.tolist()):
                r, mark = slice(3 * row, 3 * row + 3), at[int(theirs[j])]
                off = points[mark] - base[:3]
                z[r] = R.T @ off - leaf.points[j]
                C[r, turn : turn + 3], C[r, shift : shift + 3] = R.T @ skew(off), -R.T
                C[r, own + 6 + 3 * j : own + 9 + 3 * j] = -np.eye(3)
                C[r, 6 * m + 3 * mark : 6 * m + 3 * mark + 3] += R.T
            PG, PC = whole @ G.T, whole @ C.T
            S = C @ PC
            T = np.concatenate([PC[: 6 * m], G[:6] @ PC, PC[6 * m : own], G[6:] @ PC])  # covariance of all with C
            full = np.zeros((own + len(G),) * 2)
            keep = np.concatenate([np.arange(6 * m), 6 * m + 6 + np.arange(3 * n)])
            fresh = np.concatenate([6 * m + np.arange(6), own + 6 + np.arange(len(G) - 6)])
            full[np.ix_(keep, keep)], full[np.ix_(fresh, fresh)] = P, G @ PG
            full[np.ix_(keep, fresh)] = PG[:own]
            full[np.ix_(fresh, keep)] = PG[:own].T
            poses = np.vstack([poses, se3_compose(base, leaf.poses)])
            points = np.vstack([points, se3_transform(base, leaf.points[new])])
            ids = np.concatenate([ids, theirs[new]])
            if len(old):
                factor = np.linalg.cholesky(S)
                half = np.linalg.solve(factor, T.T)
                full = full - half.T @ half
                poses, points = step_values(poses, points, -half.T @ np.linalg.solve(factor, z))
            P = 0.5 * (full + full.T)
    rank = {i: j for j, i in enumerate(ids.tolist())}
    order = np.array([rank[i] for i in problem.ids.tolist()], dtype=np.int64)
    m = len(poses)
    scalars = np.concatenate([np.arange(6 * m), (6 * m + 3 * order[:, None] + np.arange(3)).ravel()])
    return problem.result(
        poses, points[order], None, method="ekf", seconds=times.wall, times=dict(times.parts), chart="cartesian",
        covariance=P[np.ix_(scalars, scalars)],
    )  # fmt: skip


def optimise_space(submaps: Sequence[Submap], joined: SpaceEstimate) -> SpaceEstimate:
    """Go on from a joined map to the least-squares optimum of its submaps; ``objective`` stays that of the joiner."""
    start, cpu = time.perf_counter(), time.process_time()
    problem = SpaceProblem.of(submaps)
    best = minimise_space_maps(problem.placed, joined.poses[1:], joined.landmarks)
    return replace(
        joined, poses=np.vstack([SE3.identity, best.poses]), landmarks=best.points, information=best.information,
        covariance=None, objective_polished=best.objective, iterations=best.iterations, converged=best.converged,
        seconds=joined.seconds + time.perf_counter() - start, chart=problem.chart,
        times={**joined.times, "polish": time.process_time() - cpu},
    )  # fmt: skip


def solve_space(submaps: Sequence[Submap], *, polish: bool = True, progress: bool = False) -> SpaceEstimate:
    """Least-squares optimum of landmark submaps in space, from the chain of their ends."""
    start = time.perf_counter()
    problem = SpaceProblem.of(submaps)
    best = minimise_space_maps(problem.placed, *problem.chain())
    return problem.result(
        best.poses, best.points, best.information, method="batch", seconds=time.perf_counter() - start,
        objective_polished=best.objective, iterations=best.iterations, converged=best.converged,
    )  # fmt: skip


def solve_space_isam2(submaps: Sequence[Submap], *, polish: bool = True, progress: bool = False) -> SpaceEstimate:
    """Landmark submaps in space through iSAM2, one by one, then to the optimum where it is asked for."""
    from graphslam.solve.space_isam2 import run_space_isam2

    start = time.perf_counter()
    problem = SpaceProblem.of(submaps)
    poses, points, updates = run_space_isam2(problem.placed, *problem.chain(), progress=progress)
    own = space_objective(problem.placed, poses, points)
    best = minimise_space_maps(problem.placed, poses, points, max_iterations=60 if polish else 0)
    found = problem.result(
        best.poses, best.points, best.information, method="isam2", seconds=time.perf_counter() - start,
        objective_polished=best.objective if polish else None, iterations=updates, converged=best.converged,
    )  # fmt: skip
    return replace(found, objective=own)


SPACE_JOINERS: dict[str, Callable[..., SpaceEstimate]] = {
    "eif-tree": join_space_tree,
    "eif-sequential": join_space_sequential,
    "eif-tree-classical": lambda submaps, **rest: join_space_tree(submaps, classical=True, **rest),
    "eif-sequential-classical": lambda submaps, **rest: join_space_sequential(submaps, classical=True, **rest),
    "ekf": join_space_ekf,
}
SPACE_SOLVERS: dict[str, Callable[..., SpaceEstimate]] = {"isam2": solve_space_isam2, "batch": solve_space}
