"""Motion and gravity of the steps as factors of the refined path, with systematic errors as states.

Increments of odometry are compared with the path, roll and pitch with gravity. Errors that persist over many steps
would give far too small covariances if they were modelled as white noise, so they are states: the bias of the yaw rate,
with a random walk; the scale of distances; the direction of the motion relative to the scanner (a wrong mounting angle
between scanner and odometry); the offset between the clocks of motion and scans; constant errors of gravity's roll and
pitch; in 2-D the turn error of wheels per metre and per radian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.poses import Group, group_of
from graphslam.core.workers import run_tasks
from graphslam.linear.block_cholesky import BlockFactor
from graphslam.refine.scans import Scans

Index = npt.NDArray[np.int64]
States = tuple[Array, ...]
"""Yaw bias at the knots ``(k,)``, constants ``(c,)``; with fixes followed by their datum and biases."""

SAMPLED = 24
"""Number of steps at which the leverage of the odometry is computed."""
LEFT = 0.02
"""Minimum remaining share of a residual (1 - leverage); smaller ones have no information on the noise."""
MEDIAN = 0.4549
"""Median of χ² of one degree of freedom."""
RARE = 10.8
"""χ² of one degree of freedom at 99.9 %."""
SCALE, SIDE, RISE, CLOCK, ROLL, PITCH, BEND, TURN = range(8)
"""Indices of the constant states: scale of distances; the scanner's direction, to the left of the motion and below it
[rad]; time by which stamps of the motion are early relative to the scans [s]; constant errors of gravity's roll and
pitch [rad]; wheel turn error per metre [rad/m] and per radian. 3-D: all but the last two. 2-D: the first, second,
fourth and the last two."""


@dataclass(frozen=True, slots=True)
class MotionTerms:
    """Whitened residuals of one kind of factor, with their variables.

    Parameters
    ----------
    r : (f, m)
    J : (f, m, Σ widths)
    nodes : (f, s) int
        Node of each slot of columns.
    widths : (s,) int
    """

    r: Array
    J: Array
    nodes: Index
    widths: tuple[int, ...]
    name: str


class MotionModel:
    """Odometry and gravity of steps as factors on the nodes of a refinement.

    Nodes are the n steps, then the knots of the yaw bias, then one node with all constant states.

    Parameters
    ----------
    knot : float
        Time between knots of the yaw bias [s].
    bridge : (n,), optional
        Share of an increment's variance that remains in the beams of its step.
    """

    def __init__(self, steps: Scans, *, knot: float = 30.0, bridge: Array | None = None) -> None:
        self.steps = steps
        self.group: Group = group_of(steps.odometry.increments)
        self.sigmas = steps.biases
        n = len(steps)
        t = steps.times
        d = self.group.dim
        span = float(t[-1] - t[0]) if n > 1 else 0.0
        self.knots = np.linspace(t[0], t[-1], max(2, int(np.ceil(span / knot)) + 1))
        self.constants = 6 if d == 3 else 5
        self.at = np.array([0, 1, 2, 3, 4, 5, -1, -1] if d == 3 else [0, 1, -1, 2, -1, -1, 3, 4])
        self.widths = np.concatenate([np.full(n, self.group.dof), np.ones(len(self.knots)), [self.constants]]).astype(
            np.int64
        )
        self.gravity = d == 3 and steps.tilt is not None
        u = steps.odometry.increments[1:]
        self.dt = np.diff(t)
        a = np.clip(np.searchsorted(self.knots, 0.5 * (t[1:] + t[:-1]), side="right") - 1, 0, len(self.knots) - 2)
        share = (0.5 * (t[1:] + t[:-1]) - self.knots[a]) / np.maximum(self.knots[a + 1] - self.knots[a], 1e-12)
        g = self.group
        xi = g.log(u)
        twist = xi / self.dt[:, None] if len(xi) else xi
        edge = np.zeros((n, g.dof))  # rate at each stamp: the mean before and after it
        if n > 2:
            edge[1:-1] = 0.5 * (twist[1:] + twist[:-1])
            edge[0], edge[-1] = twist[0], twist[-1]
        move = u[:, :d]
        B = np.zeros((n - 1, g.dof, 2 + self.constants))  # d e / d (two knots, constants)
        B[:, g.heading, 0] = -self.dt * (1.0 - share)
        B[:, g.heading, 1] = -self.dt * share
        P = np.arange(g.dof)[g.position]
        # measured odometry = true × (1 + s), rotated by the direction, with stamps early by the clock offset
        B[:, P, 2 + self.at[SCALE]] = -move
        B[:, P[0], 2 + self.at[SIDE]] = move[:, 1]
        B[:, P[1], 2 + self.at[SIDE]] = -move[:, 0]
        if d == 3:
            B[:, P[0], 2 + self.at[RISE]] = -move[:, 2]
            B[:, P[2], 2 + self.at[RISE]] = move[:, 0]
        else:
            B[:, 2, 2 + self.at[BEND]] = -move[:, 0]
            B[:, 2, 2 + self.at[TURN]] = -xi[:, 2]
        B[:, :, 2 + self.at[CLOCK]] = -(edge[1:] - edge[:-1])
        keep = np.arange(g.dof)
        if self.gravity:  # roll and pitch of the increments come from gravity and are used there
            keep = keep[2:]
        self.keep = keep
        self.bridge = np.zeros(n) if bridge is None else bridge
        C = steps.odometry.covariances[1:][:, keep][:, :, keep]
        self.covariances = C
        self.B = B
        self.scales = np.ones(len(keep))
        self.walk = 1.0
        self.nodes = np.column_stack(
            [np.arange(n - 1), np.arange(1, n), n + a, n + a + 1, np.full(n - 1, n + len(self.knots))]
        ).astype(np.int64)

    @property
    def steps_count(self) -> int:
        """Number of step nodes."""
        return len(self.steps)

    def constant_sigmas(self) -> Array:
        """Prior σ of the constant states ``(c,)``."""
        s, sigma = self.sigmas, np.zeros(self.constants)
        for place, value in zip(
            (SCALE, SIDE, RISE, CLOCK, ROLL, PITCH, BEND, TURN),
            (s.scale, s.direction, s.direction, s.clock, s.tilt, s.tilt, s.bend, s.turn),
        ):
            if self.at[place] >= 0:
                sigma[self.at[place]] = value
        return sigma

    def whiteners(self) -> Array:
        """``W`` ``(n - 1, m, m)`` with ``Wᵀ W`` = information of the increments, at their current scales."""
        s = self.scales
        L = np.linalg.cholesky(self.covariances * s[:, None] * s[None, :])
        return np.asarray(np.linalg.inv(L))

    def corrections(self, poses: Array) -> Array:
        """Error of the increment that ends at each step ``(n, d)``, right tangent; zero for the first."""
        g = self.group
        e = g.log(g.between(self.steps.odometry.increments[1:], g.between(poses[:-1], poses[1:])))
        return np.concatenate([np.zeros((1, g.dof)), e])

    @property
    def within(self) -> Array:
        """Covariance ``(n, d, d)`` of the beams of a step relative to its pose, from the motion (with its scales)."""
        C = self.steps.odometry.covariances.copy()
        s = np.ones(self.group.dof)
        s[self.keep] = self.scales
        if len(C) > 1:
            C[0] = C[1]
        return np.asarray(C * s[:, None] * s[None, :] * self.bridge[:, None, None])

    def widen(self, poses: Array, states: States, factor: BlockFactor) -> None:
        """Increase the noise of the motion if the scans show more: σ per component, and random walk of the yaw bias.

        A residual is smaller than the error because it took part in the estimate (leverage ``(J C Jᵀ)_cc / Σ_cc``), so
        the variance is the sum of squares divided by the remaining degrees of freedom (restricted maximum likelihood).
        The leverage is computed at some steps, evenly spaced. The noise is never reduced below that of the log.
        """
        g, n, K = self.group, len(self.steps), len(self.knots)
        e, J = self._increments(poses, states)
        C = np.einsum("kii->ki", self.covariances)
        some = np.unique(np.linspace(0, n - 2, min(SAMPLED, n - 1)).round().astype(np.int64))

        def leverage(k: int) -> Array:
            rows = k * g.dof + np.arange(2 * g.dof)
            rest = [self.nodes[k, 2:4] - n, K + np.arange(self.constants)]
            rows = np.concatenate([rows, n * g.dof + np.concatenate(rest)])
            P = factor.inverse_block(rows)
            return np.asarray(np.einsum("ci,ij,cj->c", J[k], P, J[k]) / (C[k] * self.scales**2))

        left = 1.0 - np.array(run_tasks(leverage, ((k,) for k in some.tolist())))
        left = np.maximum(np.mean(left, axis=0), LEFT)
        # single slips do not affect σ
        r2 = np.minimum(e**2 / C, RARE * self.scales**2)
        self.scales = np.sqrt(np.maximum(np.mean(r2, axis=0) / left, 1.0))
        q = self.sigmas.yaw_walk * np.sqrt(np.diff(self.knots))
        z = np.diff(states[0]) / np.maximum(q, 1e-12)
        P = factor.inverse_block(n * g.dof + np.arange(K))
        D = np.diff(np.eye(K), axis=0)
        left_walk = np.maximum(1.0 - np.einsum("ci,ij,cj->c", D, P, D) / (q * self.walk) ** 2, 0.0)
        # median over steps that the scans determine: one that is bent by a wrong match must not increase its own σ
        decided = left_walk > LEFT
        if np.count_nonzero(decided) >= 3:
            spread = float(np.median(z[decided] ** 2 / left_walk[decided])) / MEDIAN
            self.walk = float(np.sqrt(max(spread, 1.0)))

    def _state_rows(self, states: States) -> Array:
        bias, constants = states[:2]
        a = self.nodes[:, 2] - len(self.steps)
        return np.column_stack([bias[a], bias[a + 1], np.tile(constants, (len(a), 1))])

    def terms(self, poses: Array, states: States) -> list[MotionTerms]:
        """All factors at a path ``(n, 7|3)`` and states (yaw bias at the knots ``(k,)``, constants ``(c,)``)."""
        out = [self._odometry(poses, states), *self._priors(states)]
        if self.gravity:
            out += self._gravity(poses, states)
        return out

    def _increments(self, poses: Array, states: States) -> tuple[Array, Array]:
        """Errors of the increments ``(n - 1, m)`` and their derivatives by the two poses and the states."""
        g = self.group
        step = g.between(poses[:-1], poses[1:])
        raw = g.log(g.between(self.steps.odometry.increments[1:], step))
        e = raw - np.einsum("kij,kj->ki", self.B, self._state_rows(states))
        Jr = g.right_jacobian_inverse(raw)
        J = np.concatenate([-Jr @ g.adjoint(g.inverse(step)), Jr, -self.B], axis=2)
        return e[:, self.keep], J[:, self.keep]

    def _odometry(self, poses: Array, states: States) -> MotionTerms:
        e, J = self._increments(poses, states)
        W = self.whiteners()
        if self.group.dim == 2:
            # slipping wheels and wrong records do not affect σ: improbable increments get less weight
            r = np.einsum("kij,kj->ki", W, e)
            W = W * np.sqrt(np.minimum(1.0, SLIPPED / np.maximum(np.sum(r**2, axis=1), 1e-12)))[:, None, None]
        dof = self.group.dof
        return MotionTerms(
            np.einsum("kij,kj->ki", W, e), W @ J, self.nodes, (dof, dof, 1, 1, self.constants), "odometry"
        )

    def _priors(self, states: States) -> list[MotionTerms]:
        bias, constants = states[:2]
        s, n, K = self.sigmas, len(self.steps), len(self.knots)
        first = MotionTerms(
            np.array([[bias[0] / s.yaw_bias]]), np.array([[[1.0 / s.yaw_bias]]]), np.array([[n]]), (1,), "yaw bias"
        )
        q = np.maximum(self.walk * s.yaw_walk * np.sqrt(np.diff(self.knots)), 1e-12)
        walk = MotionTerms(
            (np.diff(bias) / q)[:, None],
            np.stack([-1.0 / q, 1.0 / q], axis=1)[:, None, :],
            np.column_stack([n + np.arange(K - 1), n + np.arange(1, K)]),
            (1, 1),
            "yaw bias walk",
        )
        sigma = self.constant_sigmas()
        fixed = MotionTerms(
            (constants / sigma)[None], np.diag(1.0 / sigma)[None], np.array([[n + K]]), (self.constants,), "constants"
        )
        return [first, walk, fixed]

    def _gravity(self, poses: Array, states: States) -> list[MotionTerms]:
        """Roll and pitch errors are an Ornstein–Uhlenbeck process: each residual is conditioned on the previous one.

        So every reading is used once, with its new information only.
        """
        steps, n = self.steps, len(self.steps)
        assert steps.tilt is not None
        seen, D = se3.roll_pitch_jacobian(poses)
        e = steps.tilt - seen - states[1][[ROLL, PITCH]]
        sigma = max(steps.tilt_sigma, 1e-5)
        phi = np.exp(-self.dt / max(steps.tilt_time, 1e-6))
        new = np.maximum(sigma * np.sqrt(1.0 - phi**2), 1e-6)
        const = n + len(self.knots)
        E = np.zeros((2, self.constants))
        E[0, ROLL] = E[1, PITCH] = 1.0
        D0 = np.concatenate([-D[:1], -E[None]], axis=2) / sigma
        first = MotionTerms(e[:1] / sigma, D0, np.array([[0, const]]), (6, self.constants), "gravity")
        J = (
            np.concatenate([phi[:, None, None] * D[:-1], -D[1:], -(1.0 - phi)[:, None, None] * E[None]], axis=2)
            / new[:, None, None]
        )
        later = MotionTerms(
            (e[1:] - phi[:, None] * e[:-1]) / new[:, None],
            J,
            np.column_stack([np.arange(n - 1), np.arange(1, n), np.full(n - 1, const)]),
            (6, 6, self.constants),
            "gravity",
        )
        return [first, later]

    def gauge(self, poses: Array, held: Array) -> MotionTerms:
        """Fix position and heading of the first pose at ``held``; roll and pitch too, if there is no gravity."""
        g = self.group
        e = g.log(g.between(held, poses[0]))
        if self.gravity:
            up = se3.quat_to_matrix(poses[0, 3:])[2]
            J = np.zeros((4, 6))
            J[0, :3] = up
            J[1:, 3:] = np.eye(3)
            r = np.concatenate([[up @ e[:3]], e[3:]])
        else:
            J, r = np.eye(g.dof), e
        return MotionTerms((r / HELD)[None], (J / HELD)[None], np.array([[0]]), (g.dof,), "gauge")


SLIPPED = 16.3
"""χ² limit of a 2-D increment (99.9 %); larger ones get less weight."""
HELD = 1e-5
"""σ of the gauge [m, rad], far below that of any measurement."""
