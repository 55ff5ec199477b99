"""IMU factors of a graph: preintegrated measurements between near nodes, gravity at far ones (3-D), and biases.

The states of an IMU (velocity and bias of each node, order of the biases) are stored only in the factors, so nothing
else must be updated when factors are removed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from graphslam.core.errors import DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.se3 import matrix_to_quat, quat_multiply, quat_to_matrix, se3_adjoint, se3_compose, so3_log
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.attitude import LEVELLED, AttitudeRecord, up_turn, without_tilt
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.imu.axes import check_imu_axes
from graphslam.graph.factors.imu.batch import (
    GYRO_ROWS,
    PLANE_GYRO_ROWS,
    PLANE_ROWS,
    XI,
    XJ,
    PreintegrationArrays,
    preintegration_terms,
)
from graphslam.graph.factors.imu.config import BodyPlace, ImuConfig, body_path, places_on_nodes
from graphslam.graph.factors.imu.plan import FEWEST, ImuFactorPlan, force_window, join_readings, plan_factors
from graphslam.graph.factors.imu.plane import IN_PLANE, lift, planar_imu, with_gravity
from graphslam.graph.factors.imu.preintegration import Preintegrated, bias_sigma, mean_force, preintegrate
from graphslam.graph.factors.imu.records import ForceRecord, GyroRecord, ImuBiasRecord, ImuRecord
from graphslam.graph.factors.imu.states import ImuStates, renumber_states, required_bias_links
from graphslam.graph.noise import whitener
from graphslam.graph.sensors.base import SensorFactors
from graphslam.graph.submap_node import SubmapNode

logger = logging.getLogger(__name__)

RECENTRE = 2e-3
"""Preintegrate again if the bias change times the duration exceeds this angle [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuUse:
    """An IMU in a graph: its readings so far, and its configuration.

    Parameters
    ----------
    imu : Imu
        As used by factors; in 2-D in the axes of the body.
    given : Imu
        Unchanged input.
    """

    imu: Imu
    config: ImuConfig
    given: Imu


class ImuFactors(SensorFactors):
    """The IMUs of a graph: preintegrated measurements, gravity, biases.

    In 2-D the IMU is planar, or it has three axes and the body is level
    (:mod:`graphslam.graph.factors.imu.plane`). No initial velocity is needed: it follows from the two poses and the
    accelerations of a preintegrated measurement.

    Consecutive nodes of a submap within :attr:`ImuConfig.longest` seconds, inner nodes included, are connected by a
    combined preintegrated measurement (:mod:`graphslam.graph.factors.imu.batch`); inside levelled submaps only the gyro
    then determines their relative roll and pitch. Each such factor adds the velocity of the unit and its biases at both
    nodes; a bias has the prior of ``ImuNoise``, and continues as a random walk over gaps. In 3-D a node without such a
    factor gets a gravity factor: the mean specific force around it, with a σ that depends on the motion. The first
    factor adds the ``tilt`` (:mod:`graphslam.graph.factors.attitude`).
    """

    name: ClassVar[str] = "imu"
    title: ClassVar[str] = "IMU"
    readings = Imu
    options = ImuConfig
    graph: FactorGraphState

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.used: dict[str, ImuUse] = {}
        plane = graph.dim == 2
        self._bias = IN_PLANE["imubias"] if plane else list(range(6))  # components of a 3-D bias that the graph has
        self._rows = PLANE_ROWS if plane else np.arange(15)
        self._gyro_rows = PLANE_ROWS[PLANE_GYRO_ROWS] if plane else GYRO_ROWS

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None, more: bool = False) -> list[int]:
        """Add an IMU that no front end used; its readings between existing nodes become factors.

        It may be called again after more submaps, with the following readings (or with none); existing factors are
        kept. Every omitted reading is counted by reason (event ``imu``).

        Parameters
        ----------
        readings : Imu
            ``T_base_imu`` is its mounting on the body; the body moves along the paths of the submaps.
        stream : str
            Name in the ledger.
        config : ImuConfig, optional
            Default: that of the previous call.
        more : bool
            It will be called again with more submaps: the last node waits for the submap that starts there, axes are
            not checked, and dropped readings are not counted.

        Returns
        -------
        list of int
            Ids of the new factors.
        """
        imu, stream = readings, stream or self.name
        known = self.used.get(stream)
        cfg = config or (ImuConfig() if known is None else known.config)
        given = imu if known is None else join_readings(known.given, imu, stream)
        if known is not None and given is known.given:
            imu = known.imu
        elif self.graph.dim == 2:
            imu = planar_imu(given, stream)
        elif given.planar and len(given.times):
            raise GeometryError(
                "a planar IMU does not say how a body moves in space", where=stream,
                got="no angular rate about x or y and no force along z", wanted="three axes, gravity among the forces",
            )  # fmt: skip
        else:
            imu = given
        if len(imu.times) < 2:
            raise DataError("an IMU needs readings", where=stream, got=len(imu.times), wanted="two or more")
        bias_sigma(imu.noise)
        places = places_on_nodes(self.graph.submaps, cfg.window)
        waiting = self.graph.submaps[-1].exit_node if more and self.graph.submaps else None
        if waiting is not None:
            places.pop(waiting, None)
        plan = plan_factors(
            self.graph.submaps, self.graph.records.values(), imu, stream, cfg, places, waiting, dim=self.graph.dim
        )
        for a, b in plan.pairs:
            self.graph.ledger.check(f"{stream} x{a} → x{b}", [stream], (places[a].time, places[b].time))
        for n in plan.gravity:
            self.graph.ledger.check(f"gravity seen by {stream} at x{n}", [stream], force_window(places[n].time, cfg))
        if not more:
            self.check(given, stream=stream, axes=cfg.axes)
        self.used[stream] = ImuUse(imu, cfg, given)
        ids = self._add_preintegrated(imu, stream, cfg, places, plan.pairs)
        ids += self._add_forces(imu, stream, cfg, places, plan)
        ids += self._relink(stream)
        if not more:
            mine = [r for r in self.graph.records.values() if getattr(r, "stream", None) == stream]
            self.graph.log_event(
                "imu", stream=stream, factors=len(mine), preintegrated=sum(isinstance(r, ImuRecord) for r in mine),
                gravity=sum(isinstance(r, ForceRecord) for r in mine), dropped=dict(plan.dropped),
            )  # fmt: skip
        return ids

    def check(self, imu: Imu, *, stream: str = "imu", axes: str = "refuse") -> str:
        """Compare the axes of an IMU with the paths of the submaps; returns a description of errors, or an empty text.

        If paths and readings overlap too little, the axes are not checked (event ``imu-axes``).
        """
        if axes == "ignore":
            return ""
        try:
            found = check_imu_axes(with_gravity(imu), body_path(self.graph.submaps, self.graph.values))
        except DataError as error:
            self.graph.log_event("imu-axes", stream=stream, verdict="not checked", why=str(error))
            return ""
        words = found.words()
        verdict = "wrong" if found.wrong else "as stated" if found.turns is None else "unlike"
        self.graph.log_event(
            "imu-axes", stream=stream, verdict=verdict, words=words, excess=found.excess, alike=found.alike,
            windows=found.windows, turns=found.turns,
        )  # fmt: skip
        if axes == "refuse":
            found.raise_if_wrong(stream)
        elif found.wrong:
            logger.warning("%s: the axes are not those that its mounting says: %s", stream, words)
        return words

    def recentre(self, *, limit: float = RECENTRE) -> int:
        """Preintegrate again, about the current bias, if a gyro bias has changed; returns the number of factors.

        Preintegrated measurements depend on the biases to first order only. After solving, call this and solve again
        until it returns zero; two iterations are usually enough.
        """
        changed = 0
        for stream, use in self.used.items():
            old = [r for r in self.graph.records.values() if isinstance(r, ImuRecord) and r.stream == stream]
            rows = [r.biases[0] for r in old]
            now = lift("imubias", self.graph.values.imu_biases[rows])
            about = np.array([r.bias for r in old]).reshape(-1, 6)
            turned = np.linalg.norm((now - about)[:, :3], axis=1) * np.array([r.seconds for r in old])
            some = np.flatnonzero(turned > limit)
            if len(some):
                begin, end = np.array([old[k].interval for k in some]).T
                self._weigh([old[k] for k in some], preintegrate(use.imu, begin, end, now[some]))
                changed += len(some)
        return changed

    def states(self, stream: str = "imu") -> ImuStates:
        """Nodes, velocities and biases of an IMU, in order of time."""
        return ImuStates.of(self.graph.records.values(), stream)

    def remove(self, submap: SubmapNode) -> None:
        """Remove the IMU factors inside a submap that is removed."""
        inside = set(submap.nodes)
        for fid, r in list(self.graph.records.items()):
            interval = isinstance(r, ImuRecord) and r.i in inside and r.j in inside
            if interval or (isinstance(r, ForceRecord) and r.node in inside):
                self.graph.take_out(fid, "its submap was removed")

    def remove_unused(self, removed: FactorRecord) -> None:
        """Clean up after a factor was removed: a bias without a preintegrated measurement from the previous one is
        linked to it as a random walk; velocities and biases without factors are removed."""
        if not self.used:
            return
        intervals = {(r.i, r.j) for r in self.graph.records.values() if isinstance(r, ImuRecord)}
        if isinstance(removed, ImuRecord) and (removed.i, removed.j) not in intervals:
            self._level_inside([(removed.i, removed.j)], give_up=False)
        for stream in self.used:
            self._relink(stream)
        self._compact()

    # ---------------------------------------------------------------- inside

    def _add_preintegrated(
        self, imu: Imu, stream: str, cfg: ImuConfig, places: dict[int, BodyPlace], pairs: Sequence[tuple[int, int]]
    ) -> list[int]:
        if not pairs:
            return []
        plane = self.graph.dim == 2
        if cfg.accelerometer and not plane:
            self.graph.start_tilt()
        begin, end = (np.array([places[pair[k]].time for pair in pairs]) for k in (0, 1))
        unit = {n: places[n].unit(imu.T_base_imu) for pair in pairs for n in pair}
        states = self.states(stream)
        start = self._start_bias(states, preintegrate(imu, begin, end), pairs, unit)
        pim = preintegrate(imu, begin, end, start)
        velocities, biases = dict(states.velocity), dict(states.bias)
        kind = ImuRecord if cfg.accelerometer else GyroRecord
        new_v, made = len(self.graph.values.velocities), []
        for k, (a, b) in enumerate(pairs):
            for n in (a, b):
                if n not in biases:
                    biases[n] = self.graph.values.append("imubias", start[self._bias])
                if cfg.accelerometer and n not in velocities:
                    velocities[n] = self.graph.values.append("velocity", np.full(self.graph.dim, np.nan))
            va, vb = velocities.get(a, -1), velocities.get(b, -1)
            local = np.stack([unit[a][1], unit[b][1]])
            made.append(
                kind(
                    self.graph.next_factor(), stream, a, b, (begin[k], end[k]), (va, vb), (biases[a], biases[b]),
                    unit[a][0], unit[b][0], pim.R[k], pim.p[k], pim.v[k], pim.J[k], pim.bias[k],
                    np.eye(len(self._rows if cfg.accelerometer else self._gyro_rows)), local, cfg.robust, planar=plane,
                )
            )  # fmt: skip
        self._start_velocities(made, new_v)
        self._weigh(made, pim)
        for r in made:
            self.graph.ledger.spend(r.factor_id, r.label(), [stream], r.interval)
        self._level_inside(pairs, give_up=True)
        return [r.factor_id for r in made]

    def _level_inside(self, pairs: Sequence[tuple[int, int]], *, give_up: bool) -> None:
        """Remove relative roll and pitch from increments inside levelled submaps with an IMU factor, or restore them.

        The path of a levelled submap gets roll and pitch from gravity at every instant, so their errors do not
        grow, and its marginals do not contain the correlation between nodes. Increments between inner nodes then have
        far too small rotation errors (:mod:`graphslam.graph.inner_nodes`), which contradict a gyro.
        """
        levelled = {f for f, r in self.graph.records.items() if isinstance(r, AttitudeRecord) and r.group == LEVELLED}
        chosen = set(pairs)
        for k, s in enumerate(self.graph.submaps):
            if not levelled.intersection(s.factor_ids) or len(s.nodes) < 3:
                continue
            covariances = s.covariances.copy()
            for m, (pair, fid) in enumerate(zip(zip(s.nodes, s.nodes[1:]), s.factor_ids)):
                old = self.graph.records.get(fid)
                if pair not in chosen or m == len(covariances) - 1 or not isinstance(old, BetweenRecord):
                    continue  # the last one has none already
                covariances[m] = without_tilt(s.stated[m]) if give_up else s.stated[m]
                W = whitener(covariances[m], what=f"covariance of {old.label()}", dim=6)
                self.graph.insert(replace(old, whitener=W))
            self.graph.submaps[k] = replace(s, covariances=covariances)

    def _start_bias(
        self,
        states: ImuStates,
        pim: Preintegrated,
        pairs: Sequence[tuple[int, int]],
        unit: dict[int, tuple[Array, Array]],
    ) -> Array:
        """Initial bias: the last one, or the median difference between the turn rates of gyro and nodes."""
        if states.bias:
            last = states.bias[states.order[-1]]
            return lift("imubias", self.graph.values.imu_biases[last : last + 1])[0].copy()
        i, j = np.array(pairs).T
        q = [
            quat_multiply(lift("x", self.graph.values.poses[n])[:, 3:], np.array([unit[k][0][3:] for k in n.tolist()]))
            for n in (i, j)
        ]
        turn = quat_multiply(q[0] * [-1.0, -1.0, -1.0, 1.0], q[1])
        excess = np.swapaxes(quat_to_matrix(turn), 1, 2) @ pim.R
        w = so3_log(matrix_to_quat(excess)) / pim.seconds[:, None]
        weight = pim.seconds >= np.median(pim.seconds)
        return np.concatenate([np.median(w[weight], axis=0), np.zeros(3)])

    def _start_velocities(self, records: Sequence[ImuRecord], first: int) -> None:
        """Initialise velocities from row ``first`` on, from the preintegrated measurements (eq. 33 solved for them)."""
        v = self.graph.values.velocities
        if len(v) == first:
            return
        tilt = self.graph.values.tilt
        up = np.zeros(3) if tilt is None else GRAVITY * up_turn(tilt)[0][:, 2]  # 2-D forces do not include gravity
        for r in records:
            a, b = r.velocities
            X = se3_compose(lift("x", self.graph.values.poses[[r.i, r.j]]), np.stack([r.T_i_imu, r.T_j_imu]))
            T, R = r.seconds, quat_to_matrix(X[0, 3:])
            at_i = (X[1, :3] - X[0, :3] + 0.5 * up * T**2 - R @ r.p) / T
            if a >= first and not np.isfinite(v[a, 0]):
                v[a] = at_i[: self.graph.dim]
            if b >= first:
                v[b] = (at_i - up * T + R @ r.v)[: self.graph.dim]  # may be overwritten by the next factor's start

    def _weigh(self, records: Sequence[ImuRecord], pim: Preintegrated) -> None:
        """Insert preintegrated factors, with the covariance of the unit's pose relative to the nodes."""
        tilt = np.zeros(2) if self.graph.values.tilt is None else self.graph.values.tilt  # not used by gyro factors
        v = np.vstack(
            [lift("velocity", self.graph.values.velocities), np.zeros(3)]
        )  # row -1: of factors with the gyro only
        b, x = lift("imubias", self.graph.values.imu_biases), lift("x", self.graph.values.poses)
        fresh = [replace(r, R=R, p=p, v=w, J=J, bias=c) for r, R, p, w, J, c in zip(
            records, pim.R, pim.p, pim.v, pim.J, pim.bias)]  # fmt: skip
        i, j = (np.array([getattr(r, n) for r in fresh]) for n in "ij")
        vs, bs = np.array([r.velocities for r in fresh]), np.array([r.biases for r in fresh])
        arrays = PreintegrationArrays(fresh)
        J = preintegration_terms(
            arrays, x[i], v[vs[:, 0]], b[bs[:, 0]], x[j], v[vs[:, 1]], b[bs[:, 1]], tilt
        )[1]  # fmt: skip
        local = np.array([r.local for r in fresh])
        P = pim.covariance.copy()
        for side, (columns, L) in enumerate(((XI, arrays.L_i), (XJ, arrays.L_j))):
            U = J[:, :, columns] @ se3_adjoint(L)  # by the unit's own right tangent
            P += U @ local[:, side] @ np.swapaxes(U, 1, 2)
        for r, Pk in zip(fresh, P):
            rows = self._gyro_rows if isinstance(r, GyroRecord) else self._rows
            Pk = Pk[np.ix_(rows, rows)]
            W = whitener(Pk, what=f"covariance of {r.label()}", dim=len(Pk))
            self.graph.insert(replace(r, whitener=W))

    def _add_forces(
        self, imu: Imu, stream: str, cfg: ImuConfig, places: dict[int, BodyPlace], plan: ImuFactorPlan
    ) -> list[int]:
        if not plan.gravity:
            return []
        self.graph.start_tilt()
        at = np.array([places[n].time for n in plan.gravity])
        force, count, quiet = mean_force(imu, at, 0.5 * cfg.window)
        states, ids = self.states(stream), []
        known = states.bias
        for k, n in enumerate(plan.gravity):
            if count[k] < FEWEST:
                plan.dropped["gravity with too few readings"] += 1
                continue
            L, E = places[n].unit(imu.T_base_imu)
            white = imu.noise.accelerometer / np.sqrt(cfg.window)
            still = bool(quiet[k]) and places[n].moved < cfg.still
            sigma = white if still else float(np.hypot(white, cfg.acceleration))
            tilted = GRAVITY**2 * (np.trace(E[:3, :3]) * np.eye(3) - E[:3, :3])
            W = whitener(sigma**2 * np.eye(3) + tilted, what=f"specific force at x{n}", dim=3)
            row = known.get(n)
            if row is None:
                last = self.graph.values.imu_biases[-1:]
                row = self.graph.values.append("imubias", last if len(last) else np.zeros(6))
            r = ForceRecord(self.graph.next_factor(), stream, n, float(at[k]), row, L, force[k], W, cfg.robust)
            self.graph.ledger.spend(r.factor_id, r.label(), [stream], force_window(at[k], cfg))
            self.graph.insert(r)
            ids.append(r.factor_id)
        return ids

    def _relink(self, stream: str) -> list[int]:
        """Set the prior of the first bias, and random-walk links to biases without a preintegrated measurement."""
        noise = self.used[stream].imu.noise
        wanted = required_bias_links(self.states(stream), self.graph.records.values(), stream, noise)
        wanted = {link: sigma[self._bias] for link, sigma in wanted.items()}
        for fid, r in list(self.graph.records.items()):
            if isinstance(r, ImuBiasRecord) and r.stream == stream:
                sigma = wanted.get((r.before, r.bias))
                if sigma is None or not np.array_equal(sigma, r.sigma):
                    self.graph.records.pop(fid)
                    self.graph.ledger.release(fid)
                    self.graph.revision += 1
                else:
                    del wanted[(r.before, r.bias)]
        ids = []
        for (before, bias), sigma in wanted.items():
            link = ImuBiasRecord(self.graph.next_factor(), stream, before, bias, sigma)
            self.graph.ledger.spend(link.factor_id, link.label(), ["-"], (0.0, 0.0), "prior")
            self.graph.insert(link)
            ids.append(link.factor_id)
        return ids

    def _compact(self) -> None:
        """Remove velocities and biases without factors; the others are renumbered."""
        changed, v, b = renumber_states(self.graph.records)
        if changed or len(v) < len(self.graph.values.velocities) or len(b) < len(self.graph.values.imu_biases):
            self.graph.values.velocities, self.graph.values.imu_biases = (
                self.graph.values.velocities[v],
                self.graph.values.imu_biases[b],
            )
            self.graph.records.update(changed)
            self.graph.revision += 1
