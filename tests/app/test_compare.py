"""The compare table: every method in a row, the figures of the JSON, and refusals."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from graphslam.app import compare as comparing
from graphslam.app.compare import (
    DEFAULT_METHODS,
    JSON_COLUMNS,
    compare_methods,
    comparison_rows,
    join_json,
    map_nees,
    methods_json,
)
from graphslam.app.memory import MemoryProbe
from graphslam.core.errors import ConfigError, DataError, UnknownNameError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import wrap_angle
from graphslam.core.jit import compile_seconds
from graphslam.core.map_truth import MapTruth
from graphslam.join.association import MapAssociationConfig
from graphslam.join.registry import compile_method, join_by_method
from graphslam.plots.comparison import AFTER, BEFORE, comparison_figure
from tests.reference.submap_chain import submap_chain


def test_one_row_per_method_and_one_optimum(rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng)
    table = compare_methods(submaps, truth=truth, memory=False)
    assert list(table["method"]) == list(DEFAULT_METHODS)
    np.testing.assert_allclose(table["objective_polished"], table["objective_polished"][1], rtol=1e-7)
    assert (table["objective"] >= table["objective_polished"] * (1 - 1e-7)).all()
    assert (table["seconds"] > 0).all()
    assert table["states"].nunique() == table["landmarks"].nunique() == 1
    np.testing.assert_allclose(table["nees"], table["nees"][1], rtol=1e-4)  # polished maps are one map
    assert (table["nees_dof"] == table["states"]).all()
    np.testing.assert_allclose(table["ci"], table["nees"] / chi2_quantile(0.95, table["nees_dof"][0]))
    # eif-sequential and ekf share their unpolished map; the tree's differs
    own = table.set_index("method")["nees_unpolished"]
    assert own["eif-sequential"] == pytest.approx(own["ekf"], rel=1e-4)
    assert own["eif-tree"] != pytest.approx(own["ekf"], rel=1e-9)


def test_json_is_what_the_command_line_promises(rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng, submaps=5)
    found = methods_json(compare_methods(submaps, ["eif-tree", "batch"], polish=False, memory=False))
    text = json.dumps(found, allow_nan=False)
    rows = json.loads(text)["methods"]
    assert [tuple(r) for r in rows] == [(*JSON_COLUMNS, "before", "after")] * 2
    assert rows[0]["objective_polished"] is None
    assert rows[1]["objective_polished"] == rows[1]["objective"]
    assert rows[0]["nees"] is rows[0]["nees_dof"] is rows[0]["ci"] is rows[0]["peak_mb"] is None
    one = join_json(submaps, "ekf", join_by_method(submaps, "ekf"), truth=truth)["methods"][0]
    assert tuple(one) == (*JSON_COLUMNS, "before", "after")
    assert isinstance(one["nees_dof"], int)


def test_figures_before_and_after_refinement_stand_side_by_side(rng: np.random.Generator) -> None:
    """For all five methods; the filters' own figures are not those of the optimum."""
    submaps, truth = submap_chain(rng, submaps=8)
    found = compare_methods(submaps, truth=truth, memory=False)
    rows = methods_json(found)["methods"]
    shown = {r["method"]: r for r in comparison_rows(rows)}
    assert list(shown) == list(DEFAULT_METHODS)
    for r in rows:
        line, n = shown[r["method"]], r["nees_dof"]
        assert (line["objective before"], line["objective after"]) == (r["objective"], r["objective_polished"])
        assert (line["NEES/n before"], line["NEES/n after"]) == (r["nees_unpolished"] / n, r["nees"] / n)
        assert (line["CI before"], line["CI after"]) == (r["ci_unpolished"], r["ci"])
    assert shown["eif-tree"]["NEES/n before"] != pytest.approx(shown["eif-tree"]["NEES/n after"], rel=1e-9)
    assert shown["batch"]["NEES/n before"] == pytest.approx(shown["batch"]["NEES/n after"], rel=1e-4)
    alone = methods_json(compare_methods(submaps, ["eif-tree"], truth=truth, polish=False, memory=False))["methods"]
    (own,) = comparison_rows(alone)
    assert own["NEES/n before"] == pytest.approx(shown["eif-tree"]["NEES/n before"])
    assert (own["NEES/n after"], own["objective after"], own["CI after"]) == (None, None, None)
    unknown = comparison_rows(methods_json(compare_methods(submaps, ["ekf"], memory=False))["methods"])
    assert not [k for k in unknown[0] if "NEES" in k]
    ax = comparison_figure(found)
    assert [a.get_xlabel()[:6] for a in ax.figure.axes] == ["χ² abo", "NEES/n", "consis"]
    drawn = ax.figure.axes[1].collections
    assert [c.get_label() for c in drawn if c.get_label() in (BEFORE, AFTER)] == [BEFORE, AFTER]
    np.testing.assert_allclose(drawn[-2].get_offsets()[:, 0], [r["NEES/n before"] for r in shown.values()])


