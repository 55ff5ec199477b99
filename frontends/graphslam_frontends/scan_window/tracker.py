"""Scan-to-window odometry: each scan is matched to the surfaces of the last seconds, with a consistent covariance.

The state is the current pose and the systematic errors of motion and gravity (yaw-rate bias, scale and direction of the
wheels, constant and time-correlated errors of roll and pitch). Each step predicts by the motion and corrects by gravity
and the scan: point-to-plane distances (in 2-D point-to-line) to the surfaces seen in the last seconds.

These surfaces have the errors of the poses from which they were seen. A filter that ignores them treats each scan as
matched to an exact map and is overconfident. So the poses of the window stay in the error state: every distance depends
on two poses with correlated errors. Older poses are considered, not corrected (Schmidt–Kalman filter), so the result is
causal. The covariances of the current pose, the window poses and the first pose of the submap are joint. In the
covariance of the end pose of a submap the errors common to start and end cancel, and the errors common to the window
stay. Unobservable directions, as along a corridor, get no information, and their covariance grows with the motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, rotation_matrices
from graphslam.registration.plane_kernels import PlanePairs, no_noise_correction, plane_blocks, plane_residuals
from graphslam.registration.surfaces import SURFACE, fit_places, thin_places
from graphslam_frontends.grid.motion import with_roll_pitch
from graphslam_frontends.grid.weights import evenly_spaced_indices
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.scan_window.config import DISTANCES, LEAST_POINTS, MOST_STEPS, SPENT, ScanWindowConfig
from graphslam_frontends.scan_window.observability import (
    CLEARLY,
    direction_strengths,
    full_rank_information,
    observable_directions,
)

Index = npt.NDArray[np.int64]

FREE_TILT = 0.02
"""σ of roll and pitch of the motion of a step if gravity is measured [rad]: gravity already determined them."""
LAY = {2: 1.0, 3: 4.0}
"""Default batch duration for surfaces in 2-D and 3-D [s]."""
TILT_NOISE = 1e-5
"""White noise of roll and pitch by gravity, besides time-correlated and constant errors [rad]."""
NORMAL_SIGMA = 0.03
"""σ of the normal of a surface [rad]; it sets the level of spurious information."""
LEAST_OVERLAP = 0.1
"""A scan with a smaller share of its points on surfaces is lost: it is not used for a correction."""
MOST_SPREAD = 0.15
"""A scan with residuals of a larger spread is lost [m]."""
SURPRISE = 40.0
"""A scan is lost if the χ² of its correction is larger (up to six degrees of freedom)."""


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """Result of the match of the scan of a step.

    Parameters
    ----------
    pairs : int
        Number of points on surfaces.
    overlap : float
        Their share of the points used; nan if there is no window yet.
    spread : float
        1.48 × the median absolute residual [m].
    surprise : float
        χ² of the correction.
    lost : str
        Why the scan is not used; "" if it is; "start" if there was no window yet.
    """

    pairs: int
    overlap: float
    spread: float
    surprise: float
    lost: str


class ScanToWindowOdometry:
    """Track the steps of a log one by one."""

    def __init__(self, steps: Steps, config: ScanWindowConfig) -> None:
        self.steps, self.config = steps, config
        self.group = g = group_of(steps.odometry.increments)
        self.gravity = steps.tilt is not None
        self.sigmas = s = steps.bias_sigmas
        w, self.w = g.dof, g.dof
        # systematic errors: yaw bias, scale, side (, rise (, constant roll and pitch, time-correlated roll and pitch))
        prior = [s.yaw_bias, s.scale, s.direction]
        if g.dim == 3:
            prior.append(s.direction)
        self.motion_states = len(prior)
        if self.gravity:
            prior += [s.tilt, s.tilt, steps.tilt_sigma, steps.tilt_sigma]
        self.x = w + len(prior)  # size of pose and systematic errors together
        self.biases = np.zeros(len(prior))
        self.slots = MOST_STEPS + 1
        self.ANCHOR, self.NOW = self.slots, self.slots + 1
        n = self.x + (self.slots + 1) * w
        self.P = np.zeros((n, n))
        diagonal = np.zeros(self.x)
        diagonal[w:] = np.square(prior)
        if self.gravity:
            diagonal[:2] = 0.1**2
        self.P[range(self.x), range(self.x)] = diagonal
        self.pose = np.array(g.identity)
        if self.gravity:
            assert steps.tilt is not None
            self.pose = with_roll_pitch(self.pose[None], steps.tilt[:1])[0]
        # the window: steps by slot, points of a slot in as many rows as the longest scan has
        self.rows = max(int(np.diff(steps.offsets).max(initial=1)), 1)
        self.points = np.zeros(((self.slots + 2) * self.rows, g.dim))
        self.origins = np.zeros_like(self.points)
        self.normals = np.zeros_like(self.points)
        self.R = np.zeros((self.slots + 2, g.dim, g.dim))
        self.t = np.zeros((self.slots + 2, g.dim))
        self.lay = config.lay if config.lay is not None else LAY[g.dim]
        self.free = list(range(self.slots))[::-1]
        self.lots: list[list[tuple[int, int, float]]] = []  # (slot, points, time) of the steps of each batch
        self.waiting: list[tuple[int, int, float]] = []
        self.flat: list[Index] = []  # rows of the surfaces of each batch
        self.places: list[Index] = []
        self.tree: cKDTree | None = None
        self.tree_rows = np.zeros(0, np.int64)
        self.last_laid = -np.inf
        self._lately, self._seen_at = np.zeros((2, w, w)), self.pose
        self.k = -1

    # --- one step ----------------------------------------------------------------------------------------------------

    def step(self) -> ScanMatch:
        """Process the next step of the log."""
        self.k += 1
        if self.k:
            self._move()
        if self.gravity:
            self._level()
        found = self._see()
        self._lay()
        return found

    def begin(self) -> None:
        """Start a submap at the current pose: its joint covariance with all later poses is kept."""
        self._clone(self.ANCHOR)

    @property
    def joint(self) -> Array:
        """Joint covariance ``(2 d, 2 d)`` of the first pose of the submap and the current pose, right tangents."""
        a = self.x + self.ANCHOR * self.w
        rows = np.concatenate([np.arange(a, a + self.w), np.arange(self.w)])
        return self.P[np.ix_(rows, rows)]

    # --- motion and gravity ------------------------------------------------------------------------------------------

    def _move(self) -> None:
        k, g, w, x = self.k, self.group, self.w, self.x
        u, dt = self.steps.odometry.increments[k], float(self.steps.times[k] - self.steps.times[k - 1])
        m = self.motion_states
        B = bias_effects(u, dt)
        step = g.compose(u, g.exp(B @ self.biases[:m]))
        Q = np.zeros((x, x))
        C = self.steps.odometry.covariances[k].copy()
        if self.gravity:
            C[:2], C[:, :2] = 0.0, 0.0
            C[0, 0] = C[1, 1] = FREE_TILT**2
        Q[:w, :w] = C
        Q[w, w] = self.sigmas.yaw_walk**2 * dt
        F = np.eye(x)
        F[:w, :w] = g.adjoint(g.inverse(step))
        F[:w, w : w + m] = B
        if self.gravity:
            phi = np.exp(-dt / max(self.steps.tilt_time, 1e-6))
            fading = np.arange(x - 2, x)
            F[fading, fading] = phi
            self.biases[-2:] *= phi
            Q[fading, fading] = self.steps.tilt_sigma**2 * (1.0 - phi**2)
        P = self.P
        P[:x, x:] = F @ P[:x, x:]
        P[x:, :x] = P[:x, x:].T
        P[:x, :x] = F @ P[:x, :x] @ F.T + Q
        self.pose = g.compose(self.pose, step)

    def _level(self) -> None:
        """Correct roll and pitch by gravity, with its constant and time-correlated errors."""
        assert self.steps.tilt is not None
        seen, D = se3.roll_pitch_jacobian(self.pose[None])
        H = np.zeros((2, self.x))
        H[:, :6] = D[0]
        H[:, -4:-2] = H[:, -2:] = np.eye(2)
        r = self.steps.tilt[self.k] - seen[0] - self.biases[-4:-2] - self.biases[-2:]
        gain = self._gain(H, np.zeros((2, 0)), np.zeros(0, np.int64), TILT_NOISE**2)
        self._correct(gain, r)

    # --- corrections -------------------------------------------------------------------------------------------------

    def _gain(self, H: Array, G: Array, slots: Index, noise: float) -> tuple[Array, Array, Array]:
        """Schmidt–Kalman gain of residuals with Jacobians ``H`` (state) and ``G`` (considered slots).

        Returns
        -------
        K : (x, m)
        HP : (m, n)
        S : (m, m)
        """
        x, P = self.x, self.P
        HP = H @ P[:x]
        if len(slots):
            at = (x + slots[:, None] * self.w + np.arange(self.w)).ravel()
            HP += G @ P[at]
            S = HP[:, :x] @ H.T + HP[:, at] @ G.T
        else:
            S = HP[:, :x] @ H.T
        S = S + noise * np.eye(len(S))
        K = np.linalg.solve(S, HP[:, :x]).T
        return np.asarray(K), HP, S

    def _correct(self, gain: tuple[Array, Array, Array], r: Array) -> None:
        """Correct the state and its covariances by residuals."""
        (K, HP, S), x, P = gain, self.x, self.P
        d = K @ r
        P[:x, x:] -= K @ HP[:, x:]
        P[x:, :x] = P[:x, x:].T
        own = P[:x, :x] - K @ S @ K.T
        P[:x, :x] = 0.5 * (own + own.T)
        # Errors common to the current pose and the window may be metres, and they are in the axes of the pose. So they
        # must be rotated with it; otherwise scans would seem to observe a part of them, and covariances would be
        # inconsistent.
        turned = self.group.adjoint(self.group.exp(-d[: self.w]))
        P[: self.w] = turned @ P[: self.w]
        P[:, : self.w] = P[:, : self.w] @ turned.T
        self.pose = self.group.compose(self.pose, self.group.exp(d[: self.w]))
        self.biases = self.biases + d[self.w :]

    # --- the scan ----------------------------------------------------------------------------------------------------

    def _see(self) -> ScanMatch:
        points, origins, returns = self.steps.scan(self.k)
        hit = np.flatnonzero(returns)
        p = hit[evenly_spaced_indices(len(hit), self.config.points)]
        if self.tree is None:
            return ScanMatch(0, np.nan, np.nan, 0.0, "start")
        g, w = self.group, self.w
        if len(p) < LEAST_POINTS:
            return ScanMatch(len(p), 0.0, np.nan, 0.0, "points")
        first = self.NOW * self.rows
        source = first + np.arange(len(p))
        self.points[source], self.origins[source] = points[p], origins[p]
        towards = origins[p] - points[p]
        d = np.zeros(self.x)
        lately = self._seen(self.pose)  # the corrections below rotate it by a negligible angle
        for distance in DISTANCES:
            pose = g.compose(self.pose, g.exp(d[:w]))
            R = self._place(self.NOW, pose)
            W = points[p] @ R.T + pose[: g.dim]
            _, at = self.tree.query(W, k=1, distance_upper_bound=distance)
            near = np.flatnonzero(at < len(self.tree_rows))
            q = self.tree_rows[at[near]]
            slot = q // self.rows
            facing = np.einsum("kij,kj,ki->k", self.R[slot], self.normals[q], towards[near] @ R.T) > 0
            near, q, slot = near[facing], q[facing], slot[facing]
            overlap = len(near) / len(p)
            if len(near) < LEAST_POINTS or overlap < LEAST_OVERLAP:
                return ScanMatch(len(near), overlap, np.nan, 0.0, "overlap")
            n = len(near)
            pairs = PlanePairs(source[near], q, np.full(n, self.NOW), slot)
            r = np.empty(n)
            plane_residuals(pairs, self.R, self.t, self.points, self.normals, r)
            scatter = 1.4826 * float(np.median(np.abs(r)))
            sigma = max(SPENT * scatter, 0.1 * distance)
            information = 1.0 / (1.0 + (r / (2.0 * sigma)) ** 2) ** 2 / sigma**2
            slots = np.unique(slot)
            L, G, b = self._blocks(pairs, information, slots)
            # the measurement: Jᵀ Λ r in the observable directions, each with unit noise
            every = full_rank_information(points[p][near], information)
            seen = np.stack([L, every])
            M = observable_directions(L, every, NORMAL_SIGMA, self._unobservable(lately + seen))
            H = np.zeros((len(M), self.x))
            H[:, :w] = M @ L @ g.adjoint(g.exp(-d[:w]))  # from the axes of the pose before corrections
            y = M @ (L @ d[:w] - b)
            gain = self._gain(H, M @ G, slots, 1.0)
            d = gain[0] @ y
        surprise = float(y @ np.linalg.solve(gain[2], y))
        lost = "spread" if scatter > MOST_SPREAD else "surprise" if surprise > SURPRISE else ""
        self._lately, self._seen_at = (1.0 - self.config.spacing / self.lay) * lately + seen, pose
        if not lost:
            self._correct(gain, y)
        return ScanMatch(n, overlap, scatter, surprise, lost)

    def _unobservable(self, seen: Array) -> Array:
        """Directions ``(w, m)`` that no recent scan constrains, this one included, for example along a corridor."""
        values, V = direction_strengths(seen[0], seen[1], NORMAL_SIGMA)
        return V[:, values <= CLEARLY]

    def _seen(self, pose: Array) -> Array:
        """Information of recent scans, observed and full-rank ``(2, w, w)``, in the axes of a pose."""
        A = self.group.adjoint(self.group.between(self._seen_at, pose))
        return np.asarray(A.T @ self._lately @ A)

    def _blocks(self, pairs: PlanePairs, information: Array, slots: Index) -> tuple[Array, Array, Array]:
        """Information of the current pose ``(w, w)``, with the slots ``(w, w·s)``, and ``Jᵀ Λ r`` ``(w,)``."""
        w, m = self.w, self.slots + 2
        H, g = np.zeros(2 * m * w * w), np.zeros((m, w))
        rank = np.ones(m, np.int64)
        rank[self.NOW] = 0
        begin = np.arange(m, dtype=np.int64) * w * w
        plane_blocks(
            pairs, (self.R, self.t), (self.points, self.normals), information,
            (begin, m * w * w + begin[pairs.j], rank), no_noise_correction(self.group.dim), H, g,
        )  # fmt: skip
        blocks = H.reshape(2, m, w, w)
        return blocks[0, self.NOW], np.concatenate(list(blocks[1, slots]), axis=1), g[self.NOW]

    def _place(self, slot: int, pose: Array) -> Array:
        self.R[slot], self.t[slot] = rotation_matrices(pose[None])[0], pose[: self.group.dim]
        return self.R[slot]

    # --- the window --------------------------------------------------------------------------------------------------

    def _clone(self, slot: int) -> None:
        """Copy the current pose to a slot of the error state."""
        x, w, P = self.x, self.w, self.P
        a = x + slot * w
        P[a : a + w] = P[:w]
        P[:, a : a + w] = P[:, :w]

    def _lay(self) -> None:
        """Store the scan for the next batch; make surfaces if a batch is complete."""
        now = float(self.steps.times[self.k])
        if now - self.last_laid >= self.config.spacing - 1e-6:
            points, origins, returns = self.steps.scan(self.k)
            n = int(returns.sum())
            if n:
                if not self.free:
                    self._drop(1)
                slot = self.free.pop()
                row = slot * self.rows
                self.points[row : row + n], self.origins[row : row + n] = points[returns], origins[returns]
                self.normals[row : row + n] = 0.0
                self._place(slot, self.pose)
                self._clone(slot)
                self.waiting.append((slot, n, now))
                self.last_laid = now
        if self.waiting and now - self.waiting[0][2] >= self.lay - 1e-6:
            self._make_surfaces(now)

    def _drop(self, lots: int) -> None:
        for lot in self.lots[:lots]:
            self.free += [slot for slot, _, _ in lot]
        del self.lots[:lots], self.flat[:lots], self.places[:lots]
        self._plant()

    def _make_surfaces(self, now: float) -> None:
        """A batch is complete: subsample it, and make surfaces of the previous batch, which now has both neighbours."""
        old = sum(lot[-1][2] < now - self.config.seconds for lot in self.lots)
        if old:
            self._drop(old)
        lot, self.waiting = self.waiting, []
        rows = np.concatenate([slot * self.rows + np.arange(n) for slot, n, _ in lot])
        stands = np.arange(len(rows))
        self.lots.append(lot)
        self.places.append(rows[thin_places(self._world(rows)[0], 0, len(rows), SURFACE.spacing, stands)])
        self.flat.append(np.zeros(0, np.int64))
        c = max(len(self.lots) - 2, 0)  # the first batch gets surfaces at once: better few neighbours than no window
        around = self.places[max(c - 1, 0) : c + 2]
        own, near = self.places[c], np.concatenate(around)
        at = (len(around[0]) if c else 0) + np.arange(len(own))
        W, O = self._world(near)
        normals, _, flat = fit_places(W, O[at], at, np.arange(len(near)), SURFACE)
        self.normals[own] = np.einsum("kji,kj->ki", self.R[own // self.rows], normals)
        self.flat[c] = own[flat]
        self._plant()

    def _world(self, rows: Index) -> tuple[Array, Array]:
        slot = rows // self.rows
        R, t = self.R[slot], self.t[slot]
        return (
            np.einsum("kij,kj->ki", R, self.points[rows]) + t,
            np.einsum("kij,kj->ki", R, self.origins[rows]) + t,
        )

    def _plant(self) -> None:
        """Build the search tree of all surfaces of the window."""
        self.tree_rows = np.concatenate([np.zeros(0, np.int64), *self.flat])
        self.tree = cKDTree(self._world(self.tree_rows)[0]) if len(self.tree_rows) else None


def bias_effects(u: Array, dt: float) -> Array:
    """Effect ``(d, 3|4)`` of the systematic errors on a motion ``u``: yaw bias, scale, and direction.

    The odometry is true × (1 + scale), rotated to the right (and in 3-D downwards) by the direction, plus ``bias · dt``
    of heading; so the true motion is ``u ∘ Exp(effects @ states)``, to first order.
    """
    d = 2 if len(u) == 3 else 3
    moved = np.zeros((d, d))  # displacement of the end, in the axes of the start
    moved[:, 0] = -u[:d]
    moved[:2, 1] = u[1], -u[0]
    if d == 3:
        moved[0, 2], moved[2, 2] = -u[2], u[0]
    g = group_of(u)
    B = np.zeros((g.dof, 1 + d))
    B[g.heading, 0] = -dt
    B[g.position, 1:] = rotation_matrices(u[None])[0].T @ moved
    return B


@dataclass(frozen=True)
class TrackedPath:
    """A tracked path.

    Parameters
    ----------
    poses : (n, 7) or (n, 3)
        In the frame of the first pose; in 3-D with gravity, its levelled frame.
    joints : (n, 2 d, 2 d)
        Joint covariance of the first pose of the submap and the pose of the step, right tangents. A step between two
        submaps belongs to the first of them.
    biases : (n, m)
        Yaw bias [rad/s], scale, direction … after each step.
    """

    poses: Array
    joints: Array
    biases: Array
    found: tuple[ScanMatch, ...]


def track_steps(steps: Steps, config: ScanWindowConfig, starts: Iterable[int] = ()) -> TrackedPath:
    """Track all steps; submaps begin at the first step and at the steps ``starts``."""
    t = ScanToWindowOdometry(steps, config)
    n, begins = len(steps), {0, *starts}
    poses, joints = np.empty((n, t.group.size)), np.empty((n, 2 * t.w, 2 * t.w))
    biases, found = np.empty((n, len(t.biases))), []
    for k in range(n):
        found.append(t.step())
        if k == 0:
            t.begin()
        poses[k], joints[k], biases[k] = t.pose, t.joint, t.biases
        if k in begins:
            t.begin()
    return TrackedPath(poses, joints, biases, tuple(found))
