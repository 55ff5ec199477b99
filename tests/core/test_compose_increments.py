"""Poses of a chain, by doubling, against the plain loop."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.poses import SE2, SE3, compose_increments


@pytest.mark.parametrize("group", [SE2, SE3])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 64, 1001])
def test_poses_are_those_of_the_plain_loop(group, n: int, rng: np.random.Generator) -> None:
    increments = group.exp(0.3 * rng.standard_normal((n, group.dof)))
    plain = [group.identity]
    for T in increments:
        plain.append(group.compose(plain[-1], T))
    made = compose_increments(increments)
    assert made.shape == (n + 1, group.size)
    assert np.abs(group.log(group.between(np.array(plain), made))).max() < 1e-11
    # a chain that goes on later has the same first poses, to the last bit
    assert made[: n // 2 + 1].tobytes() == compose_increments(increments[: n // 2]).tobytes()
