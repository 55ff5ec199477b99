"""From segments to submaps: bases, exits, maps in the right frame, matches with their support."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import CovarianceError, DataError
from graphslam.core.geometry import se2_between, se2_compose, se2_inverse
from graphslam.core.poses import SE3, pose_mean, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.io.submap_store import read_submaps, write_submaps
from graphslam_frontends.segslam.config import HandoverConfig
from graphslam_frontends.segslam.segmap import SAME, SegMap, SegmentEntry
from graphslam_frontends.segslam.submaps import Drift, common_ancestor_chain, drift_by_errors, submaps_of_segments
from tests.reference.segmap_twin import flat_grid, mark, marked, match_entry, small_segmap, straight

ZERO = np.zeros(3)
D = np.diag([0.01, 0.02, 1e-4])


def drift_by_length(path_length: np.ndarray, model: Callable[[float], np.ndarray]) -> Drift:
    """A drift that knows the length of the path only."""

    def drift(start: int, end: int, *, level_end: bool) -> np.ndarray:
        return model(float(path_length[end] - path_length[start]))

    return drift


def drift(start: int, end: int, *, level_end: bool) -> np.ndarray:
    return D * (end - start + 1)


def loop(fitness: tuple[float, ...] = (0.9, 0.95, 0.9, 0.9)) -> SegMap:
    """Four particles: 4 m ahead and a quarter turn, four times; then three of them enter the first map.

    Particle p's segments are p centimetres longer. Particles 0 and 1 enter the map of particle 0, particle 2 that of
    particle 1, particle 3 goes on in a new one. Weights 4 : 3 : 2 : 1.
    """
    m, n = small_segmap(15, 4), 4
    w = np.array([4.0, 3.0, 2.0, 1.0])
    for k in range(4):
        m.open(2 * k, [SegmentEntry(T_entry=ZERO)] * n)
        paths, grids = [], [flat_grid() for _ in range(n)]
        for p in range(n):
            path = straight(ZERO, 4.0 + 0.01 * p, 2)
            path[-1, 2] = np.pi / 2
            paths.append(path)
            mark(grids[p], 4 * k, p)
        m.close(2 * k + 2, grids, paths, w)
    entries = [match_entry(np.array([0.5, 0.1 * p, 0.0]), source, fitness[p]) for p, source in enumerate((0, 0, 1))]
    maps = m.open(8, [*entries, SegmentEntry(T_entry=ZERO)])
    paths = [straight(e.T_entry, 3.0, 2) for e in entries] + [straight(ZERO, 3.0, 2)]
    grids = [flat_grid() if g is None else g for g in maps]
    m.close(10, grids, paths, w)
    return m


def test_a_chain_becomes_submaps_whose_exits_are_the_next_bases() -> None:
    m = loop()
    chain = common_ancestor_chain(m, 16)
    assert chain.tolist() == [0, 4, 8, 12, 16]
    submaps = submaps_of_segments(m, chain, drift, uses=frozenset({"laser"}), reasons={2: "score", 10: "end-of-log"})
    assert [s.key for s in submaps] == [0, 1, 2, 3, 4]
    assert [s.interval for s in submaps] == [(0.0, 2.0), (2.0, 4.0), (4.0, 6.0), (6.0, 8.0), (8.0, 10.0)]
    for s in submaps[:4]:
        np.testing.assert_allclose(s.exit_pose, [4.0, 0.0, np.pi / 2], atol=1e-12)
    # the last one worked in the frame of the first map, half a metre ahead: its base is the body at the entry
    np.testing.assert_allclose(submaps[4].exit_pose, [3.0, 0.0, 0.0], atol=1e-12)
    assert submaps[4].trajectory is not None
    np.testing.assert_allclose(submaps[4].trajectory.poses, straight(ZERO, 3.0, 2), atol=1e-12)
    assert submaps[0].uses == {"laser"}
    assert [s.report["ended"] for s in submaps] == ["score", "unknown", "unknown", "unknown", "end-of-log"]
    assert [s.report["entered"] for s in submaps] == ["new", "new", "new", "new", "match"]
    # the last went on in the map of the first: the two hold the same scans
    assert [s.report["holds"] for s in submaps] == [[0], [1], [2], [3], [0, 4]]
    assert [s.key for s in submaps_of_segments(m, chain, drift, after=2)] == [3, 4]
    json.dumps([dict(s.report) for s in submaps], allow_nan=False)


def test_the_exit_covariance_is_particles_about_the_chosen_one_plus_drift() -> None:
    m = loop()
    s = submaps_of_segments(m, [0], drift)[0]
    w = np.array([0.4, 0.3, 0.2, 0.1])
    ahead = 0.01 * np.arange(4)  # along x of the start, which is -y at an exit that looks to the left
    np.testing.assert_allclose(s.exit_covariance, 3 * D + np.diag([0.0, w @ ahead**2, 0.0]), atol=1e-12)
    paper = submaps_of_segments(m, [0], drift, HandoverConfig(matched_only=True))[0]
    spread = w @ (ahead - w @ ahead) ** 2
    np.testing.assert_allclose(paper.exit_covariance, np.diag([1e-4, spread + 1e-4, 1e-6]), atol=1e-12)
    assert paper.report["covariance"] == "moment-matched"
    scaled = submaps_of_segments(m, [0], drift, HandoverConfig(drift_scale=2.0))[0]
    np.testing.assert_allclose(scaled.exit_covariance - s.exit_covariance, 3 * D, atol=1e-12)
    with pytest.raises(CovarianceError):
        submaps_of_segments(m, [0], lambda start, end, *, level_end: np.zeros((3, 3)))
    # along the path it grows from the start to the end
    assert s.trajectory is not None
    P = s.trajectory.covariances
    assert P is not None
    np.testing.assert_allclose(P[0], D, atol=1e-12)
    np.testing.assert_allclose(P[-1], s.exit_covariance, atol=1e-12)
    np.testing.assert_allclose(P[1], 2 * D + np.diag([w @ (0.5 * ahead) ** 2, 0, 0]), atol=1e-12)


def test_matches_go_along_with_their_support(monkeypatch: pytest.MonkeyPatch) -> None:
    m = loop()
    last = submaps_of_segments(m, common_ancestor_chain(m, 16), drift)[-1]
    (match,) = last.matches  # all three lead to the first submap of the chain
    assert match.target == 0
    assert match.support == pytest.approx(0.9)
    assert match.fitness == 0.9
    np.testing.assert_allclose(match.T_target_here, [0.5, 0.0, 0.0], atol=1e-12)
    # particle 1 says 0.1 m to the left, particle 2 0.2 m, entering another particle's map: that is their scatter.
    # Segments 0 and 1 agree where the body passed nearest to the match, at the start
    w = np.array([4.0, 3.0, 2.0])
    scatter = w @ np.array([0.0, 0.1, 0.2]) ** 2 / w.sum()
    np.testing.assert_allclose(match.covariance, 1e-4 * np.eye(3) + np.diag([0, scatter, 0]), atol=1e-12)
    assert last.report["entered_share"] == pytest.approx({"new": 0.1, "match": 0.9, "same": 0.0})
    # a chain by the particle that did not take it: the others' match is still handed over, the heaviest's
    other = submaps_of_segments(m, [0, 4, 8, 12, 19], drift)[-1]
    assert other.report["entered"] == "new"
    (match,) = other.matches
    assert match.support == pytest.approx(0.9)
    np.testing.assert_allclose(match.T_target_here, [0.5, 0.0, 0.0], atol=1e-12)
    with monkeypatch.context() as patch:
        patch.setattr("graphslam_frontends.segslam.submaps.MINIMUM_SUPPORT", 0.95)
        assert submaps_of_segments(m, [0, 4, 8, 12, 19], drift)[-1].matches == ()
    # with another particle's first segment in the chain, the same place
    (match,) = submaps_of_segments(m, [2, 4, 8, 12, 16], drift)[-1].matches
    np.testing.assert_allclose(match.T_target_here, [0.5, 0.0, 0.0], atol=1e-12)


def test_a_match_into_another_particles_map_is_carried_over_where_the_body_passed() -> None:
    """Near the end of the first segment, the two particles' paths differ by 2 cm: so does what the match says."""
    m, n = small_segmap(9, 2), 2
    m.open(0, [SegmentEntry(T_entry=ZERO)] * n)
    m.close(4, [flat_grid(), flat_grid()], [straight(ZERO, 8.0, 4), straight(ZERO, 8.08, 4)])
    m.open(4, [match_entry(np.array([6.1, 0.3, 0.2]), 1)] * n)
    m.close(6, [flat_grid(), flat_grid()], [straight(np.array([6.1, 0.3, 0.2]), 1.0 + 0.01 * p, 2) for p in range(n)])
    (match,) = submaps_of_segments(m, [0, 2], drift)[1].matches
    np.testing.assert_allclose(match.T_target_here, [6.1 - 0.06, 0.3, 0.2], atol=1e-12)
    (match,) = submaps_of_segments(m, [1, 2], drift)[1].matches
    np.testing.assert_allclose(match.T_target_here, [6.1, 0.3, 0.2], atol=1e-12)


