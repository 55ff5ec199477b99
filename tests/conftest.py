"""Shared fixtures: recorded data, seeded randomness."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.pictures import save_point

matplotlib.use("Agg")

LONGEST = ("test_notebooks.py", "test_docs.py", "test_study.py", "test_kills.py", "test_refined_run.py")
"""Files that take a minute or more. They come first, so that no process is left with one of them at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order in which files are given to processes; in a file nothing changes."""
    items.sort(key=lambda item: item.path.name not in LONGEST and item.path.parent.name != "refine")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The 40 slowest files [s], where CI runs: what to make faster first."""
    if not os.environ.get("CI"):
        return
    spent: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for r in reports:
            if isinstance(r, pytest.TestReport):
                spent[r.nodeid.split("::")[0]] += r.duration
    terminalreporter.section(f"slowest files of {len(spent)}, {sum(spent.values()):.0f} s in all")
    for file, seconds in spent.most_common(40):
        terminalreporter.line(f"{seconds:7.1f} s  {file}")


def data_root() -> Path | None:
    """Folder of recorded data (GRAPHSLAM_DATA), or None."""
    value = os.environ.get("GRAPHSLAM_DATA")
    return Path(value) if value and Path(value).is_dir() else None


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Recorded data; skips with the reason where it is missing (in CI it is there, so a skip there is a failure)."""
    root = data_root()
    if root is None:
        if os.environ.get("CI"):
            pytest.fail("GRAPHSLAM_DATA is not set or not a folder, and this is CI")
        pytest.skip("recorded data not found: set GRAPHSLAM_DATA to the folder that holds victoria_park_raw/ etc.")
    return root


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Generator seeded by the test's name: independent of order."""
    return np.random.default_rng(list(request.node.nodeid.encode()))


@pytest.fixture(scope="session", autouse=True)
def quick_pictures() -> Iterator[None]:
    """Figures are made, and written as one point; see ``full_pictures`` of tests/pictures.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", save_point)
        yield
