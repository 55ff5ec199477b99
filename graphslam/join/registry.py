"""Every way of joining submaps into one map, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.core.submap import Submap
from graphslam.join.association import Association
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinResult
from graphslam.join.online import join_online
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.polish import polish as polish_join
from graphslam.join.submap_blocks import relabel, scale_covariances
from graphslam.join.submap_solver import SubmapEstimate, solve_submaps


def _isam2(submaps: Sequence[Submap], *, polish: bool, progress: bool) -> SubmapEstimate:
    from graphslam.join.submap_isam2 import solve_submaps_isam2  # gtsam takes a second to load

    return solve_submaps_isam2(submaps, polish=polish, progress=progress)


def _batch(submaps: Sequence[Submap], *, polish: bool, progress: bool) -> SubmapEstimate:
    return solve_submaps(submaps)


JOINERS: dict[str, Callable[..., JoinResult]] = {
    "eif-tree": join_tree,
    "eif-sequential": join_sequential,
    "eif-online": join_online,
    "ekf": join_ekf,
}


SOLVERS: dict[str, Callable[..., SubmapEstimate]] = {"isam2": _isam2, "batch": _batch}


def association_of(associate: str | Association) -> Association | None:
    if isinstance(associate, Association):
        return associate
    if associate == "given":
        return None
    if associate in ("nearest", "joint"):
        return Association(rule=associate)  # type: ignore[arg-type]
    raise ConfigError(f"unknown association {associate!r}; wanted 'given', 'nearest' or 'joint'")


def join(
    submaps: Sequence[Submap],
    method: str = "eif-tree",
    *,
    polish: bool = False,
    associate: str | Association = "given",
    covariance_scale: float = 1.0,
    workers: int | None = None,
    cluster: str | None = None,
    progress: bool = False,
) -> SubmapEstimate:
    """Join submaps into one map.

    Parameters
    ----------
    submaps : sequence of Submap
        In order; submap k+1 starts where submap k ends.
    method : str
        ``eif-tree``, ``eif-sequential`` or ``ekf``: once linearised. ``eif-online``: in sequence, linearised afresh
        when a loop closes or a heading moves. ``batch``, ``isam2``: least squares.
    polish : bool
        Go on to the least-squares optimum from there.
    associate : "given", "nearest", "joint" or Association
        Landmarks are one if they bear the same id; or are recognised while joining, whatever ids they bear. The solvers
        take ids that were recognised by joining in sequence.
    covariance_scale : float
        Factor on every submap's covariance.
    workers, cluster : optional
        Number of processes, or address of a Dask scheduler, that share the joins of ``eif-tree``.
    progress : bool
        Show a progress bar.

    Returns
    -------
    SubmapEstimate
        A :class:`~graphslam.join.joined_map.JoinResult` for the joiners.

    Raises
    ------
    UnknownNameError, ConfigError, DataError, CovarianceError
    """
    if method not in JOINERS and method not in SOLVERS:
        raise UnknownNameError("method", method, [*JOINERS, *SOLVERS])
    if (workers is not None or cluster is not None) and method != "eif-tree":
        raise ConfigError(f"only eif-tree can be joined by several workers; got {method!r}")
    if workers is not None and cluster is not None:
        raise ConfigError("wanted either a number of workers or the address of a cluster; got both")
    association = association_of(associate)
    submaps = list(submaps) if covariance_scale == 1.0 else scale_covariances(submaps, covariance_scale)
    if method in SOLVERS:
        if association is not None:
            submaps = identify(submaps, association, progress=progress)
        return SOLVERS[method](submaps, polish=polish, progress=progress)
    shared = {"workers": workers, "executor": cluster} if method == "eif-tree" else {}
    joined = JOINERS[method](submaps, association=association, progress=progress, **shared)
    return polish_join(submaps, joined) if polish else joined


def identify(submaps: Sequence[Submap], association: Association, *, progress: bool = False) -> list[Submap]:
    """The same submaps with the landmark ids that joining them in sequence finds."""
    return relabel(submaps, join_sequential(submaps, association=association, progress=progress).submap_ids)
