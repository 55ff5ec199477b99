"""Maps on GPS fixes: paths and landmarks are moved by the alignment of their own, and titles say its residuals."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
import pytest

from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_transform
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from tests.reference.gps_maps import plot_gps_maps


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.fixture
def path() -> Trajectory:
    t = np.linspace(0.0, 10.0, 41)
    heading = 0.6 * t
    return Trajectory(t, np.column_stack([8.0 * np.cos(heading), 5.0 * np.sin(heading), heading]))


LEVER = np.array([2.0, 0.5])
FRAME = np.array([100.0, -40.0, 1.1])


def fixes(path: Trajectory) -> Gps:
    xy = se2_transform(FRAME, path.points(LEVER))
    return Gps(times=path.times, positions=xy, sigma=np.ones(len(path)), lever=LEVER)


def drawn(ax, label: str) -> np.ndarray:
    return next(l for l in ax.get_lines() if l.get_label() == label).get_xydata()


def test_a_right_path_in_any_frame_lies_on_the_fixes(path: Trajectory) -> None:
    gps = fixes(path)
    marks = np.array([[1.0, 2.0], [-3.0, 4.0]])
    own = np.array([-7.0, 3.0, -2.0])
    axes = plot_gps_maps(
        {"here": path, "elsewhere": path.transformed(own)},
        gps,
        landmarks={"here": marks, "elsewhere": se2_transform(own, marks)},
    )
    for ax in axes:
        assert np.allclose(drawn(ax, "path of the antenna"), gps.positions, atol=1e-9)
        assert np.allclose(drawn(ax, "GPS"), gps.positions, atol=1e-9)
        assert np.allclose(drawn(ax, "landmark"), se2_transform(FRAME, marks), atol=1e-9)
        assert "RMSE 0.00 m" in ax.get_title()
        assert "2 landmarks" in ax.get_title()
    assert axes[0].get_title().startswith("here\n")
    assert axes[0].get_xlim() == axes[1].get_xlim()
    assert (axes[0].get_ylabel(), axes[1].get_xlabel()) == ("north [m]", "east [m]")
    assert {t.get_text() for t in axes[-1].get_legend().get_texts()} == {"GPS", "path of the antenna", "landmark"}


def test_a_wrong_path_does_not_and_its_title_says_by_how_much(path: Trajectory) -> None:
    bent = Trajectory(path.times, path.poses * [1.3, 1.0, 1.0])
    (ax,) = plot_gps_maps({"bent": bent}, fixes(path))
    away = np.linalg.norm(drawn(ax, "path of the antenna") - fixes(path).positions, axis=1)
    rmse = np.sqrt(np.mean(away**2))
    assert rmse > 0.5
    assert f"RMSE {rmse:.2f} m, median {np.median(away):.2f} m" in ax.get_title()
    assert "landmarks" not in ax.get_title()


def test_what_cannot_be_drawn_is_refused(path: Trajectory) -> None:
    with pytest.raises(DataError, match="no maps"):
        plot_gps_maps({}, fixes(path))
    with pytest.raises(DataError, match="without a path"):
        plot_gps_maps({"a": path}, fixes(path), landmarks={"b": np.zeros((1, 2))})
    late = Trajectory(path.times + 100.0, path.poses)
    with pytest.raises(DataError, match="too few fixes"):
        plot_gps_maps({"late": late}, fixes(path))
