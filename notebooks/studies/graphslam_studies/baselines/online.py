"""Join submaps as they come, and stay at the least-squares optimum where one linearisation is not enough.

A submap is linearised once, where its start is believed to be when it arrives. When a loop closes, the start of every
earlier submap moves, and with it the direction in which each of them measured; a map that keeps the old linearisation
then believes in its own errors. So all submaps are linearised afresh, to the minimum of the joint objective
(Gauss–Newton from the values at hand), when something happened that can have moved them: a landmark is seen again after
a long time, or a heading has been corrected by more than a degree since it was last used.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, wrap_angle
from graphslam.core.jit import njit
from graphslam.core.progress import Bar
from graphslam.core.submap import Submap
from graphslam.join.association import MapAssociationConfig, match_landmarks
from graphslam.join.eif import join_maps, match_by_id
from graphslam.join.joined_map import JoinedMap, JoinResult, JoinTimes, OnJoin, check_chain, finish_map, landmark_labels
from graphslam.join.submap_blocks import SubmapProblem
from graphslam.join.submap_solver import MinimisationResult, minimise_submaps

logger = logging.getLogger(__name__)
Nodes = npt.NDArray[np.int64]


@dataclass(frozen=True)
class RelinearisationPolicy:
    """When all submaps are linearised afresh.

    Parameters
    ----------
    closure_gap : int
        A landmark is seen again that was last seen more than this many submaps ago.
    max_heading : float
        The heading of a pose differs by more than this from the one its submap was linearised at [rad].
    every : int
        After every so many submaps in any case; 0: never for that reason alone.
    rtol, max_iterations
        See :func:`~graphslam.join.submap_solver.minimise_submaps`.
    """

    closure_gap: int = 5
    max_heading: float = math.radians(1.0)
    every: int = 0
    rtol: float = 1e-9
    max_iterations: int = 50

    def __post_init__(self) -> None:
        if self.closure_gap < 1 or self.every < 0 or self.max_iterations < 1:
            raise ConfigError(f"relinearisation: {self}; wanted closure_gap ≥ 1, every ≥ 0, max_iterations ≥ 1")
        if not (self.max_heading > 0.0 and self.rtol > 0.0):
            raise ConfigError(f"relinearisation: {self}; wanted max_heading > 0 and rtol > 0")


@dataclass(frozen=True)
class OnlineJoinResult(JoinResult):
    """The last map of the sequence.

    Parameters
    ----------
    relinearisations : mapping of str to int
        How often all submaps were linearised afresh, by reason.
    """

    relinearisations: Mapping[str, int] = field(default_factory=dict)


@dataclass
class _Online:
    """The map so far, and what the policy must remember of it."""

    joined: JoinedMap
    last_seen: npt.NDArray[np.int64]  # submap that saw each landmark last
    linearised: Array  # heading at which each pose was last linearised as the start of a submap

    def reasons(self, k: int, again: npt.NDArray[np.intp], policy: RelinearisationPolicy) -> list[str]:
        """Why to linearise afresh after submap k, which saw the old landmarks ``again``."""
        found = []
        if policy.every and k % policy.every == 0:
            found.append("every")
        if np.any(self.last_seen[again] < k - policy.closure_gap):
            found.append("closure")
        heading = self.joined.x[self.joined.pose_at + 2][: len(self.linearised)]
        if np.any(np.abs(wrap_angle(heading - self.linearised)) > policy.max_heading):
            found.append("heading")
        return found


def join_online(
    submaps: Sequence[Submap],
    *,
    policy: RelinearisationPolicy | None = None,
    association: MapAssociationConfig | None = None,
    on_join: OnJoin | None = None,
    progress: bool = False,
) -> OnlineJoinResult:
    """Join submaps in sequence, each linearised once, and all of them afresh when the policy says so.

    Parameters
    ----------
    policy : RelinearisationPolicy, optional
        With ``every=1`` the map is the least-squares optimum of the submaps so far after each of them.
    association : MapAssociationConfig, optional
        Recognise landmarks; default: by the ids they bear.
    on_join : callable, optional
        See :func:`~graphslam.join.order.join_sequential`; called after the relinearisation, where there is one.
    progress : bool
        Show a progress bar.

    Returns
    -------
    OnlineJoinResult
        ``relinearisations`` counts them by reason (one may have several) and in all; ``times`` has a part
        ``relinearisation``; ``iterations`` are those of all Gauss–Newton searches; ``converged`` says whether the last
        submap's search ended at the optimum.

    Raises
    ------
    DataError, CovarianceError, SolverError
    """
    policy = policy or RelinearisationPolicy()
    identified = association is None
    check_chain(submaps, identified=identified)
    times = JoinTimes()
    counts = dict.fromkeys(("every", "closure", "heading", "all"), 0)
    iterations, converged = 0, False
    with times.measure("update"):
        leaves, matrices = JoinedMap.leaves(submaps, identified=identified, classical=True)
    state = _Online(leaves[0], np.zeros(len(leaves[0].ids), dtype=np.int64), np.zeros(0))
    if on_join is not None:
        on_join(0, state.joined)
    for k, leaf in enumerate(Bar(leaves[1:], name="join", unit="submap", shown=progress), start=1):
        with times.measure("association"):
            match = (
                match_by_id(state.joined, leaf)
                if association is None
                else match_landmarks(state.joined, leaf, association)
            )
        start = state.joined.x[state.joined.pose_at[-1] + 2]
        state.joined = join_maps(state.joined, leaf, match, times)
        state.linearised = np.append(state.linearised, start)
        again = match[match >= 0]
        why = state.reasons(k, again, policy)
        state.last_seen[again] = k
        new = len(state.joined.landmark_node) - len(state.last_seen)
        state.last_seen = np.append(state.last_seen, np.full(new, k))
        converged = False
        if why:
            with times.measure("relinearisation"):
                known = None if matrices is None else matrices[: k + 1]
                state.joined, best = _relinearise(submaps[: k + 1], state.joined, known, policy, identified)
            state.linearised = state.joined.x[state.joined.pose_at + 2][:-1].copy()
            iterations, converged = iterations + best.iterations, best.converged
            for name in [*why, "all"]:
                counts[name] += 1
            logger.debug("submap %d: relinearised (%s), %d iterations", k, ", ".join(why), best.iterations)
        if on_join is not None:
            on_join(k, state.joined)
    joined = finish_map(
        submaps, state.joined, identified=identified, method="eif-online", times=times, information=matrices
    )
    parts = {f.name: getattr(joined, f.name) for f in fields(joined)} | {
        "iterations": iterations,
        "converged": converged,
    }
    return OnlineJoinResult(**parts, relinearisations=counts)


def _relinearise(
    submaps: Sequence[Submap],
    joined: JoinedMap,
    matrices: Sequence[Array] | None,
    policy: RelinearisationPolicy,
    identified: bool,
) -> tuple[JoinedMap, MinimisationResult]:
    """The same map at the least-squares optimum of its submaps, reached from its present mean."""
    labels = landmark_labels(joined, joined.ids, identified=identified)
    problem = SubmapProblem(submaps, ids=[labels[e] for e in joined.entries], information=matrices)
    # Poses, then landmarks by first observation: both sides number their landmarks that way.
    scalars = np.concatenate(
        [(joined.pose_at[:, None] + np.arange(3)).ravel(), (joined.landmark_at[:, None] + np.arange(2)).ravel()]
    )
    best = minimise_submaps(problem, joined.x[scalars], rtol=policy.rtol, max_iterations=policy.max_iterations)
    pattern = problem.pattern
    block, values = _symmetrise_blocks(
        pattern.width, pattern.ptr, pattern.neighbours, pattern.block, pattern.flip, best.data
    )
    m = problem.m
    fresh = JoinedMap(
        x=best.x,
        width=pattern.width,
        ptr=pattern.ptr,
        neighbours=pattern.neighbours,
        block=block,
        values=values,
        pose_node=np.arange(m),
        landmark_node=m + np.arange(len(problem.ids)),
        ids=joined.ids,
        entry_landmark=joined.entry_landmark,
        entry_count=joined.entry_count,
        order=pattern.order,
        fill=pattern.symbolic.nnz / len(values),
    )
    return fresh, best


@njit
def _symmetrise_blocks(
    width: Nodes, ptr: Nodes, idx: Nodes, block: Nodes, flip: Nodes, value: Array
) -> tuple[Nodes, Array]:
    """Blocks that are stored once for each pair (``flip`` = 1: with the neighbour's rows) as blocks stored both ways.

    Returns
    -------
    block : (nb,); value : (k,)
        As in :func:`~graphslam.join.kernels.join_blocks`.
    """
    total = 0
    for i in range(len(width)):
        for e in range(ptr[i], ptr[i + 1]):
            total += width[i] * width[idx[e]]
    out_block = np.empty(len(idx), np.int64)
    out = np.empty(total)
    k = 0
    for i in range(len(width)):
        wi = width[i]
        for e in range(ptr[i], ptr[i + 1]):
            wj, v = width[idx[e]], block[e]
            out_block[e] = k
            for p in range(wi):
                for q in range(wj):
                    out[k] = value[v + q * wi + p] if flip[e] else value[v + p * wj + q]
                    k += 1
    return out_block, out
