"""A robot driven step by step through a street."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam_studies.sim.street import FREE, HOLE, PASSAGE, StreetRobot, draw_street
from graphslam_studies.sim.street_rover import Command, RoverState, StreetRover

ROBOT = StreetRobot(beams=31, beam_step=3.0)
WAY = np.array([[8.0, 0.0], [12.0, 0.0], [12.0, 3.0]])


def rover(seed: int = 3, **options: float) -> StreetRover:
    return StreetRover(draw_street("curb-10", 1), seed, ROBOT, longest=20.0, **options)


def test_it_keeps_to_its_way_as_well_as_it_knows_where_it_is() -> None:
    one = rover()
    state, off, away = RoverState(place=WAY[0]), [], []
    for _ in range(12):
        state, scans, believed, places = one.drive(state, Command(WAY, 1.0), 0.5)
        x, y = believed.poses[:50, 0], believed.poses[:50, 1]
        off.append(np.minimum(np.abs(y), np.abs(x - 12.0)))
        away.append(np.hypot(x - places[:, 0], y - places[:, 1]))
        assert believed.times[0] <= scans.times[0]
        assert scans.times[-1] + scans.beam_times[-1] <= believed.times[-1]
    assert np.concatenate(off).max() < 0.005  # what it believes is on the way …
    assert 0.005 < np.concatenate(away).max() < 0.15  # … and where it is differs by the error of its pose
    assert state.speed == pytest.approx(1.0)


def test_what_is_foreseen_comes_true_and_every_run_is_the_same() -> None:
    one, two = rover(), rover()
    state = RoverState(place=WAY[0])
    command = Command(WAY, 1.0)
    for _ in range(3):
        foreseen = one.after(state, command, 0.5)
        new, scans, believed, _ = one.drive(state, command, 0.5)
        _, again, same, _ = two.drive(state, command, 0.5)
        assert np.array_equal(scans.ranges, again.ranges, equal_nan=True)
        assert np.array_equal(believed.poses, same.poses)
        assert (foreseen.time, foreseen.speed, foreseen.along) == (new.time, new.speed, new.along)
        assert np.array_equal(foreseen.place, new.place)
        state = new
    other = rover(4).drive(RoverState(place=WAY[0]), command, 0.5)[1]
    assert not np.array_equal(other.ranges, two.drive(RoverState(place=WAY[0]), command, 0.5)[1].ranges)


def test_it_brakes_as_fast_as_it_can_and_turns_where_it_stands() -> None:
    one = rover(acceleration=0.8)
    straight = Command(np.array([[0.0, 0.0], [20.0, 0.0]]), 1.0)
    state = one.after(RoverState(speed=1.0), replace_speed(straight, 0.0), 5.0)
    assert state.speed == 0.0
    assert state.along == pytest.approx(1.0 / (2 * 0.8), abs=0.02)
    back = Command(np.array([[0.0, 0.0], [-5.0, 0.0]]), 1.0)
    turned = one.after(RoverState(), back, 1.0)
    assert turned.along == 0.0
    assert abs(turned.yaw) == pytest.approx(1.5, abs=0.02)
    with pytest.raises(ConfigError, match="rover"):
        rover(acceleration=0.0)


def replace_speed(command: Command, speed: float) -> Command:
    return replace(command, speed=speed)


def test_a_passage_is_level_and_free_and_what_is_beside_it_is_not() -> None:
    street = replace(draw_street("drop", 2), passage=0.4)
    u = np.array([16.5])
    inside, beside = street.raised(u, np.array([0.4])), street.raised(u, np.array([0.4 + 0.5 * PASSAGE + 0.1]))
    assert inside[0] == 0.0
    assert beside[0] == pytest.approx(-0.3)
    labels = street.labels(
        np.array([15.0, -2.0]), 0.1, (40, 20), step=0.06, slope=math.radians(15.0), height=1.8
    )  # fmt: skip
    assert np.all(labels[22:26, 8:18] == FREE)
    assert np.all(labels[5:8, 11:13] == HOLE)
