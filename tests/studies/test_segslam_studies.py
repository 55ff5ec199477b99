"""The studies of grid front ends: trials in the small world, figures against counts and truths made by hand."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from graphslam.app.run.front_ends import recommended_options
from graphslam.core.config import build_config
from graphslam.core.errors import ConfigError, DataError, UnknownNameError
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE2, SE3, heading_of, remove_roll_pitch
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.grid.filter_error_model import FilterDrift
from graphslam_frontends.segslam.front_end import SegSlamFrontEndConfig
from graphslam_frontends.segslam.result import SegSlamResult
from graphslam_studies import segslam_trial
from graphslam_studies.evaluate import segslam_judge as judge
from graphslam_studies.frontends.rbpf_grid import RbpfGridConfig, RbpfResult
from graphslam_studies.montecarlo.definition import StudyDefinition, find_study, fingerprint
from graphslam_studies.segslam_building import PARTICLES as MORE_BUILDING
from graphslam_studies.segslam_building import STUDY as BUILDING
from graphslam_studies.segslam_garage import STUDY as GARAGE
from graphslam_studies.segslam_mine import PARTICLES as MORE_MINE
from graphslam_studies.segslam_mine import STUDY as MINE
from graphslam_studies.segslam_trial import GridTrial, GridTrialConfig, drawn_algorithm, family_of, run_trial
from tests.pictures import full_pictures

STUDIES = {"segslam-garage": GARAGE, "segslam-mine": MINE, "segslam-building": BUILDING}


@pytest.fixture(autouse=True, scope="module")
def _full_pictures() -> Iterator[None]:
    with full_pictures():
        yield


@pytest.fixture(scope="module")
def tables() -> dict[str, tuple[pd.DataFrame, pd.DataFrame]]:
    """Tidy table and timings of the quick trials of each study: two runs of the first, one of the others."""
    out = {}
    for name, study in STUDIES.items():
        rows: tuple[list[tuple[object, ...]], list[tuple[object, ...]]] = ([], [])
        for world in study.worlds(True):
            for run in range(2 if study is GARAGE else 1):
                for m in study.trial(world, True)(run + 1):
                    rows[m.timing].append((world, run, m.algorithm, m.submap, m.quantity, m.value))
        names = ["world", "run", "algorithm", "submap", "quantity", "value"]
        out[name] = pd.DataFrame(rows[0], columns=names), pd.DataFrame(rows[1], columns=names)
    return out


@pytest.fixture(scope="module")
def trial() -> GridTrial:
    return GridTrial(GARAGE.quick["court-quick"], 1)


@pytest.fixture(scope="module")
def single(trial: GridTrial) -> SegSlamResult:
    """SegSLAM with one particle: what it believes is one path."""
    result = trial.outcome("segslam-1").result
    assert isinstance(result, SegSlamResult)
    return result


def mean(table: pd.DataFrame, algorithm: str, quantity: str) -> float:
    rows = table[(table["algorithm"] == algorithm) & (table["quantity"] == quantity) & (table["submap"] == -1)]
    assert len(rows), (algorithm, quantity)
    return float(rows["value"].mean())


# --- definitions ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(STUDIES))
def test_they_are_studies_that_can_be_sent_elsewhere(name: str) -> None:
    study = STUDIES[name]
    assert isinstance(study, StudyDefinition)
    assert find_study(name) is study
    assert study.name == name
    assert study.default_trials(False) >= 20
    for quick in (False, True):
        prints = set()
        for world in study.worlds(quick):
            trial = study.trial(world, quick)
            assert fingerprint(pickle.loads(pickle.dumps(trial))) == fingerprint(trial)
            prints.add(fingerprint(trial))
        assert len(prints) == len(study.worlds(quick))
    with pytest.raises(UnknownNameError, match=study.worlds(False)[0]):
        study.trial("meadow", False)


def test_the_garage_is_compared_at_the_papers_numbers_of_particles() -> None:
    assert GARAGE.worlds(False) == ("garage-A", "garage-B", "garage-C", "garage-D", "garage-drawn")
    for world in GARAGE.worlds(False):
        names = GARAGE.full[world].algorithms
        for family in ("rbpf", "segslam"):
            assert [family_of(a)[1] for a in names if family_of(a)[0] == family] == [1, 5, 10, 20, 40, 100]
    assert {GARAGE.full[w].layout for w in GARAGE.worlds(False)} == {"A", "B", "C", "D", "drawn"}


def test_more_particles_run_in_the_same_worlds() -> None:
    for study, name, most in ((MORE_MINE, "mine", 1000), (MORE_BUILDING, "building", 800)):
        base = {"mine": MINE, "building": BUILDING}[name].full[name]
        for world, config in study.full.items():
            assert replace(config, algorithms=base.algorithms) == base
            assert world == f"{name}-{family_of(config.algorithms[0])[1]}"
        assert f"{name}-{most}" in study.full


def test_names_of_algorithms() -> None:
    assert family_of("rbpf-40") == ("rbpf", 40)
    assert family_of("dead-reckoning") == ("dead-reckoning", 0)
    assert drawn_algorithm(["rbpf-100", "segslam-5", "segslam-20", "segslam-100"]) == "segslam-20"
    assert drawn_algorithm(["segslam-40"]) == "segslam-40"
    assert drawn_algorithm(["rbpf-100"]) is None
    for bad in ("rbpf-0", "rbpf", "segslam-x", "ekf-5"):
        with pytest.raises(ConfigError):
            GridTrialConfig(world="court", algorithms=(bad,))


# --- trials --------------------------------------------------------------------------------------------------


def test_dead_reckoning_is_lost_and_segslam_is_not(tables: dict[str, tuple[pd.DataFrame, pd.DataFrame]]) -> None:
    table, timings = tables["segslam-garage"]
    assert (table[table["quantity"] == "failed"]["value"] == 0).all()
    assert mean(table, "dead-reckoning", "final_error") > 3.0
    assert mean(table, "segslam-5", "final_error") < 0.8 * mean(table, "rbpf-5", "final_error")
    assert mean(table, "segslam-5", "matches") > 0
    assert mean(table, "segslam-5", "entropy") < mean(table, "dead-reckoning", "entropy")
    assert mean(table, "segslam-5", "effective_median") < 1.0
    # moment matching is overconfident by far
    d2 = table[table["quantity"].str.startswith("exit_nees")].groupby("quantity")["value"].median()
    assert d2["exit_nees_matched"] > 20 * 4 > 5 * d2["exit_nees_stated"]
    assert mean(timings, "segslam-5", "seconds_total") >= mean(timings, "segslam-5", "seconds_match") > 0.0


def test_same_seed_same_figures(tables: dict[str, tuple[pd.DataFrame, pd.DataFrame]]) -> None:
    """An algorithm's figures depend neither on the run before nor on who else is compared."""
    table, _ = tables["segslam-garage"]
    config = replace(GARAGE.quick["court-quick"], algorithms=("segslam-5",))
    again = [m for m in run_trial(config, 2) if not m.timing and m.algorithm == "segslam-5"]
    of = table[(table["run"] == 1) & (table["algorithm"] == "segslam-5")]
    assert [(m.quantity, m.submap) for m in again] == list(zip(of["quantity"], of["submap"]))
    np.testing.assert_array_equal([m.value for m in again], of["value"])
    assert not np.array_equal(of["value"], table[(table["run"] == 0) & (table["algorithm"] == "segslam-5")]["value"])


