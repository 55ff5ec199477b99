"""The gap to the optimum: of every method along the sequence, of every join up the tree, of every polish step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.errors import DataError, UnknownNameError
from graphslam.core.geometry import wrap_angle
from graphslam.join.ekf import join_ekf
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_blocks import relabel
from graphslam.join.submap_isam2 import solve_submaps_isam2
from graphslam.join.submap_solver import solve_submaps
from graphslam_studies.evaluate.gap import (
    METHODS,
    gap_along,
    gap_by_tree,
    objectives_along,
    polish_history,
    pose_consistency_along,
)
from tests.reference.submap_chain import submap_chain


@pytest.fixture
def submaps():
    """A chain whose headings move so far that ``eif-online`` relinearises."""
    return submap_chain(np.random.default_rng(1), submaps=7)[0]


def test_optimum_along_is_the_batch_optimum_of_every_prefix(submaps) -> None:
    along = objectives_along(submaps, "optimum")
    batch = [solve_submaps(submaps[: k + 1]).objective for k in range(len(submaps))]
    np.testing.assert_allclose(along, batch, rtol=1e-8, atol=1e-9)


def test_gap_along_ends_where_the_methods_end(submaps) -> None:
    table = gap_along(submaps, [m for m in METHODS if m != "optimum"])
    last = table[table["submap"] == submaps[-1].key].set_index("method")
    ends = {
        "eif-sequential": join_sequential(submaps).objective,
        "ekf": join_ekf(submaps).objective,
        "isam2": solve_submaps_isam2(submaps, polish=False).objective,
    }
    for method, objective in ends.items():
        assert last.loc[method, "objective"] == pytest.approx(objective, rel=1e-8), method
    assert (table["gap"] >= -1e-7).all()
    assert last.loc["eif-sequential", "gap"] > 1e-3  # linearised once: above the optimum
    assert last.loc["eif-online", "gap"] < last.loc["eif-sequential", "gap"]
    for k in (2, 4):  # a prefix is a map of its own
        row = table[(table["method"] == "eif-sequential") & (table["submap"] == submaps[k].key)]
        assert row["objective"].item() == pytest.approx(join_sequential(submaps[: k + 1]).objective, rel=1e-8)


def test_tree_nodes_and_what_each_join_adds(submaps) -> None:
    table = gap_by_tree(submaps)
    assert table[["level", "first", "last"]].to_numpy().tolist() == [
        [1, 0, 1], [1, 2, 3], [1, 4, 5], [2, 0, 3], [2, 4, 6], [3, 0, 6],
    ]  # fmt: skip
    root = table.iloc[-1]
    assert root["objective"] == pytest.approx(join_tree(submaps).objective, rel=1e-8)
    assert root["optimum"] == pytest.approx(solve_submaps(submaps).objective, rel=1e-8)
    assert table["own"].sum() == pytest.approx(root["gap"], rel=1e-9)  # every join once
    assert len(gap_by_tree(submaps[:1])) == 0
    assert gap_by_tree(submaps[:2])[["level", "first", "last"]].to_numpy().tolist() == [[1, 0, 1]]


def test_polish_history_goes_down_to_the_optimum(submaps) -> None:
    joined = join_tree(submaps)
    history = polish_history(submaps, joined)
    best = solve_submaps(submaps).objective
    assert history[0] == pytest.approx(joined.objective, rel=1e-9)
    assert history[-1] == pytest.approx(best, rel=1e-9)
    assert np.all(np.diff(history) <= 1e-9 * best)
    assert polish_history(submaps)[0] > history[0]  # the chain is the poorer start


def test_pose_consistency_along_is_eq_18_of_every_prefix(rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng, submaps=6)
    found = pose_consistency_along(submaps, truth)
    for method, make in (("eif-sequential", join_sequential), ("optimum", solve_submaps)):
        for k in (0, 3, 5):
            one = make(submaps[: k + 1])
            e = truth.exit_poses[k] - one.poses[-1]
            e[2] = wrap_angle(e[2])
            expected = e @ np.linalg.solve(one.pose_covariance(k + 1), e)
            assert found[method].nees[0, k] == pytest.approx(expected, rel=1e-6)
    with pytest.raises(DataError, match="not in the ground truth"):
        pose_consistency_along(submaps, replace(truth, keys=truth.keys + 100))
    with pytest.raises(UnknownNameError, match="isam2"):
        pose_consistency_along(submaps, truth, ["isam2"])


def test_refusals(submaps) -> None:
    with pytest.raises(UnknownNameError, match="eif-tree"):
        objectives_along(submaps, "eif-tree")
    nameless = relabel(submaps, [np.full(len(s.landmarks), -1) for s in submaps])
    with pytest.raises(DataError):
        gap_by_tree(nameless)
