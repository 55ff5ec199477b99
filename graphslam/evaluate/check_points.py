"""Check points: withheld surveyed points or distances, compared with a solved map, with the power of the test.

An innovation is a table row minus its prediction. Its covariance includes the map at this place, the datum if the map
has one in the frame of the row, and the row. Rows in an unknown frame are aligned with the map by the rigid motion of
least NIS; its parameters are subtracted from the degrees of freedom (:func:`graphslam.evaluate.gauge.aligned_nees` is
the same for whole maps).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import scipy.linalg as sla
from scipy import special

from graphslam.core.control import ControlRow, ControlTable, MeasuredPlace
from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, align_se2, rotation2
from graphslam.core.poses import group_of
from graphslam.core.se3 import align_se3, quat_to_matrix, so3_exp
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.covariance_assessment import HALF, LEAST_POWER
from graphslam.evaluate.gps_innovation import antenna_places
from graphslam.evaluate.residual_consistency import two_sided_bounds
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import up_turn
from graphslam.graph.factors.control import survey_terms
from graphslam.graph.factors.range import antennas
from graphslam.graph.sensors.control import ControlFactors
from graphslam.graph.sensors.gps import arm_jacobian
from graphslam.refine.result import Refinement

Verdict = Literal["consistent", "conservative", "overconfident", "wrong", "not tested"]
CONFIDENCE = 0.95
WRONG = 9.0
"""NIS per degree of freedom above which errors are not explained by a covariance that is too small: 3 σ on average."""


@dataclass(frozen=True)
class CheckPoints:
    """Result of the test.

    Parameters
    ----------
    rows : list of dict
        ``line``, ``name``, ``place``, ``frame``, ``error`` and its predicted ``sigma`` [m], ``nis``, ``dof``.
    nis, dof : float
        NIS and degrees of freedom of all rows together, with their correlations.
    power : float
        Probability that the test fails if the true covariance of the map is twice the reported one.
    aligned : int
        Degrees of freedom of the fitted rigid motions.
    """

    source: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    refused: list[tuple[int, str]] = field(default_factory=list)
    nis: float = 0.0
    dof: float = 0.0
    power: float = 0.0
    aligned: int = 0

    @property
    def bounds(self) -> tuple[float, float]:
        """Two-sided bounds of NIS/dof."""
        return two_sided_bounds(1.0, self.dof, CONFIDENCE)[:2] if self.dof > 0 else (0.0, float("inf"))

    @property
    def verdict(self) -> Verdict:
        """Verdict."""
        ratio, (low, high) = self.nis / max(self.dof, 1.0), self.bounds
        if ratio > high:
            return "wrong" if ratio > max(WRONG, high) else "overconfident"
        if ratio < low:
            return "conservative"
        return "consistent" if self.power >= LEAST_POWER else "not tested"

    @property
    def rmse(self) -> float:
        """Root mean square of the errors [m]."""
        return float(np.sqrt(np.mean([r["error"] ** 2 for r in self.rows]))) if self.rows else float("nan")

    def facts(self) -> dict[str, Any]:
        """Entries of ``run.json``."""
        low, high = self.bounds
        refused = [{"line": line, "why": why} for line, why in self.refused]
        out: dict[str, Any] = {"source": self.source, "rows": self.rows, "refused": refused, "verdict": self.verdict}
        if self.rows:
            ratio = self.nis / self.dof if self.dof > 0 else None
            out |= {"rmse": self.rmse, "nis_per_dof": ratio, "dof": self.dof, "power": self.power}
            out |= {"low": low, "high": None if np.isinf(high) else high, "aligned": self.aligned}
        return out


def power_of_test(eigenvalues: Array, confidence: float = CONFIDENCE) -> float:
    """Probability that ``Σ λ_i χ²_1`` is outside the two-sided bounds of ``χ²_n``.

    Exact, as a mixture of χ² distributions (Ruben, Annals of Mathematical Statistics 33, 1962, eq. 3.8).

    Parameters
    ----------
    eigenvalues : (n,)
        Each at least 1. All equal to 2: every true covariance is twice the reported one.
    """
    n = len(eigenvalues)
    if not n:
        return 0.0
    low, high, _ = two_sided_bounds(1.0, n, confidence)
    beta = eigenvalues.min()  # then all weights of the mixture are positive
    ratio = 1.0 - beta / eigenvalues
    a = [float(np.exp(0.5 * np.sum(np.log(beta / eigenvalues))))]
    g: list[float] = []
    inside = 0.0
    for k in range(4 * n + 200):
        if k:
            g.append(0.5 * float(np.sum(ratio**k)))
            a.append(float(np.dot(g[::-1], a)) / k)
        inside += a[k] * float(np.diff(special.chdtr(n + 2 * k, n * np.array([low, high]) / beta))[0])
        if 1.0 - sum(a) < 1e-12:
            break
    return float(np.clip(1.0 - inside, 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Predicted:
    """Predicted places of a map.

    Parameters
    ----------
    positions : (k, dim)
        In the map frame [m].
    covariance : (dim k + c, dim k + c)
        Joint covariance of the places and of the ``c`` parameters of datum and tilt.
    level : (3, 3) or None
        Rotation from the level frame to the map frame at the first base; None if the vertical is unknown, or in 2-D.
    """

    positions: Array
    covariance: Array
    level: Array | None


def check_points(
    graph: FactorGraph, table: ControlTable, refined: tuple[Refinement, Trajectory] | None = None
) -> CheckPoints:
    """Compare the rows of a table with a solved map.

    Parameters
    ----------
    graph : FactorGraph
        At its optimum.
    refined : (Refinement, Trajectory), optional
        Refined path that replaces the graph as the result; it has no datum and no landmarks.
    """
    refused, rows = list(table.refused), []
    for row in table.rows:
        try:
            for place in (row.place, row.to):
                _find(graph, place, refined)
            if row.to is None:
                row.coordinates(graph.dim)
            rows.append(row)
        except DataError as error:
            refused.append((row.line, str(error)))
    if not rows:
        return CheckPoints(table.source, refused=sorted(refused))
    places = list(dict.fromkeys(p for r in rows for p in (r.place, r.to) if p is not None))
    map_ = _of_graph(graph, places) if refined is None else _of_path(*refined, places)
    frame = "" if refined is not None else _datum_frame(graph)
    return replace(_Innovations(graph, rows, places, map_, frame).tested(table.source), refused=sorted(refused))


def _datum_frame(graph: FactorGraph) -> str:
    """Frame of the datum; empty if the graph has none."""
    if graph.values.datum is None:
        return ""
    return "gps" if graph.gps_origin is not None else ControlFactors.of(graph).frame


def _find(graph: FactorGraph, place: MeasuredPlace | None, refined: tuple[Refinement, Trajectory] | None) -> None:
    """Raise if a place is not in the map."""
    if place is None:
        return
    if refined is None:
        ControlFactors.of(graph).site(place)
    elif place.time is None:
        raise DataError("a refined path has no landmarks", got=place, wanted="a time, or --set refine.use=false")
    elif not refined[1].times[0] <= place.time <= refined[1].times[-1]:
        span = f"{refined[1].times[0]:.3f} to {refined[1].times[-1]:.3f} s"
        raise DataError("the time is outside the map", got=place, wanted=span)


def _of_graph(graph: FactorGraph, places: Sequence[MeasuredPlace]) -> _Predicted:
    """Places of a graph with their joint covariance, including the datum."""
    d, n, values, lay = graph.dim, len(places), graph.values, graph.flat().layout
    positions, left = np.zeros((n, d)), np.zeros((d * n, d * n))
    parts: list[tuple[Any, Any, Array]] = []  # rows, columns, Jacobian
    for lever in dict.fromkeys(p.lever for p in places if p.time is not None):
        mine = np.array([k for k, p in enumerate(places) if p.time is not None and p.lever == lever])
        mine = mine[np.argsort([places[k].time for k in mine])]
        times = np.array([places[k].time for k in mine], dtype=np.float64)
        node, arm, covariance, inner = antenna_places(graph, times, places[mine[0]].arm(d))
        positions[mine], J = antennas(values.poses[node], arm)
        turn = J[:, :, group_of(values.poses).position]
        rows = (d * mine[:, None] + np.arange(d)).ravel()
        C = covariance.reshape(len(mine), d, len(mine), d)
        left[np.ix_(rows, rows)] = np.einsum("aij,ajbk,bmk->aibm", turn, C, turn, optimize=True).reshape(len(rows), -1)
        parts += [(d * k + np.arange(d), c, j) for k, c, j in zip(mine, lay.pose_columns(node), J)]
        for found in inner:
            for k, f in enumerate(found.fixes.tolist()):
                moved = turn[f] @ found.jacobian[d * k : d * k + d]
                parts.append((d * mine[f] + np.arange(d), found.columns, moved))
    for k, p in enumerate(places):
        if p.landmark is not None:
            row = graph.landmark_rows[p.landmark]
            positions[k] = values.landmarks[row]
            parts.append((d * k + np.arange(d), lay.at("l", row), np.eye(d)))
    extra = np.concatenate([np.zeros(0, int), *(lay.columns(w) for w in ("datum", "tilt") if lay.count(w))])
    parts.append((d * n + np.arange(len(extra)), extra, np.eye(len(extra))))
    needed = np.unique(np.concatenate([c for _, c, _ in parts]))
    needed = needed[needed >= 0]
    A = np.zeros((d * n + len(extra), len(needed)))
    for rows, columns, J in parts:
        free = np.flatnonzero(columns >= 0)
        np.add.at(A, np.ix_(rows, np.searchsorted(needed, columns[free])), J[:, free])
    P = A @ graph.covariance().columns(needed) @ A.T
    P[: d * n, : d * n] += left
    return _Predicted(positions, P, None if values.tilt is None else up_turn(values.tilt)[0])


def _of_path(r: Refinement, path: Trajectory, places: Sequence[MeasuredPlace]) -> _Predicted:
    """Places of a refined path. The covariance is that of the step nearest in time."""
    times = np.array([p.time for p in places], dtype=np.float64)
    poses, g = path.interpolate(times), group_of(path.poses)
    after = np.clip(np.searchsorted(r.times, times), 1, len(r.times) - 1)
    steps = np.where(times - r.times[after - 1] < r.times[after] - times, after - 1, after)
    arms = np.array([p.arm(g.dim) for p in places])
    J = arm_jacobian(poses, arms) @ g.adjoint(g.between(poses, r.poses[steps]))
    P = r.joint(steps).reshape(len(places), g.dof, len(places), g.dof)
    P = np.einsum("aij,ajbk,bmk->aibm", J, P, J, optimize=True).reshape(len(places) * g.dim, -1)
    level = np.eye(3) if g.dim == 3 else None  # the frame of a refined path is level
    return _Predicted(np.asarray(g.transform(poses, arms)), P, level)


class _Innovations:
    """Innovations ``e = z - h`` of the rows, in blocks.

    Parameters
    ----------
    frame : str
        Frame of the graph's datum.
    """

    def __init__(
        self, graph: FactorGraph, rows: list[ControlRow], places: list[MeasuredPlace], found: _Predicted, frame: str
    ) -> None:
        self.graph, self.rows, self.found, self.frame, self.dim = graph, rows, found, frame, graph.dim
        number = {p: k for k, p in enumerate(places)}
        self.at = [number[r.place] for r in rows]
        self.to = [-1 if r.to is None else number[r.to] for r in rows]
        widths = [1 if r.to is not None else self.dim for r in rows]
        stops = np.cumsum(widths).tolist()
        self.parts = [slice(b - w, b) for w, b in zip(widths, stops)]
        self.size = int(stops[-1])
        self.motions = {f: self._first_motion(f) for f in dict.fromkeys(r.frame for r in rows) if f not in ("", frame)}

    def _first_motion(self, frame: str) -> tuple[Array, Array]:
        """Initial rotation and translation from a frame to the map frame."""
        mine = [k for k, r in enumerate(self.rows) if r.frame == frame]
        z = np.array([self.rows[k].coordinates(self.dim)[0] for k in mine])
        p, level = self.found.positions[[self.at[k] for k in mine]], self.found.level
        if self.dim == 3 and level is None and len(mine) > 2:
            T = align_se3(z, p)[0]
            return quat_to_matrix(T[3:]), T[:3]
        level = np.eye(self.dim) if level is None else level
        flat = p @ level
        T = align_se2(z[:, :2], flat[:, :2]) if len(mine) > 1 else np.zeros(3)
        M = np.eye(self.dim)
        M[:2, :2] = rotation2(T[2])
        M = level @ M
        return M, np.mean(p - z @ M.T, axis=0)

    def _axes(self) -> Array:
        """Axes of free rotation between a frame and the map ``(a, 3)``."""
        if self.dim == 2:
            return np.array([[0.0, 0.0, 1.0]])
        return np.eye(3) if self.found.level is None else self.found.level[:, 2][None]

    def linearised(self) -> tuple[Array, Array, Array, Array]:
        """Innovations ``(n,)``, covariances of map and of rows ``(n, n)``, Jacobian of the rigid motions ``(n, g)``."""
        d, P, n = self.dim, self.found.covariance, len(self.found.positions)
        e, B, R = np.zeros(self.size), np.zeros((self.size, len(P))), np.zeros((self.size, self.size))
        axes = self._axes()
        G = np.zeros((self.size, (d + len(axes)) * len(self.motions)))
        values, origin = self.graph.values, self._origin()
        for row, part, k, other in zip(self.rows, self.parts, self.at, self.to):
            p, at = self.found.positions[k], slice(d * k, d * k + d)
            if other >= 0:
                apart = p - self.found.positions[other]
                length = float(np.linalg.norm(apart))
                e[part], R[part, part] = row.distance - length, row.sigma[0] ** 2
                B[part, at] = apart / max(length, 1e-9)
                B[part, d * other : d * other + d] = -B[part, at]
                continue
            z, own = row.coordinates(d)
            if row.frame == self.frame:
                assert values.datum is not None
                y, turn, by = survey_terms(p[None], values.datum, values.tilt)
                e[part], R[part, part], B[part, at] = z - origin - y[0], own, turn[0]
                B[part, d * n :] = by[0][:, : len(P) - d * n]
                continue
            M, shift = self.motions[row.frame]
            q = M @ z + shift
            e[part], R[part, part], B[part, at] = q - p, M @ own @ M.T, np.eye(d)
            first = (d + len(axes)) * list(self.motions).index(row.frame)
            turned = np.cross(axes, np.append(q, np.zeros(3 - d)))[:, :d].T
            G[part, first : first + d + len(axes)] = np.hstack([np.eye(d), turned])
        return e, B @ P @ B.T, R, G

    def _origin(self) -> Array:
        if self.graph.gps_origin is not None:
            return self.graph.gps_origin
        return ControlFactors.of(self.graph).origin

    def _move(self, step: Array) -> None:
        d, a = self.dim, len(self._axes())
        for k, (frame, (M, shift)) in enumerate(self.motions.items()):
            s = step[(d + a) * k : (d + a) * (k + 1)]
            turn = quat_to_matrix(so3_exp(s[d:] @ self._axes()))[:d, :d]
            self.motions[frame] = turn @ M, turn @ shift + s[:d]

    def tested(self, source: str) -> CheckPoints:
        """NIS of each row and of all, and the power of the test."""
        rows = self._by_row(*self.linearised())
        for _ in range(50):
            e, of_map, of_rows, G = self.linearised()
            L = np.linalg.cholesky(of_map + of_rows)
            y, W = (sla.solve_triangular(L, x, lower=True) for x in (e, G))
            U, s, Vt = np.linalg.svd(W, full_matrices=True)
            rank = int(np.sum(s > 1e-9 * s.max(initial=0.0)))
            step = -(Vt[:rank].T / s[:rank]) @ (U[:, :rank].T @ y)
            if not np.max(np.abs(step), initial=0.0) > 1e-10:
                break
            self._move(step)
        N = U[:, rank:]  # orthogonal to all rigid motions
        r = N.T @ y
        K = sla.solve_triangular(L, N, lower=True, trans="T")
        eigenvalues = 1.0 + (HALF - 1.0) * np.clip(np.linalg.eigvalsh(K.T @ of_map @ K), 0.0, 1.0)
        return CheckPoints(source, rows, [], float(r @ r), float(len(r)), power_of_test(eigenvalues), rank)

    def _by_row(self, e: Array, of_map: Array, of_rows: Array, G: Array) -> list[dict[str, Any]]:
        """Error, expected error and NIS of each row; unknown frames are aligned by unweighted least squares."""
        size, S = np.diag(of_map + of_rows), of_map + of_rows
        U, s, _ = np.linalg.svd(G, full_matrices=False)
        U = U[:, s > 1e-9 * s.max(initial=0.0)]
        e, S = e - U @ (U.T @ e), S - U @ (U.T @ S)
        S = S - (S @ U) @ U.T
        out = []
        for row, part in zip(self.rows, self.parts):
            w, V = np.linalg.eigh(S[part, part])
            kept = w > 1e-9 * size[part].max()
            nis = float(np.sum((V[:, kept].T @ e[part]) ** 2 / w[kept]))
            error = float(np.linalg.norm(e[part])) if row.to is None else float(e[part][0])
            figures = {"line": row.line, "name": row.name, "place": str(row.place), "frame": row.frame, "error": error}
            out.append(figures | {"sigma": float(np.sqrt(np.sum(w[kept]))), "nis": nis, "dof": int(kept.sum())})
        return out
