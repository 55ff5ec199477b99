"""Monte Carlo: repeatable trials, the same table from any executor, statistics by hand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam.evaluate.montecarlo import COLUMNS, Measurement, TrialError, run_trials, trial_seed
from graphslam.evaluate.tables import consistency_of, paired_ratio, summarise, values_of


def noisy_trial(seed: int) -> Iterator[Measurement]:
    """NEES of an honest and of an over-confident estimator at three submaps, and a final RMSE."""
    rng = np.random.default_rng(seed)
    for submap in range(3):
        d2 = rng.chisquare(3)
        yield Measurement("honest", "nees", d2, submap)
        yield Measurement("bold", "nees", 4 * d2, submap)
    e = rng.uniform(1, 2)
    yield Measurement("honest", "rmse", e)
    yield Measurement("bold", "rmse", 2 * e)


def failing_trial(seed: int) -> list[Measurement]:
    if seed == trial_seed(0, 2):
        raise ValueError("no convergence")
    return [Measurement("a", "q", 1.0)]


def table(rows: list[tuple]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=list(COLUMNS))


def test_table_is_tidy_and_in_order_of_trial() -> None:
    t = run_trials(noisy_trial, 4, progress=False)
    assert tuple(t.columns) == COLUMNS
    assert t["run"].tolist() == sorted(t["run"].tolist())
    assert len(t) == 4 * 8
    assert set(t.loc[t["quantity"] == "rmse", "submap"]) == {-1}


def test_processes_and_serial_give_the_same_table() -> None:
    serial = run_trials(noisy_trial, 5, seed=3, progress=False)
    spawned = run_trials(noisy_trial, 5, seed=3, executor="processes", workers=2, progress=False)
    pd.testing.assert_frame_equal(serial, spawned)


def test_any_trial_can_be_repeated_alone_and_seeds_differ() -> None:
    every = run_trials(noisy_trial, 6, seed=1, progress=False)
    alone = run_trials(noisy_trial, [4], seed=1, progress=False)
    pd.testing.assert_frame_equal(every[every["run"] == 4].reset_index(drop=True), alone)
    seeds = {trial_seed(s, k) for s in range(10) for k in range(100)}
    assert len(seeds) == 1000
    assert all(0 <= s < 2**63 for s in seeds)


@pytest.mark.parametrize("executor", ["serial", "processes"])
def test_a_failed_trial_says_which_and_with_which_seed(executor: str) -> None:
    with pytest.raises(TrialError, match=f"trial 2 .seed {trial_seed(0, 2)}.*no convergence"):
        run_trials(failing_trial, 4, executor=executor, workers=1, progress=False)  # type: ignore[arg-type]


def test_wrong_use_is_refused() -> None:
    with pytest.raises(ConfigError, match="listed twice"):
        run_trials(noisy_trial, [1, 1], progress=False)
    with pytest.raises(ConfigError, match="unknown executor"):
        run_trials(noisy_trial, 1, executor="threads", progress=False)  # type: ignore[arg-type]


def test_no_trials_give_an_empty_table() -> None:
    assert run_trials(noisy_trial, 0, progress=False).empty


def test_summary_by_hand() -> None:
    t = table([(0, "a", 1, "q", 1.0), (1, "a", 1, "q", 3.0), (2, "a", 1, "q", 8.0), (0, "b", 1, "q", 5.0)])
    row = summarise(t).set_index("algorithm").loc["a"]
    assert (row["mean"], row["median"], row["min"], row["max"], row["count"]) == (4.0, 3.0, 1.0, 8.0, 3)
    assert row["standard_error"] == pytest.approx(np.sqrt(13.0 / 3))


def test_consistency_from_the_table_has_the_right_verdicts() -> None:
    t = run_trials(noisy_trial, 60, progress=False)
    for name, verdict in (("honest", "consistent"), ("bold", "over-confident")):
        submaps, c = consistency_of(t, name, "nees", dof=3, gauge="first base fixed")
        assert submaps.tolist() == [0, 1, 2]
        assert c.nees.shape == (60, 3)
        assert c.verdict == verdict


def test_missing_figures_are_nan_and_doubles_are_refused() -> None:
    t = table([(0, "a", 0, "q", 1.0), (1, "a", 0, "q", 2.0), (1, "a", 1, "q", 3.0)])
    _, v = values_of(t, "a", "q")
    assert np.array_equal(v, [[1.0, np.nan], [2.0, 3.0]], equal_nan=True)
    with pytest.raises(DataError, match="stands twice"):
        values_of(pd.concat([t, t]), "a", "q")
    with pytest.raises(DataError, match="no 'x' of 'a'"):
        values_of(t, "a", "x")


def test_paired_ratio_by_hand() -> None:
    t = table(
        [(0, "a", -1, "e", 1.0), (0, "b", -1, "e", 2.0), (1, "a", -1, "e", 8.0), (1, "b", -1, "e", 4.0)]
        + [(2, "a", -1, "e", 1.0)]  # a run that only one of them finished
    )
    r = paired_ratio(t, "e", "a", "b")
    assert (r.mean, r.wins, r.runs) == (1.25, 1, 2)
    assert r.geometric_mean == pytest.approx(1.0)
    assert r.half_width == pytest.approx(1.96 * np.std([0.5, 2.0], ddof=1) / np.sqrt(2))
    with pytest.raises(DataError, match="no 'e' of 'c'"):
        paired_ratio(t, "e", "a", "c")
    with pytest.raises(DataError, match="too few"):
        paired_ratio(t[t["run"] == 0], "e", "a", "b")
    with pytest.raises(DataError, match="not positive"):
        paired_ratio(t.assign(value=-t["value"]), "e", "a", "b")


def test_pairing_sees_what_unpaired_means_cannot() -> None:
    r = paired_ratio(run_trials(noisy_trial, 10, progress=False), "rmse", "bold", "honest")
    assert r.mean == pytest.approx(2.0)
    assert r.half_width == pytest.approx(0.0, abs=1e-12)
    assert r.wins == 0
