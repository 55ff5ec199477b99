"""NEES axis by axis: an overconfident axis is found where the sum over all axes hides it."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.app.verdict.chi_square import nees_tests
from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.poses import SE3, group_of
from graphslam.core.se3 import quat_to_matrix
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.metrics import AXES, Metrics, end_metrics


def drawn(rng: np.random.Generator, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turned bases, the joint covariance of their errors along the axes of the map, and its right-tangent form."""
    poses = SE3.exp(rng.standard_normal((m, 6)) * [0.2, 0.2, 2.0, 10.0, 10.0, 1.0])
    B = rng.standard_normal((6 * m, 6 * m)) * 0.01
    P_map = B @ B.T / 6 + 1e-5 * np.eye(6 * m)
    A = np.zeros((6 * m, 6 * m))
    for k, R in enumerate(quat_to_matrix(poses[:, 3:])):
        A[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] = A[6 * k + 3 : 6 * k + 6, 6 * k + 3 : 6 * k + 6] = R
    return poses, P_map, A


def metrics_of(poses: np.ndarray, P: np.ndarray, true: np.ndarray) -> dict[str, float]:
    out = Metrics()
    end_metrics(out, poses, P, true, Trajectory(np.arange(len(poses), dtype=float), poses), None)
    return {r["key"]: r["value"] for r in out.rows}


def test_every_axis_has_its_own_nees_and_a_halved_one_is_found(rng: np.random.Generator) -> None:
    m, runs = 8, 300
    poses, P_map, A = drawn(rng, m)
    root = np.linalg.cholesky(P_map)
    S = np.eye(6 * m)
    S[5::6, 5::6] *= np.sqrt(2.0)  # heights vary by twice what is stated
    values: dict[str, list[float]] = {name: [] for name in AXES[3]}
    for _ in range(runs):
        e = A.T @ (S @ root @ rng.standard_normal(6 * m))
        true = group_of(poses).compose(poses, SE3.exp(e.reshape(m, 6)))
        found = metrics_of(poses, A.T @ P_map @ A, true)
        for name in AXES[3]:
            values[name].append(found[f"nees_{name}_per_dof"])
        assert found["nees_z_dof"] == m
    bound = 4.0 * np.sqrt(2.0 / (m * runs))
    for name in AXES[3]:
        expected = 2.0 if name == "z" else 1.0
        assert np.mean(values[name]) == pytest.approx(expected, abs=expected * bound)


def test_the_verdict_names_an_overconfident_axis_and_nothing_else() -> None:
    m = {"nees_per_dof": 0.7, "nees_dof": 120.0}
    m |= {f"nees_{k}_per_dof": v for k, v in zip(AXES[3], (0.5, 0.5, 0.6, 0.5, 0.4, 2.9))}
    m |= {f"nees_{k}_dof": 20.0 for k in AXES[3]}
    judged = nees_tests(RunMetrics({}, m))
    assert [(j.about, j.verdict) for j in judged] == [
        ("first base fixed", "conservative"),
        ("z of all nodes", "overconfident"),
    ]
    # of six axes of consistent runs the worst is outside its own bounds in one run of forty
    assert judged[1].bounds()[1] > judged[1].__class__("nees", "", 1.0, 20.0).bounds()[1]
