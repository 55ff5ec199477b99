"""Result of a solver: values with their uncertainty, and whether they are the optimum."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError, MissingDataError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.markup import Markup, html_element, join_parts
from graphslam.core.poses import group_of
from graphslam.core.trajectory import Trajectory
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph, SubmapNode
from graphslam.graph.factors.gps import level_datum_pose
from graphslam.graph.factors.landmark_submap import SubmapRecord
from graphslam.graph.factors.sensor_biases import bias_variable_names, sensor_biases_at
from graphslam.graph.network import network_of
from graphslam.graph.score import GraphScore, score_graph
from graphslam.graph.variables import Values, variable_name, vector_form
from graphslam.solve.descent import Optimum

if TYPE_CHECKING:
    from graphslam.solve.network.certificate import Certificate


@dataclass(frozen=True, repr=False)
class Solution:
    """A solved graph, independent of later changes of the graph.

    Parameters
    ----------
    score : GraphScore
        χ² and dof per class of factor.
    iterations : int
        Total iterations of the solver (updates of an incremental one).
    converged : bool
        True only at the optimum: the predicted decrease of the quadratic model is negligible.
    decrement : float
        That predicted decrease.
    gap : float or None
        Objective minus the batch optimum reached from here; None if not computed.
    seconds : float
        Time in the solver.
    """

    solver: str
    values: Values
    score: GraphScore
    iterations: int
    converged: bool
    decrement: float
    gap: float | None
    seconds: float
    gps_origin: Array | None
    _flat: FactorArrays = field(repr=False)
    _submaps: Sequence[SubmapNode] = field(repr=False)

    @property
    def objective(self) -> float:
        """``Σ rᵀ P⁻¹ r`` (no ½)."""
        return self.score.total

    @property
    def poses(self) -> Array:
        """Nodes ``(m + 1, 3|7)`` in the frame of the first base: bases, inner nodes, exits."""
        return self.values.poses

    @property
    def submap_keys(self) -> npt.NDArray[np.int64]:
        """Keys of the submaps ``(m,)`` in order."""
        return np.array([s.key for s in self._submaps], dtype=np.int64)

    @property
    def exit_nodes(self) -> npt.NDArray[np.intp]:
        """Row of :attr:`poses` at the end of every submap ``(m,)``."""
        return np.array([s.exit_node for s in self._submaps], dtype=np.intp)

    @property
    def base_nodes(self) -> npt.NDArray[np.intp]:
        """Row of :attr:`poses` at the base of every submap ``(m,)``."""
        return np.array([s.node for s in self._submaps], dtype=np.intp)

    @property
    def submaps(self) -> tuple[SubmapNode, ...]:
        """Nodes of every submap, inner ones included."""
        return tuple(self._submaps)

    @property
    def chart(self) -> str:
        """Parametrisation in which its landmark maps are Gaussian: "group" if all are, otherwise "cartesian"."""
        charts = {r.chart for r in self._flat.records if isinstance(r, SubmapRecord) and len(r.landmark_ids)}
        return "group" if charts == {"group"} else "cartesian"

    @property
    def anchors(self) -> npt.NDArray[np.intp]:
        """Row of :attr:`poses` at the end of the submap that observed each landmark first ``(n,)``; -1 if none did."""
        first: dict[int, int] = {}
        for r in self._flat.records:
            if isinstance(r, SubmapRecord):
                for i in r.landmark_ids.tolist():
                    first.setdefault(i, r.start + 1)
        return np.array([first.get(i, -1) for i in self.landmark_ids.tolist()], dtype=np.intp)

    @property
    def node_times(self) -> Array:
        """Time of every node ``(m + 1,)`` [s]; where two submaps meet, the start of the later one."""
        out = np.full(len(self.poses), np.nan)
        for s in self._submaps:
            out[list(s.nodes)] = s.times
        return out

    @property
    def landmark_ids(self) -> npt.NDArray[np.int64]:
        """``(n,)``."""
        return self.values.landmark_ids

    @property
    def landmarks(self) -> Array:
        """``(n, 2)``."""
        return self.values.landmarks

    @property
    def states(self) -> int:
        """Number of free scalars, without the fixed first base."""
        return self._flat.layout.size

    @property
    def T_gps_world(self) -> Array | None:
        """Map → frame of the GPS stream ``(3,)`` or ``(7,)``, or None without GPS."""
        if self.values.datum is None or self.gps_origin is None:
            return None
        if self.values.dim == 3:
            T = level_datum_pose(self.values.datum, self.values.tilt)
            return np.concatenate([T[:3] + self.gps_origin, T[3:]])
        return self.values.datum + np.append(self.gps_origin, 0.0)

    @cached_property
    def _joint(self) -> JointCovariance:
        """Joint covariance at these values; cached."""
        return JointCovariance(self._flat.layout, self._flat.evaluate(self.values).A)

    def covariance(self, a: str | int, b: str | int | None = None) -> Array:
        """Covariance of one variable ``(d, d)``, or of two with each other ``(d_a, d_b)``.

        Of a pose in its right tangent: ``[δx, δy, δθ]`` or ``[δω, δv]``; zeros for the fixed first base ``x0``.

        Parameters
        ----------
        a, b : str or int
            Such as ``"x3"``, ``"l17"``, ``"datum"``, ``"bias0"``; a number k is the pose ``"xk"``; or a key of GTSAM.
        """
        first = variable_name(a)
        second = first if b is None else variable_name(b)
        lay, P = self._flat.layout, self._joint
        if first == second:
            return P.marginal(first)
        if "x0" in (first, second):
            return np.zeros([lay.pose_dof if n == "x0" else len(lay.columns(n)) for n in (first, second)])
        d = len(lay.columns(first))
        return P.joint([first, second])[:d, d:]

    def joint_marginal(self, names: Iterable[str | int]) -> Array:
        """Joint covariance of several variables in that order, named as in :meth:`covariance`; none of ``x0``."""
        return self._joint.joint(map(variable_name, names))

    def node_covariances(self) -> Array:
        """``(m + 1, d, d)``, right tangent; zeros for the fixed first base."""
        return self._joint.poses()

    def landmark_covariances(self) -> Array:
        """``(n, 2, 2)``."""
        return self._joint.landmarks()

    def joint_covariance(self) -> Array:
        """Dense covariance of ``[x_1 … x_m (x, y, θ vectors), landmarks]`` in the frame of the first base."""
        lay = self._flat.layout
        if lay.dim != 2:
            raise GeometryError("poses in space have no covariance as vectors", wanted="joint_marginal")
        P = self._joint.columns(np.arange(lay.stop("l")))
        return vector_form(P, self.values.poses[1:], [3 * k for k in range(lay.nodes - 1)])

    def certificate(self) -> Certificate:
        """Certificate of the global optimum; "not known", with the reason, if it does not apply.

        It covers relative poses only, not GPS, IMU, landmarks, kernels …
        """
        from graphslam.solve.network.certificate import Certificate, certify

        try:
            network = network_of(self._flat, self.values)
        except SolverError as error:
            return Certificate("not known", str(error))
        return certify(network, self.poses, self.objective)

    def trajectory(self, *, covariances: bool = True, keys: Collection[int] | None = None) -> Trajectory:
        """Path at full rate: ``x_k ∘ T_k_body(t)`` for every submap with a trajectory.

        ``x_k`` is the submap's base; the local path is corrected for constant errors of wheels and sensor if the graph
        estimates them. Covariances are first order, ``Ad(T⁻¹) P_k Ad(T⁻¹)ᵀ + P_local(t)`` with independent base and
        local path. At a common time of two submaps the later one is used, because its local covariance is smaller.

        The path of a submap with inner nodes is conditioned on both neighbouring nodes
        (:class:`~graphslam.graph.submap_node.PathBridge`), so it passes through the nodes without a jump; its
        covariance is that of the two nodes jointly and of the path between them.

        Parameters
        ----------
        keys : collection of int, optional
            Only these submaps, e.g. those of one robot of several.
        """
        P_nodes = self.node_covariances() if covariances else None
        P_biases = self._bias_covariances() if covariances else {}
        times, poses, covs = [], [], []
        chosen = [s for s in self._submaps if keys is None or s.key in keys]
        with_path = [s for s in chosen if s.trajectory is not None and len(s.trajectory)]
        if not with_path:
            raise MissingDataError("no submap has a trajectory", wanted="submaps with T_start_body(t)")
        last, group = np.inf, group_of(self.values.poses)
        for s in reversed(with_path):
            path = s.trajectory
            assert path is not None
            keep = path.times < last
            if not np.any(keep):
                continue
            last = float(path.times[keep][0])
            times.append(path.times[keep])
            if s.inner and path.covariances is not None:
                T, P = self._bent(s, keep, P_nodes)
                poses.append(T)
                covs.append(P)
                continue
            at = s.before(path.times[keep])
            node = np.array(s.nodes)[at]
            T, P_local = s.local_rows(keep, at)
            if s.biases is not None:
                S = s.biases.path[keep]
                T = group.compose(T, group.exp(S @ sensor_biases_at(self.values, s.robot)))
                if P_local is not None and P_nodes is not None:
                    P_local = P_local + S @ P_biases[s.robot] @ np.swapaxes(S, 1, 2)
            poses.append(group.compose(self.values.poses[node], T))
            if P_nodes is not None:
                ad = group.adjoint(group.inverse(T))
                P = ad @ P_nodes[node] @ np.swapaxes(ad, 1, 2)
                covs.append(P if P_local is None else P + P_local)
        return Trajectory(
            np.concatenate(times[::-1]),
            np.concatenate(poses[::-1]),
            np.concatenate(covs[::-1]) if covariances else None,
        )

    def _bias_covariances(self) -> dict[int, Array]:
        """Covariance of the constant errors of each robot ``(6, 6)``."""
        robots = range(self.values.count("wheels"))
        return {k: self._joint.joint(bias_variable_names(k)) for k in robots}

    def _bent(self, s: SubmapNode, rows: npt.NDArray[np.bool_], P_nodes: Array | None) -> tuple[Array, Array]:
        """Poses and covariances of a path between the nodes of its submap, conditioned on both neighbours."""
        assert s.trajectory is not None
        x, group = self.values.poses, group_of(self.values.poses)
        at, nodes = s.before(s.trajectory.times[rows]), np.array(s.nodes)
        b = s.between(rows, at)
        T_ab = group.between(s.T_base_node[:-1], s.T_base_node[1:])
        e = group.log(group.between(T_ab, group.between(x[nodes[:-1]], x[nodes[1:]])))[at]
        own = group.compose(b.T_node_body, group.exp((b.gain @ e[..., None])[..., 0]))
        poses = group.compose(x[nodes[at]], own)
        if P_nodes is None:
            return poses, np.zeros((0, group.dof, group.dof))
        P = P_nodes[nodes]
        P_ab = self._joint.cross(nodes[:-1], nodes[1:])[at]
        # δ_t = F δ_a + K δ_b + w, F = Ad(T_at⁻¹) - K Ad(T_ab⁻¹)
        F = group.adjoint(group.inverse(b.T_node_body)) - b.gain @ group.adjoint(group.inverse(T_ab))[at]
        Ft, Kt = np.swapaxes(F, 1, 2), np.swapaxes(b.gain, 1, 2)
        mixed = F @ P_ab @ Kt
        C = F @ P[at] @ Ft + b.gain @ P[at + 1] @ Kt + mixed + np.swapaxes(mixed, 1, 2) + b.left
        return poses, 0.5 * (C + np.swapaxes(C, 1, 2))

    def __repr__(self) -> str:
        at = "at the optimum" if self.converged else "not at its optimum"
        return (
            f"Solution({self.solver!r}: {len(self.poses)} nodes, {len(self.landmarks)} landmarks, "
            f"objective {self.objective:.6g}, {at})"
        )

    def _repr_html_(self) -> str:
        verdict = "at the optimum" if self.converged else f"not at its optimum (may still fall by {self.decrement:.3g})"
        gap = "" if self.gap is None else f", gap {self.gap:.3g}"
        summary = (
            f" ({self.solver}) {len(self.poses)} nodes, {len(self.landmarks)} landmarks, objective "
            f"{self.objective:.4f}, {verdict}{gap}, {self.iterations} iterations, {self.seconds:.2f} s"
        )
        return join_parts([html_element("b", "Solution"), summary, Markup(self.score._repr_html_())])


# Decrement of an optimum, relative to max(1, objective): below the precision of printed objectives, above rounding
# errors.
CONVERGED = 1e-8


def make_solution(
    solver: str, graph: FactorGraph, optimum: Optimum, *, iterations: int, gap: float | None, seconds: float
) -> Solution:
    """A :class:`Solution` from the graph's current state and the result of an optimiser."""
    flat = graph.flat()
    return Solution(
        solver=solver,
        values=optimum.values.copy(),
        score=score_graph(flat, flat.evaluate(optimum.values, hessian=False).chi2),
        iterations=iterations,
        converged=optimum.decrement <= CONVERGED * max(1.0, optimum.objective),
        decrement=optimum.decrement,
        gap=gap,
        seconds=seconds,
        gps_origin=None if graph.gps_origin is None else graph.gps_origin.copy(),
        _flat=flat,
        _submaps=tuple(graph.submaps),
    )
