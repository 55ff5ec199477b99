"""Gaussian cells beside plain ones, and the cached nearest neighbour beside a k-d tree."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from graphslam.core import se3
from graphslam_frontends.lidar_odometry import cell_kernels as kernels
from graphslam_frontends.lidar_odometry.cells import CellMap, LevelConfig, evenly_spaced_rows, first_rows_by_cube
from tests.reference.plain_cells import plain_cells, plain_cost, plain_fit

SCALE = 2.0


def _room(rng, n=4000):
    """Points on the walls and the floor of a room 8 m wide, and some clutter."""
    u = rng.uniform(-4, 4, (n, 3))
    side = rng.integers(0, 3, n)
    u[np.arange(n), side] = np.where(rng.random(n) < 0.5, -4.0, 4.0)
    u += rng.normal(0, 0.01, u.shape)
    return np.concatenate([u, rng.uniform(-1, 1, (n // 8, 3))])


def _lined(rng):
    """A room whose floor and a wall are seen by lines of a scanner, 0.7 m apart."""
    points = _room(rng)
    floor = (points[:, 2] < -3.9) | (points[:, 0] > 3.9)
    points[floor, 1] = 0.7 * np.round(points[floor, 1] / 0.7)
    return points


@pytest.fixture(scope="module", params=[(0.5, 0.05, True), (1.0, 0.25, False)])
def made(request):
    size, least, planes = request.param
    points = _lined(np.random.default_rng(3))
    wide = CellMap(LevelConfig(2.0, 0.5, False))
    wide.add(points, 0)
    level = CellMap(LevelConfig(size, least, planes))
    level.add(points, 0, wide)
    return level, points


def test_cells_are_those_of_the_plain_twin(made):
    level, points = made
    c = level.config
    centres, information = plain_cells(points, c.size, c.least, c.planes, 2.0)
    alone = plain_cells(points, c.size, c.least, c.planes)[1]
    assert np.count_nonzero(np.abs(information - alone).max(axis=(1, 2)) > 0) > 10  # rows that surfaces are told of
    # the fast ones are told anew only every quarter of their points
    valid = level.cells.updated[: level.cells.used[0]] > 0
    assert np.count_nonzero(valid) == len(centres) == len(level)
    tree = cKDTree(centres)
    _, at = tree.query(level.centres)
    assert len(set(at)) == len(at)
    full = level.cells.updated[: level.cells.used[0]][valid] == level.cells.number[: level.cells.used[0]][valid]
    assert full.sum() > 10
    np.testing.assert_allclose(level.centres[full], centres[at[full]], atol=1e-12)
    root = level.cells.root[: level.cells.used[0]][valid][full]
    slow = information[at[full]]
    np.testing.assert_allclose(root.mT @ root, slow, rtol=1e-7, atol=1e-7 * np.abs(slow).max())


def test_no_cell_is_farther_than_the_nearest_by_more_than_a_cached_cube(made):
    level, _ = made
    size = level.config.size
    rng = np.random.default_rng(5)
    queries = level.centres[rng.integers(0, len(level), 20_000)] + rng.uniform(-0.4, 0.4, (20_000, 3)) * size
    got = level.nearest(queries)
    again = level.nearest(queries)
    np.testing.assert_array_equal(got, again)  # warm as cold
    nearest, _ = cKDTree(level.centres).query(queries)
    found = np.where(got >= 0, np.linalg.norm(level.cells.centre[got] - queries, axis=1), np.inf)
    near = nearest < size * (1 - np.sqrt(3) / kernels.FINE)
    assert near.sum() > 1000
    assert np.all(found[near] <= nearest[near] + size / kernels.FINE * np.sqrt(3) + 1e-12)
    assert np.any(found[near] > nearest[near] + 1e-9)  # it is no exact search


def test_what_is_noted_learns_of_new_cells():
    rng = np.random.default_rng(8)
    size = 0.5
    points = _room(rng)
    queries = np.ascontiguousarray(points[rng.integers(0, len(points), 20_000)] + rng.uniform(-0.2, 0.2, (20_000, 3)))
    level = CellMap(LevelConfig(size, 0.05, True))
    for k, part in enumerate(np.array_split(points[rng.permutation(len(points))], 6)):
        level.add(part, k)
        got = level.nearest(queries)
        nearest, _ = cKDTree(level.centres).query(queries)
        found = np.where(got >= 0, np.linalg.norm(level.cells.centre[got] - queries, axis=1), np.inf)
        near = nearest < size * (1 - np.sqrt(3) / kernels.FINE)
        # a centre may have moved by a quarter of a cached cube since it was noted
        slack = size / kernels.FINE * (np.sqrt(3) + 2 * np.sqrt(3) * 0.25)
        assert np.all(found[near] <= nearest[near] + slack)


def test_normal_equations_are_those_of_the_plain_twin_and_of_differences(made):
    level, points = made
    rng = np.random.default_rng(11)
    T = np.asarray(se3.se3_exp(rng.normal(0, 0.03, 6)))
    R, t = se3.quat_to_matrix(T[3:]), T[:3]
    body = np.ascontiguousarray(points[rng.integers(0, len(points), 300)])
    fit = level.fit(body, np.ascontiguousarray(R), t, SCALE)
    at = level.nearest(np.ascontiguousarray(body @ R.T + t))
    root = level.cells.root[at]
    A = root.mT @ root
    cells = [level.cells.centre[k] if k >= 0 else None for k in at]
    H, g, overlap = plain_fit(body, R, t, cells, A, SCALE)
    np.testing.assert_allclose(fit.H, H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
    np.testing.assert_allclose(fit.g, g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
    assert fit.overlap == pytest.approx(overlap)
    numeric = np.empty(6)
    for k in range(6):
        costs = []
        for sign in (1, -1):
            moved = se3.se3_compose(T, se3.se3_exp(sign * 1e-6 * np.eye(6)[k]))
            costs.append(plain_cost(body, se3.quat_to_matrix(moved[3:]), moved[:3], cells, A, SCALE))
        numeric[k] = (costs[0] - costs[1]) / 2e-6
    np.testing.assert_allclose(fit.g, numeric, rtol=1e-5, atol=1e-5 * np.abs(g).max())
    valid = np.linalg.norm(A, axis=(1, 2)) > 0
    np.testing.assert_array_equal(level.known(np.ascontiguousarray(body @ R.T + t)), valid & (at >= 0))
    # what surfaces turned anyhow would say is no less, in any direction
    assert np.linalg.eigvalsh(fit.every - fit.H).min() > -1e-6 * np.abs(fit.every).max()


def test_descent_is_that_of_the_plain_steps(made):
    level, points = made
    rng = np.random.default_rng(12)
    size = level.config.size
    start = np.asarray(se3.se3_exp(np.r_[rng.normal(0, 0.05, 3), rng.normal(0, 0.2 * size, 3)]))
    body = np.ascontiguousarray(points[rng.integers(0, len(points), 2000)])
    prior = np.diag([400.0] * 3 + [25.0] * 3)
    plain = start
    for steps in range(1, 6):
        fit = level.fit(body, np.ascontiguousarray(se3.quat_to_matrix(plain[3:])), plain[:3].copy(), SCALE)
        off = se3.se3_log(se3.se3_between(start, plain))
        d = -np.linalg.solve(fit.H + prior, fit.g + prior @ off)
        d *= min(1.0, 0.5 * size / np.linalg.norm(d[3:]))
        d *= min(1.0, 0.2 / np.linalg.norm(d[:3]))
        plain = se3.se3_compose(plain, se3.se3_exp(d))
        R, t = np.ascontiguousarray(se3.quat_to_matrix(start[3:])), start[:3].copy()
        last = level.descend(body, R, t, SCALE, prior, (0.0, 0.0), steps)
        np.testing.assert_allclose(t, plain[:3], atol=1e-9)
        np.testing.assert_allclose(R, se3.quat_to_matrix(plain[3:]), atol=1e-9)
        np.testing.assert_allclose(last.H, fit.H, rtol=1e-6, atol=1e-9 * np.abs(fit.H).max())
    R, t = np.ascontiguousarray(se3.quat_to_matrix(plain[3:])), plain[:3].copy()
    level.descend(body, R, t, SCALE, np.zeros((6, 6)), (1e-4, 1e-4), 50)
    before = R.copy(), t.copy()
    level.descend(body, R, t, SCALE, np.zeros((6, 6)), (1e-3, 1e-3), 50)
    assert np.abs(R - before[0]).max() < 1e-3  # it stands still
    assert np.abs(t - before[1]).max() < 1e-3


def test_information_by_slot_adds_up():
    rng = np.random.default_rng(2)
    points = _room(rng)
    level = CellMap(LevelConfig(0.5, 0.05, True))
    for k, part in enumerate(np.array_split(points[np.argsort(points[:, 0])], 4)):
        level.add(part, 10 * k)
    body = np.ascontiguousarray(points[rng.integers(0, len(points), 500)] + rng.normal(0, 0.01, (500, 3)))
    R, t = np.eye(3), np.zeros(3)
    fit = level.fit(body, R, t, SCALE)
    H, M, G = level.by_slot(body, R, t, SCALE, np.array([5.0, 15.0, 25.0, 35.0]))
    np.testing.assert_allclose(H.sum(axis=0), fit.H, rtol=1e-9, atol=1e-9 * np.abs(fit.H).max())
    assert all(np.trace(h) > 0 for h in H)
    np.testing.assert_allclose(G.sum(axis=0), fit.g, rtol=1e-9, atol=1e-9 * np.abs(fit.g).max())
    assert np.linalg.eigvalsh(M - fit.H).max() > 0  # points of one cell err together


def test_forgotten_cells_are_gone_and_the_others_as_they_were():
    rng = np.random.default_rng(4)
    points = _room(rng)
    level = CellMap(LevelConfig(0.5, 0.05, True))
    level.add(points[points[:, 0] > 0.1], 1)
    level.add(points[points[:, 0] < -0.6], 5)
    queries = rng.uniform(-4.5, 4.5, (3000, 3))
    level.nearest(queries)
    level.keep_since(3)
    only = CellMap(LevelConfig(0.5, 0.05, True))
    only.add(points[points[:, 0] < -0.6], 5)
    np.testing.assert_allclose(np.sort(level.centres, axis=0), np.sort(only.centres, axis=0))
    a, b = level.nearest(queries), only.nearest(queries)
    np.testing.assert_array_equal(a >= 0, b >= 0)
    np.testing.assert_allclose(level.cells.centre[a[a >= 0]], only.cells.centre[b[b >= 0]])


def test_thinning_keeps_the_first_of_each_cube_within_ranges():
    points = np.random.default_rng(1).uniform(-3, 3, (5000, 3))
    rows = first_rows_by_cube(points, 0.5, (1.0, 2.5))
    seen, wanted = set(), []
    for k, p in enumerate(points):
        cube = tuple(np.floor(p / 0.5).astype(int))
        if 1.0 < np.linalg.norm(p) < 2.5 and cube not in seen:
            seen.add(cube)
            wanted.append(k)
    np.testing.assert_array_equal(rows, wanted)
    np.testing.assert_array_equal(evenly_spaced_rows(10, 20), np.arange(10))
    assert len(evenly_spaced_rows(1000, 30)) == 30


def test_kernels_of_cells_compile_few_functions(tmp_path: Path) -> None:
    """Slices set to arrays and ``np.linalg`` take more time to compile than all kernels of cells: each compiles
    functions that format shapes for messages."""
    code = (
        "import numpy as np\n"
        "from numba.core import event\n"
        "from graphslam_frontends.lidar_odometry.cells import CellMap, LevelConfig\n"
        "level, points = CellMap(LevelConfig(0.5, 0.05, True)), np.random.default_rng(0).normal(size=(500, 3))\n"
        "with event.install_recorder('numba:compile') as compiled:\n"
        "    level.add(points, 0)\n"
        "    level.keep_since(0)\n"
        "    level.fit(points, np.eye(3), np.zeros(3), 3.0)\n"
        "    level.by_slot(points, np.eye(3), np.zeros(3), 3.0, np.ones(1))\n"
        "print(*{e.data['dispatcher'].py_func.__module__ for _, e in compiled.buffer})\n"
    )
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert "cell_kernels" in done.stdout, done.stderr
    assert "numba.cpython.unicode" not in done.stdout
    assert "numba.np.linalg" not in done.stdout
