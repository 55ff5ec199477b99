"""CARMEN logs: scans with their odometry, stamps mended, corrected logs matched by ranges."""

from __future__ import annotations

import bz2
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import se2_between, se2_compose
from graphslam.core.log import DropCounter
from graphslam.io.carmen import beam_bearings, mend_stamps, read_carmen, usual_stamps
from graphslam.io.catalog import load_recording
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig

OFFSET = np.array([-0.04, 0.0, 0.0])


def poses(n: int) -> np.ndarray:
    t = 0.2 * np.arange(n)
    return np.column_stack([np.sin(0.3 * t) / 0.3, (1 - np.cos(0.3 * t)) / 0.3, 0.3 * t]) + [3.0, -1.0, 0.0]


def lines(n: int = 40, beams: int = 181) -> list[str]:
    out = ["# message formats", "PARAM robot_frontlaser_offset -0.04 100.0 host 0.0"]
    rng = np.random.default_rng(0)
    for k, robot in enumerate(poses(n)):
        laser = se2_compose(robot, OFFSET)
        ranges = " ".join(f"{r:.2f}" for r in np.append(rng.uniform(1, 20, beams - 1), 81.91))
        where = " ".join(f"{v:.9f}" for v in (*laser, *robot))
        out.append(f"ODOM {robot[0]} {robot[1]} {robot[2]} 0 0 0 {100 + 0.2 * k} host {0.2 * k}")
        out.append(f"FLASER {beams} {ranges} {where} {100 + 0.2 * k:.6f} host {0.2 * k:.6f}")
    return out


def write(folder: Path, text: list[str], name: str = "house.clf.bz2") -> Path:
    path = folder / name
    raw = ("\n".join(text) + "\n").encode()
    path.write_bytes(bz2.compress(raw) if name.endswith("bz2") else raw)
    return path


@pytest.mark.parametrize("beams", [180, 181, 360, 361])
def test_a_log(tmp_path: Path, beams: int) -> None:
    log = read_carmen(write(tmp_path, lines(beams=beams)))
    assert log.name == "house"
    laser, odometry = log["laser"], log["odometry"]
    assert laser.ranges.shape == (40, beams)
    np.testing.assert_allclose(laser.times, 100 + 0.2 * np.arange(40))
    np.testing.assert_allclose(laser.T_base_sensor, OFFSET, atol=1e-8)
    assert laser.bearings[0] == -np.pi / 2
    assert laser.bearings[-1] == pytest.approx(np.pi / 2 - (0 if beams % 2 else np.pi / beams))
    np.testing.assert_allclose(odometry.increments[1:], se2_between(poses(40)[:-1], poses(40)[1:]), atol=1e-8)
    np.testing.assert_array_equal(odometry.increments[0], 0.0)
    np.testing.assert_allclose(np.sqrt(odometry.covariances[0]), np.diag([0.01, 0.01, 0.005]))
    driven, turned = np.linalg.norm(odometry.increments[5, :2]), odometry.increments[5, 2]
    assert odometry.covariances[5, 0, 0] == pytest.approx(0.01**2 + (0.1 * driven) ** 2)
    assert odometry.covariances[5, 2, 2] == pytest.approx(0.005**2 + (0.15 * driven) ** 2 + (0.2 * turned) ** 2)
    assert log.dropped == {"log: line ODOM not used: scans have their own odometry": 40}


def test_bearings_are_those_of_the_scanner() -> None:
    np.testing.assert_allclose(np.rad2deg(beam_bearings(181)), np.arange(-90, 91), atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(beam_bearings(360)), np.arange(-90, 90, 0.5), atol=1e-9)


