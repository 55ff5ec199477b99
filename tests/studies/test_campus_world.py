"""The campus: its place, its robot, its lasers among things that move, and GPS among buildings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphslam.app.worlds import simulate, world_of, write_simulated
from graphslam.core.errors import ConfigError, DataError, UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.imu import GRAVITY
from graphslam.core.log import BeamLabels, SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import VelocityControls
from graphslam.core.se3 import quat_multiply, quat_rotate, se3_compose, se3_transform, so3_exp
from graphslam.io.log_digest import log_digest
from graphslam.io.log_store import load_log
from graphslam.sim.crawler_sensors import scan_rays, true_inertia
from graphslam.sim.raycast import RayCaster
from graphslam_studies.sim.campus import campus_motion, empty_scans, movers_of, pan_angle, slip_wheels
from graphslam_studies.sim.campus_config import CampusConfig, campus_preset
from graphslam_studies.sim.campus_plan import plan_campus
from graphslam_studies.sim.campus_world import CEILING, campus
from graphslam_studies.sim.gps_shadowing import (
    GpsFixSeries,
    draw_satellites,
    measure_gps,
    nearest_wall,
    satellites_in_view,
)
from graphslam_studies.sim.movers import Mover, clear_of
from tests.reference.plain_mesh import box, merge, plain_ranges, quad

QUICK = campus_preset("quick")
EXACT = dataclasses.replace(QUICK, noise_scale=0.0, drop_out=0.0)
SEED = 1


@pytest.fixture(scope="module")
def exact() -> SensorLog:
    return simulate("campus", preset="quick", seed=SEED, noise_scale=0.0, drop_out=0.0)


@pytest.fixture(scope="module")
def noisy() -> SensorLog:
    return simulate("campus", preset="quick", seed=SEED)


def in_world(log: SensorLog, times: Array) -> Array:
    poses = log.truth.trajectory.interpolate(times)
    return se3_compose(np.broadcast_to(log.meta["T_world_frame"], poses.shape), poses)


def robot(config: CampusConfig = QUICK) -> SeedTree:
    return SeedTree(SEED).child("campus", "robot", config.session)


# ---------------------------------------------------------------- the place


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("preset", ["quick", "block", "three-blocks"])
def test_nothing_stands_in_the_way(preset: str, seed: int) -> None:
    world = campus(campus_preset(preset), seed=seed)
    route = world.route()
    path = route.positions(route.every(0.3)) + [0.0, 0.0, 0.7]
    assert RayCaster.of(world).distances(path).min() > 0.5
    assert world.meta["corridors"]
    assert len(world.meta["roofs"]) % 2 == 0


def test_the_way_goes_up_a_ramp_through_a_corridor_with_a_right_angle_and_down(exact: SensorLog) -> None:
    (corridor,), ((begin, end),) = exact.meta["corridors"], exact.meta["indoor"]
    assert corridor["angle"] == np.pi / 2
    path, floor = exact.truth.trajectory, corridor["floor"]
    axle = exact.meta["config"]["axle"]
    heights = in_world(exact, path.times)[:, 2] - axle
    inside = (path.times > begin) & (path.times < end)
    np.testing.assert_allclose(heights[inside], floor, atol=1e-6)
    assert 0.15 < floor < 0.5
    assert np.mean(heights < 1e-6) > 0.3  # streets are level
    assert np.mean((heights > 0.02) & (heights < floor - 0.02)) > 0.02  # and ramps lead up and down
    first, second = (leg[0] for leg in corridor["legs"])
    heading = []
    for a, b in (first, second):
        ends = in_world(exact, np.array([a, b]))[:, :2]
        heading.append(np.arctan2(*(ends[1] - ends[0])[::-1]))
        assert begin <= a < b <= end
        assert np.linalg.norm(ends[1] - ends[0]) > 10.0
    turn = abs((heading[0] - heading[1] + np.pi) % (2 * np.pi) - np.pi)
    assert turn == pytest.approx(np.pi / 2, abs=1e-6)


def test_indoor_is_under_a_ceiling(exact: SensorLog) -> None:
    t = exact.truth.trajectory.times[::40]
    ((begin, end),) = exact.meta["indoor"]
    p = in_world(exact, t)[:, :3]
    up = RayCaster.of(world_of(exact)).ranges(np.hstack([p, np.broadcast_to([0, 0, 1.0], p.shape)]))
    inside = (t > begin + 0.2) & (t < end - 0.2)
    np.testing.assert_allclose(up[inside], CEILING - QUICK.axle, atol=0.3)  # a door's lintel is lower
    outside = (t < begin - 1.0) | (t > end + 1.0)
    assert np.mean(np.isnan(up[outside])) > 0.9  # but for a tree's crown


def test_sessions_share_a_place_and_a_far_one_sees_nothing_of_it() -> None:
    base = campus_preset("three-blocks")
    paths, meshes = [], []
    for changes in ({}, {"session": 1}, {"far": True}):
        world = campus(dataclasses.replace(base, **changes), seed=2)
        route = world.route()
        paths.append(route.positions(route.every(1.0))[:, :2])
        meshes.append(world.vertices)
    for other in meshes[1:]:
        assert other.tobytes() == meshes[0].tobytes()
    gap = [np.linalg.norm(paths[0][:, None] - w[None], axis=2) for w in paths[1:]]
    assert np.mean(gap[0].min(axis=1) < 3.0) > 0.5
    assert gap[1].min() > base.max_range
    assert not np.array_equal(paths[0], paths[1])
    assert len(campus(dataclasses.replace(base), seed=3).vertices) != len(meshes[0])


def test_a_corridor_whose_last_piece_is_too_short_for_a_door_ends_in_a_longer_room() -> None:
    """Two in twenty-one of the largest places had one, and were not built at all."""
    wide = {"size": (600.0, 800.0), "block": 90.0, "open_share": 0.7, "visits": 3, "round": False}
    world = campus(campus_preset("full", **wide), seed=5062472233008329382)
    assert len(world.meta["corridors"]) == 3


def test_two_doors_that_face_each_other_are_one_place() -> None:
    """Seed 1 of the whole campus has a way out of one building straight into the next."""
    world = campus(campus_preset("full", clutter=0.0), seed=1)
    assert np.linalg.norm(np.diff(world.waypoints[:, :2], axis=0), axis=1).min() > 1e-3
    assert world.meta["size"] == [600.0, 800.0]
    assert np.ptp(world.vertices, axis=0)[:2] == pytest.approx([660.0, 860.0])


def test_what_cannot_be_is_refused() -> None:
    for changes in (
        {"size": (40.0, 40.0)},
        {"far": True},
        {"movers": -1},
        {"every": 0},
        {"gyro": (1e-3, 1e-4)},
        {"lean": 1.0},
        {"clock_offset": np.nan},
        {"speed": 0.0},
        {"beams": 3.5},
        {"wheels": 1},
    ):
        with pytest.raises(ConfigError, match="campus: "):
            campus_preset("block", **changes)
    with pytest.raises(UnknownNameError):
        campus_preset("village")
    with pytest.raises(ConfigError, match="no layouts"):
        simulate("campus", layout="A")
    with pytest.raises(ConfigError, match="open_share"):
        campus(campus_preset("quick", open_share=0.0), seed=0)


# ---------------------------------------------------------------- the robot


def test_it_pitches_about_once_a_second_and_never_more_than_stated() -> None:
    world = campus(QUICK, seed=SEED)
    motion = campus_motion(world, QUICK, robot())
    t = np.arange(0.0, motion.duration, 0.01)
    lean = motion.lean(t)[0]
    assert np.abs(lean).max() <= QUICK.lean
    assert np.abs(lean).max() > 0.5 * QUICK.lean
    crossings = np.sum(np.diff(np.sign(lean)) > 0) / t[-1]
    assert 0.7 < crossings < 1.3
    still = campus_motion(world, dataclasses.replace(QUICK, lean=0.0), robot())
    np.testing.assert_allclose(motion.poses(t)[:, :3], still.poses(t)[:, :3], atol=1e-12)


def test_exact_inertia_of_a_robot_that_balances_integrates_to_its_path() -> None:
    motion = campus_motion(campus(QUICK, seed=SEED), QUICK, robot())
    t = np.arange(0.0, 40.0, 0.002)
    rate, force, _ = true_inertia(motion, t, [0.0, 0, 0.4, 0, 0, 0, 1])
    true = motion.poses(t)
    lever = np.array([0.0, 0.0, 0.4])
    q, v = true[0, 3:], motion.velocities(t[:1])[0] + quat_rotate(true[0, 3:], np.cross(rate[0], lever))
    p = se3_transform(true[0], lever)
    for k in range(len(t) - 1):
        q_next = quat_multiply(q, so3_exp(0.001 * (rate[k] + rate[k + 1])))
        a = 0.5 * (quat_rotate(q, force[k]) + quat_rotate(q_next, force[k + 1])) - [0.0, 0.0, GRAVITY]
        p, v, q = p + 0.002 * v + 0.5 * 0.002**2 * a, v + 0.002 * a, q_next
    np.testing.assert_allclose(p, se3_transform(true[-1], lever), atol=5e-3)


def test_wheels_slip_as_stated() -> None:
    n, sigma = 20000, 0.02
    wheels = VelocityControls(times=0.04 * np.arange(n), speed=np.full(n, 1.0), yaw_rate=np.zeros(n))
    error = np.concatenate([slip_wheels(wheels, sigma, 0.4, 1.0, SeedTree(k)).speed for k in range(4)]) - 1.0
    # samples ten steps apart share e^-1 of their error: an effective number, and four σ on either side
    effective = len(error) / 21.0
    assert abs(np.mean(error**2) / sigma**2 - 1.0) < 4.0 * np.sqrt(2.0 / effective)
    assert np.corrcoef(error[10:], error[:-10])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.08)
    assert np.array_equal(slip_wheels(wheels, sigma, 0.4, 0.0, SeedTree(0)).speed, wheels.speed)


def test_figures_are_drawn_within_their_ranges_over_the_whole_of_them() -> None:
    drawn = [QUICK.draw(SeedTree(k)) for k in range(300)]
    for name, values in ((n, np.array([d[n] for d in drawn])) for n in drawn[0]):
        low, high = getattr(QUICK, name)
        assert low <= values.min() < values.max() <= high
        share = np.log(values / low) / np.log(high / low)
        assert abs(share.mean() - 0.5) < 4.0 / np.sqrt(12 * 300)
        assert abs(share.var() - 1 / 12) < 4.0 * np.sqrt((1 / 80 - 1 / 144) / 300)


# ---------------------------------------------------------------- lasers


def test_beams_are_those_of_a_slow_caster_among_things_that_move(exact: SensorLog) -> None:
    """Ranges and labels against casting one triangle at a time, every mover put where it is at the beam's time."""
    world = world_of(exact)
    motion = campus_motion(world, EXACT, robot())
    movers = movers_of(world, EXACT, motion, SEED, robot().child("movers"))
    assert [m.kind for m in movers] == [m["kind"] for m in exact.meta["movers"]]
    assert {m.kind for m in movers} == {"car", "person"}
    rng = np.random.default_rng(0)
    met: set[int] = set()
    for name, ideal in empty_scans(EXACT, motion.duration, 0.01).items():
        scans, labels = exact[name], exact.truth.moving[name].labels
        assert ideal.times.tobytes() == scans.times.tobytes()
        rays = scan_rays(ideal, motion)
        moving, still = np.flatnonzero(labels.ravel() >= 0), np.flatnonzero(labels.ravel() < 0)
        chosen = np.concatenate([rng.choice(moving, 60, replace=False), rng.choice(still, 120, replace=False)])
        times = (ideal.times[:, None] + ideal.beam_times).ravel()[chosen]
        wanted = plain_ranges(world.vertices, world.triangles, rays[chosen])
        who = np.full(len(chosen), -1)
        for k, m in enumerate(movers):
            place, u = m.state(times)
            for row in range(len(chosen)):
                solid = merge(*(box(b[:3], b[3:]) for b in m.boxes))
                x = solid[0][:, :1] * u[row] + solid[0][:, 1:2] * np.array([-u[row, 1], u[row, 0]])
                corners = np.column_stack([place[row] + x, m.floor + solid[0][:, 2]])
                r = plain_ranges(corners, solid[1], rays[chosen[row]][None])[0]
                if r < (wanted[row] if np.isfinite(wanted[row]) else np.inf):
                    wanted[row], who[row] = r, k
        got, far = scans.ranges.ravel()[chosen], ~(wanted < scans.max_range)
        np.testing.assert_array_equal(got >= scans.max_range, far)
        good = np.abs(got[~far] - wanted[~far]) < 2e-3
        assert good.mean() > 0.98  # an edge may be met or not in single precision
        np.testing.assert_array_equal(labels.ravel()[chosen][~far][good], who[~far][good])
        assert np.sum(who >= 0) >= 55
        met |= set(who.tolist())
    assert len(met) > 2


