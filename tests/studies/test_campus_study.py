"""The study of the campus: pairs that differ in the fixes alone, the corridor's angle, and tables that can say no."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from graphslam.backend.config import GpsOptions
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.scan_window.front_end import ScanWindow
from graphslam_studies.campus import MOVING, QUICK_WORLDS, SESSIONS, STUDY, mean_table, nees_table, pair_table
from graphslam_studies.campus_moving import moving_figures
from graphslam_studies.campus_sessions import seam, start_of
from graphslam_studies.campus_trial import BLOCKS, KINDS, PAIRS, angle_errors, campus_figures, submap_lift
from graphslam_studies.montecarlo.definition import find_study
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.campus import simulate_campus


@pytest.fixture(scope="module")
def run() -> dict[tuple[str, str], float]:
    """One run with fixes that are nearly exact: what they bring cannot be missed."""
    config = QUICK_WORLDS["quick"]
    sharp = {"code_sigma": (0.02, 0.02), "orbit_sigma": (0.01, 0.01), "reflect_sigma": (1e-3, 1e-3)}
    campus = replace(config.campus, **sharp, hidden_share=(1e-6, 1e-6))
    rows = list(campus_figures(replace(config, campus=campus, gps=GpsOptions(use="all", every=20.0)), 3))
    return {(m.algorithm, m.quantity): m.value for m in rows}


def test_sharp_fixes_outside_straighten_the_inside(run: dict[tuple[str, str], float]) -> None:
    assert run["joint", "fixes"] > 40
    for quantity in ("ate", "ate_outdoor", "ate_indoor", "ate_indoor_anchored", "end_error"):
        assert run["joint-white", quantity] < 0.7 * run["alone", quantity]
    assert run["joint-white", "ate"] < run["joint", "ate"] < run["alone", "ate"]
    assert 0 < run["joint-white", "ate"] < 0.2
    assert run["odometry-fixes", "ate"] < run["odometry", "ate"]
    for kind in PAIRS:  # sharp fixes say where in the campus that is, without any alignment
        assert 0.5 * run[kind, "ate_indoor"] < run[kind, "ate_indoor_world"] < 0.2
    assert ("alone", "ate_indoor_world") not in run
    for kind in KINDS:
        assert run[kind, "angle_error"] < 1.0
        assert run[kind, "failed"] == 0.0
        assert {f"nees_{b}_indoor" for b in BLOCKS} <= {q for k, q in run if k == kind}
    assert run["odometry", "scans_lost"] < 0.4


def test_the_angle_between_two_legs() -> None:
    """A corridor whose second leg is bent by 2°, driven there and back."""
    out = np.linspace(0.0, 20.0, 41)
    first, second = np.column_stack([out, 0 * out]), np.column_stack([np.full(41, 20.0), out])
    plan = np.concatenate([first, second, second[::-1], first[::-1]])
    times = np.arange(len(plan)) * 0.5
    legs = [[[0.0, 20.0], [61.5, 82.0]], [[20.5, 40.5], [41.0, 61.0]]]
    true = np.tile(SE3.identity, (len(plan), 1))
    true[:, :2] = plan
    turn = np.deg2rad(2.0)
    bent = true.copy()
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    on_second = (times > 20.2) & (times < 61.2)
    bent[on_second, :2] = (plan[on_second] - [20.0, 0.0]) @ R.T + [20.0, 0.0]
    np.testing.assert_allclose(np.rad2deg(angle_errors(legs, Trajectory(times, bent), true)), [2.0, 2.0], atol=1e-9)
    bent[:, :2] = bent[:, :2] @ R.T + [5.0, 7.0]  # where the building lies is no matter of its angle
    np.testing.assert_allclose(np.rad2deg(angle_errors(legs, Trajectory(times, bent), true)), [2.0, 2.0], atol=1e-9)
    assert angle_errors(legs, Trajectory(times, true), true) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert angle_errors([[], [[0.0, 20.0]]], Trajectory(times, true), true) == []


def rows_of(pairs: list[tuple[float, float]], quantity: str = "ate_indoor") -> pd.DataFrame:
    out = []
    for run, (alone, joint) in enumerate(pairs):
        for kind, value in (("alone", alone), ("joint", joint)):
            m = Measurement(kind, quantity, value)
            out.append(("w", run, m.algorithm, m.submap, m.quantity, m.value))
    return pd.DataFrame(out, columns=["world", "run", "algorithm", "submap", "quantity", "value"])


def test_pairs_are_reported_with_a_sign_test() -> None:
    row = pair_table(rows_of([(1.0, 0.4)] * 9 + [(1.0, 1.2)])).iloc[0]
    assert (row["runs"], row["better"], row["half"]) == (10, 9, 0.9)
    assert row["p"] == pytest.approx(2 * 11 / 2**10)
    assert row["ratio"] == pytest.approx(0.48)
    worse = pair_table(rows_of([(1.0, 2.0)] * 8)).iloc[0]
    assert (worse["better"], worse["median_ratio"]) == (0, 2.0)
    assert worse["p"] < 0.01  # as sure, the other way


def test_nees_has_bounds_on_both_sides() -> None:
    t = pd.concat([rows_of([(1.0, 1.0)] * 20, f"nees_plan_{p}") for p in ("middle", "indoor", "end")])
    t = nees_table(t)
    row = t[(t["graph"] == "joint") & (t["block"] == "plan")].iloc[0]
    assert 0.5 < row["low"] < 1.0 < row["high"] < 1.6
    assert row["indoor"] == 1.0


def test_it_is_found_by_its_name() -> None:
    assert find_study("campus") is STUDY
    assert STUDY.worlds(quick=True) == ("quick",)
    assert STUDY.worlds(quick=False) == ("blocks", "block", "whole", "sessions", "moving")
    assert STUDY.trial("sessions", False).args == (SESSIONS["sessions"],)
    assert STUDY.default_trials(quick=False) == 20


def test_a_seam_is_held_against_the_covariance_that_is_stated() -> None:
    """0.3 m off along x, stated with σ of 0.1 m there: 9 of χ² over six numbers; four times that is beyond 3 σ."""
    covariance = np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.04])
    true = SE3.exp(np.array([0.0, 0.0, 0.5, 10.0, 4.0, 0.1]))

    def told(off: float) -> dict[str, float]:
        base = SE3.compose(true, SE3.exp(np.array([0.0, 0, 0, -off, 0, 0])))
        placed = SimpleNamespace(T_world_base=base, covariance=covariance)
        placed.attached = SimpleNamespace(used=[1, 2], dropped=1)
        return {m.quantity: m.value for m in seam(SimpleNamespace(sessions=[None, placed]), 1, "overlap", true)}

    near, far = told(0.3), told(0.6)
    assert near["seam_error"] == pytest.approx(0.3)
    assert near["seam_nees"] == pytest.approx(9.0 / 6.0)
    assert near["seam_sigma"] == pytest.approx(np.sqrt(0.06))
    assert (near["seam_within_3_sigma"], far["seam_within_3_sigma"]) == (1.0, 0.0)
    assert (near["links"], near["links_dropped"]) == (2.0, 1.0)
    rows = [("sessions", run, "overlap", -1, q, v) for run, d in enumerate((near, far)) for q, v in d.items()]
    table = mean_table(
        pd.DataFrame(rows, columns=["world", "run", "algorithm", "submap", "quantity", "value"]), SESSIONS
    )
    assert table["runs"].tolist() == [2]
    assert table["seam_within_3_sigma"].tolist() == [0.5]


def test_the_true_start_of_a_session_is_where_its_first_submap_begins(sessions: list[SensorLog]) -> None:
    """Level, at the first step's stamp, and the sessions in one world."""
    config = SESSIONS["sessions"]
    for log in sessions:
        start = start_of(log, config)
        submap = next(ScanWindow(config.front_end).submaps(log, seed=SeedTree(0)))
        at = log.truth.trajectory.interpolate(np.array([submap.interval[0]]))
        world = SE3.compose(np.asarray(log.meta["T_world_frame"]), at[0])
        np.testing.assert_allclose(start[:2], world[:2], atol=1e-9)
        assert start[2] == pytest.approx(world[2] - submap_lift(config.front_end.submap))
        np.testing.assert_allclose(start[3:5], 0.0, atol=1e-9)


def test_what_moves_leaves_the_map_and_the_rest_stays() -> None:
    rows = {(m.algorithm, m.quantity): m.value for m in moving_figures(MOVING["moving"], 1)}
    assert rows["evidence", "voxels_moving"] > 500
    assert rows["outvoted", "gone"] > max(rows["evidence", "gone"], 0.93)
    assert rows["outvoted", "lost"] < 0.012
    assert rows["evidence", "lost"] <= rows["outvoted", "lost"]


@pytest.fixture(scope="module")
def sessions() -> list[SensorLog]:
    small = replace(SESSIONS["sessions"].campus, every=15, every_beam=30)
    logs = [simulate_campus(replace(small, session=k, far=k == 2), 1) for k in (0, 2)]
    return [log.slice(0.0, 15.0) for log in logs]