def test_stamps_are_mended_the_least(rng: np.random.Generator) -> None:
    t = np.arange(300) * 0.2
    late = np.where(rng.random(300) < 0.1, rng.uniform(0, 0.9, 300), 0.0)
    late[49:51] = [0.2, 0.0]  # a stamp twice
    times, moved = mend_stamps(t + late, 3.0, where="log")
    assert np.all(np.diff(times) > 0.9e-3)
    assert 0 < moved < 150
    assert np.abs(times - t).max() <= late.max() + 1e-6
    assert np.abs(times - (t + late)).max() <= late.max() + 1e-6
    np.testing.assert_array_equal(mend_stamps(t, 3.0, where="log")[0], t)
    # no other rising stamps are nearer: moving any pooled block as a whole costs more
    cost = np.sum((times - t - late) ** 2)
    for _ in range(200):
        other = np.sort(times + rng.normal(scale=0.02, size=300))
        if np.all(np.diff(other) > 1e-3):
            assert np.sum((other - t - late) ** 2) > cost
    t[200:] -= 100.0
    with pytest.raises(DataError, match=r"s out of order"):
        mend_stamps(t, 3.0, where="log")


def test_stamps_that_the_motion_excludes_are_replaced(tmp_path: Path) -> None:
    scans = [" ".join([*s.split()[:-3], "0", "host", "0"]) for s in lines() if s.startswith("FLASER")]
    log = read_carmen(write(tmp_path, scans, "one-stamp.log"))
    t, step = log["laser"].times, se2_between(poses(40)[:-1], poses(40)[1:])
    np.testing.assert_array_equal(t, log["odometry"].times)
    # 0.2 m and 0.06 rad: 0.4 s at the usual speed
    np.testing.assert_allclose(np.diff(t), np.hypot(step[:, 0], step[:, 1]) / 0.5, rtol=1e-6)
    assert log.dropped == {"laser: stamp replaced (kept)": 40}
    assert log.meta["assumed"][-1] == (
        "look",
        "stamps of the scans: 0.039 s for all of the path, which is impossible. They were replaced by those of a robot "
        "with 0.5 m/s and 0.5 rad/s.",
    )
    # bunches of delayed scans, each with one stamp: the stamps stay
    bunches = mend_stamps(np.floor(np.arange(40) / 8) * 1.6, 3.0, where="log")[0]
    assert usual_stamps(bunches, poses(40)) is None
    assert usual_stamps(bunches[:1], poses(1)) is None


def test_corrected_scans_are_found_by_their_ranges(tmp_path: Path) -> None:
    text = lines()
    write(tmp_path, text)
    scans = [s.split() for s in text if s.startswith("FLASER")]
    corrected = []
    for k in range(3, 40, 4):
        w = scans[k]
        laser = se2_compose(se2_compose([10.0, 20.0, 1.0], poses(40)[k]), OFFSET)
        pose = " ".join(f"{v:.9f}" for v in (*laser, *laser))
        corrected.append(" ".join(w[:183]) + f" {pose} 1.1e+09 pippo 1.1e+09")
    strange = corrected[0].replace("FLASER 181 ", "FLASER 181 7.77 ", 1).split()
    del strange[3]
    write(tmp_path, [*corrected, " ".join(strange)], "house-corrected.log")
    log = read_carmen(tmp_path)
    reference = log["reference"]
    np.testing.assert_allclose(reference.times, log["laser"].times[3::4])
    truth = se2_compose(np.tile([10.0, 20.0, 1.0], (40, 1)), poses(40))[3::4]
    np.testing.assert_allclose(se2_between(reference.poses, truth), 0.0, atol=1e-6)
    assert log.dropped["reference: corrected scan is not in the log"] == 1
    other = [c.replace("FLASER 181 ", "FLASER 181 3.33 ", 1).split() for c in corrected]
    write(tmp_path, [" ".join([*w[:3], *w[4:]]) for w in other], "house-corrected.log")
    with pytest.raises(DataError, match="another recording"):
        read_carmen(tmp_path)


