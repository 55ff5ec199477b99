"""Smoothing of a log in windows, and the marginal likelihood of its noise (poses and landmarks integrated out).

Each window is a chain of poses with separate landmarks; all windows share the constants (biases, scales, angles). With
Laplace's approximation the negative log-likelihood of the standard deviations is

    ½ χ² + ½ ln det H + Σ ln σ

at the optimum: H is block-tridiagonal in the poses, bordered by landmarks, visits and constants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from graphslam.calibrate import kernels as K
from graphslam.calibrate import residual_kernels as R
from graphslam.core.geometry import Array

Ints = npt.NDArray[np.int64]
CONSTANTS = (
    "yaw_bias",
    "distance_scale",
    "turn_per_metre",
    "turn_scale",
    "range_scale",
    "range_offset",
    "sensor_yaw",
)
"""In the order of the kernels: rad/s, ln of the factor, rad/m, rad/rad, factor - 1, m, rad."""
PRIOR = np.array([0.1, 0.2, 0.1, 0.2, 0.2, 0.5, 0.2])
"""Prior σ of each constant."""
SIGMAS = (
    "along_metre",
    "along_second",
    "lateral_metre",
    "heading_metre",
    "heading_radian",
    "heading_second",
    "range",
    "bearing",
    "visit_range",
    "visit_bearing",
    "floor_position",
    "floor_heading",
)
"""In the order of the kernels: m/√m, m/√s, m/√m, rad/√m, rad/√rad, rad/√s, m, rad, m, rad, m, rad."""
CHI2_CLASS = dict(zip(SIGMAS, (0, 0, 1, 2, 2, 2, 3, 4, 3, 4, 0, 2)))
"""Class of the residuals that each σ weights: index in ``Work.chi2``."""
START = {
    **{"along_metre": 0.05, "along_second": 0.02, "lateral_metre": 0.03, "heading_metre": 0.01},
    **{"heading_radian": 0.02, "heading_second": 0.005, "range": 0.2, "bearing": 0.02},
    **{"visit_range": 0.1, "visit_bearing": 0.01, "floor_position": 1e-3, "floor_heading": 1e-4},
}
WIDTH = 2.0
"""Prior σ of the logarithm of each standard deviation about :data:`START`."""


@dataclass(slots=True)
class SmoothingWindow:
    """A part of the log with a separate frame and separate landmarks.

    Parameters
    ----------
    times : (n,)
        Stamps of the poses [s].
    steps : (n, 8)
        dx, dy, turn, seconds in motion, metres, from the previous pose; row 0 is zero. Then variances that replace
        those of the noise model if they are above 0.
    first : (n + 1,) int64
        Observations of pose k are rows ``first[k]:first[k + 1]``.
    detections : (q, 2)
        Range [m] and bearing [rad]; NaN where there is no bearing.
    slots : (q, 2) int64
        Landmark, and visit or -1, as row indices of ``nuisance``.
    kinds : (M,) int64
        0 a landmark, 1 a visit.
    rows : (q,) int64
        Index of each observation in the stream.
    poses : (n, 3)
    nuisance : (M, 2)
    """

    times: Array
    steps: Array
    first: Ints
    detections: Array
    slots: Ints
    kinds: Ints
    rows: Ints
    poses: Array
    nuisance: Array


@dataclass(slots=True)
class Smoothing:
    """Windows with their states, and the constants and σ that all windows share.

    Parameters
    ----------
    sensor : (3,)
        Pose of the sensor in the base frame.
    free : tuple of str
        Constants that are estimated; the others are fixed.
    constants : (7,)
    sigmas : mapping of str to float
        All of :data:`SIGMAS`.
    fitted : tuple of str
        Standard deviations that are estimated.
    """

    windows: list[SmoothingWindow]
    sensor: Array
    free: tuple[str, ...]
    fitted: tuple[str, ...]
    constants: Array = field(default_factory=lambda: np.zeros(K.CONSTANTS))
    sigmas: dict[str, float] = field(default_factory=lambda: dict(START))
    covariance: Array = field(default_factory=lambda: np.full((K.CONSTANTS, K.CONSTANTS), np.nan))
    _memory: list[K.Work] = field(default_factory=list)

    def copy(self, **changes: object) -> Smoothing:
        """Copy with independent states."""
        windows = [replace(w, poses=w.poses.copy(), nuisance=w.nuisance.copy()) for w in self.windows]
        return replace(
            self,
            **{"windows": windows, "constants": self.constants.copy(), "sigmas": dict(self.sigmas)} | changes,  # type: ignore[arg-type]
            _memory=[],
        )

    @property
    def _index(self) -> Ints:
        return np.array([CONSTANTS.index(c) for c in self.free], dtype=np.int64)

    def _parameters(self) -> Array:
        return np.array([self.sigmas[s] for s in SIGMAS])

    def _buffers(self) -> list[K.Work]:
        if len(self._memory) != len(self.windows):
            self._memory = []
            for w in self.windows:
                (n, D), M, m = w.poses.shape, len(w.nuisance), K.HEAD + 2 * most_open_nuisances(w)
                shapes = ((n, D, D), (n, D, D), (n, D, m), (m, m), (6,), (2 * M, m + D), (2 * M,))
                self._memory.append(K.Work(*(np.zeros(s) for s in shapes), *np.zeros((3, M), dtype=np.int64)))
        return self._memory

    def _eliminated(self, p: Array, damping: float = 0.0) -> tuple[float, float, Array, Array]:
        """ln det, Σ ln σ, information of the constants ``(HEAD, HEAD)``, and χ² by class."""
        logdet, volume, S, chi2 = 0.0, 0.0, np.zeros((K.HEAD, K.HEAD)), np.zeros(6)
        for w, work in zip(self.windows, self._buffers()):
            data = R.Data(w.steps, w.first, w.detections, w.slots, w.kinds)
            a, b = K.eliminate_window(w.poses, w.nuisance, self.constants, data, self.sensor, p, damping, work)
            logdet, volume = logdet + a, volume + b
            S += work.S[: K.HEAD, : K.HEAD]
            chi2 += work.chi2
        return logdet, volume, np.triu(S) + np.triu(S, 1).T, chi2

    def _with_prior(self, S: Array) -> tuple[Array, Array, float]:
        """Information matrix and right-hand side of the free constants, and χ² with their prior."""
        i = self._index
        W = 1.0 / PRIOR[i] ** 2
        H = S[np.ix_(i, i)] + np.diag(W)
        return H, S[i, K.RHS] - W * self.constants[i], float(S[K.RHS, K.RHS] + np.sum(W * self.constants[i] ** 2))

    def objective(self, sigmas: Mapping[str, float] | None = None) -> float:
        """Negative log-likelihood at the optimum of the problem linearised at the current states [nats]."""
        if sigmas is not None:
            kept, self.sigmas = self.sigmas, {**self.sigmas, **sigmas}
            try:
                return self.objective()
            finally:
                self.sigmas = kept
        return self._likelihood()[0]

    def _likelihood(self) -> tuple[float, Array]:
        """:meth:`objective`, and the second moments ``(HEAD, HEAD)`` of the constants and of -1 in row RHS."""
        logdet, volume, S, _ = self._eliminated(self._parameters())
        H, h, chi2 = self._with_prior(S)
        i, moments = self._index, np.zeros((K.HEAD, K.HEAD))
        moments[K.RHS, K.RHS] = 1.0
        if len(h):
            step = np.linalg.solve(H, h)
            chi2 -= float(h @ step)
            logdet += float(np.linalg.slogdet(H)[1])
            moments[np.ix_(i, i)] = np.linalg.inv(H) + np.outer(step, step)
            moments[i, K.RHS] = moments[K.RHS, i] = -step
        value = 0.5 * chi2 + 0.5 * logdet + volume + float(np.sum(np.log(PRIOR[i])))
        value += sum(0.5 * (np.log(self.sigmas[s] / START[s]) / WIDTH) ** 2 for s in self.fitted)
        return value if np.isfinite(value) else 1e12, moments

    def gradient(self) -> tuple[float, Array]:
        """:meth:`objective`, and its derivative by ln of each fitted standard deviation [nats]."""
        value, moments = self._likelihood()
        out = np.array([np.log(self.sigmas[s] / START[s]) / WIDTH**2 for s in self.fitted])
        if value == 1e12:  # no elimination to go back from
            return value, out
        p, fitted = self._parameters(), [SIGMAS.index(s) for s in self.fitted]
        for w, work in zip(self.windows, self._memory):
            data = R.Data(w.steps, w.first, w.detections, w.slots, w.kinds)
            out += K.differentiate_window(w.poses, w.nuisance, self.constants, data, self.sensor, p, moments, work)[
                fitted
            ]
        return value, out

    def total(self) -> float:
        """χ² of all residuals and priors at the current states."""
        return self._total(self._eliminated(self._parameters()))

    def _total(self, eliminated: tuple[float, float, Array, Array]) -> float:
        """χ² of all residuals and priors where the windows were linearised; NaN if they could not be eliminated."""
        i = self._index
        return float(eliminated[3].sum() + np.sum((self.constants[i] / PRIOR[i]) ** 2) + 0.0 * eliminated[0])

    def gain_without_distances(self, count: int, every: int = 1) -> list[Array]:
        """Decrease of χ² without ``count`` distances from each ``every``-th step on; χ²(count) for the true noise."""
        p, out = self._parameters(), []
        for w, work in zip(self.windows, self._buffers()):

            def chi2(steps: Array, w: SmoothingWindow = w, work: K.Work = work) -> float:
                data = R.Data(steps, w.first, w.detections, w.slots, w.kinds)
                K.eliminate_window(w.poses, w.nuisance, self.constants, data, self.sensor, p, 0.0, work)
                return float(work.S[K.RHS, K.RHS])

            whole, gain = chi2(w.steps), []
            for k in range(0, len(w.poses) - count, every):
                steps = w.steps.copy()
                steps[k + 1 : k + 1 + count, 5] = 1e6
                gain.append(whole - chi2(steps))
            out.append(np.array(gain))
        return out

    def converge(self, iterations: int = 20, tolerance: float = 1e-3) -> float:
        """Gauss-Newton, with Levenberg-Marquardt damping after a failed step; returns χ²."""
        p, damping, value = self._parameters(), 0.0, np.inf
        i = self._index
        current = self._eliminated(p)
        for _ in range(iterations):
            now = self._total(current)
            if not np.isfinite(now):
                damping = max(10.0 * damping, 1e-4)
                if damping > 1e6:
                    break
                current = self._eliminated(p, damping)
                continue
            H, h, _ = self._with_prior(current[2])
            step = np.zeros(K.CONSTANTS)
            step[i] = np.linalg.solve(H, h) if len(i) else 0.0
            kept = [(w.poses, w.nuisance) for w in self.windows], self.constants
            for w, work in zip(self.windows, self._buffers()):
                dp, dn = np.zeros_like(w.poses), np.zeros_like(w.nuisance)
                K.substitute_window(work, step, dp, dn)
                w.poses, w.nuisance = w.poses + dp, w.nuisance + dn
            self.constants = self.constants + step
            less = 0.1 * damping if damping > 1e-6 else 0.0
            current = self._eliminated(p, less)  # χ² of this step, and the start of the next one
            value = self._total(current)
            if not value <= now + 1e-9 * now + 1e-9:
                for w, (poses, nuisance) in zip(self.windows, kept[0]):
                    w.poses, w.nuisance = poses, nuisance
                self.constants = kept[1]
                damping, value = max(10.0 * damping, 1e-4), now
                if damping > 1e6:
                    break
                current = self._eliminated(p, damping)
                continue
            damping = less
            if now - value < tolerance * max(1.0, 1e-3 * now):
                break
        return value

    def fit(self, *, rounds: int = 4, tolerance: float = 0.05) -> float:
        """Maximum-likelihood standard deviations, with states and constants; returns the objective.

        Each round minimises the objective of the problem linearised at the states, then updates the states with the
        standard deviations found.
        """
        self.converge()
        names = list(self.fitted)
        value = self.objective()
        for _ in range(rounds if names else 0):
            x0, scale = np.log([self.sigmas[s] for s in names]), self._fisher_scale(names)

            def negative(y: Array, x0: Array = x0, scale: Array = scale) -> tuple[float, Array]:
                self.sigmas.update(dict(zip(names, np.exp(x0 + y / scale).tolist())))
                value, gradient = self.gradient()
                return value, gradient / scale

            found = minimize(
                negative,
                np.zeros(len(names)),
                method="L-BFGS-B",
                jac=True,
                bounds=[(-3.0 * a, 3.0 * a) for a in scale],
                options={
                    "ftol": tolerance / max(abs(value), 1.0),
                    # in units of scale the Hessian is about 1: half the squared gradient is the possible decrease
                    "gtol": np.sqrt(2.0 * tolerance / len(names)),
                    "maxfun": 100,
                    "maxls": 10,
                },
            )
            moved = found.x / scale
            self.sigmas.update(dict(zip(names, np.exp(x0 + moved).tolist())))
            self.converge(6)
            before, value = value, self.objective()
            if before - value < 10.0 * tolerance and float(np.max(np.abs(moved))) < 0.1:
                break
        self._constants_covariance()
        return value

    def _fisher_scale(self, names: list[str]) -> Array:
        """√ of the Fisher information of ln σ of each standard deviation: about 2 χ² of its residuals, plus prior."""
        chi2 = self._eliminated(self._parameters())[3]
        return np.array([np.sqrt(2.0 * chi2[CHI2_CLASS[s]] + WIDTH**-2) for s in names])

    def _constants_covariance(self) -> None:
        i = self._index
        H, _, _ = self._with_prior(self._eliminated(self._parameters())[2])
        self.covariance = np.full((K.CONSTANTS, K.CONSTANTS), np.nan)
        if len(i):
            self.covariance[np.ix_(i, i)] = np.linalg.inv(H)

    def residuals(self) -> list[Array]:
        """Whitened residuals of the observations ``(q, 2)`` per window; NaN without a bearing."""
        g, s = self.constants, self.sigmas
        seen = []
        for w in self.windows:
            k = np.repeat(np.arange(len(w.poses)), np.diff(w.first))
            x = w.poses[k]
            c, si = np.cos(x[:, 2]), np.sin(x[:, 2])
            o = np.column_stack([c * self.sensor[0] - si * self.sensor[1], si * self.sensor[0] + c * self.sensor[1]])
            d = w.nuisance[w.slots[:, 0]] - x[:, :2] - o
            visit = np.where(w.slots[:, 1:] >= 0, w.nuisance[w.slots[:, 1]], 0.0)
            r = (1 + g[R.RANGE_SCALE]) * np.hypot(d[:, 0], d[:, 1]) + g[R.RANGE_OFFSET] + visit[:, 0]
            b = np.arctan2(d[:, 1], d[:, 0]) - x[:, 2] - self.sensor[2] - g[R.SENSOR_YAW] + visit[:, 1]
            b = np.pi - np.mod(np.pi - (b - w.detections[:, 1]), 2 * np.pi)
            seen.append(np.column_stack([(r - w.detections[:, 0]) / s["range"], b / s["bearing"]]))
        return seen


def most_open_nuisances(w: SmoothingWindow) -> int:
    """Maximal number of nuisances of a window that are active at one pose (between first and last observation)."""
    k = np.repeat(np.arange(len(w.poses)), np.diff(w.first))
    change = np.zeros(len(w.poses) + 1, dtype=np.int64)
    for j in range(len(w.nuisance)):
        mine = k[(w.slots == j).any(axis=1)]
        if len(mine):
            change[mine[0]] += 1
            change[mine[-1] + 1] -= 1
    return int(np.cumsum(change).max(initial=0))


def keep_observations(smoothing: Smoothing, keep: Sequence[npt.NDArray[np.bool_]]) -> Smoothing:
    """The smoothing with a subset of its observations; windows with at most 3 observations are dropped."""
    windows = []
    for w, good in zip(smoothing.windows, keep):
        windows.append(rebuild_window(w, good))
    return smoothing.copy(windows=[w for w in windows if len(w.detections) > 3])


def rebuild_window(w: SmoothingWindow, good: npt.NDArray[np.bool_]) -> SmoothingWindow:
    """A window with a subset of its observations; drops landmarks with fewer than 2 (4 in range-only windows)."""
    good = good.copy()
    landmark = w.slots[:, 0]
    least = 2 if np.isfinite(w.detections[:, 1]).any() else 4
    counts = np.bincount(landmark[good], minlength=len(w.nuisance))
    good &= counts[landmark] >= least
    k = np.repeat(np.arange(len(w.poses)), np.diff(w.first))[good]
    slots, order = renumber_slots(w.slots[good])
    return SmoothingWindow(
        times=w.times,
        steps=w.steps,
        first=np.searchsorted(k, np.arange(len(w.poses) + 1)).astype(np.int64),
        detections=np.ascontiguousarray(w.detections[good]),
        slots=slots,
        kinds=np.ascontiguousarray(w.kinds[order]),
        rows=w.rows[good],
        poses=w.poses.copy(),
        nuisance=np.ascontiguousarray(w.nuisance[order]),
    )


def renumber_slots(slots: Ints) -> tuple[Ints, Ints]:
    """Slots ``(q, 2)`` renumbered in the order of their first observation, and the old number of each new one."""
    flat = slots.ravel()
    names, first, inverse = np.unique(flat, return_index=True, return_inverse=True)
    order = np.argsort(first)
    order = order[names[order] >= 0]
    rank = np.full(len(names), -1, dtype=np.int64)
    rank[order] = np.arange(len(order))
    return np.ascontiguousarray(rank[inverse].reshape(slots.shape)), names[order].astype(np.int64)
