"""The factor graph: functions that add submaps, sensors and other factors.

Node ``x_k`` is the base of submap k, ``x_0`` is fixed at the origin, the last node is the end of the last submap. The
graph has records, values and the ledger, but no solver; solvers read them and write values back.

Examples
--------
One call per finished submap, and the end of a run::

    graph = FactorGraph()
    solver = make_solver("isam2", graph)                     # graphslam.solve.registry; "batch" has the same methods
    config = AssociationConfig(covariance_scale=5.0)         # graphslam.association.landmarks
    graph.add_sensor(log["gps"], config=GpsConfig(robust=RobustKernel("cauchy", 2.385)))  # fixes wait for their submap
    for submap in submaps:
        ids = associate_landmarks(graph, submap, config)     # -1 = new
        graph.add_submap(submap, landmark_ids=ids, covariance_scale=5.0)
        solver.update()
    graph.finish_sensors()
    for keep, drop in euclidean_merges(graph, 0.7):          # graphslam.association.merging
        graph.merge_landmarks(keep, drop)
    solver.solve_to_optimum()
    solution = solver.solution()
    print(solution.score["submap"].chi2_per_dof)             # χ²/dof of the join
    path = solution.trajectory()
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.markup import Markup, html_element, join_parts
from graphslam.core.records import Stream
from graphslam.core.se3 import quat_normalize
from graphslam.core.sensor_biases import SensorBiases
from graphslam.core.sketch import plan_sketch
from graphslam.core.submap import Match, Submap
from graphslam.graph.factor_graph_state import BetweenBlock, FactorGraphState
from graphslam.graph.factors.attitude import DOWN, LEVELLED, AttitudeRecord, without_tilt
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.function import USABLE, FunctionRecord, check_group
from graphslam.graph.factors.landmark_submap import CONSTANT, SubmapRecord
from graphslam.graph.factors.range import RangeRecord
from graphslam.graph.factors.sensor_biases import SIZE, SensorBiasRecord, bias_variable_names, sensor_biases_at
from graphslam.graph.factors.space_submap import SpaceSubmapRecord
from graphslam.graph.gtsam_values import value_of
from graphslam.graph.inner_nodes import cut_submap
from graphslam.graph.ledger import EXCLUSIVE, EvidenceUse
from graphslam.graph.noise import NO_KERNEL, RobustKernel, covariance_whiteners, whitener
from graphslam.graph.sensors import kind_of
from graphslam.graph.submap_node import InnerPoints, SubmapNode
from graphslam.graph.variables import split_name, variable_name

__all__ = ["FactorGraph", "SubmapNode"]


class FactorGraph(FactorGraphState):
    """A 2-D or 3-D graph of submaps, landmarks and sensors: the functions that add factors.

    The first base is fixed at the origin. Queries of the graph are in
    :class:`~graphslam.graph.factor_graph_state.FactorGraphState`.

    Parameters
    ----------
    dim : int
        2: poses ``(3,)``; 3: poses ``(7,)``.

    Examples
    --------
    >>> graph = gs.FactorGraph(dim=2)
    >>> for submap in gs.local_maps(log)[:2]:
    ...     added = graph.add_submap(submap)
    >>> len(graph.submaps)
    2
    """

    def __repr__(self) -> str:
        return f"FactorGraph({len(self.submaps)} submaps, {len(self.values.landmarks)} landmarks, dim={self.dim})"

    def _repr_html_(self) -> str:
        score, x, d = self.objective(), self.values.poses, self.dim
        summary = (
            f": χ² {score.total:.4g} at its values, for {score.dof} degrees of freedom; {len(x)} nodes, "
            f"{len(self.values.landmarks)} landmarks, {len(self.records)} factors"
        )
        betweens = [r for r in self.records.single.values() if isinstance(r, BetweenRecord)]
        links = [(r.i, r.j) for r in betweens if abs(r.i - r.j) > 1]
        links += [pair for b in self.records.blocks for pair in b.ends[b.kept & (np.ptp(b.ends, axis=1) > 1)].tolist()]
        ends = x[np.array(links, dtype=np.intp).reshape(-1, 2), :d]
        picture = plan_sketch([x[:, :d]], points=self.values.landmarks, links=ends)
        return join_parts([html_element("b", "FactorGraph"), summary, picture, Markup(score._repr_html_())])

    @classmethod
    def from_submaps(
        cls,
        submaps: Iterable[Submap],
        *,
        covariance_scale: float = 1.0,
    ) -> FactorGraph:
        """A graph of a chain of submaps, with landmarks or dense, and all their matches.

        Parameters
        ----------
        submaps : iterable of Submap
            Each starts at the end of the previous one. Landmarks are identified by the submaps' own ids, -1 = new.
        covariance_scale : float
            As for :meth:`add_submap`.
        """
        chain = list(submaps)
        if not chain:
            raise DataError("a graph of submaps needs submaps", got="none", wanted="one or more")
        keys = {dim: [s.key for s in chain if s.dim == dim] for dim in sorted({s.dim for s in chain})}
        if len(keys) > 1:
            names = " and ".join(f"{dim}-D submaps {_some(k)}" for dim, k in keys.items())
            raise GeometryError(
                "submaps of two dimensions do not fit in one graph", got=names, wanted="a graph of each"
            )
        graph = cls(chain[0].dim)
        for s in chain:
            graph.add_submap(s, covariance_scale=covariance_scale)
        for s in chain:
            for m in s.matches:
                graph.add_match(s.key, m)
        return graph

    def add_submap(
        self,
        submap: Submap,
        landmark_ids: npt.ArrayLike | None = None,
        *,
        covariance_scale: float = 1.0,
        spacing: float | None = None,
        level_sigma: float | None = None,
    ) -> int:
        """Append a submap: a new node, new landmarks, and one factor with the full joint covariance.

        Parameters
        ----------
        submap : Submap
            Starts at the end of the last one, or at the base set by :meth:`start_session`. Without landmarks it becomes
            a between-factor, or a chain of them.
        landmark_ids : (n,) int, optional
            Graph landmark of every entry, -1 = new; default: the submap's own ids. An id may be repeated.
        covariance_scale : float
            Factor on the covariance.
        spacing : float, optional
            Approximate distance between inner nodes along the path of a submap without landmarks [m], so that loops can
            deform it (:mod:`graphslam.graph.inner_nodes`); the chain composes to its end pose.
        level_sigma : float, optional
            3-D: σ of roll and pitch with which base and end of this submap were levelled independently [rad].
            *Relative* roll and pitch in the end pose would be a wrong model: errors of relative poses accumulate along
            a chain, levelling errors do not. So relative roll and pitch are removed from the last increment, and an
            attitude factor on the end node is used instead (and one on the first base). Gravity is not used twice,
            because it was removed from the end-pose covariance (ledger kind ``levelled``).

        Returns
        -------
        int
            Factor id: for a chain the first one, whose factors are removed together.

        Raises
        ------
        EvidenceReusedError
            Its streams were already used in an overlapping interval (the graph is unchanged then).
        CovarianceError, GeometryError, DataError
        """
        if submap.dim != self.dim:
            raise GeometryError(f"submap {submap.key} has the wrong dimension", got=submap.dim, wanted=self.dim)
        if submap.key in self._place:
            raise DataError(f"submap {submap.key} is already in the graph", wanted="each submap once")
        if spacing is not None and not (np.isfinite(spacing) and spacing > 0):
            raise ConfigError(f"inner nodes need a positive spacing, got {spacing}")
        if level_sigma is not None and not (self.dim == 3 and np.isfinite(level_sigma) and level_sigma > 0):
            raise ConfigError(f"levelled bases are in space and need a positive sigma, got {level_sigma}")
        if submap.landmarks is None:
            return self._add_dense(submap, covariance_scale, spacing, level_sigma)
        return self._add_landmarks(submap, landmark_ids, covariance_scale)

    def _add_landmarks(self, submap: Submap, landmark_ids: npt.ArrayLike | None, covariance_scale: float) -> int:
        lm = submap.landmarks
        assert lm is not None
        n = len(lm)
        ids = np.array(landmark_ids if landmark_ids is not None else lm.ids, dtype=np.int64)
        if ids.shape != (n,):
            raise GeometryError(f"landmark ids of submap {submap.key} do not fit", got=ids.shape, wanted=(n,))
        retired = [int(i) for i in ids if int(i) in self._retired]
        if np.any(ids < -1) or retired:
            raise DataError(
                f"landmark ids of submap {submap.key} are not usable",
                got=f"merged-away ids {retired}" if retired else int(ids.min()),
                wanted="-1 for new, or an id of the graph or a fresh one",
            )
        record: SubmapRecord | SpaceSubmapRecord
        if self.dim == 3:
            record = SpaceSubmapRecord.of_map(-1, submap.key, -1, ids, lm, covariance_scale)
            W = np.zeros(0)
        else:
            W = whitener(
                lm.dense_covariance(), what=f"covariance of submap {submap.key}", dim=3 + 2 * n, scale=covariance_scale
            )
        node, fid = self.structure.count("x") - 1, self._next_factor
        self.ledger.spend(fid, f"submap {submap.key}", submap.uses, submap.interval)
        self.ledger.spend(fid, f"submap {submap.key}", submap.assisting_streams, submap.interval, "aid")
        # from here on nothing can fail
        fresh = np.flatnonzero(ids < 0)
        top = max(self._next_landmark, int(ids.max(initial=-1)) + 1)
        ids[fresh] = top + np.arange(len(fresh))
        self._next_landmark = max(self._next_landmark, int(ids.max(initial=-1)) + 1)
        self.start_landmarks(ids, self.structure.group.transform(self.pose(node), lm.positions))
        robot, z = -1, lm.mean
        if lm.biases is not None:
            robot = self._robots.get(submap.uses, self.structure.count("wheels"))
            z, W = np.concatenate([z, np.zeros(len(lm.biases.sigmas))]), np.hstack([W, -W @ lm.biases.response])
        if self.dim == 3:
            record = replace(record, factor_id=fid, start=node, landmark_ids=ids)
        else:
            record = SubmapRecord(fid, submap.key, node, ids, z, W, chart=lm.chart, robot=robot)
        d, ends = self.structure.group.dof, np.stack([self.structure.group.identity, submap.exit_pose])
        stated = covariance_scale * submap.exit_covariance[None]
        self._append(submap, [record], np.array(submap.interval), ends, np.zeros((0, d, d)), stated)
        if lm.biases is not None:
            self._robots[submap.uses] = robot
            self._add_biases(lm.biases, robot, submap.uses, covariance_scale)
        if lm.path is not None:
            inner = InnerPoints(lm.path, lm.mean, lm.dense_covariance(), covariance_scale, biases=lm.biases)
            self.submaps[-1] = replace(self.submaps[-1], inner_points=inner)
        self._event("submap", factor_id=fid, submap=submap.key, landmarks=n, new=len(fresh), scale=covariance_scale)
        for sensor in self.sensors.values():
            sensor.add_factors(self.submaps[-1])
        return fid

    def _add_biases(self, biases: SensorBiases, robot: int, uses: frozenset[str], covariance_scale: float) -> None:
        """Add the information on constant errors from the last submap; it is removed together with the submap.

        All submaps of the same streams share these errors; the first one adds their prior.
        """
        s = self.submaps[-1]
        if robot == self.structure.count("wheels"):
            for word in CONSTANT:
                self.structure.append(word, np.zeros((1, 2)))
            fid = self.next_factor()
            self.ledger.spend(fid, "constant errors, beforehand", ["-"], s.interval, "prior")
            self.insert(SensorBiasRecord(fid, robot, np.diag(1.0 / biases.sigmas), np.zeros(SIZE)))
            self._event("biases", factor_id=fid, names=list(biases.names), sigmas=biases.sigmas.tolist())
        R, d = biases.likelihood()
        none = SIZE - len(d)
        R, d = np.vstack([R, np.zeros((none, SIZE))]), np.concatenate([d, np.zeros(none)])
        fid = self.next_factor()
        self.ledger.spend(fid, f"submap {s.key} of constant errors", uses, s.interval, "biases")
        root = np.sqrt(covariance_scale)
        self.insert(SensorBiasRecord(fid, robot, R / root, d / root, what=f"by submap {s.key}"))
        self.submaps[-1] = replace(s, factor_ids=(*s.factor_ids, fid), biases=biases, robot=robot)

    def as_known(self, submap: Submap) -> Submap:
        """A submap corrected with the graph's estimate of its robot's constant errors, for gates and checks."""
        if submap.landmarks is None or submap.landmarks.biases is None:
            return submap
        robot = self._robots.get(submap.uses)
        before = np.zeros(SIZE), np.diag(submap.landmarks.biases.sigmas**2)
        known = before if robot is None else self.sensor_biases(robot)
        return replace(submap, landmarks=submap.landmarks.with_biases(*known))

    def sensor_biases(self, robot: int = 0) -> tuple[Array, Array]:
        """Constant errors of a robot's wheels and sensor ``(4,)`` at the graph's values, and their covariance.

        In the order of :data:`~graphslam.core.sensor_biases.CONSTANTS`; includes their prior.
        """
        if not 0 <= robot < self.values.count("wheels"):
            raise DataError(
                f"the graph has no constant errors of robot {robot}", wanted="submaps with systematic errors"
            )
        return sensor_biases_at(self.values, robot), self.covariance().joint(bias_variable_names(robot))

    def _add_dense(
        self, submap: Submap, covariance_scale: float, spacing: float | None, level_sigma: float | None
    ) -> int:
        cut = cut_submap(submap, spacing)
        stated = covariance_scale * cut.covariances
        if level_sigma is not None:
            cut.covariances[-1] = without_tilt(cut.covariances[-1])  # the inner nodes keep their own attitude
        d, node, fid = self.structure.group.dof, self.structure.count("x") - 1, self._next_factor
        records = [
            BetweenRecord(
                fid + k,
                node + k,
                node + k + 1,
                T,
                whitener(P, what=f"covariance of submap {submap.key}", dim=d, scale=covariance_scale),
                group="dense-submap",
            )
            for k, (T, P) in enumerate(zip(cut.increments, cut.covariances))
        ]
        self.ledger.spend(fid, f"submap {submap.key}", submap.uses, submap.interval)
        self.ledger.spend(fid, f"submap {submap.key}", submap.assisting_streams, submap.interval, "aid")
        # from here on nothing can fail
        self._append(submap, records, cut.times, cut.T_base_node, covariance_scale * cut.covariances, stated)
        if level_sigma is not None:
            self._level_ends(level_sigma)
        self._event(
            "submap", factor_id=fid, submap=submap.key, landmarks=0, new=0, scale=covariance_scale, nodes=len(records)
        )
        for sensor in self.sensors.values():
            sensor.add_factors(self.submaps[-1])
        return fid

    def _level_ends(self, sigma: float) -> None:
        """Attitude factor on the end node of the last submap, and on its base if that has none."""
        s = self.submaps[-1]
        if not self._attitude_of.get(s.node):
            self._level(s.node, sigma, s.interval[0])
        fid = self._level(s.exit_node, sigma, s.interval[1])
        self.submaps[-1] = replace(s, factor_ids=(*s.factor_ids, fid))  # removed together with its submap

    def _level(self, node: int, sigma: float, time: float) -> int:
        """Attitude factor of a levelled base: declared in the ledger, see :meth:`FactorGraph.add_submap`."""
        used = EvidenceUse(["gravity"], (time, time), LEVELLED)
        return self.add_attitude(node, DOWN, sigma, evidence=used, group=LEVELLED)

    def _append(
        self, submap: Submap, records: Sequence[FactorRecord], times: Array, T_base_node: Array, *covariances: Array
    ) -> None:
        """Add new nodes after the last one, the submap's entry, and its factors."""
        node, group = self.structure.count("x") - 1, self.structure.group
        base = self.pose(node)
        new = group.compose(np.broadcast_to(base, T_base_node[1:].shape), T_base_node[1:])
        self.structure.append("x", new)
        ids = tuple(r.factor_id for r in records)
        nodes = tuple(range(node, node + len(T_base_node)))
        self._place[submap.key] = len(self.submaps)
        self.submaps.append(
            SubmapNode(
                submap.key, node, submap.interval, submap.trajectory, ids[0], nodes, times, T_base_node, ids,
                *covariances,  # type: ignore[arg-type]
            )
        )  # fmt: skip
        for record in records:
            self.insert(record)

    def add_sensor(self, readings: Stream, *, stream: str | None = None, config: Any = None) -> list[int]:
        """Add readings of a sensor that no front end used; each is assigned to its submap.

        Parameters
        ----------
        readings : Stream
            Of a kind in :func:`graphslam.graph.sensors.sensor_kinds`: :class:`~graphslam.core.records.Gps` fixes, an
            :class:`~graphslam.core.imu.Imu`, ... The class of the kind makes factors of them.
        stream : str, optional
            Name in the ledger; default: that of the kind.
        config : optional
            Options of the kind.

        Returns
        -------
        list of int
            Ids of the factors; those of waiting readings are reserved.

        Raises
        ------
        EvidenceReusedError
            A submap or another factor used them already. The graph is unchanged then.
        DataError, GeometryError, ConfigError
        """
        return kind_of(readings).of(self).add(readings, stream=stream, config=config)

    def finish_sensors(self) -> None:
        """No more submaps follow: drop and count readings that still wait for a submap."""
        for sensor in self.sensors.values():
            sensor.finish()

    def add_attitude(
        self,
        node: int,
        direction: ArrayLike,
        sigma: float,
        *,
        evidence: EvidenceUse | str = EXCLUSIVE,
        robust: RobustKernel = NO_KERNEL,
        group: str = "attitude",
    ) -> int:
        """Direction of gravity in the frame of a node: constrains roll and pitch, not heading.

        The first call adds the variable ``tilt``, the up direction in the frame of the first base
        (:mod:`graphslam.graph.factors.attitude`); gravity measured at the first base is added to node 0.

        Parameters
        ----------
        node : int
        direction : (3,)
            Of gravity (down) in the node's frame; any non-zero length. ``(0, 0, -1)`` if the node is level.
        sigma : float
            Standard deviation of roll and of pitch [rad].
        evidence : EvidenceUse or str
            Streams and interval used, or a kind declared in the ledger.
        robust : RobustKernel
        group : str
            Class of the factor in :meth:`objective`.

        Returns
        -------
        int
            Factor id.

        Raises
        ------
        GeometryError
            A planar graph, or a direction of zero length.
        ConfigError, DataError, EvidenceReusedError
        """
        if self.dim != 3:
            raise GeometryError("gravity says nothing of poses in the plane", wanted="a graph in space")
        if not 0 <= node < self.structure.count("x"):
            raise DataError(
                "attitude of a node that is not there", got=node, wanted=f"x0 … x{self.structure.count('x') - 1}"
            )
        d = np.asarray(direction, dtype=np.float64)
        length = float(np.linalg.norm(d)) if d.shape == (3,) else float("nan")
        if not (np.isfinite(length) and length > 0):
            raise GeometryError(f"direction of gravity at x{node} is not usable", got=direction, wanted="three numbers")
        if not (np.isfinite(sigma) and sigma > 0):
            raise ConfigError(f"attitude of x{node} needs a positive sigma, got {sigma}")
        record = AttitudeRecord(self.next_factor(), node, d / length, np.eye(2) / sigma, robust, group)
        kind = self.ledger.enter(record.factor_id, record.label(), evidence)
        self.start_tilt()
        self.insert(record)
        self._event("attitude", factor_id=record.factor_id, node=node, sigma=sigma, evidence=kind, group=group)
        return record.factor_id

    def add_range(
        self,
        i: int,
        j: int,
        distance: float,
        sigma: float,
        *,
        arm_i: ArrayLike | None = None,
        arm_j: ArrayLike | None = None,
        evidence: EvidenceUse | str = EXCLUSIVE,
    ) -> int:
        """A distance [m] with its σ between antennas at nodes i and j, at the lever arms ``(dim,)`` [m] on the bodies.

        ``evidence`` as in :meth:`add_between`.
        """
        last = self.structure.count("x") - 1
        if i == j or not (0 <= i <= last and 0 <= j <= last):
            raise DataError("a distance joins nodes that are not there", got=(i, j), wanted=f"two of x0 … x{last}")
        if not (np.isfinite(distance) and distance >= 0 and np.isfinite(sigma) and sigma > 0):
            raise DataError(f"distance x{i} – x{j} is not usable", got=(distance, sigma), wanted="≥ 0 m, sigma > 0 m")
        arms = [np.zeros(self.dim) if a is None else np.asarray(a, dtype=np.float64) for a in (arm_i, arm_j)]
        record = RangeRecord(self.next_factor(), i, j, arms[0], arms[1], float(distance), float(sigma))
        kind = self.ledger.enter(record.factor_id, record.label(), evidence)
        self.insert(record)
        self._event("range", factor_id=record.factor_id, i=i, j=j, evidence=kind)
        return record.factor_id

    def add_factor(
        self,
        variables: Sequence[str | int],
        residual: Callable[..., ArrayLike],
        covariance: ArrayLike,
        *,
        evidence: EvidenceUse | str,
        jacobian: Callable[..., ArrayLike] | None = None,
        robust: RobustKernel = NO_KERNEL,
        group: str = "user",
    ) -> int:
        """A factor of your own: a residual as a function of the values of some variables.

        Every solver and every map-joining method uses it. A method that works in frames of submaps adds it in the
        frame of the first base if its residual depends on the frame. It is in memory only: files of a graph refuse it.

        Parameters
        ----------
        variables : sequence of str or int
            Poses, landmarks, datum or tilt, each once: ``"x3"`` or 3, ``"l17"``, ``"datum"``, ``"tilt"``.
        residual : callable
            Gets their values in that order (poses ``T_world_node`` ``(3,)`` or ``(7,)``, landmarks ``(dim,)``) and
            returns predicted minus measured ``(d,)``; angles wrapped to [-π, π].
        covariance : (d, d)
            Of the measurement, in the units of the residual.
        evidence : EvidenceUse or str
            Streams and interval of the measurement; the ledger refuses to use them twice. Or a declared kind, as
            ``"prior"``.
        jacobian : callable, optional
            Gets the same values, returns ``(d, Σ dof)`` by right tangents of poses. Default: central differences, which
            call the residual twice for each degree of freedom.
        robust : RobustKernel
        group : str
            Class of the factor in :meth:`objective`.

        Returns
        -------
        int
            Factor id.

        Raises
        ------
        ConfigError, DataError, SolverError, CovarianceError, EvidenceReusedError
            The graph is unchanged then.

        Examples
        --------
        A tape measure between the bases of two submaps, 18.0 m ± 5 cm:

        >>> graph = gs.FactorGraph.from_submaps(gs.local_maps(log)[:3])
        >>> tape = lambda a, b: [np.linalg.norm(a[:2] - b[:2]) - 18.0]
        >>> added = graph.add_factor([0, 1], tape, [[0.05**2]], evidence=gs.EvidenceUse(["tape"], (0.0, 0.0)))
        >>> gs.solve_graph(graph).score["user"].factors
        1
        """
        names = tuple(variable_name(v) for v in variables)
        known = {"x0", *self.structure.layout().names()}
        bad = [n for n in names if n not in known or split_name(n)[0].word not in USABLE]
        if bad or len(set(names)) < len(names) or not set(names) - {"x0"}:
            wanted = f"names of {', '.join(USABLE)} that are in the graph, each once, and not x0 alone"
            raise DataError("a factor cannot use these variables", got=bad or names, wanted=wanted)
        check_group(group)
        P = np.atleast_2d(np.asarray(covariance, dtype=np.float64))
        W = whitener(P, what=f"covariance of the {group} factor")
        record = FunctionRecord(self._next_factor, names, residual, jacobian, W, robust, group)
        r, J = record.linearised([value_of(self.values, n, self._row) for n in names], self.dim)
        if not (np.all(np.isfinite(r)) and np.all(np.isfinite(J))):
            raise DataError(f"{record.label()} is not finite at the values of the graph", got=r, wanted="numbers")
        kind = self.ledger.enter(record.factor_id, record.label(), evidence)
        self.insert(record)
        self._event("factor", factor_id=record.factor_id, variables=list(names), evidence=kind, group=group)
        return record.factor_id

    def start_session(self, T_world_base: ArrayLike) -> int:
        """Start another chain of submaps with a free first base: another robot, or another day.

        Only landmarks observed in both chains connect it to the graph, so it needs at least two of them, or a
        between-factor.

        Parameters
        ----------
        T_world_base : (3,) or (7,)
            Initial value of the first base.

        Returns
        -------
        int
            Node of the new first base; the next submap starts there.
        """
        T = self._pose(T_world_base, "start of a session")
        if not self.submaps:
            raise DataError("the first session needs no start", wanted="submaps before another session begins")
        node = self.structure.append("x", T)
        self.revision += 1
        self._event("session", node=node, T_world_base=T.tolist())
        return node

    def add_between(
        self,
        i: int,
        j: int,
        T_ij: ArrayLike,
        covariance: ArrayLike,
        *,
        evidence: EvidenceUse | str = EXCLUSIVE,
        robust: RobustKernel = NO_KERNEL,
        group: str = "between",
    ) -> int:
        """Relative pose ``T_ij`` ``(3,)`` or ``(7,)``, node j in frame i, with right-tangent ``covariance`` ``(d, d)``.

        Parameters
        ----------
        evidence : EvidenceUse or str
            Streams and interval used, or a kind declared in the ledger (``"shared-scan"``).
        robust : RobustKernel
        group : str
            Class of the factor in :meth:`objective`.
        """
        last = self.structure.count("x") - 1
        if i == j or not (0 <= i <= last and 0 <= j <= last):
            raise DataError("between-factor joins nodes that are not there", got=(i, j), wanted=f"two of x0 … x{last}")
        T = self._pose(T_ij, f"relative pose x{i} → x{j}")
        W = whitener(covariance, what=f"covariance of x{i} → x{j}", dim=self.structure.group.dof)
        record = BetweenRecord(self._next_factor, i, j, T, W, robust, group)
        kind = self.ledger.enter(record.factor_id, record.label(), evidence)
        self.insert(record)
        self._event("between", factor_id=record.factor_id, i=i, j=j, evidence=kind, group=group)
        return record.factor_id

    def add_betweens(
        self,
        ends: npt.ArrayLike,
        T_ij: ArrayLike,
        covariance: ArrayLike,
        *,
        poses: ArrayLike | None = None,
        evidence: EvidenceUse | str = EXCLUSIVE,
        group: str = "between",
    ) -> range:
        """Many relative poses in one call, stored as arrays: a million of them in seconds.

        Parameters
        ----------
        ends : (m, 2) int
            Nodes i and j.
        T_ij : (m, 3|7)
        covariance : (m, d, d) or (d, d)
            In the right tangent; one per factor, or one for all.
        poses : (k, 3|7), optional
            ``T_world_node`` of new nodes, numbered after the existing ones.
        evidence, group
            For all of them together (:meth:`add_between`).

        Returns
        -------
        range
            Factor ids.

        Raises
        ------
        DataError, GeometryError, CovarianceError, ConfigError, EvidenceReusedError
            The graph is unchanged then.
        """
        e = np.asarray(ends, dtype=np.int64).reshape(-1, 2)
        T = self._poses(T_ij, "relative pose")
        new = self._poses(np.zeros((0, self.structure.group.size)) if poses is None else poses, "pose of a new node")
        last = self.structure.count("x") + len(new) - 1
        bad = np.flatnonzero((e < 0).any(axis=1) | (e > last).any(axis=1) | (e[:, 0] == e[:, 1]))
        if len(bad):
            raise DataError(
                f"between-factor {bad[0]} joins nodes that are not there",
                got=tuple(e[bad[0]].tolist()),
                wanted=f"two of x0 … x{last}",
            )
        if len(T) != len(e):
            raise DataError("relative poses do not fit their ends", got=len(T), wanted=len(e))
        W = covariance_whiteners(covariance, len(e), self.structure.group.dof, what="between-factor")
        first, label = self._next_factor, f"{len(e)} × {group}"
        kind = self.ledger.enter(first, label, evidence)
        # from here on nothing can fail
        self.structure.append("x", new)
        self.records.add_block(BetweenBlock(first, e.copy(), T, W, group, np.ones(len(e), dtype=np.bool_)))
        self._next_factor += len(e)
        self.revision += 1
        self._event("betweens", factor_id=first, count=len(e), nodes=len(new), evidence=kind, group=group)
        return range(first, first + len(e))

    def _poses(self, T: ArrayLike, what: str) -> Array:
        """Poses ``(m, 3|7)`` of the graph's dimension, with unit quaternions."""
        rows, group = np.array(T, dtype=np.float64), self.structure.group
        bad = [0] if rows.ndim != 2 or rows.shape[1] != group.size else np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            raise GeometryError(f"{what} {bad[0]} is not usable", got=rows.shape, wanted=f"finite (m, {group.size})")
        if group.dim == 3:
            rows[:, 3:] = quat_normalize(rows[:, 3:])
        return rows

    def add_match(self, submap_key: int, match: Match, *, robust: RobustKernel = NO_KERNEL) -> int:
        """A front end's re-entry into an earlier submap, as declared ``shared-scan`` evidence.

        The matched scan overlaps the map that was built along the nearest part of the target's path. So if the target
        has inner nodes, the match is attached to the nearest one, with the fixed pose of that node in the target; the
        covariance of the path between the node and its nearest pose is added.

        Parameters
        ----------
        submap_key : int
            Submap whose base was matched.
        match : Match
        robust : RobustKernel
        """
        here, target = self.node_of(submap_key), self.submap(match.target)
        node, T, P = self._into(target, self._pose(match.T_target_here, "match"), np.asarray(match.covariance))
        used = EvidenceUse(["match"], self.submap(submap_key).interval, "shared-scan")
        fid = self.add_between(node, here, T, P, evidence=used, robust=robust, group="match")
        self.events[-1] |= {
            "submap": submap_key,
            "target": match.target,
            "fitness": match.fitness,
            "support": match.support,
        }
        return fid

    def _into(self, s: SubmapNode, T_base_here: Array, P: Array) -> tuple[int, Array, Array]:
        """Re-express a pose in a submap's base frame in its nearest node: (node, pose, covariance)."""
        path, group = s.trajectory, self.structure.group
        if not s.inner or path is None:
            return s.node, T_base_here, P
        dim = self.dim
        row = int(np.argmin(np.sum((path.positions - T_base_here[:dim]) ** 2, axis=1)))
        inside = np.clip(path.times[row : row + 1], *s.interval)
        inside = np.clip(inside, path.times[0], path.times[-1])
        at = s.nearest(inside)
        k = int(at[0])
        T = group.between(s.T_base_node[k], T_base_here)
        T_node_body, E = s.local(inside, at)
        if E is None or k == 0:  # the base itself: the match is already relative to it
            return s.nodes[k], T, P
        A = group.adjoint(group.between(T, T_node_body[0]))  # maps an error of the body to the end of the match
        extra = A @ E[0] @ A.T
        return s.nodes[k], T, P + 0.5 * (extra + extra.T)

    def _pose(self, T: ArrayLike, what: str) -> Array:
        """A pose of the graph's dimension, with a unit quaternion."""
        pose, group = np.asarray(T, dtype=np.float64), self.structure.group
        if pose.shape != (group.size,) or not np.all(np.isfinite(pose)):
            wanted = {3: "three", 7: "seven"}[group.size]
            raise GeometryError(f"{what} is not usable", got=T, wanted=f"{wanted} finite numbers")
        if group.dim == 3:
            pose = np.concatenate([pose[:3], quat_normalize(pose[3:])])
        return pose


def _some(keys: Sequence[int]) -> str:
    """A few of the keys, and their number."""
    return ", ".join(map(str, keys)) if len(keys) <= 4 else f"{keys[0]}, {keys[1]} … {keys[-1]} ({len(keys)})"
