"""Small files as g2o, GTSAM, TORO, iSAM, Kimera-RPGO and evo publish them reach the optimum of bare GTSAM.

Each file is written here from a list of factors. GTSAM gets the same list, not the file.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.solve_file import solve_file

N = 10
PAIRS = (*((k, k + 1) for k in range(N - 1)), (0, N - 1), (1, 6), (2, 8))
TURNED = np.array([3, 4, 5, 0, 1, 2])
"""Rotation first to translation first, and back."""


class World:
    """Poses on a turn, and noisy relative poses with correlated information in GTSAM's order."""

    def __init__(self, dim: int, seed: int = 1, information: Callable[[], np.ndarray] | None = None) -> None:
        self.rng, self.dim, self.dof = np.random.default_rng(seed), dim, 3 if dim == 2 else 6
        self.poses = [gtsam.Pose2() if dim == 2 else gtsam.Pose3()]
        step = np.array([1.0, 0.1, 0.5] if dim == 2 else [0.1, 0.2, 0.5, 1.0, 0.1, 0.2])
        for _ in range(N - 1):
            self.poses.append(self.poses[-1].compose(type(self.poses[0]).Expmap(step)))
        self.edges: list[tuple[int, int, Any, np.ndarray]] = []
        self.factors: list[Any] = []
        self.values = gtsam.Values()
        for k, pose in enumerate(self.poses):
            self.values.insert(k, pose)
        for i, j in PAIRS:
            omega = information() if information else self.information(self.dof)
            self.edges.append((i, j, self.measured(self.poses[i].between(self.poses[j]), omega), omega))
            self.factors.append(self.called("BetweenFactorPose")(*self.edges[-1][:3], noise(omega)))

    def called(self, name: str) -> Any:
        """Class of GTSAM of this dimension."""
        return getattr(gtsam, f"{name}{self.dim}")

    def information(self, size: int) -> np.ndarray:
        A = self.rng.normal(size=(size, size))
        return np.asarray(100.0 * (A @ A.T + np.eye(size)))

    def measured(self, pose: Any, omega: np.ndarray) -> Any:
        return pose.retract(self.rng.multivariate_normal(np.zeros(self.dof), np.linalg.inv(omega)))

    def fix(self) -> None:
        """The first pose."""
        self.factors.append(self.called("NonlinearEqualityPose")(0, self.poses[0]))

    def objective(self) -> float:
        """``Σ rᵀ Ω r`` at the optimum of GTSAM."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in self.factors:
            graph.add(factor)
        options = gtsam.LevenbergMarquardtParams()
        options.setRelativeErrorTol(1e-15)
        options.setAbsoluteErrorTol(1e-15)
        return float(2.0 * graph.error(gtsam.LevenbergMarquardtOptimizer(graph, self.values, options).optimize()))


def noise(omega: np.ndarray) -> Any:
    return gtsam.noiseModel.Gaussian.Information(omega)


def row(*parts: Any) -> str:
    return " ".join(format(float(v), ".17g") for part in parts for v in np.atleast_1d(part))


def upper(A: np.ndarray) -> np.ndarray:
    return np.asarray(A[np.triu_indices(len(A))])


def pose_row(pose: Any, *, euler: bool = False, longer: float = 1.0) -> str:
    """``x y θ``, ``x y z qx qy qz qw`` or ``x y z roll pitch yaw``."""
    if isinstance(pose, gtsam.Pose2):
        return row(pose.x(), pose.y(), pose.theta())
    R = Rotation.from_matrix(pose.rotation().matrix())
    return row(pose.translation(), R.as_euler("xyz") if euler else longer * R.as_quat())


def g2o(w: World, ids: Callable[[int], int] = int, *, vertices: bool = True, longer: float = 1.0) -> list[str]:
    tag = "SE2" if w.dim == 2 else "SE3:QUAT"
    order = np.arange(3) if w.dim == 2 else TURNED
    lines = [f"VERTEX_{tag} {ids(k)} {pose_row(p, longer=longer)}" for k, p in enumerate(w.poses) if vertices]
    for i, j, z, omega in w.edges:
        lines.append(f"EDGE_{tag} {ids(i)} {ids(j)} {pose_row(z, longer=longer)} {row(upper(omega[order][:, order]))}")
    return lines


def g2o_prior_2d() -> tuple[World, list[str]]:
    w = World(2)
    lines = g2o(w)
    for k in (0, 7):
        omega = w.information(3)
        z = w.measured(w.poses[k], omega)
        w.factors.append(gtsam.PriorFactorPose2(k, z, noise(omega)))
        lines.append(f"EDGE_PRIOR_SE2 {k} {pose_row(z)} {row(upper(omega))}")
    return w, lines


def g2o_prior_3d() -> tuple[World, list[str]]:
    w = World(3)
    lines = ["PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", *g2o(w)]
    for k in (1, 9):
        omega = w.information(6)
        z = w.measured(w.poses[k], omega)
        w.factors.append(gtsam.PriorFactorPose3(k, z, noise(omega)))
        lines.append(f"EDGE_SE3_PRIOR {k} 0 {pose_row(z)} {row(upper(omega[TURNED][:, TURNED]))}")
    return w, lines


def g2o_gps(dim: int) -> tuple[World, list[str]]:
    """Priors of positions, in the frame of the world."""
    w = World(dim, seed=3)
    lines = g2o(w)
    for k in (0, 3, 6, 9):
        omega = w.information(dim)
        z = w.poses[k].translation() + w.rng.multivariate_normal(np.zeros(dim), np.linalg.inv(omega))
        w.factors.append(getattr(gtsam, f"PoseTranslationPrior{dim}D")(k, z, noise(omega)))
        head = f"EDGE_PRIOR_SE2_XY {k}" if dim == 2 else f"EDGE_SE3_PRIOR_XYZ {k} 0"
        lines.append(f"{head} {row(z, upper(omega))}")
    return w, lines


def gtsam_keys() -> tuple[World, list[str]]:
    """Edges alone between keys of 64 bits: two robots, quaternions of three digits, as Kimera-RPGO reads them."""
    w = World(3, seed=4)
    w.fix()
    return w, g2o(w, lambda k: gtsam.symbol("ab"[k % 2], k), vertices=False, longer=1.0004)


def dialect() -> tuple[World, list[str]]:
    """A byte order mark, tags, scans, and comments between the records."""
    w = World(2, seed=5)
    w.fix()
    lines = g2o(w)
    scan = "ROBOTLASER1 0 -1.57 3.14 0.0174 50 0.01 0 3 1.0 2.0 3.0 0 0 0 0 0 0 0 0 0 0 0 1.0 robot 1.0"
    between = [x for k, line in enumerate(lines) for x in (line + " # odometry", "", f"VERTEX_TAG {k} a b", scan)]
    return w, ["\ufeff# graph", "PARAMS_SE2OFFSET 0 0 0 0", *between, "FIX 0"]


def gtsam_landmarks() -> tuple[World, list[str]]:
    """``BR``: bearing and range, as GTSAM's victoriaPark.txt in g2o form."""
    w = World(2, seed=6)
    w.fix()
    lines = g2o(w)
    for m, mark in enumerate(np.array([[2.0, 3.0], [0.0, 2.0], [4.0, -1.0]])):
        w.values.insert(100 + m, mark)
        lines.append(f"VERTEX_XY {100 + m} {row(mark)}")
        for k in (0, 3, 5, 8):
            r = w.poses[k].range(mark) + w.rng.normal(0.0, 0.1)
            b = w.poses[k].bearing(mark).theta() + w.rng.normal(0.0, 0.02)
            model = gtsam.noiseModel.Diagonal.Sigmas([0.02, 0.1])
            w.factors.append(gtsam.BearingRangeFactor2D(k, 100 + m, gtsam.Rot2(b), r, model))
            lines.append(f"BR {k} {100 + m} {row(b, r, 0.02, 0.1)}")
    return w, lines


