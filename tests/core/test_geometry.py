"""SE(2) and SE(3): group axioms, scipy's expm, GTSAM, finite differences; near the identity and near π."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.linalg import expm

from graphslam.core import se3
from graphslam.core.errors import GeometryError
from graphslam.core.geometry import (
    align_se2,
    arc_length,
    circular_mean,
    se2_compose,
    se2_exp,
    se2_log,
    se2_transform,
    tangent_to_vector_covariance,
    vector_to_tangent_covariance,
    wrap_angle,
)
from graphslam.core.poses import group_of
from tests.reference.compose_covariance import se2_compose_covariance
from tests.reference.groups import GROUPS, SE2, SE3, Group, tangents

both = pytest.mark.parametrize("group", GROUPS, ids=lambda g: g.name)
LAW = settings(max_examples=60, deadline=None)


def near_pi(group: Group, xi: np.ndarray) -> bool:
    return bool(np.linalg.norm(xi[group.angle_of]) > np.pi - 1e-5)


@both
@LAW
@given(data=st.data())
def test_group_axioms(group: Group, data: st.DataObject) -> None:
    a, b, c = (group.exp(data.draw(tangents(group))) for _ in range(3))
    e = group.identity
    assert group.difference(group.compose(a, e), a) < 1e-12
    assert group.difference(group.compose(e, a), a) < 1e-12
    assert group.difference(group.compose(a, group.inverse(a)), e) < 1e-9
    left = group.compose(group.compose(a, b), c)
    right = group.compose(a, group.compose(b, c))
    assert group.difference(left, right) < 1e-9
    assert group.difference(group.between(a, b), group.compose(group.inverse(a), b)) < 1e-9


@both
@LAW
@given(data=st.data())
def test_exp_is_the_matrix_exponential(group: Group, data: st.DataObject) -> None:
    xi = data.draw(tangents(group))
    assert np.abs(group.matrix(group.exp(xi)) - expm(group.hat(xi))).max() < 1e-9


@both
@LAW
@given(data=st.data())
def test_log_inverts_exp(group: Group, data: st.DataObject) -> None:
    xi = data.draw(tangents(group))
    back = group.log(group.exp(xi))
    if near_pi(group, xi):  # there the axis is only known up to sign: compare the poses
        assert group.difference(group.exp(back), group.exp(xi)) < 1e-6
    else:
        assert np.abs(back - xi).max() < 1e-8 * (1 + np.abs(xi).max())


@both
@LAW
@given(data=st.data())
def test_exp_log_adjoint_agree_with_gtsam(group: Group, data: st.DataObject) -> None:
    xi = data.draw(tangents(group))
    theirs = type(group.to_gtsam(group.identity)).Expmap(xi)
    ours = group.exp(xi)
    # GTSAM divides 1 - cos θ by θ and so loses eps/θ of the translation near the identity (ours equals expm there)
    angle = float(np.linalg.norm(xi[group.angle_of]))
    tolerance = (1e-9 + 1e-15 / max(angle, 1e-10)) * (1.0 + float(np.abs(xi).max()))
    assert group.difference(ours, group.from_gtsam(theirs)) < tolerance
    assert np.abs(group.adjoint(ours) - group.to_gtsam(ours).AdjointMap()).max() < 1e-9
    if not near_pi(group, xi):
        assert np.abs(group.log(ours) - type(theirs).Logmap(theirs)).max() < 1e3 * tolerance


@both
@LAW
@given(data=st.data())
def test_compose_between_transform_agree_with_gtsam(group: Group, data: st.DataObject) -> None:
    a, b = (group.exp(data.draw(tangents(group))) for _ in range(2))
    ga, gb = group.to_gtsam(a), group.to_gtsam(b)
    assert group.difference(group.compose(a, b), group.from_gtsam(ga.compose(gb))) < 1e-9
    assert group.difference(group.between(a, b), group.from_gtsam(ga.between(gb))) < 1e-9
    p = np.arange(1.0, 3.0 if group is SE2 else 4.0)
    assert np.abs(group.transform(a, p) - ga.transformFrom(p)).max() < 1e-9


@both
@LAW
@given(data=st.data())
def test_adjoint_moves_a_tangent_across(group: Group, data: st.DataObject) -> None:
    T, xi = group.exp(data.draw(tangents(group, reach=5.0))), data.draw(tangents(group, reach=1.0))
    left = group.compose(T, group.exp(xi))
    right = group.compose(group.exp(group.adjoint(T) @ xi), T)
    assert group.difference(left, right) < 1e-8


@both
@LAW
@given(data=st.data())
def test_right_jacobian_by_central_differences(group: Group, data: st.DataObject) -> None:
    xi = data.draw(tangents(group, reach=5.0))
    J = group.right_jacobian(xi)
    h = 1e-5
    for k in range(group.dim):
        d = np.zeros(group.dim)
        d[k] = h
        # Exp(ξ + δ) = Exp(ξ) Exp(J_r δ)
        column = group.log(group.between(group.exp(xi - d), group.exp(xi + d))) / (2 * h)
        assert np.abs(J[:, k] - column).max() < 2e-7
    inverse = group_of(group.identity).right_jacobian_inverse(xi)
    assert np.abs(inverse @ J - np.eye(group.dim)).max() < 1e-9


@both
def test_functions_broadcast_and_leave_their_arguments_alone(group: Group, rng: np.random.Generator) -> None:
    xi = rng.normal(size=(4, 5, group.dim))
    kept = xi.copy()
    T = group.exp(xi)
    assert T.shape[:2] == (4, 5)
    for i in range(4):
        for j in range(5):
            assert group.difference(T[i, j], group.exp(xi[i, j])) < 1e-14
            assert group.difference(group.compose(T[i, j], T[0, 0]), group.compose(T, T[0, 0])[i, j]) < 1e-12
    group.log(T), group.inverse(T), group.adjoint(T), group.right_jacobian(xi)
    assert np.array_equal(xi, kept)


def test_log_at_exactly_pi() -> None:
    assert np.allclose(se2_exp(se2_log([1.0, 2.0, np.pi])), [1.0, 2.0, np.pi], atol=1e-12)
    for axis in np.eye(3):
        T = np.array([1.0, -2.0, 3.0, *axis, 0.0])
        assert SE3.difference(se3.se3_exp(se3.se3_log(T)), T) < 1e-9


@given(st.floats(-1e4, 1e4))
def test_wrap_angle_is_in_the_half_open_circle(a: float) -> None:
    w = float(wrap_angle(a))
    assert -np.pi < w <= np.pi
    assert abs(np.sin(w) - np.sin(a)) < 1e-9
    assert abs(np.cos(w) - np.cos(a)) < 1e-9


def test_wrap_angle_keeps_pi_and_folds_minus_pi() -> None:
    assert wrap_angle(np.pi) == np.pi
    assert wrap_angle(-np.pi) == np.pi


def test_circular_mean_across_the_cut() -> None:
    assert abs(wrap_angle(circular_mean([np.pi - 0.1, -np.pi + 0.1]) - np.pi)) < 1e-12
    assert circular_mean([0.0, np.pi / 2], [3.0, 1.0]) == pytest.approx(np.arctan2(1, 3))


@LAW
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternion_and_matrix_are_inverse(q: list[float]) -> None:
    u = se3.quat_normalize(q)
    R = se3.quat_to_matrix(u)
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.abs(se3.quat_to_matrix(se3.matrix_to_quat(R)) - R).max() < 1e-12
    assert se3.matrix_to_quat(R)[3] >= 0


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [0, 0, np.inf, 1]])
def test_impossible_quaternion_is_refused(bad: list[float]) -> None:
    with pytest.raises(GeometryError, match="quaternion"):
        se3.quat_normalize(bad)


def test_so3_left_jacobian_and_its_inverse(rng: np.random.Generator) -> None:
    for scale in (1e-9, 1e-5, 9.9e-4, 1.1e-3, 0.3, 2.0, 3.1):
        w = rng.normal(size=3)
        w *= scale / np.linalg.norm(w)
        assert np.abs(se3.so3_left_jacobian(w) @ se3.so3_left_jacobian_inverse(w) - np.eye(3)).max() < 1e-9


def test_compose_covariance_by_sampling(rng: np.random.Generator) -> None:
    a, b = np.array([3.0, -1.0, 0.7]), np.array([2.0, 1.0, -0.4])
    A = 0.01 * np.array([[1.0, 0.2, 0.1], [0.2, 0.5, 0.05], [0.1, 0.05, 0.2]])
    B = 0.01 * np.diag([0.3, 0.8, 0.1])
    n = 200_000
    sa = se2_compose(a, se2_exp(rng.multivariate_normal(np.zeros(3), A, n)))
    sb = se2_compose(b, se2_exp(rng.multivariate_normal(np.zeros(3), B, n)))
    e = se2_log(SE2.between(se2_compose(a, b), se2_compose(sa, sb)))
    P = se2_compose_covariance(a, A, b, B)
    # relative standard error of a sample variance is sqrt(2/n) = 0.3 %; second-order terms of 0.1 rad are 1 %
    assert np.abs(np.cov(e.T) - P).max() < 0.02 * P.max()


def test_vector_and_tangent_covariance_by_sampling(rng: np.random.Generator) -> None:
    T = np.array([3.0, 4.0, 2.0])
    P = np.array([[4.0, 1.0, 0.3], [1.0, 2.0, -0.2], [0.3, -0.2, 1.0]]) * 1e-4
    x = T + rng.multivariate_normal(np.zeros(3), P, 100_000)
    e = se2_log(SE2.between(T, x))
    Q = vector_to_tangent_covariance(T, P)
    assert np.abs(np.cov(e.T) - Q).max() < 0.03 * Q.max()
    assert np.allclose(tangent_to_vector_covariance(T, Q), P, atol=1e-18)
    assert not np.allclose(P, Q, rtol=0.1)  # the two differ: mixing them up would be noticed


def test_align_se2_recovers_a_transform_and_is_optimal(rng: np.random.Generator) -> None:
    p = rng.normal(size=(30, 2)) * 10
    T = np.array([5.0, -3.0, 2.5])
    assert np.allclose(align_se2(p, se2_transform(T, p)), T, atol=1e-12)
    q = se2_transform(T, p) + rng.normal(size=p.shape)
    w = rng.uniform(0.1, 2.0, 30)
    best = align_se2(p, q, w)
    cost = lambda t: float(np.sum(w * np.sum((se2_transform(t, p) - q) ** 2, 1)))  # noqa: E731
    for d in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert cost(best + d) > cost(best)


@pytest.mark.parametrize("scale", [False, True])
def test_align_se3_recovers_a_transform(scale: bool, rng: np.random.Generator) -> None:
    p = rng.normal(size=(30, 3)) * 10
    T = se3.se3_exp(np.array([0.4, -1.0, 2.0, 1.0, 2.0, 3.0]))
    s = 1.7 if scale else 1.0
    found, k = se3.align_se3(p, se3.se3_transform(T, s * p), scale=scale)
    assert k == pytest.approx(s)
    assert SE3.difference(found, T) < 1e-9


def test_align_se3_never_mirrors(rng: np.random.Generator) -> None:
    p = rng.normal(size=(20, 3))
    found, _ = se3.align_se3(p, p * [1, 1, -1])  # a mirrored cloud: the best *rotation* is asked for
    assert np.linalg.det(se3.pose_to_matrix(found)[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("shapes", [((3,), (3,)), ((5, 3), (3,)), ((4, 1, 3), (1, 6, 3)), ((0, 3), (0, 3))])
def test_cross_product_is_numpys_to_the_bit(shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    rng = np.random.default_rng(1)
    a, b = (rng.normal(size=s) * 10.0 ** rng.integers(-8, 8, size=s) for s in shapes)
    assert np.array_equal(se3._cross(a, b), np.cross(a, b))


def test_arc_length_is_the_sum_of_the_steps() -> None:
    p = np.array([[0.0, 0.0, 1.0], [3.0, 4.0, 1.0], [3.0, 4.0, 1.0], [3.0, 4.0, -1.0]])
    np.testing.assert_array_equal(arc_length(p), [0.0, 5.0, 5.0, 7.0])
    np.testing.assert_array_equal(arc_length(p[:1]), [0.0])
