"""The study ``segmap-graph``: trials in the small world, figures against what is made by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.core import se3
from graphslam.core.errors import UnknownNameError
from graphslam.loops.measure import Loop
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study
from graphslam_studies.segmap_graph import STUDY, decision_table, gain_table, nees_table
from graphslam_studies.segmap_trial import GraphTrial, is_right


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    rows = [
        ("court-quick", run, m.algorithm, m.submap, m.quantity, m.value)
        for run in range(2)
        for m in STUDY.trial("court-quick", True)(run + 1)
        if not m.timing
    ]
    return pd.DataFrame(rows, columns=["world", "run", "algorithm", "submap", "quantity", "value"])


def value(table: pd.DataFrame, run: int, algorithm: str, quantity: str) -> float:
    rows = table[(table["run"] == run) & (table["algorithm"] == algorithm) & (table["quantity"] == quantity)]
    assert len(rows) == 1, (algorithm, quantity, len(rows))
    return float(rows["value"].iloc[0])


def test_it_is_a_study() -> None:
    assert isinstance(STUDY, StudyDefinition)
    assert find_study("segmap-graph") is STUDY
    assert STUDY.worlds(False) == ("garage-B", "garage-D", "mine", "building")
    with pytest.raises(UnknownNameError, match="segmap-graph"):
        STUDY.trial("moon", False)


def test_nothing_fails_and_the_graph_is_better_than_its_chain(table: pd.DataFrame) -> None:
    failed = table[table["quantity"] == "failed"]
    graphs = {"chain", "matches", "overlaps", "loops", "gps", "clearest"}
    assert set(failed["algorithm"]) == {"rbpf-5", "segslam-5"} | graphs
    assert not failed["value"].any()
    closed = [run for run in range(2) if value(table, run, "loops", "loops_taken") > 0]
    assert closed  # in one of them at least the loop of the court is found
    for run in closed:
        assert value(table, run, "loops", "ate_aligned") < 0.7 * value(table, run, "chain", "ate_aligned")
        assert value(table, run, "loops", "entropy_min") < value(table, run, "chain", "entropy_min")
        assert value(table, run, "clearest", "entropy_min") <= value(table, run, "loops", "entropy_min")
    for run in range(2):
        assert value(table, run, "chain", "chi2_per_dof") < 1e-6  # nothing contradicts a chain
        assert value(table, run, "loops", "loops_taken_right") == value(table, run, "loops", "loops_taken")
        assert value(table, run, "segslam-5", "ate_best_sample") <= value(table, run, "segslam-5", "ate_mean_sample")


def test_nodes_are_as_far_off_as_their_covariances_say() -> None:
    """With the truth moved by what a covariance draws, NEES is that of the draws."""
    config = STUDY.quick["court-quick"]
    trial = GraphTrial(config.grid, 1, graph=config)
    result = trial.outcome("segslam-5").result
    assert result is not None
    built = trial.build(trial.submaps(result), "chain")  # type: ignore[arg-type]
    path = built.solution.trajectory()
    base = np.array(trial.truth[0])
    trial.truth = se3.se3_compose(base[None], path.interpolate(trial.steps.times))
    level_base = trial.node_nees(result, built)  # type: ignore[arg-type]
    # the path itself, hung on the true first body: off by nothing but how that stands against its levelled base
    assert max(float(v.max()) for k, v in level_base.items() if k != "level") < 2.0
    shifted = np.array(trial.truth)
    shifted[:, 0] += 5.0
    trial.truth = np.concatenate([trial.truth[:1], shifted[1:]])
    assert float(trial.node_nees(result, built)["position"].mean()) > 20.0  # type: ignore[arg-type]


def test_right_loops() -> None:
    rng = np.random.default_rng(0)
    truth = se3.se3_exp(rng.normal(size=(2, 6)))
    T = se3.se3_between(truth[0], truth[1])

    def loop(error: list[float]) -> Loop:
        return Loop(
            i=0, j=1, T_ij=se3.se3_compose(T, se3.se3_exp(np.array(error))), covariance=np.eye(6), source="proximity"
        )

    assert is_right(loop([0.0] * 6), truth)
    assert is_right(loop([0.3, 0.0, 0.05, 0.4, 0.4, 0.1]), truth)  # tilt is no error of a loop
    assert not is_right(loop([0.0, 0.0, 0.0, 0.9, 0.0, 0.0]), truth)
    assert not is_right(loop([0.0, 0.0, 0.15, 0.0, 0.0, 0.0]), truth)


def test_tables(table: pd.DataFrame) -> None:
    gains = gain_table(table).iloc[0]
    assert gains["runs"] == 2
    ours = [value(table, run, "loops", "ate_aligned") for run in range(2)]
    assert gains["ate"] == pytest.approx(np.mean(ours))
    nees = nees_table(table)
    assert set(nees["block"]) == {"position", "heading", "pose", "level"}
    assert (nees["honest_low"] < 1.0).all()
    assert (nees["honest_high"] > 1.0).all()
    decisions = decision_table(table).set_index("algorithm")
    assert decisions.loc["loops", "taken"] == sum(value(table, run, "loops", "loops_taken") for run in range(2))
    assert 0.0 <= decisions.loc["loops", "recall"] <= 1.0


def test_figures(table: pd.DataFrame, tmp_path) -> None:  # type: ignore[no-untyped-def]
    timings = table.iloc[:0]
    assert set(STUDY.report(table, timings)) == {"paths", "gains", "nees", "loops"}
    assert [p.name for p in STUDY.figures(table, timings, tmp_path)] == ["ate_aligned.png", "entropy_min.png"]
