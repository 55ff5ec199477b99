"""The demo: from the command to a picture, to a map."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.demo import DemoProgress, demo_log
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.core.config import merge_options
from graphslam.core.errors import UnknownNameError
from graphslam.core.random import SeedTree
from graphslam.core.trajectory import Trajectory
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.segslam.progress import SegSlamProgress
from graphslam_frontends.segslam.segslam import run_segslam
from tests.app.cli.test_cli import refused


def test_an_unknown_demo_is_refused(tmp_path: Path) -> None:
    """The quick one is run, and gone on with, by the test of the README."""
    refused("demo", "--preset", "huge", "--out", tmp_path / "h", saying="garage")


def test_watching_changes_nothing_and_sees_the_chain() -> None:
    log = demo_log("quick", 3)
    options = recommended_options(log, "segslam")["frontend"]
    options = merge_options(options, {"filter": {"particles": 2}})
    config = make_front_end("segslam", options).config
    steps = make_steps(log, config.steps)
    seen: list[tuple[int, int, list[np.ndarray]]] = []

    def watch(at: SegSlamProgress) -> None:
        seen.append((at.step, at.segments, at.paths() if at.step % 40 == 0 or at.step == at.steps else []))

    watched = run_segslam(steps, config.filter, config.segslam, SeedTree(1), watch=watch)
    plain = run_segslam(steps, config.filter, config.segslam, SeedTree(1))
    np.testing.assert_array_equal(watched.ancestry.path(0), plain.ancestry.path(0))
    assert [s for s, _, _ in seen] == list(range(1, len(steps) + 1))
    counts = [n for _, n, _ in seen]
    assert counts[0] == 0
    assert counts[-1] >= 3
    paths = seen[-1][2]
    assert len(paths) == counts[-1]
    assert sum(len(p) - 1 for p in paths) == len(steps) - 1
    for a, b in pairwise(paths):  # one goes on where the other ends
        np.testing.assert_allclose(a[-1, :2], b[0, :2], atol=1e-6)
    assert steps.truth is not None
    true = steps.truth.interpolate(steps.times)[:, :3]
    assert np.abs(np.vstack(paths)[-1, :2] - (true[-1] - true[0])[:2]).max() < 6.0


def test_picture_is_drawn_when_a_segment_ends_and_stays_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Fake:
        def __init__(self, step: int, segments: int) -> None:
            self.step, self.steps, self.length, self.segments = step, 10, 3.0 * step, segments

        def paths(self) -> list[np.ndarray]:
            return [
                np.column_stack([np.arange(5.0) + 5 * k, np.zeros((5, 5)), np.ones(5)]) for k in range(self.segments)
            ]

    drawn: list[int] = []
    monkeypatch.setattr(DemoProgress, "draw", _counting(DemoProgress.draw, drawn))
    poses = np.zeros((2, 7))
    poses[:, 6] = 1.0
    picture = tmp_path / "figures" / "progress.png"
    watch = DemoProgress(picture, Trajectory(np.array([0.0, 1.0]), poses))
    for k, n in enumerate([0, 0, 1, 1, 1, 2]):
        watch.front_end_at(Fake(k + 1, n))  # type: ignore[arg-type]
        assert picture.is_file() == (n > 0)
    assert drawn == [1, 2]
    assert [p.name for p in picture.parent.iterdir()] == ["progress.png"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def _counting(draw, drawn):  # type: ignore[no-untyped-def]
    def counted(self, at):  # type: ignore[no-untyped-def]
        drawn.append(at.segments)
        draw(self, at)

    return counted


def test_unknown_sizes_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="quick"):
        demo_log("tiny", 0)
