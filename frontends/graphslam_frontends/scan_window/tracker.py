"""Scan-to-window odometry: where each scan lies on the surfaces of the seconds before it, and how sure that is.

The state is the pose of now, with the errors of motion and gravity that last (bias of the yaw rate, scale and direction
of the wheels, roll and pitch that gravity gets wrong, constant and fading). Each step the motion moves it, gravity and
the scan correct it: point-to-plane distances (in the plane, point-to-line) to the surfaces that the steps of the last
seconds saw.

These surfaces lie where those steps were *thought* to be. A filter that takes them for the world believes each scan as
if it were measured against a fixed map, and promises a path many times better than it is. So the poses of the window
stay in the error state, as they were when their scans were laid: every distance is a statement on the difference of two
poses, of which the older one is also uncertain, in ways that they share. Older poses are not corrected any more
(Schmidt's filter, in which they are *considered*): what was said of a step stays said, whatever comes later, and the
covariance of the pose of now, of any pose of the window, and of the start of the submap are joint. The exit of a submap
gets its covariance from that joint one, so that what start and end have in common leaves it, and what the
window shares stays in. Directions that no surface holds, as along a corridor, get no information, and their covariance
grows as the motion's does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.registration.plane_kernels import PlanePairs, no_noise_correction, plane_blocks, plane_residuals
from graphslam.registration.surfaces import SURFACE, fit_places, rotations, thin_places
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
"""σ of roll and pitch of a step's motion where gravity tells them [rad]: they were made of gravity's own readings."""
LAY = {2: 1.0, 3: 4.0}
"""How long scans are gathered for surfaces where nobody says so [s]."""
TOLD = 1e-5
"""σ of what gravity says beside its fading and its constant error [rad]."""
NORMAL_SIGMA = 0.03
"""σ of the normal of a surface [rad]: what surfaces hold must be clearly more than it would pretend to."""
LEAST_OVERLAP = 0.1
"""A scan of whose points a smaller share lies on surfaces is lost: it corrects nothing."""
MOST_SPREAD = 0.15
"""… and one whose residuals are spread wider than this [m]."""
SURPRISE = 40.0
"""… and one whose correction is this far from what the motion allows (χ² of up to six degrees of freedom)."""


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """What the scan of a step said.

    Parameters
    ----------
    pairs : int
        Points on surfaces.
    overlap : float
        Their share of the points looked for; nan where there is no window yet.
    spread : float
        1.48 × the median absolute residual [m].
    surprise : float
        χ² of the correction.
    lost : str
        Why the scan corrected nothing; "" if it did; "start" where there was no window to be lost in.
    """

    pairs: int
    overlap: float
    spread: float
    surprise: float
    lost: str


class ScanToWindowOdometry:
    """Follows the steps of a log one by one."""

    def __init__(self, steps: Steps, config: ScanWindowConfig) -> None:
        self.steps, self.config = steps, config
        self.group = g = group_of(steps.odometry.increments)
        self.gravity = steps.tilt is not None
        self.sigmas = s = steps.bias_sigmas
        w, self.w = g.dof, g.dof
        # lasting states: yaw bias, scale, side (, rise (, constant roll and pitch, fading roll and pitch))
        prior = [s.yaw_bias, s.scale, s.direction]
        if g.dim == 3:
            prior.append(s.direction)
        self.motion_states = len(prior)
        if self.gravity:
            prior += [s.tilt, s.tilt, steps.tilt_sigma, steps.tilt_sigma]
        self.x = w + len(prior)  # of pose and lasting states together
        self.lasting = np.zeros(len(prior))
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
        self.lots: list[list[tuple[int, int, float]]] = []  # (slot, points, time) of the steps of each lot
        self.waiting: list[tuple[int, int, float]] = []
        self.flat: list[Index] = []  # rows of the surfaces of each lot
        self.places: list[Index] = []
        self.tree: cKDTree | None = None
        self.tree_rows = np.zeros(0, np.int64)
        self.last_laid = -np.inf
        self._lately, self._seen_at = np.zeros((2, w, w)), self.pose
        self.k = -1

    # --- one step ----------------------------------------------------------------------------------------------------

    def step(self) -> ScanMatch:
        """Follow the next step of the log."""
        self.k += 1
        if self.k:
            self._move()
        if self.gravity:
            self._level()
        found = self._see()
        self._lay()
        return found

    def begin(self) -> None:
        """A submap begins at the pose of now: its joint covariance with all later ones is kept."""
        self._clone(self.ANCHOR)

    @property
    def joint(self) -> Array:
        """Joint covariance ``(2 d, 2 d)`` of the pose where the submap began and the pose of now, right tangents."""
        a = self.x + self.ANCHOR * self.w
        rows = np.concatenate([np.arange(a, a + self.w), np.arange(self.w)])
        return self.P[np.ix_(rows, rows)]

    # --- motion and gravity ------------------------------------------------------------------------------------------

    def _move(self) -> None:
        k, g, w, x = self.k, self.group, self.w, self.x
        u, dt = self.steps.odometry.increments[k], float(self.steps.times[k] - self.steps.times[k - 1])
        m = self.motion_states
        B = bias_effects(u, dt)
        step = g.compose(u, g.exp(B @ self.lasting[:m]))
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
            self.lasting[-2:] *= phi
            Q[fading, fading] = self.steps.tilt_sigma**2 * (1.0 - phi**2)
        P = self.P
        P[:x, x:] = F @ P[:x, x:]
        P[x:, :x] = P[:x, x:].T
        P[:x, :x] = F @ P[:x, :x] @ F.T + Q
        self.pose = g.compose(self.pose, step)

    def _level(self) -> None:
        """Roll and pitch as gravity tells them, with their constant and their fading error."""
        assert self.steps.tilt is not None
        seen, D = se3.roll_pitch_jacobian(self.pose[None])
        H = np.zeros((2, self.x))
        H[:, :6] = D[0]
        H[:, -4:-2] = H[:, -2:] = np.eye(2)
        r = self.steps.tilt[self.k] - seen[0] - self.lasting[-4:-2] - self.lasting[-2:]
        gain = self._gain(H, np.zeros((2, 0)), np.zeros(0, np.int64), TOLD**2)
        self._correct(gain, r)

    # --- corrections -------------------------------------------------------------------------------------------------

    def _gain(self, H: Array, G: Array, slots: Index, noise: float) -> tuple[Array, Array, Array]:
        """Schmidt's gain for residuals that depend on the state by ``H`` and on considered slots by ``G``.

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
        """Correct the state by residuals, and the covariances with it."""
        (K, HP, S), x, P = gain, self.x, self.P
        d = K @ r
        P[:x, x:] -= K @ HP[:, x:]
        P[x:, :x] = P[:x, x:].T
        own = P[:x, :x] - K @ S @ K.T
        P[:x, :x] = 0.5 * (own + own.T)
        # What now and the window share, an error of the whole map, may be metres, and is told in the axes of the pose:
        # they turn with it. Else it would seem that scans saw some of it, and what they do see would count for less.
        turned = self.group.adjoint(self.group.exp(-d[: self.w]))
        P[: self.w] = turned @ P[: self.w]
        P[:, : self.w] = P[:, : self.w] @ turned.T
        self.pose = self.group.compose(self.pose, self.group.exp(d[: self.w]))
        self.lasting = self.lasting + d[self.w :]

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
        lately = self._seen(self.pose)  # the corrections to come turn it by next to nothing
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
            # what is measured: Jᵀ Λ r, of as many directions as surfaces hold, each of unit noise
            every = full_rank_information(points[p][near], information)
            seen = np.stack([L, every])
            M = observable_directions(L, every, NORMAL_SIGMA, self._unheld(lately + seen))
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

    def _unheld(self, seen: Array) -> Array:
        """Directions ``(w, m)`` that nothing has held lately, this scan included: along a corridor, say."""
        values, V = direction_strengths(seen[0], seen[1], NORMAL_SIGMA)
        return V[:, values <= CLEARLY]

    def _seen(self, pose: Array) -> Array:
        """What scans held of late, and what they would have along every axis ``(2, w, w)``, in the axes of a pose."""
        A = self.group.adjoint(self.group.between(self._seen_at, pose))
        return np.asarray(A.T @ self._lately @ A)

    def _blocks(self, pairs: PlanePairs, information: Array, slots: Index) -> tuple[Array, Array, Array]:
        """Information of the pose of now ``(w, w)``, with the slots ``(w, w·s)``, and ``Jᵀ Λ r`` ``(w,)``."""
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
        self.R[slot], self.t[slot] = rotations(pose[None])[0], pose[: self.group.dim]
        return self.R[slot]

    # --- the window --------------------------------------------------------------------------------------------------

    def _clone(self, slot: int) -> None:
        """The pose of now stays in the error state."""
        x, w, P = self.x, self.w, self.P
        a = x + slot * w
        P[a : a + w] = P[:w]
        P[:, a : a + w] = P[:, :w]

    def _lay(self) -> None:
        """Put the scan by for the next lot; make surfaces of a lot that is full."""
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
        """A lot is full: thin it, and make surfaces of the lot before, whose neighbours on both sides are there now."""
        old = sum(lot[-1][2] < now - self.config.seconds for lot in self.lots)
        if old:
            self._drop(old)
        lot, self.waiting = self.waiting, []
        rows = np.concatenate([slot * self.rows + np.arange(n) for slot, n, _ in lot])
        stands = np.arange(len(rows))
        self.lots.append(lot)
        self.places.append(rows[thin_places(self._world(rows)[0], 0, len(rows), SURFACE.spacing, stands)])
        self.flat.append(np.zeros(0, np.int64))
        c = max(len(self.lots) - 2, 0)  # the first lot of all at once: better a poor window than none
        around = self.places[max(c - 1, 0) : c + 2]
        own, near = self.places[c], np.concatenate(around)
        begin = len(around[0]) if c else 0
        W, O = self._world(near)
        normals, _, flat = fit_places(W, O, begin + np.arange(len(own)), np.arange(len(near)), SURFACE)
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
        """The tree of all surfaces of the window."""
        self.tree_rows = np.concatenate([np.zeros(0, np.int64), *self.flat])
        self.tree = cKDTree(self._world(self.tree_rows)[0]) if len(self.tree_rows) else None