def test_one_that_gives_up_is_a_figure_and_not_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> RbpfResult:
        raise DataError("no")

    monkeypatch.setattr(segslam_trial, "run_rbpf", refuse)
    config = replace(GARAGE.quick["court-quick"], algorithms=("rbpf-5", "dead-reckoning"), figures=())
    found = {(m.algorithm, m.quantity): m.value for m in run_trial(config, 0)}
    assert found["rbpf-5", "failed"] == 1.0
    assert ("rbpf-5", "final_error") not in found
    assert found["dead-reckoning", "failed"] == 0.0
    assert found["dead-reckoning", "final_error"] > 1.0


@pytest.mark.parametrize("name", list(STUDIES))
def test_report_and_figures(name: str, tables: dict[str, tuple[pd.DataFrame, pd.DataFrame]], tmp_path) -> None:
    table, timings = tables[name]
    study = STUDIES[name]
    report = study.report(table, timings)
    assert all(len(found) for found in report.values()), {k: len(v) for k, v in report.items()}
    bare = study.report(table, timings[:0])
    assert "seconds" not in bare
    made = study.figures(table, timings, tmp_path)
    assert len(made) >= 2
    assert all(p.stat().st_size > 8_000 for p in made)
    assert f"{study.worlds(True)[0]}-path.png" in {p.name for p in made}


