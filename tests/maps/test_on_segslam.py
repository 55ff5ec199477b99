"""Fused maps of submaps that SegSLAM made: the loop that is drawn twice is drawn once where the truth puts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from frontends.steps import Steps, make_steps
from graphslam.core.errors import DataError
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.fuse import fuse
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.submaps import divide_submaps
from tests.benchmarks.bench_maps import insert, scene, submaps_of
from tests.reference.small_maps import same_map


@pytest.fixture(scope="module")
def run() -> tuple[Steps, list[Submap]]:
    s = scene("court")
    steps = make_steps(s.log, s.config.steps)
    return steps, submaps_of(s, steps)


def test_at_the_chain_pieces_are_the_submaps(run: tuple[Steps, list[Submap]]) -> None:
    _, submaps = run
    divided = divide_submaps(submaps, every=3.0, own=False)
    assert len(divided.pieces) > 2 * len(submaps) > 4
    rigid = divide_submaps(submaps, every=None, own=False)
    assert set(rigid.pieces) == {(m.key, 0) for m in submaps}
    a, b = fuse(divided.pieces, divided.poses).grid, fuse(rigid.pieces, rigid.poses).grid
    # pieces of one submap have one base pose, but for rounding of nodes composed and taken apart: 1e-15 m
    assert a.known_volume() == pytest.approx(b.known_volume(), rel=1e-5)
    points = b.occupied_cloud()
    assert np.mean(a.values_at(points) == b.values_at(points)) > 0.9999
    # bases alone place them there, too
    bases = {m.key: rigid.poses[m.key, 0] for m in submaps}
    again = divided.from_bases(bases)
    assert all(np.allclose(again[n], divided.poses[n], atol=1e-12) for n in divided.pieces)
    with pytest.raises(DataError, match="no pose"):
        divided.from_bases({})


def test_the_map_is_clearer_at_the_true_poses(run: tuple[Steps, list[Submap]]) -> None:
    steps, submaps = run
    divided = divide_submaps(submaps, config=DivisionConfig(reach=9.0))
    assert steps.truth is not None
    true = divided.along(steps.truth)
    fused = fuse(divided.pieces, divided.poses)
    before = fused.entropy()
    change = fused.move(true)
    assert change.moved > len(divided.pieces) // 2
    after = fused.entropy()
    assert after < before
    assert same_map(fused.grid, fuse(divided.pieces, fused.poses).grid)
    # and is near what the scans themselves make at the true poses
    scans: EvidenceGrid = insert(steps, steps.truth.interpolate(steps.times), 0.2, fused.grid.model)
    assert after == pytest.approx(scans.entropy(), rel=0.05)
    assert fused.known_volume() == pytest.approx(scans.known_volume(), rel=0.05)
    # one rigid piece a submap leaves the bend inside: not as near
    rigid = divide_submaps(submaps, every=1e9)
    occupied = scans.occupied_cloud()
    near = [np.mean(m.grid.occupied_at(occupied)) for m in (fused, fuse(rigid.pieces, rigid.along(steps.truth)))]
    assert near[0] > near[1]


def test_submaps_that_cannot_be_divided_are_refused(run: tuple[Steps, list[Submap]]) -> None:
    _, submaps = run
    with pytest.raises(DataError):
        divide_submaps([])
    with pytest.raises(DataError, match="no path"):
        divide_submaps([replace(submaps[0], trajectory=None)])
    with pytest.raises(DataError, match="no evidence grid"):
        divide_submaps([replace(submaps[0], grid=None)])
