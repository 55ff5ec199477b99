"""The twin itself: rays against a hand-made case and against sampling, scans and casts by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graphslam.evidence.beams import BeamModel
from tests.reference.evidence_twin import EvidenceTwin, brute_ray_voxels, crossings, ray_voxels

HALF = 4 * 4**5


@pytest.fixture
def twin() -> EvidenceTwin:
    return EvidenceTwin(0.5, BeamModel(), HALF)


def test_ray_by_hand() -> None:
    # y = 0.5 + x/4: crosses x = 1, then y = 1 at x = 2 exactly (a tie), then x = 3
    assert ray_voxels((0.0, 0.5, 0.5), (3.5, 1.375, 0.5)) == [(0, 0, 0), (1, 0, 0), (2, 1, 0), (3, 1, 0)]
    # off the tie the ray has length in the voxel beside it
    assert ray_voxels((0.0, 0.55, 0.5), (3.5, 1.425, 0.5)) == [(0, 0, 0), (1, 0, 0), (1, 1, 0), (2, 1, 0), (3, 1, 0)]
    assert ray_voxels((0.5, 0.5, 0.5), (-1.5, 0.5, 0.5)) == [(0, 0, 0), (-1, 0, 0), (-2, 0, 0)]
    assert ray_voxels((0.5, 0.5, 0.5), (0.25, 0.5, 0.5)) == [(0, 0, 0)]


def test_ray_that_starts_or_ends_on_a_plane() -> None:
    # the origin's and the end's voxels are those of the floor, also where the ray only touches them
    assert ray_voxels((3.0, 0.5, 0.5), (1.5, 0.5, 0.5)) == [(3, 0, 0), (2, 0, 0), (1, 0, 0)]
    assert ray_voxels((1.5, 0.5, 0.5), (3.0, 0.5, 0.5)) == [(1, 0, 0), (2, 0, 0), (3, 0, 0)]
    assert ray_voxels((1.5, 2.0, 0.5), (3.5, 2.0, 0.5)) == [(1, 2, 0), (2, 2, 0), (3, 2, 0)]


def test_crossings_are_exact_and_sorted(rng: np.random.Generator) -> None:
    for _ in range(20):
        o, e = rng.uniform(-6, 6, (2, 3))
        t = crossings(o, e)
        assert t == sorted(t)
        assert len(t) == int(np.abs(np.floor(o) - np.floor(e)).sum())  # one a plane: no ties among random rays


def test_rays_agree_with_sampling(rng: np.random.Generator) -> None:
    missed = total = 0
    for _ in range(25):
        o, e = rng.uniform(-8, 8, (2, 3))
        path = ray_voxels(o, e)
        seen = brute_ray_voxels(o, e)
        assert seen <= set(path)  # sampling finds nothing else
        missed += len(set(path) - seen)
        total += len(path)
        steps = np.abs(np.diff(np.array(path), axis=0)).sum(1)
        assert (steps == 1).all()  # 6-connected
        assert len(path) == 1 + int(np.abs(np.floor(o) - np.floor(e)).sum())
    assert missed <= 0.01 * total  # only pieces shorter than 1/20000 of the ray


def test_scan_by_hand(twin: EvidenceTwin) -> None:
    m = twin.model
    # two beams along x from the middle of voxel 0: one ends in voxel 2, one passes it and ends in voxel 4
    report = twin.insert_scan([[1.2, 0.25, 0.25], [2.2, 0.25, 0.25]], (0.25, 0.25, 0.25))
    assert (report.rays, report.touched) == (2, 5)
    # a hit wins over a pass, and voxels crossed twice are updated once
    expected = {0: m.miss_step, 1: m.miss_step, 2: m.hit_step, 3: m.miss_step, 4: m.hit_step}
    assert twin.values == {(i, 0, 0): v for i, v in expected.items()}
    for _ in range(40):
        twin.insert_scan([[1.2, 0.25, 0.25]], (0.25, 0.25, 0.25))
    assert twin.values[0, 0, 0] == m.clamp_steps[0]
    assert twin.values[2, 0, 0] == m.clamp_steps[1]


def test_beams_without_return_or_cut_leave_free_space_only(twin: EvidenceTwin) -> None:
    twin.insert_scan([[1.2, 0.25, 0.25]], (0.25, 0.25, 0.25), returns=[False])
    assert sorted(twin.values) == [(0, 0, 0), (1, 0, 0)]
    other = twin.empty()
    report = other.insert_scan([[9.0, 0.25, 0.25]], (0.25, 0.25, 0.25), max_range=1.0)
    assert report.cut == 1
    assert other.values == twin.values


def test_dropped_beams_are_counted(twin: EvidenceTwin) -> None:
    far = HALF * twin.voxel_size
    points = [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [far, 0, 0], [-far - 0.1, 0, 0]]
    report = twin.insert_scan(points)
    assert (report.rays, report.not_finite, report.zero_length, report.outside) == (0, 2, 1, 2)
    assert not twin.values


def test_cast_by_hand(twin: EvidenceTwin) -> None:
    twin.insert_scan([[1.2, 0.25, 0.25]], (0.25, 0.25, 0.25))
    assert twin.cast((0.25, 0.25, 0.25), (3, 0, 0), 5.0) == ("hit", pytest.approx(1.0), (2, 0, 0))
    assert twin.cast((0.25, 0.25, 0.25), (3, 0, 0), 0.8) == ("hit", 0.8, (2, 0, 0))
    assert twin.cast((0.25, 0.25, 0.25), (3, 0, 0), 0.7) == ("max", 0.7, None)
    assert twin.cast((1.25, 0.25, 0.25), (0, 1, 0), 5.0) == ("inside", 0.0, (2, 0, 0))
    assert twin.cast((0.25, 0.25, 0.25), (-1, 0, 0), 5.0, ignore_unknown=False)[0] == "unknown"
    assert twin.cast((0.25, 0.25, 0.25), (-1, 0, 0), 5.0)[0] == "max"
    small = EvidenceTwin(0.5, BeamModel(), 16)
    assert small.cast((0.25, 0.25, 0.25), (1, 0, 0), 50.0) == ("left", pytest.approx(7.75), None)


def test_merge_under_a_quarter_turn(twin: EvidenceTwin) -> None:
    other = twin.empty()
    other.values = {(0, 0, 0): 100, (1, 0, 0): 200, (5, 2, 3): -50}
    twin.values = {(-1, 0, 0): 7, (-1, 1, 0): 30000}
    s = math.sin(math.pi / 4)
    twin.merge(other, [0.0, 0.0, 0.0, 0.0, 0.0, s, s])  # x to y: voxel (i, j) goes to (-1 - j, i)
    assert twin.values == {(-1, 0, 0): 107, (-1, 1, 0): twin.model.clamp_steps[1], (-3, 5, 3): -50}


def test_entropy_of_a_coin_and_of_certainty(twin: EvidenceTwin) -> None:
    assert twin.entropy() == 0.0  # nothing observed
    twin.values = {(0, 0, 0): 0}
    assert twin.entropy() == pytest.approx(math.log(2) * 0.5**3, rel=1e-15)
    p = 0.8
    twin.values = {(0, 0, 0): round(math.log(p / (1 - p)) * 2048)}
    assert twin.entropy() == pytest.approx(-(p * math.log(p) + (1 - p) * math.log(1 - p)) / 8, rel=1e-3)
    twin.values = {(0, 0, 0): 32767}
    assert 0 < twin.entropy() < 1e-5


def test_clouds_boxes_and_bounds(twin: EvidenceTwin) -> None:
    assert twin.bounds() is None
    twin.values = {(0, 0, 0): 5, (1, 0, 0): 5, (-1, 0, 0): 5, (3, 3, 3): -5}
    assert twin.bounds() == ((-1, 0, 0), (4, 4, 4))
    np.testing.assert_allclose(twin.occupied_cloud(), [[-0.25, 0.25, 0.25], [0.25, 0.25, 0.25], [0.75, 0.25, 0.25]])
    cells = twin.binned_cloud(1)
    assert {c: n for c, (_, n) in cells.items()} == {(0, 0, 0): 2, (-1, 0, 0): 1}
    np.testing.assert_allclose(cells[0, 0, 0][0], [0.5, 0.25, 0.25])
    assert list(twin.binned_cloud(1, minimum=2)) == [(0, 0, 0)]
    assert dict(twin.box((-1, 0, 0), (2, 1, 1))) == {"occupied": 3, "known": 3, "all": 3}
    assert dict(twin.box((0, 0, 0), (4, 4, 4))) == {"occupied": 2, "known": 3, "all": 64}
