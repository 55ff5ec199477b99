"""GPS fixes before they are factors: waiting, attachment to nodes, and initialisation of the datum.

The factor itself is in :mod:`graphslam.graph.factors.gps`.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core.config import check_options, flattened_field
from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import Array, align_se2, rotation2, se2_transform
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.core.se3 import quat_to_matrix, skew
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.factors.gps import AntennaRecord, BiasPriorRecord, GpsRecord, antenna_terms
from graphslam.graph.factors.landmark_submap import PathRecord, SubmapRecord
from graphslam.graph.noise import RobustKernel, whitener
from graphslam.graph.sensors.base import SensorFactors
from graphslam.graph.submap_node import InnerPoints, SubmapNode


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsConfig:
    """Use of GPS fixes in the graph.

    Parameters
    ----------
    robust : RobustKernel
        Kernel on each fix.
    sigma : float or None
        Standard deviation of a coordinate [m], replacing that of the stream.
    baseline : float
        Fixes wait until they span this distance [m], in the GPS frame and in the map; then a rigid alignment
        initialises the datum.
    bias_sigma : float or None
        With a number [m]: one bias per GPS segment with that prior (default: none).
    segment_gap : float
        A longer gap between fixes [s] starts a new segment.
    bias_time : float or None
        With a number [s]: correlation time of the errors. A bias is then linked to the previous one as a Gauss–Markov
        process with the stationary σ ``bias_sigma``; a new one starts after a tenth of this time, and with each
        segment. For anisotropic fixes it has the shape of their covariance, and ``bias_sigma`` is its mean over east
        and north. Default: biases of segments are independent.
    errors : "fitted" or "stated"
        Fit size and correlation time of the errors to the log at the end of a run; outliers are removed first
        (:mod:`graphslam.backend.fix_errors`). With a ``bias_sigma`` nothing is fitted.
    """

    robust: RobustKernel = flattened_field(RobustKernel("none", 2.385), robust="kind", robust_width="k")
    sigma: float | None = None
    baseline: float = 20.0
    bias_sigma: float | None = None
    segment_gap: float = 2.0
    bias_time: float | None = None
    errors: Literal["stated", "fitted"] = "fitted"

    def __post_init__(self) -> None:
        check_options(self, "gps.", {"> 0": "sigma baseline bias_sigma segment_gap bias_time"})
        if self.bias_time is not None and self.bias_sigma is None:
            raise ConfigError("gps.bias_time needs gps.bias_sigma, the σ of these errors")

    @property
    def bias_every(self) -> float:
        """Time after which a new bias starts [s]; infinite without ``bias_time``: one per segment."""
        return np.inf if self.bias_time is None else 0.1 * self.bias_time


@dataclass(frozen=True, slots=True, kw_only=False)
class FixErrors:
    """Errors of fixes, estimated from a log (:mod:`graphslam.backend.fix_errors`).

    Parameters
    ----------
    bias_sigma : float
        σ of the time-correlated part, mean over east and north [m]; 0: not significant.
    bias_time : float
        Its correlation time [s].
    white : float
        Ratio of the white σ to the stated σ.
    gain : float
        Twice the log-likelihood ratio to white noise.
    wild, fixes : int
        Number of removed outliers, and of all fixes.
    """

    bias_sigma: float
    bias_time: float
    white: float
    gain: float
    wild: int = 0
    fixes: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class PendingFix:
    """A fix that is not a factor yet."""

    factor_id: int
    time: float
    position: Array
    sigma: float
    lever: Array
    config: GpsConfig
    uneven: Array | None = None
    """Covariance of an anisotropic fix."""

    @property
    def alone(self) -> Array:
        """Covariance of the fix alone ``(dim, dim)``, in the GPS frame."""
        if self.uneven is not None:
            return self.uneven
        return np.asarray((self.config.sigma or self.sigma) ** 2 * np.eye(len(self.lever)))


@dataclass(frozen=True, slots=True, eq=False)
class AttachedFix:
    """A fix with its node in a submap, waiting for a datum."""

    fix: PendingFix
    node: int
    arm: Array
    covariance: Array
    point: int | None = None
    """Row of the path point that it measures, if its submap has one."""


def lever_arm(T: Array, covariances: Array | None, lever: Array) -> tuple[Array, Array]:
    """Antennas ``T · lever`` and their covariances, 2-D or 3-D.

    Parameters
    ----------
    T : (q, 3) or (q, 7)
        ``T_node_body``.
    covariances : (q, d, d) or None
        Right tangent; None = exact.
    lever : (dim,)

    Returns
    -------
    arm : (q, dim)
    covariance : (q, dim, dim)
        ``G C Gᵀ`` with ``G = R [I | (-l_y, l_x)ᵀ]``, in 3-D ``R [-[l]× | I]``: the derivative of
        ``T Exp(ξ) · lever``.
    """
    dim = group_of(T).dim
    arm = group_of(T).transform(T, np.broadcast_to(lever, (len(T), dim)))
    if covariances is None:
        return arm, np.zeros((len(T), dim, dim))
    G = arm_jacobian(T, lever)
    return arm, G @ covariances @ np.swapaxes(G, 1, 2)


def arm_jacobian(T: Array, lever: Array) -> Array:
    """Derivative ``(q, dim, dof)`` of ``T Exp(ξ) · lever``, for one lever ``(dim,)`` or one per row ``(q, dim)``."""
    group = group_of(T)
    G = np.zeros((len(T), group.dim, group.dof))
    if group.dim == 2:
        R = rotation2(T[:, 2])
        G[:, :, :2] = R
        beside = np.stack([-lever[..., 1], lever[..., 0]], axis=-1)
        G[:, :, 2] = (R @ beside[..., None])[..., 0]
    else:
        R = quat_to_matrix(T[:, 3:])
        G[:, :, :3], G[:, :, 3:] = -R @ skew(lever), R
    return G


def datum_columns(graph: FactorGraphState, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Columns ``(k, c)`` of the variables of an antenna at nodes ``(k,)``: node, datum, tilt if any; -1: fixed.

    In the order of :func:`~graphslam.graph.factors.gps.antenna_terms`.
    """
    lay, one = graph.flat().layout, np.zeros(len(nodes), dtype=np.int64)
    words = ("datum", "tilt") if lay.count("tilt") else ("datum",)
    return np.concatenate([lay.at("x", nodes), *(lay.at(w, one) for w in words)], axis=1)


