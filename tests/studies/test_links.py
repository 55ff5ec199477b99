"""Links between pairs of poses from the landmarks that both saw."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.se3 import matrix_to_quat, se3_between, se3_log
from graphslam_studies.baselines.links import relative_links
from graphslam_studies.sim.laps import Laps, LapsConfig, draw_laps


@pytest.fixture(scope="module")
def world() -> Laps:
    return draw_laps(LapsConfig(poses=200, laps=4, begin=6, reach=8), seed=4)


def test_links_are_what_their_information_says(world: Laps) -> None:
    links = relative_links(world.problem())
    truth = np.column_stack([world.truth.position, matrix_to_quat(world.truth.rotation)])
    i, j = links.edges.T
    assert (j - i == 1).sum() >= 190
    assert (j - i > 20).sum() > 100
    r = se3_log(se3_between(links.measurements, se3_between(truth[i], truth[j])))
    squared = np.einsum("ni,nij,nj->n", r, links.information, r)
    assert np.mean(squared) / 6 == pytest.approx(1.0, abs=0.1)


def test_poses_that_share_nothing_are_refused(world: Laps) -> None:
    with pytest.raises(DataError, match="share"):
        relative_links(world.problem(), shared=1000)
