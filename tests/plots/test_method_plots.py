"""Figures of particles, hand-overs, several methods' maps and the gap: they draw the figures they are given."""

from __future__ import annotations

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Rectangle

import graphslam as gs
from graphslam.app.run.local_maps import first_particles, local_maps
from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_quantile
from graphslam.join.registry import join_by_method
from graphslam_studies.evaluate.submap_consistency import true_submap
from graphslam_studies.plots.gap import FLOOR, plot_convergence, plot_gap_along, plot_tree_gap
from graphslam_studies.plots.method_maps import plot_method_maps
from graphslam_studies.plots.particles import (
    histories_left,
    plot_exit,
    plot_exit_panels,
    plot_handovers,
    plot_histories,
    plot_lineage,
)

OPTIONS = {"particles": 20, "stopping": {"scans": 20}}


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def log():
    return gs.simulate("landmark-field", seed=2, preset="quick").slice(0.0, 20.0)


@pytest.fixture(scope="module")
def made(log):
    smoothed, particles = first_particles(log, seed=2, options=OPTIONS)
    moments = first_particles(log, seed=2, options={**OPTIONS, "handover": "moments"})[0]
    return smoothed, moments, particles


def ellipses(ax) -> list[EllipseCollection]:
    return [c for c in ax.collections if isinstance(c, EllipseCollection)]


def points(ax, label: str) -> np.ndarray:
    return next(l for l in ax.get_lines() if l.get_label() == label).get_xydata()


def test_exit_shows_particles_gaussians_and_truth(log, made) -> None:
    smoothed, moments, particles = made
    ax = plot_exit(None, {"smoothed": smoothed, "moments": moments}, particles=particles, truth=log.truth)
    first, second = ellipses(ax)
    np.testing.assert_allclose(first.get_offsets()[0], smoothed.exit_pose[:2])
    np.testing.assert_allclose(second.get_offsets()[0], moments.exit_pose[:2])
    cov = moments.landmarks.dense_covariance()[:2, :2]
    assert second.get_widths()[0] == pytest.approx(2 * np.sqrt(chi2_quantile(0.95, 2) * np.linalg.eigvalsh(cov)[1]))
    np.testing.assert_allclose(points(ax, "true exit")[0], true_submap(smoothed, log.truth)[0][:2])
    (cloud,) = [c for c in ax.collections if c.get_label() == "particles"]
    assert len(cloud.get_offsets()) == len(np.unique(particles.pose[:, :2], axis=0))
    # the area goes with the weight
    sizes, w = cloud.get_sizes(), particles.weights[np.lexsort(particles.pose[:, 1::-1].T)]
    assert len(sizes) < len(w) or np.corrcoef(sizes, w)[0, 1] > 0.9
    axes = plot_exit_panels({"a": (particles, {"s": smoothed}), "b": (None, {"m": moments})}, truth=log.truth)
    assert [a.get_title() for a in axes] == ["a", "b"]
    assert axes[0].get_xlim() == axes[1].get_xlim()
    assert axes[0].get_legend() is None
    for call in (plot_exit, plot_handovers):
        with pytest.raises(DataError, match="no submap"):
            call(None, {})


def test_handovers_hold_every_landmark_of_every_map(log, made) -> None:
    smoothed, moments, _ = made
    ax = plot_handovers(None, {"smoothed": smoothed, "moments": moments}, truth=log.truth)
    for collection, submap in zip(ellipses(ax), (smoothed, moments), strict=True):
        np.testing.assert_allclose(collection.get_offsets()[1:], submap.landmarks.positions)
    assert len(points(ax, "true landmark")) == len(smoothed.landmarks)


