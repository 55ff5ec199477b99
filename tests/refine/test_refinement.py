"""Whole refinements of drives through a court that nothing was tuned on: errors, honesty, wrong starts, faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.backend.refining import refinement_findings, wrong_loops
from graphslam.core import workers
from graphslam.core.errors import DataError, GeometryError
from graphslam.core.poses import SE3
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.maps.global_map import GlobalMap
from graphslam.refine import surfaces
from graphslam.refine.nodes import scans_at
from graphslam.refine.refine import _Refiner, refine_by_scans, refine_if_contradicted
from graphslam.refine.result import Refinement, ScanCheck
from graphslam.refine.scans import Scans
from graphslam.refine.surfaces import find_surfaces
from graphslam.registration.surfaces import SURFACE
from graphslam_studies.evaluate import segslam_judge as judge
from graphslam_studies.refinement import QUICK_WORLDS
from graphslam_studies.refinement_trial import nees_of, run_refinement_trial
from tests.refine.world import court_scans

SEEDS = range(40, 44)


def court(seed, **changes):
    """The drive of a seed with half the beams of the scanner, which are enough here."""
    return court_scans(seed, beams=31, **changes)


def error(times, poses, truth):
    return judge.path_errors(Trajectory(times, poses), truth).aligned


@pytest.fixture(scope="module")
def drives():
    out = []
    for seed in SEEDS:
        scans, start, truth = court(seed)
        out.append((scans, start, truth, refine_by_scans(scans, start)))
    return out


@pytest.fixture(scope="module")
def bent():
    """An odometry that is nearly true, a start bent by metres, the truth, and what is refined from them."""
    scans, start, truth = court(41)
    u = SE3.between(truth[:-1], truth[1:])
    good = replace(scans.odometry, increments=np.concatenate([scans.odometry.increments[:1], u]))
    scans = replace(scans, odometry=good)
    return scans, start, truth, refine_by_scans(scans, start)


def test_dead_reckoning_is_brought_to_the_truth(drives):
    for scans, start, truth, found in drives:
        assert error(scans.times, start, truth) > 1.0
        assert error(scans.times, found.poses, truth) < 0.02
        assert found.better
        assert found.agreement[1] > 0.8


def test_threads_change_no_byte_of_a_refinement(monkeypatch):
    scans, start, _ = court(SEEDS[0])
    found = []
    for threads in (1, 2, 3):
        for module in (workers, surfaces):
            monkeypatch.setattr(module, "cores", lambda n=threads: n)
        made = refine_by_scans(scans, start)
        found.append((made.poses.tobytes(), made.covariances.tobytes(), made.agreement))
    assert found[0] == found[1] == found[2]


def test_the_covariance_is_neither_too_small_nor_too_large(drives):
    """Mean over the drives; with half or twice the covariance it would be outside."""
    mean = np.mean([nees_of(found, truth)["nees"] for _, _, truth, found in drives])
    relative = np.mean([nees_of(found, truth)["nees_relative"] for _, _, truth, found in drives])
    assert 0.65 < mean < 1.9
    assert 0.36 < relative < 1.3


def test_joint_covariance_holds_that_of_each_step(drives):
    _, _, _, found = drives[0]
    some = np.array([3, 50, 170])
    P = found.joint(some).reshape(3, 6, 3, 6)
    for k, step in enumerate(some):
        np.testing.assert_allclose(P[k, :, k], found.covariances[step], rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(found.joint(some))[0] > 0


def test_motion_noisier_than_stated_is_widened_and_consistent():
    values, scales, codes = [], [], []
    for seed in (41, 42):
        scans, start, truth = court(seed, wheel_sigma=0.06)  # the front end takes 0.02 for it
        found = refine_by_scans(scans, start)
        values.append(nees_of(found, truth)["nees"])
        scales.append(found.scales)
        codes += [f.code for f in refinement_findings(found)]
    assert np.all(np.array(scales)[:, 1] > 1.5)  # along the way
    np.testing.assert_allclose(np.array(scales)[:, 0], 1.0, atol=0.3)  # the gyro is as stated
    assert 0.5 < np.mean(values) < 2.0
    assert codes.count("refine-widened") == 2


def test_motion_as_stated_is_not_widened(drives):
    assert all(np.max(found.scales) < 1.3 for *_, found in drives)


def test_biases_are_found_within_their_sigma(drives):
    z = []
    for *_, found in drives:
        clock, sigma = found.constants["clock"]
        z.append(clock / sigma)
        assert sigma < 5e-3
        assert abs(np.mean(found.yaw_bias[:, 1])) > 1e-3  # the simulated gyro is biased to ruin the path
    assert np.mean(np.square(z)) < 6.0


def test_wrong_loops_and_what_moves_do_no_harm():
    config = replace(QUICK_WORLDS["court-quick"], wrong=(3,), faults=("moving",))
    rows = {(m.algorithm, m.quantity): m.value for m in run_refinement_trial(config, 7)}
    clean = rows["refined", "ate_aligned"]
    assert clean < 0.02
    for count in config.wrong:
        assert rows[f"wrong-{count}", "ate_start"] > 0.5  # the start is bent
        assert rows[f"wrong-{count}", "ate_aligned"] < 2.0 * clean + 0.005
        assert rows[f"wrong-{count}", "left_apart"] > 0
    for fault in config.faults:
        assert rows[fault, "worse"] == 0
        assert rows[fault, "ate_aligned"] < 0.03


def test_loops_that_the_refined_path_contradicts_are_named(drives):
    *_, found = drives[0]
    nodes = found.poses[::40]
    graph = FactorGraph(3)
    graph.structure.append("x", nodes[1])
    for T in nodes[2:]:
        graph.structure.append("x", T)
    for i, j, off in ((0, 3, 0.0), (1, 4, 4.0)):
        T = SE3.between(nodes[i], nodes[j])
        T[1] += off
        graph.add_between(i, j, T, 1e-4 * np.eye(6), evidence="shared-scan")
    m = GlobalMap(
        node_times=found.times[::40],
        node_poses=nodes,
        node_covariances=found.covariances[::40],
        trajectory=Trajectory(found.times, found.poses),
        landmark_ids=np.zeros(0, np.int64),
        landmarks=np.zeros((0, 3)),
        landmark_covariances=np.zeros((0, 3, 3)),
        landmark_hits=np.zeros(0, np.int64),
    )
    wrong = wrong_loops(graph, m)
    assert [(i, j) for i, j, *_ in wrong] == [(1, 4)]
    assert wrong[0][2] == pytest.approx(4.0)
    named = {f.code: f.text for f in refinement_findings(found, wrong)}
    assert "x1 and x4 by 4.0 m" in named["refine-contradicted"]
    assert "refine-contradicted" not in {f.code for f in refinement_findings(found, [])}


def test_a_scanner_that_is_mounted_askew_is_named(drives):
    scans, start, truth, straight = drives[1]
    a = np.deg2rad(1.0)
    R = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    turned = replace(
        scans, points=(scans.points @ R.T).astype(np.float32), origins=(scans.origins @ R.T).astype(np.float32)
    )
    found = refine_by_scans(turned, start)
    assert error(scans.times, found.poses, truth) < 0.03
    side, sigma = found.constants["side"]
    assert side == pytest.approx(-a, abs=0.003)
    assert sigma < 0.002
    named = {f.code: f.text for f in refinement_findings(found)}
    assert "to the right" in named["refine-side"]  # what is ahead seems to lie to the left
    assert "refine-side" not in {f.code for f in refinement_findings(straight)}


def test_a_clock_that_is_off_is_named(drives):
    scans, start, truth, found = drives[1]
    late = replace(scans, times=scans.times, odometry=_delayed(scans, 0.05))
    delayed = refine_by_scans(late, start)
    assert error(scans.times, delayed.poses, truth) < 0.03
    off, sigma = delayed.constants["clock"]
    assert off == pytest.approx(-0.05, abs=0.012)
    assert abs(off) > 5 * sigma
    assert "ms too late" in {f.code: f.text for f in refinement_findings(delayed)}["refine-clock"]
    assert "refine-clock" not in {f.code for f in refinement_findings(found)}


def _delayed(scans: Scans, by: float):
    """Increments of a path that is read later."""
    path = [SE3.identity]
    for u in scans.odometry.increments[1:]:
        path.append(SE3.compose(path[-1], u))
    at = Trajectory(scans.times, np.array(path)).interpolate(np.clip(scans.times - by, scans.times[0], scans.times[-1]))
    u = scans.odometry.increments.copy()
    u[1:] = SE3.between(at[:-1], at[1:])
    return replace(scans.odometry, increments=u)


def test_the_same_again_to_the_last_byte(drives):
    scans, start, _, found = drives[2]
    again = refine_by_scans(scans, start.copy())
    assert again.poses.tobytes() == found.poses.tobytes()
    assert again.covariances.tobytes() == found.covariances.tobytes()


def test_scans_are_read_as_written(drives, tmp_path):
    scans = drives[0][0]
    scans.save(tmp_path / "scans.npz")
    back = Scans.load(tmp_path / "scans.npz")
    for name in ("times", "offsets", "points", "origins", "returns", "ages", "tilt"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scans, name))
    assert back.biases == scans.biases


def test_matched_scans_refine_a_graph_only_if_they_contradict_it(bent):
    """A right path is only checked; a bent one is refined as it is without the check."""
    scans, start, truth, plain = bent
    right = SE3.compose(SE3.compose(start[0], SE3.inverse(truth[0])), truth)
    check = refine_if_contradicted(scans, right)
    assert isinstance(check, ScanCheck)
    assert abs(check.start - check.odometry) < 0.001
    assert check.start > 0.8
    refined = refine_if_contradicted(scans, start)
    assert isinstance(refined, Refinement)
    np.testing.assert_allclose(refined.poses, plain.poses, atol=1e-9)
    np.testing.assert_allclose(refined.covariances, plain.covariances, rtol=1e-6, atol=1e-12)
    assert ScanCheck(0.90, 0.905, np.array([[0, 9]])).contradicted


def test_what_cannot_be_refined_is_refused(drives):
    scans, start, _, _ = drives[0]
    with pytest.raises(GeometryError, match="does not fit"):
        refine_by_scans(scans, start[:-1])
    with pytest.raises(GeometryError, match="does not fit"):
        refine_by_scans(scans, np.where(np.arange(len(start))[:, None] == 3, np.nan, start))
    with pytest.raises(DataError, match="no beam"):
        refine_by_scans(replace(scans, returns=np.zeros(len(scans.returns), bool)), start)
    few = np.arange(4)
    with pytest.raises(DataError, match="too short to refine"):
        refine_by_scans(scans_at(scans, few), start[few])


def test_odometry_better_than_the_start_is_where_the_refinement_begins_again(bent):
    """The result is no worse than what came in."""
    scans, _, truth, found = bent
    assert found.reckoned > found.agreement[0]
    assert found.agreement[1] >= found.reckoned - 0.005
    assert error(scans.times, found.poses, truth) < 0.02
    assert "input-better" not in {f.code for f in refinement_findings(found)}
    worse = replace(found, reckoned=found.agreement[1] + 0.1)
    assert {f.code: f.level for f in refinement_findings(worse)}["input-better"] == "bad"


def test_odometry_better_than_all_that_was_made_of_it_is_the_result(bent, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds that bend the path whatever they begin with: what came in comes out."""
    scans, start, truth, _ = bent
    good = scans.odometry
    rounds = _Refiner.all_passes

    def bending(self: _Refiner, distances: tuple[float, ...]) -> None:
        rounds(self, distances)
        turns = np.linspace(0.0, 1.0, len(self.poses))[:, None] * np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        self.poses = SE3.compose(SE3.exp(turns), self.poses)
        self.surfaces = find_surfaces(self.cloud, self.poses, SURFACE)

    monkeypatch.setattr(_Refiner, "all_passes", bending)
    found = refine_by_scans(scans, start)
    assert found.left is not None
    assert found.left < found.reckoned == found.agreement[1]
    assert found.better
    assert not found.input_better
    assert error(scans.times, found.poses, truth) < 0.01
    levels = {f.code: f.level for f in refinement_findings(found)}
    assert levels == {"input-better": "look"}
    # as sure as the motion alone: each step adds its own noise and what lasts, and no scan takes any of it away
    wide = np.sqrt(np.trace(found.covariances[-1][3:, 3:]))
    assert wide >= 0.99 * np.sqrt(sum(np.trace(C[3:, 3:]) for C in good.covariances[1:]))
    np.testing.assert_allclose(found.joint([len(scans) - 1]), found.covariances[-1], atol=1e-12)