def test_movers_keep_their_distance_from_the_robot_and_move(exact: SensorLog) -> None:
    world = world_of(exact)
    motion = campus_motion(world, EXACT, robot())
    movers = movers_of(world, EXACT, motion, SEED, robot().child("movers"))
    t = np.arange(0.0, motion.duration, 0.05)
    p = motion.poses(t)[:, :3]
    for m in movers:
        assert clear_of(m, t, p, 0.4)
        place, u = m.state(t)
        speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / 0.05
        assert np.median(speed) == pytest.approx(m.speed, rel=1e-6)
        np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0)
    standing = dataclasses.replace(movers[0], start=p[100, :2] - [5.0, 0], end=p[100, :2] + [5.0, 0], floor=p[100, 2])
    assert not clear_of(dataclasses.replace(standing, speed=1e-9, phase=5.0), t, p, 0.4)


def test_rays_along_the_faces_of_a_mover() -> None:
    m = Mover(
        kind="car", start=np.zeros(2), end=np.array([10.0, 0.0]), floor=0.0, speed=1.0, phase=0.0,
        boxes=np.array([[-1.0, -1.0, 0.0, 1.0, 1.0, 1.0]]),
    )  # fmt: skip
    down = np.array([[2.0, 0.0, 3.0, 0, 0, -1], [4.5, 0, 3, 0, 0, -1], [2, 0, 0.5, 0, 0, -1], [-8, 0.5, 0.5, 1, 0, 0]])
    np.testing.assert_allclose(m.hits(down, np.full(4, 2.0)), [2.0, np.inf, np.inf, 9.0])
    assert np.isinf(m.hits(np.array([[-8, 0.5, 0.5, -1.0, 0, 0]]), np.zeros(1)))[0]


