"""Priors of a position alone: the same optimum as an independent least squares, and the same factor as GTSAM's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from graphslam.core.errors import CovarianceError, DataError, FormatError
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import group_of
from graphslam.graph.factors.batch import gtsam_factor, gtsam_pose
from graphslam.graph.factors.position import PositionRecord
from graphslam.graph.network import problem_of_network
from graphslam.graph.variables import Values
from graphslam.io.g2o import read_g2o, write_g2o
from graphslam.join.graph_problem import JoinProblem
from graphslam.solve.network.multistart import STARTS
from graphslam.solve.network.solve import solve_network

PRIOR = {2: "EDGE_PRIOR_SE2_XY", 3: "EDGE_SE3_PRIOR_XYZ"}


def jacobian(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    return np.stack([(f(x + e) - f(x - e)) / (2.0 * h) for e in h * np.eye(len(x))], axis=1)


def upper(A: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in A[np.triu_indices(len(A))])


def row(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def world(dim: int, priors: list[int], *, seed: int = 1, n: int = 12, flat: bool = False) -> str:
    """A g2o file: a noisy chain with loops, in a frame that is turned against that of its positions."""
    rng = np.random.default_rng(seed)
    g = group_of(np.zeros(3 if dim == 2 else 7))
    d = g.dof
    step = np.zeros((n, d))
    step[:, g.position.start] = 1.0
    step[:, g.heading] = 0.0 if flat else 0.5
    if dim == 3 and not flat:
        step[:, 0] = 0.2
    true = [g.exp(np.r_[rng.normal(0.0, 2.0, d)])]
    for s in step[1:]:
        true.append(g.compose(true[-1], g.exp(s)))
    x = np.array(true)
    lines, order = [], np.r_[3:6, 0:3] if dim == 3 else np.arange(3)
    name = "SE2" if dim == 2 else "SE3:QUAT"
    for k, pose in enumerate(g.between(x[0], x)):
        lines.append(f"VERTEX_{name} {k} {row(pose)}")
    for i, j in [*((k, k + 1) for k in range(n - 1)), (0, n - 1), (2, 9), (1, 6)]:
        A = rng.normal(0.0, 1.0, (d, d))
        P = 1e-4 * (A @ A.T + np.eye(d))
        z = g.compose(g.between(x[i], x[j]), g.exp(rng.multivariate_normal(np.zeros(d), P)))
        lines.append(f"EDGE_{name} {i} {j} {row(z)} {upper(np.linalg.inv(P)[np.ix_(order, order)])}")
    for k in priors:
        A = rng.normal(0.0, 1.0, (dim, dim))
        P = 1e-2 * (A @ A.T + 0.1 * np.eye(dim))
        z = x[k, :dim] + (0.0 if flat else rng.multivariate_normal(np.zeros(dim), P))
        lines.append(f"{PRIOR[dim]} {k} {row(z)} {upper(np.linalg.inv(P))}")
    return "\n".join(lines) + "\n"


def read(folder: Path, text: str) -> PoseNetwork:
    path = folder / "f.g2o"
    path.write_text(text)
    return read_g2o(path)


def matrix(pose: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    planar = len(pose) == 3
    out[:3, :3] = Rotation.from_rotvec(
        [0, 0, pose[2]] if planar else Rotation.from_quat(pose[3:]).as_rotvec()
    ).as_matrix()
    out[: 2 if planar else 3, 3] = pose[: 2 if planar else 3]
    return out


def logarithm(T: np.ndarray, dim: int) -> np.ndarray:
    w = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    angle = max(float(np.linalg.norm(w)), 1e-9)
    K = np.cross(np.eye(3), w / angle)
    V = np.eye(3) + (1 - np.cos(angle)) / angle * K + (1 - np.sin(angle) / angle) * K @ K
    t = np.linalg.solve(V, T[:3, 3])
    return np.r_[w, t] if dim == 3 else np.r_[t[:2], w[2]]


def twin_of(net: PoseNetwork) -> Callable[[list[np.ndarray]], np.ndarray]:
    """Whitened residuals as a function of homogeneous transforms, one per vertex, from the definition."""
    w, V = np.linalg.eigh(net.information)
    roots = np.sqrt(np.maximum(w, 0.0))[:, :, None] * np.swapaxes(V, 1, 2)
    back = [np.linalg.inv(matrix(z)) for z in net.measurements]
    block = slice(0, 2) if net.dim == 2 else slice(3, 6)

    def residuals(frames: list[np.ndarray]) -> np.ndarray:
        out = []
        for e, (i, j) in enumerate(net.edges.tolist()):
            r = np.zeros(net.tangent_dim)
            if net.position_priors[e]:
                r[block] = frames[j][: net.dim, 3] - net.measurements[e, : net.dim]
            else:
                r = logarithm(back[e] @ np.linalg.inv(frames[i]) @ frames[j], net.dim)
            out.append(roots[e] @ r)
        return np.concatenate(out)

    return residuals


def moved(net: PoseNetwork, poses: np.ndarray, step: np.ndarray) -> list[np.ndarray]:
    """Frames after a right step of every free vertex: position in the body frame, rotation vector."""
    frames = [matrix(p) for p in poses]
    d = net.tangent_dim
    for k, v in enumerate(np.flatnonzero(~net.fixed)):
        s, E = step[d * k : d * k + d], np.eye(4)
        E[:3, :3] = Rotation.from_rotvec(s[:3] if net.dim == 3 else [0, 0, s[2]]).as_matrix()
        E[: net.dim, 3] = s[3:] if net.dim == 3 else s[:2]
        frames[v] = frames[v] @ E
    return frames


@pytest.mark.parametrize("dim", [2, 3])
def test_optimum_and_covariance_are_those_of_an_independent_least_squares(dim: int, tmp_path: Path) -> None:
    net = read(tmp_path, world(dim, [0, 3, 5, 8, 8], n=10))
    assert int(net.position_priors.sum()) == 5
    assert len(net) == 11
    assert net.fixed.sum() == 1
    assert len(net.edges) == 12 + 5  # nothing else fixes the frame
    found = solve_network(net)
    assert found.converged
    for solver in ("isam2", "pcg"):
        other = solve_network(net, solver)
        assert other.objective == pytest.approx(found.objective, rel=1e-8)
        np.testing.assert_allclose(other.poses, found.poses, atol=1e-5)
    flat, free = problem_of_network(net), ~net.fixed
    values = Values(dim, {"x": found.poses})
    for _ in range(3):  # the solver ends when the objective does, at a millionth of a standard deviation
        now = flat.evaluate(values, dense=False)
        values = flat.layout.retract(values, -np.linalg.solve(now.A.toarray(), now.g))
    twin_residuals = twin_of(net)

    def residuals(step: np.ndarray) -> np.ndarray:
        return twin_residuals(moved(net, values.poses, step))

    zero = np.zeros(net.tangent_dim * int(free.sum()))
    assert float(residuals(zero) @ residuals(zero)) == pytest.approx(found.objective, rel=1e-8)
    rng = np.random.default_rng(0)
    start = rng.normal(0.0, 0.03, len(zero))
    twin = least_squares(
        residuals, start, lambda s: jacobian(residuals, s), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert 2.0 * twin.cost == pytest.approx(found.objective, rel=1e-8)
    np.testing.assert_allclose(twin.x, 0.0, atol=1e-8)
    at = flat.layout.first("x", np.flatnonzero(free))[:, None] + np.arange(net.tangent_dim)
    J = jacobian(residuals, zero)
    ours = np.linalg.inv(flat.evaluate(values, dense=False).A.toarray())[np.ix_(at.ravel(), at.ravel())]
    np.testing.assert_allclose(ours, np.linalg.inv(J.T @ J), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_factor_is_gtsams(dim: int) -> None:
    rng = np.random.default_rng(4)
    g = group_of(np.zeros(3 if dim == 2 else 7))
    pose, z = g.exp(rng.normal(0.0, 1.0, g.dof)), rng.normal(0.0, 1.0, dim)
    W = np.triu(rng.normal(0.0, 1.0, (dim, dim))) + 2.0 * np.eye(dim)
    record = PositionRecord(0, 1, z, W)
    values = gtsam.Values()
    values.insert(gtsam.symbol("x", 1), gtsam_pose(pose))
    r = W @ (pose[:dim] - z)
    own = gtsam_factor(record, {"x0": g.identity})
    assert type(own) is (gtsam.PoseTranslationPrior2D if dim == 2 else gtsam.PoseTranslationPrior3D)
    factors = [own]
    if dim == 3:
        noise = gtsam.noiseModel.Gaussian.Information(W.T @ W)
        factors.append(gtsam.GPSFactor(gtsam.symbol("x", 1), z, noise))
    batch_net = PoseNetwork(
        dim=dim, ids=[0, 1], poses=[g.identity, pose], has_initial=[True, True], edges=[(0, 1)],
        measurements=[np.r_[z, g.identity[dim:]]], information=[np.zeros((g.dof, g.dof))], fixed=[True, False],
        position_priors=[True],
    )  # fmt: skip
    omega = np.zeros((1, g.dof, g.dof))
    omega[0, g.position, g.position] = W.T @ W
    batch = problem_of_network(replace(batch_net, information=omega)).batches[1]
    residual, J = batch.whitened(Values(dim, {"x": np.array([g.identity, pose])}))
    for factor in factors:
        assert 2.0 * factor.error(values) == pytest.approx(float(r @ r), rel=1e-12)
        linear = factor.linearize(values)
        A, b = linear.jacobian()
        np.testing.assert_allclose(A.T @ A, J[0].T @ J[0], atol=1e-12)
        np.testing.assert_allclose(A.T @ b, -J[0].T @ residual[0], atol=1e-12)
    numeric = jacobian(lambda s: W @ (g.compose(pose, g.exp(s))[:dim] - z), np.zeros(g.dof))
    np.testing.assert_allclose(J[0], numeric, atol=1e-8)


@pytest.mark.parametrize(("dim", "priors", "free"), [(2, [3], 1), (2, [3, 3], 1), (3, [3], 3), (3, [3, 8], 1)])
def test_too_few_positions_fix_nothing_but_the_rest_of_the_frame(
    dim: int, priors: list[int], free: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    net = read(tmp_path, world(dim, priors))
    directions = 3 if dim == 2 else 6
    assert f"{len(priors)} position priors leave {free} of {directions} directions of the frame free" in caplog.text
    extra = np.flatnonzero(net.fixed[net.edges[:, 0]] & ~net.position_priors)
    assert len(extra) == 1
    assert np.linalg.matrix_rank(net.information[extra[0]]) == free
    objectives = {s: solve_network(net, s) for s in ("lm", "isam2")}
    for found in objectives.values():
        assert found.converged
        cost = problem_of_network(net).squared(Values(dim, {"x": found.poses}))
        assert cost[extra[0]] < 1e-6  # it only chooses among equal solutions
        loose = twin_of(net.only(np.arange(len(net.edges)) != extra[0]))([matrix(p) for p in found.poses])
        assert float(loose @ loose) == pytest.approx(found.objective, rel=1e-7)
    assert objectives["lm"].objective == pytest.approx(objectives["isam2"].objective, rel=1e-9)


def test_positions_on_a_line_leave_the_turn_about_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    net = read(tmp_path, world(3, [0, 4, 8, 11], flat=True))
    assert "4 position priors leave 1 of 6 directions" in caplog.text
    assert solve_network(net).converged
    caplog.clear()
    read(tmp_path, world(2, [0, 4, 8, 11], flat=True))
    assert not caplog.text


@pytest.mark.parametrize("dim", [2, 3])
def test_every_start_reaches_the_optimum_although_the_file_has_another_frame(dim: int, tmp_path: Path) -> None:
    net = read(tmp_path, world(dim, [0, 3, 5, 8, 11]))
    best = solve_network(net).objective
    for name in ("chordal", "tree", "odometry", "incremental"):
        assert name in STARTS
        assert solve_network(net, starts=name).objective == pytest.approx(best, rel=1e-9), name


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("priors", [[0, 3, 5, 8], [3]])
def test_round_trip(dim: int, priors: list[int], tmp_path: Path) -> None:
    net = read(tmp_path, world(dim, priors))
    for _ in range(2):
        write_g2o(tmp_path / "b.g2o", net)
        text = (tmp_path / "b.g2o").read_text()
        assert text.count(PRIOR[dim]) == len(priors)
        again = read_g2o(tmp_path / "b.g2o")
        for name in ("ids", "poses", "fixed", "edges", "measurements", "information", "position_priors"):
            assert np.array_equal(getattr(again, name), getattr(net, name)), name
        net = again
    if len(priors) > 1:
        assert "FIX" not in text  # as the file that was read


def test_records_of_other_programs(tmp_path: Path) -> None:
    space = world(3, [0, 3, 5])
    net = read(tmp_path, space)
    for tag in ("EDGE_POINTXYZ_PRIOR", "EDGE_PRIOR_SE3_XYZ", "EDGE_PRIOR_XYZ"):
        assert np.array_equal(read(tmp_path, space.replace(PRIOR[3], tag)).information, net.information)
    numbered = "\n".join(
        " ".join([*w[:2], "0", *w[2:]]) if w[0] == PRIOR[3] else " ".join(w) for w in map(str.split, space.splitlines())
    )
    assert np.array_equal(read(tmp_path, numbered).measurements, net.measurements)
    flat = read(tmp_path, world(3, []) + "".join(f"EDGE_SE3_PRIOR_XY {k} {k} {k * k} 4 1 9\n" for k in range(3)))
    assert flat.information[-1, 3:, 3:].tolist() == [[4, 1, 0], [1, 9, 0], [0, 0, 0]]
    assert solve_network(flat).converged  # the height is fixed by the first one
    plane = world(2, [0, 3])
    other = read(tmp_path, plane.replace(PRIOR[2], "EDGE_SE2_XY_PRIOR"))
    assert np.array_equal(other.measurements, read(tmp_path, plane).measurements)


def test_bad_priors_are_refused_by_line(tmp_path: Path) -> None:
    good = world(2, [0, 3])
    line = good.count("\n") + 1
    with pytest.raises(CovarianceError, match=rf"indefinite: position of 5, .*f\.g2o:{line}"):
        read(tmp_path, good + "EDGE_PRIOR_SE2_XY 5 1 2 1 2 1\n")
    with pytest.raises(FormatError, match=rf"f\.g2o:{line}.*information zero|information zero.*f\.g2o:{line}"):
        read(tmp_path, good + "EDGE_PRIOR_SE2_XY 5 1 2 0 0 0\n")
    with pytest.raises(FormatError, match=rf"names vertex 99.*f\.g2o:{line}|f\.g2o:{line}.*names vertex 99"):
        read(tmp_path, good + "EDGE_PRIOR_SE2_XY 99 1 2 1 0 1\n")
    with pytest.raises(FormatError, match=rf"f\.g2o:{line}.*truncated|truncated.*f\.g2o:{line}"):
        read(tmp_path, good + "EDGE_PRIOR_SE2_XY 5 1 2 1 0\n")
    with pytest.raises(FormatError, match="in one file"):
        read(tmp_path, good + "EDGE_SE3_PRIOR_XYZ 5 1 2 3 1 0 0 1 0 1\n")
    repaired = tmp_path / "r.g2o"
    repaired.write_text(good + "EDGE_PRIOR_SE2_XY 5 1 2 1 2 1\n")
    assert read_g2o(repaired, repair=True).repaired == 1


def test_gnc_rejects_a_jump_and_keeps_the_rest(tmp_path: Path) -> None:
    text = world(2, list(range(0, 30, 2)), n=30)
    clean = solve_network(read(tmp_path, text), "gnc")
    assert clean.inliers is not None
    assert clean.inliers.all()
    rows = text.splitlines()
    at = [k for k, line in enumerate(rows) if line.startswith(PRIOR[2])]
    for k in (at[4], at[9]):
        words = rows[k].split()
        rows[k] = " ".join([*words[:2], str(float(words[2]) + 15.0), *words[3:]])
    net = read(tmp_path, "\n".join(rows) + "\n")
    found = solve_network(net, "gnc")
    assert found.details["outlier_names"] == ["position of 8", "position of 18"]
    moved_by = np.linalg.norm(found.poses[:, :2] - clean.poses[:, :2], axis=1).max()
    assert moved_by < 0.1


@pytest.mark.parametrize(("dim", "share"), [(2, 1.0), (3, 0.7)])
def test_positions_far_worse_than_stated_do_not_outvote_the_loops(dim: int, share: float, tmp_path: Path) -> None:
    """They were all kept as they are stated, and the loops, which they contradict, were rejected."""
    rng, rows = np.random.default_rng(5), []
    for words in map(str.split, world(dim, list(range(0, 40, 2)), n=40, seed=5).splitlines()):
        if words[0] == PRIOR[dim] and rng.random() < share:
            words[2 : 2 + dim] = (np.array(words[2 : 2 + dim], dtype=float) + 3.0 * rng.normal(size=dim)).astype(str)
        rows.append(" ".join(words))
    net = read(tmp_path, "\n".join(rows) + "\n")
    found = solve_network(net, "gnc")
    assert found.inliers is not None
    assert found.inliers[: len(net.edges)][net.relative].all()
    assert found.inliers[net.position_priors].sum() >= 10
    assert not found.converged
    assert "position priors contradict the other measurements; σ of all" in found.details["doubt"]
    factor = float(found.details["doubt"].partition("multiplied by ")[2].partition(",")[0])
    assert 10.0 < factor < 60.0  # errors of 3 m where 0.1 m (times a random matrix) is stated


def test_what_has_no_place_for_them_refuses_by_name(tmp_path: Path) -> None:
    net = read(tmp_path, world(2, [0, 3, 5]))
    shown = solve_network(net, certificate=True).certificate
    assert str(shown) == "not known (position priors are not part of the relaxation)"
    with pytest.raises(DataError, match="position priors"):
        JoinProblem.of_network(net, 3)
