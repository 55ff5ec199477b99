"""The interface between front ends and back ends: a submap is an immutable value.

A submap is a small map in the frame of its first pose, with a Gaussian over its end pose and its landmarks. Node k+1 of
a graph is the end of submap k (Combined SLAM B5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from graphslam.core.charts import check_chart, map_difference
from graphslam.core.dense import CloudMap, DensePayload
from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.gaussian import check_covariance
from graphslam.core.geometry import Array, vector_to_tangent_covariance, wrap_angle
from graphslam.core.markup import html_element, join_parts, pair_list
from graphslam.core.path_points import PathPoints
from graphslam.core.poses import position_covariances
from graphslam.core.reading import finite_mask
from graphslam.core.se3 import quat_to_matrix
from graphslam.core.sensor_biases import SensorBiases
from graphslam.core.sketch import plan_sketch
from graphslam.core.trajectory import Trajectory


def turned_covariance(R: Array, covariance: Array) -> Array:
    """Covariance ``(6, 6)`` of rotation and translation of a pose, in axes rotated by ``R`` ``(3, 3)``.

    With ``R = R(exit)ᵀ`` the block of a 3-D landmark map becomes the right tangent at the exit; ``R(exit)`` is the
    inverse.
    """
    both = np.kron(np.eye(2), R)
    return np.asarray(both @ covariance @ both.T)


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkMap:
    """Joint Gaussian over ``[exit pose, landmark_1, …]`` in the base frame.

    In 2-D the vector is ``[x, y, θ, l1x, l1y, …]``, all in the base frame. ``chart`` is the parametrisation in which it
    is Gaussian: these coordinates (the residual of Combined SLAM eq. 15 with the heading wrapped), or the group chart,
    in which a heading error rotates exit and landmarks together (:mod:`graphslam.core.charts`). Mean and covariance are
    the same in both. In 3-D the pose block is a rotation about the axes of the base frame [rad], then a translation
    along them [m].

    Parameters
    ----------
    ids : (n,) int64
        Global landmark identities; -1 = not associated. An id can be repeated (two entries of one landmark).
    exit_pose : (3,) or (7,)
        ``T_start_end``.
    positions : (n, dim)
    covariance : (d + n·dim, …) or None
    information : sparse, same shape, or None
        Exactly one of the two is given.
    detections : (q, 2) int64 or None
        Pairs (index in the log's observation stream, landmark of this map), for evaluating the association; not used by
        solvers.
    chart : "cartesian" or "group"
        External maps and those of the papers are Cartesian; the front ends of this package use the group chart.
    path : PathPoints or None
        Points of the path at fixes, jointly Gaussian with the map (2-D only).
    biases : SensorBiases or None
        Dependence of the map on constant errors of wheels and sensor; the Gaussian assumes that they are zero.
    """

    ids: npt.NDArray[np.int64]
    exit_pose: Array
    positions: Array
    covariance: Array | None = None
    information: sp.csc_matrix | None = None
    detections: npt.NDArray[np.int64] | None = None
    chart: str = "cartesian"
    path: PathPoints | None = None
    biases: SensorBiases | None = None

    def __post_init__(self) -> None:
        check_chart(self.chart)
        ids = np.ascontiguousarray(self.ids, dtype=np.int64)
        pose = np.ascontiguousarray(self.exit_pose, dtype=np.float64)
        dim = {3: 2, 7: 3}.get(pose.shape[0] if pose.ndim == 1 else -1)
        if dim is None:
            raise GeometryError("exit pose has the wrong shape", got=pose.shape, wanted="(3,) or (7,)")
        positions = np.ascontiguousarray(self.positions, dtype=np.float64).reshape(-1, dim)
        if len(positions) != len(ids):
            raise GeometryError("landmark ids and positions differ in number", got=len(positions), wanted=len(ids))
        if not (np.all(finite_mask(pose)) and np.all(finite_mask(positions))):
            raise GeometryError("landmark map is not finite", got=pose, wanted="finite poses and positions")
        n = (3 if dim == 2 else 6) + positions.size
        if (self.covariance is None) == (self.information is None):
            raise CovarianceError(
                "a landmark map carries either a covariance or an information matrix",
                got="both" if self.covariance is not None else "none",
            )
        if self.covariance is not None:
            object.__setattr__(self, "covariance", check_covariance(self.covariance, what="submap covariance", dim=n))
        else:
            info = sp.csc_matrix(self.information)
            if info.shape != (n, n):
                raise CovarianceError("submap information has the wrong shape", got=info.shape, wanted=(n, n))
            if not np.all(finite_mask(info.data)):
                raise CovarianceError("submap information is not finite", wanted="finite numbers")
            object.__setattr__(self, "information", info)
        if self.path is not None and (self.path.cross.shape[1] != n or len(self.path.lever) != dim):
            raise GeometryError("points of the path do not fit the map", got=self.path.cross.shape, wanted=f"(…, {n})")
        if self.biases is not None and len(self.biases.response) != n:
            raise GeometryError(
                "systematic errors do not fit the map", got=self.biases.response.shape, wanted=f"({n}, 6)"
            )
        if self.detections is not None:
            rows = np.ascontiguousarray(self.detections, dtype=np.int64).reshape(-1, 2)
            if len(rows) and (rows[:, 1].min() < 0 or rows[:, 1].max() >= len(ids)):
                raise GeometryError("observations of a landmark that is not in the map", got=rows[:, 1].max())
            object.__setattr__(self, "detections", rows)
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "exit_pose", pose)
        object.__setattr__(self, "positions", positions)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return 2 if len(self.exit_pose) == 3 else 3

    @property
    def mean(self) -> Array:
        """``[exit pose, landmarks…]`` as one vector; in 3-D the pose has seven numbers."""
        return np.concatenate([self.exit_pose, self.positions.ravel()])

    def dense_covariance(self) -> Array:
        """Joint covariance, inverted from the information matrix if that is stored."""
        if self.covariance is not None:
            return self.covariance
        assert self.information is not None
        try:
            P = np.linalg.inv(self.information.toarray())
        except np.linalg.LinAlgError:
            raise CovarianceError("submap information matrix is singular", wanted="positive definite") from None
        return 0.5 * (P + P.T)

    def dense_information(self) -> Array:
        """Joint information matrix, inverted from the covariance if that is stored."""
        if self.information is not None:
            return np.asarray(self.information.toarray())
        assert self.covariance is not None
        L = np.linalg.inv(self.covariance)
        return np.asarray(0.5 * (L + L.T))

    def subset(self, keep: npt.ArrayLike) -> LandmarkMap:
        """Marginal over the exit pose and the landmarks ``keep`` (mask or integer indices)."""
        chosen = np.asarray(keep)
        k = np.arange(len(self))[chosen if chosen.size else chosen.astype(np.intp)]  # an empty list has type float
        d = 3 if self.dim == 2 else 6
        ix = np.concatenate([np.arange(d), (d + self.dim * k[:, None] + np.arange(self.dim)).ravel()]).astype(np.intp)
        return LandmarkMap(
            ids=self.ids[k],
            exit_pose=self.exit_pose,
            positions=self.positions[k],
            covariance=self.dense_covariance()[np.ix_(ix, ix)],
            chart=self.chart,
            path=None if self.path is None else self.path.of_landmarks(ix),
            biases=None if self.biases is None else self.biases.of_landmarks(ix),
        )

    def with_biases(self, mean: Array, covariance: Array) -> LandmarkMap:
        """The map with Gaussian constant errors of wheels and sensor included; unchanged if it has no biases.

        Parameters
        ----------
        mean, covariance : (6,), (6, 6)
            Of the errors, including the information of this map.
        """
        if self.biases is None:
            return self
        S = self.biases.response
        off = S @ mean
        exit_pose = self.exit_pose + off[:3]
        exit_pose[2] = wrap_angle(exit_pose[2])
        return LandmarkMap(
            ids=self.ids, exit_pose=exit_pose, positions=self.positions + off[3:].reshape(-1, 2),
            covariance=self.dense_covariance() + S @ covariance @ S.T, detections=self.detections, chart=self.chart,
        )  # fmt: skip

    def difference(self, x: Array) -> Array:
        """Difference of ``x`` (layout of :attr:`mean`) from the mean in this map's chart ``(n,)``."""
        return map_difference(x, self.mean, self.chart, space=self.dim == 3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """A re-entry into an earlier submap, found by the front end.

    Parameters
    ----------
    target : int
        Key of the earlier submap.
    T_target_here : (3,) or (7,)
        Base of this submap in the target's base frame.
    covariance : (d, d)
        Right tangent.
    fitness : float
        Registration fitness in [0, 1].
    support : float
        Share of the particle weight with this match; the null match has the rest.
    """

    target: int
    T_target_here: Array
    covariance: Array
    fitness: float
    support: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Submap:
    """A local map in the frame of its first pose.

    Parameters
    ----------
    key : int
    interval : (t_start, t_end)
        Seconds.
    exit_pose : (3,) or (7,)
        ``T_start_end``.
    exit_covariance : (d, d)
        Right tangent at the exit, GTSAM order.
    landmarks : LandmarkMap or None
    trajectory : Trajectory or None
        ``T_start_body(t)``.
    grid : EvidenceGrid or None
        In the base frame.
    cloud : CloudMap or None
        In the base frame; an array ``(m, dim)`` is read as points without further data.
    matches : tuple of Match
    uses : frozenset of str
        Streams whose information is already used in the submap.
    assisting_streams : frozenset of str
        Streams that were used only for preprocessing (start of a match, deskewing), not in the covariances. A factor
        may still use them.
    report : mapping
        Report of the front end: reason for the end of the map, consistency values, counts. JSON-serialisable.

    Examples
    --------
    >>> submap = gs.local_maps(log)[0]
    >>> submap
    Submap(0, [0.00, 5.60] s, 15 landmarks)
    >>> submap.exit_pose.shape, submap.landmarks.ids.shape
    ((3,), (15,))
    """

    key: int
    interval: tuple[float, float]
    exit_pose: Array
    exit_covariance: Array
    landmarks: LandmarkMap | None = None
    trajectory: Trajectory | None = None
    grid: DensePayload | None = None
    cloud: CloudMap | None = None
    matches: tuple[Match, ...] = ()
    uses: frozenset[str] = frozenset()
    assisting_streams: frozenset[str] = frozenset()
    report: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        d = 3 if len(self.exit_pose) == 3 else 6
        object.__setattr__(self, "exit_pose", np.ascontiguousarray(self.exit_pose, dtype=np.float64))
        object.__setattr__(
            self,
            "exit_covariance",
            check_covariance(self.exit_covariance, what=f"exit covariance of submap {self.key}", dim=d),
        )
        if self.cloud is not None:
            cloud = self.cloud if isinstance(self.cloud, CloudMap) else CloudMap(points=self.cloud)
            if cloud.dim != self.dim:
                raise GeometryError(
                    f"the cloud of submap {self.key} is {cloud.dim}-D", got=cloud.points.shape, wanted=f"{self.dim}-D"
                )
            object.__setattr__(self, "cloud", cloud)
        t0, t1 = self.interval
        if not t1 > t0:
            raise GeometryError(f"interval of submap {self.key} is empty", got=self.interval, wanted="t_end > t_start")

    @classmethod
    def from_landmarks(
        cls, key: int, landmarks: LandmarkMap, *, interval: tuple[float, float] | None = None, **rest: Any
    ) -> Submap:
        """A landmark submap; its exit is derived from the joint Gaussian. Default interval: [k, k+1]."""
        P = landmarks.dense_covariance()
        d = 3 if landmarks.dim == 2 else 6
        exit_cov = P[:d, :d]
        if landmarks.dim == 2:
            exit_cov = vector_to_tangent_covariance(landmarks.exit_pose, exit_cov)
        else:
            exit_cov = turned_covariance(quat_to_matrix(landmarks.exit_pose[3:]).T, exit_cov)
        return cls(
            key=key,
            interval=interval or (float(key), float(key + 1)),
            exit_pose=landmarks.exit_pose,
            exit_covariance=exit_cov,
            landmarks=landmarks,
            **rest,
        )

    @property
    def dim(self) -> int:
        """2 or 3."""
        return 2 if len(self.exit_pose) == 3 else 3

    def with_ids(self, ids: npt.ArrayLike) -> Submap:
        """The submap with landmark ids ``ids`` ``(n,)``."""
        if self.landmarks is None:
            raise GeometryError(f"submap {self.key} has no landmarks to identify")
        return replace(self, landmarks=replace(self.landmarks, ids=np.asarray(ids, dtype=np.int64)))

    def of_session(self, name: str) -> Submap:
        """The submap with the stream names of one session of several: ``name/stream``."""
        uses, aids = (frozenset(f"{name}/{u}" for u in streams) for streams in (self.uses, self.assisting_streams))
        return replace(self, uses=uses, assisting_streams=aids)

    def __repr__(self) -> str:
        n = 0 if self.landmarks is None else len(self.landmarks)
        return f"Submap({self.key}, [{self.interval[0]:.2f}, {self.interval[1]:.2f}] s, {n} landmarks)"

    def _repr_html_(self) -> str:
        d = self.dim
        P = position_covariances(self.exit_pose[None], self.exit_covariance[None])[:, :2, :2]
        s = np.sqrt(np.diag(self.exit_covariance))
        metres, radians = (s[:2], s[2:]) if d == 2 else (s[3:], s[:3])
        lm, sigmas = self.landmarks, f"σ at most {metres.max():.3g} m and {np.degrees(radians.max()):.3g}°"
        n = 0 if lm is None else len(lm)
        summary = f": end pose {sigmas}; {n} landmarks, [{self.interval[0]:.2f}, {self.interval[1]:.2f}] s"
        path = np.stack([np.zeros(d), self.exit_pose[:d]]) if self.trajectory is None else self.trajectory.positions
        ellipses = [(self.exit_pose[None, :2], P)]
        if lm is not None and d == 2 and n:
            rows = 3 + 2 * np.arange(n)[:, None] + np.arange(2)
            ellipses.append((lm.positions, lm.dense_covariance()[rows[:, :, None], rows[:, None, :]]))
        seen = lm.positions if lm is not None else None if self.cloud is None else self.cloud.points
        picture = plan_sketch([path], points=seen, ellipses=ellipses)
        return join_parts([html_element("b", f"Submap {self.key}"), summary, picture, pair_list(self.report)])