def test_the_panning_laser_goes_from_side_to_side_in_two_seconds(exact: SensorLog) -> None:
    s = exact["panning"]
    full = dataclasses.replace(QUICK, every=1, every_beam=1)
    t = np.arange(0.0, 8.0, 1.0 / 75.0)
    angle = pan_angle(full, t)
    assert angle.min() == pytest.approx(-QUICK.pan)
    assert angle.max() == pytest.approx(QUICK.pan)
    np.testing.assert_allclose(np.abs(np.diff(angle)), np.deg2rad(120.0) / 150.0, atol=1e-9)  # 150 lines a sweep
    np.testing.assert_allclose(np.diff(np.flatnonzero(np.diff(np.sign(np.diff(angle))))), 150)
    lines = empty_scans(full, 8.0, 0.01)["panning"]
    np.testing.assert_allclose(np.diff(np.arcsin(lines.directions[:, 0])), np.deg2rad(0.5))
    origin, d = s.head_rays()
    middle = d[:, len(s.beam_times) // 2]
    np.testing.assert_allclose(
        np.arctan2(middle[:, 1], middle[:, 0]), pan_angle(QUICK, s.times + s.beam_times[30]), atol=1e-6
    )
    np.testing.assert_allclose(middle[:, 2], 0.0, atol=1e-12)
    assert origin[2] > 0.5
    across = exact["vertical"].head_rays()[1]
    np.testing.assert_allclose(across[..., 0], 0.0, atol=1e-12)
    assert np.all(across[..., 1] > 0.3)  # to the left


def test_offsets_of_encoder_and_clock_change_what_is_written_and_nothing_else(exact: SensorLog) -> None:
    off = simulate(
        "campus", preset="quick", seed=SEED, noise_scale=0.0, drop_out=0.0, encoder_offset=0.02, clock_offset=0.05
    )
    for name in ("panning", "vertical"):
        a, b = exact[name], off[name]
        assert a.ranges.tobytes() == b.ranges.tobytes()
        np.testing.assert_allclose(b.times - a.times, 0.05)
        np.testing.assert_allclose(b.spin - a.spin, 0.02 if name == "panning" else 0.0)
        np.testing.assert_array_equal(off.truth.moving[name].times, b.times)
    for name in ("imu", "wheels", "gps"):
        assert off[name].times.tobytes() == exact[name].times.tobytes()


def test_ranges_have_the_stated_noise(exact: SensorLog, noisy: SensorLog) -> None:
    for name in ("panning", "vertical"):
        a, b = exact[name].ranges, noisy[name].ranges
        met = np.isfinite(b) & (b < QUICK.max_range - 0.2) & (a < QUICK.max_range - 0.2)
        e = (b - a)[met] / noisy.meta["noise"]["range_sigma"]
        n = len(e)
        assert n > 10_000
        assert abs(np.mean(e)) < 4.0 / np.sqrt(n)
        assert abs(np.mean(e**2) - 1.0) < 4.0 * np.sqrt(2.0 / n)
        assert abs(np.mean(np.isnan(b)) - QUICK.drop_out) < 4.0 * np.sqrt(QUICK.drop_out / b.size)


# ---------------------------------------------------------------- GPS


def test_satellites_are_in_view_where_no_triangle_is_before_them(rng: np.random.Generator) -> None:
    world = campus(QUICK, seed=SEED)
    caster, sky = RayCaster.of(world), draw_satellites(QUICK, SeedTree(5))
    assert sky.shape == (QUICK.satellites, 3)
    np.testing.assert_allclose(np.linalg.norm(sky, axis=1), 1.0)
    assert sky[:, 2].min() >= np.sin(QUICK.mask)
    path = world.route().positions(np.linspace(0.0, world.route().length, 20)) + [0.0, 0.0, 1.8]
    rays = np.hstack([np.repeat(path, len(sky), axis=0), np.tile(sky, (len(path), 1))])
    wanted = np.isnan(plain_ranges(world.vertices, world.triangles, rays)).reshape(len(path), -1)
    seen = satellites_in_view(caster, path, sky)
    np.testing.assert_array_equal(seen, wanted)
    inside = plan_campus(QUICK, SEED).inside(path)
    assert inside.sum() > 2
    assert not seen[inside].any(axis=1).all()
    assert seen.sum(axis=1).max() > 8
    wall = nearest_wall(RayCaster(*quad([3, -50, 0], [3, 50, 0], [3, 50, 5], [3, -50, 5])), np.array([[0.0, 0, 1]]))
    assert wall[0] == pytest.approx(3.0)


def test_there_is_no_fix_inside_and_exact_fixes_are_where_the_antenna_is(exact: SensorLog, noisy: SensorLog) -> None:
    for log in (exact, noisy):
        g, ((begin, end),) = log["gps"], log.meta["indoor"]
        inside = (g.times > begin + 4.0) & (g.times < end - 4.0)
        assert not inside.any()
        assert end - begin > 30.0
        assert np.mean((g.times < begin) | (g.times > end)) > 0.9
        assert len(g.times) > 0.6 * (log.duration - (end - begin))
    g = exact["gps"]
    antenna = se3_transform(in_world(exact, g.times), np.broadcast_to(g.lever, (len(g.times), 3)))
    np.testing.assert_allclose(g.positions, antenna, atol=1e-4)


def fixes(config: CampusConfig, mesh: Any, seed: int, **figures: float) -> GpsFixSeries:
    motion = campus_motion(campus(QUICK, seed=SEED), QUICK, robot())
    drawn = {**QUICK.draw(SeedTree(0)), **figures}
    return measure_gps(motion, RayCaster(*mesh), config, drawn, SeedTree(seed))


def whitened(f: GpsFixSeries) -> Array:
    """Errors of fixes ``(n, 3)``, of unit covariance where they are as stated."""
    error = f.positions - f.truth
    return np.asarray(np.linalg.solve(np.linalg.cholesky(f.covariances), error[..., None])[..., 0])


GROUND = quad([-100, -100, -1], [200, -100, -1], [200, 200, -1], [-100, 200, -1])


def test_errors_of_fixes_are_as_stated_under_an_open_sky_and_larger_upwards() -> None:
    config = dataclasses.replace(QUICK, gps_rate=10.0, orbit_time=0.02)  # errors new at every fix
    z, ratio = [], []
    for seed in range(6):
        f = fixes(config, GROUND, seed, orbit_sigma=0.6, code_sigma=0.4)
        assert f.hidden.sum() == 0
        z.append(whitened(f))
        sigmas = np.sqrt(np.diagonal(f.covariances, axis1=1, axis2=2))
        ratio.append(sigmas[:, 2] / sigmas[:, :2].mean(axis=1))
    e = np.concatenate(z)
    n = len(e)
    np.testing.assert_array_less(np.abs(e.mean(axis=0)), 4.0 / np.sqrt(n))
    np.testing.assert_array_less(np.abs(np.mean(e**2, axis=0) - 1.0), 4.0 * np.sqrt(2.0 / n))
    assert min(r.min() for r in ratio) > 1.0
    correlated = fixes(dataclasses.replace(QUICK, gps_rate=10.0), GROUND, 0, orbit_sigma=1.0, code_sigma=0.2)
    e = (correlated.positions - correlated.truth)[:, 0]
    assert np.corrcoef(e[10:], e[:-10])[0, 1] > 0.5  # as far apart as a second
    f = fixes(config, GROUND, 0, orbit_sigma=0.6, code_sigma=0.4)
    e = (f.positions - f.truth)[:, 0]
    assert abs(np.corrcoef(e[10:], e[:-10])[0, 1]) < 4.0 / np.sqrt(len(e))


def test_walls_hide_satellites_and_make_errors_that_are_not_stated() -> None:
    """A wall to the north of the whole way: fixes lean, and the receiver does not know why."""
    wall = merge(GROUND, quad([-100, 75, -1], [200, 75, -1], [200, 75, 60], [-100, 75, 60]))
    config = dataclasses.replace(QUICK, gps_rate=4.0)
    figures = {"orbit_sigma": 0.3, "code_sigma": 0.2, "hidden_share": 0.4, "hidden_way": 12.0, "reflect_sigma": 2.0}
    z_open, z_wall, hidden = [], [], 0
    for seed in range(6):
        a, b = fixes(config, GROUND, seed, **figures), fixes(config, wall, seed, **figures)
        z_open.append(np.mean(whitened(a) ** 2))
        z_wall.append(np.mean(whitened(b) ** 2))
        hidden += b.hidden.sum()
        assert b.seen[1].mean() < a.seen[1].mean()
    assert hidden > 100
    assert np.mean(z_wall) > 4.0 * np.mean(z_open)


# ---------------------------------------------------------------- the log


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    short: dict[str, Any] = {"preset": "quick", "every": 75, "every_beam": 10}
    a, b = (log_digest(simulate("campus", seed=7, **short)) for _ in range(2))
    assert a == b
    other = simulate("campus", seed=8, world_seed=7, **short)
    c = log_digest(other)
    assert all(a[k] != c[k] for k in ("panning", "imu", "wheels", "gps"))
    np.testing.assert_array_equal(world_of(other).vertices, campus(QUICK, seed=7).vertices)


def test_a_log_comes_back_from_disk_with_its_truth_and_the_place(noisy: SensorLog, tmp_path: Path) -> None:
    write_simulated(noisy, tmp_path / "log")
    back = load_log(tmp_path / "log")
    assert log_digest(back) == log_digest(noisy)
    for name, labels in noisy.truth.moving.items():
        got = back.truth.moving[name]
        assert got.labels.dtype == np.int16
        np.testing.assert_array_equal(got.labels, labels.labels)
        part = back.slice(50.0, 60.0)[name]
        inside = (labels.times >= 50.0) & (labels.times <= 60.0)
        np.testing.assert_array_equal(got.of(part.times), labels.labels[inside])
    assert back.meta["indoor"] == noisy.meta["indoor"]
    assert back.meta["mesh"]["file"] == "mesh.ply"
    other = dataclasses.replace(noisy.truth, moving={})
    assert log_digest(dataclasses.replace(noisy, truth=other))["(truth)"] != log_digest(noisy)["(truth)"]


def test_labels_that_do_not_fit_are_refused() -> None:
    labels = BeamLabels(np.array([0.0, 1.0]), np.array([[1, -1], [0, 2]]))
    np.testing.assert_array_equal(labels.of(np.array([1.0])), [[0, 2]])
    for times in ([0.5], [2.0]):
        with pytest.raises(DataError, match="stamp"):
            labels.of(np.array(times))
    with pytest.raises(DataError, match="labels"):
        BeamLabels(np.array([0.0, 1.0]), np.array([[1, -1]]))
    with pytest.raises(DataError, match="labels"):
        BeamLabels(np.array([0.0]), np.array([[0.5]]))
