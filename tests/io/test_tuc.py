"""The lecture hall: dead reckoning and covariances by hand, bad records dropped and counted, bad files refused."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import se2_between, se2_exp, se2_log
from graphslam.io.catalog import load_recording
from graphslam.io.tuc import TucLog, read_tuc


def write(folder: Path, lines: list[str], truth: list[str] | None = None) -> Path:
    (folder / "Lecture_Hall_Input.txt").write_text("\n".join(lines) + "\n")
    text = "\n".join(truth or ["point2 0 0 0 0 0 0 0", "angle 0 0 0", "point2 9 9 0 0 0 0 0"]) + "\n"
    with gzip.open(folder / "Lecture_Hall_GT.txt.gz", "wt") as stream:
        stream.write(text)
    return folder


DRIVE = [f"odom2 {0.1 * k:.1f} 1.0 0.0 0.5 0.0025 0.0025 0.0001" for k in range(51)]


def test_dead_reckoning_at_stamps_between_records(tmp_path: Path) -> None:
    log = read_tuc(write(tmp_path, [*DRIVE, "loop 4.25 1.13 0.75"]))
    assert log.loops.tolist() == [[1.13, 4.25]]
    network, times = log.to_network(spacing=1.0)
    assert times.tolist() == [0.0, 1.0, 1.13, 2.0, 3.0, 4.0, 4.25]
    assert np.allclose(network.poses, se2_exp(times[:, None] * [1.0, 0.0, 0.5]))
    assert network.edges[-1].tolist() == [2, 6]
    assert np.allclose(network.information[-1], np.diag([1.0, 1.0, 1 / 0.09]))
    assert np.allclose(log.truth_at(np.array([4.5])), [[4.5, 0.0]])


def test_odometry_covariance_is_that_of_noisy_velocities(tmp_path: Path) -> None:
    """Monte Carlo: increments integrated from disturbed velocities scatter as stated, two-sided."""
    log = read_tuc(write(tmp_path, DRIVE))
    network, _ = log.to_network(spacing=2.0)
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(400):
        noisy = log.velocities + np.sqrt(log.variances) * rng.standard_normal(log.velocities.shape)
        other = TucLog(
            log.times,
            noisy,
            log.variances,
            log.loops,
            log.similarity,
            log.truth_times,
            log.truth,
            {},
            "noisy",
        )
        moved, _ = other.to_network(spacing=2.0)
        errors.append(se2_log(se2_between(network.measurements[0], moved.measurements[0])))
    e = np.array(errors)
    chi2 = np.einsum("ki,ij,kj->k", e, network.information[0], e)
    assert 3 - 4 * np.sqrt(6 / 400) < chi2.mean() < 3 + 4 * np.sqrt(6 / 400)


def test_bad_records_are_dropped_and_counted(tmp_path: Path) -> None:
    bad = [
        "odom2 5.2 nan 0 0 0.0025 0.0025 0.0001",
        "odom2 5.3 1 0 0 0 0.0025 0.0001",
        "odom2 4.0 1 0 0 0.0025 0.0025 0.0001",
        "loop 3 1 1.5",
        "loop 3 99 0.5",
        "loop 3 3 0.5",
        "loop nan 3 0.5",
        "loop 3 1 0.5",
    ]
    log = read_tuc(write(tmp_path, [*DRIVE, *bad]))
    assert len(log.times) == len(DRIVE)
    assert len(log.loops) == 1
    assert sum(log.dropped.values()) == 7


def test_bad_files_are_refused_with_their_line(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="no such folder"):
        read_tuc(tmp_path / "nowhere")
    for line, message in (
        ("odom3 1 2", "unknown record"),
        ("loop 1 2", "truncated or too long"),
        ("loop 1 2 x", "holds no number"),
    ):
        with pytest.raises(FormatError, match=message) as caught:
            read_tuc(write(tmp_path, [*DRIVE, line]))
        assert "line 52" in str(caught.value)
    with pytest.raises(DataError, match="fewer than two"):
        read_tuc(write(tmp_path, DRIVE[:1]))
    with pytest.raises(DataError, match="no true position"):
        read_tuc(write(tmp_path, DRIVE, ["angle 0 0 0"]))
    with pytest.raises(ConfigError, match="positive"):
        read_tuc(write(tmp_path, DRIVE)).to_network(place_sigma=0.0)
    for drive, message in (
        ([*DRIVE, "odom2 1e12 1.0 0.0 0.5 0.0025 0.0025 0.0001"], "a stamp is wrong"),
        ([line.replace("0.0025 0.0025 0.0001", "0.0025 0.0025 1e-320") for line in DRIVE], "not positive definite"),
    ):
        log = read_tuc(write(tmp_path, drive))
        with pytest.raises(DataError, match=message):
            log.to_network()
    log = read_tuc(write(tmp_path, [*DRIVE, "odom2 5.1 1e40 0.0 0.5 0.0025 0.0025 0.0001"]))
    assert log.dropped["odometry: not finite, or a variance that is not positive"] == 1


@pytest.mark.data
def test_recorded_hall(data_dir: Path) -> None:
    log = load_recording("tuc-slam-lecture-hall")
    assert (len(log.times), len(log.loops), len(log.truth)) == (13838, 5180, 6919)
    assert log.dropped == {} or sum(log.dropped.values()) == 0
    network, times = log.to_network(min_similarity=0.5)
    assert len(network) == len(times)
    # candidates of a high similarity are mostly right
    ends = log.truth_at(times)[network.edges[len(network) - 1 :]]
    assert np.mean(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) < 2.0) > 0.85
    free, _ = log.to_network(min_similarity=0.9, heading_sigma=None)
    assert free.information[-1, 2, 2] == 0.0
