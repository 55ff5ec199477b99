"""The demo: from the command to a picture, to a map."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.demo import demo_log
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.core.config import merge_options
from graphslam.core.errors import UnknownNameError
from graphslam.core.random import SeedTree
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


def test_unknown_sizes_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="quick"):
        demo_log("tiny", 0)