def greatest_distance(points: Array) -> float:
    """Largest distance from the first point [m]; zero without points."""
    return float(np.max(np.linalg.norm(points - points[0], axis=1))) if len(points) else 0.0


def start_datum(world: Array, fixes: Array, sigma: Array) -> Array:
    """Initial ``T_gps_world`` from antenna positions in the map and their fixes.

    Rigid alignment, reweighted a few times with Cauchy weights of three sigma (at least 1 m), which reduces the
    influence of outliers.

    Parameters
    ----------
    world, fixes : (q, 2)
    sigma : (q,)
    """
    w = 1.0 / sigma**2
    T = align_se2(world, fixes, w)
    width = np.maximum(3.0 * sigma, 1.0)
    for _ in range(10):
        d = np.linalg.norm(se2_transform(T, world) - fixes, axis=1)
        T = align_se2(world, fixes, w / (1.0 + (d / width) ** 2))
    return T


def level_datum(world: Array, fixes: Array, sigma: Array) -> Array:
    """:func:`start_datum` of positions ``(q, dim)``; in 3-D with the median height, as ``[x, y, z, heading]``."""
    level = start_datum(world[:, :2], fixes[:, :2], sigma)
    if world.shape[1] == 2:
        return level
    return np.array([*level[:2], np.median(fixes[:, 2] - world[:, 2]), level[2]])


