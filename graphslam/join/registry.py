"""Every way of joining submaps into one map, by name."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, Union

from graphslam.core.errors import ConfigError, GraphSlamError, UnknownNameError
from graphslam.core.submap import Submap
from graphslam.join.association import MapAssociationConfig
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinResult
from graphslam.join.online import join_online
from graphslam.join.optimise import optimise_from_join as polish_join
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_blocks import relabel, scale_covariances
from graphslam.join.submap_solver import SubmapEstimate, solve_submaps

if TYPE_CHECKING:
    from graphslam.join.pose_problem import PoseProblem


def _isam2(submaps: Sequence[Submap], *, polish: bool, progress: bool) -> SubmapEstimate:
    from graphslam.join.submap_isam2 import solve_submaps_isam2  # gtsam takes a second to load

    return solve_submaps_isam2(submaps, polish=polish, progress=progress)


def _batch(submaps: Sequence[Submap], *, polish: bool, progress: bool) -> SubmapEstimate:
    return solve_submaps(submaps)


JOINERS: dict[str, Callable[..., JoinResult]] = {
    "eif-tree": join_tree,
    "eif-sequential": join_sequential,
    "eif-tree-classical": partial(join_tree, classical=True),
    "eif-sequential-classical": partial(join_sequential, classical=True),
    "eif-online": join_online,
    "ekf": join_ekf,
}


SOLVERS: dict[str, Callable[..., SubmapEstimate]] = {"isam2": _isam2, "batch": _batch}


Material: TypeAlias = Union[Sequence[Submap], "PoseProblem"]
"""What is joined: submaps with landmarks or without; or the latter with all their ties, which is no sequence.

