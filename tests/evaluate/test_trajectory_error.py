"""ATE and RPE against values computed by hand; against evo where it happens to be installed."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import DataError
from graphslam.core.geometry import rotation2, se2_compose, se2_exp
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.trajectory_error import ate, delta_pairs, match_stamps, rpe
from graphslam.io.tum import embed_plane


def path(*poses: tuple[float, float, float], times: list[float] | None = None) -> Trajectory:
    return Trajectory(times if times is not None else np.arange(float(len(poses))), np.array(poses, dtype=float))


LINE = path((0, 0, 0), (1, 0, 0), (2, 0, 0))


def test_ate_without_alignment_by_hand() -> None:
    e = ate(path((0, 3, 0), (1, 4, 0), (2, 0, 0.5)), LINE, alignment="none")
    assert e.translation.tolist() == [3.0, 4.0, 0.0]
    assert e.statistics.rmse == pytest.approx(np.sqrt(25 / 3))
    assert e.rotation.tolist() == [0.0, 0.0, 0.5]


def test_ate_at_the_origin_by_hand() -> None:
    """The estimate starts at (5, 5) looking along y and drives straight: rotated back it is perfect, except the end."""
    e = ate(path((5, 5, np.pi / 2), (5, 6, np.pi / 2), (4, 7, np.pi / 2)), LINE, alignment="origin")
    assert np.allclose(e.translation, [0, 0, 1], atol=1e-12)


def test_ate_with_rigid_alignment_by_hand() -> None:
    """Square of side 2 with one corner pushed out by symmetry: the optimum is known.

    Reference corners (±1, ±1); estimate the same with (1, 1) → (1 + d, 1 + d). By symmetry no rotation is gained;
    the mean moves by d/4 in x and y, so residuals are d/4·√2 for three corners and 3d/4·√2 for the fourth.
    """
    d = 0.4
    ref = path((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))
    est = path((-1, -1, 0), (1, -1, 0), (1 + d, 1 + d, 0), (-1, 1, 0))
    e = ate(est, ref, alignment="se")
    assert np.allclose(e.translation, np.sqrt(2) * d / 4 * np.array([1, 1, 3, 1]), atol=1e-12)
    assert np.allclose(e.T_ref_est, [-d / 4, -d / 4, 0], atol=1e-12)


def test_scale_alignment_by_hand() -> None:
    """An estimate that is twice too large, turned by 90° and shifted: ``sim`` explains all of it, ``se`` not."""
    ref = path((0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0))
    est = path((7, 3, np.pi / 2), (7, 7, np.pi / 2), (5, 7, np.pi / 2), (5, 3, np.pi / 2))
    e = ate(est, ref, alignment="sim")
    assert e.scale == pytest.approx(0.5)
    assert e.statistics.maximum < 1e-12
    assert e.rotation_statistics.maximum < 1e-12
    # rigid: corners at (±1, ±½) against (±2, ±1): each is off by half its own radius, √5/2
    s = ate(est, ref, alignment="se")
    assert s.statistics.rmse == pytest.approx(np.sqrt(1.25))
    assert s.scale == 1.0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("alignment", ["se", "sim"])
def test_alignment_recovers_a_moved_copy_and_is_least_squares(dim: int, alignment: str) -> None:
    rng = np.random.default_rng(3)
    scale = 0.4 if alignment == "sim" else 1.0
    if dim == 2:
        ref = Trajectory(np.arange(20.0), se2_exp(rng.normal(size=(20, 3)) * [5, 5, 1]))
        T = np.array([3.0, -2.0, 2.2])
        moved = se2_compose(np.broadcast_to(T, ref.poses.shape), ref.poses)
    else:
        ref = Trajectory(np.arange(20.0), se3.se3_exp(rng.normal(size=(20, 6)) * [1, 1, 1, 5, 5, 5]))
        T = se3.se3_exp(np.array([0.5, -1.0, 1.5, 3.0, -2.0, 1.0]))
        moved = se3.se3_compose(np.broadcast_to(T, ref.poses.shape), ref.poses)
    moved[:, :dim] /= scale
    e = ate(Trajectory(ref.times, moved), ref, alignment=alignment)  # type: ignore[arg-type]
    assert e.statistics.maximum < 1e-9
    assert e.rotation_statistics.maximum < 1e-7
    assert e.scale == pytest.approx(scale)
    # with noise, no neighbouring transform is better
    noisy = moved.copy()
    noisy[:, :dim] += rng.normal(size=(20, dim))
    best = ate(Trajectory(ref.times, noisy), ref, alignment=alignment)  # type: ignore[arg-type]
    p, q = noisy[:, :dim], ref.positions

    def rmse(step: np.ndarray, s: float) -> float:
        if dim == 2:
            t = se2_compose(best.T_ref_est, se2_exp(step))
            x = s * p @ rotation2(t[2]).T + t[:2]
        else:
            t = se3.se3_compose(best.T_ref_est, se3.se3_exp(step))
            x = se3.se3_transform(t, s * p)
        return float(np.sqrt(np.mean(np.sum((x - q) ** 2, axis=1))))

    n = 3 if dim == 2 else 6
    assert rmse(np.zeros(n), best.scale) == pytest.approx(best.statistics.rmse)
    for d in 1e-3 * np.vstack([np.eye(n), -np.eye(n)]):
        assert rmse(d, best.scale) > best.statistics.rmse
    if alignment == "sim":
        assert min(rmse(np.zeros(n), best.scale * f) for f in (0.999, 1.001)) > best.statistics.rmse


def test_rpe_over_distance_by_hand() -> None:
    """Straight reference, one metre a step; the estimate stretches its second step by 0.5 m and turns 0.1 in it."""
    ref = path((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0))
    est = path((0, 0, 0), (1, 0, 0), (2.5, 0, 0.1), (2.5 + np.cos(0.1), np.sin(0.1), 0.1))
    e = rpe(est, ref, delta=1.0, unit="m")
    assert np.allclose(e.translation, [0.0, 0.5, 0.0], atol=1e-12)
    assert np.allclose(e.rotation, [0.0, 0.1, 0.0], atol=1e-12)
    assert e.times.tolist() == [0.0, 1.0, 2.0]
    two = rpe(est, ref, delta=2.0, unit="m")
    assert two.pairs == 2
    # pair 0-2: estimate (2.5, 0) against (2, 0); pair 1-3: (1.5 + cos, sin) against (2, 0)
    assert np.allclose(two.translation, [0.5, np.hypot(np.cos(0.1) - 0.5, np.sin(0.1))], atol=1e-12)
    assert two.as_row()["delta_unit"] == "m"


def test_rpe_does_not_see_a_moved_frame() -> None:
    rng = np.random.default_rng(0)
    ref = Trajectory(np.arange(30.0), np.cumsum(rng.normal(size=(30, 3)) * [1, 1, 0.2], axis=0))
    moved = ref.transformed(np.array([10.0, 5.0, 1.0]))
    assert rpe(moved, ref, delta=3.0, relative_tolerance=0.5).statistics.maximum < 1e-12


def test_rpe_over_time_and_chained_pairs_by_hand() -> None:
    ref = path(*[(float(k), 0, 0) for k in range(7)], times=[0, 1, 2, 3, 4, 5, 6])
    est = path(*[(1.1 * k, 0, 0) for k in range(7)], times=[0, 1, 2, 3, 4, 5, 6])
    every = rpe(est, ref, delta=2.0, unit="s")
    assert every.pairs == 5
    assert np.allclose(every.translation, 0.2)
    chain = rpe(est, ref, delta=2.0, unit="s", all_pairs=False)
    assert chain.times.tolist() == [0.0, 2.0, 4.0]
    assert rpe(est, ref, delta=2.0, unit="s", scale=True).statistics.maximum < 1e-12


def test_pairs_are_nearest_within_the_tolerance() -> None:
    progress = np.array([0.0, 0.9, 1.05, 2.0, 2.0, 3.0])
    i, j = delta_pairs(progress, 1.0, tolerance=0.1, all_pairs=True)
    assert list(zip(i.tolist(), j.tolist())) == [(0, 2), (2, 3), (3, 5), (4, 5)]


def test_delta_pairs_equal_brute_force(rng: np.random.Generator) -> None:
    s = np.cumsum(rng.uniform(0, 1, 200))
    i, j = delta_pairs(s, 5.0, tolerance=0.3, all_pairs=True)
    slow = []
    for a in range(199):
        b = a + 1 + int(np.argmin(np.abs(s[a + 1 :] - s[a] - 5.0)))
        if abs(s[b] - s[a] - 5.0) <= 0.3:
            slow.append((a, b))
    assert list(zip(i.tolist(), j.tolist())) == slow


def test_association_is_mutual_and_within_max_diff() -> None:
    i, j = match_stamps([0.0, 1.0, 2.0, 3.0], [0.004, 0.996, 1.001, 2.5, 3.02], max_diff=0.01)
    assert list(zip(i.tolist(), j.tolist())) == [(0, 0), (1, 2)]
    i, j = match_stamps([0.0, 1.0], [0.4, 0.6], max_diff=1.0)
    assert list(zip(i.tolist(), j.tolist())) == [(0, 0), (1, 1)]
    assert len(match_stamps([], [1.0])[0]) == 0
    assert len(match_stamps([5.0], [1.0], max_diff=10.0)[0]) == 1


def test_association_decides_which_poses_are_compared() -> None:
    est = path((0.005, 1, 0), (9, 9, 0), (2, 1, 0), times=[0.005, 0.5, 2.003])
    e = ate(est, LINE, alignment="none")
    assert e.pairs == 2
    assert e.translation == pytest.approx([1.0, 1.0], abs=1e-12)  # the reference moves 5 mm in 5 ms
    assert e.times.tolist() == [0.005, 2.003]


def test_what_cannot_be_scored_is_refused() -> None:
    with pytest.raises(DataError, match=r"no stamps.*98\.000 s apart"):
        ate(path((0, 0, 0), times=[100.0]), LINE)
    with pytest.raises(DataError, match="too few"):
        ate(path((0, 0, 0), (1, 0, 0)), LINE, alignment="se")
    with pytest.raises(DataError, match="do not determine"):
        ate(path((1, 1, 0), (1, 1, 1), (1, 1, 2)), LINE, alignment="se")
    with pytest.raises(DataError, match="differ in dimension"):
        ate(Trajectory(LINE.times, embed_plane(LINE.poses)), LINE)
    with pytest.raises(DataError, match=r"apart; got 2\.000 m"):
        rpe(LINE, LINE, delta=50.0)
    with pytest.raises(DataError, match="positive delta"):
        rpe(LINE, LINE, delta=0.0)
    with pytest.raises(DataError, match="unknown alignment"):
        ate(LINE, LINE, alignment="affine")  # type: ignore[arg-type]
    straight = Trajectory(LINE.times, embed_plane(LINE.poses))
    with pytest.raises(DataError, match="a point or a line"):
        ate(straight, straight, alignment="se")


def test_planar_and_embedded_scores_are_the_same() -> None:
    rng = np.random.default_rng(1)
    ref = Trajectory(np.arange(40.0), np.cumsum(rng.normal(size=(40, 3)) * [1, 1, 0.3], axis=0))
    est = Trajectory(ref.times, ref.poses + 0.1 * rng.normal(size=(40, 3)))
    ref3, est3 = (Trajectory(t.times, embed_plane(t.poses)) for t in (ref, est))
    for alignment in ("none", "origin", "se", "sim"):
        a, b = ate(est, ref, alignment=alignment), ate(est3, ref3, alignment=alignment)  # type: ignore[arg-type]
        assert np.allclose(a.translation, b.translation, atol=1e-9)
        assert np.allclose(a.rotation, b.rotation, atol=1e-7)
    a, b = rpe(est, ref, delta=4.0), rpe(est3, ref3, delta=4.0)
    assert np.allclose(a.translation, b.translation, atol=1e-9)


@pytest.mark.parametrize("planar", [True, False])
def test_agrees_with_evo(planar: bool) -> None:
    pytest.importorskip("evo", reason="evo is an optional oracle (GPL): pip install evo to compare with it")
    from evo.core import metrics, sync, units
    from evo.core.trajectory import PoseTrajectory3D

    rng = np.random.default_rng(5)
    n = 300
    if planar:
        steps = se2_exp(rng.normal(size=(n, 3)) * 0.1 + [0.5, 0, 0.02])
        poses = [np.zeros(3)]
        for s in steps[1:]:
            poses.append(se2_compose(poses[-1], s))
        ref = np.array(poses)
        est = embed_plane(se2_compose(ref, se2_exp(rng.normal(size=(n, 3)) * 0.2)))
        ref = embed_plane(ref)
    else:
        steps = se3.se3_exp(rng.normal(size=(n, 6)) * 0.1 + [0, 0, 0.02, 0.5, 0, 0])
        poses = [np.array([0.0, 0, 0, 0, 0, 0, 1])]
        for s in steps[1:]:
            poses.append(se3.se3_compose(poses[-1], s))
        ref = np.array(poses)
        est = se3.se3_compose(ref, se3.se3_exp(rng.normal(size=(n, 6)) * 0.2))
    est = se3.se3_compose(np.broadcast_to(se3.se3_exp([0.2, -0.4, 1.0, 5, 6, 7]), est.shape), est)
    est[:, :3] *= 1.3
    t = np.arange(n) * 0.1
    ours_ref, ours = Trajectory(t, ref), Trajectory(t, est)  # evo does not interpolate

    def theirs(x: Trajectory) -> PoseTrajectory3D:
        return PoseTrajectory3D(x.poses[:, :3], x.poses[:, [6, 3, 4, 5]], x.times)

    full = metrics.PoseRelation.translation_part
    angle = metrics.PoseRelation.rotation_angle_rad
    for alignment in ("none", "origin", "se", "sim"):
        a, b = sync.associate_trajectories(theirs(ours_ref), theirs(ours), max_diff=0.01)
        if alignment == "origin":
            b.align_origin(a)
        elif alignment != "none":
            b.align(a, correct_scale=alignment == "sim")
        e = ate(ours, ours_ref, alignment=alignment)  # type: ignore[arg-type]
        for relation, value in ((full, e.statistics.rmse), (angle, e.rotation_statistics.rmse)):
            m = metrics.APE(relation)
            m.process_data((a, b))
            assert m.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(value, rel=1e-6)
    a, b = sync.associate_trajectories(theirs(ours_ref), theirs(ours), max_diff=0.01)
    r = rpe(ours, ours_ref, delta=3.0)
    m = metrics.RPE(full, 3.0, units.Unit.meters, rel_delta_tol=0.1, all_pairs=True, pairs_from_reference=True)
    m.process_data((a, b))
    assert len(m.error) == r.pairs
    assert np.allclose(m.error, r.translation, rtol=1e-9)
