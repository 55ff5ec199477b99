"""Relation error: relative poses of pairs, not positions in a frame (Burgard et al. 2009, eq. 3–5).

Whether a map is right does not depend on where its frame is. What is compared are the relative poses of pairs that a
reference states: of neighbours, which say how smooth a path is, and of pairs at random, which say whether the map hangs
together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.trajectory import Trajectory

Index = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class RelationError:
    """Errors of the relations between pairs of poses.

    Parameters
    ----------
    translation : (m,)
        [m]
    rotation : (m,)
        [rad]
    """

    translation: Array
    rotation: Array

    @property
    def pairs(self) -> int:
        """Their number."""
        return len(self.translation)

    def as_row(self) -> dict[str, float]:
        """One row of a table: metres and degrees."""
        t, r = self.translation, np.degrees(self.rotation)
        return {
            "pairs": self.pairs,
            "translation_mean": float(t.mean()),
            "translation_median": float(np.median(t)),
            "translation_p95": float(np.quantile(t, 0.95)),
            "rotation_mean_deg": float(r.mean()),
            "rotation_median_deg": float(np.median(r)),
        }


def relation_error(estimate: Trajectory, reference: Trajectory, pairs: tuple[Index, Index]) -> RelationError:
    """Errors of the relative poses of pairs.

    Parameters
    ----------
    estimate : Trajectory
        Covers the stamps of the reference; interpolated at them.
    pairs : (m,) and (m,)
        Places in the reference.
    """
    if estimate.dim != reference.dim:
        raise DataError("trajectories differ in dimension", got=estimate.dim, wanted=reference.dim)
    i, j = (np.asarray(p, dtype=np.intp) for p in pairs)
    if len(i) != len(j) or not len(i):
        raise DataError("pairs of relations do not match, or there are none", got=(len(i), len(j)))
    used = np.unique(np.concatenate([i, j]))
    outside = (reference.times[used] < estimate.times[0]) | (reference.times[used] > estimate.times[-1])
    if np.any(outside):
        raise DataError(
            f"{int(outside.sum())} poses of the reference lie outside the estimate",
            got=f"{reference.times[used][outside][0]:.3f} s",
            wanted=f"{estimate.times[0]:.3f} to {estimate.times[-1]:.3f} s",
        )
    between = group_of(reference.poses).between
    a, b = estimate.interpolate(reference.times[i]), estimate.interpolate(reference.times[j])
    d = between(between(reference.poses[i], reference.poses[j]), between(a, b))
    if reference.dim == 2:
        return RelationError(translation=np.linalg.norm(d[:, :2], axis=1), rotation=np.abs(d[:, 2]))
    return RelationError(
        translation=np.linalg.norm(d[:, :3], axis=1), rotation=np.linalg.norm(se3.so3_log(d[:, 3:]), axis=1)
    )


def covered_part(reference: Trajectory, estimate: Trajectory) -> Trajectory:
    """The part of the reference that the estimate covers in time."""
    inside = (reference.times >= estimate.times[0]) & (reference.times <= estimate.times[-1])
    return reference.take(np.flatnonzero(inside))


def consecutive_pairs(n: int) -> tuple[Index, Index]:
    """Each pose with the next ``(n - 1,)``."""
    k = np.arange(n, dtype=np.intp)
    return k[:-1], k[1:]


def random_pairs(n: int, pairs: int, rng: np.random.Generator) -> tuple[Index, Index]:
    """Pairs of different poses, drawn evenly ``(pairs,)``."""
    if n < 2:
        raise DataError("too few poses for a pair", got=n, wanted="at least 2")
    i = rng.integers(n, size=pairs)
    j = (i + rng.integers(1, n, size=pairs)) % n
    return i.astype(np.intp), j.astype(np.intp)
