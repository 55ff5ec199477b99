"""Custom GTSAM factors of an IMU, by the terms of our own families on one row.

GTSAM's ``CombinedImuFactor`` knows neither where a unit is mounted on a node, nor a frame that leans against gravity;
with the unit at the node and no lean the two agree (a test holds them against each other). The factors never raise and
fill every Jacobian they are asked for (see :mod:`graphslam.graph.gtsam_space`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from graphslam.core.geometry import Array
from graphslam.graph.factors.imu.family import ForceFamily, GyroFamily, ImuBiasFamily, ImuFamily
from graphslam.graph.factors.imu.records import ForceRecord, GyroRecord, ImuBiasRecord, MotionRecord
from graphslam.graph.families import UniformFamily
from graphslam.graph.gtsam_values import pose_array
from graphslam.graph.state import Layout, Values, gtsam_key

_WIDTH = {"x": 6, "v": 3, "i": 6, "t": 2}
_LAYOUT = Layout(3, (), False, 0, 3, True, 2, 2)


def imu_in_space(record: MotionRecord, noise: Any, origin: Array) -> gtsam.CustomFactor:
    """The GTSAM factor of a record; ``noise`` is of unit size, the terms are whitened."""
    names = record.variables()
    widths = [_WIDTH[n[0]] for n in names]
    family, start = _alone(record)
    first = start + np.concatenate([[0], np.cumsum(widths)])
    free = [k for k, n in enumerate(names) if n != "x0"]
    keys = [gtsam_key(n) for n in names]
    empty = Values.empty(3)

    def error(_: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        try:
            poses, found = np.tile(origin, (3, 1)), {"v": np.zeros((2, 3)), "i": np.zeros((2, 6))}
            tilt, seen = np.zeros(2), dict.fromkeys("xvi", 0)
            for name, key in zip(names, keys):
                letter = name[0]
                if letter == "t":
                    tilt = values.atVector(key)
                    continue
                k = seen[letter]
                seen[letter] = k + 1
                if letter == "x":
                    poses[k + 1] = origin if name == "x0" else pose_array(values.atPose3(key))
                else:
                    found[letter][k] = values.atVector(key)
            here = replace(empty, poses=poses, tilt=tilt, velocities=found["v"], imu_biases=found["i"])
            r, J = family.terms(here)
            if H is not None:
                for h, k in enumerate(free):
                    H[h] = np.asfortranarray(J[0][:, first[k] : first[k + 1]])
            return np.asarray(r[0])
        except Exception:  # whatever it is, GTSAM must not see it: nan is refused by the solver instead
            for h, k in enumerate(free if H is not None else []):
                H[h] = np.zeros((record.rows, widths[k]))  # type: ignore[index]
            return np.full(record.rows, np.nan)

    return gtsam.CustomFactor(noise, [keys[k] for k in free], error)


def _alone(record: MotionRecord) -> tuple[UniformFamily, int]:
    """A family of this one factor, on nodes 1 and 2 and the first rows, and its first column that is a variable's."""
    if isinstance(record, ImuBiasRecord):
        bare = record.before is None
        one = replace(record, before=None if bare else 0, bias=0 if bare else 1)
        return ImuBiasFamily([one], _LAYOUT), 6 if bare else 0
    if isinstance(record, ForceRecord):
        return ForceFamily([replace(record, node=1, bias=0)], _LAYOUT), 0
    way = replace(record, i=1, j=2, velocities=(0, 1), biases=(0, 1))
    return (GyroFamily if isinstance(record, GyroRecord) else ImuFamily)([way], _LAYOUT), 0
