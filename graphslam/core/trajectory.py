"""Times, poses and covariances of a path, in two or three dimensions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike, se2_between, se2_compose, se2_exp, se2_log
from graphslam.core.markup import html_element, join_parts
from graphslam.core.poses import group_of, position_covariances
from graphslam.core.reading import finite_mask
from graphslam.core.records import check_times
from graphslam.core.sketch import plan_sketch

Index = npt.NDArray[np.intp]

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True, repr=False)
class Trajectory:
    """A path ``T_frame_body(t)``.

    Parameters
    ----------
    times : (n,)
        Strictly increasing [s].
    poses : (n, 3) [m, m, rad] or (n, 7), position [m] and quaternion (x, y, z, w)
    covariances : (n, d, d) or None
        Right tangent, GTSAM order; d = 3 or 6.

    Examples
    --------
    >>> path = run.map.trajectory
    >>> path.interpolate(path.times[:1] + 0.05).shape
    (1, 3)
    """

    times: Array
    poses: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", check_times(self.times, len(self.poses), where="trajectory"))
        poses = np.ascontiguousarray(self.poses, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] not in (3, 7):
            raise GeometryError("trajectory poses have the wrong shape", got=poses.shape, wanted="(n, 3) or (n, 7)")
        if not np.all(finite_mask(poses)):
            k = int(np.argwhere(~finite_mask(poses))[0][0])
            raise GeometryError(f"trajectory pose {k} is not finite", got=poses[k])
        object.__setattr__(self, "poses", poses)
        if self.covariances is not None:
            d = 3 if poses.shape[1] == 3 else 6
            C = np.ascontiguousarray(self.covariances, dtype=np.float64)
            if C.shape != (len(poses), d, d):
                raise GeometryError(
                    "trajectory covariances have the wrong shape", got=C.shape, wanted=(len(poses), d, d)
                )
            if not np.all(finite_mask(C)):
                k = int(np.argwhere(~finite_mask(C))[0][0])
                raise GeometryError(f"trajectory covariance {k} is not finite", got=C[k])
            object.__setattr__(self, "covariances", C)

    def __len__(self) -> int:
        return len(self.times)

    def to_pandas(self) -> pd.DataFrame:
        """One row per time, indexed by ``time`` [s]: ``x, y, heading`` [m, rad], in 3-D ``x, y, z, qx, qy, qz, qw``.

        With covariances also ``sigma_…`` of each coordinate of the right tangent (rotations first in 3-D).
        """
        import pandas as pd

        plane = self.poses.shape[1] == 3
        names = ["x", "y", "heading"] if plane else ["x", "y", "z", "qx", "qy", "qz", "qw"]
        columns = dict(zip(names, self.poses.T))
        if self.covariances is not None:
            tangent = names if plane else ["roll", "pitch", "yaw", "x", "y", "z"]
            columns |= {f"sigma_{n}": np.sqrt(self.covariances[:, k, k]) for k, n in enumerate(tangent)}
        return pd.DataFrame(columns, index=pd.Index(self.times, name="time"))

    def to_numpy(self) -> Array:
        """Times and poses in one array: ``(n, 4)`` of t, x, y, θ; in 3-D ``(n, 8)`` of t, x, y, z, qx, qy, qz, qw."""
        return np.column_stack([self.times, self.poses])

    def _repr_html_(self) -> str:
        from graphslam.core.gaussian import largest_sigmas  # loads SciPy

        sigma = "no covariances"
        P: Array | None = None
        if self.covariances is not None and len(self):
            P = position_covariances(self.poses, self.covariances)[:, :2, :2]
            sigma = f"σ of the position at most {largest_sigmas(P).max():.3g} m"
        text = f": {self.length():.1f} m, {sigma}; {len(self)} poses"
        when = f", {self.times[0]:.2f} to {self.times[-1]:.2f} s" if len(self) else ""
        picture = plan_sketch([self.positions], ellipses=[] if P is None else [(self.positions, P)])
        return join_parts([html_element("b", "Trajectory"), text, when, picture])

    def __repr__(self) -> str:
        when = f", {self.times[0]:.6g} to {self.times[-1]:.6g} s" if len(self) else ""
        note = "" if self.covariances is None else ", with covariances"
        return f"Trajectory({len(self)} poses in {'the plane' if self.poses.shape[1] == 3 else 'space'}{when}{note})"

    @property
    def dim(self) -> int:
        """2 or 3."""
        return 2 if self.poses.shape[1] == 3 else 3

    @property
    def positions(self) -> Array:
        """``(n, dim)``."""
        return self.poses[:, : self.dim]

    def _bracket(self, t: ArrayLike, max_gap: float | None) -> tuple[Index, Index, Array]:
        q = np.atleast_1d(np.asarray(t, dtype=np.float64))
        if len(self) == 0 or not np.all((q >= self.times[0]) & (q <= self.times[-1])):  # also rejects NaN
            span = f"[{self.times[0]:.3f}, {self.times[-1]:.3f}]" if len(self) else "an empty trajectory"
            raise DataError("time outside the trajectory", got=f"[{q.min():.3f}, {q.max():.3f}]", wanted=span)
        j = np.clip(np.searchsorted(self.times, q, side="right"), 1, max(len(self) - 1, 1))
        i = j - 1
        if len(self) == 1:
            j = i
        span_s = self.times[j] - self.times[i]
        u = np.where(span_s > 0, (q - self.times[i]) / np.where(span_s > 0, span_s, 1.0), 0.0)
        if max_gap is not None and np.any((span_s > max_gap) & (u > 0) & (u < 1)):
            raise DataError(
                "time falls in a gap of the trajectory", got=f"{span_s.max():.3f} s", wanted=f"≤ {max_gap} s"
            )
        return np.asarray(i), np.asarray(j), np.asarray(u, dtype=np.float64)

    def interpolate(self, t: ArrayLike, *, max_gap: float | None = None) -> Array:
        """Poses at times ``t`` ``(q,)`` [s] along the geodesic between neighbours, position *and* heading.

        Neighbours more than ``max_gap`` [s] apart are refused (DataError).
        """
        i, j, u = self._bracket(t, max_gap)
        a, b = self.poses[i], self.poses[j]
        if self.dim == 2:
            return se2_compose(a, se2_exp(u[:, None] * se2_log(se2_between(a, b))))
        return se3.se3_compose(a, se3.se3_exp(u[:, None] * se3.se3_log(se3.se3_between(a, b))))

    def interpolate_covariance(self, t: ArrayLike) -> Array:
        """Covariances ``(q, d, d)`` at ``t``, linear between neighbours (an upper bound inside a submap's step)."""
        if self.covariances is None:
            raise DataError("trajectory has no covariances", wanted="covariances")
        i, j, u = self._bracket(t, None)
        w = u[:, None, None]
        return (1.0 - w) * self.covariances[i] + w * self.covariances[j]

    def points(self, lever: ArrayLike) -> Array:
        """World positions ``(n, dim)`` of a point fixed in the body at ``lever`` ``(dim,)``."""
        return group_of(self.poses).transform(self.poses, np.broadcast_to(lever, (len(self), self.dim)))

    def transformed(self, T_new_frame: ArrayLike) -> Trajectory:
        """The same path in another frame; right-tangent covariances do not change."""
        T = np.broadcast_to(T_new_frame, self.poses.shape)
        return replace(self, poses=group_of(self.poses).compose(T, self.poses))

    def take(self, index: Any) -> Trajectory:
        """The poses ``index`` (slice, mask or integer array) as a path: a trajectory can be a stream of a log."""
        covariances = None if self.covariances is None else self.covariances[index]
        return replace(self, times=self.times[index], poses=self.poses[index], covariances=covariances)

    def length(self) -> float:
        """Length of the path [m]."""
        return float(np.sum(np.linalg.norm(np.diff(self.positions, axis=0), axis=1))) if len(self) > 1 else 0.0
