"""Headings that drift by degrees inside a submap: maps are consistent in the group chart, and joins of them without a
polish; the same maps read as plain vectors are not."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.app.compare import map_nees
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.join.registry import join_by_method
from graphslam_studies.charts import ChartConfig, local_table, run_trial
from tests.reference.submap_chain import submap_chain

RUNS = 10


@pytest.fixture(scope="module")
def consistency() -> dict[str, tuple[float, int]]:
    """Joint NEES and its dimension over all runs, by method, in the group chart; 16 maps, 2.3° each."""
    found: dict[str, tuple[float, int]] = {}
    for seed in range(RUNS):
        chain, truth = submap_chain(
            np.random.default_rng(seed), submaps=16, landmarks=70, radius=30.0, sigma_heading=0.04, chart="group"
        )
        for method in ("eif-tree", "eif-tree-classical", "batch", "isam2"):
            d2, dof = map_nees(join_by_method(chain, method), [s.key for s in chain], truth, chart="group")
            before = found.get(method, (0.0, 0))
            found[method] = (before[0] + d2, before[1] + dof)
    return found


@pytest.mark.parametrize("method", ["eif-tree", "batch", "isam2"])
def test_joined_maps_are_consistent_in_the_group_chart(consistency: dict[str, tuple[float, int]], method: str) -> None:
    d2, dof = consistency[method]
    low, high = chi2_mean_bounds(dof, 1, confidence=0.999)
    assert low < d2 < 1.03 * high  # an unpolished filter may cost three parts in a hundred
    assert not low < 2.0 * d2 < 1.03 * high  # and a covariance of half the size is found


def test_the_classical_filter_is_not(consistency: dict[str, tuple[float, int]]) -> None:
    assert consistency["eif-tree-classical"][0] > 1.3 * consistency["eif-tree"][0]


def test_local_maps_of_a_drifting_robot_are_consistent_in_their_chart_only() -> None:
    """The front end smooths; exit headings are uncertain by some 7°."""
    config = ChartConfig(odometry=(0.1, 0.1, 3.0), seconds=120.0)
    rows = [
        {"world": "w", "algorithm": m.algorithm, "quantity": m.quantity, "value": m.value, "submap": m.submap}
        for seed in range(4)
        for m in run_trial(config, seed)
    ]
    (row,) = local_table(pd.DataFrame(rows)).to_dict("records")
    assert row["exit_sigma"] > 4.0
    assert 0.9 < row["group"] < 1.1
    assert row["plain"] > 2.0