def test_mine_and_building_measure_what_they_are_for(tables: dict[str, tuple[pd.DataFrame, pd.DataFrame]]) -> None:
    table, timings = tables["segslam-mine"]
    assert mean(table, "segslam-5", "loops") == 1.0
    assert mean(table, "segslam-5", "loops_closed") == 1.0
    assert mean(table, "dead-reckoning", "loops_closed") == 0.0
    assert mean(table, "segslam-5", "merged_parallels") == 0.0
    fewest, best, most = (mean(table, "rbpf-5", f"loops_closed{of}") for of in ("_fewest", "", "_most"))
    assert fewest <= best <= most
    assert 1 <= mean(table, "rbpf-5", "particle_paths") <= 5
    assert 0.0 < mean(table, "rbpf-5", "common_path") < 1.0
    assert 1.0 < mean(table, "rbpf-5", "alternatives") == mean(table, "rbpf-5", "survivors") < 5.0
    assert 1.0 <= mean(table, "segslam-5", "survivors") < mean(table, "segslam-5", "alternatives") <= 5.0
    assert mean(timings, "segslam-5", "seconds_step_last_quarter") > 0.0
    table, _ = tables["segslam-building"]
    assert mean(table, "segslam-5", "entropy_min") <= mean(table, "segslam-5", "entropy")
    assert 1 <= mean(table, "rbpf-5", "entropy_samples") <= 3
    assert mean(table, "segslam-5", "entropy_samples") == 3
    assert mean(table, "segslam-5", "known_volume") > mean(table, "segslam-5", "entropy_min")
    assert mean(table, "segslam-5", "height_rmse") < 1.0
    assert mean(table, "segslam-5", "leg_angle") < mean(table, "dead-reckoning", "leg_angle")


# --- judges --------------------------------------------------------------------------------------------------


def test_errors_of_a_path(trial: GridTrial) -> None:
    truth, times = trial.truth, trial.steps.times
    T = SE3.compose(np.array([5.0, -2.0, 1.0, 0, 0, np.sin(0.4), np.cos(0.4)]), truth)
    e = judge.path_errors(Trajectory(times, T), truth)
    np.testing.assert_allclose([e.final, e.final_yaw, e.anchored, e.aligned], 0.0, atol=1e-6)
    moved = truth.copy()
    moved[-1, :3] += [0.3, 0.4, 0.0]
    e = judge.path_errors(Trajectory(times, moved), truth)
    assert e.final == pytest.approx(0.5)
    assert e.anchored == pytest.approx(0.5 / np.sqrt(len(truth)), rel=1e-6)
    assert 0.0 < e.aligned <= e.anchored
    assert judge.path_errors(Trajectory(times, moved), truth, truth[-1]).final == pytest.approx(0.0, abs=1e-9)
    assert e.height == pytest.approx(0.0, abs=1e-9)
    moved[1:, 2] += 0.2
    assert judge.path_errors(Trajectory(times, moved), truth).height == pytest.approx(0.2, rel=0.01)


def test_dead_reckoning_is_what_one_particle_does(trial: GridTrial) -> None:
    one = trial.outcome("rbpf-1")
    reckoned = judge.dead_reckoned(trial.steps).poses
    reckoned[:, 2] += one.path.poses[0, 2]  # maps begin on their lattice, below the body
    np.testing.assert_allclose(reckoned, one.path.poses, atol=1e-9)


def test_fused_map_is_the_map_of_a_filter_on_the_same_path(trial: GridTrial) -> None:
    one = trial.outcome("rbpf-1")
    assert isinstance(one.result, RbpfResult)
    grid = judge.fused_grid(trial.steps, one.path.poses, model=trial.config.filter.beam_model())
    own = one.result.particles.grids[0]
    np.testing.assert_array_equal(grid.brick_coordinates(), own.brick_coordinates())
    np.testing.assert_array_equal(grid.brick_values(), own.brick_values())
    true = judge.fused_grid(trial.steps, trial.truth, model=trial.config.filter.beam_model())
    assert true.entropy() < 0.95 * grid.entropy()


@pytest.mark.parametrize("dim", [2, 3])
def test_placements_of_a_grid_fill_a_voxel_and_a_quarter_turn(dim: int) -> None:
    group = SE3 if dim == 3 else SE2
    np.testing.assert_array_equal(judge.grid_placements(1, 0.2, dim), group.identity[None])
    T = judge.grid_placements(4, 0.2, dim)
    assert T.shape == (4, group.size)
    assert np.all((T[:, :dim] >= 0.0) & (T[:, :dim] < 0.2))
    np.testing.assert_allclose(heading_of(T), np.pi / 2 * np.array([0.125, 0.375, 0.625, 0.875]))
    np.testing.assert_allclose(remove_roll_pitch(T), T, atol=1e-12)
    for axis in range(dim):  # no half of the voxel is left out
        assert len(np.unique(T[:, axis])) == 4
        assert T[:, axis].min() < 0.1 < T[:, axis].max()
    if dim == 3:
        np.testing.assert_allclose(T[:, 2], [0.025, 0.075, 0.125, 0.175])


