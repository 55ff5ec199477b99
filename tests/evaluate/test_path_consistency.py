"""NEES of every pose of a path is that of the run's own chart, and its errors and σ are those along the map's axes."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.app.report.curves import _Axis, extreme_rows
from graphslam.core import se3
from graphslam.core.charts import apply_inverse_left_jacobian
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_compose, se2_exp, wrap_angle
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.consistency import joint_nees
from graphslam.evaluate.path_consistency import map_errors, path_consistency

RNG = np.random.default_rng(17)


def covariances(n: int, d: int) -> np.ndarray:
    A = 0.1 * RNG.standard_normal((n, d, d))
    return A @ np.swapaxes(A, 1, 2) + 1e-4 * np.eye(d)


@pytest.mark.parametrize("chart", ["group", "cartesian"])
def test_a_pose_in_the_plane_is_judged_as_the_metric_of_the_run_judges_it(chart: str) -> None:
    """That metric takes the vector (x, y, θ), bent along the arc in the group chart, with the vector's covariance."""
    n, h = 40, 1e-6
    x = np.column_stack([5.0 * RNG.standard_normal((n, 2)), RNG.uniform(-np.pi, np.pi, n)])
    P = covariances(n, 3)
    true = se2_compose(x, se2_exp(RNG.standard_normal((n, 3))))  # headings that differ by much
    steps = h * np.eye(3)
    J = np.stack(
        [(se2_compose(x, se2_exp(np.tile(s, (n, 1)))) - se2_compose(x, se2_exp(np.tile(-s, (n, 1))))) for s in steps], 2
    )
    J[:, 2] = wrap_angle(J[:, 2])
    J /= 2.0 * h
    e = true - x
    e[:, 2] = wrap_angle(e[:, 2])
    if chart == "group":
        e[:, :2] = apply_inverse_left_jacobian(e[:, :2], e[:, 2])
    got, Q = map_errors(x, P, true, chart)
    assert got == pytest.approx(e, abs=1e-9)
    assert pytest.approx(J @ P @ np.swapaxes(J, 1, 2), abs=1e-6) == Q
    times = np.arange(n, dtype=np.float64)
    made = path_consistency(Trajectory(times, x, P), Trajectory(times, true), chart=chart)
    wanted = [joint_nees(a, covariance=b) for a, b in zip(e, J @ P @ np.swapaxes(J, 1, 2))]
    assert made.nees == pytest.approx(wanted, rel=1e-5)
    assert made.errors == pytest.approx(e, abs=1e-9)
    assert made.dof == 3
    assert made.names == ("x", "y", "heading")


def test_a_pose_in_space_is_judged_by_its_tangent_and_shown_along_the_axes_of_the_map() -> None:
    """NEES of the right tangent; σ against drawn poses: a body that is tilted turns about the vertical by all axes."""
    n = 20_000
    T = se3.se3_exp(np.tile([0.9, -0.7, 1.3, 2.0, -1.0, 0.5], (n, 1)))
    P = covariances(1, 6)[0] * 1e-5
    drawn = RNG.multivariate_normal(np.zeros(6), P, n)
    true = se3.se3_compose(T, se3.se3_exp(drawn))
    times = np.arange(n, dtype=np.float64)
    made = path_consistency(Trajectory(times, T, np.tile(P, (n, 1, 1))), Trajectory(times, true), chart="group")
    assert made.nees == pytest.approx(np.einsum("ki,ij,kj->k", drawn, np.linalg.inv(P), drawn), rel=1e-6)
    assert made.dof == 6
    assert made.names == ("x", "y", "z", "heading")
    # first order: errors are of some 1e-3, their squares of 1e-6
    assert made.errors[:, :3] == pytest.approx(true[:, :3] - T[:, :3], abs=1e-5)
    up = se3.so3_log(se3.quat_multiply(true[:, 3:], T[:, 3:] * [-1.0, -1.0, -1.0, 1.0]))[:, 2]  # of R_true R_estᵀ
    assert made.errors[:, 3] == pytest.approx(up, abs=1e-5)
    # two-sided, 5 σ of a σ from n draws
    assert made.errors.std(axis=0) == pytest.approx(made.sigmas[0], rel=5.0 / np.sqrt(2.0 * n))


def test_poses_without_truth_or_with_a_certain_direction_are_left_out() -> None:
    n = 12
    times = 1.5e9 + 0.1 * np.arange(n)
    x, P = np.cumsum(RNG.standard_normal((n, 3)), axis=0), covariances(n, 3)
    P[0] = 0.0  # the fixed base
    P[7, :, 1] = P[7, 1, :] = 0.0  # a wheel that never slips sideways
    kept = np.delete(np.arange(n), [4, 5])
    made = path_consistency(Trajectory(times, x, P), Trajectory(times[kept], x[kept]), chart="group")
    assert made.rows.tolist() == [1, 2, 3, 6, 8, 9, 10, 11]
    assert made.certain == 2
    assert made.nees == pytest.approx(np.zeros(8), abs=1e-20)
    axis = _Axis.of(Trajectory(times, x, P), made.rows)
    assert axis.piece.tolist() == [0, 0, 0, 1, 2, 2, 2, 2]
    assert axis.t == pytest.approx(0.1 * made.rows, abs=1e-6)
    with pytest.raises(DataError, match="agree"):
        path_consistency(Trajectory(times, x, P), Trajectory(times + 0.05, x), chart="group")
    with pytest.raises(DataError, match="dimension"):
        path_consistency(Trajectory(times, x, P), Trajectory(times, np.tile([0.0] * 6 + [1.0], (n, 1))), chart="group")
    with pytest.raises(DataError, match="covariances"):
        path_consistency(Trajectory(times, x), Trajectory(times, x), chart="group")
    with pytest.raises(ConfigError, match="chart"):
        path_consistency(Trajectory(times, x, P), Trajectory(times, x), chart="polar")


@pytest.mark.parametrize("n", [0, 1, 1999, 2000, 2001, 2002, 4001, 123_457])
def test_a_long_curve_keeps_its_ends_and_every_peak(n: int) -> None:
    values = RNG.standard_normal(n)
    if n > 100:
        at = RNG.choice(np.arange(1, n - 1), 9, replace=False)
        values[at] = [50.0, -50.0, 60.0, -60.0, 70.0, -70.0, 80.0, -80.0, 90.0]
    keep = extreme_rows(values, 2000)
    assert len(keep) <= 2000
    assert np.all(np.diff(keep) > 0)
    if n <= 2000:
        assert len(keep) == n
        return
    assert keep[0] == 0
    assert keep[-1] == n - 1
    assert len(keep) > 1200
    # of two peaks of one sign within one bucket only the larger is kept: at most a pixel wide
    width = n / 999 + 1
    for k in at:
        near = np.abs(keep - k) <= width
        assert np.any(np.sign(values[keep[near]]) * values[keep[near]] >= abs(values[k]) - 1e-12)
