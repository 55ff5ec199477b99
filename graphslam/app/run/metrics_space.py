"""Figures of a run in space against its truth: errors and honesty by block."""

from __future__ import annotations

import numpy as np

from graphslam.app.run.metrics import Metrics
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.map_truth import MapTruth
from graphslam.core.poses import SE3
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.map_error import match_ids
from graphslam.evaluate.trajectory_error import ate
from graphslam.solve.solution import Solution

BLOCKS = {"position": slice(3, 6), "heading": slice(2, 3), "level": slice(0, 2)}
"""Tangent components of the blocks that honesty is told by: position, heading, roll and pitch."""


def truth_metrics_in_space(
    out: Metrics, solution: Solution, truth: MapTruth, *, path: Trajectory | None = None
) -> None:
    """RMSE and NEES of the ends of the submaps with the first base fixed, and errors of the path after an alignment.

    Errors are right tangents, ``Log(T_est⁻¹ T_true)``. The NEES of a block is the mean over the submaps of that of its
    marginal; ``nees`` itself is that of all ends jointly.

    Parameters
    ----------
    path : Trajectory, optional
        True path at full rate.
    """
    i, j = match_ids(solution.submap_keys, truth.keys)
    nodes = solution.exit_nodes[i]
    e = SE3.log(SE3.between(solution.poses[nodes], truth.exit_poses[j]))
    out.add("pose_rmse", _rms(e[:, BLOCKS["position"]]), "m", "lower")
    out.add("heading_rmse", np.rad2deg(_rms(e[:, BLOCKS["heading"]])), "deg", "lower")
    out.add("level_rmse", np.rad2deg(_rms(e[:, BLOCKS["level"]])), "deg", "lower")
    if path is not None and len(path) >= 3:
        for name, alignment in (("path_rmse", "none"), ("path_rmse_aligned", "se")):
            whole = ate(solution.trajectory(covariances=False), path, alignment=alignment)  # type: ignore[arg-type]
            out.add(name, whole.statistics.rmse, "m", "lower")
            out.add(name.replace("rmse", "max"), whole.statistics.maximum, "m", "lower")
    P = solution.joint_marginal([f"x{n}" for n in nodes])
    nees = float(e.ravel() @ np.linalg.solve(P, e.ravel()))
    out.add("nees", nees)
    out.add("nees_dof", e.size)
    out.add("nees_per_dof", nees / e.size, "", "one")
    out.add("ci", nees / chi2_quantile(0.95, e.size), "", "lower")
    k = np.arange(len(nodes))
    marginals = P.reshape(len(k), 6, len(k), 6)[k, :, k, :]
    for name, block in BLOCKS.items():
        d = e[:, block]
        each = np.einsum("ki,kij,kj->k", d, np.linalg.inv(marginals[:, block, block]), d)
        out.add(f"anees_{name}_per_dof", float(np.mean(each)) / d.shape[1], "", "one")


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
