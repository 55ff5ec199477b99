"""Likelihoods of a scan: their formulas, beams that say nothing, and that the true pose wins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.likelihood import CastLikelihood, EndpointLikelihood, log_weights
from graphslam.evidence.queries import HIT, INSIDE, LEFT, MAX_RANGE, UNKNOWN_SPACE, UNUSABLE, cast_beams

HALF = np.array([3.05, 2.05, 1.55])  # in the middle of voxels of 0.1 m


def room_scan(origin: Array, directions: Array) -> Array:
    """End points, from the origin, of beams on the walls of a box."""
    with np.errstate(divide="ignore"):
        t = np.where(directions > 0, (HALF - origin) / directions, (-HALF - origin) / directions)
    return directions * t.min(axis=1, keepdims=True)


@pytest.fixture
def room(rng: np.random.Generator) -> EvidenceGrid:
    grid = EvidenceGrid(0.1)
    for _ in range(20):
        origin = rng.uniform(-0.5, 0.5, 3)
        d = rng.normal(size=(3000, 3))
        grid.insert_scan(room_scan(origin, d / np.linalg.norm(d, axis=1)[:, None]) + rng.normal(0, 0.01, (3000, 3)),
                         pose=[*origin, 0, 0, 0, 1])  # fmt: skip
    return grid


def test_cast_formula() -> None:
    model = CastLikelihood(1.0, sigma=0.2, clip=3.0)
    status = np.array([HIT, HIT, INSIDE, MAX_RANGE, LEFT, MAX_RANGE, HIT, UNUSABLE, HIT])
    expected = np.array([5.0, 5.0, 0.0, 20.0, 12.0, 20.0, 5.0, np.nan, 5.0])
    measured = np.array([5.1, 9.0, 0.1, np.inf, 25.0, 19.9, np.inf, 4.0, np.nan])
    clip = -0.5 * 9.0
    wanted = [-0.5 * 0.5**2, clip, -0.5 * 0.5**2, 0.0, 0.0, -0.5 * 0.5**2, clip, clip, 0.0]
    np.testing.assert_allclose(model.beams(expected, status, measured, 20.0), wanted, atol=1e-12)


def test_unknown_space_tells_nothing_unless_a_beam_ended_before_it() -> None:
    status, expected = np.full(3, UNKNOWN_SPACE), np.full(3, 4.0)
    measured = np.array([6.0, 3.9, 2.0])
    mild = CastLikelihood(1.0, ignore_unknown=False, unknown=1.0)
    np.testing.assert_allclose(mild.beams(expected, status, measured, 20.0), [-0.5, -0.5, -4.5])
    strict = CastLikelihood(1.0, ignore_unknown=False)
    np.testing.assert_allclose(strict.beams(expected, status, measured, 20.0), -4.5)


def test_endpoint_formula() -> None:
    model = EndpointLikelihood(1.0, floor=0.1)
    np.testing.assert_allclose(model.beams([0.0, 0.5, 1.0, np.nan]), [np.log(0.1), np.log(0.55), 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("model", "other"),
    [
        (EndpointLikelihood(0.5), EndpointLikelihood(1.0)),
        (EndpointLikelihood(0.5, interpolation="nearest"), EndpointLikelihood(1.0, interpolation="nearest")),
        (CastLikelihood(0.05), CastLikelihood(0.1)),
        (CastLikelihood(0.05, ignore_unknown=False), CastLikelihood(0.1, ignore_unknown=False)),
    ],
)
def test_the_true_pose_wins(rng: np.random.Generator, room: EvidenceGrid, model: Any, other: Any) -> None:
    d = rng.normal(size=(120, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    truth = np.array([0.2, -0.1, 0.1])
    scan = room_scan(truth, d) + rng.normal(0, 0.01, (120, 3))
    shifts = np.array([[0, 0, 0], [0.3, 0, 0], [0, -0.3, 0], [0, 0, 0.3], [-1, 0.5, 0]])
    poses = np.column_stack([truth + shifts, np.tile([0.0, 0, 0, 1], (5, 1))])
    grids = [room] * 5
    w = log_weights(grids, poses, scan, model, max_range=20.0)
    assert w.shape == (5,)
    assert np.argmax(w) == 0
    assert w[0] > w[1:4].max() + 0.5
    assert w[4] < w[1:4].max()
    # the exponent scales, and nothing else does
    np.testing.assert_allclose(log_weights(grids, poses, scan, other, max_range=20.0), 2.0 * w, rtol=1e-12)
    assert (log_weights(grids, poses, scan, model, max_range=20.0, threads=2) == w).all()
    # beams that cannot be used say nothing, whatever they are called
    odd = np.concatenate([scan, np.full((2, 3), np.nan), np.zeros((1, 3))])
    np.testing.assert_allclose(log_weights(grids, poses, odd, model, max_range=20.0), w, rtol=1e-12)
    returns = np.ones(len(odd), bool)
    returns[120:] = False
    np.testing.assert_allclose(log_weights(grids, poses, odd, model, max_range=20.0, returns=returns), w, rtol=1e-12)


def test_weights_are_sums_over_single_beams(rng: np.random.Generator, room: EvidenceGrid) -> None:
    pose = np.array([[0.2, -0.1, 0.1, 0, 0, 0, 1.0]])
    scan = rng.normal(0, 1.5, (30, 3))
    origin = np.array([0.05, 0.0, 0.1])
    for model in (CastLikelihood(0.1), EndpointLikelihood(0.7)):
        single = [
            log_weights([room], pose, scan[k : k + 1], model, origin=origin, max_range=10.0)[0] for k in range(30)
        ]
        whole = log_weights([room], pose, scan, model, origin=origin, max_range=10.0)
        assert whole[0] == pytest.approx(sum(single))
    found = cast_beams(room, origin, scan - origin, 10.0, pose=pose[0])
    z = np.minimum(np.abs(np.linalg.norm(scan - origin, axis=1) - found.ranges) / 0.2, 3.0)
    assert log_weights([room], pose, scan, CastLikelihood(0.1), origin=origin, max_range=10.0)[0] == pytest.approx(
        0.1 * np.sum(-0.5 * z * z)
    )


def test_beams_without_return(rng: np.random.Generator, room: EvidenceGrid) -> None:
    pose = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
    scan = np.array([[1.0, 0.2, 0.1], [0.3, 1.0, 0.2]])
    none = np.zeros(2, bool)
    # the walls stand nearer than 10 m, so a beam that met nothing contradicts the map; within 1 m it does not
    assert log_weights([room], pose, scan, CastLikelihood(1.0), max_range=10.0, returns=none)[0] == -9.0
    assert log_weights([room], pose, scan, CastLikelihood(1.0), max_range=1.0, returns=none)[0] == 0.0
    assert log_weights([room], pose, scan, EndpointLikelihood(1.0), max_range=10.0, returns=none)[0] == 0.0
    assert log_weights([], np.zeros((0, 7)), scan, EndpointLikelihood(1.0)).shape == (0,)


def test_impossible_models_are_refused(room: EvidenceGrid) -> None:
    for make in (
        lambda: EndpointLikelihood(0.0),
        lambda: EndpointLikelihood(np.nan),
        lambda: EndpointLikelihood(1.0, floor=0.0),
        lambda: EndpointLikelihood(1.0, unknown=2.0),
        lambda: EndpointLikelihood(1.0, interpolation="cubic"),
        lambda: CastLikelihood(-1.0),
        lambda: CastLikelihood(1.0, sigma=0.0),
        lambda: CastLikelihood(1.0, clip=np.inf),
        lambda: CastLikelihood(1.0, unknown=5.0),
        lambda: log_weights([room], [[0.0, 0, 0, 0, 0, 0, 1]], np.ones((1, 3)), CastLikelihood(1.0)),
    ):
        with pytest.raises(ConfigError):
            make()
    with pytest.raises(TypeError):
        CastLikelihood()  # type: ignore[call-arg]  # no exponent is right without being chosen
