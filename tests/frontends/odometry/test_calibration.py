"""Odometry that bends every metre by the same angle: found from scans, and taken out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import se2_exp, se2_log
from graphslam_frontends.odometry.calibration import without_yaw_per_metre, yaw_per_metre
from tests.frontends.grid_world import ring
from tests.frontends.odometry.test_recorded import winding


@pytest.mark.parametrize("rate", [-0.05, 0.0, 0.03])
def test_a_bend_of_every_metre_is_found(rate: float) -> None:
    """In a ring of corridors, whose odometry has noise besides; the sign too."""
    steps = ring(0, 2, length=60.0, yaw_bias=0.0)
    xi = se2_log(steps.odometry.increments)
    xi[:, 2] += rate * np.hypot(xi[:, 0], xi[:, 1])
    bent = dataclasses.replace(steps, odometry=dataclasses.replace(steps.odometry, increments=se2_exp(xi)), errors=None)
    found = yaw_per_metre(bent)
    assert found.pairs > 30
    assert 1e-4 < found.per_metre_sigma < 0.005
    assert abs(found.per_metre - rate) < max(4 * found.per_metre_sigma, 0.004)


def test_taking_out_undoes_what_was_put_in() -> None:
    odometry = winding(2)
    there_and_back = without_yaw_per_metre(without_yaw_per_metre(odometry, 0.05), -0.05)
    np.testing.assert_allclose(there_and_back.increments, odometry.increments, atol=1e-12)
    xi, less = se2_log(odometry.increments), se2_log(without_yaw_per_metre(odometry, 0.05).increments)
    np.testing.assert_allclose(less[:, :2], xi[:, :2], atol=1e-12)
    np.testing.assert_allclose(less[:, 2], xi[:, 2] - 0.05 * np.hypot(xi[:, 0], xi[:, 1]), atol=1e-12)
    with pytest.raises(ConfigError, match="in the plane"):
        without_yaw_per_metre(winding(3), 0.05)


def test_steps_in_space_are_refused() -> None:
    with pytest.raises(ConfigError, match="in space"):
        yaw_per_metre(ring(0, 3, length=8.0))
