"""Calibration of odometry by scans: a robot in a furnished room, errors added to its odometry and found again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import graphslam as gs
from graphslam.calibrate.corrections import Corrections, apply_corrections
from graphslam.calibrate.estimate import Calibration, Estimate
from graphslam.calibrate.landmark_calibration import QUICK
from graphslam.calibrate.scans import (
    BLOCK,
    ScanPairs,
    calibrate_scans,
    cross_validate,
    heading_cover,
    regress_errors,
)
from graphslam.core.errors import DataError
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from tests.calibrate.room import drive

BIAS, SCALE, NOISE = np.deg2rad(0.6), 1.04, 0.02


@pytest.fixture(scope="module")
def log():
    return drive(bias=BIAS, scale=SCALE, noise=NOISE)[0]


def test_added_scale_noise_and_turning_are_found(log) -> None:
    found = calibrate_scans(make_steps(log, StepConfig(period=None)), QUICK)
    c = found.corrections
    assert c.distance_scale == pytest.approx(SCALE, abs=0.005)
    metres = float(np.hypot(*log["odometry"].increments[:, :2].T).sum())
    turned = c.yaw_bias * 150.0 + c.turn_per_metre * metres + (c.turn_scale - 1) * 25.0
    assert turned == pytest.approx(BIAS * 150.0, rel=0.15)
    step = 0.5 * metres / 150.0
    heading = c.heading_metre**2 * step + c.heading_radian**2 * 0.09 + c.heading_second**2 * 0.5
    assert np.sqrt(heading) == pytest.approx(NOISE * np.sqrt(step), rel=0.35)
    assert any("odometry distances" in f.text for f in found.findings())
    assert found.prediction is not None
    assert found.prediction.supported == "all"


def test_noise_of_the_heading_is_no_error_of_the_turns() -> None:
    """The odometry turns by its noise, too: as regressor, that turn explains the whole error of the heading."""
    log, _ = drive(noise=0.1)
    found = {e.name: e for e in calibrate_scans(make_steps(log, StepConfig(period=None)), QUICK).estimates}
    assert abs(found["turn_scale"].value) < 4.0 * found["turn_scale"].sigma


def test_run_of_a_front_end_on_grids_is_calibrated(log) -> None:
    options = {"frontend": {"steps": {"period": "none"}, "filter": {"particles": 4}}, "map": {"fuse": False}}
    run = gs.run(log.slice(0.0, 60.0), frontend="rbpf-grid", config=options, progress=False)
    assert run.report["calibrate"]["given"]["distance_scale"] == pytest.approx(SCALE, abs=0.01)


def test_the_noise_of_distances_is_widened_by_scans_and_never_narrowed() -> None:
    """Matches over a metre do not see wheels that slip seldom: believed, they once bent a map by a metre and a half."""
    for stated in (1e-4, 0.2):
        log, _ = drive(bias=BIAS, noise=NOISE, stated=stated, seconds=80.0)
        found = calibrate_scans(make_steps(log, StepConfig(period=None)), QUICK).corrections
        before = log["odometry"].covariances[1:, [0, 1], [0, 1]]
        after = apply_corrections(log, found)["odometry"].covariances[1:, [0, 1], [0, 1]]
        assert np.all(after >= before)


def test_far_too_large_a_noise_of_the_heading_is_replaced_by_one_that_covers_all_matches() -> None:
    log, _ = drive(bias=BIAS, noise=NOISE, stated=0.2, seconds=80.0)
    few = calibrate_scans(make_steps(log.slice(0.0, 60.0), StepConfig(period=None)), QUICK)
    assert few.corrections.heading_cover is None  # fewer than 100 matches: rare slips may be missed
    before = log["odometry"].covariances[1:, 2, 2]
    found = calibrate_scans(make_steps(log, StepConfig(period=None)), QUICK)
    after = apply_corrections(log, found.corrections)["odometry"].covariances[1:, 2, 2]
    assert np.all(after <= before)
    true = NOISE * np.sqrt(np.hypot(*log["odometry"].increments[1:, :2].T))
    assert 0.9 < np.median(np.sqrt(after) / true) < 4.0  # 15 times before
    assert any("times this one" in f.text for f in found.findings())


def test_heading_noise_that_one_match_contradicts_is_kept() -> None:
    """The errors are 0.01 rad: a log that gives 0.2 rad is corrected, unless one error in 120 is as large as that."""
    e = 0.01 * np.random.default_rng(5).standard_normal(120)
    estimated, stated = np.full(120, 0.01**2), np.full(120, 0.2**2)
    assert 1.0 <= heading_cover(e, estimated, stated) < 1.5
    assert heading_cover(e, estimated, np.full(120, 0.015**2)) is None
    e[60] = 0.6
    assert heading_cover(e, estimated, stated) is None


def test_ranges_twice_too_long_are_a_contradiction_and_correct_nothing(log) -> None:
    scans = log["scans"]
    doubled = dataclasses.replace(scans, ranges=2.0 * scans.ranges, max_range=60.0)
    made = make_steps(dataclasses.replace(log, streams={**log.streams, "scans": doubled}), StepConfig(period=None))
    found = calibrate_scans(made, QUICK)
    scale = next(e for e in found.estimates if e.name == "distance_scale")
    assert scale.contradiction
    assert found.corrections == Corrections()
    (line,) = found.findings()
    assert (line.level, line.code) == ("bad", "calibration-contradiction")


def test_scans_that_see_nothing_are_refused(log) -> None:
    blind = dataclasses.replace(log["scans"], ranges=np.full_like(log["scans"].ranges, 99.0))
    nothing = dataclasses.replace(log, streams={**log.streams, "scans": blind})
    with pytest.raises(DataError, match="too few scans"):
        calibrate_scans(make_steps(nothing, StepConfig(period=None)), QUICK)


def test_matches_of_few_places_are_no_fair_sample(log) -> None:
    """Along a street most scans do not match; those that do once made good wheels six times worse."""
    scans = log["scans"]
    rng = np.random.default_rng(5)
    street = rng.random(len(scans.ranges)) < 0.55
    ranges = np.where(street[:, None], rng.uniform(1.0, 9.0, scans.ranges.shape), scans.ranges)
    few = dataclasses.replace(log, streams={**log.streams, "scans": dataclasses.replace(scans, ranges=ranges)})
    with pytest.raises(DataError, match=r"biased sample.* of .* neighbouring key scans; wanted 50%"):
        calibrate_scans(make_steps(few, StepConfig(period=None)), QUICK)


def test_regression_finds_noise_that_grows_and_is_not_led_by_outliers() -> None:
    rng = np.random.default_rng(1)
    d = rng.choice([0.4, 1.3], 600)
    e = 0.05 * d + np.sqrt(0.01**2 + 0.03**2 * d) * rng.standard_normal(600)
    e[::20] += 1.0
    found = regress_errors(e, d[:, None], d[:, None])
    assert found.value[0] == pytest.approx(0.05, abs=4 * np.sqrt(found.covariance[0, 0]))
    assert found.sigmas[1] == pytest.approx(0.03, rel=0.25)
    assert not found.keep[::20].any()


def drawn_pairs(bend, *, stated, seed=4) -> ScanPairs:
    """Pairs of a robot whose heading errs by so much a metre, with 0.02 rad/√m and 0.03 m/√m of noise."""
    rng = np.random.default_rng(seed)
    d = np.tile([0.4, 4.0], 120)
    zero, n = np.zeros(len(d)), len(d)
    heading = bend * d + np.sqrt(0.005**2 + 0.02**2 * d) * rng.standard_normal(n)
    along = np.sqrt(0.01**2 + 0.03**2 * d) * rng.standard_normal(n)
    columns = {"apart": zero, "seconds": d, "metres": d, "turn": zero, "turned": zero, "chord": d, "side": zero}
    variances = {"stated_heading": stated**2 * 0.02**2 * d, "stated_along": stated**2 * 0.03**2 * d}
    return ScanPairs(**columns, **variances, heading=heading, along=along)


def judged(p: ScanPairs) -> Calibration:
    bend = Estimate(name="turn_per_metre", value=0.1, sigma=0.01, gain=50.0, other=0.1, other_sigma=0.01)
    raw = Calibration(kind="scans", corrections=Corrections(turn_per_metre=0.1, along_metre=0.03), estimates=(bend,))
    return raw.validated(cross_validate(p, raw, widen=True))


def test_halves_that_contradict_each_other_refuse_what_the_whole_says() -> None:
    """A robot that bends to one side in half of the blocks and to the other in the rest has no constant bend."""
    side = np.where(np.arange(240) // BLOCK % 2 == 0, 0.1, -0.1)
    correlated = judged(drawn_pairs(0.1, stated=0.25))
    assert correlated.prediction.supported == "all"
    assert correlated.corrections.turn_per_metre == 0.1
    refused = judged(drawn_pairs(side, stated=0.25))
    assert refused.prediction.supported == "noise"
    assert refused.corrections == Corrections(along_metre=0.03)
    assert not refused.estimates[0].applied
    assert any(f.code == "calibration-refused" for f in refused.findings())


def test_noise_that_is_stated_rightly_is_not_changed_for_a_worse_one() -> None:
    """What halves of the log tell of the noise is worth much where the log states too little, and nothing otherwise."""
    right = judged(drawn_pairs(0.0, stated=1.0))
    small = judged(drawn_pairs(0.0, stated=0.25))
    assert small.prediction.gains["noise"] > 10.0
    assert right.prediction.gains["noise"] < 3.0
