"""Fused maps of submaps that SegSLAM made: the loop that is drawn twice is drawn once where the truth puts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.fuse import fuse_pieces
from graphslam.maps.increment import own_evidence
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.segslam_evidence import own_evidence_of
from graphslam.maps.submaps import divide_submaps
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.steps import Steps
from graphslam_frontends.segslam.front_end import submaps_of_best_particle
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_frontends.segslam.segslam import run_segslam
from graphslam_frontends.segslam.submaps import common_ancestor_chain
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
    a, b = fuse_pieces(divided.pieces, divided.poses).grid, fuse_pieces(rigid.pieces, rigid.poses).grid
    # pieces of one submap have one base pose, but for rounding of nodes composed and taken apart: 1e-15 m
    assert a.known_volume() == pytest.approx(b.known_volume(), rel=1e-5)
    points = b.occupied_cloud()
    assert np.mean(a.values_at(points) == b.values_at(points)) > 0.9999


def test_the_map_is_clearer_at_the_true_poses(run: tuple[Steps, list[Submap]]) -> None:
    steps, submaps = run
    divided = divide_submaps(submaps, config=DivisionConfig(reach=9.0))
    assert steps.truth is not None
    true = divided.along(steps.truth)
    fused = fuse_pieces(divided.pieces, divided.poses)
    before = fused.entropy()
    change = fused.move(true)
    assert change.moved > len(divided.pieces) // 2
    after = fused.entropy()
    assert after < before
    assert same_map(fused.grid, fuse_pieces(divided.pieces, fused.poses).grid)
    # and is near what the scans themselves make at the true poses
    scans: EvidenceGrid = insert(steps, steps.truth.interpolate(steps.times), 0.2, fused.grid.model)
    assert after == pytest.approx(scans.entropy(), rel=0.05)
    assert fused.known_volume() == pytest.approx(scans.known_volume(), rel=0.05)
    # one rigid piece a submap leaves the bend inside: not as near
    rigid = divide_submaps(submaps, every=1e9)
    occupied = scans.occupied_cloud()
    near = [np.mean(m.grid.occupied_at(occupied)) for m in (fused, fuse_pieces(rigid.pieces, rigid.along(steps.truth)))]
    assert near[0] > near[1]


def test_submaps_that_cannot_be_divided_are_refused(run: tuple[Steps, list[Submap]]) -> None:
    _, submaps = run
    with pytest.raises(DataError):
        divide_submaps([])
    with pytest.raises(DataError, match="no path"):
        divide_submaps([replace(submaps[0], trajectory=None)])
    with pytest.raises(DataError, match="has no map"):
        divide_submaps([replace(submaps[0], grid=None)])


@pytest.fixture(scope="module")
def reentered() -> tuple[SegSlamResult, list[Submap]]:
    """A run that enters an older map, by more than one particle."""
    s = scene("court")
    steps = make_steps(s.log, s.config.steps)
    result = run_segslam(steps, replace(s.config.filter, particles=5), s.config.segslam, SeedTree(0))
    return result, submaps_of_best_particle(result, s.config.drift, s.config.segslam)


def test_a_segment_that_entered_a_map_is_left_with_its_own(reentered: tuple[SegSlamResult, list[Submap]]) -> None:
    result, submaps = reentered
    chain = common_ancestor_chain(result.segmap, int(result.closed[result.best]))
    exact = own_evidence_of(result.segmap, chain, submaps)
    entered = [m for m in submaps if m.report["entered"] != "new"]
    assert entered
    separated, _ = own_evidence(submaps)
    for m in submaps:
        whole, own = m.grid.voxel_counts().known, exact[m.key].voxel_counts().known  # type: ignore[union-attr]
        if m in entered:
            assert own < 0.8 * whole
            # what can be told without the run is about as much
            assert separated[m.key].voxel_counts().known == pytest.approx(own, rel=0.25)
        else:
            assert exact[m.key] is m.grid
    # along the path of the map sample, the map is nearer to that of the scans than with everything twice
    path = result.trajectory()
    poses = path.interpolate(np.clip(result.steps.times, path.times[0], path.times[-1]))
    scans = insert(result.steps, poses, 0.2, submaps[0].grid.model)  # type: ignore[union-attr]
    off = []
    for grids in (None, separated, exact):
        divided = divide_submaps(submaps, own=False, grids=grids, config=DivisionConfig(reach=9.0))
        off.append(abs(fuse_pieces(divided.pieces, divided.along(path)).entropy() - scans.entropy()))
    assert off[2] < off[0]
    assert max(off) < 0.05 * scans.entropy()
    with pytest.raises(DataError):
        own_evidence_of(result.segmap, chain[:1], submaps)
