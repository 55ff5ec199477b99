"""Errors of calibration are found from residuals alone: how large, which, and not where there are none."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.evaluate.bias_test import KINDS, BiasTest, bias_test_findings, sum_bias_windows
from graphslam_frontends.landmarks.bias_score import PARAMETERS
from graphslam_studies.faults import landmarks as inject


def reports(log: SensorLog, frontend: str) -> list[dict]:
    options = recommended_options(log, frontend)["frontend"]
    return [s.report for s in make_front_end(frontend, options).submaps(log, seed=SeedTree(1))]


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return simulate("landmark-field", seed=2, preset="quick")


def test_both_sides_name_the_same_errors() -> None:
    assert tuple(KINDS) == PARAMETERS


@pytest.mark.parametrize(
    ("fault", "name", "truth"),
    [
        (inject.ranges(1.05), "range-scale", 0.05),
        (inject.ranges(1.0, 1.0), "range-offset", 1.0),
        (inject.bearing_offset(np.deg2rad(10)), "bearing-offset", np.deg2rad(10)),
        (inject.mounted(0.0, 1.0, 0.0), "mount-y", 1.0),
        (inject.mounted(-0.5, 0.0, 0.0), "mount-x", -0.5),
        (inject.speed(1.05), "distance-scale", 0.05),
    ],
)
@pytest.mark.parametrize("frontend", ["rbpf-ekf", "ekf-slam"])
def test_an_error_is_measured(log: SensorLog, frontend: str, fault: inject.Inject, name: str, truth: float) -> None:
    found = sum_bias_windows(reports(fault(log), frontend))
    assert isinstance(found, BiasTest)
    k = PARAMETERS.index(name)
    assert abs(found.error[k]) > 4 * found.sigma[k]
    assert found.error[k] == pytest.approx(truth, abs=4 * found.sigma[k])
    best = float(found.reduction.max())
    assert found.reduction[k] > 0.95 * best  # scales of ranges and of distances take away the same: one cannot be told
    lines = {f.code: f for f in bias_test_findings(reports(fault(log), frontend))}
    text = KINDS[name].more if truth > 0 else KINDS[name].less
    assert text.partition("{}")[2] in lines["calibration"].text


@pytest.mark.parametrize("seed", range(40, 46))
def test_consistent_robots_have_no_error(seed: int) -> None:
    rng = np.random.default_rng(seed)
    log = simulate(
        "landmark-field",
        seed=seed,
        preset="quick",
        sigma_range=rng.uniform(0.05, 0.5),
        sigma_bearing=np.deg2rad(rng.uniform(0.5, 5.0)),
        sigma_speed=rng.uniform(0.05, 0.6),
    )
    for frontend in ("rbpf-ekf", "ekf-slam"):
        made = reports(log, frontend)
        assert bias_test_findings(made) == []
        found = sum_bias_windows(made)
        assert found is not None
        assert 0.9 < found.ratio < 1.1


def test_noise_that_is_larger_than_stated_is_reported() -> None:
    for scale, level in ((1.12, "look"), (2.0, "bad")):
        log = simulate("landmark-field", seed=5, preset="quick", noise_scale=scale)
        options = recommended_options(log, "rbpf-ekf")["frontend"]
        options["motion"] = {k: v / scale for k, v in options["motion"].items()}
        made = [s.report for s in make_front_end("rbpf-ekf", options).submaps(log, seed=SeedTree(1))]
        lines = bias_test_findings(made)
        assert [(f.code, f.level) for f in lines] == [("residuals", level)]


def test_nothing_to_judge_says_nothing() -> None:
    assert bias_test_findings([]) == bias_test_findings([{}, {"systematic": {}}]) == []
