"""Figures of scans, single submaps, their reports, and GPS vectors: what is drawn is what was given."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.quiver import Quiver

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_mean_bounds, chi2_quantile
from graphslam.core.log import Truth
from graphslam.core.records import LandmarkObservations, LaserScans
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps import gps_residuals
from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field
from graphslam_studies.plots.gps import plot_gps_vectors
from graphslam_studies.plots.local_map import plot_correlation, plot_local_map
from graphslam_studies.plots.reports import plot_report, plot_submap_chi2
from graphslam_studies.plots.scans import observed_points, plot_scan, scan_points


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


def rendered(ax: Axes, tmp_path: Path) -> Axes:
    ax.figure.savefig(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5_000
    return ax


def legend_of(ax: Axes) -> list[str]:
    return [t.get_text() for t in ax.get_legend().get_texts()]


def line(ax: Axes, label: str) -> np.ndarray:
    return next(l for l in ax.get_lines() if str(l.get_label()).startswith(label)).get_xydata()


LASER = LaserScans(
    times=[0.0, 1.0],
    ranges=np.array([[2.0, 90.0, np.nan], [1.0, 3.0, 80.0]]),
    bearings=[-np.pi / 2, 0.0, np.pi / 2],
    max_range=80.0,
    T_base_sensor=[3.0, 0.5, 0.0],
)


def seen(sensor: tuple[float, float, float] = (3.0, 0.5, 0.0)) -> LandmarkObservations:
    return LandmarkObservations(
        times=[0.0, 1.0],
        offsets=[0, 1, 3],
        ranges=[5.0, 10.0, 20.0],
        bearings=[0.0, np.pi / 2, 0.0],
        sigmas=[[0.1, 0.01], [0.1, 0.01], [0.5, 0.02]],
        T_base_sensor=np.array(sensor),
    )


def test_returns_are_points_in_the_base_frame() -> None:
    assert np.allclose(scan_points(LASER, 0), [[3.0, -1.5]])
    assert np.allclose(scan_points(LASER, 1), [[3.0, -0.5], [6.0, 0.5]])


def test_observed_landmarks_and_their_covariance() -> None:
    points, P = observed_points(seen(), 1)
    assert np.allclose(points, [[3.0, 10.5], [23.0, 0.5]])
    assert np.allclose(P[0], np.diag([0.1**2, 0.1**2]))  # seen to the left: across is x, (10 · 0.01)²
    assert np.allclose(P[1], np.diag([0.5**2, 0.4**2]))
    _, turned = observed_points(seen((0.0, 0.0, np.pi / 2)), 1)
    assert np.allclose(turned[1], np.diag([0.4**2, 0.5**2]))


def test_observed_covariance_is_the_scatter_of_samples(rng: np.random.Generator) -> None:
    r, b = 20 + 0.5 * rng.standard_normal(40_000), 0.7 + 0.02 * rng.standard_normal(40_000)
    one = replace(seen(), offsets=[0, 0, 1], ranges=[20.0], bearings=[0.7], sigmas=[[0.5, 0.02]])
    _, P = observed_points(one, 1)
    assert np.allclose(np.cov(r * np.cos(b), r * np.sin(b)), P[0], atol=0.02)


def test_scan_with_two_lists(tmp_path: Path) -> None:
    ax = rendered(plot_scan(None, 1.0, scans=LASER, landmarks={"ours": seen(), "theirs": seen()}), tmp_path)
    assert np.allclose(line(ax, "return"), [[3.0, -0.5], [6.0, 0.5]])
    assert np.allclose(line(ax, "ours"), line(ax, "theirs"))
    assert {"return (2)", "ours (2)", "theirs (2)", "ours, 95% ellipse"} <= set(legend_of(ax))
    assert ax.get_aspect() == 1.0
    assert len([c for c in ax.collections if isinstance(c, EllipseCollection)]) == 1
    with pytest.raises(DataError, match="no scan near"):
        plot_scan(None, 0.5, scans=LASER)
    with pytest.raises(DataError, match="nothing to draw"):
        plot_scan(None, 0.5)


def submap(key: int = 0, **report: object) -> Submap:
    P = np.diag([0.04, 0.09, 0.01, 1.0, 4.0, 1.0, 1.0])
    P[0, 3] = P[3, 0] = 0.1
    m = LandmarkMap(ids=[7, -1], exit_pose=[10.0, 0.0, np.pi / 2], positions=[[5.0, 5.0], [8.0, -3.0]], covariance=P)
    path = Trajectory([0.0, 1.0], [[0, 0, 0], [10.0, 0.0, np.pi / 2]])
    return Submap.from_landmarks(key, m, interval=(0.0, 1.0), trajectory=path, report=report)


def test_local_map_with_truth(tmp_path: Path) -> None:
    truth = Truth(Trajectory([0.0, 1.0], [[0, 0, 0], [10.5, 0, np.pi / 2]]), np.array([7]), np.array([[5.5, 5.0]]))
    ax = rendered(plot_local_map(None, submap(), truth=truth), tmp_path)
    assert np.allclose(line(ax, "truth"), [[10.5, 0.0], [5.5, 5.0]])  # id -1 has no truth
    exit_ellipse, landmarks = (c for c in ax.collections if isinstance(c, EllipseCollection))
    k = 2 * np.sqrt(chi2_quantile(0.95, 2))
    assert np.allclose(np.sort(2 * exit_ellipse._widths), k * 0.3)  # the joint Gaussian's own block, not rotated
    assert len(landmarks.get_offsets()) == 2
    assert "submap 0: 1.0 s, 2 landmarks" in ax.get_title()


def test_correlation_image(tmp_path: Path) -> None:
    ax = rendered(plot_correlation(None, submap()), tmp_path)
    C = np.asarray(ax.images[0].get_array())
    assert np.allclose(np.diag(C), 1.0)
    assert C[0, 3] == pytest.approx(0.1 / (0.2 * 1.0))
    bare = Submap(key=1, interval=(0.0, 1.0), exit_pose=[1.0, 0, 0], exit_covariance=np.eye(3))
    with pytest.raises(DataError, match="no landmarks"):
        plot_correlation(None, bare)
    assert plot_local_map(None, bare).get_title() == "submap 1: 1.0 s, 0 landmarks"


def chain() -> list[Submap]:
    rows = [("features", 90.0, 100), ("features", 200.0, 100), ("distance", 50.0, 50)]
    return [submap(k, ended=e, chi2=c, dof=d, min_ess=4.0 * k) for k, (e, c, d) in enumerate(rows)]


def test_chi2_of_submaps_over_their_bounds(tmp_path: Path) -> None:
    ax = rendered(plot_submap_chi2(None, chain()), tmp_path)
    assert np.allclose(line(ax, "ended: features (2)"), [[0, 0.9], [1, 2.0]])
    assert np.allclose(line(ax, "ended: distance (1)"), [[2, 1.0]])
    low, high = chi2_mean_bounds(50, 1)
    box = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (box.min(), box.max()) == pytest.approx((low / 50, high / 50))
    with pytest.raises(DataError, match="no degrees of freedom"):
        plot_submap_chi2(None, [submap(0, chi2=1.0, dof=0)])


def test_report_figures(tmp_path: Path) -> None:
    ax = rendered(plot_report(None, chain(), "min_ess", label="ESS", limit=(10.0, "alarm")), tmp_path)
    assert np.allclose(line(ax, "ended: features"), [[0, 0.0], [1, 4.0]])
    assert ax.get_ylabel() == "ESS"
    assert "alarm" in legend_of(ax)
    with pytest.raises(DataError, match="has no number 'scans'"):
        plot_report(None, chain(), "scans")


def test_gps_vectors_point_from_map_to_fix(tmp_path: Path) -> None:
    log = simulate_landmark_field(landmark_field_preset("quick", gps_rate=1.0), 0)
    g = log["gps"]
    r = gps_residuals(log.truth.trajectory, g.take((g.times < 10) | (g.times > 30)))
    ax = rendered(plot_gps_vectors(None, r, scale=5.0, path=log.truth.trajectory.positions), tmp_path)
    arrows = [c for c in ax.collections if isinstance(c, Quiver)]
    assert len(arrows) == 2
    assert np.allclose(arrows[0].U, 5.0 * r.residuals[r.times < 10, 0])
    assert np.allclose(arrows[1].get_offsets(), r.points[r.times > 30])
