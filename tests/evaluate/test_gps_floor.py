"""The floor under GPS residuals: segments, their bias, and what two passes over one place say of the GPS itself."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import GpsResiduals, gps_residuals
from graphslam.evaluate.gps_repeatability import fix_segments
from graphslam_studies.evaluate.gps_repeatability import revisit_disagreement, segment_table


def residuals(times: list[float], points: list[list[float]], errors: list[list[float]]) -> GpsResiduals:
    return GpsResiduals(
        times=np.array(times),
        residuals=np.array(errors, dtype=float).reshape(-1, 2),
        points=np.array(points, dtype=float).reshape(-1, 2),
        T_gps_map=np.zeros(3),
        lever=np.zeros(2),
        fitted=0,
        outside=0,
        in_gap=0,
    )


def test_a_pause_starts_a_segment() -> None:
    assert fix_segments(np.array([0.0, 1.0, 3.0, 5.1, 6.0])).tolist() == [0, 0, 0, 1, 1]
    assert fix_segments(np.array([0.0, 1.0, 3.0]), gap=0.5).tolist() == [0, 1, 2]
    assert fix_segments(np.zeros(0)).tolist() == []
    with pytest.raises(DataError, match="not positive"):
        fix_segments(np.zeros(1), gap=0.0)


def test_segment_table_by_hand() -> None:
    t = segment_table(residuals([0, 1, 10, 11], np.zeros((4, 2)), [[3, 4], [3, 4], [1, 0], [-1, 0]]))
    assert t["fixes"].tolist() == [2, 2]
    assert t["t_start"].tolist() == [0, 10]
    assert t["bias"].tolist() == [5.0, 0.0]
    assert t["scatter"].tolist() == [0.0, 1.0]
    assert segment_table(residuals([], [], [])).empty


def test_disagreement_by_hand() -> None:
    """Two places: at the first, passes 0 and 1 differ by 5 m; at the second, passes 1 and 2 by 2 m."""
    r = residuals(
        [0, 1, 10, 11, 20],
        [[0, 0], [0.5, 0], [1, 0], [100, 0], [100, 1]],
        [[3, 4], [3, 4], [0, 0], [0, 2], [0, 0]],
    )
    t = revisit_disagreement(r, radius=2.0)
    assert t[["first", "second", "pairs"]].to_numpy().tolist() == [[0, 1, 2], [1, 2, 1]]
    assert t["disagreement"].tolist() == [5.0, 2.0]
    assert len(revisit_disagreement(r, radius=2.0, min_pairs=2)) == 1
    assert revisit_disagreement(r, radius=0.6)["pairs"].tolist() == [1]  # neighbours of one segment are no revisit
    assert revisit_disagreement(residuals([], [], [])).empty
    with pytest.raises(DataError, match="radius"):
        revisit_disagreement(r, radius=-1.0)


def test_disagreement_finds_the_error_of_one_fix_whatever_the_map_does_to_the_frame(rng: np.random.Generator) -> None:
    """Ten laps of one circle, each with its own GPS bias of σ per coordinate: the floor is √2 σ · Rayleigh median."""
    sigma, laps = 1.2, 40
    times = np.arange(laps * 100.0)
    angle = 2 * np.pi * times / 100.0
    path = np.stack([30 * np.cos(angle), 30 * np.sin(angle), angle + np.pi / 2], -1)
    seen = times % 100.0 < 60.0
    lap = (times // 100).astype(int)
    fixes = path[:, :2] + rng.normal(0, sigma, (laps, 2))[lap]
    gps = Gps(times=times[seen], positions=fixes[seen] + [500, -20], sigma=np.ones(seen.sum()), lever=[0, 0])
    r = gps_residuals(Trajectory(times, path), gps)
    found = revisit_disagreement(r, radius=0.5)
    assert len(found) == laps * (laps - 1) // 2
    # difference of two biases has √2 σ a coordinate; the median length of a 2-D Gaussian of s is s √(2 ln 2)
    assert found["disagreement"].median() == pytest.approx(np.sqrt(2) * sigma * np.sqrt(2 * np.log(2)), rel=0.2)
    table = segment_table(r)
    assert len(table) == laps
    assert table["scatter"].max() < 1e-9  # all of it is bias
    assert np.sqrt(np.mean(table["bias"] ** 2)) == pytest.approx(np.sqrt(2) * sigma, rel=0.25)
