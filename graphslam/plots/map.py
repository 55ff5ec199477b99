"""Map figure: path, landmarks with their uncertainty, GPS, ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from graphslam.core.errors import CovarianceError, GeometryError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, tangent_to_vector_covariance
from graphslam.core.log import Truth
from graphslam.core.records import Gps
from graphslam.core.submap import LandmarkMap
from graphslam.core.trajectory import Trajectory
from graphslam.plots import style

Path = Trajectory | npt.ArrayLike
POSE_ELLIPSES = 12
"""Number of position ellipses along the path of a map."""


def positions_of(path: Path) -> Array:
    """``(n, 2)`` positions of a trajectory, or of an array with at least two columns (x, y first)."""
    points = path.positions if isinstance(path, Trajectory) else np.asarray(path, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] < 2:
        raise GeometryError("nothing to draw: positions have the wrong shape", got=points.shape, wanted="(n, ≥ 2)")
    return np.asarray(points[:, :2])


def ellipse_axes(covariances: npt.ArrayLike, confidence: float = 0.95) -> tuple[Array, Array, Array]:
    """Full widths, full heights [m] and angles [rad] of the confidence ellipses of ``(n, 2, 2)`` covariances.

    The ellipse ``dᵀ P⁻¹ d = χ²_{2,confidence}`` has half axes ``sqrt(χ² λ)`` along the eigenvectors of P.
    """
    P = np.asarray(covariances, dtype=np.float64)
    if P.ndim != 3 or P.shape[1:] != (2, 2):
        raise CovarianceError("ellipses need 2 × 2 covariances", got=P.shape, wanted="(n, 2, 2)")
    if not np.all(np.isfinite(P)):
        raise CovarianceError("covariance of an ellipse is not finite", got=int(np.argwhere(~np.isfinite(P))[0][0]))
    values, vectors = np.linalg.eigh(P)
    if np.any(values < 0):
        k = int(np.argwhere(values < 0)[0][0])
        raise CovarianceError(f"covariance {k} of an ellipse is not positive", got=values[k].min(), wanted="≥ 0")
    size = 2.0 * np.sqrt(chi2_quantile(confidence, 2) * values)
    major = vectors[:, :, 1]
    return size[:, 1], size[:, 0], np.arctan2(major[:, 1], major[:, 0])


def plot_ellipses(
    ax: Axes | None,
    centres: npt.ArrayLike,
    covariances: npt.ArrayLike,
    *,
    confidence: float = 0.95,
    colour: str = style.LANDMARK,
    label: str | None = None,
    alpha: float = 0.18,
) -> Axes:
    """Confidence ellipses of ``(n, 2)`` points, in metres: they scale with the map."""
    ax = style.new_axes(ax)
    c = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
    width, height, angle = ellipse_axes(covariances, confidence)
    if len(width) != len(c):
        raise CovarianceError("points and covariances differ in number", got=len(width), wanted=len(c))
    ellipses = EllipseCollection(
        width,
        height,
        np.degrees(angle),
        units="xy",
        offsets=c,
        offset_transform=ax.transData,
        facecolors=_with_alpha(colour, alpha),
        edgecolors=_with_alpha(colour, 0.9),
        linewidths=0.7,
        zorder=2.5,
    )
    ax.add_collection(ellipses, autolim=False)
    if label is not None:  # legends have no handler for ellipse collections: an empty scatter represents it
        ax.scatter([], [], s=60, marker="o", fc=_with_alpha(colour, alpha), ec=_with_alpha(colour, 0.9), label=label)
    # a collection with offsets does not enter the data limits by its size: add the bounding box of each ellipse
    half = np.sqrt(chi2_quantile(confidence, 2) * np.einsum("nii->ni", np.asarray(covariances, dtype=np.float64)))
    if len(c):
        ax.update_datalim(np.concatenate([c - half, c + half]))
        ax.autoscale_view()
    return ax


def _with_alpha(colour: str, alpha: float) -> tuple[float, float, float, float]:
    r, g, b = (int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return r, g, b, alpha


def landmark_blocks(covariances: npt.ArrayLike, n: int, *, offset: int = 0) -> Array:
    """Marginals ``(n, 2, 2)`` from ``(n, 2, 2)`` blocks or from a joint covariance ``(offset + 2n, …)``."""
    P = np.asarray(covariances, dtype=np.float64)
    if P.ndim == 3:
        return P
    if P.shape != (offset + 2 * n, offset + 2 * n):
        raise CovarianceError("joint covariance does not fit the landmarks", got=P.shape, wanted=offset + 2 * n)
    ix = offset + 2 * np.arange(n)[:, None] + np.arange(2)
    return np.asarray(P[ix[:, :, None], ix[:, None, :]])


def plot_map(
    ax: Axes | None = None,
    *,
    trajectory: Path | None = None,
    landmarks: LandmarkMap | npt.ArrayLike | None = None,
    covariances: npt.ArrayLike | None = None,
    gps: Gps | npt.ArrayLike | None = None,
    truth: Truth | Path | None = None,
    dead_reckoning: Path | None = None,
    before: Path | None = None,
) -> Axes:
    """Draw a 2-D map; everything in one frame.

    Parameters
    ----------
    ax : Axes, optional
        None: a new figure.
    trajectory : Trajectory or (n, ≥ 2), optional
        Estimated path, with 95 % ellipses of some positions if it has covariances.
    landmarks : LandmarkMap or (n, 2), optional
        Estimated landmarks; a LandmarkMap brings its covariance.
    covariances : (n, 2, 2) or (2n, 2n), optional
        Of the landmarks.
    gps : Gps or (n, 2), optional
        Fixes, already in the map's frame.
    truth : Truth, Trajectory or (n, ≥ 2), optional
    dead_reckoning : Trajectory or (n, ≥ 2), optional
        The path before any correction.
    before : Trajectory or (n, ≥ 2), optional
        The path of the graph, where a refinement began.
    """
    ax = style.new_axes(ax)
    if dead_reckoning is not None:
        p = positions_of(dead_reckoning)
        ax.plot(p[:, 0], p[:, 1], color=style.DEAD_RECKONING, lw=1.5, ls=":", label="dead reckoning", zorder=1)
    if before is not None:
        p = positions_of(before)
        ax.plot(p[:, 0], p[:, 1], color=style.GRAPH, lw=1.5, label="graph, before the refinement", zorder=2)
    if truth is not None:
        _plot_truth(ax, truth)
    if gps is not None:
        g = np.asarray(gps.positions if isinstance(gps, Gps) else gps, dtype=np.float64)
        ax.plot(g[:, 0], g[:, 1], "+", color=style.GPS, ms=5, mew=0.9, alpha=0.8, label="GPS", zorder=1.5)
    if landmarks is not None:
        _plot_landmarks(ax, landmarks, covariances)
    if trajectory is not None:
        p = positions_of(trajectory)
        ax.plot(p[:, 0], p[:, 1], color=style.ESTIMATE, lw=1.6, label="path", zorder=3)
        ax.plot(p[0, 0], p[0, 1], "o", color=style.ESTIMATE, ms=6, mec="white", mew=0.8, label="start", zorder=4)
        if isinstance(trajectory, Trajectory) and trajectory.covariances is not None:
            k = np.unique(np.linspace(0, len(trajectory) - 1, POSE_ELLIPSES).astype(int))
            P = tangent_to_vector_covariance(trajectory.poses[k], trajectory.covariances[k])[:, :2, :2]
            plot_ellipses(ax, p[k], P, colour=style.ESTIMATE, label=style.ellipses("path"))
    style.metric_axes(ax)
    style.legend(ax)
    return ax


def _plot_truth(ax: Axes, truth: Truth | Path) -> None:
    if isinstance(truth, Truth):
        if len(truth.landmarks):
            ax.plot(
                *truth.landmarks[:, :2].T,
                "x",
                color=style.GREY,
                ms=5,
                mew=0.9,
                label="true landmarks",
                zorder=2.2,
            )
        truth = truth.trajectory
    p = positions_of(truth)
    ax.plot(p[:, 0], p[:, 1], color=style.TRUTH, lw=1.0, ls="--", label="truth", zorder=3.2)


def _plot_landmarks(ax: Axes, landmarks: LandmarkMap | npt.ArrayLike, covariances: npt.ArrayLike | None) -> None:
    if isinstance(landmarks, LandmarkMap):
        points = landmarks.positions[:, :2]
        blocks = landmark_blocks(landmarks.dense_covariance(), len(landmarks), offset=3) if landmarks.dim == 2 else None
    else:
        points, blocks = np.asarray(landmarks, dtype=np.float64).reshape(-1, 2), None
    if covariances is not None:
        blocks = landmark_blocks(covariances, len(points))
    if blocks is not None and len(points):
        plot_ellipses(ax, points, blocks, colour=style.LANDMARK, label=style.ellipses("landmarks"))
    name: dict[str, Any] = {} if blocks is not None else {"label": "landmarks"}
    ax.plot(points[:, 0], points[:, 1], ".", color=style.LANDMARK, ms=3, zorder=3.4, **name)
