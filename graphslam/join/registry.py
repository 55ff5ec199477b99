"""Registry of the methods for joining submaps into one map."""

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
from graphslam.join.optimise import optimise_from_join as polish_join
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_blocks import relabel, scale_covariances
from graphslam.join.submap_solver import SubmapEstimate, solve_submaps

if TYPE_CHECKING:
    from graphslam.join.graph_problem import JoinProblem


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
    "ekf": join_ekf,
}


SOLVERS: dict[str, Callable[..., SubmapEstimate]] = {"isam2": _isam2, "batch": _batch}


Material: TypeAlias = Union[Sequence[Submap], "JoinProblem"]
"""Input of a join: 2-D landmark submaps, for which there are compiled methods, or any factor graph.

(The module of :class:`~graphslam.join.graph_problem.JoinProblem` loads gtsam, which landmark submaps do not need.)
"""


class JoinMethods(NamedTuple):
    """The methods for one type of input: filters, solvers, and the function for the polish."""

    joiners: dict[str, Callable[..., Any]]
    solvers: dict[str, Callable[..., Any]]
    polish: Callable[[Any, Any], Any]

    def check(self, method: str) -> None:
        """Refuse an unknown name."""
        if method not in self.joiners and method not in self.solvers:
            raise UnknownNameError("method", method, [*self.joiners, *self.solvers])


def are_landmark_submaps(submaps: Sequence[Submap]) -> bool:
    """Whether the compiled methods support these submaps: 2-D, with landmarks, without matches between submaps."""
    return any(s.landmarks is not None for s in submaps) and all(s.dim == 2 and not s.matches for s in submaps)


def methods_for(material: Material) -> JoinMethods:
    """The methods for this input."""
    if isinstance(material, Sequence):
        return JoinMethods(JOINERS, SOLVERS, polish_join)
    from graphslam.join.graph_join import GRAPH_JOINERS, GRAPH_SOLVERS, optimise_estimate

    return JoinMethods(GRAPH_JOINERS, GRAPH_SOLVERS, optimise_estimate)


def prepare_submaps(
    submaps: Material, *, associate: str | MapAssociationConfig = "given", covariance_scale: float = 1.0
) -> Material:
    """2-D landmark submaps with scaled covariances; everything else as a graph with all its factors."""
    association = association_of(associate)
    if isinstance(submaps, Sequence) and are_landmark_submaps(submaps):
        return list(submaps) if covariance_scale == 1.0 else scale_covariances(submaps, covariance_scale)
    if association is not None:
        raise ConfigError(f"only landmark submaps in the plane are associated while joining; got {associate!r}")
    if isinstance(submaps, Sequence):
        from graphslam.join.graph_problem import JoinProblem

        return JoinProblem.of_submaps(submaps, covariance_scale=covariance_scale)
    if covariance_scale != 1.0:
        raise ConfigError("the covariances of a graph are those of its factors: wanted scale 1")
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
    submaps : sequence of Submap, or JoinProblem
        In order; submap k+1 starts where submap k ends. Matches in the submaps are factors, too. A
        :class:`~graphslam.join.graph_problem.JoinProblem` has all factors of a graph.
    method : str
        ``eif-tree``, ``eif-sequential``: extended information filters, in the chart of the submaps; with ``-classical``
        as in the paper, Cartesian and linearised once. ``ekf``: linearised once. ``batch``, ``isam2``: least squares.
    polish : bool
        Continue to the least-squares optimum.
    associate : "given", "nearest", "joint" or Association
        Landmarks are matched by id, or associated while joining, ignoring their ids. The solvers use the association of
        a sequential join.
    covariance_scale : float
        Factor on every submap's covariance.
    workers, cluster : optional
        Number of processes, or address of a Dask scheduler, for the joins of ``eif-tree``.
    progress : bool
        Show a progress bar.

    Returns
    -------
    SubmapEstimate
        A :class:`~graphslam.join.joined_map.JoinResult` for 2-D landmark submaps, otherwise a
        :class:`~graphslam.join.graph_join.GraphEstimate`.
    """
    submaps = prepare_submaps(submaps, associate=associate, covariance_scale=covariance_scale)
    methods = methods_for(submaps)
    methods.check(method)
    if (workers is not None or cluster is not None) and not method.startswith("eif-tree"):
        raise ConfigError(f"only eif-tree can be joined by several workers; got {method!r}")
    if workers is not None and cluster is not None:
        raise ConfigError("wanted either a number of workers or the address of a cluster; got both")
    association = association_of(associate)
    if not isinstance(submaps, Sequence):
        if workers is not None or cluster is not None:
            raise ConfigError("a graph with more than landmark submaps is joined in one process; wanted no workers")
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
    """Join the first submaps only, to compile kernels and load modules before a timed join.

    Errors of the submaps are ignored here; the complete join reports them.
    """
    with contextlib.suppress(GraphSlamError):
        if isinstance(submaps, Sequence):
            join_by_method(submaps[:3], method, polish=polish)
        else:
            join_by_method(submaps.first_submaps(3), method, polish=polish)


def identify_landmarks(
    submaps: Sequence[Submap], association: MapAssociationConfig, *, progress: bool = False
) -> list[Submap]:
    """The submaps with the landmark ids from the data association of a sequential join."""
    return relabel(submaps, join_sequential(submaps, association=association, progress=progress).submap_ids)