(The module of a :class:`~graphslam.join.pose_problem.PoseProblem` loads gtsam, which landmark submaps do not need.)
"""


class JoinMethods(NamedTuple):
    """The methods of one kind of material: those that filter, those that solve, and the way on to the optimum."""

    joiners: dict[str, Callable[..., Any]]
    solvers: dict[str, Callable[..., Any]]
    polish: Callable[[Any, Any], Any]

    def check(self, method: str) -> None:
        """Refuse an unknown name."""
        if method not in self.joiners and method not in self.solvers:
            raise UnknownNameError("method", method, [*self.joiners, *self.solvers])


def are_dense(submaps: Sequence[Submap]) -> bool:
    """Whether submaps are to be joined by their poses: none of them has landmarks."""
    return bool(submaps) and all(s.landmarks is None for s in submaps)


def have_space_landmarks(submaps: Sequence[Submap]) -> bool:
    """Whether submaps with landmarks are three-dimensional."""
    return any(s.dim == 3 for s in submaps)


def methods_for(material: Material) -> JoinMethods:
    """The methods that take landmark submaps, in the plane or in space, or those that take dense ones."""
    if not isinstance(material, Sequence):
        from graphslam.join.pose_estimate import optimise_poses
        from graphslam.join.pose_join import POSE_JOINERS, POSE_SOLVERS

        return JoinMethods(POSE_JOINERS, POSE_SOLVERS, optimise_poses)
    if have_space_landmarks(material):
        from graphslam.join.space import SPACE_JOINERS, SPACE_SOLVERS, optimise_space

        return JoinMethods(SPACE_JOINERS, SPACE_SOLVERS, optimise_space)
    return JoinMethods(JOINERS, SOLVERS, polish_join)


def prepare_submaps(
    submaps: Material, *, associate: str | MapAssociationConfig = "given", covariance_scale: float = 1.0
) -> Material:
    """Submaps with their covariances as they are to be joined; dense ones with the matches that tie them."""
    association = association_of(associate)
    if isinstance(submaps, Sequence) and not are_dense(submaps):
        if association is not None and have_space_landmarks(submaps):
            raise ConfigError(f"landmarks in space are joined by the ids that they bear; got {associate!r}")
        return list(submaps) if covariance_scale == 1.0 else scale_covariances(submaps, covariance_scale)
    if association is not None:
        raise ConfigError(f"dense submaps have no landmarks to be associated; got {associate!r}, wanted 'given'")
    if isinstance(submaps, Sequence):
        from graphslam.join.pose_problem import PoseProblem

        return PoseProblem.of_submaps(submaps, covariance_scale=covariance_scale)
    if covariance_scale != 1.0:
        raise ConfigError("the covariances of dense submaps with ties are those of their graph: wanted scale 1")
    return submaps


def association_of(associate: str | MapAssociationConfig) -> MapAssociationConfig | None:
    if isinstance(associate, MapAssociationConfig):
        return associate
    if associate == "given":
        return None
    if associate in ("nearest", "joint"):
        return MapAssociationConfig(rule=associate)  # type: ignore[arg-type]
    raise ConfigError(f"unknown association {associate!r}; wanted 'given', 'nearest' or 'joint'")


def join_by_method(
    submaps: Material,
    method: str = "eif-tree",
    *,
    polish: bool = False,
    associate: str | MapAssociationConfig = "given",
    covariance_scale: float = 1.0,
    workers: int | None = None,
    cluster: str | None = None,
    progress: bool = False,
) -> SubmapEstimate:
    """Join submaps into one map.

    Parameters
    ----------
    submaps : sequence of Submap, or PoseProblem
        In order; submap k+1 starts where submap k ends. Those without landmarks are joined by their poses: with the
        matches that they carry, or with all constraints of a :class:`~graphslam.join.pose_problem.PoseProblem`.
    method : str
        ``eif-tree``, ``eif-sequential``: extended information filters, in the chart of the submaps; with ``-classical``
        as the paper has them, Cartesian and linearised once. ``ekf``: once linearised. ``eif-online``: in sequence,
        linearised afresh when a loop closes or a heading moves. ``batch``, ``isam2``: least squares.
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
        A :class:`~graphslam.join.joined_map.JoinResult` for landmark submaps; of dense submaps a
        :class:`~graphslam.join.pose_estimate.PoseEstimate`.

    Raises
    ------
    UnknownNameError, ConfigError, DataError, GeometryError, CovarianceError
    """
    submaps = prepare_submaps(submaps, associate=associate, covariance_scale=covariance_scale)
    methods = methods_for(submaps)
    methods.check(method)
    if (workers is not None or cluster is not None) and not method.startswith("eif-tree"):
        raise ConfigError(f"only eif-tree can be joined by several workers; got {method!r}")
    if workers is not None and cluster is not None:
        raise ConfigError("wanted either a number of workers or the address of a cluster; got both")
    association = association_of(associate)
    if not isinstance(submaps, Sequence) or have_space_landmarks(submaps):
        if workers is not None or cluster is not None:
            raise ConfigError(
                "dense submaps and those in space are joined in one process; wanted neither workers nor a cluster"
            )
        if method in methods.solvers:
            return methods.solvers[method](submaps, polish=polish, progress=progress)
        found = methods.joiners[method](submaps, progress=progress)
        return methods.polish(submaps, found) if polish else found
    if method in SOLVERS:
        if association is not None:
            submaps = identify_landmarks(submaps, association, progress=progress)
        return SOLVERS[method](submaps, polish=polish, progress=progress)
    shared = {"workers": workers, "executor": cluster} if method.startswith("eif-tree") else {}
    joined = JOINERS[method](submaps, association=association, progress=progress, **shared)
    return polish_join(submaps, joined) if polish else joined


def compile_method(submaps: Material, method: str, *, polish: bool = False) -> None:
    """Join the first submaps alone: kernels are compiled and modules loaded, and neither is timed or measured later.

    What is wrong with the submaps is left to the join of all of them to report.
    """
    first = submaps[:3] if isinstance(submaps, Sequence) else submaps.part(0, min(3, len(submaps.keys)))
    with contextlib.suppress(GraphSlamError):
        join_by_method(first, method, polish=polish)


def identify_landmarks(
    submaps: Sequence[Submap], association: MapAssociationConfig, *, progress: bool = False
) -> list[Submap]:
    """The same submaps with the landmark ids that joining them in sequence finds."""
    return relabel(submaps, join_sequential(submaps, association=association, progress=progress).submap_ids)
