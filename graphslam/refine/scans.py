"""Scans of steps, with motion and gravity: all inputs of a refinement, and their file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import read_npz, write_npz
from graphslam.core.errors import DataError, FormatError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.npz import Field, flags, floats, ints
from graphslam.core.poses import Group, group_of
from graphslam.core.records import Odometry, check_offsets, check_times
from graphslam_frontends.odometry.motion_prior import BiasSigmas
from graphslam_frontends.odometry.steps import Steps

SCANS_FORMAT = "graphslam.scans/1"
FIELDS: dict[str, Field] = {
    "times": floats("n"),
    "increments": floats("n", "p"),
    "covariances": floats("n", "d", "d"),
    "offsets": ints("n+1"),
    "points": floats("q", "c"),
    "origins": floats("q", "c"),
    "returns": flags("q"),
    "scalars": floats("s"),
    "ages": floats("q", optional=True),
    "tilt": floats("n", "t", optional=True),
}
BIASES = ("yaw_bias", "yaw_walk", "scale", "direction", "clock", "tilt", "bend", "turn")
"""``scalars``: max_range, tilt_sigma, tilt_time, these σ of systematic errors, ``matched`` (0 if missing)."""
REACH = 10.0, 30.0
"""Bounds of the reach (distance of chunks that may observe the same surfaces), if the log determines it [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scans:
    """Beams of n steps, the motion between them, and gravity.

    Parameters
    ----------
    times : (n,)
        Stamps [s].
    odometry : Odometry
        Increments at ``times``; each covariance has only the noise that is new.
    offsets : (n + 1,) int64
        Beams of step k are rows ``offsets[k]:offsets[k + 1]``.
    points, origins : (q, dim)
        Ends and origins of the beams, frame of the base at the stamp of their step, in single precision [m].
    returns : (q,) bool
    ages : (q,) or None
        Time from each beam to the stamp of its step, bridged by the motion alone [s]; None: no time.
    max_range : float
        [m]
    tilt : (n, 2) or None
        Roll and pitch from gravity [rad].
    tilt_sigma, tilt_time : float
        σ and correlation time of their error [rad], [s].
    matched : bool
        The odometry was made by matching consecutive scans.
    """

    times: Array
    odometry: Odometry
    offsets: npt.NDArray[np.int64]
    points: npt.NDArray[np.float32]
    origins: npt.NDArray[np.float32]
    returns: npt.NDArray[np.bool_]
    max_range: float
    biases: BiasSigmas
    ages: npt.NDArray[np.float32] | None = None
    tilt: Array | None = None
    tilt_sigma: float = 0.0
    tilt_time: float = 1.0
    name: str = "scans"
    matched: bool = False

    @classmethod
    def of(cls, steps: Steps) -> Scans:
        """Scans of steps, with σ of the systematic errors of their motion, at least those
        of :data:`~graphslam_frontends.odometry.motion_prior.LEAST`."""
        odometry = steps.odometry
        if steps.recorded is not None:  # corrected by scans: use the recorded σ, so that scans are not used twice
            odometry = replace(odometry, covariances=steps.recorded.covariances)
        same = ("times", "offsets", "returns", "max_range", "tilt", "tilt_sigma", "tilt_time", "name", "matched")
        return cls(
            odometry=odometry,
            points=steps.points.astype(np.float32, copy=False),
            origins=steps.origins.astype(np.float32, copy=False),
            ages=None if steps.ages is None else steps.ages.astype(np.float32),
            biases=steps.bias_sigmas,
            **{k: getattr(steps, k) for k in same},
        )

    def __len__(self) -> int:
        return len(self.times)

    @property
    def group(self) -> Group:
        """SE(2) or SE(3)."""
        return group_of(self.odometry.increments)

    @property
    def path_length(self) -> Array:
        """Path length up to each step ``(n,)``, by the odometry [m]."""
        return np.cumsum(np.linalg.norm(self.odometry.increments[:, : self.group.dim], axis=1))

    @property
    def reach(self) -> float:
        """Range below which three quarters of the returns are, clipped to :data:`REACH` [m]."""
        points = (self.points - self.origins)[self.returns]
        if not len(points):
            return REACH[0]
        return float(np.clip(np.quantile(np.linalg.norm(points[:: 1 + len(points) // 100_000], axis=1), 0.75), *REACH))

    def scan(self, k: int) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Points ``(m, dim)``, origins ``(m, dim)`` and returns ``(m,)`` of step k."""
        rows = slice(int(self.offsets[k]), int(self.offsets[k + 1]))
        return self.points[rows].astype(np.float64), self.origins[rows].astype(np.float64), self.returns[rows]

    def save(self, file: Path) -> None:
        """Write ``scans.npz``."""
        biases = [getattr(self.biases, k) for k in BIASES]
        arrays: dict[str, Any] = {
            "format": SCANS_FORMAT,
            "times": self.times,
            "increments": self.odometry.increments,
            "covariances": self.odometry.covariances,
            "offsets": self.offsets,
            "points": self.points,
            "origins": self.origins,
            "returns": self.returns,
            "scalars": np.array([self.max_range, self.tilt_sigma, self.tilt_time, *biases, self.matched]),
        }
        if self.ages is not None:
            arrays["ages"] = self.ages
        if self.tilt is not None:
            arrays["tilt"] = self.tilt
        write_npz(file, arrays)

    @classmethod
    def load(cls, file: Path, name: str = "scans") -> Scans:
        """Read ``scans.npz``."""
        a = read_npz(file, fmt=SCANS_FORMAT, fields=FIELDS)
        s = a["scalars"]
        try:
            if len(s) not in (11, 12) or not np.all(s >= 0) or s[0] <= 0:
                raise DataError("scalars are impossible", got=s.tolist(), wanted="11 or 12 numbers, ≥ 0, the range > 0")
            d = {3: 2, 7: 3}.get(a["increments"].shape[1])
            if d is None or a["points"].shape != a["origins"].shape or a["points"].shape[1] != d:
                raise DataError("points and increments do not fit", got=(a["increments"].shape, a["points"].shape))
            if not len(a["returns"]) == len(a.get("ages", a["returns"])) == len(a["points"]):
                raise DataError("beams differ in number", got=len(a["returns"]), wanted=len(a["points"]))
            times = check_times(a["times"])
            return cls(
                times=times,
                odometry=Odometry(times=times, increments=a["increments"], covariances=a["covariances"]),
                offsets=check_offsets(a["offsets"], len(a["points"]), where=str(file)),
                points=a["points"],
                origins=a["origins"],
                returns=a["returns"],
                ages=a.get("ages"),
                max_range=float(s[0]),
                tilt=a.get("tilt"),
                tilt_sigma=float(s[1]),
                tilt_time=float(s[2]),
                biases=BiasSigmas(**dict(zip(BIASES, s[3:11].tolist()))),
                name=name,
                matched=bool(np.any(s[11:])),
            )
        except (DataError, GeometryError) as error:
            raise FormatError(error.what, where=str(file), got=error.got, wanted=error.wanted) from None
