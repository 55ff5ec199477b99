"""Metrics of a merged map: agreement of the runs and, with ground truth, errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, se2_transform
from graphslam.evaluate.gauge import aligned_nees
from graphslam.evaluate.map_error import landmark_error, match_ids
from graphslam.evaluate.metrics import Metrics, add_nees, rms
from graphslam.evaluate.trajectory_error import match_stamps
from graphslam.solve.solution import Solution

if TYPE_CHECKING:
    from graphslam.app.sessions.merged_map import Session


def merge_metrics(
    sessions: Sequence[Session],
    solution: Solution,
    keep: npt.NDArray[np.bool_],
    seen_by: npt.NDArray[np.int64],
    split: int,
    *,
    identities: bool,
) -> list[dict[str, Any]]:
    """Metrics of a merged map; with true identities also errors and NEES, all after *one* rigid alignment.

    The alignment fits the landmarks of the whole map to the ground truth, and is used for the paths too, so it does not
    hide a wrong alignment of one run in the common map. ``<name>_landmark_rmse_alone`` is that of the single run,
    aligned separately.
    """
    out = Metrics()
    out.add("sessions", len(sessions))
    out.add("submaps", sum(len(s.keys) for s in sessions))
    out.add("landmarks", int(keep.sum()))
    out.add("landmarks_shared", int(np.sum(seen_by[keep] > 1)))
    out.add("observations_split", split)
    score = solution.score["submap"]
    out.add("join_chi2", score.chi2)
    out.add("join_dof", score.dof)
    out.add("join_chi2_per_dof", score.chi2_per_dof, "", "one")
    out.add("converged", float(solution.converged), "", "higher")
    out.add("states", solution.states)
    for s in sessions:
        if s.alignment is not None:
            out.add(f"{s.name}_common_landmarks", len(s.alignment.pairs))
            out.add(f"{s.name}_alignment_rms", s.alignment.rms, "m", "lower")
            sigma = np.sqrt(np.diag(s.map.node_covariances[0]))
            out.add(f"{s.name}_base_sigma", float(np.hypot(*sigma[:2])), "m", "lower")
    truth = sessions[0].run.truth
    if truth is not None and identities and len(truth.landmark_ids):
        _score(out, sessions, solution, keep, truth.landmark_ids, truth.landmarks)
    return out.rows


def _score(
    out: Metrics,
    sessions: Sequence[Session],
    solution: Solution,
    keep: npt.NDArray[np.bool_],
    true_ids: npt.NDArray[np.int64],
    true_points: Array,
) -> None:
    """Errors against ground truth in the frame of the first session's first base."""
    rows = np.flatnonzero(keep)
    i, j = match_ids(solution.landmark_ids[rows], true_ids)
    if len(i) < 2:
        return
    rows = rows[i]
    ids, points = solution.landmark_ids[rows], solution.landmarks[rows]
    fit = landmark_error(ids, points, true_ids, true_points, gauge="rigid")
    out.add("landmark_rmse_aligned", fit.statistics.rmse, "m", "lower")
    out.add("landmark_max_aligned", fit.statistics.maximum, "m", "lower")
    if len(ids) > 2:
        none = np.zeros((0, 3))
        P = solution.joint_marginal(f"l{k}" for k in ids.tolist())
        nees = aligned_nees(none, points, (none, true_points[j]), P)
        add_nees(out, "nees_aligned_landmarks", nees, 2 * len(ids) - 3)
    for s in sessions:
        truth, path = s.run.truth, s.run.truth_path
        if truth is None or path is None:
            continue
        # landmarks known in the frames of two first bases give the transform between the two true frames
        try:
            frames = landmark_error(truth.landmark_ids, truth.landmarks, true_ids, true_points, gauge="rigid")
        except DataError:
            continue
        a, b = match_stamps(path.times, s.map.trajectory.times)
        if len(a) == 0:
            continue
        where = se2_transform(fit.T_truth_estimate, s.map.trajectory.positions[b])
        error = where - se2_transform(frames.T_truth_estimate, path.positions[a])
        out.add(f"{s.name}_path_rmse", rms(error), "m", "lower")
        for key, name in (("landmark_rmse_aligned", "landmark_rmse_alone"), ("path_rmse_aligned", "path_rmse_alone")):
            if any(r["key"] == key for r in s.run.metric_rows):
                out.add(f"{s.name}_{name}", s.run.metric(key), "m", "lower")
