"""The look-ahead window stands where dead reckoning puts it, and says whether the log reaches to its end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.poses import group_of
from graphslam.core.records import Odometry
from graphslam_frontends.segslam.window import gather_look_ahead
from tests.frontends.grid_world import ring


@pytest.mark.parametrize("dim", [2, 3])
def test_points_ahead_lie_where_the_true_motion_puts_them(dim: int) -> None:
    steps = ring(1, dim, length=12.0, beams=40)
    truth = steps.truth.poses
    group = group_of(truth)
    first = np.zeros((1, truth.shape[1]))
    first[0] = group.identity
    exact = np.concatenate([first, group.between(truth[:-1], truth[1:])])
    odometry = Odometry(times=steps.times, increments=exact, covariances=steps.odometry.covariances)
    steps = replace(steps, odometry=odometry)
    ahead = gather_look_ahead(steps, 7, 2.0)
    assert (ahead.step, ahead.last, ahead.full) == (7, 12, True)
    expected = []
    for k in range(8, 13):
        p, _, returns = steps.scan(k)
        T = group.between(truth[7], truth[k])
        expected.append(group.transform(np.broadcast_to(T, (int(returns.sum()), group.size)), p[returns]))
    np.testing.assert_allclose(ahead.window.points, np.concatenate(expected), atol=1e-9)
    assert ahead.window.beams == 5 * 40
    near = ahead.source(25, 3.0)
    assert len(near) == 25
    assert np.linalg.norm(near, axis=1).max() <= 3.0
    assert len(ahead.source(0, np.inf)) == len(ahead.window)
    assert len(ahead.window.thinned(30)) == 30


def test_at_the_end_of_the_log_the_window_is_not_full() -> None:
    steps = ring(1, 2, length=8.0, beams=20)
    n = len(steps)
    assert gather_look_ahead(steps, n - 6, 2.0).full
    short = gather_look_ahead(steps, n - 5, 2.0)
    assert (short.full, short.last) == (False, n - 1)
    empty = gather_look_ahead(steps, n - 1, 2.0)
    assert (empty.last, len(empty.window), len(empty.source(10, 5.0))) == (n - 1, 0, 0)
