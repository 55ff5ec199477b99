"""Graphs with an IMU are as sure as they should be, block by block, and nearer to the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.evaluate.residual_consistency import class_consistency
from graphslam.graph.factors.imu.config import ImuConfig
from tests.reference import imu_ring
from tests.reference.imu_ring import STEP
from tests.reference.imu_study import solved, trial

RUNS = 20
DOF = {"heading": 1, "level": 2, "tilt": 2}


@pytest.fixture(scope="module")
def trials():
    def some(imu, gps):
        rng = [np.random.default_rng([3, k]) for k in range(RUNS)]
        return [trial(r, imu, gps=gps, step=3 * STEP, submaps=4) for r in rng]

    return {(imu, gps): some(ImuConfig() if imu else None, gps) for imu in (True, False) for gps in (True, False)}


@pytest.mark.parametrize("gps", [False, True])
def test_nees_by_block_is_inside_two_sided_bounds(trials, gps):
    """Means over the nodes of a run and over runs: nodes of one run are alike, so the bounds are those of the runs."""
    seen = trials[True, gps]
    assert set(seen[0].nees) == {
        "position", "heading", "level", "velocity", "gyro bias", "force bias", "tilt"
    }  # fmt: skip
    for block in seen[0].nees:
        n = DOF.get(block, 3)
        low, high = np.array(chi2_mean_bounds(n, RUNS, 0.999)) / n
        assert low < np.mean([t.nees[block] for t in seen]) < high, block


def test_chi2_of_the_ways_is_as_it_should_be(trials):
    chi2, dof = np.sum([t.chi2["imu"] for t in trials[True, False]], axis=0)
    low, high = np.array(chi2_mean_bounds(dof, 1, 0.999)) / dof
    assert low < chi2 / dof < high


def test_it_helps(trials):
    """Roll and pitch above all; position with GPS or without."""

    def rms(imu: bool, gps: bool, what: str) -> float:
        return float(np.sqrt(np.mean([getattr(t, what) ** 2 for t in trials[imu, gps]])))

    for gps in (False, True):
        assert rms(True, gps, "level") < 0.5 * rms(False, gps, "level")
        assert rms(True, gps, "ate") < 0.95 * rms(False, gps, "ate")


def test_an_imu_that_is_worse_than_it_says_shows(rng):
    """Readings ten times as noisy as stated: χ² and NEES say so."""
    stated = imu_ring.NOISE
    rough = replace(stated, gyro=10 * stated.gyro, accelerometer=10 * stated.accelerometer)
    made = imu_ring.ring(rng, submaps=4, noise=rough)
    made.imu = replace(made.imu, noise=stated)
    g = solved(made, rng, ImuConfig(), False, 3.0)
    c = class_consistency(g)["imu"]
    assert c.chi2 / c.dof > 5
