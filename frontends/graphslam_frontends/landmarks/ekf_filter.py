"""Compressed EKF-SLAM over one map: the cost of a scan depends on nearby landmarks only (Guivant & Nebot 2001).

It is the standard filter: state ``[x, y, θ, l_1x, l_1y, …]`` in the frame of the first base, motion in the tangent of
the pose, one stacked update by all observations of a scan, new landmarks with exact cross covariances. The far part of
the covariance is written later, with the same result.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import qr
from scipy.linalg.blas import dsyrk

from graphslam.core.errors import CovarianceError
from graphslam.core.geometry import Array
from graphslam_frontends.landmarks.compatibility import gates_by_dof, pair_observations
from graphslam_frontends.landmarks.compatibility_kernels import LandmarkCounts, misses_kernel
from graphslam_frontends.landmarks.config import GATE_NEW
from graphslam_frontends.landmarks.ekf_config import EkfFilterConfig
from graphslam_frontends.landmarks.ekf_kernels import (
    ActiveState,
    PoseState,
    augment_kernel,
    gather_kernel,
    innovation_kernel,
    passive_distance_kernel,
    predict_kernel,
    scatter_kernel,
    update_kernel,
)

Ints = npt.NDArray[np.int64]
IGNORED = -1
# Up to this many landmarks all are active: the bookkeeping would take longer than it saves.
_SMALL = 48
# If a landmark has to become active, all those within this multiple of its gate become active.
_GENEROUS = 3.0
_ROWS = 1024
_ROOM = 96
ACTIVE_MARGIN = 20.0
"""Landmarks this far beyond the range of the sensor are active, the others are updated later [m]. It changes the
computing time, not the result."""


class EkfMap:
    """The Gaussian over pose and landmarks, with its association.

    Parameters
    ----------
    sensor : (3,)
        ``T_base_sensor``.
    field_of_view : (2,)
        Bearings of the sensor [rad].
    max_range : float
        That of the sensor [m]; may be infinite.
    """

    resamplings = 0
    ancestors: int | None = None

    def __init__(
        self, config: EkfFilterConfig, sensor: Array, field_of_view: tuple[float, float], max_range: float
    ) -> None:
        self.config, self.sensor, self.field_of_view = (
            config,
            np.ascontiguousarray(sensor, dtype=np.float64),
            field_of_view,
        )
        self.reach = min(config.max_range, max_range)
        # the whole map at the last fold; P stores its lower triangle
        self._x, self._P = np.zeros(3), np.zeros((3, 3))
        self._slots = 0
        self.hits, self.misses, self.born, self.founded = (np.zeros(0, dtype=np.int64) for _ in range(4))
        self._free: list[int] = []
        self._slot_of_key: dict[int, int] = {}
        # the active part
        self._active = np.zeros(0, dtype=np.int64)
        self._place = np.zeros(0, dtype=np.int64)  # index of a slot in the active ones, -1 = passive
        self._ax, self._aP, self._aPhi = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 0))
        self._n0 = 0
        self._C, self._V, self._rows, self._theta = np.zeros((0, 3)), np.zeros((0, 0)), 0, np.zeros(0)
        self._passive, self._anchor = np.zeros(0, dtype=np.int64), np.zeros(2)
        # association: every created landmark has a founding number, stored for each observation
        self._founding = np.full(256, IGNORED, dtype=np.int64)
        self.foundings = 0
        self.scans = self.observations = 0
        self.folds = 0
        self.nis, self.nis_dof = 0.0, 0
        self.capped, self.nodes, self.outliers, self.unfounded = 0, 0, 0, 0
        margin = np.deg2rad(1.0)  # at the edge of a scan a trunk is cut off and not reported
        self._limits = np.array(
            [
                config.confirm_hits,
                config.drop_misses,
                config.drop_scans,
                0.9 * self.reach,
                field_of_view[0] + margin,
                field_of_view[1] - margin,
            ]
        )

    # ---- one scan

    def step(self, u: Array, Q: Array, observations: Array, known: Ints) -> None:
        """Process one scan: motion, association, stacked update, new landmarks, deletion of spurious ones.

        Parameters
        ----------
        u, Q : (3,), (3, 3)
            Increment since the last scan and its right-tangent covariance.
        observations : (q, 4)
            Range, bearing and their variances; an infinite bearing variance = range only.
        known : (q,)
            A number ≥ 0 of each observation's landmark in known-association mode, else -1.
        """
        q = len(observations)
        by_identity = self.config.association == "known"
        if len(self._active):
            moved = np.hypot(self._ax[0] - self._anchor[0], self._ax[1] - self._anchor[1])
            if moved > ACTIVE_MARGIN and (self._n0 or len(self._active) > _SMALL):
                self._choose(None)
        predict_kernel(self._ax, self._aP, 3 + 2 * len(self._active), self._aPhi, self._n0, u, Q)
        if by_identity:
            at, fresh = self._by_identity(observations, known)
        else:
            at, fresh, polar = self._by_distance(observations)
        self._update(observations, at)
        paired = at >= 0
        first = self._remember(q)
        seen = self._active[at[paired]]
        np.add.at(self.hits, seen, 1)
        self.misses[seen] = 0
        self._founding[first : first + q][paired] = self.founded[seen]
        for o in fresh:
            slot = self._found(observations[o])
            self._founding[first + o] = self.founded[slot]
            if by_identity:
                self._slot_of_key[int(known[o])] = slot
        if not by_identity:
            self._drop_spurious(at, polar)
        self.scans += 1
        self.observations += q

    def _update(self, observations: Array, at: Ints) -> None:
        rows = 2 * len(observations)
        if self._rows + rows > len(self._V):
            self._compress(rows)
        n = 3 + 2 * len(self._active)
        active = ActiveState(self._ax, self._aP, self._aPhi, self._V, self._theta)
        nis, used = update_kernel(active, n, self._n0, self._rows, observations, at, self.sensor)
        if used < 0 or not np.isfinite(nis):
            raise CovarianceError(
                f"innovation covariance of scan {self.scans} is not positive definite", wanted="finite motion and noise"
            )
        if self._n0:
            self._rows += used
        self.nis += nis
        self.nis_dof += used

    def _by_identity(self, observations: Array, known: Ints) -> tuple[Ints, list[int]]:
        slots = np.array([self._slot_of_key.get(int(k), -1) for k in known], dtype=np.int64)
        if self._n0 and np.any(self._place[slots[slots >= 0]] < 0):
            self._choose(slots[slots >= 0])
        at = np.where(slots >= 0, self._place[slots], -1) if len(self._place) else slots
        if self.config.outlier_gate > 0 and np.any(at >= 0):
            gates = gates_by_dof(self.config.outlier_gate, 2)
            d2 = innovation_kernel(self._ax, self._aP, observations, at, self.sensor)
            bad = (at >= 0) & (d2 > np.where(np.isinf(observations[:, 3]), gates[1], gates[2]))
            self.outliers += int(bad.sum())
            at = np.where(bad, -1, at)
        fresh, keys = [], set()
        for o in np.flatnonzero(slots < 0):
            if np.isinf(observations[o, 3]):
                self.unfounded += 1  # one range gives no position
            elif int(known[o]) not in keys:
                fresh.append(int(o))
                keys.add(int(known[o]))
        return at, fresh

    def _by_distance(self, observations: Array) -> tuple[Ints, list[int], Array]:
        c = self.config
        if self._n0 and len(observations):
            cross = np.vstack([self._aPhi[:3, : self._n0], self._theta]) @ self._C
            if np.any(self._distance(observations, self._passive, cross) < 1.0):
                self._choose(None, observations)
        alive = self.hits[self._active] > 0
        p = pair_observations(
            self._ax,
            self._aP,
            observations,
            self.sensor,
            gate=c.gate,
            method="jcbb" if c.association == "jcbb" else "nearest",
            max_nodes=c.max_nodes,
            alive=alive,
        )
        self.nodes += p.nodes
        self.capped += p.capped
        flat = np.isinf(observations[:, 3])
        gates, new = gates_by_dof(c.gate, 2), gates_by_dof(GATE_NEW, 2)
        far = p.nearest > np.where(flat, new[1] / gates[1], new[2] / gates[2])
        self.unfounded += int(np.count_nonzero(far & flat))
        return p.landmark, [int(o) for o in np.flatnonzero(far & ~flat)], p.polar

    def _distance(self, observations: Array, slots: Ints, cross: Array) -> Array:
        """Bound of the least distance² of any observation to each passive landmark, relative to the gate of new ones.

        cross (4, N): covariance of the pose with the whole state, and the change of that state since the last fold.
        """
        new = gates_by_dof(GATE_NEW, 2)
        weights = np.broadcast_to([1.0 / new[1], 1.0 / new[2]], (len(observations), 2))
        out = np.empty(len(slots))
        now = PoseState(self._ax[:3], self._aP[:3, :3], cross[:3], cross[3])
        passive_distance_kernel(now, slots, self._x, self._P, np.hstack([observations, weights]), self.sensor, out)
        return out

    def _drop_spurious(self, at: Ints, polar: Array) -> None:
        k = len(polar)  # landmarks created in this scan are not tested
        dropped = np.zeros(k, dtype=np.bool_)
        slots = self._active[:k]
        counts = LandmarkCounts(self.hits, self.misses, self.born)
        if misses_kernel(slots, self.scans, at, polar, counts, self._limits, dropped):
            self.hits[slots[dropped]] = 0  # marginalised out: the row stays until the active part is chosen again

    def _remember(self, q: int) -> int:
        """Allocate space for the association of ``q`` more observations; returns the index of the first."""
        while self.observations + q > len(self._founding):
            self._founding = np.pad(self._founding, (0, len(self._founding)), constant_values=IGNORED)
        return self.observations

    # ---- landmarks and the active part

    def _found(self, row: Array) -> int:
        """Add a landmark at the end of the active part; returns its slot."""
        if self._free:
            slot = self._free.pop()
        else:
            slot = self._slots
            self._slots += 1
            if slot >= len(self.hits):
                self._grow()
        self.hits[slot], self.misses[slot], self.born[slot] = 1, 0, self.scans
        self.founded[slot] = self.foundings
        self.foundings += 1
        n = 3 + 2 * len(self._active)
        if n + 2 > len(self._ax):
            self._ax = np.pad(self._ax, (0, _ROOM))
            self._aP = np.pad(self._aP, ((0, _ROOM), (0, _ROOM)))
            self._aPhi = np.pad(self._aPhi, ((0, _ROOM), (0, 0)))
        augment_kernel(self._ax, self._aP, n, self._aPhi, self._n0, row, self.sensor)
        self._place[slot] = len(self._active)
        self._active = np.append(self._active, slot)
        return slot

    def _grow(self) -> None:
        pad = 64
        self._x = np.pad(self._x, (0, 2 * pad))
        self._P = np.pad(self._P, ((0, 2 * pad), (0, 2 * pad)))
        self._C = np.pad(self._C, ((0, 0), (0, 2 * pad)))
        self.hits, self.misses, self.born, self.founded = (
            np.pad(a, (0, pad)) for a in (self.hits, self.misses, self.born, self.founded)
        )
        self._place = np.pad(self._place, (0, pad), constant_values=-1)

    def _compress(self, rows: int) -> None:
        """Allocate more rows of V; only Vᵀ V is needed, so V is replaced by its triangular factor."""
        if self._rows > self._n0:
            self._V[: self._n0] = qr(self._V[: self._rows], mode="r", check_finite=False)[0][: self._n0]
            self._rows = self._n0
        if self._rows + rows > len(self._V):
            self._V = np.pad(self._V, ((0, self._rows + rows + _ROWS - len(self._V)), (0, 0)))

    def _fold(self) -> None:
        """Write the active part, and its effect on the passive part, into the whole map."""
        n0 = self._n0
        alive = np.concatenate([[True, True, True], np.repeat(self.hits[self._active] > 0, 2)])
        mine = np.flatnonzero(alive)
        state = _columns(self._active)[alive]
        if n0:
            others = _columns(self._passive)[3:]
            if self._rows:
                V = self._V[: self._rows]
                R = V if self._rows <= n0 else qr(V, mode="r", check_finite=False)[0][:n0]
                W = R @ self._C
                # P[B, B] -= (V C)ᵀ (V C); C has only the columns of B. P.T is in Fortran order, so nothing is copied
                self._P = dsyrk(-1.0, W.T, beta=1.0, c=self._P.T, lower=0, overwrite_c=1).T
            cross = self._aPhi[mine, :n0] @ self._C[:, others]
            scatter_kernel(self._P, state, others, cross)
            self._x += self._theta @ self._C
            self.folds += 1
        self._x[state] = self._ax[mine]
        scatter_kernel(self._P, state, state, self._aP[np.ix_(mine, mine)])
        dead = self._active[self.hits[self._active] == 0]
        self._place[self._active] = -1
        self._free += [int(s) for s in dead]
        self._n0 = self._rows = 0
        self._active = self._passive = np.zeros(0, dtype=np.int64)

    def _choose(self, needed: Ints | None, observations: Array | None = None) -> None:
        """Fold, then choose the active landmarks: those near the vehicle, ``needed``, and those near observations."""
        self._fold()
        slots = np.flatnonzero(self.hits[: self._slots] > 0)
        x, y, th = self._x[:3]
        self._anchor = self._x[:2].copy()
        active = np.ones(len(slots), dtype=np.bool_)
        if len(slots) > _SMALL:
            m = ACTIVE_MARGIN
            dx, dy = self._x[3 + 2 * slots] - x, self._x[4 + 2 * slots] - y
            distance = np.hypot(dx, dy)
            bearing = np.abs((np.arctan2(dy, dx) - th - self.sensor[2] + np.pi) % (2 * np.pi) - np.pi)
            ahead = bearing < np.max(np.abs(self.field_of_view)) + np.deg2rad(20.0)
            active = (distance < self.reach + m) & (ahead | (distance < 0.3 * m))
            if self.config.association != "known":  # provisional ones are checked in every scan
                active |= self.hits[slots] < self.config.confirm_hits
            if needed is not None:
                active |= np.isin(slots, needed)
            if observations is not None:
                cross = np.vstack([self._P[:, :3].T, np.zeros(len(self._x))])
                active |= self._distance(observations, slots, cross) < _GENEROUS
        self._active, self._passive = slots[active], slots[~active]
        self._place[self._active] = np.arange(len(self._active))
        mine = _columns(self._active)
        n = len(mine)
        room = n + _ROOM
        self._ax, self._aP = np.zeros(room), np.zeros((room, room))
        self._ax[:n] = self._x[mine]
        gather_kernel(self._P, mine, mine, self._aP)
        if len(self._passive):
            self._n0 = n
            others = _columns(self._passive)[3:]
            block = np.empty((n, len(others)))
            gather_kernel(self._P, mine, others, block)
            self._C = np.zeros((n, len(self._x)))
            self._C[:, others] = block
            self._V = np.empty((_ROWS, n))
            self._theta = np.zeros(n)
        self._aPhi = np.zeros((room, self._n0))
        self._aPhi[: self._n0] = np.eye(self._n0)

    # ---- estimates

    @property
    def pose(self) -> Array:
        """x, y, θ ``(3,)``."""
        return self._ax[:3].copy()

    @property
    def pose_covariance(self) -> Array:
        """Covariance ``(3, 3)`` of the plain vector x, y, θ."""
        return self._aP[:3, :3].copy()

    def pose_std(self) -> Array:
        """Standard deviation of x, y [m] and heading [rad], ``(3,)``."""
        return np.asarray(np.sqrt(np.diag(self._aP[:3, :3])))

    @property
    def confirmed(self) -> int:
        """Number of features that are no longer provisional."""
        return int(np.count_nonzero(self.hits[: self._slots] >= self.config.confirm_hits))

    @property
    def keys(self) -> dict[int, int]:
        """Founding number of each known landmark by the ``known`` number of :meth:`step`."""
        return {k: int(self.founded[s]) for k, s in self._slot_of_key.items()}

    def association(self) -> Ints:
        """Founding number of the landmark of each observation so far ``(observations,)``; -1 = none, or deleted."""
        live = np.zeros(self.foundings + 1, dtype=np.bool_)  # the last entry represents "none"
        live[self.founded[: self._slots][self.hits[: self._slots] > 0]] = True
        a = self._founding[: self.observations]
        return np.where(live[a], a, IGNORED)

    def landmarks(self, min_hits: int) -> Ints:
        """Slots of the landmarks observed at least ``min_hits`` times, in order of founding."""
        slots = np.flatnonzero(self.hits[: self._slots] >= min_hits)
        return slots[np.argsort(self.founded[slots])]

    def joint(self, slots: Ints) -> tuple[Array, Array]:
        """Mean and covariance over ``[pose, landmarks of slots]``; folds first."""
        self._choose(None)
        ix = _columns(slots)
        P = np.empty((len(ix), len(ix)))
        gather_kernel(self._P, ix, ix, P)
        return self._x[ix], P

    def marginals(self, slots: Ints) -> tuple[Array, Array]:
        """Positions ``(L, 2)`` and covariances ``(L, 2, 2)`` of landmarks; folds first."""
        self._choose(None)
        ix = (3 + 2 * slots)[:, None] + np.arange(2)
        i, j = np.maximum(ix[:, :, None], ix[:, None, :]), np.minimum(ix[:, :, None], ix[:, None, :])
        return self._x[ix], self._P[i, j]


def _columns(slots: Ints) -> Ints:
    """Columns of the pose and of landmarks ``slots``."""
    return np.concatenate([[0, 1, 2], (3 + 2 * slots[:, None] + np.arange(2)).ravel()]).astype(np.int64)