def toro_2d() -> tuple[World, list[str]]:
    """Information in TORO's order: xx xy yy θθ xθ yθ."""
    w = World(2, seed=7, information=lambda: np.diag([500.0, 200.0, 3000.0]))
    w.fix()
    lines = [f"VERTEX2 {k} {pose_row(p)}" for k, p in enumerate(w.poses)]
    for i, j, z, I in w.edges:
        lines.append(f"EDGE2 {i} {j} {pose_row(z)} {row(I[0, 0], I[0, 1], I[1, 1], I[2, 2], I[0, 2], I[1, 2])}")
    return w, lines


def toro_3d() -> tuple[World, list[str]]:
    """Information of x y z roll pitch yaw, and edges that TORO contracts."""
    w = World(3, seed=8)
    w.fix()
    lines = [f"VERTEX3 {k} {pose_row(p, euler=True)}" for k, p in enumerate(w.poses)]
    for i, j, z, omega in w.edges:
        lines.append(f"EDGE3 {i} {j} {pose_row(z, euler=True)} {row(upper(omega[TURNED][:, TURNED]))}")
    return w, [*lines, "EQUIV 0 9"]


def isam_3d() -> tuple[World, list[str]]:
    """Square roots of the information, edges alone."""
    w = World(3, seed=9)
    w.fix()
    lines = []
    for i, j, z, omega in w.edges:
        root = np.linalg.cholesky(omega[TURNED][:, TURNED]).T
        lines.append(f"EDGE3 {i} {j} {pose_row(z, euler=True)} {row(upper(root))}")
    return w, lines


def isam_2d() -> tuple[World, list[str]]:
    """Diagonal square roots, which are not named: ``noise="auto"`` finds them."""
    w = World(2, seed=10, information=lambda: np.diag([400.0, 400.0, 10_000.0]))
    w.fix()
    lines = [f"{'EDGE2' if j - i > 1 else 'ODOMETRY'} {i} {j} {pose_row(z)} 20 0 0 20 0 100" for i, j, z, _ in w.edges]
    return w, lines


