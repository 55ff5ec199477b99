"""Surfaces: distances that are right, a zero set of the right order, and pieces that move bit for bit."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError, FormatError, GridError
from graphslam.core.geometry import Array
from graphslam.maps.surface.field_kernels import curvature
from graphslam.maps.surface.layer import SurfaceLayer
from graphslam.maps.surface.mesh import Mesh, Mesher, position_sigma, save_mesh, vertex_owners, zero_set
from graphslam.maps.surface.piece import SurfaceConfig, SurfacePiece, normals_of, piece_of_planes, piece_of_scans
from tests.reference.plain_surface import plain_planes, plain_pose

IDENTITY = np.array([0.0, 0, 0, 0, 0, 0, 1])
CENTRE = np.array([0.013, 0.027, 0.009])


def sphere_piece(c: SurfaceConfig, radius: float = 1.0) -> SurfacePiece:
    rng = np.random.default_rng(0)
    n = rng.standard_normal((int(4 * np.pi * (radius / c.voxel) ** 2 * 6), 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    at = CENTRE + radius * n
    return piece_of_planes(at, CENTRE + 3.0 * radius * n, n, np.ones(len(n), bool), c)


def layer_of(piece: SurfacePiece, c: SurfaceConfig, T: Array = IDENTITY) -> SurfaceLayer:
    layer = SurfaceLayer(c)
    layer.add(0, piece, T)
    return layer


def centres(coordinates: Array) -> Array:
    v = np.arange(512)
    return 8 * coordinates[:, None, :] + np.stack([v % 8, (v // 8) % 8, v // 64], axis=-1) + 0.5


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_a_sphere_is_found_to_second_order(smoothing: float) -> None:
    rms = []
    for voxel in (0.2, 0.1, 0.05):
        c = SurfaceConfig(voxel=voxel, smoothing=smoothing, carving=False)
        mesh = zero_set(layer_of(sphere_piece(c), c).bricks(), voxel)
        off = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - 1.0
        rms.append(float(np.sqrt(np.mean(off**2))))
        solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
        assert solid.is_watertight
        assert solid.volume > 0.0  # triangles look outwards, to the free side
    assert math.log2(rms[0] / rms[2]) / 2.0 > 1.8
    assert mesh.area() == pytest.approx(4.0 * np.pi, rel=0.005)


def test_a_tilted_plane_is_exact_to_a_hundredth_of_a_voxel() -> None:
    c = SurfaceConfig(voxel=0.05, smoothing=0.1, carving=False)
    rng = np.random.default_rng(1)
    n = np.array([0.3, -0.2, 0.93])
    n /= np.linalg.norm(n)
    u = np.cross(n, [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    a, b = rng.uniform(-0.6, 0.6, (2, 8000))
    p = 0.1 * n + a[:, None] * u + b[:, None] * np.cross(n, u)
    piece = piece_of_planes(p, p + n, np.broadcast_to(n, p.shape), np.ones(len(p), bool), c)
    coordinates, phi, known = layer_of(piece, c).bricks()
    true = (centres(coordinates) * c.voxel @ n - 0.1) / c.voxel
    at = centres(coordinates) * c.voxel
    inner = known & (np.hypot(at @ u, at @ np.cross(n, u)) < 0.45) & (np.abs(true) < 1.0)
    assert inner.sum() > 500
    assert np.max(np.abs(phi - true)[inner]) < 0.01
    mesh = zero_set((coordinates, phi, known), c.voxel)
    assert np.max(np.abs(mesh.vertices @ n - 0.1)) < 0.01 * c.voxel


def test_points_are_summed_as_the_plain_twin_does() -> None:
    rng = np.random.default_rng(2)
    c = SurfaceConfig(voxel=1.0, carving=False)
    p, n = rng.uniform(-9.0, 9.0, (60, 3)), rng.standard_normal((60, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    piece = piece_of_planes(p, p + 3.0 * n, n, np.ones(60, bool), c)
    wanted = plain_planes(p, n)
    found = {}
    for at, d, k in zip(centres(piece.coordinates), piece.distance, piece.counts):
        for v in np.flatnonzero((k[:, 0] > 0) | (k[:, 2] > 0)).tolist():
            found[tuple(int(x) for x in np.floor(at[v]))] = (float(d[v]), int(k[v, 0]), int(k[v, 2]))
    assert found.keys() == wanted.keys()
    for v, (num, w, hit) in wanted.items():
        assert found[v][1:] == (w, hit)
        if w:
            assert found[v][0] == pytest.approx(num * 16 / (w * 1024), abs=1e-5)


def test_beams_clear_what_they_passed_and_stop_before_their_point() -> None:
    c = SurfaceConfig(voxel=1.0)
    wall = np.array([[20.5, 0.5 + y, 0.5] for y in range(-3, 4)] * 6)
    beams = np.concatenate([wall, np.array([[10.5, 0.5, 0.5]])])
    from_ = beams * [0.0, 1.0, 1.0] + [0.5, 0.0, 0.0]  # side by side
    n = np.broadcast_to([-1.0, 0.0, 0.0], beams.shape)
    piece = piece_of_planes(beams, from_, n, np.ones(len(beams), bool), c)
    passed = {}
    for at, k in zip(centres(piece.coordinates), piece.counts):
        for v in np.flatnonzero(k[:, 1]).tolist():
            passed[tuple(int(x) for x in np.floor(at[v]))] = int(k[v, 1])
    assert passed[(10, 0, 0)] == 6  # the six to the wall, and not the one that ends here
    assert passed[(17, 0, 0)] == 6
    assert (18, 0, 0) not in passed
    assert (19, 0, 0) not in passed


def test_what_has_gone_leaves_no_surface() -> None:
    c = SurfaceConfig(voxel=0.1, most_range=20.0)
    y, z = np.meshgrid(np.arange(-1.0, 1.0, 0.05), np.arange(-1.0, 1.0, 0.05))
    origin = np.array([0.05, 0.03, 0.02])

    def at(x: float, part: float) -> Array:
        p = np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])
        return p[np.max(np.abs(p[:, 1:]), axis=1) < part]

    passing = [(at(1.95, 0.15), origin)] + [(at(4.0 + 0.001 * k, 1.0), origin) for k in range(12)]
    for carving, left in ((True, False), (False, True)):
        made = dataclasses.replace(c, carving=carving)
        mesh = zero_set(layer_of(piece_of_scans(passing, IDENTITY, made), made).bricks(), 0.1)
        assert np.any(np.abs(mesh.vertices[:, 0] - 4.0) < 0.05)
        assert np.any(np.abs(mesh.vertices[:, 0] - 1.95) < 0.05) == left


def test_normals_look_to_the_scanner_and_lines_have_none() -> None:
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(-1, 1, (400, 2)), 0.002 * rng.standard_normal(400)])
    c = SurfaceConfig()
    n = normals_of(flat, flat + [0.0, 0.0, -5.0], c)
    assert np.nanmin(-n[:, 2]) > 0.98
    line = np.column_stack([np.linspace(0, 1, 50), 0.001 * rng.standard_normal((50, 2))])
    spread = np.linalg.eigvalsh(np.cov(line[:, 1:].T))
    assert spread[1] < 4.0 * spread[0]
    assert np.mean(np.isfinite(normals_of(line, line + 1.0, c)[:, 0])) < 0.3
    assert np.all(np.isnan(normals_of(flat[:3], flat[:3] + 1.0, c)))


# --- pieces in the world -----------------------------------------------------------------------------------------


def turned(seed: int, reach: float = 0.3) -> Array:
    rng = np.random.default_rng(seed)
    return np.asarray(se3.se3_exp(np.concatenate([rng.normal(0, 1.0, 3), rng.uniform(-reach, reach, 3)])))


def test_a_piece_is_put_in_the_world_as_the_plain_twin_does() -> None:
    rng = np.random.default_rng(4)
    c = SurfaceConfig(voxel=1.0, carving=False)
    p, n = rng.uniform(-4.0, 4.0, (12, 3)), rng.standard_normal((12, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    piece = piece_of_planes(p, p + 3.0 * n, n, np.ones(12, bool), c)
    cells = {}
    for at, d, g, k in zip(centres(piece.coordinates), piece.distance, piece.normal, piece.counts):
        for v in np.flatnonzero(k[:, 0]).tolist():
            home = np.floor(at[v]).astype(int)
            cells[(int(home[0]), int(home[1]), int(home[2]))] = (float(d[v]), g[v] / 127.0, int(k[v, 0]))
    T = turned(5, reach=3.0)
    layer = layer_of(piece, c, T)
    layer.update()
    wanted = plain_pose(cells, se3.quat_to_matrix(T[3:]), T[:3])
    found = {}
    for key, at in zip(layer._rows.tolist(), centres(layer.bricks()[0])):
        for v in np.flatnonzero(layer._sums[key, :, 1]).tolist():
            found[tuple(int(x) for x in np.floor(at[v]))] = tuple(int(x) for x in layer._sums[key, v, :2])
    assert found.keys() == wanted.keys()
    off = np.array([abs(found[v][0] - wanted[v][0]) for v in wanted])
    assert np.all(off <= 1)  # the last digit of a turn
    assert all(found[v][1] == wanted[v][1] for v in wanted)


def test_distances_are_sampled_with_their_gradient() -> None:
    c = SurfaceConfig(voxel=0.05, carving=False, smoothing=0.0, steps=0, redistance_steps=0)
    piece = sphere_piece(c)
    nearest = dataclasses.replace(piece, normal=np.zeros_like(piece.normal))
    off = []
    for made in (piece, nearest):
        T = turned(6)
        coordinates, phi, known = layer_of(made, c, T).bricks()
        middle = se3.se3_transform(T[None], CENTRE[None])[0]
        true = (np.linalg.norm(centres(coordinates) * c.voxel - middle, axis=-1) - 1.0) / c.voxel
        near = known & (np.abs(true) < 1.0)
        off.append(float(np.sqrt(np.mean((phi - true)[near] ** 2))))
    assert off[0] < 0.03
    assert off[1] > 0.2


def scene(k: int) -> tuple[Array, Array]:
    """A noisy floor with a step and a wall around place ``k``."""
    rng = np.random.default_rng(k)
    x, y = rng.uniform(-0.6, 0.6, (2, 4000)) + [[1.0 * k], [0.0]]
    z = 0.1 * (y > 0.1) + 0.004 * rng.standard_normal(4000)
    wall = np.column_stack(
        [x[:1500], np.full(1500, 0.6) + 0.004 * rng.standard_normal(1500), rng.uniform(0, 0.8, 1500)]
    )
    return np.concatenate([np.column_stack([x, y, z]), wall]), np.array([1.0 * k, -0.5, 1.0])


@pytest.fixture(scope="module")
def four() -> tuple[SurfaceConfig, dict[int, SurfacePiece], dict[int, Array]]:
    c = SurfaceConfig(voxel=0.05)
    poses = {k: np.array([1.0 * k, 0.0, 0.0, 0, 0, math.sin(0.1 * k), math.cos(0.1 * k)]) for k in range(4)}
    return c, {k: piece_of_scans([scene(k)], poses[k], c) for k in range(4)}, poses


def test_a_moved_surface_is_bit_for_bit_the_one_made_anew(
    four: tuple[SurfaceConfig, dict[int, SurfacePiece], dict[int, Array]],
) -> None:
    c, pieces, poses = four
    layer, mesher = SurfaceLayer(c), Mesher(c.voxel)
    for k, piece in pieces.items():
        layer.add(k, piece, poses[k])
    mesher.update(*layer.bricks())
    everything = layer.evolved
    others = dict(poses)
    for seed, name in ((7, 0), (8, 3), (9, 0)):
        others[name] = se3.se3_compose(se3.se3_exp(np.random.default_rng(seed).normal(0, 0.05, 6)), poses[name])
        assert layer.move(others) == 1
        changed = layer.update()
        assert layer.evolved < 0.8 * everything
        mesher.update(*layer.bricks(), changed)
        again = SurfaceLayer(c)
        for k in (2, 0, 3, 1):  # in another order
            again.add(k, pieces[k], others[k])
        for a, b in zip(layer.bricks(), again.bricks()):
            assert np.array_equal(a, b)
        fresh, followed = zero_set(again.bricks(), c.voxel), mesher.mesh()
        assert len(fresh.triangles) > 1000
        assert np.array_equal(fresh.vertices, followed.vertices)
        assert np.array_equal(fresh.triangles, followed.triangles)
    layer.move(poses)
    layer.update()
    assert np.array_equal(layer.bricks()[1], _made(four).bricks()[1])


def _made(four: tuple[SurfaceConfig, dict[int, SurfacePiece], dict[int, Array]]) -> SurfaceLayer:
    layer = SurfaceLayer(four[0])
    for k, piece in four[1].items():
        layer.add(k, piece, four[2][k])
    return layer


def test_position_sigma_is_that_of_drawn_poses(
    four: tuple[SurfaceConfig, dict[int, SurfacePiece], dict[int, Array]],
) -> None:
    layer = _made(four)
    mesh = zero_set(layer.bricks(), layer.config.voxel)
    own = vertex_owners(mesh, layer)
    assert {0, 1, 2, 3} <= set(np.unique(own).tolist())
    assert np.mean(own < 0) < 0.02  # beside the voxels of any piece
    rng = np.random.default_rng(10)
    A = rng.normal(0, 0.02, (6, 6))
    S = A @ A.T
    sigma = position_sigma(mesh, layer, {2: S})
    assert np.array_equal(np.isfinite(sigma), own == 2)
    k = int(np.flatnonzero(own == 2)[100])
    T = layer.poses[2]
    q = se3.se3_transform(se3.se3_inverse(T)[None], mesh.vertices[k][None])
    drawn = se3.se3_compose(
        np.broadcast_to(T, (40_000, 7)), se3.se3_exp(rng.multivariate_normal(np.zeros(6), S, 40_000))
    )
    spread = se3.se3_transform(drawn, np.broadcast_to(q, (40_000, 3)))
    assert sigma[k] == pytest.approx(float(np.sqrt(np.trace(np.cov(spread.T)))), rel=0.03)


# --- the level set -----------------------------------------------------------------------------------------------


def test_curvature_of_a_sphere() -> None:
    z, y, x = np.meshgrid(*[np.arange(10.0)] * 3, indexing="ij")
    for radius in (6.0, 12.0):
        r = np.sqrt((x + radius - 4.0) ** 2 + (y - 4.0) ** 2 + (z - 5.0) ** 2)
        there = np.ones((10, 10, 10), np.uint8)
        assert curvature(r, there, 5, 4, 4) == pytest.approx(2.0 / radius, rel=0.03)
        there[:, :, 5] = 0  # what is not known goes on in a straight line
        assert abs(curvature(x - 4.0 + 0.3 * y, there, 5, 4, 4)) < 1e-9


def test_redistancing_makes_a_distance_and_keeps_the_zero_set() -> None:
    c = SurfaceConfig(voxel=0.05, smoothing=0.0, carving=False, steps=0, redistance_steps=0)
    rng = np.random.default_rng(11)
    p = np.column_stack([rng.uniform(-0.5, 0.5, (6000, 2)), np.full(6000, 0.012)])
    piece = piece_of_planes(p, p + [0, 0, 1.0], np.broadcast_to([0.0, 0, 1], p.shape), np.ones(6000, bool), c)
    squeezed = dataclasses.replace(piece, distance=0.5 * piece.distance, normal=piece.normal // 2)
    slopes = []
    for steps in (0, 16):
        made = dataclasses.replace(c, redistance_steps=steps)
        coordinates, phi, known = layer_of(squeezed, made).bricks()
        mesh = zero_set((coordinates, phi, known), c.voxel)
        assert np.max(np.abs(mesh.vertices[:, 2] - 0.012)) < 0.01 * c.voxel
        z = centres(coordinates)[..., 2] - 0.24
        at = centres(coordinates)
        inner = known & (np.max(np.abs(at[..., :2]), axis=-1) < 5) & (np.abs(z) < 1.6)
        slopes.append(float(np.polyfit(z[inner], phi[inner], 1)[0]))
    assert slopes[0] == pytest.approx(0.5, abs=0.02)
    assert slopes[1] == pytest.approx(1.0, abs=0.05)


# --- files and wrong input ---------------------------------------------------------------------------------------


def test_a_mesh_is_written_and_read_back(tmp_path: Path) -> None:
    c = SurfaceConfig(voxel=0.2, carving=False)
    mesh = zero_set(layer_of(sphere_piece(c), c).bricks(), 0.2)
    colours = np.full((len(mesh.vertices), 4), (10, 200, 30, 255), np.uint8)
    for ending in (".ply", ".glb", ".obj"):
        path = save_mesh(mesh, tmp_path / f"s{ending}", colours)
        again = trimesh.load(path, force="mesh")
        assert len(again.faces) == len(mesh.triangles)
        assert np.allclose(np.sort(again.vertices[:, 2]), np.sort(mesh.vertices[:, 2]), atol=1e-5)
        assert tuple(again.visual.vertex_colors[0][:3]) == (10, 200, 30)
    with pytest.raises(FormatError, match="ending"):
        save_mesh(mesh, tmp_path / "s.stl")
    with pytest.raises(DataError, match="without a triangle"):
        save_mesh(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)), tmp_path / "s.ply")


def test_impossible_input_is_refused() -> None:
    for wrong in ({"voxel": 0.0}, {"smoothing": -1.0}, {"dt": 0.9, "smoothing": 1.0}, {"data": "x"}, {"steps": -1}):
        with pytest.raises(ConfigError, match="surface"):
            SurfaceConfig(**wrong)  # type: ignore[arg-type]
    c = SurfaceConfig()
    with pytest.raises(DataError, match="points of a surface"):
        piece_of_scans([(np.array([[np.nan, 0.0, 0.0]]), np.zeros(3))], IDENTITY, c)
    layer = layer_of(piece_of_scans([], IDENTITY, c), c)
    assert len(zero_set(layer.bricks(), c.voxel).triangles) == 0
    with pytest.raises(DataError, match="there already"):
        layer.read(0, [], IDENTITY)
    with pytest.raises(DataError, match="no surface was read"):
        layer.move({1: IDENTITY})
    far = np.concatenate([np.zeros((9, 3)), np.full((9, 3), 4e4)]) + np.random.default_rng(0).uniform(0, 0.1, (18, 3))
    with pytest.raises(GridError, match="too wide"):
        piece_of_planes(far, far + 1.0, np.broadcast_to([0.0, 0, 1], (18, 3)), np.ones(18, bool), c)
