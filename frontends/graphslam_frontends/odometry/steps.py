"""Steps: motion and beams of a log at common stamps, the input of scan filters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.findings import Finding
from graphslam.core.geometry import Array
from graphslam.core.point_clouds import check_offsets
from graphslam.core.records import Odometry, check_times
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.gaps import Gaps
from graphslam_frontends.odometry.motion_prior import BiasSigmas, MotionPrior


class IntervalCovariance(Protocol):
    """Covariance of dead reckoning over an interval of steps, including systematic errors."""

    def between(
        self, start: int, end: int, *, level_start: bool = False, level_end: bool = False
    ) -> tuple[Array, Array]:
        """Motion from step ``start`` to step ``end``, and its covariance in the right tangent."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """Motion and beams of n steps, in two or three dimensions.

    Parameters
    ----------
    times : (n,)
        Stamps, the end of each step [s].
    odometry : Odometry
        Increments ``(n, 7)`` or ``(n, 3)`` at ``times``: record k moves from step k - 1 to k, record 0 is identity. The
        covariances are those of white noise, without systematic errors.
    offsets : (n + 1,) int64
        Beams of step k are rows ``offsets[k]:offsets[k + 1]``; a step may have none.
    points : (q, dim)
        Ends of the beams, base frame at the step's stamp [m]; at ``max_range`` for beams without a return.
    origins : (q, dim)
        Origins of the beams, same frame.
    returns : (q,) bool
        Does the beam have a return?
    ages : (q,) or None
        Time from each beam to the stamp of its step [s], bridged by the motion alone; None: not known.
    max_range, range_sigma : float
        [m]
    tilt : (n, 2) or None
        Roll and pitch of the base at the stamps, by gravity [rad].
    tilt_sigma, tilt_time : float
        σ of its error [rad], and the correlation time of the error [s].
    uses : frozenset of str
        Streams of the log that were used.
    errors : IntervalCovariance or None
        Covariance of dead reckoning over any interval, if the source of the motion has one.
    gaps : Gaps
        Gaps in the records of the motion, which is extrapolated there.
    findings : tuple of Finding
        Findings from the comparison of scans and motion.
    recorded : Odometry or None
        The motion without scan matches, if ``odometry`` includes them.
    matched : bool
        The odometry is from matching these scans one after the other.
    """

    times: Array
    odometry: Odometry
    offsets: npt.NDArray[np.int64]
    points: Array
    origins: Array
    returns: npt.NDArray[np.bool_]
    max_range: float
    range_sigma: float
    ages: Array | None = None
    tilt: Array | None = None
    tilt_sigma: float = 0.0
    tilt_time: float = 1.0
    uses: frozenset[str] = frozenset()
    name: str = "steps"
    truth: Trajectory | None = None
    errors: IntervalCovariance | None = None
    gaps: Gaps = field(default_factory=Gaps)
    findings: tuple[Finding, ...] = ()
    recorded: Odometry | None = None
    matched: bool = False

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        set_(self, "times", check_times(self.times, where=self.name))
        n, q, d = len(self.times), len(self.points), self.dim
        if not np.array_equal(self.odometry.times, self.times):
            raise DataError("odometry and steps have different stamps", where=self.name)
        set_(self, "offsets", check_offsets(self.offsets, q, where=self.name))
        if len(self.offsets) != n + 1:
            raise DataError("offsets and stamps differ in number", got=len(self.offsets), wanted=n + 1)
        for what in ("points", "origins"):
            given = np.asarray(getattr(self, what))
            a = np.ascontiguousarray(given, dtype=np.float32 if given.dtype == np.float32 else np.float64)
            if a.shape != (q, d):
                raise GeometryError(f"{what} have the wrong shape", where=self.name, got=a.shape, wanted=(q, d))
            if not np.all(ok := np.isfinite(a)):
                raise DataError(f"{what} are not finite", where=f"{self.name}, beam {np.argwhere(~ok)[0][0]}")
            set_(self, what, a)
        returns = np.ascontiguousarray(self.returns)
        if returns.shape != (q,) or returns.dtype != np.bool_:
            raise GeometryError("returns have the wrong shape or type", got=returns.shape, wanted=f"({q},) bool")
        set_(self, "returns", returns)
        for what in ("max_range", "range_sigma"):
            if not (np.isfinite(getattr(self, what)) and getattr(self, what) > 0):
                raise DataError(f"{what} is impossible", where=self.name, got=getattr(self, what), wanted="> 0 m")
        if self.ages is not None and (np.shape(self.ages) != (q,) or not np.all(np.isfinite(self.ages))):
            raise GeometryError("ages have the wrong shape", got=np.shape(self.ages), wanted=f"({q},), finite")
        if self.tilt is not None:
            tilt = np.ascontiguousarray(self.tilt, dtype=np.float64)
            if d != 3 or tilt.shape != (n, 2) or not np.all(np.isfinite(tilt)):
                raise GeometryError(
                    "tilt is impossible", where=self.name, got=tilt.shape, wanted=f"({n}, 2), finite, 3-D"
                )
            set_(self, "tilt", tilt)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return 2 if self.odometry.increments.shape[1] == 3 else 3

    def __len__(self) -> int:
        return len(self.times)

    def scan(self, k: int) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Points ``(m, dim)``, origins ``(m, dim)`` and returns ``(m,)`` of step k."""
        rows = slice(int(self.offsets[k]), int(self.offsets[k + 1]))
        return self.points[rows], self.origins[rows], self.returns[rows]

    @property
    def returned(self) -> npt.NDArray[np.int64]:
        """Number of returns in each step ``(n,)``."""
        return np.diff(np.concatenate([[0], np.cumsum(self.returns)])[self.offsets]).astype(np.int64)

    @property
    def bias_sigmas(self) -> BiasSigmas:
        """Prior σ of the systematic errors, as given with the motion, with lower bounds."""
        stated = self.errors.biases.sigmas if isinstance(self.errors, MotionPrior) else {}
        return BiasSigmas.of({"tilt": self.tilt_sigma, **stated})

    @property
    def path_length(self) -> Array:
        """Metres driven until each step ``(n,)``, by the odometry."""
        return np.cumsum(np.linalg.norm(self.odometry.increments[:, : self.dim], axis=1))