def load2d() -> tuple[World, list[str]]:
    """Covariances, and landmarks, as in GTSAM's victoriaPark.txt."""
    w = World(2, seed=11, information=lambda: np.diag([100.0, 100.0, 2500.0]))
    w.fix()
    lines = [f"ODOMETRY {i} {j} {pose_row(z)} 0.01 0 0 0.01 0 0.0004" for i, j, z, _ in w.edges]
    for m, mark in enumerate(np.array([[2.0, 3.0], [0.0, 2.0]])):
        w.values.insert(100 + m, mark)
        for k in (0, 4, 7):
            x, y = w.poses[k].transformTo(mark) + w.rng.normal(0.0, 0.1, 2)
            model = gtsam.noiseModel.Diagonal.Sigmas([np.sqrt(0.04 / 10.0), 0.2])
            b, r = gtsam.Rot2(np.arctan2(y, x)), np.hypot(x, y)
            w.factors.append(gtsam.BearingRangeFactor2D(k, 100 + m, b, r, model))
            lines.append(f"LANDMARK {k} {100 + m} {row(x, y)} 0.04 0 0.04")
    return w, lines


FILES: dict[str, tuple[Callable[[], tuple[World, list[str]]], dict[str, Any]]] = {
    "g2o, SE2 with priors": (g2o_prior_2d, {}),
    "g2o, SE3 with priors and a parameter": (g2o_prior_3d, {}),
    "g2o, SE2 with GPS": (partial(g2o_gps, 2), {}),
    "g2o, SE3 with GPS": (partial(g2o_gps, 3), {}),
    "g2o, keys of GTSAM and Kimera-RPGO": (gtsam_keys, {}),
    "g2o, tags, scans, comments and a byte order mark": (dialect, {}),
    "g2o of GTSAM, landmarks by bearing and range": (gtsam_landmarks, {}),
    "TORO 2-D": (toro_2d, {}),
    "TORO 3-D with EQUIV": (toro_3d, {}),
    "iSAM 3-D, square roots": (isam_3d, {"noise": "sqrt-information"}),
    "iSAM 2-D, diagonal square roots": (isam_2d, {}),
    "GTSAM load2D with landmarks": (load2d, {}),
}


@pytest.mark.parametrize("name", FILES)
def test_a_published_form_reaches_the_optimum_of_gtsam(name: str, tmp_path: Path) -> None:
    make, options = FILES[name]
    world, lines = make()
    file = tmp_path / "graph.txt"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    best = world.objective()
    found = solve_file(file, **options)
    assert found["converged"]
    assert found["objective"] == pytest.approx(best, rel=1e-6)
    assert best > 1.0


def test_a_wrong_loop_of_two_robots_is_rejected_as_kimera_rpgo_does(tmp_path: Path) -> None:
    """The optimum of the rest is that of GTSAM without it."""
    w = World(3, seed=12)
    w.fix()
    best = w.objective()
    wrong = gtsam.Pose3(gtsam.Rot3(), np.array([30.0, 0.0, 0.0]))
    w.edges.append((3, 9, wrong, w.edges[0][3]))
    file = tmp_path / "two.g2o"
    file.write_text("\n".join(g2o(w, lambda k: gtsam.symbol("ab"[k >= 5], k))) + "\n")
    found = solve_file(file, solver="gnc")
    assert found["outlier_names"] == [f"{gtsam.symbol('a', 3)} -> {gtsam.symbol('b', 9)}"]
    assert found["objective_inliers"] == pytest.approx(best, rel=1e-6)


def test_evo_files_with_a_repeated_stamp_give_the_error_of_their_other_rows(tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    rows = np.zeros((200, 8))
    rows[:, 0], rows[:, 7] = 1305031098.0 + 0.1 * np.arange(200), 1.0
    rows[:, 1:4] = np.cumsum(rng.normal(0.0, 0.1, (200, 3)), axis=0)
    estimate = rows.copy()
    estimate[:, 1:4] += rng.normal(0.0, 0.05, (200, 3))
    np.savetxt(tmp_path / "truth.tum", rows, fmt="%.9f")
    np.savetxt(
        tmp_path / "estimate.tum", np.insert(estimate, 50, [*estimate[49, :1], *[9.0] * 3, *estimate[49, 4:]], 0)
    )
    done = CliRunner().invoke(app, ["eval", *(str(tmp_path / f"{n}.tum") for n in ("estimate", "truth")), "--json"])
    assert done.exit_code == 0, done.output
    x, y = estimate[:, 1:4], rows[:, 1:4]
    R, _ = Rotation.align_vectors(y - y.mean(0), x - x.mean(0))
    error = np.linalg.norm(R.apply(x - x.mean(0)) + y.mean(0) - y, axis=1)
    found = json.loads(done.stdout[done.stdout.index("{") :])["ate"]
    assert found["pairs"] == 200
    assert found["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