def bias_effects(u: Array, dt: float) -> Array:
    """What errors that last take off a motion ``u``: ``(d, 3|4)``, for a yaw bias, a scale, and a direction.

    The odometry is measured = true × (1 + scale), led astray to the right (and in space downwards) by the direction,
    with ``bias · dt`` more of heading; so the true motion is ``u ∘ Exp(effects @ states)``, to first order.
    """
    d = 2 if len(u) == 3 else 3
    moved = np.zeros((d, d))  # of the end, in the axes of the beginning
    moved[:, 0] = -u[:d]
    moved[:2, 1] = u[1], -u[0]
    if d == 3:
        moved[0, 2], moved[2, 2] = -u[2], u[0]
    g = group_of(u)
    B = np.zeros((g.dof, 1 + d))
    B[g.heading, 0] = -dt
    B[g.position, 1:] = rotations(u[None])[0].T @ moved
    return B


@dataclass(frozen=True)
class TrackedPath:
    """A tracked path.

    Parameters
    ----------
    poses : (n, 7) or (n, 3)
        In the frame of the first pose, in space with gravity a level one.
    joints : (n, 2 d, 2 d)
        Joint covariance of the pose where the submap of each step began, and of the step's own, right tangents. A step
        where one submap ends and the next begins belongs to the one that ends.
    lasting : (n, m)
        Yaw bias [rad/s], scale, direction … after each step.
    """

    poses: Array
    joints: Array
    lasting: Array
    found: tuple[ScanMatch, ...]


def track_steps(steps: Steps, config: ScanWindowConfig, starts: Iterable[int] = ()) -> TrackedPath:
    """Follow all steps; submaps begin at the first step and at the steps ``starts``."""
    t = ScanToWindowOdometry(steps, config)
    n, begins = len(steps), {0, *starts}
    poses, joints = np.empty((n, t.group.size)), np.empty((n, 2 * t.w, 2 * t.w))
    lasting, found = np.empty((n, len(t.lasting))), []
    for k in range(n):
        found.append(t.step())
        if k == 0:
            t.begin()
        poses[k], joints[k], lasting[k] = t.pose, t.joint, t.lasting
        if k in begins:
            t.begin()
    return TrackedPath(poses, joints, lasting, tuple(found))
