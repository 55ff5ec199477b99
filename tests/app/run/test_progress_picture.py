"""The picture that is drawn during a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.run.progress_picture import PICTURE, ProgressPicture, plot_log
from graphslam.app.run.run_bar import RunBar
from graphslam.backend.back_end import Observer
from graphslam.core.errors import DataError
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)


class Watch(Observer):
    """Bytes of the picture at each event."""

    def __init__(self, path: Path) -> None:
        self.path, self.seen = path, list[tuple[str, bytes]]()

    def stage(self, name: str) -> None:
        self.seen.append((name, self.path.read_bytes() if self.path.is_file() else b""))

    def submap_added(self, submap: object, graph: object) -> None:
        self.stage("submap")


def test_a_run_is_drawn_while_it_works_and_stays_the_same(log: SensorLog, tmp_path: Path) -> None:
    watch = Watch(tmp_path / "drawn" / PICTURE)
    drawn = gs.run(log, seed=1, out=tmp_path / "drawn", progress=[RunBar(True), watch])
    plain = gs.run(log, seed=1, out=tmp_path / "plain", progress=False)
    assert {name for name, picture in watch.seen if not picture} == {"reading"}
    pictures = [picture for name, picture in watch.seen if picture]
    assert all(p.startswith(b"\x89PNG") for p in pictures)
    assert len(set(pictures)) >= 2  # the log, then submaps
    assert not watch.path.exists()
    assert not (tmp_path / "plain" / PICTURE).exists()
    np.testing.assert_array_equal(drawn.map.base_poses, plain.map.base_poses)


def test_segments_are_drawn_when_one_ends(tmp_path: Path) -> None:
    class Progress:
        def __init__(self, segments: int) -> None:
            self.length, self.segments = 3.0 * segments, segments

        def paths(self) -> list[np.ndarray]:
            return [
                np.column_stack([np.arange(5.0) + 5 * k, np.zeros((5, 5)), np.ones(5)]) for k in range(self.segments)
            ]

    watch = ProgressPicture(tmp_path)
    drawn = []
    for n in (0, 0, 1, 1, 2):
        watch.front_end_at(Progress(n))
        drawn.append(watch.path.read_bytes() if watch.path.is_file() else b"")
    assert [bool(d) for d in drawn] == [False, False, True, True, True]
    assert drawn[2] == drawn[3] != drawn[4]


def test_the_odometry_is_aligned_to_the_fixes(log: SensorLog) -> None:
    ax = plot_log(log)
    lines = {line.get_label(): line.get_xydata() for line in ax.lines}
    fixes, path = lines["GPS"], lines["dead reckoning"]
    gaps = np.linalg.norm(fixes[:, None] - path[None], axis=2).min(axis=1)
    assert np.sqrt(np.mean(gaps**2)) < 3.0
    gps = next(s for s in log.streams.values() if isinstance(s, Gps))
    assert np.ptp(gps.positions[:, :2], axis=0).max() > 20.0


def test_a_log_without_odometry_and_gps_has_no_first_picture(log: SensorLog) -> None:
    assert plot_log(replace(log, streams={"landmarks": log.streams["landmarks"]})) is None


def test_a_picture_that_cannot_be_drawn_does_not_end_the_run(
    log: SensorLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing(log: SensorLog) -> None:
        raise DataError("odometry that cannot be integrated")

    monkeypatch.setattr("graphslam.app.run.progress_picture.plot_log", failing)
    watch = ProgressPicture(tmp_path)
    watch.log_read(log)
    watch.stage("calibration")
    assert not watch.path.exists()
    assert "was not drawn" in caplog.text
    assert "cannot be integrated" in caplog.text
