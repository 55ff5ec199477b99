"""Simulated streets: heights, labels, and drives of the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam_studies.sim.street import (
    FREE,
    HOLE,
    NEITHER,
    OBSTACLE,
    STEEP,
    STEP,
    TARGETS,
    StreetRobot,
    draw_street,
    drive_street,
)

VEHICLE = {"step": 0.06, "slope": np.deg2rad(15.0), "height": 1.8}


def label(target: str, x: float, y: float = 0.05) -> int:
    street = draw_street(target, 4)
    found = street.labels(np.array([0.0, -2.0]), 0.1, (40, 240), **VEHICLE)
    return int(found[round((y + 1.95) / 0.1), round((street.target_at + x - 0.05) / 0.1)])


@pytest.mark.parametrize(
    ("target", "x", "wanted"),
    [
        ("curb-10", -0.05, STEP), ("curb-10", -1.0, FREE), ("curb-10", 1.0, FREE), ("curb-5", 0.05, NEITHER),
        ("drop", 0.25, HOLE), ("drop", 2.0, NEITHER), ("drop", -0.5, FREE), ("stairs-up", 0.57, STEP),
        ("ramp-25", 1.0, STEEP), ("ramp-10", 1.0, FREE), ("hole-1.0", 0.5, HOLE), ("hole-1.0", 2.0, FREE),
        ("wire-1.2", -0.05, OBSTACLE), ("wire-2.5", -0.05, FREE), ("car", 0.9, OBSTACLE), ("nothing", 0.5, FREE),
    ],
)  # fmt: skip
def test_labels(target: str, x: float, wanted: int) -> None:
    assert label(target, x) == wanted


def test_heights_are_those_of_the_target() -> None:
    for target, x, rise in (("curb-15", 1.0, 0.15), ("stairs-down", 3.0, -8 * 0.17), ("hole-0.5", 0.25, -0.4)):
        street = draw_street(target, 1)
        at = street.target_at + np.array([-0.1, x])
        assert float(np.diff(street.height(at, 0.0) - street.base(at, 0.0))[0]) == pytest.approx(rise)


def test_every_target_makes_a_mesh_and_teaching_streets_are_others() -> None:
    for target in TARGETS:
        vertices, triangles = draw_street(target, 2).mesh()
        assert triangles.max() < len(vertices)
        assert np.all(np.isfinite(vertices))
    assert draw_street("curb-10", 2, teaching=True).figures != draw_street("curb-10", 2).figures
    with pytest.raises(UnknownNameError, match="target of a street"):
        draw_street("moat", 2)


def test_the_same_seed_drives_the_same_way() -> None:
    street = draw_street("curb-10", 2)
    a, b = (drive_street(street, 5, start=3.0, until=1.5) for _ in range(2))
    assert np.array_equal(a.scans.ranges, b.scans.ranges, equal_nan=True)
    assert np.array_equal(a.believed.poses, b.believed.poses)
    other = drive_street(street, 6, start=3.0, until=1.5)
    assert not np.array_equal(a.scans.ranges, other.scans.ranges, equal_nan=True)
    side = drive_street(street, 5, aside=2.0)
    assert np.all(side.scans.spin == 0.0)
    with pytest.raises(ConfigError, match="before the target"):
        drive_street(street, 5, start=1.0)
    with pytest.raises(ConfigError, match="drop_out"):
        StreetRobot(drop_out=2.0)
