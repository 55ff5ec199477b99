"""IMU factors on recorded readings: a flying IMU with a surveyed position now and then, and a carried lidar's path.

``python -m tests.benchmarks.bench_imu_recorded [euroc|carried] [--quick]``

``euroc``: EuRoC machine hall 01. No front end at all: submaps of one second that know next to nothing, the IMU by its
data sheet, and a position of the tracked prism every so many seconds; the other positions are predicted.
``carried``: the path that ships with the gtsam_points samples, and its IMU. Its turns are those of this very IMU, so
what it shows is that ways and path are consistent, not that anything is gained.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import GraphSlamError
from graphslam.core.imu import GRAVITY, Imu, ImuNoise
from graphslam.core.poses import SE3
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.residual_consistency import class_consistency
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.gps import level_datum_pose
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.factors.imu.preintegration import preintegrate
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.graph.sensors.imu import ImuFactors
from graphslam.io.euroc import read_euroc
from graphslam.solve.batch import BatchSolver
from tests.conftest import data_root

PRISM = np.array([7.48903e-02, -1.84772e-02, -1.20209e-01])
CONSUMER = ImuNoise(
    gyro=1e-3, gyro_bias=0.02, gyro_walk=1e-4, accelerometer=1e-2, accelerometer_bias=0.1, accelerometer_walk=1e-3
)
"""Of a small unit whose data sheet is not in the set: assumed."""
CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


def level_from(force: np.ndarray) -> np.ndarray:
    """Quaternion ``(4,)`` of a body in a level frame, heading zero, from the force it feels at rest."""
    up = force / np.linalg.norm(force)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    s, c = np.linalg.norm(axis), up[2]
    return se3.so3_exp(axis / max(s, 1e-12) * np.arctan2(s, c))


def turned_on(start: np.ndarray, imu: Imu, at: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Attitudes ``(n, 4)`` at ``at`` ``(n,)`` by the gyro alone, from that at the first."""
    q = [start]
    for R in preintegrate(imu, at[:-1], at[1:], bias).R:
        q.append(se3.quat_multiply(q[-1], se3.matrix_to_quat(R)))
    return np.array(q)


def flown(
    imu: Imu, at: np.ndarray, points: np.ndarray, body: np.ndarray, heading: float, sigma: float
) -> FactorGraph | None:
    """The graph of a flight at its optimum; None where it has none.

    Parameters
    ----------
    at : (n,)
        Times of the nodes [s].
    points, body : (n, 3), (n, 4)
        Positions of the prism, and attitudes to start from.
    heading : float
        Of the first body in the frame of the positions, to start from [rad].
    """
    path = np.concatenate([se3.quat_rotate(se3.so3_exp([0.0, 0.0, heading]), points - points[0]), body], axis=1)
    path[:, :3] -= se3.quat_rotate(body, np.tile(PRISM, (len(body), 1)))
    g = FactorGraph(3)
    frame = np.append(path[0, :3], [0.0, 0.0, 0.0, 1.0])  # the first base is level, the others stand as the body does
    for k in range(len(at) - 1):
        local = SE3.between(np.stack([frame, frame]), path[k : k + 2])
        P = np.diag(np.repeat([0.5, 3.0], 3) ** 2)  # a stretch of which nothing is known
        rows = Trajectory(at[k : k + 2], local, np.stack([1e-12 * np.eye(6), P]))
        g.add_submap(
            Submap(key=k, interval=(at[k], at[k + 1]), exit_pose=local[1], exit_covariance=P, trajectory=rows,
                   uses=frozenset({"nothing"}))
        )  # fmt: skip
        frame = path[k + 1]
    g.add_attitude(0, [0.0, 0.0, -1.0], 0.2, evidence="prior")
    fixes = Gps(times=at, positions=points, sigma=np.full(len(at), sigma), lever=PRISM)
    g.add_sensor(fixes, config=GpsConfig(baseline=0.3))
    g.finish_sensors()
    if g.values.datum is None:
        return None
    g.add_sensor(imu, config=ImuConfig(axes="ignore"))
    try:
        solver = BatchSolver(g)
        solver.solve_to_optimum()
        for _ in range(5):
            if not ImuFactors.of(g).recentre():
                break
            solver.solve_to_optimum()
    except GraphSlamError:
        return None
    return g