def test_nees_is_eq_18(rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng)
    best = join_by_method(submaps, "batch")
    at = {int(j): p for j, p in zip(truth.landmark_ids, truth.landmarks)}
    e = best.poses[1:] - truth.exit_poses
    e[:, 2] = wrap_angle(e[:, 2])
    error = np.concatenate([e.ravel(), *(p - at[int(j)] for j, p in zip(best.landmark_ids, best.landmarks))])
    expected = error @ np.linalg.solve(best.joint_covariance(), error)
    keys = [s.key for s in submaps]
    assert map_nees(best, keys, truth) == (pytest.approx(expected, rel=1e-6), best.states)
    # with part of the truth, the marginal is judged
    some = MapTruth(
        keys=truth.keys[3:7], exit_poses=truth.exit_poses[3:7], landmark_ids=truth.landmark_ids[:4],
        landmarks=truth.landmarks[:4],
    )  # fmt: skip
    value, dof = map_nees(best, keys, some)
    ix = np.concatenate([np.arange(9, 21), *(best.landmark_indices(int(j)) for j in some.landmark_ids)])
    P = best.joint_covariance()[np.ix_(ix, ix)]
    assert dof == 20
    assert value == pytest.approx(error[ix] @ np.linalg.solve(P, error[ix]), rel=1e-6)
    nobody = MapTruth(
        keys=np.array([99]), exit_poses=np.zeros((1, 3)), landmark_ids=np.array([-7]), landmarks=np.zeros((1, 2))
    )
    with pytest.raises(DataError, match="has ground truth"):
        map_nees(best, keys, nobody)


def test_association_gives_all_methods_the_same_landmarks(rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng, submaps=14, landmarks=50)
    lost = [s.with_ids(np.full(len(s.landmarks), -1)) for s in submaps]
    options = MapAssociationConfig(rule="joint", sensor_range=14.0)
    table = compare_methods(lost, ["batch", "eif-tree"], truth=truth, associate=options, memory=False)
    assert table["landmarks"].nunique() == 1
    np.testing.assert_allclose(table["objective_polished"], table["objective_polished"][0], rtol=1e-8)
    assert (table["nees_dof"] == 3 * 14).all()  # recognised landmarks have no names the truth knows
    assert 0.2 < table["nees"][0] / 42 < 3.0
    with pytest.raises(DataError, match="identity"):
        join_by_method(lost, "eif-tree")


def test_covariance_scale_reaches_every_method(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=6)
    for method in DEFAULT_METHODS:
        plain, wide = join_by_method(submaps, method), join_by_method(submaps, method, covariance_scale=4.0)
        if method in ("batch", "ekf"):
            assert wide.objective == pytest.approx(plain.objective / 4.0, rel=1e-2)
        P, Q = plain.pose_covariance(6), wide.pose_covariance(6)
        np.testing.assert_allclose(Q, 4.0 * P, rtol=0.05, atol=0.02 * np.abs(Q).max())


def test_unknown_names_are_refused_with_those_known(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=2)
    with pytest.raises(UnknownNameError, match=r"'eif'.*eif-sequential"):
        join_by_method(submaps, "eif")
    with pytest.raises(UnknownNameError, match="'magic'"):
        compare_methods(submaps, ["batch", "magic"])
    with pytest.raises(ConfigError, match="association"):
        join_by_method(submaps, "eif-tree", associate="guess")
    with pytest.raises(DataError, match="no submaps"):
        compare_methods([], ["batch"], memory=False)


def test_peak_memory_grows_with_what_is_joined(rng: np.random.Generator) -> None:
    """The dense filter's covariance must show: at 1,500 scalars it is 18 MB, and its work space as much again."""
    submaps, _ = submap_chain(rng, submaps=40, landmarks=700, radius=100.0, reach=14.0)
    states = join_by_method(submaps, "eif-tree").states
    assert states > 1400
    with MemoryProbe(submaps) as probe:
        dense, sparse, unknown = probe.measure(["ekf", "isam2", "magic"], polish=False)
    assert dense is not None
    assert sparse is not None
    assert sparse < dense
    assert unknown is None
    assert 8e-6 * states**2 < dense < 12 * 8e-6 * states**2
    with MemoryProbe(None) as probe:
        assert probe.measure(["ekf"], polish=False) == [None]


def test_a_method_is_compiled_before_it_is_timed(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every kernel of the timed join was used in the join of the first submaps."""
    submaps, _ = submap_chain(rng)
    compiled: list[str] = []

    def record(submaps: object, method: str, *, polish: bool) -> None:
        compiled.append(method)
        compile_method(submaps, method, polish=polish)  # type: ignore[arg-type]

    monkeypatch.setattr(comparing, "compile_method", record)
    for method in DEFAULT_METHODS:
        table = compare_methods(submaps, [method], memory=False)
        assert compiled[-1] == method
        before = compile_seconds()
        compare_methods(submaps, [method], memory=False)
        assert compile_seconds() == before
        assert table["seconds"][0] < 5.0
    compile_method(submaps[:1], "eif-tree")  # what one submap lacks is for the join itself to say
    compile_method([], "eif-tree")


def test_the_table_is_a_frame(rng: np.random.Generator) -> None:
    submaps, _ = submap_chain(rng, submaps=3)
    table = compare_methods(submaps, ["batch"], memory=False)
    assert isinstance(table, pd.DataFrame)
    assert {"rmse_poses", "rmse_landmarks", "iterations", "converged", "nees_unpolished"} <= set(table.columns)