def test_matches_whose_target_is_gone_are_counted() -> None:
    m = loop()
    m._release(np.array([1]))
    last = submaps_of_segments(m, common_ancestor_chain(m, 16), drift)[-1]
    assert last.report["matches_without_target"] == 1
    assert last.matches[0].support == pytest.approx(0.7)
    assert submaps_of_segments(m, [16], drift)[0].matches == ()  # the chain does not hold what was entered


def test_maps_are_handed_over_in_the_frames_of_their_bases() -> None:
    m, entry = small_segmap(9, 1), np.array([3.0, 2.0, np.pi / 2])
    m.open(0, [SegmentEntry(T_entry=ZERO)])
    grid = flat_grid()
    mark(grid, 5, 2)
    m.close(2, [grid], [straight(ZERO, 1.0, 2)])
    m.open(2, [match_entry(entry, 0)])
    m.close(4, [m.map_of(0).copy()], [straight(entry, 1.0, 2)])
    first, second = submaps_of_segments(m, [0, 1], drift)
    assert isinstance(first.grid, EvidenceGrid)
    assert isinstance(second.grid, EvidenceGrid)
    assert first.grid.same_as(m.map_of(0))
    assert marked(first.grid) == {(5, 2)}
    # voxel (5, 2) has its centre at (5.5, 2.5): 0.5 m ahead and 2.5 m to the right of a body at (3, 2) facing left
    assert marked(second.grid) == {(0, -3)}
    assert submaps_of_segments(m, [0], drift, with_grids=False)[0].grid is None