def euroc(
    root: Path, every: float, *, sigma: float = 0.01, length: float = 170.0, scale: float = 1.0, late: float = 0.0
) -> str:
    """One line: what a position every ``every`` seconds and the IMU say of all other positions.

    Parameters
    ----------
    scale : float
        Factor on the densities of the data sheet.
    late : float
        Taken off the stamps of the positions [s].
    """
    log = read_euroc(root / "euroc_mh01_imu_leica", sigma=sigma, late=late, noise_scale=scale)
    imu, tz, z = log["imu"], log["leica"].times, log["leica"].positions
    keep = [k for k in range(len(tz)) if 1.0 < tz[k] < length]
    nodes = [keep[0]]
    for k in keep:
        if tz[k] - tz[nodes[-1]] >= every - 0.01:
            nodes.append(k)
    at, points = tz[nodes], z[nodes]
    # a start: attitudes by the gyro alone from the force of the first second, as if it stood still then
    first = imu.times < 1.0
    bias = np.concatenate([imu.angular_rate[first].mean(axis=0), np.zeros(3)])
    body = turned_on(level_from(imu.specific_force[first].mean(axis=0)), imu, np.append(1.0, at), bias)[1:]
    # how the frame of the positions lies is not known: the best of some headings over the first stretch
    n = int(np.searchsorted(at, 60.0))
    tried = []
    for heading in np.deg2rad(np.arange(0, 360, 60)):
        short = flown(imu, at[:n], points[:n], body[:n], heading, sigma)
        if short is not None:
            tried.append((short.objective().total, short.values.datum[3], short.values.imu_biases[-1]))
    if not tried:
        return f"every {every:g} s: no start leads anywhere"
    _, heading, bias = min(tried, key=lambda row: row[0])
    body = turned_on(body[0], imu, at, bias)  # by the bias that the short solution found
    g = flown(imu, at, points, body, -heading, sigma)
    if g is None:
        return f"every {every:g} s: no start leads anywhere"
    withheld = np.array([k for k in keep if k not in set(nodes) and at[0] < tz[k] < at[-1]])
    T_gps = level_datum_pose(g.values.datum, g.values.tilt)
    states = ImuFactors.of(g).states()
    node_at = np.array([s.node for s in g.submaps])
    which = np.searchsorted(at, tz[withheld], side="right") - 1
    v = g.values.velocities[[states.velocity[n] for n in node_at[which]]]
    b = g.values.imu_biases[[states.bias[n] for n in node_at[which]]]
    pim = preintegrate(imu, at[which], tz[withheld], b)
    first_body = np.concatenate([np.zeros(3), body[0]])
    poses = g.values.poses.copy()
    poses[0] = SE3.compose(poses[0], first_body)  # the body on the level first base
    X, T = poses[node_at[which]], pim.seconds[:, None]
    up = se3.quat_rotate(T_gps[3:] * CONJUGATE, [0.0, 0.0, 1.0])
    p = X[:, :3] + v * T - 0.5 * GRAVITY * T**2 * up + se3.quat_rotate(X[:, 3:], pim.p)
    turned = se3.quat_multiply(X[:, 3:], se3.matrix_to_quat(pim.R))
    seen = SE3.transform(T_gps, p + se3.quat_rotate(turned, np.tile(PRISM, (len(p), 1)))) + g.gps_origin
    wrong = np.linalg.norm(seen - z[withheld], axis=1)
    line = np.array([np.interp(tz[withheld], at, c) for c in points.T]).T
    straight = np.linalg.norm(line - z[withheld], axis=1)
    last = states.bias[states.order[-1]]
    s = np.sqrt(np.diag(g.covariance().marginal(f"imubias{last}")))
    chi2 = ", ".join(
        f"{n} {c.ratio:.2f} ({c.dof:.0f})" for n, c in class_consistency(g).items() if np.isfinite(c.ratio)
    )
    return (
        f"every {every:g} s, noise × {scale:g}, {late:g} s late: {len(withheld)} withheld; "
        f"RMSE {np.sqrt(np.mean(wrong**2)):.3f} m (median {np.median(wrong):.3f}); straight lines "
        f"{np.sqrt(np.mean(straight**2)):.3f} m "
        f"(median {np.median(straight):.3f}); gyro bias {np.round(g.values.imu_biases[last, :3], 4)} ± {s[0]:.1e}, "
        f"force bias {np.round(g.values.imu_biases[last, 3:], 3)} ± {s[3]:.1e}; χ²/dof (dof) {chi2}"
    )


