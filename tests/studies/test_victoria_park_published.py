"""Published detections and SLAM input of Victoria Park: against the raw log and against each other."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.log import DropCounter
from graphslam.core.records import LandmarkObservations
from graphslam_studies.io.victoria_park import LASER_POSITION, read_victoria_park
from graphslam_studies.io.victoria_park_published import (
    SLSJF_LANDMARK_OFFSET,
    match_observations,
    read_slsjf_network,
    read_slsjf_observations,
    read_ufastslam_detections,
)


@pytest.fixture(scope="module")
def published(data_dir: Path) -> Path:
    return data_dir / "victoria_park_processed"


@pytest.mark.data
def test_ufastslam_detections_lie_on_laser_returns(data_dir: Path, published: Path) -> None:
    """Every detection of an ASCII scan lies just behind the beams it names: clock, bearing and unit are right."""
    found = read_ufastslam_detections(published)
    assert (len(found.times), len(found.ranges)) == (7249, 52974)
    laser = read_victoria_park(data_dir / "victoria_park_raw", gps="none")["laser"]
    k = np.searchsorted(found.times, laser.times - 1e-4)
    np.testing.assert_allclose(found.times[k], laser.times, atol=1e-9)  # all 7,230 scans are there
    behind = []
    for scan in range(0, len(laser.times), 50):
        rows = found.scan(int(k[scan]))
        for r, b in zip(found.ranges[rows], found.bearings[rows]):
            beam = (b + np.pi / 2) / np.deg2rad(0.5)
            near = laser.ranges[scan, [int(np.floor(beam + 0.01)), int(np.ceil(beam - 0.01))]]
            behind.append(np.min(r - near[near < 80], initial=np.inf))
    behind = np.array(behind)
    assert len(behind) > 900
    assert np.mean((behind >= -0.3) & (behind < 0.6)) > 0.98


@pytest.mark.data
def test_slsjf_observations_are_a_part_of_the_detections(published: Path) -> None:
    seen = read_slsjf_observations(published)
    assert (len(seen.times), len(seen.ranges)) == (7122, 46860)
    assert seen.ids is not None
    assert len(set(seen.ids.tolist())) == 299
    # no tree twice in a scan
    scan = np.repeat(np.arange(len(seen.times)), np.diff(seen.offsets))
    assert len(set(zip(scan.tolist(), seen.ids.tolist()))) == len(seen.ids)
    found = read_ufastslam_detections(published)
    index = {round(t, 3): k for k, t in enumerate(found.times)}
    hits = []
    for k in range(0, len(seen.times), 40):
        a = seen.scan(k)
        b = found.scan(index[round(seen.times[k], 3)])
        d = np.abs(seen.bearings[a][:, None] - found.bearings[b][None])
        hits += list(
            np.min(np.where(np.abs(seen.ranges[a][:, None] - found.ranges[b][None]) < 0.3, d, 9.0), axis=1) < 0.01
        )
    assert np.mean(hits) > 0.9


@pytest.mark.data
def test_slsjf_network_agrees_with_its_observations(published: Path) -> None:
    network = read_slsjf_network(published)
    assert (len(network.ids), len(network.edges)) == (6899, 6898)
    assert (len(network.landmark_ids), len(network.observations)) == (299, 45390)
    seen = read_slsjf_observations(published)
    assert seen.ids is not None
    # the first observation of the file: rear-axle frame = laser frame moved by its position
    k = 0
    xy = seen.ranges[k] * np.array([np.cos(seen.bearings[k]), np.sin(seen.bearings[k])]) + LASER_POSITION
    np.testing.assert_allclose(network.observation_values[0], xy, atol=0.005)
    assert network.landmark_ids[network.observations[0, 1]] - SLSJF_LANDMARK_OFFSET == seen.ids[0]
    # covariances came through: those of the file's first step
    P = np.linalg.inv(network.information[0])
    assert P[0, 0] == pytest.approx(1.68e-3, rel=0.01)
    assert P[2, 2] == pytest.approx(1.279e-5, rel=0.01)


def pack(path: Path, table: np.ndarray) -> None:
    path.write_bytes(gzip.compress("\n".join(" ".join(f"{v:.6e}" for v in row) for row in table).encode()))


def make_ufastslam(folder: Path, n: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    distance = np.zeros((n, 18))
    distance[:, :5] = rng.uniform(2, 40, (n, 5))
    return (
        distance,
        np.where(distance > 0, rng.uniform(-1.5, 1.5, (n, 18)), 0.0),
        21819.0 + 213.0 * np.arange(n)[:, None],
    )


def write_ufastslam(folder: Path, distance: np.ndarray, angle: np.ndarray, stamp: np.ndarray) -> None:
    pack(folder / "ufastslam_ObservationDistance.txt.gz", distance)
    pack(folder / "ufastslam_ObservationAngle_90.txt.gz", angle)
    pack(folder / "ufastslam_lasersampling.txt.gz", stamp)


def test_bad_detections_are_counted_or_refused(tmp_path: Path) -> None:
    distance, angle, stamp = make_ufastslam(tmp_path)
    distance[3, 1], distance[4, 2], angle[5, 0] = np.nan, -1.0, np.inf
    write_ufastslam(tmp_path, distance, angle, stamp)
    drops = DropCounter()
    found = read_ufastslam_detections(tmp_path, drops=drops)
    assert drops.counts == {"detections: range or bearing is impossible": 3}
    assert len(found.ranges) == 247
    assert list(np.diff(found.offsets)[2:6]) == [5, 4, 4, 4]
    write_ufastslam(tmp_path, distance, angle, stamp[:-1])
    with pytest.raises(FormatError, match="differ in length"):
        read_ufastslam_detections(tmp_path)
    write_ufastslam(tmp_path, np.where(distance > 0, np.nan, 0.0), angle, stamp)
    with pytest.raises(DataError, match="unusable"):
        read_ufastslam_detections(tmp_path)
    with pytest.raises(ConfigError):
        read_ufastslam_detections(_good(tmp_path), range_sigma=0.0)


def _good(folder: Path) -> Path:
    write_ufastslam(folder, *make_ufastslam(folder))
    return folder


def test_bad_slsjf_files(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        read_slsjf_observations(tmp_path)
    rows = np.column_stack(
        [21819.0 + 213.0 * np.arange(100), np.full((100, 2), 5.0), np.zeros((100, 2)), np.arange(100)]
    )
    rows[7, 5], rows[8, 1] = -1.0, np.nan
    rows[9, 5] = 1e20
    path = tmp_path / "slsjf_data_sensor_clean_clean.mat"
    scipy.io.savemat(path, {"data_sensor_clean_clean": rows})
    drops = DropCounter()
    assert len(read_slsjf_observations(tmp_path, drops=drops).ranges) == 97
    assert drops.counts == {
        "observations: time, range, bearing or id is impossible": 2,
        "observations: marked as poor": 1,
    }
    rows[50, 0] = 0.0
    scipy.io.savemat(path, {"data_sensor_clean_clean": rows})
    with pytest.raises(DataError, match="backwards at row 47"):
        read_slsjf_observations(tmp_path)
    net = tmp_path / "slsjf_VicPark_clean_data.mat"
    odometry = np.array([[1.0, 0, 1, 1, 0, 0, 1, 0, 0, 1, 0, 1], [1.0, 1, 2, 1, 0, 0, 1, 2, 0, 1, 0, 1]])
    scipy.io.savemat(net, {"VicPark_clean_data": odometry})
    with pytest.raises(FormatError, match="not positive definite, first: number 1"):
        read_slsjf_network(tmp_path)
    odometry[1, 2] = 2.5
    scipy.io.savemat(net, {"VicPark_clean_data": odometry})
    with pytest.raises(FormatError, match="row 1 is neither"):
        read_slsjf_network(tmp_path)
    odometry[1, 0], odometry[1, 2] = 7, 2
    scipy.io.savemat(net, {"VicPark_clean_data": odometry})
    with pytest.raises(FormatError, match="row 1 is neither"):
        read_slsjf_network(tmp_path)


def test_observations_are_matched_by_scan_and_each_row_once():
    def seen(times: list[float], counts: list[int], ranges: list[float]) -> LandmarkObservations:
        zeros, offsets = np.zeros(len(ranges)), np.concatenate([[0], np.cumsum(counts)])
        return LandmarkObservations(
            times=np.array(times), offsets=offsets, ranges=np.array(ranges), bearings=zeros,
            sigmas=np.tile([0.1, 0.01], (len(ranges), 1)),
        )  # fmt: skip

    got = match_observations(seen([1.0, 2.0], [2, 1], [5.0, 5.1, 7.0]), seen([1.001, 3.0], [2, 1], [5.09, 5.25, 7.0]))
    # row 0 of the reference is nearest to observation 1; observation 0 then takes the other; 3.0 s is another scan
    assert got.tolist() == [1, 0, -1]