def test_a_chain_with_gaps_is_refused_and_holes_in_a_history_are_filled() -> None:
    m = loop()
    with pytest.raises(DataError, match="does not follow"):
        submaps_of_segments(m, [0, 8], drift)
    m._release(np.array([8]))
    assert common_ancestor_chain(m, 16).tolist() == [1, 5, 9, 12, 16]  # the heaviest that fits
    with pytest.raises(DataError, match="pruned"):
        submaps_of_segments(m, [8], drift)


def test_an_interval_of_which_nothing_heavy_is_left_is_still_handed_over() -> None:
    m = loop()
    m.table.weight[:4] = 0.0
    s = submaps_of_segments(m, [0], drift)[0]
    ahead = 0.01 * np.arange(4)
    np.testing.assert_allclose(s.exit_covariance, 3 * D + np.diag([0.0, np.mean(ahead**2), 0.0]), atol=1e-12)


def test_going_on_in_the_same_map_is_no_match() -> None:
    m = small_segmap(5, 1)
    m.open(0, [SegmentEntry(T_entry=ZERO)])
    m.close(2, [flat_grid()], [straight(ZERO, 1.0, 2)])
    (grid,) = m.open(2, [SegmentEntry(T_entry=m[0].T_exit, kind=SAME, source=0)])
    assert grid is not None
    m.close(4, [grid], [straight(m[0].T_exit, 1.0, 2)])
    s = submaps_of_segments(m, [0, 1], drift)[1]
    assert s.matches == ()
    assert s.report["entered"] == "same"
    np.testing.assert_allclose(s.exit_pose, [1.0, 0.0, 0.0], atol=1e-12)


