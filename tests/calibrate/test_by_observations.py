"""Calibration of logs of landmarks: what it finds in drawn robots, what it leaves alone, and how runs use it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.cli.run import join_note
from graphslam.app.run.calibration import keep_user_settings
from graphslam.app.run.front_ends import recommended_options
from graphslam.app.run.options import RunOptions
from graphslam.calibrate.clock import profile_clock
from graphslam.calibrate.corrections import Corrections, apply_corrections, moved_end
from graphslam.calibrate.estimate import Estimate
from graphslam.calibrate.landmark_calibration import LONG, QUICK, RAN_AWAY, SHORT, calibrate_observations
from graphslam.calibrate.landmarks import fit_noise, smooth_observations
from graphslam.calibrate.prediction_check import predict_withheld_observations
from graphslam.calibrate.smoothing import CONSTANTS
from graphslam.calibrate.windows import ObservationLog, window_scans
from graphslam.core.config import read_toml
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp
from graphslam.core.poses import compose_increments
from graphslam.io.log_store import save_log
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf
from graphslam_frontends.odometry.motion import MotionNoise
from graphslam_studies.calibration_robot import draw_robot, drive

ROBOT = draw_robot(3)
OPTIONS = {
    "frontend": {"association": "known", "particles": 4, "stopping": {"max_distance": 40.0}},
    "backend": {"associate": False, "merge_every": 0},
}


@pytest.fixture(scope="module")
def log():
    return drive(ROBOT, 3, 60.0)


@pytest.fixture(scope="module")
def found(log):
    return calibrate_observations(ObservationLog.of(log, "landmarks", log["landmarks"]), QUICK)


def test_drawn_robot_is_found_again(found) -> None:
    c = found.corrections
    assert c.clock == pytest.approx(ROBOT.clock, abs=0.05)  # half a record of its odometry
    e = {e.name: e for e in found.estimates}
    assert np.exp(e["distance_scale"].value) == pytest.approx(ROBOT.distance_scale, abs=0.02)
    assert e["yaw_bias"].value == pytest.approx(ROBOT.yaw_bias, abs=np.deg2rad(0.5))
    assert c.yaw_bias == 0.0  # no more than chance in a minute of these wheels
    assert e["sensor_yaw"].value == pytest.approx(ROBOT.sensor_yaw, abs=np.deg2rad(0.8))
    assert c.range_offset == pytest.approx(ROBOT.range_offset, abs=3.0 * e["range_offset"].sigma)
    assert e["range_offset"].sigma < 0.05
    assert c.range_sigma == pytest.approx(ROBOT.range_sigma, rel=0.1)
    assert c.bearing_sigma == pytest.approx(ROBOT.bearing_sigma, rel=0.1)


@pytest.mark.parametrize(("number", "rate", "scans"), [(1000, 20.0, 4.0), (1003, 20.0, 4.0), (1049, 10.0, 2.0)])
def test_clocks_that_agree_are_left_alone(number: int, rate: float, scans: float) -> None:
    """Records that are averaged over half a period look less noisy, whatever the clocks are."""
    robot = dataclasses.replace(draw_robot(number), clock=0.0)
    drawn = drive(robot, number, 90.0, rate=rate, scans=scans)
    seen = ObservationLog.of(drawn, "landmarks", drawn["landmarks"]).with_withheld()
    free = ("yaw_bias", "distance_scale", "range_offset", "sensor_yaw")
    clock = profile_clock(fit_noise(smooth_observations(seen, SHORT, 20, free))[0], seen)
    assert not clock.applied
    assert abs(clock.value) < 0.02


def test_withheld_observations_take_what_is_right_and_refuse_what_is_wrong(log, found) -> None:
    assert found.prediction.supported == "all"
    assert found.prediction.gains["all"] > 100.0
    seen = ObservationLog.of(log, "landmarks", log["landmarks"]).with_withheld()
    share = float(seen.withheld.mean())
    assert 0.0 < share < 0.2
    scans = window_scans(seen, LONG)
    bent = dataclasses.replace(found.corrections.without_constants(), yaw_bias=0.2)
    blunt = dataclasses.replace(bent, range_sigma=1e5, bearing_sigma=1e4)
    for c, supported in ((bent, "noise"), (blunt, "nothing")):
        wrong = found.validated(
            predict_withheld_observations(seen, dataclasses.replace(found, corrections=c), scans, MotionNoise())
        )
        assert wrong.prediction.supported == supported
        assert not any(e.applied for e in wrong.estimates)
        assert "calibration-refused" in {f.code for f in wrong.findings()}
        assert wrong.corrections == (found.corrections.without_constants() if supported == "noise" else Corrections())


def test_corrections_that_change_nothing_predict_nothing_better(log, found) -> None:
    seen = ObservationLog.of(log, "landmarks", log["landmarks"]).with_withheld()
    none = dataclasses.replace(found, corrections=Corrections())
    gains = predict_withheld_observations(seen, none, window_scans(seen, LONG), MotionNoise()).gains
    assert gains["all"] == pytest.approx(0.0, abs=0.01)


def test_corrected_log_says_nothing_more_of_its_constants(log, found) -> None:
    mended = apply_corrections(log, found.corrections)
    again = calibrate_observations(ObservationLog.of(mended, "landmarks", mended["landmarks"]), QUICK)
    before = {e.name: e for e in found.estimates if e.applied}
    for e in again.estimates:
        assert not e.applied or abs(e.value) < 0.3 * abs(before[e.name].value), e


def test_tracks_without_identities_tell_the_same(log, found) -> None:
    blind = dataclasses.replace(log["landmarks"], ids=None)
    there = calibrate_observations(ObservationLog.of(log, "landmarks", blind), QUICK).corrections
    assert there.distance_scale == pytest.approx(found.corrections.distance_scale, abs=0.01)
    assert there.clock == pytest.approx(found.corrections.clock, abs=0.1)
    assert there.range_sigma == pytest.approx(ROBOT.range_sigma, rel=0.3)


def test_wrong_identities_are_trimmed(log, found) -> None:
    rng = np.random.default_rng(2)
    ids = log["landmarks"].ids.copy()
    wrong = rng.random(len(ids)) < 0.05
    ids[wrong] = rng.permutation(ids[wrong])
    spoilt = dataclasses.replace(log["landmarks"], ids=ids)
    c = calibrate_observations(ObservationLog.of(log, "landmarks", spoilt), QUICK).corrections
    assert c.range_sigma == pytest.approx(ROBOT.range_sigma, rel=0.2)
    assert c.bearing_sigma == pytest.approx(ROBOT.bearing_sigma, rel=0.2)


def test_too_few_observations_are_refused_with_a_count(log) -> None:
    short = log.slice(0.0, 1.5)
    with pytest.raises(DataError, match="observations of landmarks"):
        calibrate_observations(ObservationLog.of(short, "landmarks", short["landmarks"].take(slice(0, 2))), QUICK)


def test_run_of_an_unknown_log_is_calibrated_and_says_so(log, tmp_path) -> None:
    stated = gs.run(log, config={**OPTIONS, "calibrate": {"use": "none"}}, progress=False)
    run = gs.run(log, config=OPTIONS, progress=False, out=tmp_path / "run")
    assert run.metric("nees_aligned_poses_per_dof") < 0.1 * stated.metric("nees_aligned_poses_per_dof")
    assert run.metric("path_rmse_aligned") < stated.metric("path_rmse_aligned")
    texts = [f.text for f in run.verdict if f.code == "calibrated"]
    assert any("odometry stamps" in s for s in texts)
    given = read_toml(tmp_path / "run" / "config.toml")["calibrate"]["given"]
    assert given["clock"] == pytest.approx(ROBOT.clock, abs=0.05)
    before = (tmp_path / "run" / "config.toml").read_bytes()
    again = gs.run(log, config=OPTIONS, progress=False, out=tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "config.toml").read_bytes() == before
    assert again.metric("path_rmse_aligned") == run.metric("path_rmse_aligned")


def test_noise_set_by_hand_stands(log) -> None:
    options = {**OPTIONS, "frontend": {**OPTIONS["frontend"], "noise": {"range_sigma": 9.0, "bearing_sigma": 1.0}}}
    run = gs.run(log, config=options, progress=False)
    given = run.report["calibrate"]["given"]
    assert "range_sigma" not in given
    assert given["along_metre"] > 0


def test_command_line_writes_what_a_run_takes(log, tmp_path) -> None:
    save_log(log, tmp_path / "log")
    file = tmp_path / "noise.toml"
    result = CliRunner().invoke(app, ["calibrate", str(tmp_path / "log"), "--quick", "--out", str(file), "--json"])
    assert result.exit_code == 0, result.output
    value = json.loads(result.stdout)
    given = read_toml(file)["calibrate"]["given"]
    assert given["clock"] == pytest.approx(value["given"]["clock"])
    run = gs.run(log, config={**OPTIONS, **read_toml(file)}, progress=False)
    assert run.report["calibrate"]["given"] == given


@pytest.mark.parametrize("name", ["range_sigma", "distance_scale"])
def test_impossible_figures_are_refused(name) -> None:
    with pytest.raises(ConfigError, match=name):
        Corrections(**{name: -1.0})


def test_advice_names_the_cause_and_no_scale_on_covariances(log) -> None:
    run = gs.run(log, config={**OPTIONS, "calibrate": {"use": "none"}}, progress=False)
    causes = [f.text for f in run.verdict if f.code == "calibration" and "a cause of the disagreement" in f.text]
    assert any("odometry stamps" in c for c in causes)
    (note,) = join_note(run)
    assert "calibration" in note
    assert "covariance_scale=" not in note


def test_noise_of_the_wheels_does_not_make_their_distances_look_too_long() -> None:
    """Noise of half a step length is in what is measured, not in the way: it must not be taken for a scale."""
    robot = dataclasses.replace(ROBOT, speed=0.6, along_metre=0.12, clock=0.0, distance_scale=1.0, range_sigma=0.03)
    noisy = drive(robot, 5, 60.0)
    effort = dataclasses.replace(QUICK, clock=False)
    seen = ObservationLog.of(noisy, "landmarks", noisy["landmarks"])
    e = {e.name: e for e in calibrate_observations(seen, effort).estimates}
    assert abs(e["distance_scale"].value) < 2.5 * e["distance_scale"].sigma


def test_a_scale_that_is_hardly_observable_is_left() -> None:
    """On a robot of MRCLAM wheels looked half as long as they are, ± 20 %, and the map came out 300 m wide."""
    clear = Estimate(name="distance_scale", value=0.1, sigma=0.01, gain=50.0, other=0.1, other_sigma=0.01)
    vague = dataclasses.replace(clear, value=0.68, sigma=0.2, gain=3783.0, other=0.7, other_sigma=0.2)
    assert clear.gated().applied
    assert not vague.gated().applied
    assert "20 %" in vague.gated().why_not
    assert not vague.contradiction
    assert dataclasses.replace(vague, sigma=0.02).contradiction


@pytest.mark.data
def test_a_scale_that_runs_away_is_held_and_the_noise_is_found(data_dir):
    """Detections of MRCLAM are so sparse that wheels without any say are likelier than the right ones."""
    log = gs.load("mrclam-dataset7/robot1")
    seen = ObservationLog.of(log, "landmarks", log["landmarks"])
    free = ("yaw_bias", "distance_scale", "range_offset", "sensor_yaw")
    wild, _ = fit_noise(smooth_observations(seen, SHORT, 20, free))
    assert abs(wild.constants[CONSTANTS.index("distance_scale")]) > RAN_AWAY * 0.2
    found = calibrate_observations(seen, dataclasses.replace(QUICK, clock=False))
    assert "distance_scale" not in {e.name for e in found.estimates}
    assert any("distance_scale: not observable" in f.text for f in found.findings())
    assert found.corrections.distance_scale == 1.0
    assert 0.01 < found.noise["range_sigma"] < 0.1
    assert int(found.data.split()[3]) > 900  # detections: nearly none is trimmed


def test_no_constant_is_corrected_twice() -> None:
    """A file of options that corrects ranges, on top of an estimate of the same error, divided it out twice."""
    c = Corrections(range_scale=1.066, range_offset=0.1, turn_per_metre=0.01, yaw_bias=0.02, along_metre=0.1)
    own = {"frontend": {"noise": {"range_scale": 1.066}, "steps": {"yaw_per_metre": 0.01}}}
    kept = keep_user_settings(c, own)
    assert (kept.range_scale, kept.range_offset, kept.turn_per_metre) == (1.0, 0.0, 0.0)
    assert (kept.yaw_bias, kept.along_metre) == (0.02, 0.1)
    assert keep_user_settings(c, {"frontend": {"smoothing_noise": None}}) == c


def test_a_preset_of_another_set_is_read_without_its_noise(log) -> None:
    assert recommended_options(log, "rbpf-ekf", "victoria-park")["frontend"].keys() & {"motion", "noise"}

    def set_by_preset(**calibrate: str) -> set[str]:
        config = {"preset": "victoria-park", "calibrate": calibrate}
        options = RunOptions.for_log(log, "rbpf-ekf", "batch", 0, config)
        default = RbpfEkf().config
        assert options.front is not None
        return {k for k in ("motion", "noise") if getattr(options.front.config, k) != getattr(default, k)}

    assert set_by_preset() == set()
    assert set_by_preset(use="none")


def test_the_end_of_a_corrected_path_moves_as_a_monte_carlo_says(log) -> None:
    c = Corrections(distance_scale=1.02, yaw_bias=0.002)
    corrected = apply_corrections(log, c)
    moved, allowed = moved_end(log, corrected, MotionNoise())
    odometry = [each["odometry"] for each in (log, corrected)]
    end = [compose_increments(o.increments)[-1] for o in odometry]
    assert moved == pytest.approx(np.hypot(*(end[0] - end[1])[:2]), rel=1e-6)
    rng = np.random.default_rng(0)
    direction = se2_between(*end)[:2] / moved
    ends = []
    for o in odometry:
        root = np.linalg.cholesky(o.covariances[1:] + 1e-12 * np.eye(3))
        noise = se2_exp(np.einsum("nij,rnj->rni", root, rng.standard_normal((400, len(root), 3))))
        drawn = [
            compose_increments(np.concatenate([o.increments[:1], se2_compose(o.increments[1:], e)])) for e in noise
        ]
        ends.append(
            se2_between(np.broadcast_to(compose_increments(o.increments)[-1], (400, 3)), np.array(drawn)[:, -1])
        )
    R = se2_between(*end)[2]
    turned = ends[1][:, :2] @ np.array([[np.cos(R), np.sin(R)], [-np.sin(R), np.cos(R)]])
    sigma = np.sqrt(np.var(ends[0][:, :2] @ direction) + np.var(turned @ direction))
    assert allowed == pytest.approx(3.3 * sigma, rel=0.12)
