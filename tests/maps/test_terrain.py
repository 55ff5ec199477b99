"""Terrain: detectors against their plain twins, range bands, what outvotes what, and tables."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, GeometryError, GridError
from graphslam.core.geometry import Array
from graphslam.core.range_scans import RangeScans
from graphslam.core.trajectory import Trajectory
from graphslam.maps.terrain.line_kernels import ABOVE, OVERHANG, STEP, SUPPORT, DetectorSettings
from graphslam.maps.terrain.lines import DetectorConfig, ScanLines, lines_of_clouds, lines_of_scans, observe_terrain
from graphslam.maps.terrain.plan import CostConfig, cost_map, occupancy_values, save_cost_map
from graphslam.maps.terrain.pyramid import Pyramid, TerrainClass
from graphslam.maps.terrain.tables import (
    BINS,
    TerrainWeights,
    calibrate_probability,
    effective_count,
    fixed_tables,
    noisy_or,
    read_tables,
)
from graphslam.maps.terrain.vehicle import CELLS, LineSensor, Vehicle
from graphslam_studies.maps.learning import fit_calibration, fit_weights, ratios_of
from graphslam_studies.maps.plan import plan_vehicle_path
from graphslam_studies.sim.street import StreetRobot, draw_street, drive_street
from tests.reference.map_server import read_map_server
from tests.reference.plain_terrain import plain_rows

H = 1.1
ELEVATION = np.deg2rad(-65.0 + 0.5 * np.arange(181))
SENSOR, VEHICLE = LineSensor(), Vehicle()
BOX = (-2.0, -2.0, 14.0, 2.0)
FIXED = np.array([-3.0, 0.0, 8.0, -3.0, 0.0, 8.0, 0.7, 0.0, 1.0])
DRIVEN = TerrainWeights(fixed_tables(4, 0.85, 0.4), np.array([FIXED] * 4), FIXED, 0.5, {})


def profile_line(solids: list[tuple[float, float, float, float]], floor: list[tuple[float, float]]) -> Array:
    """Points ``(181, 3)`` of a line along x: a floor, level from each ``(x, z)`` on, and boxes x0, x1, z0, z1."""
    faces = []
    for (x, z), nxt in zip(floor, [*floor[1:], (40.0, floor[-1][1])]):
        faces.append(((x, z), (nxt[0], z)))
        faces.append(((nxt[0], z), (nxt[0], nxt[1])))
    for x0, x1, z0, z1 in solids:
        ring = [(x0, z0), (x1, z0), (x1, z1), (x0, z1), (x0, z0)]
        faces += list(pairwise(ring))
    a, b = (np.array([face[k] for face in faces]) - [0.0, H] for k in (0, 1))
    d = np.column_stack([np.cos(ELEVATION), np.sin(ELEVATION)])[:, None]

    def cross(u: Array, v: Array) -> Array:
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    with np.errstate(divide="ignore", invalid="ignore"):  # where a beam and a face are parallel
        t, u = cross(a, b - a) / cross(d, b - a), cross(a, d) / cross(d, b - a)
    best = np.where((t > 0) & (u >= -1e-9) & (u <= 1 + 1e-9), t, np.inf).min(axis=1)
    best[best >= 30.0] = np.nan
    return np.column_stack([best * d[:, 0, 0], np.full(len(best), 0.05), H + best * d[:, 0, 1]])


def lines_of(points: Array, feet: float = 0.0) -> ScanLines:
    p = np.atleast_3d(points) if points.ndim == 3 else points[None]
    return ScanLines(p, np.tile([0.0, 0.05, H], (len(p), 1)), np.full(len(p), feet))


def observed(points: Array) -> dict[int, dict[int, int]]:
    """Channel → ix of cells of 0.1 m → value, in one band of 0.1 m up to 20 m."""
    rows = np.concatenate(list(observe_terrain(lines_of(points), np.array([20.0]), np.array([0.1]), VEHICLE)))
    out: dict[int, dict[int, int]] = {k: {} for k in range(4)}
    for row in rows[rows[:, 4] < 4]:
        out[int(row[4])][int(row[2])] = int(row[5])
    return out


LEVEL = [(-1.0, 0.0)]


def test_a_curb_is_a_step_where_it_is_and_nowhere_else() -> None:
    steps = observed(profile_line([], [(-1.0, 0.0), (3.02, 0.1)]))[STEP]
    high = [ix for ix, value in steps.items() if value >= 6]
    assert high
    assert all(29 <= ix <= 31 for ix in high)
    assert max(steps.values()) in (7, 8, 9, 10)
    assert max(observed(profile_line([], LEVEL))[STEP].values()) == 0


def test_a_hole_lacks_support_and_the_ground_before_and_behind_it_does_not() -> None:
    found = observed(profile_line([], [(-1.0, 0.0), (2.5, -0.6), (3.5, 0.0)]))
    support = found[SUPPORT]
    # the beam over the edge meets the far wall 0.44 m below; a legal slope would lead 0.27 m down
    assert max(support[ix] for ix in range(27, 34)) >= 15
    assert all(value == 0 for ix, value in support.items() if ix < 24 or ix > 37)
    assert all(ix in support for ix in range(13, 24))


def test_stairs_down_lack_support() -> None:
    floor = [(-1.0, 0.0), *((2.0 + 0.28 * k, -0.17 * (k + 1)) for k in range(8))]
    support = observed(profile_line([], floor))[SUPPORT]
    assert max(value for ix, value in support.items() if 20 <= ix <= 30) >= 15


def test_what_an_obstacle_hides_is_unknown_not_missing() -> None:
    found = observed(profile_line([(3.0, 4.0, 0.0, 0.9)], LEVEL))
    assert any(28 <= ix <= 31 for ix in found[OVERHANG])
    hidden = [ix for ix in found[SUPPORT] if 41 <= ix <= 100]
    assert not hidden
    assert all(value == 0 for value in found[SUPPORT].values())


@pytest.mark.parametrize(("height", "channel"), [(1.2, OVERHANG), (2.5, ABOVE)])
def test_a_wire_is_an_obstacle_only_within_the_height_of_the_vehicle(height: float, channel: int) -> None:
    found = observed(profile_line([(3.2, 3.3, height - 0.05, height)], LEVEL))
    other = ABOVE if channel == OVERHANG else OVERHANG
    assert set(found[channel])
    assert set(found[channel]) <= {31, 32, 33}
    assert not found[other]
    assert max(found[STEP].values()) == 0  # it is no step of the ground below it


def test_a_legal_ramp_is_ground_and_a_steep_one_is_a_step() -> None:
    def ramp(angle: float) -> dict[int, int]:
        steps = [(3.0 + 0.01 * k, 0.01 * k * math.tan(math.radians(angle))) for k in range(300)]
        return observed(profile_line([], [(-1.0, 0.0), *steps]))[STEP]

    assert max(ramp(10.0).values()) <= 3
    assert max(value for ix, value in ramp(25.0).items() if ix > 32) >= 6


def test_detectors_are_those_of_the_plain_twin() -> None:
    rng = np.random.default_rng(5)
    scenes = [
        ([(4.0, 4.3, 2.3, 2.5)], LEVEL),
        ([], [(-1.0, 0.0), (2.4, 0.15), (6.0, -0.4)]),
        ([(3.0, 5.0, 0.0, 1.4), (2.0, 2.05, 1.2, 1.25)], [(-1.0, 0.0), (1.5, -0.5), (2.2, 0.0)]),
        ([(1.2, 1.25, 2.4, 2.5)], [(-1.0, 0.0), *((2.0 + 0.28 * k, 0.17 * (k + 1)) for k in range(8))]),
        ([(0.3, 1.6, 0.0, 0.14)], [(-1.0, 0.0), (2.2, -0.3)]),
    ]
    points = []
    for solids, floor in scenes:
        for sigma in (0.0, 0.02, 0.05):
            line = profile_line(solids, floor)
            line[:, 2] += sigma * rng.standard_normal(len(line))
            line[rng.random(len(line)) < 2.0 * sigma] = np.nan
            ghosts = rng.random(len(line)) < sigma  # reflected: farther along their beams, so below the ground
            line[ghosts] = [0.0, 0.05, H] + 1.5 * (line[ghosts] - [0.0, 0.05, H])
            points.append(line)
    lines = lines_of(np.array(points), 0.01)
    edges, cells = SENSOR.band_edges(), np.array(CELLS)
    made = np.concatenate(list(observe_terrain(lines, edges, cells, VEHICLE)))
    c = DetectorConfig()
    f = DetectorSettings(
        c.smooth, c.window, math.tan(VEHICLE.max_slope), c.residual, c.residual_rate, c.memory, c.support_reach,
        math.tan(VEHICLE.max_slope + math.radians(5.0)), VEHICLE.clearance, VEHICLE.height, c.above_limit,
        VEHICLE.climbable_step, VEHICLE.width,
    )  # fmt: skip
    wanted = plain_rows(lines, edges, cells, f, c.nearest)
    assert np.array_equal(made[np.lexsort(made.T[::-1])], wanted)
    assert {int(k) for k in np.unique(made[:, 4])} == {0, 1, 2, 3, 4, 5}


def row(band: int, x: float, channel: int, value: int, many: int = 1) -> Array:
    ix = math.floor(x / CELLS[band])
    return np.tile(np.array([0, band, ix, 0, channel, value], np.int32), (many, 1))


def at(p: Pyramid, x: float) -> float:
    found = p.classify()
    return float(found.probability[math.floor((0.05 - found.origin[1]) / 0.1), math.floor((x - found.origin[0]) / 0.1)])


def missing(points: Array, foot: float = 0.0, height: float = 1.77) -> list[int]:
    """Depths [cm] that the statements of missing support of one line give; points are places and heights."""
    line = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]])
    lines = ScanLines(line[None], np.array([[0.0, 0.0, foot + height]]), np.array([foot]))
    rows = np.concatenate(list(observe_terrain(lines, SENSOR.band_edges(), np.array(CELLS), VEHICLE)))
    return [int(v) for v in rows[(rows[:, 4] == SUPPORT) & (rows[:, 5] > 0), 5]]


def test_a_fall_begins_on_ground_that_the_vehicle_can_be_on() -> None:
    road = np.column_stack([np.arange(4.1, 9.0, 0.1), np.zeros(49)])
    # the lowest beam meets the road 4.1 m away; one on the bumper of a car is nearer and comes later in the line
    bumper = np.array([[3.9, 0.35], [3.9, 0.45], [3.9, 0.55]])
    assert not missing(np.concatenate([road[:4], bumper, road[4:]]))
    # a hedge of 0.5 m that is led up in small steps, and the road behind it
    hedge = np.column_stack([np.arange(4.7, 5.2, 0.1), [0.05, 0.1, 0.16, 0.22, 0.24]])
    behind = road[road[:, 0] > 5.6]
    assert not missing(np.concatenate([road[:6], hedge, behind]))
    # a terrace of the same height that is as wide as the vehicle, and a drop behind it
    wide = np.column_stack([np.arange(5.2, 6.3, 0.1), np.full(11, 0.24)])
    low = np.column_stack([np.arange(7.4, 8.5, 0.1), np.full(11, -0.5)])
    assert max(missing(np.concatenate([road[:6], hedge, wide, low]))) > 30
    # level road, and a fall of less than the vehicle climbs, or of more
    for depth, lacks in ((0.08, False), (0.5, True)):
        floor = np.column_stack([np.arange(5.62, 7.3, 0.1), np.full(17, -depth)])
        assert bool(missing(np.concatenate([road[:15], floor]))) is lacks
    # the lowest beams of a scanner meet a bumper, and nothing is seen of the road before it
    first = np.array([[3.6, 0.24], [3.7, 0.25], [3.8, 0.25]])
    behind = np.column_stack([np.linspace(4.8, 6.0, 13), np.zeros(13)])
    assert not missing(np.concatenate([first, behind]))
    # the road is as high there, and goes on for the width of the vehicle: what is behind it is a fall
    hill = np.column_stack([np.linspace(3.6, 4.6, 11), np.full(11, 0.25)])
    low = np.column_stack([np.linspace(6.0, 7.0, 11), np.full(11, -0.4)])
    assert max(missing(np.concatenate([hill, low]))) > 20


def test_no_beam_passes_below_ground_that_higher_beams_of_its_line_met() -> None:
    road = np.column_stack([np.arange(4.1, 9.0, 0.1), np.zeros(49)])
    # a mirror image of the road, 0.9 m below it; the beams above it met the road before that place
    mirrored = np.array([[6.6, -0.9]])
    assert not missing(np.concatenate([road[:5], mirrored, road[5:]]))
    # the far wall of a pit: no ground is met nearer than it
    wall = np.array([[5.6, -0.5], [5.6, -0.3], [5.6, -0.1]])
    assert max(missing(np.concatenate([road[:5], wall, road[road[:, 0] > 5.6]]))) > 5
    # the bottom of a ditch goes on below the place of its near edge, and its ground is no road
    floor = np.column_stack([np.linspace(5.6, 6.6, 11), np.full(11, -0.6)])
    assert max(missing(np.concatenate([road[:5], floor]))) > 30


@pytest.mark.parametrize("channel", [STEP, SUPPORT])
@pytest.mark.parametrize(("near", "far"), [(0, 30), (30, 0)])
def test_long_range_evidence_never_overrides_short_range(channel: int, near: int, far: int) -> None:
    alone, both = (Pyramid(BOX, DRIVEN, VEHICLE, SENSOR) for _ in range(2))
    alone.add(row(0, 2.05, channel, near))
    both.add(row(0, 2.05, channel, near))
    both.add(row(3, 2.05, channel, far, many=1000))
    assert at(both, 2.05) == at(alone, 2.05)
    assert (at(both, 2.05) > 0.5) is (near > 0)
    assert (at(both, 2.25) > 0.5) is (far > 0)  # only the far band knows this one
    single = Pyramid(BOX, DRIVEN, VEHICLE, SENSOR, (0.2,) * 4)
    for made in (row(0, 2.05, channel, near), row(3, 2.05, channel, far, many=1000)):
        made[:, 2] = 10
        single.add(made)
    found = single.classify()
    k = math.floor((0.05 - found.origin[1]) / 0.2), math.floor((2.05 - found.origin[0]) / 0.2)
    assert (found.probability[k] > 0.5) is np.bool_(far > 0)  # in a single map it does


def test_something_hanging_is_kept_where_the_ground_below_is_known_from_near() -> None:
    p = Pyramid(BOX, DRIVEN, VEHICLE, SENSOR)
    p.add(row(0, 2.05, STEP, 0, many=50))
    p.add(row(1, 2.05, OVERHANG, 1, many=5))
    assert at(p, 2.05) > 0.9
    p.add(row(0, 2.15, OVERHANG, 1, many=5))  # the near band says in which of the cells
    assert at(p, 2.05) < 0.5 < at(p, 2.15)


def test_classes() -> None:
    p = Pyramid(BOX, DRIVEN, VEHICLE, SENSOR)
    wall = profile_line([(5.0, 5.4, 0.0, 2.0)], [(-1.0, 0.0), (3.0, 0.12)])
    rng = np.random.default_rng(0)
    for _ in range(40):
        line = wall.copy()
        line[:, 2] += 0.003 * rng.standard_normal(len(line))
        p.insert(lines_of(line))
    found = p.classify()
    iy = math.floor((0.05 - found.origin[1]) / 0.1)
    classes = {round(x, 2): TerrainClass(k) for x, k in zip(found.centres()[0].tolist(), found.classes[iy].tolist())}
    assert classes[2.05] is TerrainClass.FREE
    assert classes[3.05] is TerrainClass.STEP or classes[2.95] is TerrainClass.STEP
    assert classes[5.05] is TerrainClass.OBSTACLE
    assert classes[7.05] is TerrainClass.UNKNOWN
    assert abs(found.ground[iy, math.floor((4.05 - found.origin[0]) / 0.1)] - 0.12) < 0.01
    assert SENSOR.hole_reach(VEHICLE, VEHICLE.clearance) < SENSOR.band_edges()[0]
    assert found.provisional[iy, math.floor((4.55 - found.origin[0]) / 0.1)]
    assert not found.provisional[iy, math.floor((2.05 - found.origin[0]) / 0.1)]


def test_sums_do_not_depend_on_the_order_and_pyramids_add() -> None:
    rng = np.random.default_rng(1)
    places, values = rng.integers(-4, 9, (2, 500)), rng.integers(0, 60, 500)
    rows = np.column_stack([np.zeros(500), rng.integers(0, 4, 500), *places, rng.integers(0, 6, 500), values])
    rows = rows.astype(np.int32)
    a, b, c = (Pyramid(BOX, DRIVEN, VEHICLE, SENSOR) for _ in range(3))
    a.add(rows)
    b.add(rows[200:])
    c.add(rows[:200])
    b.merge(c)
    for name in ("ratios", "counts", "heights"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    assert a.outside == b.outside
    with pytest.raises(GridError, match="different boxes"):
        a.merge(Pyramid((0.0, 0.0, 3.0, 3.0), DRIVEN, VEHICLE, SENSOR))


def test_statements_outside_the_box_are_counted() -> None:
    p = Pyramid((0.0, 0.0, 2.0, 2.0), DRIVEN, VEHICLE, SENSOR)
    p.add(np.concatenate([row(0, 1.05, STEP, 3), row(0, 5.05, STEP, 3)]))
    assert p.outside == 1
    assert p.counts[STEP].sum() == 1


def test_bands_end_where_beams_are_a_cell_apart() -> None:
    edges = SENSOR.band_edges()
    assert np.allclose(edges[:3] ** 2 * SENSOR.beam_step / SENSOR.height, CELLS[:3])
    assert edges[3] == pytest.approx(12.05, abs=0.01)
    assert SENSOR.hole_reach(VEHICLE) == pytest.approx(4.105, abs=1e-3)
    for depth in (0.25, 0.3, 1.0):
        reach = SENSOR.hole_reach(VEHICLE, depth)
        down = reach * depth / SENSOR.height  # from the edge to where the beam over it meets the ground below
        assert depth - math.tan(VEHICLE.max_slope) * down == pytest.approx(VEHICLE.climbable_step)
        speed = SENSOR.speed_bound(VEHICLE, depth)
        distance = speed * SENSOR.sweep_time + VEHICLE.braking_distance(speed) + 0.5 * VEHICLE.width
        assert distance == pytest.approx(reach)
    assert SENSOR.speed_bound(VEHICLE) == SENSOR.speed_bound(VEHICLE, VEHICLE.clearance)
    assert SENSOR.hole_reach(VEHICLE, 0.05) == SENSOR.speed_bound(VEHICLE, 0.05) == 0.0
    assert VEHICLE.braking_distance(VEHICLE.safe_speed(3.0)) == pytest.approx(3.0)


def test_probability_is_a_noisy_or() -> None:
    w = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.5, 0.0, 1.0])
    zero = np.zeros((2, 1))

    def p(ratios: Array, *counts: int) -> float:
        return float(noisy_or(ratios, np.array(counts)[:, None], w)[0])

    assert p(zero, 1, 1, 0) == pytest.approx(0.75)
    assert p(zero, 0, 0, 0) == 0.0
    assert p(zero - 500.0, 1, 1, 2) == pytest.approx(1.0 - math.exp(-1.0))
    assert p(zero + [[2.0], [0.0]], 1, 0, 0) == pytest.approx(1.0 / (1.0 + math.exp(-2.0 / 1.2)))
    assert effective_count(np.array(1e6)) == pytest.approx(5.0, rel=1e-4)  # many lines count as five


def test_a_calibrated_probability_is_as_often_right_as_it_says() -> None:
    rng = np.random.default_rng(5)
    p = rng.random(60_000)
    hazard = rng.random(60_000) < calibrate_probability(p, 0.8, 1.5)
    u, v = fit_calibration(p, hazard)
    assert u == pytest.approx(0.8, abs=0.05)
    assert v == pytest.approx(1.5, abs=0.05)
    for low in (0.1, 0.4, 0.7):
        q = calibrate_probability(p, u, v)
        some = (q > low) & (q < low + 0.2)
        assert np.mean(hazard[some]) == pytest.approx(float(q[some].mean()), abs=0.02)
    assert calibrate_probability(np.array([0.3]), 0.0, 1.0)[0] == pytest.approx(0.3)
    assert np.isnan(calibrate_probability(np.array([np.nan]), 0.0, 1.0)[0])


def test_weights_are_found_again() -> None:
    rng = np.random.default_rng(2)
    w = np.array([-2.0, 0.3, 0.8, -3.0, -0.2, 1.2, 0.6, 0.0, 1.0])
    counts = np.stack([*rng.poisson(2.0, (2, 40_000)), rng.poisson(0.3, 40_000)])
    ratios = rng.normal(0, 2, (2, 40_000)) * counts[:2]
    hazard = rng.random(40_000) < noisy_or(ratios, counts, w)
    assert np.allclose(fit_weights(ratios, counts, hazard), w, atol=0.25)
    with pytest.raises(DataError, match="too few cells"):
        fit_weights(ratios, counts, np.zeros(40_000, bool))


def test_ratios_of_histograms() -> None:
    h = np.zeros((2, 3, 1, BINS), np.int64)
    h[0, 0, 0, :5], h[0, 2, 0, 10:] = 1000, 100
    ratios = ratios_of(h) / 256
    assert np.all(ratios[0, 0, :5] < -2.0)
    assert np.all(ratios[0, 0, 10:] > 2.0)
    assert np.all(ratios[1] == 0.0)


def test_what_a_legal_slope_says_as_often_is_no_hazard_however_rare_slopes_are() -> None:
    h = np.zeros((2, 3, 1, BINS), np.int64)
    h[:, 0, 0, 0], h[:, 1, 0, 2:5], h[:, 2, 0, 2:9] = 100_000, 40, 1000
    ratios = ratios_of(h)[0, 0] / 256
    assert np.all(ratios[2:5] < 0.0)  # all of the free ones together say so once in a thousand times
    assert np.all(ratios[6:9] > 2.0)
    h[:, 1] = 0
    assert np.all(ratios_of(h)[0, 0, 2:9] / 256 > 2.0)  # no slope was taught


def test_tables_of_the_package_and_their_file(tmp_path: Path) -> None:
    tables = read_tables()
    assert tables.bands == 4
    assert tables.provenance["seeds"]
    assert tables.provenance["vehicle"]["climbable_step"] == VEHICLE.climbable_step
    tables.write(tmp_path / "t.json")
    again = read_tables(tmp_path / "t.json")
    assert np.array_equal(again.ratios, tables.ratios)
    text = (tmp_path / "t.json").read_text()
    for old, new, said_ in (
        ('"graphslam.terrain-tables/2"', '"other/1"', "unknown format"),
        (f'"threshold": {tables.threshold}', '"threshold": 2.0', "do not fit"),
        ('"support"', '"supports"', "missing"),
    ):
        assert old in text
        (tmp_path / "bad.json").write_text(text.replace(old, new))
        with pytest.raises(FormatError, match=said_):
            read_tables(tmp_path / "bad.json")


def test_impossible_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="climbable"):
        Vehicle(climbable_step=0.4)
    with pytest.raises(ConfigError, match="height"):
        LineSensor(height=0.0)
    with pytest.raises(ConfigError, match="window"):
        DetectorConfig(window=float("nan"))
    with pytest.raises(GridError, match="impossible box"):
        Pyramid((0, 0, 0, 1), DRIVEN, VEHICLE, SENSOR)
    with pytest.raises(GridError, match="too many cells"):
        Pyramid((0, 0, 1e4, 1e4), DRIVEN, VEHICLE, SENSOR)
    with pytest.raises(ConfigError, match="widths"):
        Pyramid(BOX, DRIVEN, VEHICLE, SENSOR, (0.1, 0.2))
    with pytest.raises(GeometryError, match="wrong shape"):
        ScanLines(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(DataError, match="infinite"):
        ScanLines(np.full((1, 4, 3), np.inf), np.zeros((1, 3)), np.zeros(1))


def test_lines_of_scans_follow_the_pose_of_each_beam() -> None:
    down = np.deg2rad([10.0, -30.0])  # highest first: turned round
    scans = RangeScans(
        times=np.array([0.1]),
        ranges=np.array([[2.0, 2.2]]),
        directions=np.column_stack([np.cos(down), np.zeros(2), np.sin(down)]),
        beam_times=np.array([0.0, 0.1]),
        max_range=10.0,
        sigma=0.01,
        T_base_mount=np.array([0.0, 0, 1.1, 0, 0, 0, 1]),
    )
    path = Trajectory(np.array([0.0, 1.0]), np.array([[0.0, 0, 0, 0, 0, 0, 1], [1.0, 0, 0, 0, 0, 0, 1]]))
    lines = lines_of_scans(scans, path, 1.1)
    assert np.allclose(lines.points[0, 0], [0.2 + 2.2 * np.cos(down[1]), 0, 1.1 - 1.1])
    assert np.allclose(lines.points[0, 1, 0], 0.1 + 2.0 * np.cos(down[0]))
    assert lines.feet[0] == pytest.approx(0.0)
    with pytest.raises(DataError, match="outside the path"):
        lines_of_scans(dataclasses.replace(scans, times=np.array([0.95])), path, 1.1)
    level = np.column_stack([np.cos(down), np.sin(down), np.zeros(2)])
    with pytest.raises(DataError, match="no upright lines"):
        lines_of_scans(dataclasses.replace(scans, directions=level), path, 1.1)


def test_lines_of_a_spinning_scanner_are_its_columns() -> None:
    azimuth = np.deg2rad(np.repeat([0.2, 90.2], 3))
    elevation = np.deg2rad(np.tile([-5.0, -20.0, -10.0], 2))
    r = 5.0
    points = r * np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    lines = lines_of_clouds(points, np.zeros(3), -1.7, beams=2)
    filled = np.flatnonzero(np.isfinite(lines.points[:, 0, 0]))
    assert len(filled) == 2
    assert np.allclose(lines.points[filled, :, 2], r * np.sin(np.deg2rad([[-20.0, -10.0]] * 2)))


@pytest.mark.parametrize(
    ("target", "kind"),
    [
        ("curb-15", TerrainClass.STEP),
        ("hole-1.0", TerrainClass.HOLE),
        ("nothing", None),
        ("ramp-down-10", None),
    ],
)
def test_what_lies_ahead_on_a_simulated_street(target: str, kind: TerrainClass | None) -> None:
    street = draw_street(target, 3)
    drive = drive_street(street, 3, StreetRobot(), start=6.0, until=1.5)
    lines = lines_of_scans(drive.scans, drive.believed, drive.robot.height)
    p = Pyramid((8.0, -3.2, 22.4, 3.2), read_tables(), VEHICLE, SENSOR)
    assert p.insert(lines) > 1000
    found = p.classify()
    x, y = found.centres()
    lane = np.abs(y) < 0.5
    ahead = found.classes[lane][:, (x > 15.5) & (x < 17.2)]
    before = found.classes[lane][:, (x > 13.5) & (x < 15.0)]
    assert np.mean(before != TerrainClass.UNKNOWN) > 0.85
    assert np.mean(before > TerrainClass.ABOVE_REACH) < 0.01
    if kind is None:
        assert not np.any(ahead > TerrainClass.ABOVE_REACH)
    else:
        assert np.mean(np.any(ahead == kind, axis=1)) > 0.9  # over its whole width
    truth = street.labels(
        found.origin, found.cell, found.classes.shape,
        step=VEHICLE.climbable_step, slope=VEHICLE.max_slope, height=VEHICLE.height,
    )  # fmt: skip
    assert np.any(truth[lane][:, (x > 15.5) & (x < 17.2)] > 0) == (kind is not None)


def test_ways_lead_round_hazards_and_never_through_them() -> None:
    p = Pyramid(BOX, DRIVEN, VEHICLE, SENSOR)
    for band in (0, 1):
        for iy in range(-20, 20):
            made = np.concatenate([row(band, 0.05 + 0.1 * k, STEP, 0, many=3) for k in range(60)])
            made[:, 3] = iy
            p.add(made)
    wall = np.concatenate([row(0, 3.05, STEP, 30, many=20)] * 24)
    wall[:, 3] = np.repeat(np.arange(-20, 4), 20)
    p.add(wall)
    costs = cost_map(p.classify(), VEHICLE)
    path = plan_vehicle_path(costs, np.array([1.0, 0.0]), np.array([5.0, 0.0]))
    assert path is not None
    off = np.hypot(path.points[:, 0] - 3.05, np.maximum(path.points[:, 1] - 0.35, 0.0))
    assert off.min() >= 0.5 * VEHICLE.width - 0.06
    assert path.length == pytest.approx(np.sum(np.linalg.norm(np.diff(path.points, axis=0), axis=1)))
    assert plan_vehicle_path(costs, np.array([1.0, 0.0]), np.array([3.05, -0.5])) is None
    with pytest.raises(DataError, match="outside the terrain map"):
        plan_vehicle_path(costs, np.array([-9.0, 0.0]), np.array([5.0, 0.0]))
    # of several goals the cheapest to reach, closed ones left out
    near = np.array([[5.0, 0.0], [2.0, 0.5], [3.05, -0.5]])
    to_one = plan_vehicle_path(costs, np.array([1.0, 0.0]), near)
    assert to_one is not None
    assert np.hypot(*(to_one.points[-1] - near[1])) < 0.1
    # a vehicle that stands too near to a wall leaves it on its own side
    stands = np.array([2.75, -0.5])
    assert not np.isfinite(costs.cost[costs.index(stands)])
    out = plan_vehicle_path(costs, stands, near[1])
    assert out is not None
    assert np.array_equal(out.points[0], stands)
    assert np.all(out.points[:, 0] <= 2.8)
    assert plan_vehicle_path(costs, np.array([3.05, -0.5]), near[1]) is None  # … but nothing leads out of a hazard


def test_what_only_coarse_bands_say_costs_but_does_not_close() -> None:
    p = Pyramid(BOX, DRIVEN, VEHICLE, SENSOR)
    p.add(np.concatenate([row(0, 2.05, STEP, 30, many=20), row(3, 9.2, STEP, 30, many=20)]))
    found = p.classify()
    near, far = (2.05, 0.05), (9.2, 0.05)
    for bands, open_ in ((None, False), (2, True), (4, False)):
        costs = cost_map(found, VEHICLE, CostConfig(closing_bands=bands))
        assert np.isfinite(costs.cost[costs.index(np.array(far))]) == open_
        assert not np.isfinite(costs.cost[costs.index(np.array(near))])
    costs = cost_map(found, VEHICLE, CostConfig(closing_bands=2))
    assert costs.cost[costs.index(np.array(far))] > 15.0
    with pytest.raises(ConfigError, match="closing_bands"):
        CostConfig(closing_bands=0)


def test_cost_maps_are_files_of_a_map_server(tmp_path: Path) -> None:
    p = Pyramid((0.0, 0.0, 1.6, 0.8), DRIVEN, VEHICLE, SENSOR)
    p.add(np.concatenate([row(0, 0.05, STEP, 0, many=5), row(0, 1.45, STEP, 30, many=20)]))
    costs = cost_map(p.classify(), Vehicle(width=0.1))
    wanted = occupancy_values(costs)
    assert {-1, 100} < set(np.unique(wanted))
    for mode in ("raw", "scale"):
        yaml, image = save_cost_map(costs, tmp_path / f"{mode}.yaml", mode=mode)
        assert image.suffix == (".pgm" if mode == "raw" else ".png")
        cells, info = read_map_server(yaml)
        np.testing.assert_array_equal(cells, wanted)
        assert info["mode"] == mode
        assert info["resolution"] == costs.cell
        np.testing.assert_allclose(info["origin"], [*costs.origin, 0.0], atol=1e-6)
    # every value that a cell may have, in either mode
    every = dataclasses.replace(costs, cost=np.geomspace(1.0, 1e4, costs.cost.size).reshape(costs.cost.shape))
    for mode in ("raw", "scale"):
        cells, _ = read_map_server(save_cost_map(every, tmp_path / "every.yaml", mode=mode)[0])
        np.testing.assert_array_equal(cells, occupancy_values(every))
    with pytest.raises(FormatError, match="mode"):
        save_cost_map(costs, tmp_path / "x.yaml", mode="trinary")
    with pytest.raises(FormatError, match="ending"):
        save_cost_map(costs, tmp_path / "x.pgm")
