"""Absolute and relative error of a trajectory (Sturm et al. 2012), in two and three dimensions.

ATE: distance between corresponding positions after a given alignment. RPE: error of the motion over a given distance or
time, ``E_ij = (R_i⁻¹ R_j)⁻¹ (P_i⁻¹ P_j)`` with R the reference and P the estimate; it needs no alignment. The reference
is interpolated at the stamps of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, ArrayLike, align_se2, rotation2
from graphslam.core.poses import group_of
from graphslam.core.records import check_times
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.statistics import ErrorStatistics

Alignment = Literal["none", "origin", "se", "sim"]
Index = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryError:
    """ATE or RPE with the parameters to reproduce it.

    Parameters
    ----------
    kind : {"ATE", "RPE"}
    alignment : {"none", "origin", "se", "sim"}
    times : (n,)
        Stamp of each error; of the first pose of the pair for RPE.
    translation : (n,)
        [m].
    rotation : (n,)
        Absolute angle [rad].
    T_ref_est : (3,) or (7,)
        Alignment that was applied after scaling.
    scale : float
        1 unless ``sim``.
    pairs : int
        Number of errors: associated poses (ATE), or pairs of them ``delta`` apart (RPE).
    delta : (float, str) or None
        RPE only: distance [m] or time [s] of the pairs.
    """

    kind: Literal["ATE", "RPE"]
    alignment: Alignment
    times: Array
    translation: Array
    rotation: Array
    T_ref_est: Array
    scale: float
    pairs: int
    delta: tuple[float, str] | None = None

    def aligned(self, estimate: Trajectory) -> Trajectory:
        """An estimate after the alignment, with its covariances if the scale is 1."""
        poses = estimate.poses.copy()
        poses[:, : estimate.dim] *= self.scale
        covariances = estimate.covariances if self.scale == 1.0 else None
        return Trajectory(estimate.times, poses, covariances).transformed(self.T_ref_est)

    @property
    def statistics(self) -> ErrorStatistics:
        """Of the translation part [m]."""
        return ErrorStatistics.of(self.translation)

    @property
    def rotation_statistics(self) -> ErrorStatistics:
        """Of the rotation part [rad]."""
        return ErrorStatistics.of(self.rotation)

    def as_row(self) -> dict[str, Any]:
        """One row of a table."""
        delta = {} if self.delta is None else {"delta": self.delta[0], "delta_unit": self.delta[1]}
        rot = {f"rotation_{k}": v for k, v in self.rotation_statistics.as_dict().items() if k != "count"}
        head = {"kind": self.kind, "alignment": self.alignment, "pairs": self.pairs, "scale": self.scale}
        return {**head, **delta, **self.statistics.as_dict(), **rot}


def match_stamps(reference_times: ArrayLike, times: ArrayLike, *, max_diff: float = 0.01) -> tuple[Index, Index]:
    """Pairs ``(i, j)`` of stamps that are each other's nearest, not more than ``max_diff`` [s] apart.

    No pose is used twice. Sorted by time.
    """
    r, t = check_times(reference_times, where="reference"), check_times(times, where="estimate")
    if not len(r) or not len(t):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    i = _nearest(r, t)
    j = _nearest(t, r)
    k = np.arange(len(t))
    good = (j[i] == k) & (np.abs(r[i] - t) <= max_diff)
    return i[good], k[good]


def _nearest(sorted_times: Array, query: Array) -> Index:
    after = np.clip(np.searchsorted(sorted_times, query), 1, max(len(sorted_times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(sorted_times) - 1)
    later = np.abs(sorted_times[after] - query) < np.abs(query - sorted_times[before])
    return np.where(later, after, before)


def fit_alignment(reference: Array, estimate: Array, alignment: Alignment) -> tuple[Array, float]:
    """``T_ref_est`` and scale that align estimated poses with reference poses, row by row.

    ``none``; ``origin``: the first poses coincide, heading included; ``se``: rigid least squares on positions; ``sim``:
    with scale (Umeyama 1991).
    """
    g = group_of(reference)
    if alignment == "none":
        return g.identity.copy(), 1.0
    if alignment == "origin":
        return g.compose(reference[0], g.inverse(estimate[0])), 1.0
    if alignment not in ("se", "sim"):
        raise DataError("unknown alignment", got=alignment, wanted="none, origin, se or sim")
    q, p = reference[:, : g.dim], estimate[:, : g.dim]
    if len(p) < 3:
        raise DataError("too few associated poses to align", got=len(p), wanted="at least 3")
    spread = np.linalg.svd(p - p.mean(0), compute_uv=False)
    if spread[g.dim - 2] < 1e-9 * max(1.0, float(np.abs(p).max())):
        got = "a point" if g.dim == 2 else "a point or a line"
        raise DataError("the positions do not determine a rotation", got=got)
    if g.dim == 3:
        return se3.align_se3(p, q, scale=alignment == "sim")
    T = align_se2(p, q)
    if alignment == "se":
        return T, 1.0
    # least squares scale for the optimal rotation, which does not depend on it
    dp, dq = p - p.mean(0), q - q.mean(0)
    turned = dp @ rotation2(T[2]).T
    scale = float(np.sum(turned * dq) / np.sum(dp**2))
    return np.array([*(q.mean(0) - scale * rotation2(T[2]) @ p.mean(0)), T[2]]), scale


def _pair(
    reference: Trajectory, estimate: Trajectory, alignment: Alignment, max_diff: float
) -> tuple[Array, Array, Array, Array, float]:
    """Stamps, reference poses, aligned estimated poses, alignment and scale."""
    if reference.dim != estimate.dim:
        raise DataError(
            "estimate and reference differ in dimension",
            got=f"estimate in {estimate.dim}-D, reference in {reference.dim}-D",
            wanted="both in 3-D (read_tum(…, dim=3)) or both in the plane",
        )
    i, j = match_stamps(reference.times, estimate.times, max_diff=max_diff)
    if not len(i):
        gap = np.abs(reference.times[_nearest(reference.times, estimate.times)] - estimate.times).min(initial=np.inf)
        raise DataError(
            "no stamps of estimate and reference agree",
            got=f"{len(estimate)} and {len(reference)} poses, the nearest {gap:.3f} s apart",
            wanted=f"stamps within {max_diff} s of each other",
        )
    ref, est = reference.interpolate(np.clip(estimate.times[j], *reference.times[[0, -1]])), estimate.poses[j].copy()
    T, scale = fit_alignment(ref, est, alignment)
    est[:, : reference.dim] *= scale
    return estimate.times[j], ref, group_of(est).compose(np.broadcast_to(T, est.shape), est), T, scale


def _size(error: Array) -> tuple[Array, Array]:
    """Length and absolute angle of error poses ``(n, 3)`` or ``(n, 7)``."""
    if error.shape[1] == 3:
        return np.linalg.norm(error[:, :2], axis=1), np.abs(error[:, 2])
    return np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(se3.so3_log(error[:, 3:]), axis=1)


def ate(
    estimate: Trajectory, reference: Trajectory, *, alignment: Alignment = "se", max_diff: float = 0.01
) -> TrajectoryError:
    """Absolute trajectory error.

    Parameters
    ----------
    alignment : {"none", "origin", "se", "sim"}
        See :func:`fit_alignment`.
    max_diff : float
        Largest difference of associated stamps [s].
    """
    times, ref, est, T, scale = _pair(reference, estimate, alignment, max_diff)
    translation, rotation = _size(group_of(est).between(ref, est))
    return TrajectoryError(
        kind="ATE",
        alignment=alignment,
        times=times,
        translation=translation,
        rotation=rotation,
        T_ref_est=T,
        scale=scale,
        pairs=len(times),
    )


def delta_pairs(progress: Array, delta: float, *, tolerance: float, all_pairs: bool) -> tuple[Index, Index]:
    """Pairs ``i < j`` whose ``progress`` (path length or time, ``(n,)``, non-decreasing) differs by ``delta``.

    For each i the first j whose difference is nearest to ``delta``, kept if within ``tolerance``. With
    ``all_pairs=False`` the pairs do not overlap: the next one starts where the last one ended.
    """
    n = len(progress)
    i = np.arange(n - 1)
    want = progress[i] + delta
    after = np.clip(np.searchsorted(progress, want), i + 1, n - 1)
    before = np.maximum(after - 1, i + 1)
    j = np.where(np.abs(progress[before] - want) <= np.abs(progress[after] - want), before, after)
    # at standstill the progress is constant: use the first of equal candidates
    j = np.maximum(np.searchsorted(progress, progress[j], side="left"), i + 1)
    good = np.abs(progress[j] - want) <= tolerance
    if all_pairs:
        return i[good], j[good]
    chain, k = [], 0
    while k < n - 1:
        if good[k]:
            chain.append(k)
            k = int(j[k])
        else:
            k += 1
    c = np.array(chain, dtype=np.intp)
    return c, j[c]


def rpe(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    delta: float = 1.0,
    unit: Literal["m", "s"] = "m",
    relative_tolerance: float = 0.1,
    all_pairs: bool = True,
    scale: bool = False,
    max_diff: float = 0.01,
) -> TrajectoryError:
    """Relative pose error over ``delta`` metres of the *reference's* path, or over ``delta`` seconds.

    Parameters
    ----------
    relative_tolerance : float
        A pair may miss ``delta`` by this fraction of it.
    all_pairs : bool
        Every pose starts a pair (overlapping), instead of a chain.
    scale : bool
        Correct the estimate's scale first (monocular methods).
    """
    if not delta > 0:
        raise DataError("RPE needs a positive delta", got=delta, wanted="> 0")
    alignment: Alignment = "sim" if scale else "none"
    times, ref, est, T, s = _pair(reference, estimate, alignment, max_diff)
    if unit == "m":
        steps = np.linalg.norm(np.diff(ref[:, : reference.dim], axis=0), axis=1)
        progress = np.concatenate([[0.0], np.cumsum(steps)])
    elif unit == "s":
        progress = times - times[0]
    else:
        raise DataError("unknown unit of delta", got=unit, wanted="m or s")
    i, j = delta_pairs(progress, delta, tolerance=relative_tolerance * delta, all_pairs=all_pairs)
    if not len(i):
        raise DataError(f"no two poses are {delta} {unit} apart", got=f"{progress[-1]:.3f} {unit} in all")
    between = group_of(est).between
    translation, rotation = _size(between(between(ref[i], ref[j]), between(est[i], est[j])))
    return TrajectoryError(
        kind="RPE",
        alignment=alignment,
        times=times[i],
        translation=translation,
        rotation=rotation,
        T_ref_est=T,
        scale=s,
        pairs=len(i),
        delta=(float(delta), unit),
    )
