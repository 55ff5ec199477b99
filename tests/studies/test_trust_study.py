"""The study of words without truth: its worlds, its scoring, and its table."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pandas as pd
import pytest

from graphslam.core.geometry import se2_between
from graphslam.core.random import SeedTree
from graphslam_studies.trust import (
    FULL,
    QUICK,
    WORDS,
    ScanWorld,
    confusion_table,
    consistency,
    run_trial,
    summary_table,
    world_table,
)
from graphslam_studies.trust_faults import FAULTS, fault_worlds
from graphslam_studies.trust_worlds import TrustWorld, correlated, draw_world, world_log


def test_worlds_are_drawn_alike_again_and_half_of_them_are_clean():
    assert draw_world(7) == draw_world(7) != draw_world(8)
    drawn = [w for w in FULL.values() if isinstance(w, TrustWorld)]
    assert sum(w.clean for w in drawn) == len(drawn) // 2 >= 25
    assert {w.kind for w in FULL.values() if isinstance(w, ScanWorld)} == {"park", "laser", "garage", "lidar"}
    assert {w.gps for w in drawn} == {"none", "white", "rtk", "correlated", "correlated-white", "multipath"}
    assert {w.front_end for w in drawn} == {"rbpf-ekf", "ekf"}
    assert all(w.wrong != "nothing" for k, w in enumerate(drawn) if k % 2)


def test_a_log_states_what_its_data_sheets_say_and_not_what_is_true():
    """Noise, wheels, tails and fixes of a world, measured against its truth."""
    w = TrustWorld(understated=2.0, scale=1.03, gps="white", gps_sigma=0.7)
    log = world_log(w, SeedTree(1))
    path = log.truth.trajectory
    u = log["odometry"]
    off = u.increments[1:] - se2_between(path.poses[:-1], path.poses[1:])
    stated = np.sqrt(np.diag(u.covariances[5]))
    assert np.std(off[:, 2]) == pytest.approx(2.0 * stated[2], rel=0.1)
    assert np.mean(off[:, 0]) == pytest.approx(0.03 * 0.2, rel=0.4)  # 3 % of 2 m/s in a tenth of a second
    assert np.array_equal(stated, [0.02, 0.01, np.deg2rad(0.3)])
    gps = log["gps"]
    assert np.all(gps.sigma == 0.7)
    lasts = correlated(np.random.default_rng(0), 20000, 1.0, 10.0, 2)
    assert np.std(lasts) == pytest.approx(1.0, abs=0.05)
    assert np.mean(lasts[1:] * lasts[:-1]) == pytest.approx(np.exp(-0.1), abs=0.05)


def test_every_fault_changes_a_log_of_a_clean_world_and_keeps_its_truth():
    worlds = fault_worlds()
    assert {w.wrong for w in worlds.values()} == set(FAULTS)
    for w in worlds.values():
        clean, log = world_log(w.world, SeedTree(3)), w.log(3)
        assert w.world.clean
        assert not w.clean
        assert np.array_equal(log.truth.trajectory.poses, clean.truth.trajectory.poses)
        changed = [k for k in clean.streams if _digest(log[k]) != _digest(clean[k])]
        part = w.wrong.split(":")[0]
        known = {"GPS": ["gps"], "odometry": ["odometry"], "landmarks": ["landmarks"]}
        assert changed == known.get(part, ["odometry", "landmarks"]), w.wrong


def _digest(stream) -> list[bytes]:
    return [
        np.asarray(getattr(stream, f.name)).tobytes() for f in fields(stream) if f.name not in ("noise", "geometry")
    ]


def test_the_confusion_table_sets_truth_against_words():
    known = {"a": FULL["world-800"], "b": FULL["fault-00"], "c": FULL["fault-01"]}
    figures = {"a": (1.0, 0), "b": (2.5, 0), "c": (50.0, 4)}
    rows = []
    for world, (nees, verdict) in figures.items():
        values = {"node": nees, "node_dof": 40.0, "joint": nees, "joint_dof": 60.0, "verdict": float(verdict)}
        rows += [
            {"world": world, "run": 0, "algorithm": "run", "submap": -1, "quantity": q, "value": v}
            for q, v in values.items()
        ]
    rows.append({"world": "d", "run": 0, "algorithm": "run", "submap": -1, "quantity": "verdict", "value": 5.0})
    known["d"] = FULL["fault-02"]
    worlds = world_table(pd.DataFrame(rows), known)
    assert worlds["true"].tolist() == ["consistent", "overconfident", "wrong", "refused"]
    table = confusion_table(worlds, known).set_index(["worlds", "true"])
    assert table.loc[("clean", "consistent"), "consistent"] == 1
    assert table.loc[("fault", "overconfident"), "consistent"] == 1
    assert table.loc[("fault", "wrong"), "wrong"] == table.loc[("fault", "refused"), "refused"] == 1


def test_consistency_of_errors_that_are_as_stated(rng):
    A = rng.standard_normal((30, 30))
    P = A @ A.T + 0.1 * np.eye(30)
    L = np.linalg.cholesky(P)
    found = [consistency((L @ rng.standard_normal(30)).reshape(10, 3), P) for _ in range(400)]
    assert np.mean([f["joint"] for f in found]) == pytest.approx(1.0, abs=0.05)
    assert np.mean([f["node"] for f in found]) == pytest.approx(1.0, abs=0.05)
    # the mean over correlated nodes varies as χ² of the dof that are told
    assert np.var([f["node"] for f in found]) == pytest.approx(2.0 / found[0]["node_dof"], rel=0.3)
    wide = consistency(2.0 * (L @ rng.standard_normal(30)).reshape(10, 3), P)
    assert wide["joint"] > 2.0


@pytest.mark.parametrize("world", list(QUICK))
def test_quick_worlds_are_mapped_with_default_options(world):
    rows = {m.quantity: m.value for m in run_trial(QUICK[world], 5)}
    assert rows["clean"] == float(QUICK[world].clean)
    assert rows["verdict"] in (0.0, 3.0)  # noise that is stated wrongly is estimated from the log
    assert 0.2 < rows["joint"] < 2.5  # 15 degrees of freedom or so


@pytest.mark.parametrize("kind", ["park", "laser"])
def test_worlds_with_scans_are_mapped_as_a_newcomer_would(kind):
    rows = {m.quantity: m.value for m in run_trial(ScanWorld(kind=kind, number=3), 5)}
    assert WORDS[int(rows["verdict"])] in ("consistent", "not tested")
    assert rows["rms"] < 0.5
    assert 0.1 < rows["joint"] < 2.0


def test_the_table_counts_what_must_not_happen():
    rows = []
    for world, node, verdict in (
        ("quick-04", 1.0, 0),
        ("quick-22", 0.9, 1),
        ("quick-31", 4.0, 2),
        ("quick-09", 1.1, 3),
    ):
        for trial in range(3):
            figures = {"node": node, "node_dof": 40.0, "joint": node, "joint_dof": 60.0, "verdict": float(verdict)}
            rows += [
                {"world": world, "run": trial, "algorithm": "run", "submap": -1, "quantity": q, "value": v}
                for q, v in figures.items()
            ]
    worlds = world_table(pd.DataFrame(rows), QUICK)
    assert worlds.set_index("world")["bad map"].to_dict() == {
        "quick-04": False, "quick-22": False, "quick-31": True, "quick-09": False,
    }  # fmt: skip
    table = summary_table(worlds).set_index("worlds are")
    assert table.loc["NEES/n > 1.5", "points the wrong way"] == 1.0  # it was called conservative
    assert table.loc["clean", "points the wrong way"] == 0.5  # overconfident
    assert table.loc["other", "not tested"] == 3
