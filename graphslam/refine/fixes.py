"""Position fixes in a refinement: the antenna along the path, in a frame that is estimated.

At time ``t`` between two nodes the antenna is on the line between its positions at both. The frame of the fixes,
``T_gps_world``, is a state, because the first pose of the path is fixed; time-correlated errors of the fixes are
states, too, as in the graph (:mod:`graphslam.graph.sensors.gps`)::

    r = T_gps_world p + bias - z,    p = (1 - a) T_k l + a T_{k+1} l
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphslam.core import se3
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.core.records import Gps
from graphslam.graph.sensors.gps import GpsConfig, arm_jacobian, greatest_distance, start_datum
from graphslam.refine.motion import MotionModel, MotionTerms, States

FARTHEST = 3.0
"""Fixes between nodes that are farther apart are not used: the antenna path between them is unknown [m]."""
UPRIGHT = 1e-4
"""σ of the up direction in the frame of the fixes, if gravity was measured [rad]."""
LEANING = 0.5
"""… and without gravity [rad]."""
CONTRADICTED = 1.5
"""Ratio of the median χ² of fixes to its expected value above which they contradict scans and motion."""
ALIKE = 0.3
"""Autocorrelation of consecutive residuals above which, if significant, their errors are time-correlated."""
RARE = 0.999
"""A fix beyond this quantile is an outlier."""


@dataclass(frozen=True, slots=True)
class FixReport:
    """Report on the fixes in a refinement.

    Parameters
    ----------
    used, left : int
        Number of fixes in the problem; number outside the path, or in a gap of it.
    typical : float
        Ratio of the median χ² of their residuals to its expected value: about 1 if the noise model is right.
    wild : int
        Number of fixes beyond the 99.9 % quantile; the robust kernel reduces their weight.
    alike : float
        Autocorrelation of consecutive residuals; if above 0.3 and significant, errors are time-correlated.
    rms : float
        Of the distances from the fixes that are no outliers [m].
    T_gps_world : (7,) or (3,)
        From the refined path to the frame of the stream.
    """

    used: int
    left: int
    typical: float
    wild: int
    alike: float
    rms: float
    T_gps_world: Array

    @property
    def contradicted(self) -> bool:
        """Are errors of fixes larger than assumed, or time-correlated?"""
        return self.typical > CONTRADICTED or self.alike > max(ALIKE, 4.0 / np.sqrt(max(self.used, 1)))


class FixModel:
    """Fixes as factors on the nodes of a refinement, with additional nodes after those of the motion.

    These are one for the datum ``T_gps_world`` (right tangent), and one for each bias.

    Parameters
    ----------
    poses : (n, 7) or (n, 3)
        Initial path of the refinement.
    """

    def __init__(self, gps: Gps, config: GpsConfig, motion: MotionModel, poses: Array) -> None:
        self.group, t, d = group_of(poses), motion.steps.times, group_of(poses).dim
        self.gravity, self.lever, self.robust = motion.gravity, gps.lever, config.robust
        k = np.clip(np.searchsorted(t, gps.times, side="right") - 1, 0, len(t) - 2)
        length = np.linalg.norm(poses[k + 1, :d] - poses[k, :d], axis=1)
        inside = np.flatnonzero((gps.times >= t[0]) & (gps.times <= t[-1]) & (length < FARTHEST))
        self.left = len(gps.times) - len(inside)
        self.k, self.times = k[inside], gps.times[inside]
        self.share = (self.times - t[self.k]) / np.maximum(t[self.k + 1] - t[self.k], 1e-12)
        self.origin = gps.positions[inside[0]].copy() if len(inside) else np.zeros(d)
        self.positions = gps.positions[inside] - self.origin
        sigma = gps.sigma[inside] if config.sigma is None else np.full(len(inside), config.sigma)
        P = sigma[:, None, None] ** 2 * np.eye(d)
        if gps.covariances is not None and config.sigma is None:
            P = gps.covariances[inside]
        self.covariances = P
        self.whiteners = np.linalg.inv(np.linalg.cholesky(P)) if len(P) else np.zeros((0, d, d))
        self._biases(config, gps.covariances is not None)
        self.datum_node = len(motion.widths)
        self.widths = np.r_[self.group.dof, np.full(len(self.keep), d)].astype(np.int64)
        nodes = [self.k, self.k + 1, np.full(len(self.k), self.datum_node)]
        if len(self.keep):
            nodes.append(self.datum_node + 1 + self.bias)
        self.nodes = np.column_stack(nodes).astype(np.int64)
        b = self.datum_node + 1 + np.arange(len(self.keep))
        self._chain = np.column_stack([b, np.maximum(b - 1, self.datum_node + 1)])
        self._datum_nodes = np.array([[self.datum_node]])

    def ready(self, baseline: float, poses: Array) -> bool:
        """Do fixes and path span enough to determine the heading?"""
        d = self.group.dim
        if len(self.times) < 3:
            return False
        return min(greatest_distance(self.positions[:, :2]), greatest_distance(poses[self.k, :d][:, :2])) >= baseline

    def _biases(self, config: GpsConfig, uneven: bool) -> None:
        """Assign a bias to each fix, and link each bias to the previous one."""
        d = self.group.dim
        self.bias = np.zeros(len(self.times), np.int64)
        keep: list[float] = []
        roots: list[Array] = []
        begin = previous = -np.inf
        for i, t in enumerate(self.times.tolist()) if config.bias_sigma is not None else ():
            hold = config.bias_every
            if config.bias_time is not None and config.bias_sigma is not None:
                # over its validity, a bias changes by at most half the white σ
                white = float(np.trace(self.covariances[i])) / d
                hold = min(hold, config.bias_time * white / (8.0 * config.bias_sigma**2))
            if t - previous > config.segment_gap or t - begin >= hold:
                fades = config.bias_time is not None and keep
                keep.append(float(np.exp(-(t - begin) / config.bias_time)) if fades and config.bias_time else 0.0)
                P = self.covariances[i]
                shape = P / (0.5 * np.trace(P[:2, :2])) if uneven and config.bias_time is not None else np.eye(d)
                assert config.bias_sigma is not None
                roots.append(config.bias_sigma * np.sqrt(1.0 - keep[-1] ** 2) * np.linalg.cholesky(shape))
                begin = t
            self.bias[i] = len(keep) - 1
            previous = t
        self.keep = np.array(keep)
        self.bias_whiteners = np.linalg.inv(np.array(roots)) if roots else np.zeros((0, d, d))

    # --- states: datum and biases, the last two of all ----------------------------------------------------------------

    def start(self, poses: Array) -> tuple[Array, Array]:
        """Datum ``(7,)`` or ``(3,)`` from a robust rigid alignment, and biases of zero."""
        p, z = self.antennas(poses), self.positions
        sigma = np.sqrt(np.einsum("kii->k", self.covariances[:, :2, :2]) / 2.0)
        flat = start_datum(p[:, :2], z[:, :2], sigma)
        biases = np.zeros((len(self.keep), self.group.dim))
        if self.group.dim == 2:
            return flat, biases
        turn = se3.so3_exp(np.array([0.0, 0.0, flat[2]]))
        level = np.concatenate([flat[:2], [np.median(z[:, 2] - p[:, 2])], turn])
        if self.gravity:
            return level, biases
        # the up direction is unknown: 3-D fixes may determine it, if their path is not a straight line
        free, w = se3.align_se3(p, z)[0], np.sqrt(np.einsum("kii->k", self.covariances) / 3.0)
        cost = [np.median(np.linalg.norm(se3.se3_transform(T, p) - z, axis=1) / w) for T in (level, free)]
        lean = np.arccos(np.clip(se3.quat_to_matrix(np.asarray(free)[3:])[2, 2], -1.0, 1.0))
        return (np.asarray(free), biases) if cost[1] < 0.5 * cost[0] and lean < 2.0 * LEANING else (level, biases)

    def moved(self, states: States, step: Array) -> States:
        """States after a step of all scalars."""
        rest = step[len(step) - int(self.widths.sum()) :]
        g = self.group
        return (
            g.compose(states[-2], g.exp(rest[: g.dof])),
            states[-1] + rest[g.dof :].reshape(states[-1].shape),
        )

    # --- factors -----------------------------------------------------------------------------------------------------

    def antennas(self, poses: Array) -> Array:
        """Antenna positions ``(q, dim)`` at the fixes, in the frame of the path."""
        g = self.group
        lever = np.broadcast_to(self.lever, (len(self.k), g.dim))
        a, b = g.transform(poses[self.k], lever), g.transform(poses[self.k + 1], lever)
        return np.asarray(a + self.share[:, None] * (b - a))

    def residuals(self, poses: Array, states: States) -> Array:
        """``T_gps_world p + bias - z`` ``(q, dim)`` [m]."""
        e = self.group.transform(states[-2], self.antennas(poses)) - self.positions
        return np.asarray(e + states[-1][self.bias] if len(self.keep) else e)

    def terms(self, poses: Array, states: States) -> list[MotionTerms]:
        """Fixes with their kernel, priors of biases, and the up direction if gravity was measured (3-D)."""
        g, d = self.group, self.group.dim
        datum, biases = states[-2:]
        p, q = self.antennas(poses), len(self.k)
        many = np.broadcast_to(datum, (q, g.size))
        turn = arm_jacobian(many, np.zeros(d))[:, :, g.position]
        a = self.share[:, None, None]
        J = [
            (1.0 - a) * (turn @ arm_jacobian(poses[self.k], self.lever)),
            a * (turn @ arm_jacobian(poses[self.k + 1], self.lever)),
            arm_jacobian(many, p),
        ]
        widths = [g.dof, g.dof, g.dof]
        if len(self.keep):
            J.append(np.tile(np.eye(d), (q, 1, 1)))
            widths.append(d)
        e = np.einsum("kij,kj->ki", self.whiteners, self.residuals(poses, states))
        W = np.sqrt(self.robust.weight(np.sum(e**2, axis=1)))
        out = [
            MotionTerms(
                W[:, None] * e,
                W[:, None, None] * (self.whiteners @ np.concatenate(J, axis=2)),
                self.nodes,
                tuple(widths),
                "fixes",
            )
        ]
        if len(self.keep):
            before = np.vstack([np.zeros((1, d)), biases[:-1]])
            r = np.einsum("kij,kj->ki", self.bias_whiteners, biases - self.keep[:, None] * before)
            B = np.concatenate([self.bias_whiteners, -self.keep[:, None, None] * self.bias_whiteners], axis=2)
            one = self._chain[:, 0] == self._chain[:, 1]
            first = MotionTerms(r[one], B[one][:, :, :d], self._chain[one][:, :1], (d,), "biases of fixes")
            out += [first, MotionTerms(r[~one], B[~one], self._chain[~one], (d, d), "biases of fixes")]
        if d == 3:
            up = se3.quat_to_matrix(datum[3:])[2]  # the fixes' up in the frame of the path
            # d/dξ of Rᵀ e_z = [Rᵀ e_z]× ξ
            J_up = np.zeros((2, 6))
            J_up[:, :3] = se3.skew(up)[:2]
            s = UPRIGHT if self.gravity else LEANING
            out.append(MotionTerms((up[:2] / s)[None], (J_up / s)[None], self._datum_nodes, (6,), "up of fixes"))
        return out

    def report(self, poses: Array, states: States) -> FixReport:
        """Report on the residuals."""
        e = self.residuals(poses, states)
        w = np.einsum("kij,kj->ki", self.whiteners, e)
        d2 = np.sum(w**2, axis=1)
        # limit outliers, so that they do not affect the autocorrelation
        limit = chi2_quantile(RARE, self.group.dim)
        w = w / np.sqrt(np.maximum(d2 / limit, 1.0))[:, None]
        near = d2 <= limit if np.any(d2 <= limit) else np.ones(len(d2), bool)
        T = np.array(states[-2], dtype=np.float64)
        T[: self.group.dim] += self.origin
        return FixReport(
            len(self.k),
            self.left,
            float(np.median(d2) / chi2_quantile(0.5, self.group.dim)),
            int(np.count_nonzero(d2 > limit)),
            float(np.sum(w[1:] * w[:-1]) / max(np.sum(w**2), 1e-12)),
            float(np.sqrt(np.mean(np.sum(e[near] ** 2, axis=1)))),
            T,
        )
