"""Odometry that bends every metre by the same angle: taken out."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import se2_log
from graphslam_frontends.odometry.recorded import without_yaw_per_metre
from tests.frontends.odometry.test_recorded import winding


def test_taking_out_undoes_what_was_put_in() -> None:
    odometry = winding(2)
    there_and_back = without_yaw_per_metre(without_yaw_per_metre(odometry, 0.05), -0.05)
    np.testing.assert_allclose(there_and_back.increments, odometry.increments, atol=1e-12)
    xi, less = se2_log(odometry.increments), se2_log(without_yaw_per_metre(odometry, 0.05).increments)
    np.testing.assert_allclose(less[:, :2], xi[:, :2], atol=1e-12)
    np.testing.assert_allclose(less[:, 2], xi[:, 2] - 0.05 * np.hypot(xi[:, 0], xi[:, 1]), atol=1e-12)
    with pytest.raises(ConfigError, match="in the plane"):
        without_yaw_per_metre(winding(3), 0.05)