class GpsFactors(SensorFactors):
    """The fixes of a graph: waiting ones, and their conversion to factors.

    Fixes wait for their submap, and until :attr:`GpsConfig.baseline` is spanned; then the datum is initialised by
    rigid alignment and all of them become factors. The map does not move then, however late that is: its first base is
    fixed and the datum is estimated. Fixes without a submap are dropped and counted (event ``gps-dropped``). Each is
    attached to the node nearest in time, the base or an inner node.

    A fix at ``t`` belongs to the submap with ``t_start <= t < t_end``: exactly on a boundary it belongs to the later
    one. A fix at the end of a finished graph belongs to the last submap.
    """

    name: ClassVar[str] = "gps"
    title: ClassVar[str] = "GPS fixes"
    readings = Gps
    options = GpsConfig
    graph: FactorGraphState

    def __init__(self, graph: FactorGraphState) -> None:
        super().__init__(graph)
        self.config = GpsConfig()
        self.waiting: list[PendingFix] = []  # for their submap, sorted by time
        self.attached: list[AttachedFix] = []  # for a datum
        self.last_time = -np.inf
        self.bias_begin = -np.inf  # of the last bias
        self.fitted: FixErrors | None = None

    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """See :meth:`SensorFactors.add`; one id per fix."""
        g, gps, stream = self.graph, readings, stream or self.name
        if gps.positions.shape[1] != g.dim:
            raise GeometryError(
                "GPS positions and map differ in dimension",
                where=stream,
                got=f"{gps.positions.shape[1]}-D positions",
                wanted=f"{g.dim}-D, or leave GPS out (--set gps.use=none)",
            )
        self.config = config or self.config
        for t in gps.times:
            g.ledger.check(f"GPS fix at {t:.3f} s", [stream], (float(t), float(t)))
        fixes = []
        uneven = None if self.config.sigma is not None else gps.covariances
        for k, (t, p, s) in enumerate(zip(gps.times.tolist(), gps.positions, gps.sigma.tolist())):
            P = None if uneven is None else uneven[k]
            fixes.append(PendingFix(g.next_factor(), t, p, s, gps.lever, self.config, P))
            g.ledger.spend(fixes[-1].factor_id, f"GPS fix at {t:.3f} s", [stream], (t, t))
        self.waiting = sorted([*self.waiting, *fixes], key=lambda f: f.time)
        first = min((f.time for f in fixes), default=np.inf)
        for s in g.submaps:
            if s.interval[1] >= first or s is g.submaps[-1]:
                self.attach(s, more=s is not g.submaps[-1])
        return [f.factor_id for f in fixes]

    def add_factors(self, submap: SubmapNode) -> None:
        """See :meth:`SensorFactors.add_factors`."""
        self.attach(submap)

    def waiting_readings(self) -> int:
        """Number of fixes that wait for a submap or for a datum."""
        return len(self.waiting) + len(self.attached)

    def finish(self) -> None:
        """Attach a fix at the end of the last submap, and drop later ones."""
        if self.graph.submaps:
            self.attach(self.graph.submaps[-1], closed=True)
        self._drop([(f.factor_id, "after the last submap") for f in self.waiting])
        self.waiting = []

    def attach(self, s: SubmapNode, *, closed: bool = False, more: bool = False) -> None:
        """Attach waiting fixes to a submap, with ``closed`` also one at its end; with ``more`` no datum is started."""
        g = self.graph
        dropped = self._queue(s, closed)
        late = self.waiting[: 0 if more or s is not g.submaps[-1] else self._before(s.interval[0])]
        self.waiting = self.waiting[len(late) :]
        self._drop([*dropped, *((f.factor_id, "no submap covers it") for f in late)])
        if more or not self.attached:
            return
        if g.gps_origin is None:
            g.gps_origin = self.attached[0].fix.position.copy()
        if not g.structure.count("datum"):
            start = self._datum_if_ready(g.values.poses, g.gps_origin, self.attached[0].fix.config.baseline)
            if start is None:
                return
            g.values.datum = start
            g.log_event("datum", fixes=len(self.attached), T_gps_world=start.tolist())
        for t in sorted(self.attached, key=lambda t: t.fix.time):
            bias = self._bias_of(t.fix)
            W = whitener(self._in_its_frame(t), what=f"covariance of the GPS fix at {t.fix.time:.3f} s")
            z = t.fix.position - g.gps_origin
            tilt, uneven = g.structure.count("tilt") > 0, t.fix.uneven is not None
            kernel = t.fix.config.robust
            g.insert(
                GpsRecord(
                    t.fix.factor_id, t.node, t.fix.time, t.arm, z, W, kernel, bias, tilt=tilt, uneven=uneven,
                    point=t.point, stated=t.fix.alone,
                )
            )  # fmt: skip
        self.attached = []

    def _in_its_frame(self, t: AttachedFix) -> Array:
        """Covariance of a fix with its arm, in the node's frame; of an anisotropic fix in the GPS frame."""
        if t.fix.uneven is None:
            return t.covariance
        if t.point is not None:
            return t.fix.uneven
        values = self.graph.values
        assert values.datum is not None
        J = antenna_terms(values.poses[[t.node]], values.datum, values.tilt, t.arm[None])[1][0]
        turn = J[:, :2] if self.graph.dim == 2 else J[:, 3:6]  # the node's axes in the GPS frame
        return np.asarray(t.fix.uneven + turn @ t.covariance @ turn.T)

    def remove(self, submap: SubmapNode) -> None:
        """Remove the fixes of a submap that is removed, because their arms come from its trajectory."""
        s, own = submap, set(submap.nodes[:-1])
        inside = [r.factor_id for r in self.graph.records.values() if isinstance(r, GpsRecord) and r.node in own]
        for fid in inside:
            del self.graph.records[fid]
        placed = [t.fix.factor_id for t in self.attached if t.node in own]
        self.attached = [t for t in self.attached if t.node not in own]
        self._drop([(i, "its submap was removed") for i in [*placed, *inside]])
        self._leave_points(self.graph.submap(s.key))

    def remove_unused(self, removed: FactorRecord) -> None:
        """Remove the datum if it has no factor left, with the biases."""
        g = self.graph
        if g.structure.count("datum") and not any(isinstance(r, AntennaRecord) for r in g.records.values()):
            for fid in [k for k, r in g.records.items() if isinstance(r, BiasPriorRecord)]:
                g.ledger.release(fid)
                del g.records[fid]
            g.values.datum, g.values.biases = None, np.zeros((0, g.dim))
            self.fitted = None
            g.revision += 1

    def _drop(self, dropped: Iterable[tuple[int, str]]) -> None:
        for fid, reason in dropped:
            self.graph.ledger.release(fid)
            self.graph.log_event("gps-dropped", factor_id=fid, reason=reason)

    def _before(self, t: float, at: bool = False) -> int:
        """Number of waiting fixes before a time; ``at``: or at it."""
        return (bisect_right if at else bisect_left)(self.waiting, t, key=lambda f: f.time)

    def _queue(self, s: SubmapNode, closed: bool) -> list[tuple[int, str]]:
        """Attach the fixes of one submap to its nodes; returns (factor_id, reason) of fixes that cannot be used."""
        first, end = self._before(s.interval[0]), self._before(s.interval[1], closed)
        mine, dropped = self.waiting[first:end], []
        del self.waiting[first:end]
        if mine and s.trajectory is None:
            return [(f.factor_id, "submap has no trajectory") for f in mine]
        for f in mine:
            t = np.array([f.time])
            at = s.nearest(t)
            try:
                arm, cov = lever_arm(*s.local(t, at), f.lever)
            except DataError:
                dropped.append((f.factor_id, "outside the submap's trajectory"))
                continue
            sigma = f.sigma if f.config.sigma is None else f.config.sigma
            point = self._inner_point(s, f)
            if point is not None:  # the uncertainty of the path is in the point
                cov = np.zeros_like(cov)
            # of an anisotropic fix only the arm's covariance, until the datum gives the rotation between the frames
            covariance = cov[0] if f.uneven is not None else sigma**2 * np.eye(len(f.lever)) + cov[0]
            self.attached.append(AttachedFix(f, s.nodes[int(at[0])], arm[0], covariance, point))
        self.attach_points(s)
        return dropped

    def _inner_point(self, s: SubmapNode, fix: PendingFix) -> int | None:
        """Row of the path point of a submap at a fix, created if needed; None: the submap has no such point."""
        inner = self.graph.submap(s.key).inner_points
        k = None if inner is None else inner.path.at(fix.time, fix.lever)
        return None if k is None else self.row_of_point(s, k)

    def row_of_point(self, s: SubmapNode, k: int) -> int:
        """Row of path point k of a submap, created if needed (:meth:`attach_points` must follow)."""
        g, s = self.graph, self.graph.submap(s.key)
        inner = s.inner_points
        assert inner is not None
        if k not in inner.rows:
            place = group_of(g.structure.poses).transform(g.pose(s.node), inner.path.positions[k])
            rows = {**inner.rows, k: g.structure.append("point", place)}
            self._keep(s, replace(inner, rows=rows))
            return rows[k]
        return inner.rows[k]

    def _keep(self, s: SubmapNode, inner: InnerPoints | None) -> None:
        submaps = self.graph.submaps
        k = next(k for k, other in enumerate(submaps) if other.key == s.key)
        submaps[k] = replace(submaps[k], inner_points=inner)

    def attach_points(self, s: SubmapNode) -> None:
        """Connect the used path points of a submap to its end pose and landmarks with one factor."""
        g, s = self.graph, self.graph.submap(s.key)
        inner = s.inner_points
        if inner is None or not inner.rows:
            return
        fid = inner.factor_id
        held = None if fid is None else g.records[fid]
        if isinstance(held, PathRecord) and len(held.points) == len(inner.rows):
            return
        submap = g.records[s.factor_id]
        assert isinstance(submap, SubmapRecord)
        if fid is None:
            fid = g.next_factor()
            g.ledger.spend(fid, f"path of submap {s.key} at its fixes", ["-"], s.interval, "prior")
        self._keep(s, replace(inner, factor_id=fid))
        g.insert(inner.record(submap, fid))

    def _leave_points(self, s: SubmapNode) -> None:
        """Remove the path points of a submap that is removed; the others are renumbered."""
        g, inner = self.graph, s.inner_points
        if inner is None or not inner.rows:
            return
        if inner.factor_id is not None:
            del g.records[inner.factor_id]
            g.ledger.release(inner.factor_id)
        removed = set(inner.rows.values())
        kept = [k for k in range(g.structure.count("point")) if k not in removed]
        new = {old: k for k, old in enumerate(kept)}
        for fid, r in list(g.records.items()):
            if isinstance(r, PathRecord):
                g.records[fid] = replace(r, points=np.array([new[k] for k in r.points.tolist()], dtype=np.int64))
                continue
            ends = {name: getattr(r, name, None) for name in ("point", "point_to")}
            if ends := {name: new.get(k, -1) for name, k in ends.items() if k is not None}:  # -1: a removed point
                g.records[fid] = replace(r, **ends)  # type: ignore[type-var]
        for other in list(g.submaps):
            if other.inner_points is not None and other.key != s.key:
                rows = {k: new[v] for k, v in other.inner_points.rows.items()}
                self._keep(other, replace(other.inner_points, rows=rows))
        if any(other.key == s.key for other in g.submaps):
            self._keep(s, replace(inner, factor_id=None, rows={}))
        self.attached = [t if t.point is None else replace(t, point=new[t.point]) for t in self.attached]
        g.values["point"] = g.values["point"][kept]
        g.revision += 1

    def _datum_if_ready(self, poses: Array, origin: Array, baseline: float) -> Array | None:
        """Initial ``T_gps_world`` from the attached fixes, once they span ``baseline`` in both frames."""
        if len(self.attached) < 2:
            return None
        group = group_of(poses)
        world = group.transform(poses[[t.node for t in self.attached]], np.array([t.arm for t in self.attached]))
        fixes = np.array([t.fix.position for t in self.attached]) - origin
        if (
            min(greatest_distance(world[:, :2]), greatest_distance(fixes[:, :2])) < baseline
        ):  # only a horizontal extent determines the heading
            return None
        fix = [np.zeros((group.dim, group.dim)) if t.fix.uneven is None else t.fix.uneven for t in self.attached]
        sigma = np.array([np.sqrt(np.trace((t.covariance + P)[:2, :2]) / 2.0) for t, P in zip(self.attached, fix)])
        return level_datum(world, fixes, sigma)

    def _bias_of(self, fix: PendingFix) -> int | None:
        cfg, previous = fix.config, self.last_time
        self.last_time = fix.time
        g = self.graph
        if cfg.bias_sigma is None:
            return None
        last = g.structure.count("bias") - 1
        paused = fix.time - previous > cfg.segment_gap
        if last < 0 or paused or not 0.0 <= fix.time - self.bias_begin < cfg.bias_every:
            before, keep = None, 0.0
            if last >= 0 and cfg.bias_time is not None and fix.time >= self.bias_begin:
                before, keep = last, float(np.exp(-(fix.time - self.bias_begin) / cfg.bias_time))
            shape = None
            if cfg.bias_time is not None and fix.uneven is not None:
                shape = fix.uneven / (0.5 * np.trace(fix.uneven[:2, :2]))
            self.bias_begin = fix.time
            last = g.structure.append("bias", np.zeros(g.dim))
            sigma = cfg.bias_sigma * float(np.sqrt(1.0 - keep**2))
            record = BiasPriorRecord(
                g.next_factor(), last, sigma, dim=g.dim, before=before, keep=keep, shape=shape
            )  # fmt: skip
            g.ledger.spend(record.factor_id, record.label(), ["-"], (fix.time, fix.time), "prior")
            g.insert(record)
        return last