def test_in_three_dimensions_bases_are_level_and_paths_keep_their_tilt() -> None:
    rng = np.random.default_rng(0)

    def body(T: np.ndarray) -> np.ndarray:
        lean = np.concatenate([np.zeros(3), se3.so3_exp(np.concatenate([0.05 * rng.normal(size=2), [0.0]]))])
        return se3.se3_compose(T, lean)

    def pose(x: float, y: float, z: float, heading: float) -> np.ndarray:
        return np.concatenate([[x, y, z], se3.so3_exp([0.0, 0.0, heading])])

    m = SegMap(np.arange(7.0), np.arange(7.0), 1, dim=3, gravity=True)
    entry = body(pose(0, 0, 0, 0))
    m.open(0, [SegmentEntry(T_entry=entry)])
    m.close(2, [flat_grid(dim=3)], [np.stack([entry, body(pose(1, 0, 0, 0)), body(pose(2, 1, 0.3, 0.9))])])
    entry = body(pose(5, 6, 1, -2.0))
    own = np.diag([1e-6, 2e-6, 3e-6, 1e-2, 2e-2, 3e-2])
    m.open(2, [SegmentEntry(T_entry=entry, kind=1, source=0, covariance=own, fitness=0.9)])
    path = np.stack([entry, body(pose(6, 6, 1, -2.0)), body(pose(7, 6, 1.2, -1.0))])
    m.close(4, [flat_grid(dim=3)], [path])
    asked: list[tuple[bool, bool]] = []

    class Errors:
        def between(self, start: int, end: int, *, level_start: bool = False, level_end: bool = False):  # type: ignore[no-untyped-def]
            asked.append((level_start, level_end))
            return None, np.eye(6) * 1e-3

    a, b = submaps_of_segments(m, [0, 1], drift_by_errors(Errors(), gravity=True))
    assert (True, True) in asked
    np.testing.assert_allclose(a.exit_pose, pose(2, 1, 0.3, 0.9), atol=2e-3)
    np.testing.assert_allclose(a.exit_pose, remove_roll_pitch(a.exit_pose), atol=1e-15)
    base = remove_roll_pitch(entry)
    np.testing.assert_allclose(b.exit_pose, remove_roll_pitch(se3.se3_between(base, path[-1])), atol=1e-12)
    assert b.trajectory is not None
    np.testing.assert_allclose(
        se3.pose_to_matrix(b.trajectory.poses),
        se3.pose_to_matrix(se3.se3_between(np.broadcast_to(base, path.shape), path)),
        atol=1e-12,
    )
    (match,) = b.matches
    expected = se3.se3_between(remove_roll_pitch(m[0].T_entry), remove_roll_pitch(entry))
    np.testing.assert_allclose(match.T_target_here, expected, atol=1e-12)
    np.testing.assert_allclose(match.T_target_here[:3], [5, 6, 1], atol=2e-3)  # a lean turns headings a little
    np.testing.assert_allclose(match.T_target_here[3:5], 0.0, atol=1e-15)
    # the covariance turned from the body's axes to those of the base: Monte Carlo
    noise = rng.multivariate_normal(np.zeros(6), own, 20000)
    bodies = SE3.compose(np.broadcast_to(entry, (20000, 7)), SE3.exp(noise))
    lean = SE3.between(entry, base)
    bases = SE3.compose(bodies, np.broadcast_to(lean, bodies.shape))
    e = SE3.log(SE3.between(np.broadcast_to(base, bases.shape), bases))
    np.testing.assert_allclose(match.covariance, e.T @ e / 20000, atol=4e-4)
    assert np.abs(pose_mean(bases[:50])[:3] - base[:3]).max() < 0.1


def test_chained_submaps_are_the_path_that_was_driven() -> None:
    """Composed exits take the base of each submap to where the sample has it."""
    m = loop()
    submaps = submaps_of_segments(
        m, common_ancestor_chain(m, 19), drift_by_length(m.path_length, lambda s: D * (1 + s))
    )
    T = ZERO
    for s in submaps:
        T = se2_compose(T, s.exit_pose)
    # four quarter turns close, and then 3 m ahead
    np.testing.assert_allclose(se2_between(ZERO, T), [3.0, 0.0, 0.0], atol=0.1)
    np.testing.assert_allclose(se2_compose(se2_inverse(T), T), 0.0, atol=1e-12)
    np.testing.assert_allclose(submaps[0].exit_covariance[2, 2], D[2, 2] * 3, atol=1e-9)


def test_submaps_go_to_disk_and_come_back(tmp_path) -> None:  # type: ignore[no-untyped-def]
    m = loop()
    submaps = submaps_of_segments(m, common_ancestor_chain(m, 16), drift)
    write_submaps(tmp_path, submaps)
    back = list(read_submaps(tmp_path))
    assert len(back) == 5
    np.testing.assert_array_equal(back[4].exit_covariance, submaps[4].exit_covariance)


def test_bases_stand_on_the_lattice_of_their_maps() -> None:
    """A new map begins a quarter of a voxel below the body: its submap has the very grid, and exits do not change."""
    up = np.array([0.0, 0, 0, 0, 0, 0, 1])

    def settled(lift: float) -> list[Submap]:
        m = SegMap(np.arange(5.0), np.arange(5.0), 1, dim=3, gravity=True, lift=lift)
        for k, rise in ((0, 0.3), (2, -0.2)):
            path = np.tile(up, (3, 1))
            path[:, 0], path[:, 2] = [0.0, 1.0, 2.0], lift + rise * np.array([0.0, 0.5, 1.0])
            m.open(k, [SegmentEntry(T_entry=path[0])])
            m.close(k + 2, [flat_grid(dim=3)], [path])
        return submaps_of_segments(m, [0, 1], drift_by_length(m.path_length, lambda s: np.eye(6) * 1e-3))

    for plain, lifted in zip(settled(0.0), settled(0.05)):
        np.testing.assert_allclose(lifted.exit_pose, plain.exit_pose, atol=1e-12)
        np.testing.assert_allclose(lifted.exit_covariance, plain.exit_covariance, atol=1e-12)
        assert lifted.grid is not None
        assert plain.grid is not None
        np.testing.assert_array_equal(lifted.grid.brick_values(), plain.grid.brick_values())
        assert lifted.trajectory is not None
        assert plain.trajectory is not None
        above = lifted.trajectory.poses - plain.trajectory.poses
        np.testing.assert_allclose(above, np.tile([0, 0, 0.05, 0, 0, 0, 0], (3, 1)), atol=1e-12)
