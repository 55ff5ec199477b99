"""Drawn local maps: their covariance against numerical Jacobians, their errors against it, and the world they show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import se2_between, se2_transform
from graphslam.core.submap import Submap
from graphslam.join.submap_solver import solve_submaps
from graphslam.sim.landmark_field import landmark_layout
from graphslam.sim.vehicle import follow_route
from graphslam_studies.sim.local_maps import local_map_world, simulate_local_maps


def exact(count: int, scans: int, seed: int = 0) -> list[Submap]:
    return simulate_local_maps(count, seed, scans=scans)[0]


def test_covariance_is_that_of_the_controls_and_scans_by_numerical_jacobians() -> None:
    """One submap: every control and every measurement perturbed one by one, then the poses between integrated out."""
    scans, k = 5, 3
    c = local_map_world(20)  # longer than what is driven here
    submap = simulate_local_maps(12, 7, scans=scans, config=c)[0][k]
    route, features = landmark_layout(c, 7)
    stride, dt = c.scan_stride, 1.0 / c.control_rate
    poses, steering = follow_route(
        route, 12 * scans * stride, speed=c.speed, dt=dt, wheelbase=c.wheelbase, max_steering=c.max_steering,
        steering_rate=c.steering_rate, look_ahead=c.look_ahead,
    )  # fmt: skip
    base = poses[k * scans * stride]
    G = steering[k * scans * stride :]

    def move(pose: np.ndarray, v: float, g: float) -> np.ndarray:
        x, y, h = pose
        return np.array([x + v * dt * np.cos(h + g), y + v * dt * np.sin(h + g), h + v * dt * np.sin(g) / c.wheelbase])

    def end_of_scan(pose: np.ndarray, j: int, dv: np.ndarray, dg: np.ndarray) -> np.ndarray:
        for i in range(stride):
            pose = move(pose, c.speed + dv[i], G[j * stride + i] + dg[i])
        return pose

    path = [np.zeros(3)]
    for j in range(scans):
        path.append(end_of_scan(path[-1], j, np.zeros(stride), np.zeros(stride)))
    local = se2_between(base, np.column_stack([features, np.zeros(len(features))]))[:, :2]
    ids = submap.landmarks.ids
    n = 3 * scans + 2 * len(ids)
    A = np.zeros((n, n))
    h = 1e-6
    for j in range(scans):
        none = np.zeros(stride)
        J = np.zeros((3, 3))
        for i, e in enumerate(np.eye(3)):
            J[:, i] = (end_of_scan(path[j] + h * e, j, none, none) - end_of_scan(path[j] - h * e, j, none, none)) / (
                2 * h
            )
        Q = np.zeros((3, 3))
        for e in np.eye(stride):
            v = (end_of_scan(path[j], j, h * e, none) - end_of_scan(path[j], j, -h * e, none)) / (2 * h)
            g = (end_of_scan(path[j], j, none, h * e) - end_of_scan(path[j], j, none, -h * e)) / (2 * h)
            Q += c.sigma_speed**2 * np.outer(v, v) + c.sigma_steering**2 * np.outer(g, g)
        D = np.zeros((3, n))
        D[:, 3 * j : 3 * j + 3] = np.eye(3)
        if j:
            D[:, 3 * j - 3 : 3 * j] = -J
        A += D.T @ np.linalg.inv(Q) @ D
        for a, f in enumerate(ids):

            def measured(x: np.ndarray) -> np.ndarray:
                d = x[3:] - x[:2]
                return np.array([np.hypot(*d), np.arctan2(d[1], d[0]) - x[2]])

            x = np.concatenate([path[j + 1], local[f]])
            seen = measured(x)
            bearing = np.arctan2(np.sin(seen[1]), np.cos(seen[1]))
            if not (c.min_range <= seen[0] <= c.max_range and abs(bearing) <= c.field_of_view / 2):
                continue
            J = np.array([(measured(x + h * e) - measured(x - h * e)) / (2 * h) for e in np.eye(5)]).T
            D = np.zeros((2, n))
            D[:, 3 * j : 3 * j + 3] = J[:, :3]
            D[:, 3 * scans + 2 * a : 3 * scans + 2 * a + 2] = J[:, 3:]
            A += D.T @ np.diag([c.sigma_range**-2, c.sigma_bearing**-2]) @ D
    P = np.linalg.inv(A)[3 * scans - 3 :, 3 * scans - 3 :]
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(
        submap.landmarks.covariance / np.outer(scale, scale), P / np.outer(scale, scale), atol=1e-5
    )


def test_errors_are_drawn_from_the_covariance() -> None:
    d2, dof = 0.0, 0
    for seed in range(2):
        submaps, truth = simulate_local_maps(40, seed, scans=20)
        at = {int(j): p for j, p in zip(truth.landmark_ids, truth.landmarks)}
        starts = np.vstack([np.zeros(3), truth.exit_poses[:-1]])
        for s, start, end in zip(submaps, starts, truth.exit_poses):
            points = np.array([at[int(j)] for j in s.landmarks.ids])
            z = np.concatenate(
                [
                    se2_between(start, end),
                    se2_between(start, np.column_stack([points, 0 * points[:, 0]]))[:, :2].ravel(),
                ]
            )
            e = s.landmarks.mean - z
            e[2] = np.angle(np.exp(1j * e[2]))
            d2 += e @ np.linalg.solve(s.landmarks.covariance, e)
            dof += len(e)
    assert abs(d2 / dof - 1.0) < 4.0 * np.sqrt(2.0 / dof)


def test_world_a_has_the_size_of_the_stated_experiment() -> None:
    submaps, truth = simulate_local_maps(126, 0)
    per_map = np.mean([len(s.landmarks) for s in submaps])
    assert 14.0 < per_map < 17.0
    assert 1400 < 3 * 126 + 2 * len(truth.landmark_ids) <= 3 * 126 + 2 * 554
    first_lap = np.unique(np.concatenate([s.landmarks.ids for s in submaps[:63]]))
    second_lap = np.unique(np.concatenate([s.landmarks.ids for s in submaps[66:]]))
    assert np.isin(second_lap, first_lap).all()  # the loop closes after half of them
    assert np.linalg.norm(truth.exit_poses[62, :2]) < 10.0
    best = solve_submaps(submaps)
    freedom = sum(3 + 2 * len(s.landmarks) for s in submaps) - best.states
    assert abs(best.objective / freedom - 1.0) < 4.0 * np.sqrt(2.0 / freedom)


def test_same_seed_same_maps_and_the_layout_can_be_held() -> None:
    a, b, other = exact(8, 30, 3), exact(8, 30, 3), exact(8, 30, 4)
    for s, t in zip(a, b):
        np.testing.assert_array_equal(s.landmarks.mean, t.landmarks.mean)
        np.testing.assert_array_equal(s.landmarks.covariance, t.landmarks.covariance)
    assert any(not np.array_equal(s.landmarks.ids, t.landmarks.ids) for s, t in zip(a, other))
    held = dataclasses.replace(local_map_world(8, scans=30), layout_seed=5)
    (c, truth_c), (d, truth_d) = (simulate_local_maps(8, seed, scans=30, config=held) for seed in (1, 2))
    np.testing.assert_array_equal(truth_c.landmarks, truth_d.landmarks)
    assert all(not np.array_equal(s.landmarks.mean, t.landmarks.mean) for s, t in zip(c, d))
    # the truth is one world: what two submaps see of a feature is the same place
    at = {int(j): p for j, p in zip(truth_c.landmark_ids, truth_c.landmarks)}
    for s, start in zip(c[1:], truth_c.exit_poses):
        seen = se2_transform(start, s.landmarks.positions)
        assert np.median(np.linalg.norm(seen - [at[int(j)] for j in s.landmarks.ids], axis=1)) < 2.0


def test_impossible_chains_are_refused() -> None:
    with pytest.raises(ConfigError, match="1 local maps"):
        simulate_local_maps(1, 0)
    with pytest.raises(ConfigError, match="control steps"):
        simulate_local_maps(40, 0, scans=20, config=local_map_world(10, scans=20))
