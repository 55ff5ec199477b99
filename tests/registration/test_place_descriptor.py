"""Descriptors of places: the same whichever way one stands, compared as a plain loop would, told apart in a hall."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.poses import heading_of
from graphslam.evidence.views import GridView
from graphslam.loops.appearance import AppearanceConfig, appearance_candidates
from graphslam.loops.places import Places
from graphslam.registration.place_descriptor import (
    DescriptorConfig,
    PlaceDescriptors,
    concatenate_descriptors,
    describe_places,
    descriptor_similarity,
)
from tests.reference.box_submaps import mapped, straight_path
from tests.reference.box_world import hall, heading

SMALL = DescriptorConfig(rings=5, sectors=12, least=5, blur=0.0)


def random_descriptors(n: int, seed: int = 0) -> PlaceDescriptors:
    rng = np.random.default_rng(seed)
    known = (rng.random((n, 5, 12)) < 0.8).astype(float)
    return PlaceDescriptors(rng.random((n, 5, 12)) * known, known, SMALL)


def plain_similarity(query: PlaceDescriptors, which: int, other: PlaceDescriptors, row: int) -> tuple[float, int]:
    """Correlation over the bins that both know, turn by turn."""
    best, at = -1.0, 0
    fewer = min(query.known[which].sum(), other.known[row].sum())
    for t in range(12):
        v, k = (np.roll(a, t, axis=1) for a in (query.values[which], query.known[which]))
        both = (k > 0) & (other.known[row] > 0)
        if both.sum() < max(SMALL.known * fewer, SMALL.least):
            continue
        a, b = other.values[row][both], v[both]
        r = float(np.corrcoef(a, b)[0, 1])
        if r > best:
            best, at = r, t
    return best, at


def test_similarity_is_that_of_a_plain_loop() -> None:
    D, E = random_descriptors(4), random_descriptors(6, seed=1)
    for which in range(4):
        r, turn = descriptor_similarity(D, which, E, np.arange(6))
        for row in range(6):
            wanted, t = plain_similarity(D, which, E, row)
            assert r[row] == pytest.approx(wanted, abs=1e-9)
            assert math.cos(turn[row] - 2 * math.pi * t / 12) == pytest.approx(1.0)


def test_bins_that_only_one_knows_are_not_compared() -> None:
    D = random_descriptors(1)
    half = D.known.copy()
    half[:, :, 6:] = 0.0
    cut = PlaceDescriptors(D.values * half, half, SMALL)
    assert descriptor_similarity(cut, 0, D, np.array([0]))[0][0] == pytest.approx(1.0)
    hardly = np.zeros_like(half)
    hardly[:, 0, :4] = 1.0
    few = PlaceDescriptors(D.values * hardly, hardly, SMALL)
    assert descriptor_similarity(few, 0, D, np.array([0]))[0][0] == -1.0


@pytest.fixture(scope="module")
def drive() -> tuple[Places, PlaceDescriptors]:
    """There along one side of a hall, and back along the other with the eyes the other way."""
    world, rng = hall(cars=24), np.random.default_rng(5)
    there, back = straight_path(6.0, 54.0, 8.0), straight_path(52.0, 8.0, 8.6, yaw=np.pi)
    grids = mapped(world, there, rng), mapped(world, back, rng)
    T = np.array([heading(x, 0, 0, 0) for x in np.arange(2.0, 42.0, 3.0)])
    D = [describe_places(GridView(g), T) for g in grids]
    n = len(T)
    places = Places(
        np.arange(2 * n), np.repeat([0, 1], n), np.concatenate([T, T]),
        np.concatenate([T[:, 0], 100 + T[:, 0]]), np.arange(2.0 * n),
    )  # fmt: skip
    return places, concatenate_descriptors(D)


def test_a_place_looks_the_same_whichever_way_one_stands() -> None:
    grid = mapped(hall(cars=24), straight_path(10.0, 40.0, 8.0), np.random.default_rng(0))
    T = np.stack([heading(15.0, 0.5, 0.0, 0.0), heading(15.0, 0.5, 0.0, math.radians(40.0), 0.1)])
    D = describe_places(GridView(grid), T)
    r, turn = descriptor_similarity(D, 1, D, np.array([0]))
    assert r[0] > 0.97
    assert turn[0] == pytest.approx(math.radians(40.0), abs=math.radians(2.6))
    # rings do not turn at all
    np.testing.assert_allclose(*D.ring_keys(), atol=0.02)


def test_second_visits_are_found_with_their_heading(drive: tuple[Places, PlaceDescriptors]) -> None:
    places, D = drive
    n = len(places) // 2
    x_there, x_back = 6.0 + places.T_base_node[:n, 0], 52.0 - places.T_base_node[n:, 0]
    right = []
    for j in range(n):
        r, turn = descriptor_similarity(D, n + j, D, np.arange(n))
        near = np.abs(x_there - x_back[j])
        if near.min() < 2.0:
            k = int(np.argmax(r))
            right.append(near[k] <= 3.5)
            if right[-1]:
                assert abs(abs(turn[k]) - math.pi) < math.radians(8.0)
    assert len(right) > 8
    assert np.mean(right) > 0.7
    found = appearance_candidates(places, D, AppearanceConfig(top=1, lead=0.0))
    assert found
    assert np.mean([abs(x_there[c.i] - x_back[c.j - n]) <= 4.0 for c in found]) > 0.5
    for c in found:
        assert c.source == "appearance"
        assert abs(abs(heading_of(c.T_ij)) - math.pi) < 0.2 or abs(x_there[c.i] - x_back[c.j - n]) > 4.0
        assert np.sqrt(c.covariance[3, 3]) == 2.0
    assert appearance_candidates(places, D, exclude=[(1, 0)]) == []


def test_places_that_look_like_many_are_not_given(drive: tuple[Places, PlaceDescriptors]) -> None:
    places, D = drive
    same = PlaceDescriptors(np.repeat(D.values[:1], len(D), 0), np.repeat(D.known[:1], len(D), 0), D.config)
    assert appearance_candidates(places, same, AppearanceConfig(stretch=3.0)) == []
    assert appearance_candidates(places, same, AppearanceConfig(stretch=3.0, lead=0.0)) != []


def test_what_is_impossible_is_refused(drive: tuple[Places, PlaceDescriptors]) -> None:
    places, D = drive
    with pytest.raises(DataError):
        appearance_candidates(places, concatenate_descriptors([D, D]))
    grid = mapped(hall(), straight_path(10.0, 12.0, 8.0), np.random.default_rng(0))
    with pytest.raises(GeometryError):
        describe_places(GridView(grid), np.zeros((2, 3)))
    for bad in ({"radius": 0.0}, {"low": 2.0}, {"rings": 0}, {"known": 1.5}):
        with pytest.raises(ConfigError):
            DescriptorConfig(**bad)
    with pytest.raises(ConfigError):
        AppearanceConfig(sigma=0.0)
