"""Monte Carlo: repeatable trials, the same table from any executor, statistics by hand."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from graphslam.core.errors import ConfigError, DataError
from graphslam_studies.evaluate.tables import (
    consistency_of,
    consistency_table,
    coverage_table,
    paired_ratio,
    ratio_table,
    summarise,
    values_of,
)
from graphslam_studies.montecarlo.executors import Job, execute, hold_one_thread
from graphslam_studies.montecarlo.trials import (
    COLUMNS,
    Measurement,
    TrialError,
    check_measurements,
    run_trials,
    trial_seed,
)
from tests.reference.trials import dies_once, fails_once, gives_a_lambda, notes_its_process, steady


def noisy_trial(seed: int) -> Iterator[Measurement]:
    """NEES of a consistent and of an overconfident estimator at three submaps, and a final RMSE."""
    rng = np.random.default_rng(seed)
    for submap in range(3):
        d2 = rng.chisquare(3)
        yield Measurement("consistent", "nees", d2, submap)
        yield Measurement("bold", "nees", 4 * d2, submap)
    e = rng.uniform(1, 2)
    yield Measurement("consistent", "rmse", e)
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
    for name, verdict in (("consistent", "consistent"), ("bold", "overconfident")):
        submaps, c = consistency_of(t, name, "nees", dof=3, gauge="first base fixed")
        assert submaps.tolist() == [0, 1, 2]
        assert c.nees.shape == (60, 3)
        assert c.verdict == verdict


def test_missing_figures_are_nan_and_doubles_are_refused() -> None:
    t = table([(0, "a", 0, "q", 1.0), (1, "a", 0, "q", 2.0), (1, "a", 1, "q", 3.0)])
    _, v = values_of(t, "a", "q")
    assert np.array_equal(v, [[1.0, np.nan], [2.0, 3.0]], equal_nan=True)
    with pytest.raises(DataError, match="is repeated"):
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
    r = paired_ratio(run_trials(noisy_trial, 10, progress=False), "rmse", "bold", "consistent")
    assert r.mean == pytest.approx(2.0)
    assert r.half_width == pytest.approx(0.0, abs=1e-12)
    assert r.wins == 0


# --- executors ---------------------------------------------------------------------------------------------------


def test_timings_stay_out_of_the_table_and_can_be_asked_for() -> None:
    t = run_trials(steady, 3, progress=False)
    assert set(t["quantity"]) == {"q"}
    assert set(run_trials(steady, 3, timings=True, progress=False)["quantity"]) == {"seconds"}


def test_a_worker_that_dies_names_its_trial_and_the_others_finish(tmp_path: Path) -> None:
    jobs = [Job(f"t{k}", partial(dies_once, bad=3), k) for k in range(8)]
    found = {o.job.name: o for o in execute(jobs, executor="processes", workers=2)}
    assert len(found) == 8
    assert found["t3"].error == "its worker process died (signal 9)"
    assert all(o.error is None and len(o.values) == 2 for name, o in found.items() if name != "t3")


def test_a_trial_that_raises_is_an_outcome_with_its_traceback() -> None:
    for executor in ("serial", "processes"):
        jobs = [Job(f"t{k}", partial(fails_once, bad=1), k) for k in range(3)]
        found = {o.job.name: o for o in execute(jobs, executor=executor, workers=1)}  # type: ignore[arg-type]
        assert found["t1"].error == "ValueError: no convergence"
        assert "fails_once" in (found["t1"].details or "")
        assert found["t0"].error is found["t2"].error is None


def test_closing_ends_workers_in_the_middle_of_their_trials(tmp_path: Path) -> None:
    slow = partial(notes_its_process, folder=str(tmp_path), seconds=60.0)
    quick = partial(notes_its_process, folder=str(tmp_path))
    outcomes = execute([Job("quick", quick, 0), *(Job(f"t{k}", slow, k) for k in (1, 2))], executor="processes")
    next(outcomes)
    deadline = time.monotonic() + 30
    while len(list(tmp_path.iterdir())) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    pids = {int(p.name.split("-")[0]) for p in tmp_path.iterdir()}
    begin = time.monotonic()
    outcomes.close()
    assert time.monotonic() - begin < 5.0
    assert pids
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_workers_are_held_to_one_thread_and_share_the_work(tmp_path: Path) -> None:
    trial = partial(notes_its_process, folder=str(tmp_path), seconds=0.2)
    jobs = [Job(f"t{k}", trial, k) for k in range(6)]
    threads = [o.values[0].value for o in execute(jobs, executor="processes", workers=2, prepare=hold_one_thread)]
    assert threads == [1.0] * 6
    pids = [p.name.split("-")[0] for p in tmp_path.iterdir()]
    assert len(set(pids)) == 2
    assert str(os.getpid()) not in pids


def test_what_cannot_be_sent_to_a_worker_is_refused_at_once() -> None:
    with pytest.raises(ConfigError, match="wanted a function of a module"):
        run_trials(lambda seed: [], 2, executor="processes", progress=False)
    with pytest.raises(ConfigError, match="scheduler's address"):
        execute([], executor="dask")
    with pytest.raises(TrialError, match="cannot be sent back"):
        run_trials(gives_a_lambda, 1, executor="processes", workers=1, progress=False)


def test_nonsense_and_double_figures_are_failures() -> None:
    m = Measurement("a", "q", 1.0)
    assert check_measurements([m, Measurement("a", "q", 1.0, 0), Measurement("a", "q", 1.0, timing=True)]) is None
    assert "is repeated" in (check_measurements([m, m]) or "")
    assert "gave a float" in (check_measurements([1.0]) or "")


# --- tables ------------------------------------------------------------------------------------------------------


def study_table(rng: np.random.Generator, *, worlds: int = 2, runs: int = 40, scale: float = 1.0) -> pd.DataFrame:
    """``scale`` times consistent NEES of poses (3), and of joint maps whose dimension differs from run to run."""
    rows = []
    for w in range(worlds):
        for run in range(runs):
            n = int(rng.integers(10, 60))
            rows += [
                (f"w{w}", run, "a", -1, "pose_nees", scale * rng.chisquare(3)),
                (f"w{w}", run, "a", -1, "joint", scale * rng.chisquare(n)),
                (f"w{w}", run, "a", -1, "joint_dof", float(n)),
                (f"w{w}", run, "local", 0, "local_joint_nees", scale * rng.chisquare(n)),
                (f"w{w}", run, "local", 0, "local_joint_dof", float(n)),
                (f"w{w}", run, "local", 0, "local_pose_nees", scale * rng.chisquare(3)),
            ]
    return pd.DataFrame(rows, columns=["world", *COLUMNS])


@pytest.mark.parametrize(("scale", "verdict"), [(1.0, True), (2.5, False), (0.3, False)])
def test_consistency_table_tells_consistent_from_bold_and_from_timid(
    rng: np.random.Generator, scale: float, verdict: bool
) -> None:
    t = study_table(rng, scale=scale)
    for quantity, dof in (("pose_nees", 3), ("joint", "joint_dof")):
        found = consistency_table(t, quantity, dof=dof, confidence=0.999)
        assert found["world"].tolist() == ["w0", "w1"]
        assert found["inside"].tolist() == [verdict] * 2
        assert np.allclose(found["nees_over_n"], scale, rtol=0.4)
        assert ((found["ci_low"] < found["ci_consistent"]) & (found["ci_consistent"] < found["ci_high"])).all()


def test_bounds_of_the_consistency_table_hold_as_often_as_they_say(rng: np.random.Generator) -> None:
    t = study_table(rng, worlds=400, runs=5)
    for quantity, dof in (("pose_nees", 3), ("joint", "joint_dof")):
        share = consistency_table(t, quantity, dof=dof)["inside"].mean()
        assert 0.91 < share < 0.985
    local = coverage_table(t)
    assert 0.91 < np.mean((local["joint"] > local["joint_low"]) & (local["joint"] < local["joint_high"])) < 0.985
    assert 0.91 < np.mean((local["pose"] > local["pose_low"]) & (local["pose"] < local["pose_high"])) < 0.985


def test_consistency_table_by_hand() -> None:
    t = table([(k, "a", s, "pose_nees", v) for s in (0, 1) for k, v in enumerate((1.0, 3.0, np.nan))])
    found = consistency_table(t, "pose_nees", dof=3, submap=None)
    assert found["submap"].tolist() == [0, 1]
    row = found.iloc[0]
    assert (row["runs"], row["missing"]) == (2, 1)
    assert row["nees_over_n"] == pytest.approx(4.0 / 6.0)
    assert row["ci_mean"] == row["ci_median"] == pytest.approx(2.0 / 7.814727903251179)
    assert row["low"] == pytest.approx(1.2373442457912 / 6)  # 2.5 % quantile of χ²_6
    assert row["high"] == pytest.approx(14.4493753354 / 6)
    assert consistency_table(t.assign(value=np.inf), "pose_nees", dof=3, submap=0)["inside"].tolist() == [False]
    with pytest.raises(DataError, match="no 'n' beside it"):
        consistency_table(t, "pose_nees", dof="n", submap=0)
    # just above the upper bound: not inside, but near; two fifths above it: neither
    edge = table([(0, "a", -1, "q", 9.348 * 1.05), (0, "b", -1, "q", 9.348 * 1.4)])
    near = consistency_table(edge, "q", dof=3)
    assert near["inside"].tolist() == [False, False]
    assert near["near"].tolist() == [True, False]
    assert consistency_table(edge, "q", dof=3, algorithms=["b", "a"])["algorithm"].tolist() == ["b", "a"]


def test_ratios_of_each_world() -> None:
    rows = [(w, k, name, -1, "e", v * (k + 1)) for w in "AB" for k in range(3) for name, v in (("x", 1.0), ("y", 4.0))]
    t = pd.DataFrame([*rows, ("B", 9, "x", -1, "e", 1.0)], columns=["world", *COLUMNS])
    found = ratio_table(t, ["e", "absent"], [("x", "y"), ("y", "x"), ("x", "z")])
    assert found[["world", "a", "b"]].to_numpy().tolist() == [
        ["A", "x", "y"],
        ["A", "y", "x"],
        ["B", "x", "y"],
        ["B", "y", "x"],
    ]
    assert np.allclose(found["geometric_mean"], [0.25, 4.0, 0.25, 4.0])
    assert np.allclose(found["factor"], 1.0)
    assert found["wins"].tolist() == [3, 0, 3, 0]


def test_interval_of_a_geometric_mean_holds_as_often_as_it_says(rng: np.random.Generator) -> None:
    inside = 0
    for _ in range(300):
        logs = rng.normal(0.7, 1.0, 40)
        t = table([(k, "x", -1, "e", float(np.exp(v))) for k, v in enumerate(logs)])
        t = pd.concat([t, t.assign(algorithm="y", value=1.0)])
        r = paired_ratio(t, "e", "x", "y")
        inside += r.geometric_mean / r.factor < np.exp(0.7) < r.geometric_mean * r.factor
    assert 0.90 < inside / 300 < 0.985


@pytest.mark.parametrize(("scale", "consistent"), [(1.0, True), (1.3, False), (0.7, False)])
def test_coverage_of_local_maps(rng: np.random.Generator, scale: float, consistent: bool) -> None:
    t = study_table(rng, worlds=1, runs=400, scale=scale)
    (row,) = coverage_table(t, confidence=0.95).to_dict("records")
    assert row["maps"] == 400
    assert row["joint"] == pytest.approx(scale, rel=0.05)
    assert row["pose"] == pytest.approx(scale, rel=0.2)
    assert (row["inside_low"] - 0.01 <= row["inside"] <= row["inside_high"] + 0.01) == consistent
    with pytest.raises(DataError, match="no local maps"):
        coverage_table(t[t["algorithm"] == "a"])
