"""Shared fixtures: recorded data, seeded randomness."""

from __future__ import annotations

import os
import signal
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.pictures import save_point

matplotlib.use("Agg")

LONGEST = (
    "test_docs.py",
    "test_notebooks.py",
    "app/run/test_refined_run.py",
    "refine/test_refinement.py",
    "studies/test_study.py",
    "faults/test_grid_faults.py",
    "faults/test_landmark_faults.py",
    "faults/test_kills.py",
    "app/sessions/test_merge_dense.py",
    "app/run/test_slam.py",
    "app/test_compare_equals_run.py",
    "refine/test_fixes.py",
    "frontends/lidar_odometry/test_inertial.py",
    "join/test_every_factor.py",
    "refine/test_plane.py",
    "app/cli/test_cli.py",
)
"""The files with the most CPU time, as CI prints it: they come first, so that no process has one left at the end."""
_cpu_before = [0.0]


def cpu_seconds() -> float:
    """CPU time of this process and of its children that ended [s]."""
    return sum(os.times()[:4])


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--all``: also the tests marked slow."""
    parser.addoption("--all", action="store_true", help="also the rest of the tables of which a sample is run")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order in which files are given to processes; in a file nothing changes. Slow tests are left out, and counted."""
    if not config.getoption("--all"):
        left_out = [item for item in items if item.get_closest_marker("slow")]
        items[:] = [item for item in items if not item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=left_out)
    ranks = {Path(__file__).parent / name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))
    _cpu_before[0] = cpu_seconds()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Each report has the CPU time since the one before, of this process and of those that ended."""
    report = yield
    now = cpu_seconds()
    report.cpu, _cpu_before[0] = now - _cpu_before[0], now  # type: ignore[attr-defined]
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The 40 files with the most CPU time [s], where CI runs: what to make faster first."""
    if not os.environ.get("CI"):
        return
    spent: Counter[str] = Counter()
    for reports in terminalreporter.stats.values():
        for r in reports:
            if isinstance(r, pytest.TestReport):
                spent[r.nodeid.split("::")[0]] += getattr(r, "cpu", 0.0)  # it has none if its process died
    terminalreporter.section(f"CPU time of {len(spent)} files, {sum(spent.values()):.0f} s in all")
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


@pytest.fixture(autouse=True)
def own_signals() -> Iterator[None]:
    """A command that a test runs in this process changes signals and hooks; the next test has Python's own again."""
    hook = sys.unraisablehook
    signals = {n: h for n in (signal.SIGINT, signal.SIGTERM) if (h := signal.getsignal(n)) is not None}
    yield
    sys.unraisablehook = hook
    for number, handler in signals.items():
        signal.signal(number, handler)
