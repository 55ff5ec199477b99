"""Fused maps of recorded data: what the scans make along a path, pieces make there, also where the path is bent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core.poses import SE3
from graphslam.core.trajectory import Trajectory
from graphslam.maps.fuse import fuse_pieces
from graphslam.maps.pieces import DivisionConfig
from graphslam.maps.submaps import divide_submaps
from graphslam_frontends.odometry.make_steps import make_steps
from tests.benchmarks.bench_maps import bodies_of, insert, scene, submaps_of


@pytest.mark.data
def test_pieces_make_what_the_scans_make(data_dir: Path) -> None:
    s = scene("lidar3d-hku1", points=300)
    begins = float(s.log["reference"].times[0])
    steps = make_steps(s.log.slice(begins, begins + 30.0), s.config.steps)
    submaps = submaps_of(s, steps)
    divided = divide_submaps(submaps, config=DivisionConfig(reach=31.0))
    size, model = divided.pieces[0, 0].voxel_size, submaps[0].grid.model  # type: ignore[union-attr]
    bodies = bodies_of(submaps, steps)
    scans = insert(steps, bodies, size, model)
    fused = fuse_pieces(divided.pieces, divided.poses, model=model)
    assert fused.known_volume() == pytest.approx(scans.known_volume(), rel=0.05)
    assert fused.entropy() == pytest.approx(scans.entropy(), rel=0.05)
    # a bend of 4° and 1.2 m, spread over the way
    share = np.linspace(0.0, 1.0, len(bodies))[:, None]
    bent = SE3.compose(SE3.exp(share * [0.0, 0.0, np.radians(4.0), 1.0, 0.6, 0.3]), bodies)
    fused.move(divided.along(Trajectory(steps.times, bent)))
    there = insert(steps, bent, size, model)
    occupied = there.occupied_cloud()
    near, far = (np.mean(g.occupied_at(occupied)) for g in (fused.grid, scans))
    # thin surfaces on another lattice: few of their voxels are the very same, but many more than of the unbent map
    assert near > 1.3 * far
    assert fused.known_volume() == pytest.approx(there.known_volume(), rel=0.05)
