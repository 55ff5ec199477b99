"""The small world: closed all round, a way that comes back, things that move with the seed and never stand in it."""

from __future__ import annotations

import numpy as np

from graphslam.sim.raycast import RayCaster
from graphslam.sim.ring_hall import ring_hall


def test_way_comes_back_and_is_free() -> None:
    w = ring_hall(seed=1)
    route = w.route()
    (revisit,) = w.meta["revisits"]
    assert revisit["same_heading"]
    assert abs(revisit["again"][1] - route.length) < 0.02
    first, again = (route.positions(np.array(revisit[k])) for k in ("first", "again"))
    assert np.all(np.linalg.norm(first - again, axis=1) < 1.0)
    # half a metre around the way, at the height of the scanner, nothing stands
    s = route.every(0.5)
    p = route.positions(s) + [0.0, 0.0, 0.7]
    a = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    d = np.column_stack([np.cos(a), np.sin(a), np.zeros(12)])
    ranges = RayCaster.of(w).ranges(np.column_stack([np.repeat(p, 12, axis=0), np.tile(d, (len(p), 1))]))
    assert ranges.min() > 0.5
    assert np.all(np.isfinite(ranges))


def test_no_beam_leaves_it() -> None:
    w = ring_hall(seed=2)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(4000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    s = rng.uniform(0.0, w.route().length, 4000)
    ranges = RayCaster.of(w).ranges(np.column_stack([w.route().positions(s) + [0.0, 0.0, 0.9], d]))
    assert np.all(ranges < 21.0)


def test_parallel_stretches_lie_side_by_side() -> None:
    w = ring_hall()
    ((one, other),) = w.meta["parallel"]
    a, b = (w.route().positions(np.linspace(*stretch, 9)) for stretch in (one, other))
    np.testing.assert_allclose(np.abs(a[:, 1] - b[:, 1]), 8.0, atol=1e-9)
    assert min(np.ptp(a[:, 0]), np.ptp(b[:, 0])) > 7.0


def test_seed_moves_things_and_nothing_else() -> None:
    a, b, c = ring_hall(seed=0), ring_hall(seed=1), ring_hall(seed=0)
    assert np.array_equal(a.vertices, c.vertices)
    assert not (a.vertices.shape == b.vertices.shape and np.array_equal(a.vertices, b.vertices))
    assert np.array_equal(a.waypoints, b.waypoints)
    assert a.meta["things"] > 3
