"""Chains of relative poses."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.poses import SE2, SE3, Group, compose_increments


@pytest.mark.parametrize("group", [SE2, SE3])
def test_each_node_is_where_its_increment_puts_it(group: Group, rng: np.random.Generator) -> None:
    steps = group.exp(rng.normal(size=(7, group.dof)))
    poses = compose_increments(steps)
    assert poses.shape == (8, group.size)
    np.testing.assert_array_equal(poses[0], group.identity)
    np.testing.assert_allclose(group.log(group.between(group.between(poses[:-1], poses[1:]), steps)), 0.0, atol=1e-9)