def carried(root: Path, drift: float, seed: int = 0) -> str:
    """One line: the shipped path, made to drift by ``drift`` a step of half a second, with and without the IMU."""
    folder = root / "gtsam_points_samples" / "continuous"
    a, b = np.loadtxt(folder / "imu.txt"), np.loadtxt(folder / "traj.txt")
    t0 = b[0, 0]
    imu = Imu(times=a[:, 0] - t0, angular_rate=a[:, 4:7], specific_force=a[:, 1:4], noise=CONSUMER)
    times, poses = b[::5, 0] - t0, b[::5, 1:]
    inside = (times > imu.times[0]) & (times < imu.times[-1])
    times, poses = times[inside], poses[inside]
    rng, step = np.random.default_rng(seed), drift * np.array([2e-3, 2e-3, 2e-3, 0.01, 0.01, 0.01])
    moves = SE3.between(poses[:-1], poses[1:])
    seen = SE3.compose(moves, SE3.exp(step * rng.standard_normal((len(moves), 6))))
    Q, out = np.diag(step**2), []
    for use in (False, True):
        g = FactorGraph(3)
        for k in range(0, len(seen) - 20, 20):
            path, P = [SE3.identity], [1e-12 * np.eye(6)]
            for m in seen[k : k + 20]:
                path.append(SE3.compose(path[-1], m))
                ad = SE3.adjoint(SE3.inverse(m))
                P.append(ad @ P[-1] @ ad.T + Q)
            rows = Trajectory(times[k : k + 21], np.array(path), np.array(P))
            g.add_submap(
                Submap(key=k, interval=(times[k], times[k + 20]), exit_pose=path[-1], exit_covariance=P[-1],
                       trajectory=rows, uses=frozenset({"lidar"})),
                spacing=0.5,
            )  # fmt: skip
        down = -se3.quat_rotate(poses[0, 3:] * CONJUGATE, [0.0, 0.0, 1.0])
        g.add_attitude(0, down, 0.02, evidence="prior")
        if use:
            g.add_sensor(imu, config=ImuConfig(axes="warn"))
        solver = BatchSolver(g)
        solver.solve_to_optimum()
        while use and ImuFactors.of(g).recentre():
            solver.solve_to_optimum()
        ends = np.array([s.node for s in g.submaps])
        begun = np.searchsorted(times, [s.interval[0] for s in g.submaps])
        T, _ = se3.align_se3(g.values.poses[ends, :3], poses[begun, :3])
        off = SE3.transform(T, g.values.poses[ends, :3]) - poses[begun, :3]
        out.append(f"{'with' if use else 'without'} {np.sqrt(np.mean(np.sum(off**2, axis=1))):.3f} m")
    axes = [e for e in g.events if e["event"] == "imu-axes"]
    states, score = ImuFactors.of(g).states(), class_consistency(g)
    bias = g.values.imu_biases[states.bias[states.order[-1]]]
    return (
        f"drift × {drift:g}: aligned {', '.join(out)}; axes {axes[-1]['verdict']}; "
        f"{sum(r.group == 'imu' for r in g.records.values())} ways, bias {np.round(bias, 4)}; χ²/dof "
        + ", ".join(f"{n} {c.ratio:.2f} ({c.dof:.0f})" for n, c in score.items() if np.isfinite(c.ratio))
    )


def main(which: str, *, quick: bool = False) -> None:
    """Print the lines."""
    root = data_root()
    if root is None:
        print("set GRAPHSLAM_DATA")
        return
    if which in ("all", "euroc"):
        cases = (
            *((1.0, 0.14, 3.0), (2.0, 0.14, 3.0), (5.0, 0.14, 3.0)),
            *((1.0, 0.0, 1.0), (1.0, 0.05, 1.0), (1.0, 0.1, 1.0), (1.0, 0.14, 1.0), (1.0, 0.2, 1.0)),
        )
        for every, late, scale in cases[:1] if quick else cases:
            print(euroc(root, every, scale=scale, late=late), flush=True)
    if which in ("all", "carried"):
        for drift in (1.0,) if quick else (1.0, 5.0):
            print(carried(root, drift), flush=True)


def command() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("which", nargs="?", default="all", choices=("all", "euroc", "carried"))
    parser.add_argument("--quick", action="store_true", help="one line of each")
    return parser.parse_args()


if __name__ == "__main__":
    args = command()
    main(args.which, quick=args.quick)
