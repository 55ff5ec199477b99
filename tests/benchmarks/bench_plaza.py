"""Plaza 1, range only: where the preset's figures come from, and how good the map is against the RTK truth.

    python tests/benchmarks/bench_plaza.py calibrate     maximum of the marginal likelihood; reads no truth
    python tests/benchmarks/bench_plaza.py score         path, beacons and NEES against the truth

The marginal likelihood of the whole log given noise and calibration is that of one smoothing of all poses and beacons
(Laplace): -½ (χ² + log det H) - Σ log σ of every increment and range, in the units of the raw ranges.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.optimize import minimize

import graphslam as gs
from graphslam.core.geometry import align_se2, se2_between, se2_compose, se2_inverse, se2_transform
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.random import SeedTree
from graphslam_frontends.landmarks.config import RangeBearingNoise, RbpfEkfConfig, StoppingConfig
from graphslam_frontends.landmarks.prepare import prepare_log
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf
from graphslam_frontends.landmarks.summarise import SmoothingProblem
from graphslam_frontends.odometry.motion import MotionNoise

FLOORS = {"floor_position": 1e-3, "floor_heading": 1e-4}


@dataclass(frozen=True)
class Model:
    """What is calibrated; σ in metres and radians per root second, range σ in metres."""

    speed_walk: float = 0.03
    yaw_walk: float = 0.003
    range_sigma: float = 0.5
    range_scale: float = 1.05
    range_offset: float = 0.0

    def config(self) -> RbpfEkfConfig:
        """The whole log as one submap."""
        return RbpfEkfConfig(
            association="known",
            max_range=1e3,
            min_hits=10,
            outlier_gate=16.0,
            motion=MotionNoise(speed=0.0, speed_walk=self.speed_walk, yaw_rate=0.0, yaw_walk=self.yaw_walk, **FLOORS),
            noise=RangeBearingNoise(
                range_sigma=self.range_sigma,
                bearing_sigma=np.inf,
                range_scale=self.range_scale,
                range_offset=self.range_offset,
            ),
            stopping=StoppingConfig(scans=10**9),
        )


class Evidence:
    """Negative log marginal likelihood of a log as a function of the model."""

    def __init__(self, log: SensorLog) -> None:
        self.log = log
        (start,) = RbpfEkf(Model().config()).submaps(log, seed=SeedTree(0))
        self.poses = start.trajectory.poses[-len(log["landmarks"].times) :]
        self.beacons = dict(zip(start.landmarks.ids.tolist(), start.landmarks.positions))

    def __call__(self, model: Model) -> float:
        d = prepare_log(self.log, model.config(), DropCounter())
        obs, rows, T = d.observations, d.rows, len(d)
        scan = np.searchsorted(obs.offsets, np.arange(len(rows)), side="right") - 1
        ids, first, rank = np.unique(obs.ids, return_index=True, return_inverse=True)
        order = np.argsort(first)
        beacon = np.argsort(order)[rank]
        start = np.array([self.beacons[int(i)] for i in ids[order]])
        increments, covariances = d.odometry.increments, d.odometry.covariances
        problem = SmoothingProblem(increments, covariances, scan, beacon, rows, obs.T_base_sensor, 0.0, 1)
        s = problem.smooth(self.poses[:T], start)
        L = np.linalg.cholesky(covariances)
        sigma = np.sqrt(rows[:, 2])

        def odometry(P):
            before = np.vstack([np.zeros((1, 3)), P[:-1]])
            e = se2_compose(se2_inverse(increments), se2_between(before, P))
            return np.linalg.solve(L, e[..., None])[..., 0]

        def ranges(P, l):
            return (np.hypot(*(P[scan, :2] - l[beacon]).T) - rows[:, 0]) / sigma

        J = _jacobian(odometry, ranges, s.poses, s.gaussian.mean[3:].reshape(-1, 2), scan, beacon)
        lu = spla.splu(
            sp.csc_matrix(J.T @ J),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        log_det = np.log(np.abs(lu.U.diagonal())).sum()
        volume = np.log(np.diagonal(L, axis1=1, axis2=2)).sum() + np.log(sigma * model.range_scale).sum()
        return float(0.5 * (s.chi2 + log_det) + volume)


def _jacobian(odometry, ranges, p, l, scan, beacon, h=1e-5):
    """Sparse Jacobian of all residuals by central differences; every second pose can be moved at once."""
    T, entries = len(p), []
    k = np.arange(T)
    for c in range(3):
        for parity in range(2):
            D = np.zeros((T, 3))
            D[parity::2, c] = h
            J = (odometry(se2_compose(p, D)) - odometry(se2_compose(p, -D))) / (2 * h)
            source = np.where(k % 2 == parity, k, k - 1)
            ok = source >= 0
            entries += [(3 * k[ok] + r, 3 * source[ok] + c, J[ok, r]) for r in range(3)]
        D = np.zeros((T, 3))
        D[:, c] = h
        J = (ranges(se2_compose(p, D), l) - ranges(se2_compose(p, -D), l)) / (2 * h)
        entries.append((3 * T + np.arange(len(scan)), 3 * scan + c, J))
    for c in range(2):
        D = np.zeros_like(l)
        D[:, c] = h
        J = (ranges(p, l + D) - ranges(p, l - D)) / (2 * h)
        entries.append((3 * T + np.arange(len(scan)), 3 * T + 2 * beacon + c, J))
    rows, columns, values = (np.concatenate(part) for part in zip(*entries))
    return sp.csc_matrix((values, (rows, columns)))


def calibrate(log: SensorLog) -> None:
    """Maximise the marginal likelihood, and say how sharp the scale and the offset of the ranges are."""
    evidence = Evidence(log)
    decode = lambda x: Model(*np.exp(x[:3]).tolist(), float(x[3]), float(x[4]))  # noqa: E731
    x = np.array([*np.log([0.03, 0.003, 0.5]), 1.05, 0.0])
    simplex = np.vstack([x, x + np.diag([0.7, -0.7, -0.3, 0.02, 0.3])])
    options = {"initial_simplex": simplex, "maxfev": 250, "xatol": 1e-3, "fatol": 0.02}
    found = minimize(lambda x: evidence(decode(x)), x, method="Nelder-Mead", options=options)
    best = decode(found.x)
    print(f"{found.nfev} evaluations, -log likelihood {found.fun:.2f}: {best}")
    for name, step in (("range_scale", 0.003), ("range_offset", 0.2), ("speed_walk", 0.01), ("yaw_walk", 2e-4)):
        values = {**best.__dict__}
        side = [evidence(Model(**{**values, name: values[name] + s * step})) - found.fun for s in (-1, 1)]
        print(f"  {name} {values[name]:.5f}: {side[0]:+.2f} at -{step:g}, {side[1]:+.2f} at +{step:g}")


def free_nees(mean, P, truth, *, scale: bool) -> float:
    """NEES of points after the best rigid (or similarity) alignment in the metric of P: χ² with 2n - 3 (4) dof."""
    points, W = mean.reshape(-1, 2), np.linalg.inv(P)

    def cost(x):
        e = (np.exp(x[3] if scale else 0.0) * se2_transform(x[:3], truth) - points).ravel()
        return e @ W @ e

    options = {"maxiter": 8000, "maxfev": 8000, "xatol": 1e-8, "fatol": 1e-6}
    return float(minimize(cost, [*align_se2(truth, points), 0.0], method="Nelder-Mead", options=options).fun)


def score(log: SensorLog) -> None:
    """Path and beacons against the truth, after rigid alignment."""
    truth = log.truth
    beacons = dict(zip(truth.landmark_ids.tolist(), truth.landmarks))
    rms = lambda e: float(np.sqrt(np.mean(np.sum(e**2, axis=1))))  # noqa: E731
    for frontend in ("rbpf-slam", "rbpf-ekf"):
        run = gs.run(log, frontend=frontend, solver="batch", progress=False)
        s = run.solution
        path = run.map.trajectory
        inside = (path.times >= truth.trajectory.times[0]) & (path.times <= truth.trajectory.times[-1])
        there, here = truth.trajectory.interpolate(path.times[inside])[:, :2], path.poses[inside, :2]
        L = np.array([beacons[int(i)] for i in s.landmark_ids])
        off_path = rms(se2_transform(align_se2(here, there), here) - there)
        off_beacons = rms(se2_transform(align_se2(s.landmarks, L), s.landmarks) - L)
        print(f"{frontend}: {len(run.submaps)} submaps, path {off_path:.3f} m, beacons {off_beacons:.3f} m")
        P = s.joint_covariance()
        n = 3 * (len(s.poses) - 1)
        ix = np.concatenate([3 * k + np.arange(2) for k in range(len(s.poses) - 1)] + [np.arange(n, len(P))])
        ends = truth.trajectory.interpolate([m.interval[1] for m in run.submaps])[:, :2]
        mean, points = np.vstack([s.poses[1:, :2], s.landmarks]), np.vstack([ends, L])
        for label, scale in (("rigid", False), ("similarity", True)):
            dof = 2 * len(points) - 3 - scale
            nees = free_nees(mean, P[np.ix_(ix, ix)], points, scale=scale)
            print(f"  NEES of submap ends and beacons, {label}: {nees:.1f} with {dof} dof")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["calibrate", "score"], nargs="?", default="score")
    parser.add_argument("--quick", action="store_true", help="the score alone, which takes seconds")
    args = parser.parse_args()
    {"calibrate": calibrate, "score": score}["score" if args.quick else args.what](gs.load("plaza1"))
