"""What a segment added to a map that it entered again."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from graphslam.core.errors import DataError, GridError
from graphslam.core.poses import SE2, SE3
from graphslam.core.submap import Match, Submap
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.increment import map_increment, own_evidence
from tests.reference.plain_fuse import voxels_of_grid
from tests.reference.small_maps import room, scanned, some_pose


def later(grid: EvidenceGrid, dim: int, seed: int = 3) -> tuple[EvidenceGrid, EvidenceGrid]:
    """A copy of a map with two more scans in it, and these scans alone."""
    rng = np.random.default_rng(seed)
    copy, alone = grid.copy(), grid.empty()
    for _ in range(2):
        points = rng.normal(size=(30, dim))
        points *= 2.6 / np.linalg.norm(points, axis=1, keepdims=True)
        for g in (copy, alone):
            g.insert_scan(points, pose=None, origin=np.full(dim, 0.3))
    return copy, alone


@pytest.mark.parametrize("dim", [2, 3])
def test_what_came_in_since_is_what_was_scanned(dim: int, rng: np.random.Generator) -> None:
    old = scanned(rng, dim, scans=1)
    new, alone = later(old, dim)
    found = map_increment(new, old)
    wanted, got = voxels_of_grid(alone), voxels_of_grid(found.grid)
    assert set(got) <= set(wanted)
    # but for what was saturated, nothing is lost and nothing changed
    low, high = old.model.clamp_steps
    whole = voxels_of_grid(new)
    for voxel, value in wanted.items():
        if voxel not in got:
            assert whole[voxel] in (low, high)
        elif low < whole[voxel] < high:
            assert got[voxel] == value
    assert found.known == len(got) > 100
    assert found.shared == old.voxel_counts().known
    assert found.copied == sum(whole[v] == value for v, value in voxels_of_grid(old).items())
    # a map beside itself added nothing
    assert map_increment(old, old.copy()).known == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_a_value_from_beside_is_no_change_where_maps_were_rounded_twice(dim: int, rng: np.random.Generator) -> None:
    old, new = scanned(rng, dim), scanned(rng, dim)
    got = map_increment(new, old, slack=1)
    before, up = voxels_of_grid(old), 1 if dim == 3 else 0
    wanted = {}
    for (x, y, z), value in voxels_of_grid(new).items():
        beside = itertools.product(range(x - 1, x + 2), range(y - 1, y + 2), range(z - up, z + up + 1))
        if (x, y, z) in before and value in {before.get(v) for v in beside}:
            continue
        wanted[x, y, z] = value - before.get((x, y, z), 0)
    assert voxels_of_grid(got.grid) == wanted
    assert got.known < map_increment(new, old).known
    assert map_increment(old, old.copy(), slack=1).known == 0
    with pytest.raises(GridError):
        map_increment(new, old, slack=2)


def resampled(grid: EvidenceGrid, T: np.ndarray) -> EvidenceGrid:
    """A map in the frame of another base, as front ends hand it over."""
    moved = grid.empty()
    moved.merge(grid, T)
    return moved


@pytest.mark.parametrize("dim", [2, 3])
def test_submaps_lose_what_they_took_over(dim: int, rng: np.random.Generator) -> None:
    group = SE3 if dim == 3 else SE2
    first, second = scanned(rng, dim), scanned(rng, dim)
    T = some_pose(rng, dim, 0.3)  # T_old_here
    copy, _ = later(first, dim)
    here = resampled(copy, group.inverse(T))
    P = np.eye(group.dof)

    def submap(key: int, grid: EvidenceGrid | None, matches: tuple[Match, ...] = (), kind: str = "new") -> Submap:
        return Submap(
            key=key, interval=(key, key + 1.0), exit_pose=group.identity, exit_covariance=P, grid=grid,
            matches=matches, report={"entered": kind},
        )  # fmt: skip

    def match(target: int, T: np.ndarray) -> Match:
        return Match(target=target, T_target_here=T, covariance=P, fitness=0.9, support=0.5)

    matches = (match(1, group.identity), match(0, T), match(77, T))
    chain = [submap(0, first), submap(1, second), submap(2, here, matches, "match")]
    grids, entered = own_evidence(chain)
    assert entered == {2: 0}
    assert grids[0] is first
    assert grids[2].voxel_counts().known < here.voxel_counts().known
    assert voxels_of_grid(grids[2]) == voxels_of_grid(map_increment(here, first, group.inverse(T), slack=1).grid)
    # one that goes on in the map of the one before
    further = [submap(0, first), submap(1, resampled(copy, group.inverse(group.identity)), (), "same")]
    grids, entered = own_evidence(further)
    assert entered == {1: 0}
    assert grids[1].voxel_counts().known < copy.voxel_counts().known
    assert own_evidence([further[1]])[1] == {}
    # no match, or a map that is no copy of it: all is its own
    assert own_evidence([chain[0], submap(2, here, matches, "new")])[1] == {}
    assert own_evidence([chain[0], submap(2, second, (match(0, T),), "match")])[1] == {}
    with pytest.raises(DataError):
        own_evidence([submap(0, None)])


def test_other_grids_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(GridError):
        map_increment(scanned(rng, 3), scanned(rng, 2))
    with pytest.raises(GridError):
        map_increment(scanned(rng, 3), room(SE3.identity))