def test_clarity_is_the_mean_over_grids_that_stand_differently(trial: GridTrial) -> None:
    steps, model = trial.steps, trial.config.filter.beam_model()
    one = judge.clarity(steps, trial.truth, model=model)
    grid = judge.fused_grid(steps, trial.truth, model=model)
    assert (one.entropy, one.volume) == (grid.entropy(), grid.known_volume())
    moved = [SE3.compose(np.broadcast_to(T, trial.truth.shape), trial.truth) for T in judge.grid_placements(2, 0.2, 3)]
    grids = [judge.fused_grid(steps, path, model=model) for path in moved]
    two = judge.clarity(steps, trial.truth, model=model, count=2)
    assert two.entropy == pytest.approx(np.mean([g.entropy() for g in grids]))
    assert two.volume == pytest.approx(np.mean([g.known_volume() for g in grids]))
    assert two.entropy != one.entropy
    # a map pressed together has less in it
    pressed = trial.truth.copy()
    pressed[:, :3] *= 0.5
    assert judge.clarity(steps, pressed, model=model).volume < 0.9 * one.volume


def test_steps_of_the_way_are_where_the_way_is(trial: GridTrial) -> None:
    from graphslam.sim.crawler import crawler_motion, start_frame

    way = trial.world.route().positions(trial.arc)
    T = start_frame(crawler_motion(trial.world, trial.config.crawler))
    there = SE3.compose(np.broadcast_to(T, trial.truth.shape), trial.truth)[:, :3]
    assert np.linalg.norm(there - way, axis=1).max() < 0.3
    assert np.all(np.diff(trial.arc) >= 0)


def test_a_match_is_false_if_the_truth_says_so(single: SegSlamResult) -> None:
    """The path that the filter believes, taken for the truth, makes its matches right; bent after them, wrong."""
    believed = single.trajectory().poses
    right = judge.match_errors(single.segmap, believed)
    assert len(right.segments) >= 1
    assert right.offsets.max() < 0.02
    assert right.angles.max() < 0.02
    assert not right.false.any()
    step = int(right.steps[0])
    bent = believed.copy()
    bent[step:, 0] += 2.0
    wrong = judge.match_errors(single.segmap, bent)
    assert wrong.offsets[0] == pytest.approx(2.0, abs=0.02)
    assert wrong.false[0]
    turned = believed.copy()
    turned[step] = SE3.compose(turned[step], SE3.exp(np.array([0.0, 0, 0.2, 0, 0, 0])))
    wrong = judge.match_errors(single.segmap, turned)
    assert wrong.angles[0] == pytest.approx(0.2, abs=0.02)
    assert wrong.offsets[0] < 0.1
    assert wrong.false[0]


def test_merged_stretches_of_a_hand_case() -> None:
    arc = np.arange(100.0)
    pairs = [[[10.0, 20.0], [60.0, 70.0]]]

    def merged(step: int, place: int, offset: float = 8.0) -> int:
        one = np.array([0])
        m = judge.MatchErrors(one, np.array([step]), np.array([place]), np.array([offset]), np.zeros(1), np.ones(1))
        return judge.merged_stretches(m, arc, pairs)

    assert merged(65, 15) == merged(15, 65) == 1
    assert merged(65, 62) == merged(65, 30) == merged(5, 65) == 0
    assert merged(65, 15, 0.2) == 0


def test_overlapping_stretches_of_a_hand_case() -> None:
    arc = np.arange(0.0, 101.0)
    truth = np.zeros((101, 7))
    truth[:, 0] = np.minimum(arc, 60.0) - np.maximum(arc - 60.0, 0.0)  # forth, and back beside it
    truth[:, 1] = 8.0 * (arc > 60.0)
    pairs = [[[20.0, 50.0], [70.0, 100.0]]]

    def overlapping(apart: float) -> int:
        path = truth.copy()
        path[arc > 60.0, 1] = apart
        return judge.overlapping_stretches(path, truth, arc, pairs)

    assert [overlapping(a) for a in (8.0, 4.1, 3.9, -3.9, -4.1)] == [0, 0, 1, 1, 0]