def test_bad_lines_are_counted_or_refused(tmp_path: Path) -> None:
    text = lines(n=100)
    laser = [k for k, s in enumerate(text) if s.startswith("FLASER")]
    text[laser[-1]] = text[laser[-1]][:200]  # the log was cut off
    text[laser[10]] = text[laser[10]].replace("FLASER 181 ", "FLASER 181 x", 1)
    words = text[laser[20]].split()
    words[-4] = "nan"
    text[laser[20]] = " ".join(words)
    words = text[laser[30]].split()
    words[5] = "nan"  # a range without a reading is no bad record
    text[laser[30]] = " ".join(words)
    log = read_carmen(write(tmp_path, text))
    assert len(log["laser"].times) == 97
    assert log.dropped["laser: scan is truncated, or of another size"] == 1
    assert log.dropped["laser: scan holds something that is no number"] == 1
    assert log.dropped["laser: pose or stamp is not finite"] == 1
    for k in laser[40:50]:
        text[k] = "FLASER 181 1.0"
    with pytest.raises(
        FormatError, match=r"first in line \d+: 13 of 100 scans are unusable, 11 of them because: scan is truncated"
    ):
        read_carmen(write(tmp_path, text))


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="no such file"):
        read_carmen(tmp_path / "nothing")
    with pytest.raises(MissingDataError, match="does not hold one log"):
        read_carmen(tmp_path)
    with pytest.raises(FormatError, match="no scan"):
        read_carmen(write(tmp_path, ["ODOM 0 0 0 0 0 0 1 host 1"]))
    with pytest.raises(FormatError, match="number of beams"):
        read_carmen(write(tmp_path, ["FLASER 1 3.0 0 0 0 0 0 0 1 host 1"]))
    good = write(tmp_path, lines())
    for bad in ({"max_range": 0.0}, {"most_mended": np.nan}):
        with pytest.raises(ConfigError, match="carmen"):
            read_carmen(good, **bad)
    for bad in ({"floor": (0.0, 1.0)}, {"per_radian": -1.0}):
        with pytest.raises(ConfigError, match="odometry"):
            load_recording(good, **bad)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "scans", "corrected", "metres"),
    [("radish-intel", 13631, 910, 508), ("radish-fr079", 4934, 4791, 392), ("radish-mit-csail", 1988, 406, 374)],
)
def test_recorded_logs_become_steps(data_dir: Path, name: str, scans: int, corrected: int, metres: float) -> None:
    drops = DropCounter()
    log = load_recording(name)  # reads the corrected log as well
    assert len(log["laser"].times) == scans
    assert len(log["reference"]) == corrected
    steps = make_steps(log, StepConfig(most_points=180), drops=drops)
    assert steps.dim == 2
    assert steps.path_length[-1] == pytest.approx(metres, rel=0.02)
    assert len(steps) == pytest.approx(log.duration / 0.4, abs=2)
    assert np.diff(steps.offsets).max() == 180
    assert np.mean(np.diff(steps.offsets) == 0) < (0.3 if name == "radish-intel" else 0.01)
    assert 0.9 < steps.returns.mean() < 1.0
    assert not any("outside" in d for d in drops.counts)
    # odometry and the reference agree over a few metres; over the whole they do not
    reference = log["reference"]
    here = reference.times[: min(len(reference), 400)]
    a, b = here[10], here[15]
    i, j = np.searchsorted(log["odometry"].times, [a, b])
    T = np.zeros(3)
    for step in log["odometry"].increments[i + 1 : j + 1]:
        T = se2_compose(T, step)
    R = se2_between(reference.interpolate(a)[0], reference.interpolate(b)[0])
    assert np.linalg.norm(T[:2] - R[:2]) < 0.5


def test_field_of_view_and_greatest_range_of_lines_param(tmp_path: Path) -> None:
    text = lines(beams=541)
    plain = read_carmen(write(tmp_path, text))
    np.testing.assert_allclose(plain["laser"].bearings[[0, -1]], [-np.pi / 2, np.pi / 2])
    assert plain.meta["assumed"] == [
        ("look", "field of view of the laser: 180°, no line states it (reader option fov=).")
    ]
    params = [
        "PARAM laser_front_laser_fov 270 1.0 host 1.0",
        "PARAM robot_front_laser_max 30.0 1.0 host 1.0",
        "PARAM simulator_laser_probability_of_random_max .0001 1.0 host 1.0",
    ]
    log = read_carmen(write(tmp_path, params + text))
    np.testing.assert_allclose(np.rad2deg(log["laser"].bearings[[0, 270, -1]]), [-135, 0, 135], atol=1e-9)
    assert log["laser"].max_range == 30.0
    assert log.meta["assumed"] == [("", "field of view of the laser: 270°, by a line PARAM.")]
    asked = read_carmen(tmp_path / "house.clf.bz2", fov=240.0)
    np.testing.assert_allclose(np.rad2deg(asked["laser"].bearings[-1]), 120.0)
