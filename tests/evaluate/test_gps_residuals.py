"""GPS residuals: alignment, lever, counts; by hand and on simulated fixes of known noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_inverse
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import gps_residuals, move_to_gps_frame
from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field

FRAME = (500.0, -200.0, 1.2)


def fixes(times: list[float], positions: list, lever: tuple[float, float] = (0.0, 0.0)) -> Gps:
    return Gps(times=times, positions=positions, sigma=np.ones(len(times)), lever=lever)


DRIVE = Trajectory([0.0, 10.0], [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])


def test_residuals_with_a_given_alignment_by_hand() -> None:
    g = fixes([0.0, 5.0, 10.0], [[0, 1], [5, -2], [13, 4]])
    r = gps_residuals(DRIVE, g, T_gps_map=np.zeros(3))
    assert r.residuals.tolist() == [[0.0, 1.0], [0.0, -2.0], [3.0, 4.0]]
    assert r.errors.tolist() == [1.0, 2.0, 5.0]
    s = r.statistics
    assert s.rmse == pytest.approx(np.sqrt(30 / 3))
    assert (s.median, s.maximum, s.count) == (2.0, 5.0, 3)
    assert r.fitted == 0
    assert "no scale" in r.as_row()["gauge"]


def test_lever_turns_with_the_heading() -> None:
    """Antenna 2 m ahead and 1 m to the left of a base that stands at the origin looking along y."""
    t = Trajectory([0.0, 1.0], [[0, 0, np.pi / 2], [0, 0, np.pi / 2]])
    r = gps_residuals(t, fixes([0.5], [[-1.0, 2.0]], lever=(2.0, 1.0)), T_gps_map=np.zeros(3))
    assert np.allclose(r.residuals, 0.0, atol=1e-12)
    other = gps_residuals(t, fixes([0.5], [[-1.0, 2.0]], lever=(2.0, 1.0)), lever=[0.0, 0.0], T_gps_map=np.zeros(3))
    assert np.allclose(other.residuals, [[-1.0, 2.0]], atol=1e-12)


def test_fixes_outside_and_in_gaps_are_counted_not_scored() -> None:
    t = Trajectory([0.0, 1.0, 9.0, 10.0], [[0, 0, 0], [1, 0, 0], [9, 0, 0], [10, 0, 0]])
    g = fixes([-1.0, 0.5, 1.0, 5.0, 9.5, 11.0, 12.0], [[k, 0] for k in (-1, 0.5, 1.0, 5, 9.5, 11, 12)])
    r = gps_residuals(t, g, max_gap=2.0)
    assert r.times.tolist() == [0.5, 1.0, 9.5]
    assert (r.outside, r.in_gap, r.fitted) == (3, 1, 3)
    assert gps_residuals(t, g).times.tolist() == [0.5, 1.0, 5.0, 9.5]


def test_alignment_is_rigid_and_finds_the_frame() -> None:
    log = simulate_landmark_field(
        landmark_field_preset("demo", gps_rate=5.0, gps_lever=(2.0, 0.5), gps_frame=FRAME, noise_scale=0.0), 0
    )
    r = gps_residuals(log.truth.trajectory, log["gps"])
    assert np.allclose(r.T_gps_map, FRAME, atol=1e-9)
    assert r.statistics.maximum < 1e-9
    moved = move_to_gps_frame(log.truth.trajectory, r)
    assert np.allclose(moved.poses[0], FRAME, atol=1e-9)
    # a map that is 1 % too large cannot be fitted away
    t = log.truth.trajectory
    large = Trajectory(t.times, t.poses * [1.01, 1.01, 1.0])
    assert gps_residuals(large, log["gps"]).statistics.rmse > 0.3


def test_rmse_on_a_perfect_map_is_the_noise_of_the_fixes() -> None:
    """Two-sided: n fixes of σ per coordinate, three parameters fitted, leave χ² with 2n - 3 degrees of freedom."""
    log = simulate_landmark_field(landmark_field_preset("demo", gps_rate=5.0, gps_sigma=1.5, gps_frame=FRAME), 3)
    r = gps_residuals(log.truth.trajectory, log["gps"])
    chi2 = float(np.sum(r.residuals**2)) / 1.5**2
    low, high = stats.chi2.ppf([0.001, 0.999], 2 * len(r.times) - 3)
    assert low < chi2 < high
    assert r.outside == 0


def test_withheld_fixes_do_not_take_part_in_the_alignment() -> None:
    log = simulate_landmark_field(landmark_field_preset("demo", gps_rate=5.0, gps_frame=FRAME), 3)
    g = log["gps"]
    fit = np.arange(len(g.times)) % 2 == 0
    spoiled = Gps(times=g.times, positions=g.positions + 50.0 * ~fit[:, None], sigma=g.sigma, lever=g.lever)
    a = gps_residuals(log.truth.trajectory, g, fit=fit, score=~fit)
    b = gps_residuals(log.truth.trajectory, spoiled, fit=fit, score=~fit)
    assert np.array_equal(a.T_gps_map, b.T_gps_map)
    assert a.fitted == fit.sum()
    assert len(a.times) == (~fit).sum()
    assert b.statistics.rmse > 60.0


def test_map_in_any_frame_scores_the_same() -> None:
    log = simulate_landmark_field(landmark_field_preset("quick", gps_rate=5.0), 3)
    t = log.truth.trajectory
    a = gps_residuals(t, log["gps"])
    b = gps_residuals(t.transformed(se2_inverse(np.array([3.0, 4.0, 2.0]))), log["gps"])
    assert np.allclose(a.residuals, b.residuals, atol=1e-9)


def test_what_cannot_be_scored_is_refused() -> None:
    with pytest.raises(DataError, match="too few fixes"):
        gps_residuals(DRIVE, fixes([1.0, 50.0], [[0, 0], [1, 1]]))
    with pytest.raises(DataError, match="masks"):
        gps_residuals(DRIVE, fixes([1.0, 2.0], [[0, 0], [1, 1]]), fit=np.ones(3, dtype=bool))
    spatial = Trajectory([0.0, 10.0], [[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 1]])
    with pytest.raises(DataError, match="2-D"):
        gps_residuals(spatial, fixes([1.0, 2.0], [[0, 0], [1, 1]]))
    empty = gps_residuals(DRIVE, fixes([20.0], [[0, 0]]), T_gps_map=np.zeros(3))
    assert empty.outside == 1
    with pytest.raises(DataError, match="no errors"):
        _ = empty.statistics
