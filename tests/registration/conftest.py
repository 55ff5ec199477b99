"""Maps that are dear enough to be made once."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.geometry import Array
from graphslam.registration.target import Target
from tests.reference.box_world import BoxWorld, hall, survey
from tests.registration.halls import along, flat_map


@pytest.fixture(scope="module")
def garage() -> tuple[BoxWorld, Array, Target]:
    """A hall with parked cars, the points of its map, and these prepared."""
    world, rng = hall(cars=24), np.random.default_rng(11)
    points = survey(world, along(rng), 3000, 0.025, 25.0, rng)
    return world, points, Target(points, voxel=0.3)


@pytest.fixture(scope="module")
def planar() -> tuple[BoxWorld, Target]:
    world = hall(cars=24)
    return world, flat_map(world, np.random.default_rng(12))