def test_lineage_is_sideways_from_the_smoothed_path(made) -> None:
    smoothed, _, particles = made
    ax = plot_lineage(None, particles, smoothed)
    lines = [l for l in ax.get_lines() if len(l.get_xdata()) == particles.scans]
    assert 1 <= len(lines) <= len(particles.weights)
    # the winner's last pose, by hand: rotated into the smoothed body
    end = smoothed.trajectory.poses[-1]
    d = particles.pose[:, :2] - end[:2]
    sideways = -np.sin(end[2]) * d[:, 0] + np.cos(end[2]) * d[:, 1]
    np.testing.assert_allclose(sorted({round(float(l.get_ydata()[-1]), 9) for l in lines}),
                               sorted({round(float(v), 9) for v in sideways}), atol=1e-8)  # fmt: skip
    left = histories_left(particles)
    assert left[-1] == len(np.unique(particles.pose, axis=0))
    assert left[0] == particles.ancestors  # before any resampling every particle has a pose of its own
    curve = plot_histories(None, {"20": particles}).get_lines()[0].get_ydata()
    np.testing.assert_array_equal(curve, left)


def test_method_maps_state_their_own_figures(log) -> None:
    submaps = local_maps(log, seed=2, options=OPTIONS)
    joined = join_by_method(submaps, "eif-tree", polish=True)
    (whole,) = local_maps(log, "ekf-slam", seed=2)
    one, two = plot_method_maps({"polished": joined, "EKF": whole}, log.truth)
    truth = dict(zip(log.truth.landmark_ids.tolist(), log.truth.landmarks))
    for ax, ids, marks, cov in (
        (one, joined.landmark_ids, joined.landmarks, [joined.landmark_covariance(int(i)) for i in joined.landmark_ids]),
        (two, whole.landmarks.ids, whole.landmarks.positions,
         [whole.landmarks.dense_covariance()[k:k + 2, k:k + 2] for k in range(3, 3 + 2 * len(whole.landmarks), 2)]),
    ):  # fmt: skip
        e = np.array([truth[int(i)] for i in ids]) - marks
        d2 = np.array([d @ np.linalg.solve(P, d) for d, P in zip(e, cov)])
        rms = np.sqrt((e**2).sum(axis=1).mean())
        inside = np.mean(d2 <= chi2_quantile(0.95, 2))
        assert f"RMS {rms:.3g} m, {inside:.0%} of {len(ids)} inside" in ax.get_title()
        (lines,) = [c for c in ax.collections if type(c) is LineCollection]
        assert len(lines.get_segments()) == len(ids)
    with pytest.raises(DataError, match="no maps"):
        plot_method_maps({}, log.truth)


def test_gap_figures(rng: np.random.Generator) -> None:
    best = np.array([0.0, 5.0, 20.0, 50.0])
    gap = np.array([0.0, 1.0, 0.0, -1e-12])
    table = pd.DataFrame({"submap": range(4), "method": "m", "objective": best + gap, "optimum": best, "gap": gap})
    ax = plot_gap_along(None, table)
    np.testing.assert_allclose(points(ax, "m"), [[2, 0.2], [3, FLOOR], [4, FLOOR]])
    tree = pd.DataFrame({"level": [1, 1, 2], "first": [0, 2, 0], "last": [1, 3, 3], "own": [0.1, 2.0, 30.0]})
    tree["gap"] = [0.1, 2.0, 32.1]
    for value, top in (("own", "30"), ("gap", "32.1")):
        ax = plot_tree_gap(None, tree, value=value)
        boxes = [p for p in ax.patches if isinstance(p, Rectangle)]
        assert [(b.get_x(), b.get_width()) for b in boxes] == [(0.5, 2), (2.5, 2), (0.5, 4)]
        assert top in [t.get_text() for t in ax.texts]
    ax = plot_convergence(None, {"tree": [12.0, 10.1, 10.0], "chain": [1000.0, 20.0, 10.0, 10.0]})
    np.testing.assert_allclose(points(ax, "tree: 2 steps")[:, 1], [0.2, 0.01, FLOOR])
    for call in (plot_gap_along, plot_tree_gap):
        with pytest.raises(DataError, match="to draw"):
            call(None, table.iloc[:0].assign(level=0, first=0, last=0, own=0.0))