def test_second_visits_and_legs_of_hand_cases() -> None:
    level_pose = np.array([0.0, 0, 0, 0, 0, 0, 1.0])
    truth = np.tile(level_pose, (6, 1))
    truth[:, 0] = [0.0, 10.0, 10.0, 0.0, 0.0, 10.0]
    truth[3:, 2] = 3.0
    path = truth.copy()
    path[4] = path[4] + [0.6, 0.8, 0, 0, 0, 0, 0]
    assert judge.visit_error(path, truth, 0, 4) == pytest.approx(1.0)
    assert judge.visit_error(path, truth, 0, 3) == 0.0
    # a leg on each of two levels, the upper one turned by 0.1 rad
    pieces = [(0, 1), (3, 5)]
    bent = truth.copy()
    bent[5, :2] = 10.0 * np.array([np.cos(0.1), np.sin(0.1)])
    assert judge.leg_angle_error(bent, truth, pieces) == pytest.approx(0.1)
    assert judge.leg_angle_error(truth, truth, pieces) == 0.0
    assert np.isnan(judge.leg_angle_error(truth, truth, pieces[:1]))


def test_legs_of_the_way_are_straight(trial: GridTrial) -> None:
    pieces = judge.legs(trial.world.route(), trial.arc, 4.0)
    assert len(pieces) == 5
    for a, b in pieces:
        p = trial.truth[a : b + 1, :2]
        along = p[-1] - p[0]
        across = np.abs((p - p[0]) @ np.array([-along[1], along[0]])) / np.linalg.norm(along)
        assert across.max() < 0.1
        assert np.linalg.norm(along) > 3.0


def test_exits_against_the_model_alone(trial: GridTrial, single: SegSlamResult) -> None:
    """One particle has no spread and corrects nothing: its NEES is that of the drift model and of all that dead
    reckoning states of itself, written out."""
    model = FilterDrift(heading_walk=0.02, position_walk=0.05)
    e = judge.exit_errors(single, trial.truth, model)
    t = single.segmap.table
    for k, i in enumerate(single.segmap.chain(int(single.closed[0])).tolist()):
        a, b = int(t.start[i]), int(t.end[i])
        est = SE3.between(remove_roll_pitch(t.entry[i]), remove_roll_pitch(t.exit[i]))
        true = SE3.between(remove_roll_pitch(trial.truth[a]), remove_roll_pitch(trial.truth[b]))
        x = SE3.log(SE3.between(est, true))[2:]
        L = float(single.steps.path_length[b] - single.steps.path_length[a])
        assert e.lengths[k] == pytest.approx(L)
        assert single.steps.errors is not None
        O = single.steps.errors.between(a, b, level_start=True, level_end=True)[1]
        D = (replace(model, alone_walk=np.sqrt(1.0 + model.few) * model.heading_walk).covariance(t.paths[i], 1) + O)[
            2:, 2:
        ]
        assert e.default.values[k] == pytest.approx(x @ np.linalg.solve(D, x), rel=1e-6)
        floor = np.array([1e-3, 0.01, 0.01, 0.01])
        assert e.matched.values[k] == pytest.approx(np.sum((x / floor) ** 2), rel=1e-6)
        np.testing.assert_allclose(e.default.errors[k], x, atol=1e-12)
    assert e.default.dof == 4


def test_small_helpers() -> None:
    assert judge.quarters(np.array([1.0, 3.0, 9.0, 9.0, 9.0, 9.0, 5.0, 7.0])) == (2.0, 6.0)
    assert judge.distinct(np.array([[1, 1], [2, 2], [1, 1], [3, 3]]), 2) == [0, 1]
    assert judge.distinct(np.array([[1, 1], [1, 1], [3, 3]]), 5) == [0, 2]
    assert judge.nearest(np.array([0.0, 1.0, 2.0]), 1.6) == 2


@pytest.mark.parametrize("world", ["garage-C", "mine", "building"])
def test_presets_are_the_settings_of_the_studies(world: str) -> None:
    """Who simulates a world and runs a front end on it gets what the study has figures of."""
    study = {**GARAGE.full, **MINE.full, **BUILDING.full}[world]
    log = SensorLog(name=world, streams={})
    segslam = build_config(SegSlamFrontEndConfig, recommended_options(log, "segslam")["frontend"])
    assert (segslam.steps, segslam.filter, segslam.segslam, segslam.drift) == (
        study.steps, study.segslam_filter, study.segslam, study.drift,
    )  # fmt: skip
    rbpf = build_config(RbpfGridConfig, recommended_options(log, "rbpf-grid")["frontend"])
    assert (rbpf.steps, rbpf.filter) == (study.steps, study.filter)
